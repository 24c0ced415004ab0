"""
From an ensemble of observed images to camera, alignment and covariance.

A robust search from the prior, then least squares on the stars that fit, with the variances of
centroids and star tracker estimated again and the misfits left out, until nothing changes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.covariance import shared_covariance, shared_names
from starcal_ros.estimation.levenberg_marquardt import NotObservable, Solution
from starcal_ros.estimation.normal_equations import (
    arrange,
    Measurements,
    residuals_px,
    squared_sigmas,
    star_table,
    StarTable,
)
from starcal_ros.estimation.problem import (
    attitude_errors,
    attitudes_of_stars_alone,
    image_blocks,
    image_parameters,
    METHODS,
    minimise,
    Problem,
    reduced_information,
    State,
)
from starcal_ros.estimation.temperature import weakest_term, why_unsupported
from starcal_ros.estimation.variance_components import (
    CentroidVariance,
    estimate_star_tracker_sigma,
    estimate_variance,
)
from starcal_ros.options import option
from starcal_ros.records import CameraGeometry, Ensemble, Thermal

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROBUST_SCALE = 3.0  # of the Cauchy loss, in sigma: of normal noise 5 % of the weight is lost
_START_FLOOR_PX = 0.05  # until the residuals tell: of the order of what is left in good images
_ROUNDS = 10  # the set of rejected stars settles in two or three
FEWEST_STARS = 3  # of an image: its rotation fits any one star, and two as good as any
_FEWEST_SIGHTINGS = 3  # of a star, from which it can be told from its images
_STAR_CHANCE = 1e-7  # that a good star is dropped for the sum of its residuals


@dataclass(frozen=True)
class CalibrationOptions:
    """What is estimated, and how."""

    method: str = option(
        'hierarchical', 'how the attitudes of the images are treated', choices=METHODS
    )
    estimate: tuple[str, ...] = option(
        ('fx', 'skew', 'fy', 'k1', 'k2', 'k3', 'p1', 'p2'),
        'camera parameters that are estimated; the others are held at the prior',
        choices=PARAMETER_NAMES,
    )
    star_tracker_sigma_arcsec: tuple[float, ...] = option(
        (10.0, 10.0, 10.0),
        '1-sigma of the star tracker attitude about its x, y, z axes, arcsec',
        low=1e-3,
        high=3600.0,
        length=3,
    )
    min_images: int = option(
        3, 'fewest images from which a calibration is made', low=1, high=100000
    )
    min_stars: int = option(
        60, 'fewest star observations from which a calibration is made', low=10, high=1000000
    )
    max_images: int = option(
        400, 'most images kept; beyond it those that add least information go', low=3, high=100000
    )
    outlier_sigma: float = option(
        4.5,
        'length of a residual, in its sigma, from which a star is left out',
        low=3.0,
        high=20.0,
    )
    prior_sigma: tuple[float, ...] = option(
        (0.0,) * 10,
        '1-sigma of the prior of fx, skew, fy, cx, cy (px), k1, k2, k3, p1, p2; 0: of one that is'
        ' estimated, nothing is known; of one that is held, it is taken as exact',
        low=0.0,
        length=10,
    )
    variance_components: bool = option(
        True, 'estimate the sigmas of centroids and star tracker again from the residuals'
    )
    focal_temperature_order: int = option(
        0, 'degree of the polynomial of focal length in temperature; 0: none', low=0, high=2
    )
    alignment_temperature: bool = option(
        False, 'alignment linear in temperature; not with the method per_image'
    )
    reference_temperature_degc: float = option(
        20.0,
        'temperature at which camera and alignment are reported where they change with it, degC',
        low=-273.15,
        high=1000.0,
    )


@dataclass(frozen=True)
class Estimate:
    """
    A solved calibration, before products; m images, n stars.

    Attributes
    ----------
    geometry : CameraGeometry
    covariance : (13, 13)
    information : (k, k)
        On the estimated camera parameters and focal terms, then the alignment where the method
        has one, and its rate; the rotations of the images eliminated.
    information_names : tuple of k str
    shared_covariance : (s, s)
        Of the ten camera parameters, focal terms, alignment and its rate.
    shared_names : tuple of s str
    problem : Problem
        The one whose minimum the state is.
    state : State
    table : StarTable
    kept : (n,) bool
        Stars used.
    residual_px : (n, 2)
        Of all stars.
    variance : CentroidVariance
        How the centroid covariances were corrected.
    variance_factor : float
        chi^2 per degree of freedom of the centroid covariances as given.
    star_tracker_sigma_rad : (3,)
        As given, or as estimated again.
    misfit_image : (m,) bool
        Images whose attitude does not fit, or that lost their stars.
    dropped_catalog_id : (d,) int64
        Stars that misfit across images and were left out of all.
    alignment_scatter_arcsec : float
        RMS per axis of the alignments that the images show, about their mean.
    attitude_error_rad, attitude_covariance_rad2, attitude_seen : (m, 3), (m, 3, 3), (m,) bool
        Star tracker errors by the stars alone, of `attitudes_of_stars_alone`.
    iterations, termination
    thermal : Thermal or None
        None where no change with temperature was asked for.
    """

    geometry: CameraGeometry
    covariance: Floats
    information: Floats
    information_names: tuple[str, ...]
    shared_covariance: Floats
    shared_names: tuple[str, ...]
    problem: Problem
    state: State
    table: StarTable
    kept: Mask
    residual_px: Floats
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
    thermal: Thermal | None


def check_options(options: CalibrationOptions) -> None:
    """
    Raise `OptionError` for options that do not go together.

    Raises
    ------
    OptionError
        Naming the option.
    """
    if options.alignment_temperature and options.method == 'per_image':
        # Its mean of the images' alignments has no place for a slope: `hierarchical` with a loose
        # star tracker is the same estimate with one.
        raise OptionError('alignment_temperature: the method per_image has no common alignment')


def check_enough(ensemble: Ensemble, options: CalibrationOptions) -> None:
    """
    Raise `TooFewObservations` that says how many images or stars are missing.

    Raises
    ------
    TooFewObservations
        A sentence for a person.
    """
    images, stars = len(ensemble.images), ensemble.star_count
    missing = []
    if images < options.min_images:
        missing.append(
            f'{options.min_images - images} more images are needed '
            f'({images} of {options.min_images} collected)'
        )
    if stars < options.min_stars:
        missing.append(
            f'{options.min_stars - stars} more stars are needed '
            f'({stars} of {options.min_stars} collected)'
        )
    if missing:
        refused = sum(ensemble.refused.values())
        also = f'; {refused} images were refused' if refused else ''
        raise TooFewObservations('too few observations: ' + ' and '.join(missing) + also)


def estimate_calibration(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> Estimate:
    """
    Estimate of the camera parameters and the alignment from an ensemble.

    Terms of temperature that the images do not carry, or that are no more than chance, are left
    out one by one; the note of ``thermal`` says which.

    Raises
    ------
    TooFewObservations
        When there are too few images or stars, or they do not determine what is to be estimated.
    OptionError
        For options that do not go together.
    """
    check_options(options)
    check_enough(ensemble, options)
    table = star_table(ensemble.images)
    problem = problem_of(ensemble, prior, options)
    order, with_rate = options.focal_temperature_order, options.alignment_temperature
    left_out = []
    unsupported = (order or with_rate) and why_unsupported(
        np.array([image.temperature_degc for image in ensemble.images]), order
    )
    if unsupported:
        order, with_rate = 0, False
        left_out.append(unsupported)
    while True:
        start = start_of(problem, prior, order, with_rate)
        try:
            estimate, weakest = _search(problem, start, table, prior, options)
            why = 'within chance'
        except (NotObservable, np.linalg.LinAlgError) as error:
            if not (order or with_rate):
                names = ', '.join(options.estimate)
                raise TooFewObservations(
                    f'the stars do not determine all of {names} and the alignment: {error}; '
                    'more images, or stars over more of the detector, or fewer parameters are '
                    'needed'
                ) from error
            weakest, why = 'focal' if order else 'rate', 'not determined by the images'
        if weakest == 'focal':
            left_out.append(f'focal term of degree {order} is {why}')
            order -= 1
        elif weakest == 'rate':
            left_out.append(f'alignment rate is {why}')
            with_rate = False
        else:
            break
    if estimate.thermal is None or not left_out:
        return estimate
    note = 'left out: ' + ', '.join(left_out)
    return dataclasses.replace(estimate, thermal=dataclasses.replace(estimate.thermal, note=note))


def problem_of(ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions) -> Problem:
    """What a search is given of an ensemble."""
    prior_sigma = np.array(options.prior_sigma)
    return Problem(
        method=options.method,
        free=np.sort(np.array([PARAMETER_NAMES.index(n) for n in options.estimate], np.int64)),
        prior_parameters=prior.camera.parameters,
        prior_sigma=np.where(prior_sigma > 0, prior_sigma, np.inf),
        star_tracker_from_icrf=Rotation.from_quat(
            np.array([image.icrf_from_star_tracker_xyzw for image in ensemble.images])
        ).inv(),
        star_tracker_sigma_rad=np.tile(
            np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD, (len(ensemble.images), 1)
        ),
        above_reference_k=np.array([image.temperature_degc for image in ensemble.images])
        - options.reference_temperature_degc,
    )


def start_of(problem: Problem, prior: CameraGeometry, order: int, with_rate: bool) -> State:
    """The prior as a state, with so many focal terms of zero and a rate of zero, or none."""
    alignment = Rotation.from_quat(prior.star_tracker_from_camera_xyzw).inv()
    return State(
        prior.camera.parameters.copy(),
        alignment,
        alignment * problem.star_tracker_from_icrf,
        np.zeros(order),
        np.zeros(3 if with_rate else 0),
    )


@dataclass(frozen=True)
class _Verdict:
    """What the residuals say: the variances, and what is left out."""

    variance: CentroidVariance
    tracker_sigma_rad: Floats  # (3,)
    misfit: Mask  # (m,)
    kept: Mask  # (n,)

    def agrees_with(self, other: _Verdict) -> bool:
        """Whether a search with the one would end where a search with the other does."""
        return (
            np.array_equal(self.kept, other.kept)
            and np.array_equal(self.misfit, other.misfit)
            and self.variance.is_close_to(other.variance)
            and np.allclose(self.tracker_sigma_rad, other.tracker_sigma_rad, rtol=0.02)
        )


def _search(
    problem: Problem,
    start: State,
    table: StarTable,
    prior: CameraGeometry,
    options: CalibrationOptions,
) -> tuple[Estimate, str]:
    """
    Robust search, then least squares with snooping; see the head of the module.

    With the term of temperature to leave out, if any.
    """
    everything = np.ones(len(table), bool)
    given_rad = problem.star_tracker_sigma_rad[0]
    verdict = _Verdict(
        CentroidVariance(1.0, _START_FLOOR_PX**2),
        given_rad,
        np.zeros(table.image_count, bool),
        everything,
    )
    measurements = _arranged(table, verdict)
    solution = _robust_search(problem, start, measurements)
    iterations = solution.iterations
    _, blocks = image_blocks(problem, solution.state, measurements)
    del measurements  # before the next: they are as large as the table
    after, measurements = _judge(
        problem, solution.state, blocks, table, verdict, given_rad, options
    )
    for _ in range(_ROUNDS):
        verdict = after
        problem = dataclasses.replace(
            problem,
            star_tracker_sigma_rad=np.where(
                verdict.misfit[:, None], np.inf, verdict.tracker_sigma_rad
            ),
        )
        del blocks
        solution = minimise(problem, solution.state, measurements)
        iterations += solution.iterations
        _, blocks = image_blocks(problem, solution.state, measurements)
        del measurements
        after, measurements = _judge(
            problem, solution.state, blocks, table, verdict, given_rad, options
        )
        if after.agrees_with(verdict):
            break
    del measurements
    return _estimate(problem, solution, blocks, table, verdict, prior, options, iterations)


def _arranged(table: StarTable, verdict: _Verdict) -> Measurements:
    return arrange(table, verdict.kept, verdict.variance.of(table.covariance_px2, table.magnitude))


def _estimate(
    problem: Problem,
    solution: Solution[State],
    blocks: Floats,
    table: StarTable,
    verdict: _Verdict,
    prior: CameraGeometry,
    options: CalibrationOptions,
    iterations: int,
) -> tuple[Estimate, str]:
    """What a search has found, and the term of temperature to leave out, if any."""
    state = solution.state
    residual_px = _residuals(problem, state, table)
    kept = verdict.kept
    freedom = _freedom(problem, state, blocks, kept, verdict.tracker_sigma_rad)
    chi2_given = squared_sigmas(residual_px[kept], table.covariance_px2[kept]).sum()
    lost = np.bincount(table.image[kept], minlength=table.image_count) == 0
    geometry, full, scatter_arcsec = _result(
        problem, state, blocks, prior, verdict.tracker_sigma_rad
    )
    alignment = Rotation.from_quat(geometry.star_tracker_from_camera_xyzw).inv()
    attitude_error_rad, attitude_covariance_rad2, attitude_seen = attitudes_of_stars_alone(
        problem, dataclasses.replace(state, camera_from_star_tracker=alignment), blocks
    )
    information = reduced_information(problem, state, blocks)
    shared = np.concatenate([problem.free, np.arange(10, len(information))])
    k = 10 + len(state.focal)
    at_reference = np.r_[0:10, k : k + 3]
    thermal = _thermal(state, full, options)
    weakest = weakest_term(thermal, full[k + 3 :, k + 3 :]) if thermal else ''
    names = shared_names(len(state.focal), len(state.rate) > 0)
    estimate = Estimate(
        geometry=geometry,
        covariance=full[np.ix_(at_reference, at_reference)],
        information=information[np.ix_(shared, shared)],
        information_names=tuple(names[i] for i in shared),
        shared_covariance=full,
        shared_names=names,
        problem=problem,
        state=state,
        table=table,
        kept=kept,
        residual_px=residual_px,
        variance=verdict.variance,
        variance_factor=float(chi2_given / (2 * np.count_nonzero(kept) * freedom)),
        star_tracker_sigma_rad=verdict.tracker_sigma_rad,
        misfit_image=verdict.misfit | lost,
        dropped_catalog_id=_dropped(table, kept),
        alignment_scatter_arcsec=scatter_arcsec,
        attitude_error_rad=attitude_error_rad,
        attitude_covariance_rad2=attitude_covariance_rad2,
        attitude_seen=attitude_seen,
        iterations=iterations,
        termination=solution.termination,
        thermal=thermal,
    )
    return estimate, weakest


def _thermal(state: State, full: Floats, options: CalibrationOptions) -> Thermal | None:
    """Terms of temperature of a state; None where none was asked for."""
    if not (options.focal_temperature_order or options.alignment_temperature):
        return None
    k = 10 + len(state.focal)
    sigma = np.sqrt(np.diag(full))
    return Thermal(
        reference_degc=options.reference_temperature_degc,
        focal_per_degc=tuple(state.focal.tolist()),
        focal_sigma=tuple(sigma[10:k].tolist()),
        alignment_rate_rad_per_degc=tuple(state.rate.tolist()),
        alignment_rate_sigma=tuple(sigma[k + 3 :].tolist()),
    )


def _robust_search(problem: Problem, start: State, measurements: Measurements) -> Solution[State]:
    """
    Search with the robust loss, every image free of the star tracker.

    A star tracker that is said to be better than it is would bend the camera to its attitudes, and
    then seem to be right.
    """
    if problem.method == 'hierarchical':
        try:
            free = dataclasses.replace(problem, method='per_image')
            solution = minimise(free, start, measurements, _ROBUST_SCALE)
            return dataclasses.replace(solution, state=_with_slope(problem, solution.state))
        except NotObservable:
            pass  # so few stars that they need the star tracker
    return minimise(problem, start, measurements, _ROBUST_SCALE)


def _with_slope(problem: Problem, state: State) -> State:
    """
    The state with an alignment rate that its rotations show, where one is estimated.

    Median of the slopes between images: left in, a drift would look like scatter or misfits.
    """
    if len(state.rate) == 0:
        return state
    eta_rad = attitude_errors(problem, state, state.camera_from_icrf)
    # The frame turns by what is missing from the star tracker's side.
    turned = state.camera_from_star_tracker.apply(eta_rad)
    one, other = np.triu_indices(len(turned), 1)
    apart_k = problem.above_reference_k[other] - problem.above_reference_k[one]
    differ = apart_k != 0
    slopes = (turned[other] - turned[one])[differ] / apart_k[differ, None]
    return dataclasses.replace(state, rate=state.rate + np.median(slopes, axis=0))


def _judge(
    problem: Problem,
    state: State,
    blocks: Floats,
    table: StarTable,
    before: _Verdict,
    given_rad: Floats,
    options: CalibrationOptions,
) -> tuple[_Verdict, Measurements]:
    """
    Variances and misfits from the residuals at a state that the verdict before has led to.

    With the measurements as the verdict has them, which a search with it needs.
    """
    residual_px = _residuals(problem, state, table)
    variance, tracker_sigma_rad = CentroidVariance(1.0, 0.0), given_rad
    if options.variance_components:
        freedom = _freedom(problem, state, blocks, before.kept, before.tracker_sigma_rad)
        variance = estimate_variance(
            residual_px, table.covariance_px2, table.magnitude, before.kept, freedom
        )
    kept = _fitting(residual_px, table, variance, options)
    del residual_px
    misfit: Mask = np.zeros(table.image_count, bool)
    measurements = arrange(table, kept, variance.of(table.covariance_px2, table.magnitude))
    # One rotation for all has no attitude of an image to judge.
    if problem.method != 'single':
        # By the stars that fit: one that does not turns an image of few by more than the tracker.
        _, blocks = image_blocks(problem, state, measurements)
        eta_rad, covariance_rad2, seen = attitudes_of_stars_alone(problem, state, blocks)
        fitted = 2 if len(state.rate) else 1  # mean of the attitudes, and slope
        found_rad, misfit = estimate_star_tracker_sigma(
            eta_rad, covariance_rad2, seen, given_rad, fitted
        )
        if options.variance_components:
            tracker_sigma_rad = found_rad
    return _Verdict(variance, tracker_sigma_rad, misfit, kept), measurements


def _fitting(
    residual_px: Floats, table: StarTable, variance: CentroidVariance, options: CalibrationOptions
) -> Mask:
    """
    Return (n,) which stars are used.

    Not an outlier; not a star that is one in most of its images, or whose residuals together are
    too large (a wrong catalog place, a planet); and in an image that has enough of the others.
    """
    length2 = squared_sigmas(residual_px, variance.of(table.covariance_px2, table.magnitude))
    fits = length2 < options.outlier_sigma**2
    star = table.star
    sightings = np.bincount(star)
    misses = np.bincount(star, ~fits)
    summed = np.bincount(star, np.where(fits, length2, 0.0))
    bad_star = (2 * misses > sightings) | (summed > chdtri(2 * sightings, _STAR_CHANCE))
    fits &= ~(bad_star & (sightings >= _FEWEST_SIGHTINGS))[star]
    left = np.bincount(table.image[fits], minlength=table.image_count)
    return np.asarray(fits & (left[table.image] >= FEWEST_STARS))


def _dropped(table: StarTable, kept: Mask) -> NDArray[np.int64]:
    """Catalog stars that were seen often enough to be told apart, and left out of all images."""
    catalog_id, star = np.unique(table.catalog_id, return_inverse=True)
    sightings, uses = np.bincount(star), np.bincount(star, kept)
    return np.asarray(catalog_id[(sightings >= _FEWEST_SIGHTINGS) & (uses == 0)])


def _residuals(problem: Problem, state: State, table: StarTable) -> Floats:
    return residuals_px(
        table, image_parameters(problem, state), state.camera_from_icrf.as_matrix()
    )


def _freedom(
    problem: Problem, state: State, blocks: Floats, kept: Mask, tracker_sigma_rad: Floats
) -> float:
    """
    Share of the residuals' degrees of freedom that the fit leaves.

    An attitude that the star tracker holds costs less than three: with P the covariance from the
    stars and T the star tracker's, trace(T (T + P)^-1).
    """
    unknowns = float(len(problem.free) + len(state.focal) + len(state.rate))
    if problem.method == 'single':
        unknowns += 3
    else:
        _, P, seen = attitudes_of_stars_alone(problem, state, blocks)
        if problem.method == 'per_image':
            unknowns += 3 * int(np.count_nonzero(seen))
        else:
            T = np.diag(tracker_sigma_rad**2)
            unknowns += float(np.trace(np.linalg.solve(T + P[seen], T), axis1=1, axis2=2).sum())
    share = 1.0 - unknowns / (2 * max(int(np.count_nonzero(kept)), 1))
    if share <= 0:
        raise NotObservable('fewer residuals than unknowns')
    return share


def _result(
    problem: Problem,
    state: State,
    blocks: Floats,
    prior: CameraGeometry,
    tracker_sigma_rad: Floats,
) -> tuple[CameraGeometry, Floats, float]:
    """
    Geometry, covariance of all that is shared, and the scatter of the images' alignments, arcsec.

    The covariance is of camera, focal terms, alignment and its rate.
    """
    scatter_arcsec, good = 0.0, np.zeros(len(blocks), bool)
    if problem.method != 'single':
        eta_rad, _, seen = attitudes_of_stars_alone(problem, state, blocks)
        good = seen & np.isfinite(problem.star_tracker_sigma_rad[:, 0])
        if good.any():
            scatter_arcsec = float(np.sqrt(eta_rad[good].var(axis=0).mean())) / ARCSECOND_RAD
    alignment, full = shared_covariance(problem, state, blocks, good, tracker_sigma_rad)
    focal_px = state.parameters[[0, 2]]
    if not (focal_px > 0).all():
        raise NotObservable(f'fx, fy of {focal_px.round(1).tolist()} px are of a mirrored image')
    camera = prior.camera.replace(
        **{PARAMETER_NAMES[i]: float(state.parameters[i]) for i in problem.free}
    )
    quaternion = alignment.inv().as_quat()
    # One of the two quaternions of a rotation, so that equal calibrations are equal numbers.
    quaternion = quaternion * math.copysign(1.0, quaternion[3])
    return CameraGeometry(camera, quaternion), full, scatter_arcsec
