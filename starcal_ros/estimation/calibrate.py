# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
From an ensemble of observed images to camera, alignment and covariance.

A robust search from the prior; then, in turns, the posterior of all unknowns at the state, a step
to its mean, and the variances of centroids and star trackers, the errors that observations share
and the outliers from the residuals, until nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.camera import project_parameters
from starcal_ros.camera.detector_field import DetectorField
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.amplitudes import LogPrior, STARTS_PX
from starcal_ros.estimation.centroid_variance import CentroidVariance
from starcal_ros.estimation.equations import Linearisation, star_sums, StarSums
from starcal_ros.estimation.image_rotations import sky_rotations, turned
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.limits import FREE_FACTOR, MOST_ROUNDS
from starcal_ros.estimation.options import (
    assumed_tracker_sigma_rad,
    CalibrationOptions,
    check_enough,
    check_options,
)
from starcal_ros.estimation.outliers import dropped_stars
from starcal_ros.estimation.posterior import (
    Posterior,
    posterior,
    still_to_move,
    Weighting,
    with_shared_errors,
)
from starcal_ros.estimation.problem import (
    canonical_xyzw,
    image_parameters,
    Problem,
    reference_degc,
    star_tracker_names,
    State,
    supported_terms,
)
from starcal_ros.estimation.refraction import Refraction, STATED_SITE_RAD, ZENITH_SIGMA_RAD
from starcal_ros.estimation.search import minimise, Minimum, moved_to_stars, problem_of, start_of
from starcal_ros.estimation.shared_errors import observation_groups, pixel_variance_px2
from starcal_ros.estimation.star_equations import (
    arrange,
    Measurements,
    squared_sigmas,
    star_table,
    StarTable,
)
from starcal_ros.estimation.tracker_errors import (
    AttitudeErrors,
    measured_rates,
    star_tracker_alignments,
)
from starcal_ros.estimation.unknowns import (
    Assumptions,
    EntryInputs,
    FIELD_OCTAVES,
    IMAGE_ROTATION,
    Layout,
    moved,
    readout_rms_s,
    unknowns_of,
)
from starcal_ros.estimation.weights import (
    Data,
    degrees_of_freedom,
    judge,
    tracker_attitudes,
    weighted_attitudes,
)
from starcal_ros.records import (
    CameraGeometry,
    Ensemble,
    MapCovariance,
    StarTrackerAlignment,
    TemperatureTerms,
)

_START_FLOOR_PX = 0.05  # good images leave about that much; the residuals replace it
_ROBUST_SCALE = 3.0  # Cauchy loss, sigma: normal noise loses 3 % of its information
_ROBUST_GAIN = 0.1  # steps of less than half a sigma are left to the posterior
_LEAST_SHARE = 0.25  # smaller steps would not arrive within `MOST_ROUNDS`
_SPACE_VELOCITY_M_S = 20000.0  # against the Earth, usual in orbits about the Earth and the Sun
_PLAUSIBLE_M_S = 8000.0  # orbits about the Earth are no faster
_UNKNOWN_READOUT_S = 0.02  # a rolling shutter takes 5 to 50 ms a frame
LENS_RESIDUAL_LOG_SIGMA = 1.5  # a data sheet states it on the ground; flight changes it
_READOUT_ERROR = 0.01  # a data sheet rounds the time, and clocks have a tolerance


@dataclass(frozen=True)
class Estimate:
    """
    A solved calibration, before products; m images, n observations of stars.

    Attributes
    ----------
    geometry : CameraGeometry
    considered : (P, P)
        Covariance of the shared unknowns, with that of camera parameters that are held.
    map_covariance : MapCovariance
        That of camera, alignment and field, on which lines of sight depend.
    linear : Linearisation
        The last one: the state is the one before the last step.
    sums : StarSums
    posterior : Posterior
    weights : Weighting
        Those with which the last round was made.
    table : StarTable
    kept : (n,) bool
        Observations used.
    residual_px : (n, 2)
        Residuals of all observations, with all unknowns at their means.
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
    attitudes : AttitudeErrors
    iterations, termination
    thermal : TemperatureTerms or None
        None where no change with temperature was asked for.
    star_trackers : tuple of StarTrackerAlignment
        Empty where there is one only.
    """

    geometry: CameraGeometry
    considered: Floats
    map_covariance: MapCovariance
    linear: Linearisation
    sums: StarSums
    posterior: Posterior
    weights: Weighting
    table: StarTable
    kept: Mask
    residual_px: Floats
    variance_factor: float
    star_tracker_sigma_rad: Floats
    misfit_image: Mask
    dropped_catalog_id: NDArray[np.int64]
    alignment_scatter_arcsec: float
    attitudes: AttitudeErrors
    iterations: int
    termination: str
    thermal: TemperatureTerms | None
    star_trackers: tuple[StarTrackerAlignment, ...]

    @property
    def covariance(self) -> Floats:
        """Covariance (p + 3, p + 3) of the p camera parameters and the alignment angles."""
        basic = self.linear.layout.of(['camera', 'alignment'])
        return self.considered[np.ix_(basic, basic)]


def estimate_calibration(
    ensemble: Ensemble,
    prior: CameraGeometry,
    options: CalibrationOptions,
    colours_of: Callable[[Indices], Floats] | None = None,
) -> Estimate:
    """
    Estimate of the camera parameters and the alignment from an ensemble.

    ``colours_of`` gives BP - RP (n,) of stars by their catalog numbers (n,); NaN: not known.

    Raises
    ------
    TooFewObservations
        When there are too few images or stars, they do not determine the unknowns, or
        the images are mirrored.
    OptionError
        For options that do not go together.
    """
    check_options(options, prior.camera.model)
    check_enough(ensemble, options)
    table = star_table(ensemble.images)
    problem = problem_of(ensemble, prior, options)
    order, with_rate, note = supported_terms(
        ensemble, options.focal_temperature_order, options.alignment_temperature
    )
    stated_rad = assumed_tracker_sigma_rad(options)
    data = Data(
        table,
        np.array([image.time_ns for image in ensemble.images], np.int64),
        stated_rad,
        prior,
        options,
        measured_rates(ensemble.images),
        dataclasses.replace(_assumed(ensemble, options), colour=_colours(table, colours_of)),
        observation_groups(table.measured_px, table.star, prior.camera.width),
    )
    try:
        start = start_of(problem, prior, order, with_rate)
        start = moved_to_stars(problem, start, table, prior.camera)
        result = _estimate(data, problem, start, ensemble)
    except (NotObservable, np.linalg.LinAlgError) as error:
        raise TooFewObservations(
            f'the stars do not determine {", ".join(options.estimate)} and the alignment: {error};'
            ' more images, stars over more of the detector or fewer parameters are needed'
        ) from error
    if result.thermal is None or not note:
        return result
    thermal = dataclasses.replace(result.thermal, note=f'left out: {note}')
    return dataclasses.replace(result, thermal=thermal)


def _estimate(data: Data, problem: Problem, start: State, ensemble: Ensemble) -> Estimate:
    """Return the estimate from a start."""
    table = data.table
    variance, every = CentroidVariance(1.0, _START_FLOOR_PX**2), np.ones(len(table), bool)
    covariance_px2 = variance.of(table.covariance_px2, table.magnitude)
    measurements = arrange(table, every, covariance_px2)
    solution = _robust_search(problem, start, measurements)
    state, iterations = solution.state, solution.iterations
    _check_not_mirrored(state)
    residual_px = residuals_px(problem, state, table)
    from_sky = sky_rotations(state, table, data.prior.camera)
    judged = Weighting(table, from_sky, variance, (), every, None)
    judged = judge(data, residual_px, np.full(len(table), 2.0), judged, None)
    before: _Round | None = None
    moved_by: Floats | None = None
    termination = 'iteration_limit'
    share = 1.0
    before_sigma: Floats = np.empty(0)
    for k in range(MOST_ROUNDS):
        last = _round(data, problem, state, judged, residual_px, before, share)
        iterations += 1
        if before:
            moved_by, left = still_to_move(last.posterior, before.posterior, moved_by)
            if left.max() <= 1.0:
                termination = 'converged'
                break
        after = judge(data, last.residual_px, last.freedom, judged, last.posterior, last.attitudes)
        residual_px, before = last.residual_px, last
        if k < MOST_ROUNDS - 1:
            state, judged = last.after, after
        # Steps of unknowns that stars hardly show oscillate: the ratio of successive steps damps
        # them.
        step_sigma = last.posterior.step_sigma
        if k:
            of_before = max(float(before_sigma @ before_sigma), 1e-300)
            rest = float(step_sigma @ before_sigma) / of_before
            share = min(max(share / max(1.0 - rest, share), _LEAST_SHARE), 1.0)
        before_sigma = step_sigma
    return _result(data, ensemble, last, judged, iterations, termination)


@dataclass(frozen=True)
class _Round:
    """A linearisation, its posterior, the state after its step, and the residuals there."""

    linear: Linearisation
    sums: StarSums
    posterior: Posterior
    after: State
    residual_px: Floats
    freedom: Floats
    attitudes: AttitudeErrors


def _round(
    data: Data,
    problem: Problem,
    state: State,
    judged: Weighting,
    residual_px: Floats,
    before: _Round | None,
    share: float,
) -> _Round:
    """Return a share of a step from a state of residuals (n, 2), with the weights judged."""
    table, camera = data.table, data.prior.camera
    problem = weighted_attitudes(problem, data, judged.attitudes, state)
    size = camera.width, camera.height
    near = before.posterior if before else None
    readout_s = math.hypot(*data.assumed.readout_s)
    if near:
        readout_s = readout_rms_s(near.layout, near.mean, near.working, data.assumed)
    rates = data.rates.turned(state.camera_from_star_tracker, readout_s)
    layout = unknowns_of(EntryInputs(problem, state, rates, size, data.assumed))
    measurements = arrange(table, judged.kept, judged.working_px2)
    linear = Linearisation(problem, state, layout, measurements, table.measured_px - residual_px)
    sums = star_sums(linear)
    shape_px = np.maximum(near.shapes.sigma_px, STARTS_PX[0]) if near else STARTS_PX[0]
    found = posterior(sums, linear, shape_px, near)
    # Unknowns outside the state, such as a velocity, take their mean; the images follow both.
    shared = found.mean.copy()
    shared[layout.in_state] *= share
    taken = dataclasses.replace(found, mean=shared)
    after = moved(problem, state, layout, shared, taken.of_images[:, IMAGE_ROTATION])
    left_px = residuals_px(problem, after, table, taken, size)
    freedom = degrees_of_freedom(found, linear, table, judged.kept)
    attitudes = tracker_attitudes(data, linear, sums, taken, after, judged.attitudes)
    return _Round(linear, sums, found, after, left_px, freedom, attitudes)


def _assumed(ensemble: Ensemble, options: CalibrationOptions) -> Assumptions:
    """Return the priors of what is stated by the options and the observations."""
    velocity_m_s, plausible_m_s = options.velocity_sigma_m_s, math.inf
    if velocity_m_s < 0:
        velocity_m_s = float(np.max([image.velocity_sigma_m_s for image in ensemble.images]))
        if not math.isfinite(velocity_m_s):
            velocity_m_s, plausible_m_s = _SPACE_VELOCITY_M_S, _PLAUSIBLE_M_S
    readout_s = {
        'global': (0.0, 0.0),
        'rolling': (options.readout_s, _READOUT_ERROR * abs(options.readout_s)),
        'unknown': (0.0, _UNKNOWN_READOUT_S),
    }
    readout = readout_s[options.shutter]
    lens, refraction = LogPrior(), None
    if options.lens_residual_px:
        lens = LogPrior(math.log(options.lens_residual_px), LENS_RESIDUAL_LOG_SIGMA)
    zenith = np.array([image.zenith_icrf for image in ensemble.images])
    is_known = np.isfinite(zenith).all(axis=1)
    if is_known.any():  # where none is stated, as in older recordings, the air turns no star
        zenith = np.where(is_known[:, None], zenith, 0.0)
        size, sigma = np.array([image.refraction_arcsec for image in ensemble.images]).max(axis=0)
        stamps = np.array([image.time_ns for image in ensemble.images], np.int64)
        # The velocity of a stated site is exact; a zenith by the stars comes with no date.
        is_stated = all(image.velocity_sigma_m_s == 0 for image in ensemble.images)
        site_rad = STATED_SITE_RAD if is_stated else ZENITH_SIGMA_RAD
        refraction = Refraction(stamps, zenith, float(size), float(sigma), site_rad)
    stamp_s = options.stamp_sigma_s
    return Assumptions(velocity_m_s, readout, stamp_s, refraction, lens, plausible_m_s)


def _colours(table: StarTable, colours_of: Callable[[Indices], Floats] | None) -> Floats | None:
    """Return colours (n,) from their mean, which stars of unknown colour have; None if all are."""
    colour = colours_of(table.catalog_id) if colours_of else np.full(len(table), np.nan)
    known = np.isfinite(colour)
    weight = known / (table.covariance_px2[:, 0] + table.covariance_px2[:, 2])
    colour = np.where(known, colour, 0.0)
    return known * (colour - np.average(colour, weights=weight)) if known.any() else None


def _check_not_mirrored(state: State) -> None:
    focal_px = state.parameters[[0, 2]]
    if not (focal_px > 0).all():
        raise TooFewObservations(
            'the stars are those of a mirrored image: fx and fy would be '
            f'{focal_px.round(1).tolist()} px; flip the images along one axis, or set up the '
            'driver of the camera not to'
        )


def _field_of(found: Posterior, size: tuple[int, int]) -> DetectorField:
    """Return the field of a posterior on a detector (width, height)."""
    coefficients = found.mean[found.layout.field_at].reshape(2, -1)
    return DetectorField(*size, FIELD_OCTAVES, coefficients)


def residuals_px(
    problem: Problem,
    state: State,
    table: StarTable,
    found: Posterior | None = None,
    size: tuple[int, int] = (0, 0),
) -> Floats:
    """
    Measured minus predicted pixels (n, 2) of all observations at a state.

    Unknowns outside the state take their mean in a posterior, where there is one: ``size`` (width,
    height) is that of the detector.
    """
    own = image_parameters(problem, state)
    measured = table.measured_px
    rotations = state.camera_from_icrf.as_matrix()
    e = turned(rotations, table.image, table.direction_icrf)
    if found is not None:
        layout = found.layout
        own = np.broadcast_to(own, (table.image_count, problem.camera_count)).copy()
        measured = measured - _field_of(found, size).displacement_px(measured)
        turn = np.zeros((3, len(table)))
        for entry in layout.entries:
            at = layout.places[entry.name]
            if entry.camera is not None and not entry.kind.in_state:
                values = found.of_images[:, at] if entry.of_image else found.mean[None, at]
                own += (entry.camera @ values[:, :, None])[:, :, 0]
            if entry.turn is not None:
                by = entry.turns(table.measured_px.T, e.T, table.image, np.arange(len(table)))
                if entry.of_image:
                    turn += (by * found.of_images[table.image, at].T).sum(axis=1)
                else:
                    turn += np.einsum('aqn,q->an', by, found.mean[at])
        e = e - np.cross(turn, e.T, axis=0).T
    own_of_star = own if own.ndim == 1 else np.take(own.T, table.image, axis=1)
    return np.asarray(measured - project_parameters(problem.model, own_of_star, e))


def _result(
    data: Data,
    ensemble: Ensemble,
    last: _Round,
    weights: Weighting,
    iterations: int,
    termination: str,
) -> Estimate:
    """Return the estimate of the last round, which was made with the weights."""
    table, options, prior = data.table, data.options, data.prior
    size = prior.camera.width, prior.camera.height
    linear, after, attitudes, kept = last.linear, last.after, last.attitudes, weights.kept
    problem, layout, residual_px = linear.problem, linear.layout, last.residual_px
    found = with_shared_errors(last.posterior, last.sums, linear, weights, attitudes.trackers)
    free = {problem.parameter_names[i]: float(after.parameters[i]) for i in problem.free}
    try:
        camera = dataclasses.replace(prior.camera, field=_field_of(found, size)).replace(**free)
    except ValueError as error:  # stars near the boresight alone allow a mirrored camera too
        raise NotObservable(f'the {prior.camera.model} fit ends at {error}') from error
    alignment = after.camera_from_star_tracker
    geometry = CameraGeometry(camera, canonical_xyzw(alignment.inv()))
    covariance = _considered(found, problem)
    joint = layout.line_of_sight_at
    chi2_given = squared_sigmas(residual_px[kept], table.covariance_px2[kept]).sum()
    trackers = attitudes.trackers
    noise = np.ones(3)
    for axis in range(3 if trackers else 0):
        noise[axis] = math.sqrt(np.mean([t.noise**2 for t in trackers if axis in t.axes]))
    shown = attitudes.seen & ~attitudes.misfit
    scatter_rad = (
        float(np.sqrt(attitudes.error_rad[shown].var(axis=0).mean())) if shown.any() else 0.0
    )
    lost = np.bincount(table.image[kept], minlength=table.image_count) == 0
    mountings = layout.of(['alignment', 'mountings'])
    return Estimate(
        geometry=geometry,
        considered=covariance,
        map_covariance=MapCovariance(
            covariance[np.ix_(joint, joint)], math.sqrt(pixel_variance_px2(weights.errors))
        ),
        linear=linear,
        sums=last.sums,
        posterior=found,
        weights=weights,
        table=table,
        kept=kept,
        residual_px=residual_px,
        variance_factor=float(chi2_given / max(float(last.freedom[kept].sum()), 1e-9)),
        star_tracker_sigma_rad=noise * data.stated_rad,
        misfit_image=attitudes.misfit | lost,
        dropped_catalog_id=dropped_stars(table, kept),
        alignment_scatter_arcsec=scatter_rad / ARCSECOND_RAD,
        attitudes=attitudes,
        iterations=iterations,
        termination=termination,
        thermal=_thermal(after, layout, covariance, ensemble, options),
        star_trackers=star_tracker_alignments(
            star_tracker_names(ensemble),
            problem,
            after,
            covariance[np.ix_(mountings, mountings)],
            attitudes,
            data.time_ns,
            noise * data.stated_rad,
        ),
    )


def _considered(found: Posterior, problem: Problem) -> Floats:
    """
    Covariance (P, P) with that of camera parameters that are held.

    A held parameter with a prior sigma is a consider parameter: it keeps its prior variance, whose
    effect on the estimated unknowns is added.  Without a prior sigma its variance is zero.
    """
    sigma = np.zeros(found.layout.count)
    sigma[found.layout.places['camera']] = np.where(
        np.isfinite(problem.prior_sigma), problem.prior_sigma, 0.0
    )
    held = np.setdiff1d(np.flatnonzero(sigma), found.estimated)
    follow = found.working @ found.equations.information[:, held]
    by_held = (np.eye(len(sigma))[:, held] - follow) * sigma[held]
    return np.asarray(found.covariance + by_held @ by_held.T)


def _thermal(
    state: State,
    layout: Layout,
    covariance: Floats,
    ensemble: Ensemble,
    options: CalibrationOptions,
) -> TemperatureTerms | None:
    """Terms of temperature of a state; None where none was asked for."""
    if not (options.focal_temperature_order or options.alignment_temperature):
        return None
    sigma = np.sqrt(np.diag(covariance))
    return TemperatureTerms(
        reference_degc=reference_degc(ensemble),
        focal_per_degc=tuple(state.focal.tolist()),
        focal_per_degc_sigma=tuple(sigma[layout.of(['focal'])].tolist()),
        alignment_rate_rad_per_degc=tuple(state.rate.tolist()),
        alignment_rate_rad_per_degc_sigma=tuple(sigma[layout.of(['rate'])].tolist()),
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
            star_tracker_sigma_rad=FREE_FACTOR * problem.star_tracker_sigma_rad,
            mounting_sigma_rad=FREE_FACTOR * problem.mounting_sigma_rad,
        )
        try:
            return minimise(free, start, measurements, _ROBUST_SCALE, least_gain=_ROBUST_GAIN)
        except NotObservable:
            pass  # so few stars that they need the star tracker
    return minimise(problem, start, measurements, _ROBUST_SCALE, least_gain=_ROBUST_GAIN)
