# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
From an ensemble of observed images to camera, alignment and covariance.

A robust search from the prior; then, in turns, the posterior of all unknowns at the state, a step
to its mean, and the variances of centroids and star trackers, the errors that observations share
and the outliers from what is left, until nothing changes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import CameraModel, project_parameters, rotation_jacobian
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.detector_field import DetectorField
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.attitude_errors import attitude_errors
from starcal_ros.estimation.centroid_noise import CentroidVariance, estimate_variance
from starcal_ros.estimation.equations import (
    chain,
    equations,
    seen_by_stars,
    star_columns,
    star_sums,
    StarSums,
)
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.minimise import minimise, Minimum
from starcal_ros.estimation.options import (
    assumed_tracker_sigma_rad,
    CalibrationOptions,
    check_enough,
    check_options,
    estimated_parameters,
    tracker_sigma_is_given,
)
from starcal_ros.estimation.posterior import (
    Posterior,
    posterior,
    Weights,
    with_shared_errors,
)
from starcal_ros.estimation.problem import image_alignment, image_parameters, Problem, State
from starcal_ros.estimation.reweighting import dropped_stars, fitting_stars, misfit_images
from starcal_ros.estimation.shared_errors import (
    pixel_variance_px2,
    place_variance_px2,
    shared_errors,
    SharedError,
)
from starcal_ros.estimation.star_equations import (
    arrange,
    Measurements,
    squared_sigmas,
    star_table,
    StarTable,
)
from starcal_ros.estimation.star_trackers import (
    AttitudeErrors,
    canonical_xyzw,
    star_tracker_alignments,
    star_tracker_names,
)
from starcal_ros.estimation.start import moved_to_stars
from starcal_ros.estimation.temperature import why_unsupported
from starcal_ros.estimation.tracker_errors import tracker_errors, TrackerErrors
from starcal_ros.estimation.unknowns import (
    Assumptions,
    FIELD_OCTAVES,
    Layout,
    moved,
    SHAPE_MODES,
    unknowns_of,
)
from starcal_ros.records import (
    CameraGeometry,
    Ensemble,
    MapCovariance,
    StarTrackerAlignment,
    TemperatureTerms,
)

_START_FLOOR_PX = 0.05  # until the residuals show it: of the order of what is left in good images
_ROBUST_SCALE = 3.0  # of the Cauchy loss, in sigma: of normal noise 5 % of the weight is lost
_ROBUST_GAIN = 1e-3  # a step of 0.04 sigma: the posterior goes on from there
_ROUNDS = 8  # the set of rejected stars settles in three or four
_STEP_SIGMA = 0.05  # of any unknown, below which the state is at the minimum
_FIRST_SHAPE_PX = 1e-4
# Method 1 does not use the star tracker for the camera, Method 2 takes it as exact: a sigma of a
# thousand times the stated one, and of a milliarcsecond.
_FREE_FACTOR, _EXACT_RAD = 1e3, 1e-3 * ARCSECOND_RAD
_SPACE_VELOCITY_M_S = 8000.0  # an orbit about the Earth
_UNKNOWN_READOUT_S = 0.02  # of a rolling shutter: 5 to 50 ms a frame are usual
_READOUT_ERROR = 0.01  # of the time by a data sheet: the tolerance of a clock, and rounding


@dataclass(frozen=True)
class Estimate:
    """
    A solved calibration, before products; m images, n observations of stars.

    Attributes
    ----------
    geometry : CameraGeometry
    covariance : (p + 3, p + 3)
        Of the p camera parameters and the alignment angles.
    joint_covariance : (p + 3 + 2 t, p + 3 + 2 t)
        Of these and of the coefficients of the field of the camera, those of u, then those of v.
    pixel_sigma_px : float
        1-sigma per axis of structure finer than the field: it is part of any line of sight.
    information : (k, k)
        On the estimated camera parameters, focal terms, alignment and its rate, the images
        eliminated; ``information_names`` are their names.
    shared_covariance : (s, s)
        Of camera parameters, focal terms, alignment, rate and mountings: ``shared_names``.
    problem, state, layout, posterior
        At the last linearisation: the state is the one before the last step.
    sums : StarSums
    measurements : Measurements
        The stars that were used, with the working weights.
    weights : Weights
    table : StarTable
    kept : (n,) bool
        Observations used.
    residual_px : (n, 2)
        Of all observations, all unknowns at their means.
    covariance_px2 : (n, 3)
        Of each observation: noise, and the errors it shares with others.
    variance : CentroidVariance
        How the centroid covariances were corrected.
    variance_factor : float
        chi^2 per degree of freedom of the centroid covariances as given.
    star_tracker_sigma_rad : (3,)
        Noise of the star trackers, estimated.
    misfit_image : (m,) bool
        Images whose attitude does not fit, or that lost their stars.
    dropped_catalog_id : (d,) int64
        Stars that misfit across images and were left out of all.
    alignment_scatter_arcsec : float
        RMS per axis of the alignments that the images show, about their mean.
    attitude_error_rad, attitude_covariance_rad2, attitude_seen : (m, 3), (m, 3, 3), (m,) bool
        Star-tracker errors as the stars show them.
    iterations, termination
    thermal : TemperatureTerms or None
        None where no change with temperature was asked for.
    shared_errors : tuple of SharedError
    tracker_errors : tuple of TrackerErrors
        One for each star tracker with images.
    star_trackers : tuple of StarTrackerAlignment
        Empty where there is one only.
    """

    geometry: CameraGeometry
    covariance: Floats
    joint_covariance: Floats
    pixel_sigma_px: float
    information: Floats
    information_names: tuple[str, ...]
    shared_covariance: Floats
    shared_names: tuple[str, ...]
    problem: Problem
    state: State
    layout: Layout
    posterior: Posterior
    sums: StarSums
    measurements: Measurements
    weights: Weights
    table: StarTable
    kept: Mask
    residual_px: Floats
    covariance_px2: Floats
    variance: CentroidVariance
    variance_factor: float
    star_tracker_sigma_rad: Floats
    misfit_image: Mask
    dropped_catalog_id: NDArray[np.int64]
    alignment_scatter_arcsec: float
    attitude_error_rad: Floats
    attitude_covariance_rad2: Floats
    attitude_seen: Mask
    iterations: int
    termination: str
    thermal: TemperatureTerms | None
    shared_errors: tuple[SharedError, ...]
    tracker_errors: tuple[TrackerErrors, ...]
    star_trackers: tuple[StarTrackerAlignment, ...]

    @property
    def map_covariance(self) -> MapCovariance:
        """Covariance of lines of sight."""
        return MapCovariance(self.joint_covariance, self.pixel_sigma_px)


@dataclass(frozen=True)
class _Data:
    """What stays the same over the rounds of an estimate."""

    table: StarTable
    time_ns: NDArray[np.int64]
    stated_rad: Floats  # (3,)
    prior: CameraGeometry
    options: CalibrationOptions
    rates_rad_s: Floats  # (m, 3) of the first star tracker in its frame
    velocity_sigma_m_s: Floats  # (m,)


@dataclass(frozen=True)
class _Attitudes:
    """Errors of the star trackers as the stars show them, and what follows from them."""

    error_rad: Floats
    covariance_rad2: Floats
    seen: Mask
    misfit: Mask
    trackers: tuple[TrackerErrors, ...]
    images: tuple[NDArray[np.int64], ...]  # of each of them, those that fit


@dataclass(frozen=True)
class _Judged:
    """Conclusions from the residuals of a round: the weights of the next one."""

    variance: CentroidVariance
    errors: tuple[SharedError, ...]
    kept: Mask
    attitudes: _Attitudes | None

    def covariance_px2(self, table: StarTable) -> Floats:
        """Return the covariances (n, 3) of the observations."""
        return self.variance.of(table.covariance_px2, table.magnitude)

    def inflation_px2(self, table: StarTable) -> Floats:
        """
        Return the variance (n,) by which the weights are lower for errors that images share.

        With it, k images of a star weigh as the mean of theirs does.
        """
        sightings = np.bincount(table.star, self.kept, int(table.star.max()) + 1)[table.star]
        return np.asarray(np.maximum(sightings - 1.0, 0.0) * place_variance_px2(self.errors))

    def working_px2(self, table: StarTable) -> Floats:
        """Return the covariances (n, 3) whose inverses are the weights."""
        inflation_px2 = self.inflation_px2(table)
        return self.covariance_px2(table) + np.outer(inflation_px2, [1.0, 0.0, 1.0])


def estimate_calibration(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Estimate:
    """
    Estimate of the camera parameters and the alignment from an ensemble.

    Raises
    ------
    TooFewObservations
        When there are too few images or stars, they do not determine what is to be estimated, or
        the images are mirrored.
    OptionError
        For options that do not go together.
    """
    check_options(options, prior.camera.model)
    check_enough(ensemble, options)
    table = star_table(ensemble.images)
    problem = problem_of(ensemble, prior, options)
    order, with_rate = options.focal_temperature_order, options.alignment_temperature
    note = (order or with_rate) and why_unsupported(
        np.array([image.temperature_degc for image in ensemble.images]), order
    )
    if note:
        order, with_rate = 0, False
    data = _Data(
        table,
        np.array([image.time_ns for image in ensemble.images], np.int64),
        assumed_tracker_sigma_rad(options),
        prior,
        options,
        np.array([image.star_tracker_rate_rad_s for image in ensemble.images]),
        np.array([image.velocity_sigma_m_s for image in ensemble.images]),
    )
    try:
        start = start_of(problem, prior, order, with_rate)
        start = moved_to_stars(problem, start, table, prior.camera)
        result = _estimate(data, problem, start, ensemble)
    except (NotObservable, np.linalg.LinAlgError) as error:
        asked = ', '.join(estimated_parameters(options, problem.model))
        raise TooFewObservations(
            f'the stars do not determine all of {asked} and the alignment: {error}; more images, '
            'or stars over more of the detector, or fewer parameters are needed'
        ) from error
    if result.thermal is None or not note:
        return result
    thermal = dataclasses.replace(result.thermal, note=f'left out: {note}')
    return dataclasses.replace(result, thermal=thermal)


def problem_of(ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions) -> Problem:
    """What a search is given of an ensemble."""
    model, names = prior.camera.model, prior.camera.parameter_names
    prior_sigma = np.array(np.broadcast_to(options.prior_sigma, len(names)))
    weak_px = options.principal_point_prior * max(prior.camera.width, prior.camera.height)
    free = {names.index(name) for name in estimated_parameters(options, model)}
    for k in free & {names.index('cx'), names.index('cy')}:
        if prior_sigma[k] == 0:
            prior_sigma[k] = weak_px
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
        prior_parameters=prior.camera.parameters,
        prior_sigma=np.where(prior_sigma > 0, prior_sigma, np.inf),
        star_tracker_from_icrf=attitudes.inv(),
        star_tracker_sigma_rad=np.tile(
            assumed_tracker_sigma_rad(options), (len(ensemble.images), 1)
        ),
        above_reference_k=np.array([image.temperature_degc for image in ensemble.images])
        - options.reference_temperature_degc,
        star_tracker=np.array([names.index(image.star_tracker) for image in ensemble.images]),
        first_from_star_tracker=mountings,
        mounting_sigma_rad=options.star_tracker_mounting_sigma_arcsec * ARCSECOND_RAD,
    )


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


def _estimate(data: _Data, problem: Problem, start: State, ensemble: Ensemble) -> Estimate:
    """Return the estimate from a start."""
    table, camera = data.table, data.prior.camera
    judged = _Judged(
        CentroidVariance(1.0, _START_FLOOR_PX**2), (), np.ones(len(table), bool), None
    )
    measurements = arrange(table, judged.kept, judged.covariance_px2(table))
    solution = _robust_search(problem, start, measurements)
    state, iterations = solution.state, solution.iterations
    residual_px = _residuals_px(problem, state, table, None, None, camera)
    judged = _judge(data, state, residual_px, np.full(len(table), 2.0), judged, None)
    shape_px: Floats = np.full(3, _FIRST_SHAPE_PX)
    termination = 'iteration_limit'
    for k in range(_ROUNDS):
        whole = k > 0
        if not judged.kept.any():
            raise NotObservable('no image has three stars that fit')
        problem = _weighted_attitudes(problem, data, judged.attitudes)
        rates_rad_s = state.camera_from_star_tracker.apply(data.rates_rad_s)
        size = camera.width, camera.height
        layout = unknowns_of(problem, state, rates_rad_s, size, _assumed(data))
        inflation_px2 = judged.inflation_px2(table)
        measurements = arrange(table, judged.kept, judged.working_px2(table))
        predicted_px = table.measured_px - residual_px
        sums = star_sums(measurements, problem, state, layout, predicted_px)
        found = posterior(sums, problem, state, layout, shape_px, whole)
        after_step = moved(problem, state, layout, found.mean, found.of_images[:, :3])
        _check_not_mirrored(after_step)
        residual_px = _residuals_px(problem, after_step, table, layout, found, camera)
        freedom = _freedom(found, measurements, problem, state, layout, table, judged.kept)
        attitudes = _attitudes(data, problem, state, after_step, sums, layout, found)
        after = _judge(data, after_step, residual_px, freedom, judged, found, attitudes)
        shape_px = np.maximum(found.shape_sigma_px, _FIRST_SHAPE_PX)
        iterations += 1
        if whole and _step_sigma(layout, found) < _STEP_SIGMA and _agree(judged, after, table):
            termination = 'converged'
            break
        if k < _ROUNDS - 1:
            state, judged = after_step, after
    weights = Weights(
        judged.covariance_px2(table)[:, [0, 2]].mean(axis=1),
        inflation_px2,
        _from_sky(after_step, table, camera),
        predicted_px,
        judged.errors,
        _tracker_covariances(problem, data, attitudes),
    )
    found = with_shared_errors(found, sums, measurements, problem, state, layout, weights)
    return _result(
        data,
        ensemble,
        problem,
        state,
        after_step,
        layout,
        found,
        sums,
        measurements,
        weights,
        judged,
        attitudes,
        residual_px,
        freedom,
        iterations,
        termination,
    )


def _assumed(data: _Data) -> Assumptions:
    """Return the priors of velocity, read-out and stamps by the options and the observations."""
    options = data.options
    velocity_m_s = options.velocity_sigma_m_s
    if velocity_m_s < 0:
        stated = float(data.velocity_sigma_m_s.max())
        velocity_m_s = stated if math.isfinite(stated) else _SPACE_VELOCITY_M_S
    readout_s = {
        'global': (0.0, 0.0),
        'rolling': (options.readout_s, _READOUT_ERROR * abs(options.readout_s)),
        'unknown': (0.0, _UNKNOWN_READOUT_S),
    }
    return Assumptions(velocity_m_s, readout_s[options.shutter], options.stamp_sigma_s)


def _weighted_attitudes(problem: Problem, data: _Data, attitudes: _Attitudes | None) -> Problem:
    """Return the problem with the working sigmas of the star trackers."""
    m = data.table.image_count
    if data.options.method == 'single':
        return dataclasses.replace(problem, star_tracker_sigma_rad=np.full((m, 3), _EXACT_RAD))
    factor = np.ones(m)
    if attitudes is not None:
        for images, tracker in zip(attitudes.images, attitudes.trackers, strict=True):
            factor[images] = tracker.working
        factor[attitudes.misfit] = np.inf
    if data.options.method == 'per_image':
        factor *= _FREE_FACTOR
    return dataclasses.replace(problem, star_tracker_sigma_rad=factor[:, None] * data.stated_rad)


def _tracker_covariances(
    problem: Problem, data: _Data, attitudes: _Attitudes
) -> tuple[tuple[NDArray[np.int64], Floats, float], ...]:
    """Return the images of each star tracker with the covariance of their errors."""
    found = []
    for images, tracker in zip(attitudes.images, attitudes.trackers, strict=True):
        working = problem.star_tracker_sigma_rad[images[0], 0] / data.stated_rad[0]
        found.append((images, tracker.covariance / working**2, tracker.independent / working**2))
    return tuple(found)


def _step_sigma(layout: Layout, found: Posterior) -> float:
    """Return the largest step of a shared unknown of the state, in its sigma."""
    in_state = layout.of(['camera', 'focal', 'alignment', 'rate', 'mountings'])
    sigma = np.sqrt(np.diag(found.covariance)[in_state])
    free = sigma > 0
    return float(np.abs(found.mean[in_state][free] / sigma[free]).max(initial=0.0))


def _check_not_mirrored(state: State) -> None:
    focal_px = state.parameters[[0, 2]]
    if not (focal_px > 0).all():
        raise TooFewObservations(
            'the stars are those of a mirrored image: fx and fy would be '
            f'{focal_px.round(1).tolist()} px; flip the images along one axis, or set up the '
            'driver of the camera not to'
        )


def field_of(layout: Layout, found: Posterior, size: tuple[int, int]) -> DetectorField:
    """Return the field of a posterior on a detector (width, height)."""
    coefficients = found.mean[layout.places['field']].reshape(2, -1)
    return DetectorField(*size, FIELD_OCTAVES, coefficients, 'cosine')


def _residuals_px(
    problem: Problem,
    state: State,
    table: StarTable,
    layout: Layout | None,
    found: Posterior | None,
    camera: CameraModel,
) -> Floats:
    """Measured minus predicted pixels (n, 2) of all observations at a state."""
    own = image_parameters(problem, state)
    measured = table.measured_px
    rotations = state.camera_from_icrf.as_matrix()
    e = np.einsum('nij,nj->ni', rotations[table.image], table.direction_icrf)
    if layout is not None and found is not None:
        own = np.broadcast_to(own, (table.image_count, problem.camera_count)).copy()
        own[:, :3] += found.of_images[:, 3:] @ SHAPE_MODES.T
        size = camera.width, camera.height
        measured = measured - field_of(layout, found, size).displacement_px(measured)
        turned = np.zeros((3, len(table)))
        for entry in layout.shared:
            if entry.turn is not None:
                by = entry.turn(table.measured_px.T, e.T, table.image)
                turned += np.einsum('aqn,q->an', by, found.mean[layout.places[entry.name]])
        e = e - np.cross(turned.T, e)
    own_of_star = own if own.ndim == 1 else own[table.image].T
    return np.asarray(measured - project_parameters(problem.model, own_of_star, e))


def _freedom(
    found: Posterior,
    measurements: Measurements,
    problem: Problem,
    state: State,
    layout: Layout,
    table: StarTable,
    kept: Mask,
) -> Floats:
    """Degrees of freedom (n,) that the fit leaves each observation, of two."""
    leverage = np.zeros(len(table))
    E = chain(problem, layout, table.image_count)
    b = found.own.shape[1]
    of_image = E[:, :-1, -1 - b : -1]
    for chunk, Z in star_columns(measurements, problem, state, layout):
        m, _, n = chunk.direction_icrf.shape
        c = Z.shape[1] - 1
        columns = Z[:, :c].reshape(2, c, m, n).transpose(2, 0, 3, 1).reshape(m, 2 * n, c)
        K = columns @ of_image[chunk.image]
        each = ((K @ found.image_covariance[chunk.image]) * K).sum(axis=2).reshape(m, 2, n)
        real = chunk.whitener[0] > 0
        leverage[chunk.row[real]] = each.sum(axis=1).ravel()[real]
    used = max(int(np.count_nonzero(kept)), 1)
    if leverage.sum() + found.resolved >= 2 * used:
        raise NotObservable('fewer residuals than unknowns')
    return np.asarray(2.0 - leverage - found.resolved / used)


def _attitudes(
    data: _Data,
    problem: Problem,
    state: State,
    after: State,
    sums: StarSums,
    layout: Layout,
    found: Posterior,
) -> _Attitudes:
    """Return the errors of the star trackers as the stars alone show them."""
    m = data.table.image_count
    stated = data.stated_rad
    rotation, covariance, seen = _rotations_of_stars(sums, problem, layout, found)
    by_stars = Rotation.from_rotvec(-rotation) * state.camera_from_icrf
    error = attitude_errors(problem, after, by_stars)
    tracker_from_camera = np.swapaxes(image_alignment(problem, after).as_matrix(), -1, -2)
    covariance = tracker_from_camera @ covariance @ np.swapaxes(tracker_from_camera, -1, -2)
    error = np.where(seen[:, None], error, 0.0)
    variance = np.einsum('mii->mi', covariance) / stated**2
    if data.options.method == 'single':
        # Star trackers that are taken as exact have no misfits; their errors are as stated.
        images = tuple(
            np.flatnonzero(problem.star_tracker == k) for k in np.unique(problem.star_tracker)
        )
        working = _EXACT_RAD / stated[0]
        trackers = tuple(
            TrackerErrors(1.0, 0.0, np.eye(len(i)), working, 0.0, '', 1.0) for i in images
        )
        return _Attitudes(error, covariance, seen, np.zeros(m, bool), trackers, images)
    misfit = misfit_images(error / stated, variance, seen, problem.star_tracker, data.time_ns)
    found_images, found_trackers = [], []
    for k in np.unique(problem.star_tracker):
        here = np.flatnonzero((problem.star_tracker == k) & seen & ~misfit)
        if len(here) == 0:
            continue
        found_images.append(here)
        found_trackers.append(
            tracker_errors(
                error[here] / stated,
                variance[here],
                data.time_ns[here],
                after.camera_from_icrf[here],
                tracker_sigma_is_given(data.options),
                data.options.star_tracker_slow_arcsec * ARCSECOND_RAD / float(stated.mean()),
            )
        )
    return _Attitudes(error, covariance, seen, misfit, tuple(found_trackers), tuple(found_images))


def _rotations_of_stars(
    sums: StarSums, problem: Problem, layout: Layout, found: Posterior
) -> tuple[Floats, Floats, Mask]:
    """Rotations (m, 3) by the stars alone, their covariances (m, 3, 3), images with enough."""
    m = len(sums.blocks)
    E = chain(problem, layout, m)
    b = found.own.shape[1]
    blocks = E.transpose(0, 2, 1) @ sums.blocks @ E
    first = blocks.shape[1] - 1 - b
    rotation = slice(first, first + 3)
    C = blocks[:, rotation, rotation]
    others = np.concatenate(
        [np.tile(found.mean[seen_by_stars(layout)], (m, 1)), found.of_images[:, 3:]], axis=1
    )
    columns = np.r_[0:first, first + 3 : first + b]
    c = blocks[:, rotation, -1] - np.einsum('mij,mj->mi', blocks[:, rotation, columns], others)
    cross = (sums.field_cross @ E)[:, :, rotation]
    c = c - np.einsum('mti,t->mi', cross, found.mean[layout.places['field']])
    diagonal = np.einsum('mii->mi', C)
    seen: Mask = np.asarray((diagonal > 0).all(axis=1))
    scale = np.where(seen[:, None], 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    scaled = C * scale[:, :, None] * scale[:, None, :]
    scaled[~seen] = np.eye(3)
    seen &= np.linalg.eigvalsh(scaled)[:, 0] > 1e-9
    covariance = np.zeros_like(C)
    covariance[seen] = np.linalg.inv(scaled[seen])
    covariance *= scale[:, :, None] * scale[:, None, :]
    return np.einsum('mij,mj->mi', covariance, c), covariance, seen


def _from_sky(state: State, table: StarTable, camera: CameraModel) -> Floats:
    """
    Rotations (n, 2, 2) of displacements fixed to a star into pixel axes.

    The rotation part of the derivative of the pixel by the place of the star.
    """
    e = table.direction_icrf
    along = np.cross(e, [0.1, 0.2, 0.97])
    along /= np.linalg.norm(along, axis=1)[:, None]
    rotations = state.camera_from_icrf.as_matrix()[table.image]
    in_camera = np.einsum('nij,nj->ni', rotations, e)
    J = rotation_jacobian(
        dataclasses.replace(camera, parameters=state.parameters, field=None), in_camera
    )
    columns = [
        np.einsum('nab,nb->na', J, np.cross(np.einsum('nij,nj->ni', rotations, one), in_camera))
        for one in (along, np.cross(e, along))
    ]
    M = np.stack(columns, axis=2)
    # A mirrored pair of axes is the same for all stars: the sky's second axis is turned over.
    M[..., 1] *= np.sign(M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0])[:, None]
    angle = np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1])
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)


def _judge(
    data: _Data,
    state: State,
    residual_px: Floats,
    freedom: Floats,
    before: _Judged,
    found: Posterior | None,
    attitudes: _Attitudes | None = None,
) -> _Judged:
    """Return the weights that the residuals of a state ask for."""
    table, options = data.table, data.options
    finite = np.asarray(np.isfinite(residual_px).all(axis=1))
    residual_px = np.where(finite[:, None], residual_px, 1e6)
    variance = CentroidVariance(1.0, 0.0)
    if options.variance_components:
        variance = estimate_variance(
            residual_px, table.covariance_px2, table.magnitude, before.kept & finite, freedom
        )
    covariance_px2 = variance.of(table.covariance_px2, table.magnitude)
    errors: tuple[SharedError, ...] = ()
    kept = fitting_stars(
        residual_px,
        covariance_px2,
        place_variance_px2(before.errors),
        table,
        options.outlier_sigma,
    )
    if found is not None:
        errors = _errors_of(data, state, residual_px, covariance_px2, kept, found)
    return _Judged(variance, errors, kept, attitudes)


def _errors_of(
    data: _Data,
    state: State,
    residual_px: Floats,
    covariance_px2: Floats,
    kept: Mask,
    found: Posterior,
) -> tuple[SharedError, ...]:
    """Return the errors that observations share, from the residuals of those that are used."""
    table, camera = data.table, data.prior.camera
    from_sky = _from_sky(state, table, camera)
    errors = shared_errors(
        residual_px[kept],
        table.measured_px[kept],
        table.star[kept],
        from_sky[kept],
        0.5 * (covariance_px2[kept, 0] + covariance_px2[kept, 2]),
        camera.width,
        found.last_octave,
    )
    spread = []
    for error in errors:
        group = np.full(len(table), -1, np.int64)
        group[kept] = error.group
        spread.append(dataclasses.replace(error, group=group))
    return tuple(spread)


def _agree(one: _Judged, other: _Judged, table: StarTable) -> bool:
    """Return True if both lead to the same estimate."""
    if one.attitudes is None or other.attitudes is None:
        return False
    return (
        np.array_equal(one.kept, other.kept)
        and np.array_equal(one.attitudes.misfit, other.attitudes.misfit)
        # No estimate moves with 2 % of the variances, nor with more of the one of a bright star
        # that holds its image: that creeps on with a floor near zero, as the variance of places
        # does where hardly a star is seen twice.
        and _change(one.working_px2(table), other.working_px2(table)) < 0.02
        and math.isclose(
            pixel_variance_px2(one.errors),
            pixel_variance_px2(other.errors),
            rel_tol=0.1,
            abs_tol=1e-7,
        )
        and len(one.attitudes.trackers) == len(other.attitudes.trackers)
        and all(
            math.isclose(a.working, b.working, rel_tol=0.05)
            for a, b in zip(one.attitudes.trackers, other.attitudes.trackers, strict=True)
        )
    )


def _change(before: Floats, after: Floats) -> float:
    """Return the RMS of the relative change of variances uu, vv of covariances (n, 3)."""
    return float(np.sqrt(np.mean((after[:, ::2] / before[:, ::2] - 1.0) ** 2)))


def _result(
    data: _Data,
    ensemble: Ensemble,
    problem: Problem,
    state: State,
    after: State,
    layout: Layout,
    found: Posterior,
    sums: StarSums,
    measurements: Measurements,
    weights: Weights,
    judged: _Judged,
    attitudes: _Attitudes,
    residual_px: Floats,
    freedom: Floats,
    iterations: int,
    termination: str,
) -> Estimate:
    """Return the estimate of the last round."""
    table, options, prior = data.table, data.options, data.prior
    size = prior.camera.width, prior.camera.height
    kept = judged.kept
    camera = dataclasses.replace(prior.camera, field=field_of(layout, found, size)).replace(
        **{problem.parameter_names[i]: float(after.parameters[i]) for i in problem.free}
    )
    alignment = after.camera_from_star_tracker
    geometry = CameraGeometry(camera, canonical_xyzw(alignment.inv()))
    covariance = _considered(found, sums, problem, state, layout)
    basic = layout.of(['camera', 'alignment'])
    joint = layout.of(['camera', 'alignment', 'field'])
    shared = layout.of(['camera', 'focal', 'alignment', 'rate', 'mountings'])
    names = tuple(layout.labels[k] for k in shared)
    arrow = equations(
        sums, problem, state, layout, np.maximum(found.shape_sigma_px, _FIRST_SHAPE_PX)
    )
    asked = np.intersect1d(shared, found.estimated)
    chi2_given = squared_sigmas(residual_px[kept], table.covariance_px2[kept]).sum()
    trackers = attitudes.trackers
    noise = math.sqrt(np.mean([t.noise**2 for t in trackers])) if trackers else 1.0
    shown = attitudes.seen & ~attitudes.misfit
    scatter_rad = (
        float(np.sqrt(attitudes.error_rad[shown].var(axis=0).mean())) if shown.any() else 0.0
    )
    lost = np.bincount(table.image[kept], minlength=table.image_count) == 0
    star_trackers = star_tracker_names(ensemble)
    errors = AttitudeErrors(
        data.time_ns,
        attitudes.error_rad,
        np.einsum('mii->mi', attitudes.covariance_rad2),
        noise * data.stated_rad,
        attitudes.seen,
    )
    mountings = layout.of(['alignment', 'mountings'])
    return Estimate(
        geometry=geometry,
        covariance=covariance[np.ix_(basic, basic)],
        joint_covariance=covariance[np.ix_(joint, joint)],
        pixel_sigma_px=math.sqrt(pixel_variance_px2(judged.errors)),
        information=arrow.information[np.ix_(asked, asked)],
        information_names=tuple(layout.labels[k] for k in asked),
        shared_covariance=covariance[np.ix_(shared, shared)],
        shared_names=names,
        problem=problem,
        state=state,
        layout=layout,
        posterior=found,
        sums=sums,
        measurements=measurements,
        weights=weights,
        table=table,
        kept=kept,
        residual_px=residual_px,
        covariance_px2=judged.covariance_px2(table),
        variance=judged.variance,
        variance_factor=float(chi2_given / max(float(freedom[kept].sum()), 1e-9)),
        star_tracker_sigma_rad=noise * data.stated_rad,
        misfit_image=attitudes.misfit | lost,
        dropped_catalog_id=dropped_stars(table, kept),
        alignment_scatter_arcsec=scatter_rad / ARCSECOND_RAD,
        attitude_error_rad=attitudes.error_rad,
        attitude_covariance_rad2=attitudes.covariance_rad2,
        attitude_seen=attitudes.seen,
        iterations=iterations,
        termination=termination,
        thermal=_thermal(after, covariance[np.ix_(shared, shared)], options),
        shared_errors=judged.errors,
        tracker_errors=trackers,
        star_trackers=star_tracker_alignments(
            star_trackers, problem, after, covariance[np.ix_(mountings, mountings)], errors
        ),
    )


def _considered(
    found: Posterior, sums: StarSums, problem: Problem, state: State, layout: Layout
) -> Floats:
    """
    Covariance (P, P) with that of camera parameters that are held.

    A held parameter with a prior sigma is a consider parameter: it keeps its prior variance, whose
    effect on the estimated unknowns is added.  Without a prior sigma its variance is zero.
    """
    sigma = np.zeros(layout.count)
    sigma[layout.places['camera']] = np.where(
        np.isfinite(problem.prior_sigma), problem.prior_sigma, 0.0
    )
    held = np.setdiff1d(np.flatnonzero(sigma), found.estimated)
    if len(held) == 0:
        return found.covariance
    arrow = equations(
        sums, problem, state, layout, np.maximum(found.shape_sigma_px, _FIRST_SHAPE_PX)
    )
    by_held = np.zeros((layout.count, len(held)))
    by_held[held] = np.diag(sigma[held])
    by_held -= found.working @ arrow.information[:, held] * sigma[held]
    return np.asarray(found.covariance + by_held @ by_held.T)


def _thermal(state: State, full: Floats, options: CalibrationOptions) -> TemperatureTerms | None:
    """Terms of temperature of a state; None where none was asked for."""
    if not (options.focal_temperature_order or options.alignment_temperature):
        return None
    p = len(state.parameters)
    k = p + len(state.focal)
    sigma = np.sqrt(np.diag(full))
    return TemperatureTerms(
        reference_degc=options.reference_temperature_degc,
        focal_per_degc=tuple(state.focal.tolist()),
        focal_per_degc_sigma=tuple(sigma[p:k].tolist()),
        alignment_rate_rad_per_degc=tuple(state.rate.tolist()),
        alignment_rate_rad_per_degc_sigma=tuple(sigma[k + 3 : k + 3 + len(state.rate)].tolist()),
    )


def _robust_search(problem: Problem, start: State, measurements: Measurements) -> Minimum:
    """
    Search with the robust loss, every image nearly free of the star tracker.

    A star tracker that is better by its data sheet than it is would bend the camera to its
    attitudes, and then seem to be right; a wrong mounting would cost its images all their stars.
    """
    if problem.method == 'hierarchical':
        free = dataclasses.replace(
            problem,
            star_tracker_sigma_rad=_FREE_FACTOR * problem.star_tracker_sigma_rad,
            mounting_sigma_rad=_FREE_FACTOR * problem.mounting_sigma_rad,
        )
        try:
            return minimise(free, start, measurements, _ROBUST_SCALE, least_gain=_ROBUST_GAIN)
        except NotObservable:
            pass  # so few stars that they need the star tracker
    return minimise(problem, start, measurements, _ROBUST_SCALE, least_gain=_ROBUST_GAIN)
