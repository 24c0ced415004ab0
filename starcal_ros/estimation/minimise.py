# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The state of least cost: camera, alignment and the rotations of the images."""

from __future__ import annotations

import dataclasses

import numpy as np

from starcal_ros.arrays import Floats, Indices
from starcal_ros.estimation.attitude_errors import whitened_attitude_errors
from starcal_ros.estimation.equations import arrow, stars_alone
from starcal_ros.estimation.levenberg_marquardt import (
    levenberg_marquardt,
    NormalEquations,
    Solution,
    solve_arrow,
)
from starcal_ros.estimation.problem import image_blocks, Problem, State
from starcal_ros.estimation.star_equations import Measurements
from starcal_ros.estimation.unknowns import Layout, moved, unknowns_in_state

Minimum = Solution[State, NormalEquations]


def minimise(
    problem: Problem,
    start: State,
    measurements: Measurements,
    loss_scale: float = np.inf,
    least_gain: float = 0.0,
) -> Minimum:
    """
    Return the state of least cost, by Levenberg-Marquardt.

    ``loss_scale`` is that of `star_equations.normal_blocks`: infinite is least squares;
    ``least_gain`` is that of `levenberg_marquardt`.

    Raises
    ------
    NotObservable
        When the stars do not determine all unknowns.
    """

    def evaluate(state: State) -> NormalEquations:
        cost, blocks = image_blocks(problem, state, measurements, loss_scale)
        if not np.isfinite(cost):
            none: Floats = np.empty(0)
            return NormalEquations(cost, none, none, none, none, none)
        return equations_in_state(problem, state, cost, blocks)

    def move(state: State, shared: Floats, blocks: Floats) -> State:
        layout = unknowns_in_state(problem, state)
        step = np.zeros(layout.count)
        step[estimated(layout)] = shared
        return moved(problem, state, layout, step, blocks)

    return levenberg_marquardt(start, evaluate, move, least_gain)


def without_parameter(
    problem: Problem, minimum: Minimum, k: int, value: float
) -> tuple[Problem, State]:
    """
    Return the problem with the k-th camera parameter held at a value, and a start of its search.

    That is where the normal equations of the minimum have the least cost under that condition.

    Raises
    ------
    NotObservable
        When the stars do not determine all other unknowns.
    """
    state, normal = minimum.state, minimum.normal
    layout = unknowns_in_state(problem, state)
    kept = estimated(layout)
    at = int(np.flatnonzero(kept == layout.places['camera'].start + k)[0])
    others = np.delete(np.arange(len(kept)), at)
    step = value - float(state.parameters[k])
    left, blocks = solve_arrow(
        NormalEquations(
            normal.cost,
            normal.A[np.ix_(others, others)],
            normal.a[others] - normal.A[others, at] * step,
            normal.B[:, :, others],
            normal.C,
            normal.c - normal.B[:, :, at] * step,
        ),
        0.0,
    )
    shared = np.zeros(layout.count)
    shared[kept] = np.insert(left, at, step)
    after = moved(problem, state, layout, shared, blocks)
    after.parameters[k] = value  # to the last digit
    return dataclasses.replace(problem, free=problem.free[problem.free != k]), after


def estimated(layout: Layout) -> Indices:
    """Return the places of the shared unknowns that are not held."""
    return np.flatnonzero(np.isfinite(layout.prior_precision))


def equations_in_state(
    problem: Problem, state: State, cost: float, blocks: Floats
) -> NormalEquations:
    """
    Return the normal equations of the estimated unknowns with their priors.

    ``cost`` and ``blocks`` are those of `problem.image_blocks`.
    """
    layout = unknowns_in_state(problem, state)
    normal = arrow(stars_alone(blocks, problem, layout), problem, state, layout)
    kept = estimated(layout)
    precision, offset = layout.prior_precision[kept], layout.prior_offset[kept]
    off_tracker, _ = whitened_attitude_errors(problem, state)
    cost += 0.5 * float((off_tracker**2).sum() + precision @ offset**2)
    return NormalEquations(
        cost,
        normal.A[np.ix_(kept, kept)] + np.diag(precision),
        normal.a[kept] - precision * offset,
        normal.B[:, :, kept],
        normal.C,
        normal.c,
    )
