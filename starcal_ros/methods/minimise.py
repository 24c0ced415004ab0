# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The state of least cost of a calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.least_squares.levenberg_marquardt import (
    levenberg_marquardt,
    NormalEquations,
    Solution,
    solve_arrow,
)
from starcal_ros.least_squares.linear_terms import LinearTerms
from starcal_ros.least_squares.normal_equations import Measurements
from starcal_ros.methods.assembly import assemble
from starcal_ros.methods.problem import (
    field_terms,
    image_alignment,
    image_blocks,
    Problem,
    State,
)


@dataclass(frozen=True)
class ImageEquations(NormalEquations):
    """Normal equations and what they are made of: `image_blocks` and `field_terms`."""

    blocks: Floats
    terms: LinearTerms | None


Minimum = Solution[State, ImageEquations]


def image_equations(
    problem: Problem, state: State, cost: float, blocks: Floats, terms: LinearTerms | None
) -> ImageEquations:
    """Normal equations of `assemble` with its arguments."""
    normal = assemble(problem, state, cost, blocks, terms)
    return ImageEquations(**vars(normal), blocks=blocks, terms=terms)


def minimise(
    problem: Problem,
    start: State,
    measurements: Measurements,
    loss_scale: float = np.inf,
    at_start: tuple[float, Floats] | None = None,
    least_gain: float = 0.0,
) -> Minimum:
    """
    The state of least cost, by Levenberg-Marquardt.

    ``loss_scale`` is that of `normal_equations.normal_blocks`: infinite is least squares;
    ``at_start`` are the `image_blocks` at the start, where they are known; ``least_gain`` is that
    of `levenberg_marquardt`.

    Raises
    ------
    NotObservable
        When the stars do not determine all unknowns.
    """
    information: Floats | None = None  # of the modes of the field: the same at every state

    def evaluate(state: State) -> ImageEquations:
        nonlocal information
        if at_start is not None and state is start:
            cost, blocks = at_start
        else:
            cost, blocks = image_blocks(problem, state, measurements, loss_scale)
        if not np.isfinite(cost):
            none: Floats = np.empty(0)
            return ImageEquations(cost, none, none, none, none, none, none, None)
        terms = field_terms(problem, state, measurements, information)
        information = terms.information if terms else None
        return image_equations(problem, state, cost, blocks, terms)

    def move(state: State, shared: Floats, blocks: Floats) -> State:
        return _move(problem, state, shared, blocks)

    return levenberg_marquardt(start, evaluate, move, least_gain)


def without_parameter(
    problem: Problem, minimum: Minimum, k: int, value: float
) -> tuple[Problem, State]:
    """
    The problem with the k-th camera parameter held at a value, and where to start the search.

    That is where the normal equations of the minimum have the least cost under that condition.

    Raises
    ------
    NotObservable
        When the stars do not determine all other unknowns.
    """
    state, normal = minimum.state, minimum.normal
    shared = np.arange(len(normal.a))
    at = int(np.flatnonzero(problem.free == k)[0])
    keep = shared[shared != at]
    step = value - float(state.parameters[k])
    left, blocks = solve_arrow(
        NormalEquations(
            normal.cost,
            normal.A[np.ix_(keep, keep)],
            normal.a[keep] - normal.A[keep, at] * step,
            normal.B[:, :, keep],
            normal.C,
            normal.c - normal.B[:, :, at] * step,
        ),
        0.0,
    )
    moved = _move(problem, state, np.insert(left, at, step), blocks)
    moved.parameters[k] = value  # to the last digit
    return replace(problem, free=problem.free[problem.free != k]), moved


def _move(problem: Problem, state: State, shared: Floats, blocks: Floats) -> State:
    """Take a step: parameters add, rotations turn (Eq. 11)."""
    f, q = len(problem.free), len(state.focal)
    parameters = state.parameters.copy()
    parameters[problem.free] += shared[:f]
    r = len(state.modes)
    last = len(shared) - r
    focal, turned = state.focal + shared[f : f + q], shared[f + q : last]
    modes = state.modes + shared[last:]
    alignment, rotations = state.camera_from_star_tracker, state.camera_from_icrf
    shapes = state.shapes + blocks[:, 3:] if state.shapes.size else state.shapes
    if problem.method == 'per_image':
        rotations = Rotation.from_rotvec(-blocks[:, :3]) * rotations
        return State(
            parameters, alignment, rotations, focal, state.rate, modes, shapes, state.mountings
        )
    turn = Rotation.from_rotvec(-turned[:3])
    s = 3 + len(state.rate)
    rate, mountings = state.rate + turned[3:s], state.mountings + turned[s:]
    moved = State(parameters, turn * alignment, rotations, focal, rate, modes, shapes, mountings)
    if problem.method == 'hierarchical':
        rotations = Rotation.from_rotvec(-blocks[:, :3]) * rotations
    elif state.alignment_count > 3:
        rotations = image_alignment(problem, moved) * problem.star_tracker_from_icrf
    else:
        rotations = turn * rotations
    return replace(moved, camera_from_icrf=rotations)
