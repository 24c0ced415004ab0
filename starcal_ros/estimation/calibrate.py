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

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import ALL_PARAMETER_NAMES, CameraModel, parameter_names
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.detector_field import in_degree
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.attitude_correlation import attitude_correlation, AttitudeCorrelation
from starcal_ros.estimation.covariance import shared_covariance, shared_names
from starcal_ros.estimation.image_variation import image_variation, ImageVariation
from starcal_ros.estimation.levenberg_marquardt import NotObservable, Solution
from starcal_ros.estimation.linear_terms import LinearTerms, Score
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
    field_terms,
    image_blocks,
    image_field,
    image_parameters,
    METHODS,
    minimise,
    Problem,
    reduced_information,
    scalar_terms_at,
    score_of,
    State,
)
from starcal_ros.estimation.repeated_pointings import pointing_groups, repetition
from starcal_ros.estimation.residual_field import (
    best_prior,
    degree_for,
    FieldPrior,
    polynomials,
    sees_detector,
    TEST_DEGREE,
)
from starcal_ros.estimation.temperature import weakest_term, why_unsupported
from starcal_ros.estimation.variance_components import (
    CentroidVariance,
    estimate_star_tracker_sigma,
    estimate_variance,
)
from starcal_ros.lens import COEFFICIENTS
from starcal_ros.options import option
from starcal_ros.records import CameraGeometry, Ensemble, TemperatureTerms

_ROBUST_SCALE = 3.0  # of the Cauchy loss, in sigma: of normal noise 5 % of the weight is lost
_START_FLOOR_PX = 0.05  # until the residuals tell: of the order of what is left in good images
_TRACKER_EXCESS = 1.3  # found over assumed sigma from which the scatter is suspect
_FIELD_ROUNDS = 6  # its prior and the variances settle in two or three
_USUAL_TRACKER_ARCSEC = 10.0  # until the scatter tells
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
        ('fx', 'skew', 'fy', 'cx', 'cy', 'distortion'),
        'camera parameters that are estimated; the others are held at the prior; distortion: all'
        ' coefficients of the lens model',
        choices=(*ALL_PARAMETER_NAMES, 'distortion'),
    )
    star_tracker_sigma_arcsec: tuple[float, ...] = option(
        (0.0, 0.0, 0.0),
        '1-sigma of the star tracker attitude about its x, y, z axes, arcsec; zeros: estimated'
        ' from the scatter of the images',
        low=0.0,
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
        (0.0,),
        '1-sigma of the prior of fx, skew, fy, cx, cy (px) and of the coefficients of the lens'
        ' model, or one number for all; 0: of one that is estimated, nothing is known; of one that'
        ' is held, it is taken as exact',
        low=0.0,
    )
    principal_point_prior: float = option(
        0.03,
        '1-sigma of the prior of cx and cy where prior_sigma gives none, as a fraction of the'
        ' longer side of the image; 0: none',
        low=0.0,
        high=1.0,
    )
    variance_components: bool = option(
        True, 'estimate the sigmas of centroids and star tracker again from the residuals'
    )
    residual_field: bool = option(
        True,
        'estimate a smooth field over the detector beside the lens model where stars show one',
    )
    max_field_p_value: float = option(
        0.01,
        'p-value of no field below which one is estimated',
        low=0.0,
        high=1.0,
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
    covariance : (p + 3, p + 3)
        Of the p camera parameters and the alignment angles.
    information : (k, k)
        On the estimated camera parameters and focal terms, then the alignment where the method
        has one, and its rate; the rotations of the images eliminated.
    information_names : tuple of k str
    shared_covariance : (s, s)
        Of the camera parameters, focal terms, alignment and its rate.
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
    thermal : TemperatureTerms or None
        None where no change with temperature was asked for.
    joint_covariance : (p + 3 + 2 t, p + 3 + 2 t)
        Of ``covariance``'s numbers and the coefficients of the field of the camera, those of u,
        then those of v; t is 0 where there is no field.
    field_test : FieldPrior or None
        Of the test whether the lens model needs a field beside it; None where it was not made.
    repetition : (n,)
        Factor on the centroid covariances of stars that images of one pointing repeat.
    pointings : int
        Number of different pointings of the images.
    variation : ImageVariation
        Of the camera from image to image; carried in the covariances.
    correlation : AttitudeCorrelation
        Of the star-tracker errors in time; carried in the covariances.
    """

    geometry: CameraGeometry
    covariance: Floats
    joint_covariance: Floats
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
    thermal: TemperatureTerms | None
    field_test: FieldPrior | None
    repetition: Floats
    pointings: int
    variation: ImageVariation
    correlation: AttitudeCorrelation


def check_options(options: CalibrationOptions, model: str) -> None:
    """
    Raise `OptionError` for options that do not go together, or not with a lens model.

    Raises
    ------
    OptionError
        Naming the option.
    """
    if options.alignment_temperature and options.method == 'per_image':
        # Its mean of the images' alignments has no place for a slope: `hierarchical` with a loose
        # star tracker is the same estimate with one.
        raise OptionError('alignment_temperature: the method per_image has no common alignment')
    if tracker_sigma_is_given(options) and min(options.star_tracker_sigma_arcsec) < 1e-3:
        raise OptionError(
            f'star_tracker_sigma_arcsec: {list(options.star_tracker_sigma_arcsec)} has a sigma of'
            ' zero; give three, or none'
        )
    names = parameter_names(model)
    for name in estimated_parameters(options, model):
        if name not in names:
            raise OptionError(
                f'estimate: {name} is not a parameter of the lens model {model}, which has '
                + ', '.join(names)
            )
    if len(options.prior_sigma) not in (1, len(names)):
        raise OptionError(
            f'prior_sigma: {len(options.prior_sigma)} numbers, but the lens model {model} has '
            f'{len(names)} parameters: {", ".join(names)}'
        )


def tracker_sigma_is_given(options: CalibrationOptions) -> bool:
    """Whether a star tracker sigma is assumed, in place of the scatter of the images alone."""
    return any(options.star_tracker_sigma_arcsec)


def assumed_tracker_sigma_rad(options: CalibrationOptions) -> Floats:
    """1-sigma (3,) of the star tracker that an estimate starts with."""
    if not tracker_sigma_is_given(options):
        return np.full(3, _USUAL_TRACKER_ARCSEC * ARCSECOND_RAD)
    return np.array(options.star_tracker_sigma_arcsec) * ARCSECOND_RAD


def estimated_parameters(options: CalibrationOptions, model: str) -> tuple[str, ...]:
    """Names of the camera parameters that ``estimate`` asks for, of a lens model."""
    return tuple(
        name
        for asked in options.estimate
        for name in (COEFFICIENTS[model] if asked == 'distortion' else (asked,))
    )


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
    check_options(options, prior.camera.model)
    check_enough(ensemble, options)
    table = star_table(ensemble.images)
    time_ns = np.array([image.time_ns for image in ensemble.images], np.int64)
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
            estimate, weakest = _search(problem, start, table, time_ns, prior, options)
            why = 'within chance'
        except (NotObservable, np.linalg.LinAlgError) as error:
            if not (order or with_rate):
                names = ', '.join(estimated_parameters(options, problem.model))
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
    model, names = prior.camera.model, prior.camera.parameter_names
    prior_sigma = np.array(np.broadcast_to(options.prior_sigma, len(names)))
    weak_px = options.principal_point_prior * max(prior.camera.width, prior.camera.height)
    free = {names.index(name) for name in estimated_parameters(options, model)}
    for k in free & {names.index('cx'), names.index('cy')}:
        if prior_sigma[k] == 0:
            prior_sigma[k] = weak_px
    return Problem(
        method=options.method,
        model=model,
        free=np.array(sorted(free), np.int64),
        prior_parameters=prior.camera.parameters,
        prior_sigma=np.where(prior_sigma > 0, prior_sigma, np.inf),
        star_tracker_from_icrf=Rotation.from_quat(
            np.array([image.icrf_from_star_tracker_xyzw for image in ensemble.images])
        ).inv(),
        star_tracker_sigma_rad=np.tile(
            assumed_tracker_sigma_rad(options), (len(ensemble.images), 1)
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
    repetition: Floats  # (n,) factor on the covariances

    def covariance_px2(self, table: StarTable) -> Floats:
        """Return the centroid covariances (n, 3) that the search weights with."""
        return self.variance.of(table.covariance_px2, table.magnitude) * self.repetition[:, None]

    def agrees_with(self, other: _Verdict) -> bool:
        """Whether a search with the one would end where a search with the other does."""
        return (
            np.array_equal(self.kept, other.kept)
            and np.array_equal(self.misfit, other.misfit)
            and self.variance.is_close_to(other.variance)
            and np.allclose(self.repetition, other.repetition, rtol=0.02)
            and np.allclose(self.tracker_sigma_rad, other.tracker_sigma_rad, rtol=0.02)
        )


def _search(
    problem: Problem,
    start: State,
    table: StarTable,
    time_ns: NDArray[np.int64],
    prior: CameraGeometry,
    options: CalibrationOptions,
) -> tuple[Estimate, str]:
    """
    Robust search, then least squares with snooping, without a field and, if it must be, with one.

    With the term of temperature to leave out, if any.
    """
    everything = np.ones(len(table), bool)
    given_rad = problem.star_tracker_sigma_rad[0]
    verdict = _Verdict(
        CentroidVariance(1.0, _START_FLOOR_PX**2),
        given_rad,
        np.zeros(table.image_count, bool),
        everything,
        np.ones(len(table)),
    )
    measurements = _arranged(table, verdict)
    solution = _robust_search(problem, start, measurements)
    _, blocks = image_blocks(problem, solution.state, measurements)
    del measurements  # before the next: they are as large as the table
    verdict, measurements = _judge(
        problem, solution.state, blocks, None, table, verdict, given_rad, options
    )
    found = _settle(
        _Found(problem, solution, verdict, solution.iterations), measurements, table, options
    )
    del measurements
    found = _with_field(found, table, prior, options)
    return _estimate(found, table, time_ns, prior, options)


@dataclass(frozen=True)
class _Found:
    """Where a search stands: its problem, its minimum, and the verdict that it was made with."""

    problem: Problem
    solution: Solution[State]
    verdict: _Verdict
    iterations: int
    field_test: FieldPrior | None = None


def _settle(
    found: _Found, measurements: Measurements, table: StarTable, options: CalibrationOptions
) -> _Found:
    """Least squares and judgement of its residuals in turns, until the judgement stands."""
    problem, solution = found.problem, found.solution
    given_rad = assumed_tracker_sigma_rad(options)
    iterations, after = found.iterations, found.verdict
    for _ in range(_ROUNDS):
        verdict = after
        problem = dataclasses.replace(
            problem,
            star_tracker_sigma_rad=np.where(
                verdict.misfit[:, None], np.inf, verdict.tracker_sigma_rad
            ),
        )
        solution = minimise(problem, solution.state, measurements)
        iterations += solution.iterations
        _, blocks = image_blocks(problem, solution.state, measurements)
        terms = field_terms(problem, solution.state, measurements)
        after, measurements = _judge(
            problem, solution.state, blocks, terms, table, verdict, given_rad, options
        )
        del blocks
        if after.agrees_with(verdict):
            break
    return dataclasses.replace(
        found, problem=problem, solution=solution, verdict=verdict, iterations=iterations
    )


def _with_field(
    found: _Found, table: StarTable, prior: CameraGeometry, options: CalibrationOptions
) -> _Found:
    """The search with a field beside the lens model, where the stars show one."""
    plain = found
    best = _field_prior(found, table, prior.camera, TEST_DEGREE)
    if best is None:
        return plain
    found = plain = dataclasses.replace(found, field_test=best)
    if not options.residual_field or best.p_value > options.max_field_p_value:
        return plain
    best = _field_prior(found, table, prior.camera, degree_for(best))
    for _ in range(_FIELD_ROUNDS):
        if best is None:
            return plain
        found = _settle(_started(found, best), _arranged(table, found.verdict), table, options)
        again = _field_prior(found, table, prior.camera, degree_for(best))
        if again is not None and again.is_close_to(best):
            break
        best = again
    return found if best is not None else plain


def _started(found: _Found, prior: FieldPrior) -> _Found:
    """The search with another prior of the field, from the field that there is."""
    before, state = image_field(found.problem, found.solution.state), found.solution.state
    modes: Floats = np.zeros(prior.modes.shape[1])
    if before is not None:
        coefficients = in_degree(before, prior.degree)
        modes = np.asarray(np.linalg.lstsq(prior.modes, coefficients, rcond=1e-9)[0])
    return dataclasses.replace(
        found,
        problem=dataclasses.replace(found.problem, field_prior=prior),
        solution=dataclasses.replace(
            found.solution, state=dataclasses.replace(state, modes=modes)
        ),
    )


def _field_prior(
    found: _Found, table: StarTable, camera: CameraModel, degree: int
) -> FieldPrior | None:
    """
    The prior of a field that the residuals at a minimum ask for, in polynomials of a degree.

    None where the lens model has lines of sight for a small part of the detector only.
    """
    problem, state = found.problem, found.solution.state
    camera = dataclasses.replace(camera, parameters=state.parameters, field=None)
    if not sees_detector(camera):
        return None
    measurements = _arranged(table, found.verdict)
    _, blocks = image_blocks(problem, state, measurements)
    terms = scalar_terms_at(
        problem, state, measurements, polynomials(camera.width, camera.height, degree)
    )
    # The field that there is, if any, is part of what the residuals are asked for.
    without = dataclasses.replace(problem, field_prior=None)
    shown = score_of(without, state, blocks, None, terms)
    now = image_field(problem, state)
    if now is not None:
        coefficients = in_degree(now, degree)
        gradient = shown.gradient + shown.information @ coefficients
        shown = Score(gradient, shown.information)
    return best_prior(shown, camera, problem.free, degree)


def _arranged(table: StarTable, verdict: _Verdict) -> Measurements:
    return arrange(table, verdict.kept, verdict.covariance_px2(table))


def _estimate(
    found: _Found,
    table: StarTable,
    time_ns: NDArray[np.int64],
    prior: CameraGeometry,
    options: CalibrationOptions,
) -> tuple[Estimate, str]:
    """What a search has found, and the term of temperature to leave out, if any."""
    problem, solution, verdict = found.problem, found.solution, found.verdict
    state = solution.state
    measurements = _arranged(table, verdict)
    _, blocks = image_blocks(problem, state, measurements)
    terms = field_terms(problem, state, measurements)
    del measurements
    residual_px = _residuals(problem, state, table)
    kept = verdict.kept
    freedom = _freedom(problem, state, blocks, terms, kept, verdict.tracker_sigma_rad)
    chi2_given = squared_sigmas(residual_px[kept], table.covariance_px2[kept]).sum()
    lost = np.bincount(table.image[kept], minlength=table.image_count) == 0
    geometry, full, scatter_arcsec = _result(
        problem, state, blocks, terms, prior, verdict.tracker_sigma_rad
    )
    alignment = Rotation.from_quat(geometry.star_tracker_from_camera_xyzw).inv()
    attitude_error_rad, attitude_covariance_rad2, attitude_seen = attitudes_of_stars_alone(
        problem, dataclasses.replace(state, camera_from_star_tracker=alignment), blocks
    )
    p = problem.camera_count
    radius_px = 0.5 * math.hypot(prior.camera.width, prior.camera.height)
    focal_px = float(state.parameters[0])
    variation = image_variation(blocks, focal_px, radius_px)
    correlated = _correlation(
        found, time_ns, attitude_error_rad, attitude_covariance_rad2, attitude_seen, options
    )
    full = _with_alike(full, variation, correlated, alignment, len(state.focal))
    information = reduced_information(problem, state, blocks, terms)
    in_modes = len(state.modes)
    shared = np.concatenate([problem.free, np.arange(p, len(information) - in_modes)])
    k = p + len(state.focal)
    at_reference = np.r_[0:p, k : k + 3]
    of_modes = np.arange(len(full) - in_modes, len(full))
    full, joint = full[: of_modes[0], : of_modes[0]] if in_modes else full, full
    thermal = _thermal(state, full, options)
    weakest = weakest_term(thermal, full[k + 3 :, k + 3 :]) if thermal else ''
    names = shared_names(problem.model, len(state.focal), len(state.rate) > 0)
    estimate = Estimate(
        geometry=geometry,
        covariance=full[np.ix_(at_reference, at_reference)],
        joint_covariance=_in_coefficients(problem, joint, np.r_[at_reference, of_modes]),
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
        iterations=found.iterations,
        termination=solution.termination,
        thermal=thermal,
        field_test=found.field_test,
        repetition=verdict.repetition,
        pointings=len(np.unique(pointing_groups(state.camera_from_icrf, focal_px))),
        variation=variation,
        correlation=correlated,
    )
    return estimate, weakest


def _correlation(
    found: _Found,
    time_ns: NDArray[np.int64],
    error_rad: Floats,
    covariance_rad2: Floats,
    seen: Mask,
    options: CalibrationOptions,
) -> AttitudeCorrelation:
    """Correlation in time of the star-tracker errors of the images that fit."""
    good = seen & ~found.verdict.misfit
    assumed_rad = assumed_tracker_sigma_rad(options)
    excess = tracker_sigma_is_given(options) and bool(
        (found.verdict.tracker_sigma_rad > _TRACKER_EXCESS * assumed_rad).any()
    )
    return attitude_correlation(
        time_ns[good], error_rad[good], np.einsum('mii->mi', covariance_rad2[good]), excess
    )


def _with_alike(
    full: Floats,
    variation: ImageVariation,
    correlated: AttitudeCorrelation,
    camera_from_star_tracker: Rotation,
    focal_terms: int,
) -> Floats:
    """The covariance of all that is shared with what errors that images have alike add to it."""
    p = len(variation.information)
    gain = full[:, :p]
    full = full + gain @ variation.information @ gain.T
    angles = slice(p + focal_terms, p + focal_terms + 3)
    A = camera_from_star_tracker.as_matrix()
    full[angles, angles] += A @ np.diag(correlated.added_variance_rad2) @ A.T
    return full


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
        alignment_rate_rad_per_degc_sigma=tuple(sigma[k + 3 :].tolist()),
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
    terms: LinearTerms | None,
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
        freedom = _freedom(problem, state, blocks, terms, before.kept, before.tracker_sigma_rad)
        variance = estimate_variance(
            residual_px, table.covariance_px2, table.magnitude, before.kept, freedom
        )
    kept = _fitting(residual_px, table, variance, options)
    groups = pointing_groups(state.camera_from_icrf, float(state.parameters[0]))
    repeated = repetition(table, kept, residual_px, groups)
    del residual_px
    misfit: Mask = np.zeros(table.image_count, bool)
    weighted = variance.of(table.covariance_px2, table.magnitude) * repeated[:, None]
    measurements = arrange(table, kept, weighted)
    # One rotation for all has no attitude of an image to judge.
    if problem.method != 'single':
        # By the stars that fit: one that does not turns an image of few by more than the tracker.
        _, blocks = image_blocks(problem, state, measurements)
        eta_rad, covariance_rad2, seen = attitudes_of_stars_alone(problem, state, blocks)
        fitted = 2 if len(state.rate) else 1  # mean of the attitudes, and slope
        found_rad, misfit = estimate_star_tracker_sigma(
            eta_rad, covariance_rad2, seen, given_rad, fitted, tracker_sigma_is_given(options)
        )
        if options.variance_components:
            tracker_sigma_rad = found_rad
    return _Verdict(variance, tracker_sigma_rad, misfit, kept, repeated), measurements


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
    rotations = state.camera_from_icrf.as_matrix()
    return residuals_px(
        table,
        problem.model,
        image_parameters(problem, state),
        rotations,
        image_field(problem, state),
    )


def _in_coefficients(problem: Problem, covariance: Floats, rows: NDArray[np.int64]) -> Floats:
    """Some rows of a covariance, the modes of a field at its end turned into coefficients."""
    chosen = covariance[np.ix_(rows, rows)]
    if problem.field_prior is None:
        return chosen
    modes = problem.field_prior.modes
    k = len(rows) - modes.shape[1]
    to_coefficients = np.zeros((k + len(modes), len(rows)))
    to_coefficients[:k, :k] = np.eye(k)
    to_coefficients[k:, k:] = modes
    return np.asarray(to_coefficients @ chosen @ to_coefficients.T)


def _freedom(
    problem: Problem,
    state: State,
    blocks: Floats,
    terms: LinearTerms | None,
    kept: Mask,
    tracker_sigma_rad: Floats,
) -> float:
    """
    Share of the residuals' degrees of freedom that the fit leaves.

    An attitude that the star tracker holds costs less than three: with P the covariance from the
    stars and T the star tracker's, trace(T (T + P)^-1).  So does a mode of the field that its
    prior holds: one less its posterior variance.
    """
    unknowns = float(len(problem.free) + len(state.focal) + len(state.rate))
    if terms is not None:
        without = dataclasses.replace(problem, field_prior=None)
        shown = score_of(without, state, blocks, None, terms).information
        unknowns += len(shown) - float(np.trace(np.linalg.inv(shown + np.eye(len(shown)))))
    if problem.method == 'single':
        unknowns += 3
    else:
        _, P, seen = attitudes_of_stars_alone(problem, state, blocks)
        if problem.method == 'per_image':
            unknowns += 3 * int(np.count_nonzero(seen))
        else:
            T = np.diag(tracker_sigma_rad**2)
            total = T + P[seen]
            # numpy 1 reads a single matrix beside a stack of them as a stack of vectors.
            held = np.linalg.solve(total, np.broadcast_to(T, total.shape))
            unknowns += float(np.trace(held, axis1=1, axis2=2).sum())
    share = 1.0 - unknowns / (2 * max(int(np.count_nonzero(kept)), 1))
    if share <= 0:
        raise NotObservable('fewer residuals than unknowns')
    return share


def _result(
    problem: Problem,
    state: State,
    blocks: Floats,
    terms: LinearTerms | None,
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
    alignment, full = shared_covariance(problem, state, blocks, good, tracker_sigma_rad, terms)
    focal_px = state.parameters[[0, 2]]
    if not (focal_px > 0).all():
        raise NotObservable(f'fx, fy of {focal_px.round(1).tolist()} px are of a mirrored image')
    camera = dataclasses.replace(prior.camera, field=image_field(problem, state)).replace(
        **{problem.parameter_names[i]: float(state.parameters[i]) for i in problem.free}
    )
    quaternion = alignment.inv().as_quat()
    # One of the two quaternions of a rotation, so that equal calibrations are equal numbers.
    quaternion = quaternion * math.copysign(1.0, quaternion[3])
    return CameraGeometry(camera, quaternion), full, scatter_arcsec
