# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""From an ensemble of observed images to camera, alignment and covariance."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError, TooFewObservations
from starcal_ros.estimation.options import (
    assumed_tracker_sigma_rad,
    CalibrationOptions,
    check_enough,
    check_options,
    estimated_parameters,
    tracker_sigma_is_given,
)
from starcal_ros.estimation.search import Found, search
from starcal_ros.estimation.star_trackers import (
    AttitudeErrors,
    canonical_xyzw,
    star_tracker_alignments,
    star_tracker_names,
)
from starcal_ros.estimation.verdict import all_residuals_px, dropped_stars, free_share
from starcal_ros.least_squares.levenberg_marquardt import NotObservable
from starcal_ros.least_squares.linear_terms import LinearTerms
from starcal_ros.least_squares.normal_equations import squared_sigmas, star_table, StarTable
from starcal_ros.methods.assembly import reduced_information
from starcal_ros.methods.covariance import shared_covariance, shared_names
from starcal_ros.methods.image_unknowns import attitudes_of_stars_alone
from starcal_ros.methods.problem import image_field, Problem, State
from starcal_ros.model_errors.attitude_correlation import attitude_correlation, AttitudeCorrelation
from starcal_ros.model_errors.image_variation import ImageVariation
from starcal_ros.model_errors.repeated_pointings import pointing_groups
from starcal_ros.model_errors.residual_field import FieldPrior
from starcal_ros.model_errors.temperature import weakest_term, why_unsupported
from starcal_ros.model_errors.variance_components import CentroidVariance
from starcal_ros.records import (
    CameraGeometry,
    Ensemble,
    StarTrackerAlignment,
    TemperatureTerms,
)

_TRACKER_EXCESS = 1.3  # found over assumed sigma from which the scatter is suspect


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
    blocks : (m, p + 4, p + 4)
        Its `image_blocks`, with the stars that were used and their final covariances.
    field_terms : LinearTerms or None
        Its `problem.field_terms`; None where no field is estimated.
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
        Of the camera from image to image; where there is one, each image has a shape of its own.
    correlation : AttitudeCorrelation
        Of the star-tracker errors in time, of the first one; carried in the covariances.
    star_trackers : tuple of StarTrackerAlignment
        Empty where there is one only.
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
    blocks: Floats
    field_terms: LinearTerms | None
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
    star_trackers: tuple[StarTrackerAlignment, ...]


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
    names = star_tracker_names(ensemble)
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
            found = search(problem, start, table, prior.camera, options)
            estimate, weakest = _estimate(found, table, time_ns, names, prior, options)
            why = 'within chance'
        except (NotObservable, np.linalg.LinAlgError) as error:
            if not (order or with_rate):
                asked = ', '.join(estimated_parameters(options, problem.model))
                raise TooFewObservations(
                    f'the stars do not determine all of {asked} and the alignment: {error}; '
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


def _estimate(
    found: Found,
    table: StarTable,
    time_ns: NDArray[np.int64],
    star_trackers: tuple[str, ...],
    prior: CameraGeometry,
    options: CalibrationOptions,
) -> tuple[Estimate, str]:
    """What a search has found, and the term of temperature to leave out, if any."""
    problem, solution, verdict = found.problem, found.solution, found.verdict
    state = solution.state
    blocks, terms = solution.normal.blocks, solution.normal.terms
    residual_px = all_residuals_px(problem, state, table)
    kept = verdict.kept
    freedom = free_share(problem, state, blocks, terms, kept, verdict.tracker_sigma_rad)
    chi2_given = squared_sigmas(residual_px[kept], table.covariance_px2[kept]).sum()
    lost = np.bincount(table.image[kept], minlength=table.image_count) == 0
    geometry, full, scatter_arcsec = _result(
        problem, state, blocks, terms, prior, verdict.tracker_sigma_rad
    )
    alignment = Rotation.from_quat(geometry.star_tracker_from_camera_xyzw).inv()
    attitude_error_rad, attitude_covariance_rad2, attitude_seen = attitudes_of_stars_alone(
        problem, dataclasses.replace(state, camera_from_star_tracker=alignment), blocks
    )
    errors = AttitudeErrors(
        time_ns,
        attitude_error_rad,
        np.einsum('mii->mi', attitude_covariance_rad2),
        verdict.tracker_sigma_rad,
        attitude_seen & ~verdict.misfit,
    )
    # The errors of one star tracker say nothing of those of another.
    correlations = [
        _correlation(found, errors, problem.star_tracker == k, options)
        for k in range(len(star_trackers))
    ]
    covariances = _covariances(found, full, alignment, correlations[0])
    names = shared_names(
        problem.model, len(state.focal), len(state.rate) > 0, len(state.mountings) // 3
    )
    information = reduced_information(problem, state, blocks, terms)
    shared = np.r_[problem.free, problem.camera_count : len(information) - len(state.modes)]
    thermal = _thermal(state, covariances.shared, options)
    k = problem.camera_count + len(state.focal) + 3
    rate = slice(k, k + len(state.rate))
    weakest = weakest_term(thermal, covariances.shared[rate, rate]) if thermal else ''
    estimate = Estimate(
        geometry=geometry,
        covariance=covariances.at_reference,
        joint_covariance=covariances.joint,
        information=information[np.ix_(shared, shared)],
        information_names=tuple(names[i] for i in shared),
        shared_covariance=covariances.shared,
        shared_names=names,
        problem=problem,
        state=state,
        blocks=blocks,
        field_terms=terms,
        table=table,
        kept=kept,
        residual_px=residual_px,
        variance=verdict.variance,
        variance_factor=float(chi2_given / (2 * np.count_nonzero(kept) * freedom)),
        star_tracker_sigma_rad=verdict.tracker_sigma_rad,
        misfit_image=verdict.misfit | lost,
        dropped_catalog_id=dropped_stars(table, kept),
        alignment_scatter_arcsec=scatter_arcsec,
        attitude_error_rad=attitude_error_rad,
        attitude_covariance_rad2=attitude_covariance_rad2,
        attitude_seen=attitude_seen,
        iterations=found.iterations,
        termination=solution.termination,
        thermal=thermal,
        field_test=found.field_test,
        repetition=verdict.repetition,
        pointings=len(
            np.unique(pointing_groups(state.camera_from_icrf, float(state.parameters[0])))
        ),
        variation=verdict.variation,
        correlation=correlations[0],
        star_trackers=star_tracker_alignments(
            star_trackers,
            problem,
            state,
            covariances.star_trackers,
            errors,
            [one.added_variance_rad2 for one in correlations],
        ),
    )
    return estimate, weakest


class _Covariances(NamedTuple):
    """Parts of the covariance of a solution, with what its images do not show each by itself."""

    at_reference: Floats  # of camera parameters and alignment
    joint: Floats  # of these, then of the coefficients of the field
    shared: Floats  # of all that is shared but the field
    star_trackers: Floats  # of alignment and mountings, errors independent in time


def _covariances(
    found: Found, of_noise: Floats, alignment: Rotation, correlated: AttitudeCorrelation
) -> _Covariances:
    """
    Covariances of a solution from that of its noise.

    Added are the correlation in time of the errors of the first star tracker, and the difference
    of the camera of one image from the mean.
    """
    problem, state = found.problem, found.solution.state
    full = of_noise.copy()
    p = problem.camera_count
    k = p + len(state.focal)
    A = alignment.as_matrix()
    full[k : k + 3, k : k + 3] += A @ np.diag(correlated.added_variance_rad2) @ A.T
    free = np.ix_(problem.free, problem.free)
    full[free] += found.verdict.variation.covariance_of_one_image(p)[free]
    at_reference = np.r_[0:p, k : k + 3]
    without_modes = len(full) - len(state.modes)
    with_modes = np.r_[at_reference, without_modes : len(full)]
    aligned = k + np.r_[0:3, 3 + len(state.rate) : state.alignment_count]
    return _Covariances(
        full[np.ix_(at_reference, at_reference)],
        _in_coefficients(problem, full, with_modes),
        full[:without_modes, :without_modes],
        of_noise[np.ix_(aligned, aligned)],
    )


def _correlation(
    found: Found, errors: AttitudeErrors, here: Mask, options: CalibrationOptions
) -> AttitudeCorrelation:
    """Correlation in time of the errors of a star tracker, in the images that fit."""
    good = errors.seen & here
    assumed_rad = assumed_tracker_sigma_rad(options)
    is_given = tracker_sigma_is_given(options)
    excess = is_given and bool(
        (found.verdict.tracker_sigma_rad > _TRACKER_EXCESS * assumed_rad).any()
    )
    largest_rad = assumed_rad if is_given and not excess else np.full(3, np.inf)
    return attitude_correlation(
        errors.time_ns[good],
        errors.error_rad[good],
        errors.variance_rad2[good],
        excess,
        largest_rad,
    )


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
    camera = dataclasses.replace(prior.camera, field=image_field(problem, state)).replace(
        **{problem.parameter_names[i]: float(state.parameters[i]) for i in problem.free}
    )
    return CameraGeometry(camera, canonical_xyzw(alignment.inv())), full, scatter_arcsec
