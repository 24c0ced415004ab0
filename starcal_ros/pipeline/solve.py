# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
From an ensemble to a calibration: collect, solve with the smallest lens, judge by the gate.

A calibration has its provenance: software, options, catalog, prior and observations.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import hashlib
import json
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices
from starcal_ros.assessment import observability
from starcal_ros.assessment.budget import sigma_budget, statements
from starcal_ros.assessment.gate import judge, reasons_of
from starcal_ros.assessment.model_checks import check_sigmas, model_checks
from starcal_ros.assessment.stated import check_statements, with_doubts
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid
from starcal_ros.camera.lens import LENSES
from starcal_ros.camera.projection import convert
from starcal_ros.constants import ARCSECOND_RAD, software_version
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.identification.star_finder import realigned
from starcal_ros.pipeline.setup import aligned, Setup
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    Ensemble,
    EnsembleStatus,
    factored_field,
    StarObservations,
    TIMES,
)

_FEWEST_STARS = 3  # two fit their mirror image
_SHOWING = 50  # stars, from bright to faint, show the constellation as well as all
_MOST_OFF = 0.5  # misfit in RMS sizes of a constellation; a mirrored one misfits by 1.4
_ALIGNING = 20  # images, of whose alignments the middle one is taken


def add_to_ensemble(ensemble: Ensemble, observations: StarObservations, setup: Setup) -> Ensemble:
    """Return the ensemble with one more image, and without the least informative if too many."""
    return within_limit(ensemble.add(checked(observations, setup)), setup)


def checked(observations: StarObservations, setup: Setup) -> StarObservations:
    """
    Return the observations, refused if they cannot be of the prior camera.

    Images of another size are not, nor those whose stars no rotation brings near their pixels, as
    negated directions.
    """
    size, camera = (observations.width, observations.height), setup.prior.camera
    if not observations.refusal and size != (camera.width, camera.height):
        observations = dataclasses.replace(observations, refusal='wrong_size')
    if not observations.refusal and not _shows_its_stars(observations, camera):
        observations = dataclasses.replace(observations, refusal='bad_observations')
    return observations


def _shows_its_stars(observations: StarObservations, camera: CameraModel) -> bool:
    """
    True if a rotation brings the directions of the stars near the lines of sight of their pixels.

    Near compared with the size of the constellation: any prior camera is good enough, but a
    mirrored or mixed-up constellation stays off by its own size.
    """
    some = slice(None, None, max(1, len(observations) // _SHOWING))
    lines = line_of_sight(camera, observations.measured_px[some])
    exists = np.isfinite(lines[:, 0])
    if exists.sum() < _FEWEST_STARS:
        return True
    lines, directions = lines[exists], observations.direction_icrf[some][exists]
    spread = float(np.sqrt(((lines - lines.mean(axis=0)) ** 2).sum(axis=1).mean()))
    # The misfit of the best rotation (Kabsch 1976), without that rotation; no rotation mirrors.
    product = lines.T @ directions
    fit = np.linalg.svd(product, compute_uv=False)
    fit[2] = math.copysign(fit[2], np.linalg.det(product))
    off2 = float((lines**2).sum() + (directions**2).sum() - 2.0 * fit.sum())
    return math.sqrt(max(off2, 0.0) / len(lines)) <= _MOST_OFF * spread


def aligned_by(ensemble: Ensemble, setup: Setup) -> Setup:
    """The setup; where it has no prior alignment, with that of the middle one of the images."""
    if setup.is_aligned or not ensemble.images:
        return setup
    shown = Rotation.from_quat(
        np.array(
            [
                realigned(setup.prior, image).star_tracker_from_camera_xyzw
                for image in ensemble.images[:_ALIGNING]
            ]
        )
    )
    apart = np.abs(shown.as_quat() @ shown.as_quat().T)  # cosines of half angles
    return aligned(setup, shown[int(np.median(apart, axis=1).argmax())].as_quat())


@one_blas_thread()
def within_limit(ensemble: Ensemble, setup: Setup) -> Ensemble:
    """Return the ensemble without its least informative images, down to ``max_images``."""
    setup = aligned_by(ensemble, setup)
    return observability.keep_most_informative(ensemble, setup.prior, setup.calibration)


@one_blas_thread()
def ensemble_status(ensemble: Ensemble, setup: Setup) -> EnsembleStatus:
    """Images and stars collected, and the predicted precision of a calibration from them."""
    setup = aligned_by(ensemble, setup)
    return observability.ensemble_status(ensemble, setup.prior, setup.calibration)


@one_blas_thread()
def solve(ensemble: Ensemble, setup: Setup, active: Calibration | None = None) -> Calibration:
    """
    A calibration of the ensemble, judged by the gate.

    The gate limits the change from ``active``, the calibration that this one would replace. Raises
    TooFewObservations when the ensemble is too small; the text names the shortage.
    """
    setup = aligned_by(ensemble, setup)
    return calibration_of(estimated(ensemble, setup), ensemble, setup, active)


@one_blas_thread()
def judged(
    calibration: Calibration, ensemble: Ensemble, setup: Setup, active: Calibration | None
) -> Calibration:
    """A calibration of an ensemble with the checks and the verdict of the gate."""
    prior = aligned_by(ensemble, setup).prior
    checks = judge(calibration, prior, active, setup.gate, setup.calibration)
    reasons = reasons_of(checks)
    return dataclasses.replace(calibration, gate=checks, reasons=reasons, accepted=not reasons)


def estimated(ensemble: Ensemble, setup: Setup) -> Estimate:
    """The estimate with the lens model that was asked for, with doubts about the velocity."""
    ensemble = with_doubts(ensemble, setup.catalog)
    is_same = {image.catalog_digest for image in ensemble.images} == {setup.catalog.digest}
    colours_of = setup.catalog.colours_bp_rp if is_same else None
    given = ensemble, setup.prior, setup.calibration, colours_of
    if setup.frames.lens_model == 'auto':
        return estimate_with_smallest_lens(*given)
    return estimate_calibration(*given)


def calibration_of(
    result: Estimate, ensemble: Ensemble, setup: Setup, active: Calibration | None = None
) -> Calibration:
    """The estimate of an ensemble with its statistics and provenance, judged as by `judged`."""
    kept, camera = result.kept, result.geometry.camera
    field = camera.field
    layout, found = result.linear.layout, result.posterior
    searched, free = layout.in_state, np.intersect1d(layout.in_state, found.estimated)
    singular_values, weakest = observability.weakest_direction(
        found.equations.information[np.ix_(free, free)], tuple(layout.labels[k] for k in free)
    )
    stamps_ns = [image.time_ns for image in ensemble.images]
    budget = sigma_budget(result, setup.calibration, has_alignment=setup.has_tracker)
    has_dates = TIMES not in setup.origin
    calibration = Calibration(
        time_ns=max(stamps_ns),
        first_image_ns=min(stamps_ns),
        geometry=result.geometry,
        covariance=result.covariance,
        method=setup.calibration.method,
        estimated=estimated_parameters(setup.calibration, camera.model),
        residual_rms_px=float(np.sqrt(np.mean(result.residual_px[kept] ** 2))),
        variance_factor=result.variance_factor,
        images_used=len(stamps_ns),
        images_refused=dict(ensemble.refused),
        stars_used=int(kept.sum()),
        stars_rejected=int((~kept).sum()),
        alignment_scatter_arcsec=result.alignment_scatter_arcsec,
        star_tracker_sigma_arcsec=tuple(
            float(sigma) for sigma in result.star_tracker_sigma_rad / ARCSECOND_RAD
        ),
        centroid_scale=result.weights.variance.scale,
        centroid_floor_px=math.sqrt(result.weights.variance.floor_px2),
        dropped_catalog_ids=tuple(result.dropped_catalog_id.tolist()),
        misfit_images_ns=tuple(np.array(stamps_ns)[result.misfit_image].tolist()),
        singular_values=tuple(float(value) for value in singular_values),
        weakest_direction=weakest,
        zero_skew_cost_px=camera.ros_fit[1],
        iterations=result.iterations,
        termination=result.termination,
        accepted=False,
        reasons=(),
        parent_frame=setup.frames.star_tracker_frame,
        child_frame=setup.frames.camera_frame,
        provenance=provenance_of(setup, ensemble),
        temperature=result.thermal,
        maps=observability.detector_maps(
            camera, result.map_covariance, result.table.measured_px[kept]
        ),
        correlation=observability.correlation(
            result.considered[np.ix_(searched, searched)],
            tuple(layout.labels[k] for k in searched),
        ),
        star_trackers=tuple(
            dataclasses.replace(tracker, frame=tracker.frame or setup.frames.star_tracker_frame)
            for tracker in result.star_trackers
        ),
        model_checks=model_checks(
            result,
            (
                *check_statements(ensemble, setup.calibration, setup.catalog),
                *check_sigmas(result, setup.calibration),
            ),
        ),
        field=factored_field(field, result.map_covariance) if field else None,
        sigma_budget=budget,
        statements=statements(budget, result, setup.calibration, has_dates=has_dates),
    )
    return judged(calibration, ensemble, setup, active)


# Twice the log likelihood of a field that is not there: the 1 % level of three amplitudes.
_CHANCE = 9.0
_PER_COEFFICIENT = 2.0  # Akaike 1974: any coefficient gains so much likelihood ratio by chance


def estimate_with_smallest_lens(
    ensemble: Ensemble,
    prior: CameraGeometry,
    options: CalibrationOptions,
    colours_of: Callable[[Indices], Floats] | None = None,
) -> Estimate:
    """
    Return the estimate with the smallest lens model that needs no field.

    The model of the prior camera comes first, then the others by the number of their coefficients.
    A model is accepted where the likelihood of a field beside it is not larger than chance makes
    it: structure over the detector, which a model does not lose by having more coefficients alone.
    Where none is accepted, the model with the least evidence for a field is, each coefficient
    counted as 2, of those whose coefficients the stars show more than the prior of any lens does.
    A model of another kind than that of the prior camera is taken only if they do.  A model that
    cannot be estimated is left out.

    Raises
    ------
    TooFewObservations
        When no model can be estimated, with the shortage of the first.
    OptionError
        For options that do not go together.
    """
    least = math.inf
    best: Estimate | None = None
    shortage = TooFewObservations('no lens model describes the prior camera')
    others = sorted(
        LENSES.keys() - {prior.camera.model}, key=lambda m: len(LENSES[m].coefficients)
    )
    for model in (prior.camera.model, *others):
        camera, worst_px = convert(prior.camera, model)
        if not math.isfinite(worst_px):
            continue
        started = dataclasses.replace(prior, camera=camera)
        try:
            estimate = estimate_calibration(ensemble, started, options, colours_of)
        except TooFewObservations as error:
            shortage = error if prior.camera.has_lens(model) else shortage
            continue  # the stars do not determine this model
        if estimate.termination != 'converged' and best is not None:
            continue  # lost on the way: its lack of a field means nothing
        # Coefficients that the stars do not show stay where they started: at those of the prior in
        # a model that contains its model, where the conversion has put them in another one.
        is_shown = best is None or _is_shown_by_stars(estimate)
        if not (is_shown or worst_px == 0.0):
            continue
        camera = estimate.geometry.camera
        if not np.isfinite(line_of_sight(camera, pixel_grid(camera, 15, 15))).all():
            continue  # beyond the stars it folds
        ratio = estimate.posterior.field.likelihood_ratio
        if ratio < _CHANCE:
            return estimate
        if is_shown and ratio + _PER_COEFFICIENT * len(LENSES[model].coefficients) < least:
            least = ratio + _PER_COEFFICIENT * len(LENSES[model].coefficients)
            best = estimate
    if best is None:
        raise shortage
    return best


def _is_shown_by_stars(estimate: Estimate) -> bool:
    """Return True if the stars outweigh the default prior of each lens coefficient."""
    problem = estimate.linear.problem
    variance = np.diag(estimate.covariance)[: problem.camera_count]
    # Stars with as much information as the prior halve its variance.
    return not (problem.is_weak & (variance > 0.5 * problem.prior_sigma**2)).any()


def provenance_of(setup: Setup, ensemble: Ensemble) -> dict[str, str]:
    """Provenance of a calibration, sufficient to repeat it."""
    prior = np.r_[setup.prior.camera.parameters, setup.prior.star_tracker_from_camera_xyzw]
    return {
        'software': f'starcal {software_version()}',
        'camera_name': setup.camera_name,
        'catalog': setup.catalog.digest,
        'options': json.dumps(setup.options(), sort_keys=True),
        'prior': json.dumps(prior.tolist()),
        'observations_sha256': _digest(ensemble),
        **setup.origin,
    }


def _digest(ensemble: Ensemble) -> str:
    """
    SHA-256 of stamps, attitudes, stars and temperatures of the images, in their order.

    For each image, little-endian: stamp (int64, ns), number of stars (int64), attitude, then by
    column catalog numbers (int64), directions, pixels and covariances, last the temperature if
    known.  It can be recomputed from recorded observations.
    """
    digest = hashlib.sha256()
    for image in ensemble.images:
        digest.update(np.array([image.time_ns, len(image)], '<i8').tobytes())
        digest.update(image.icrf_from_star_tracker_xyzw.astype('<f8').tobytes())
        digest.update(image.catalog_id.astype('<i8').tobytes())
        for column in (image.direction_icrf, image.measured_px, image.covariance_px2):
            digest.update(column.astype('<f8').tobytes())
        if not math.isnan(image.temperature_degc):
            digest.update(np.array(image.temperature_degc, '<f8').tobytes())
    return digest.hexdigest()
