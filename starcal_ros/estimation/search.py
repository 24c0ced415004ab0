# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The search: its start, and the state of least cost of camera, alignment and images.

An attitude, an alignment or a mounting may be wrong by more than a search can cross: a robust loss
has no slope far from the stars, and none behind the camera.  Each image therefore begins with the
rotation from its own stars; these give alignment and mountings.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel
from starcal_ros.camera.lens import LENSES
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.errors import OptionError
from starcal_ros.estimation.equations import arrow, stars_alone
from starcal_ros.estimation.image_rotations import fitted_rotations
from starcal_ros.estimation.levenberg_marquardt import (
    levenberg_marquardt,
    NormalEquations,
    Solution,
)
from starcal_ros.estimation.options import (
    assumed_tracker_sigma_rad,
    CalibrationOptions,
    estimated_parameters,
)
from starcal_ros.estimation.problem import Problem, reference_degc, star_tracker_names, State
from starcal_ros.estimation.star_equations import Measurements, StarTable
from starcal_ros.estimation.unknowns import Layout, moved, unknowns_in_state
from starcal_ros.records import CameraGeometry, Ensemble

Minimum = Solution[State]
_SERIES_RAD = 0.3  # angle from the axis at which all orders of a distortion may be as large


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
        layout = unknowns_in_state(problem, state)
        cost, sums = stars_alone(problem, state, layout, measurements, loss_scale)
        normal, kept = arrow(sums, problem, state, layout), estimated(layout)
        precision, offset = layout.prior_precision[kept], layout.prior_offset[kept]
        return NormalEquations(
            cost + normal.cost + 0.5 * float(precision @ offset**2),
            normal.A[np.ix_(kept, kept)] + np.diag(precision),
            normal.a[kept] - precision * offset,
            normal.B[:, :, kept],
            normal.C,
            normal.c,
        )

    def move(state: State, shared: Floats, blocks: Floats) -> State:
        layout = unknowns_in_state(problem, state)
        step = np.zeros(layout.count)
        step[estimated(layout)] = shared
        return moved(problem, state, layout, step, blocks)

    return levenberg_marquardt(start, evaluate, move, least_gain)


def estimated(layout: Layout) -> Indices:
    """Return the places of the shared unknowns that are not held."""
    return np.flatnonzero(np.isfinite(layout.prior_precision))


def problem_of(ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions) -> Problem:
    """Problem of a search over an ensemble."""
    camera, model, names = prior.camera, prior.camera.model, prior.camera.parameter_names
    prior_sigma = np.array(np.broadcast_to(options.prior_sigma, len(names)))
    free = {names.index(name) for name in estimated_parameters(options, model)}
    is_default = (prior_sigma == 0) & np.isin(np.arange(len(names)), list(free))
    prior_sigma = np.where(is_default, _default_sigma(prior.camera, options), prior_sigma)
    stamps_ns = np.array([image.time_ns for image in ensemble.images], np.int64)
    late_s = (stamps_ns - stamps_ns[0]) / NANOSECONDS_PER_SECOND
    stars = [max(len(image), 1) for image in ensemble.images]
    attitudes = Rotation.from_quat(
        np.array([image.icrf_from_star_tracker_xyzw for image in ensemble.images])
    )
    names = star_tracker_names(ensemble)
    mountings = None
    if len(names) > 1:
        if options.method == 'per_image':
            raise OptionError(
                'method: per_image has no common alignment, which several star trackers need'
            )
        mountings = Rotation.from_quat(
            np.array([image.first_from_star_tracker_xyzw for image in ensemble.images])
        )
        attitudes = attitudes * mountings
    return Problem(
        method=options.method,
        model=model,
        free=np.array(sorted(free), np.int64),
        prior_parameters=camera.parameters,
        prior_sigma=np.where(prior_sigma > 0, prior_sigma, np.inf),
        star_tracker_from_icrf=attitudes.inv(),
        star_tracker_sigma_rad=np.tile(
            assumed_tracker_sigma_rad(options), (len(ensemble.images), 1)
        ),
        above_reference_k=np.array([image.temperature_degc for image in ensemble.images])
        - reference_degc(ensemble),
        star_tracker=np.array([names.index(image.star_tracker) for image in ensemble.images]),
        first_from_star_tracker=mountings,
        mounting_sigma_rad=options.star_tracker_mounting_sigma_arcsec * ARCSECOND_RAD,
        time_s=late_s - np.average(late_s, weights=stars),
        is_weak=is_default & np.isin(camera.parameter_names, LENSES[model].coefficients),
    )


def _default_sigma(camera: CameraModel, options: CalibrationOptions) -> Floats:
    """
    Return the 1-sigma (p,) of camera parameters that no option states; 0: no prior.

    Lens coefficients by their displacement of a corner: without a prior, those of a numerator and
    a denominator run into a pole on the detector.  The series of a lens is in the angle from its
    axis: in a narrow field each order is smaller than the one before, and the stars do not show
    it.
    """
    corner = 0.5 * np.array([camera.width, camera.height]) / camera.parameters[0]
    lens = camera.lens
    none = np.zeros(len(lens.coefficients))
    effect, half_way = (
        np.linalg.norm(lens.by_coefficients(part * corner, none), axis=0) for part in (1.0, 0.5)
    )
    beyond_third = np.maximum(np.log2(effect / half_way) - 3.0, 0.0)
    falling = min(float(np.linalg.norm(corner)) / _SERIES_RAD, 1.0) ** beyond_third
    centre_px = options.principal_point_prior * max(camera.width, camera.height)
    of_lens = options.lens_prior * np.linalg.norm(corner) / effect * falling
    return np.concatenate([[0.0, 0.0, 0.0, centre_px, centre_px], of_lens])


def start_of(problem: Problem, prior: CameraGeometry, order: int, with_rate: bool) -> State:
    """The prior as a state, with so many focal terms of zero and a rate of zero, or none."""
    alignment = Rotation.from_quat(prior.star_tracker_from_camera_xyzw).inv()
    return State(
        prior.camera.parameters.copy(),
        alignment,
        alignment * problem.star_tracker_from_icrf
        if problem.first_from_star_tracker is None
        else alignment * problem.first_from_star_tracker * problem.star_tracker_from_icrf,
        np.zeros(order),
        np.zeros(3 if with_rate else 0),
        mountings=np.zeros(3 * int(problem.star_tracker.max(initial=0))),
    )


def moved_to_stars(problem: Problem, start: State, table: StarTable, camera: CameraModel) -> State:
    """Return a start with alignment, mountings and rotations by the stars, the camera as given."""
    rotations, by_stars = fitted_rotations(start.camera_from_icrf, table, camera)
    # The alignment to the first star tracker that each image shows, the mountings as assumed.
    shown = rotations * problem.star_tracker_from_icrf.inv()
    if problem.first_from_star_tracker is not None:
        shown = shown * problem.first_from_star_tracker.inv()
    alignment, mountings = None, start.mountings.copy()
    for k in np.unique(problem.star_tracker[by_stars]):
        own = shown[by_stars & (problem.star_tracker == k)].mean()
        if alignment is None:
            alignment = own
        elif k:
            mountings[3 * k - 3 : 3 * k] = -(own * alignment.inv()).as_rotvec()
    return dataclasses.replace(
        start,
        camera_from_star_tracker=alignment or start.camera_from_star_tracker,
        camera_from_icrf=rotations,
        mountings=mountings,
    )
