# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Whether the stars contradict the model of the world that a calibration assumes.

Each check is a score test at the minimum: what would the stars do with one more term, all that is
estimated free to answer.  Held camera parameters, a wrong velocity of the observer and a step
between two parts of the detector are tested; the tests that the estimate makes itself (a field
beside the lens model, variation from image to image, star-tracker errors that are correlated) are
reported beside them.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.special import chdtrc

from starcal_ros.arrays import Floats, Indices
from starcal_ros.assessment.cross_validation import cross_validation
from starcal_ros.assessment.detector_step import detector_step
from starcal_ros.camera import CameraModel, pixel_grid, rotation_jacobian
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.least_squares.linear_terms import linear_terms, LinearTerms
from starcal_ros.least_squares.normal_equations import arrange, Measurements
from starcal_ros.methods.assembly import score_of
from starcal_ros.methods.problem import image_parameters
from starcal_ros.records import HeldTerm, ModelChecks

_SPEED_OF_LIGHT_KM_S = 299792.458
_GRID = 25


def model_checks(estimate: Estimate) -> ModelChecks:
    """Return what the stars of an estimate show of the model that it assumes."""
    covariance = estimate.variance.of(estimate.table.covariance_px2, estimate.table.magnitude)
    covariance = covariance * estimate.repetition[:, None]
    measurements = arrange(estimate.table, estimate.kept, covariance)
    camera = estimate.geometry.camera
    test, variation, correlation = estimate.field_test, estimate.variation, estimate.correlation
    velocity = _velocity(estimate, measurements)
    rms_px, worst_px = _field_px(camera)
    return ModelChecks(
        field_p_value=test.p_value if test else float('nan'),
        field_rms_px=rms_px,
        field_worst_px=worst_px,
        held=_held_terms(estimate),
        step=detector_step(estimate, measurements),
        velocity_error_km_s=velocity[0],
        velocity_sigma_km_s=velocity[1],
        velocity_p_value=velocity[2],
        image_variation_px=variation.corner_sigma_px(
            float(camera.parameters[0]), _corner_radius_px(camera)
        ),
        image_variation_p_value=variation.p_value,
        correlation_time_s=correlation.correlation_time_s,
        independent_images=float(correlation.independent_images.min()),
        pointings=estimate.pointings,
        independent_pointings=_independent_pointings(estimate),
        cross_validation=cross_validation(estimate, measurements),
    )


def _independent_pointings(estimate: Estimate) -> float:
    """Number of images, one that repeats the stars of others counted by what it adds."""
    image, kept = estimate.table.image, estimate.kept
    stars = np.bincount(image[kept], minlength=estimate.table.image_count)
    summed = np.bincount(image[kept], estimate.repetition[kept], estimate.table.image_count)
    return float((stars[stars > 0] / summed[stars > 0]).sum())


def _corner_radius_px(camera: CameraModel) -> float:
    """Distance of a corner of the detector from its middle, px."""
    return 0.5 * math.hypot(camera.width, camera.height)


def _field_px(camera: CameraModel) -> tuple[float, float]:
    """RMS per axis and largest length of the field over the detector, px."""
    if camera.field is None:
        return 0.0, 0.0
    moved = camera.field.displacement_px(pixel_grid(camera, _GRID, _GRID))
    return float(np.sqrt((moved**2).mean())), float(np.linalg.norm(moved, axis=1).max())


def _held_terms(estimate: Estimate) -> tuple[HeldTerm, ...]:
    """Camera parameters that are held or bound by their prior, with what the stars ask for."""
    problem, state, field = estimate.problem, estimate.state, estimate.field_terms
    p = problem.camera_count
    names = problem.parameter_names
    terms = []
    held = np.setdiff1d(np.arange(p), problem.free)
    if len(held):
        # The held columns are terms like any other; their sums stand in the blocks.
        rows = estimate.blocks[:, held, :]
        tested = LinearTerms(rows[:, :, held].sum(axis=0), rows)
        between = None
        if field is not None:
            between = field.cross[:, :, held].sum(axis=0).T
        value, sigma = score_of(problem, state, estimate.blocks, field, tested, between).single()
        for k, j in enumerate(held):
            if np.isfinite(sigma[k]):
                asked = float(state.parameters[j] + value[k])
                terms.append(
                    HeldTerm(names[j], float(state.parameters[j]), asked, float(sigma[k]))
                )
    variance = np.diag(estimate.covariance)
    for j in problem.free:
        prior_variance = problem.prior_sigma[j] ** 2
        if np.isfinite(prior_variance) and variance[j] < prior_variance:
            # How far the estimate is from the prior, in the sigma of that difference.
            apart = np.sqrt(prior_variance - variance[j])
            prior = float(problem.prior_parameters[j])
            terms.append(HeldTerm(names[j], prior, float(state.parameters[j]), float(apart)))
    return tuple(terms)


def _velocity(estimate: Estimate, measurements: Measurements) -> tuple[float, float, float]:
    """Length of the velocity that the stars miss, its largest 1-sigma, km/s; p-value of none."""
    problem, state, field = estimate.problem, estimate.state, estimate.field_terms
    camera, R = estimate.geometry.camera, state.camera_from_icrf.as_matrix()
    modes = problem.field_prior

    def displacement(pixels: Floats, directions: Floats, image: Indices) -> Floats:
        e = directions.T
        J = rotation_jacobian(dataclasses.replace(camera, field=None), e)
        axes = R[image]  # columns: the axes of the ICRS in the camera frame
        toward = axes - e[:, :, None] * np.einsum('ni,nij->nj', e, axes)[:, None, :]
        # A direction that moves by d turns by the passive rotation d x e.
        rotation = np.cross(toward, e[:, :, None], axisa=1, axisb=1, axisc=1)
        moved = (J @ rotation / _SPEED_OF_LIGHT_KM_S).transpose(1, 2, 0)
        if modes is None:
            return moved
        phi = modes.polynomials(pixels)
        of_u, of_v = modes.modes[: len(phi)], modes.modes[len(phi) :]
        return np.concatenate([moved, np.stack([of_u.T @ phi, of_v.T @ phi])], axis=1)

    terms = linear_terms(
        measurements,
        problem.model,
        image_parameters(problem, state),
        R,
        displacement,
        estimate.geometry.camera.field,
    )
    between = terms.information[:3, 3:] if field is not None else None
    tested = LinearTerms(terms.information[:3, :3], terms.cross[:, :3])
    score = score_of(problem, state, estimate.blocks, field, tested, between)
    if not (np.diag(score.information) > 0).all():
        return 0.0, float('inf'), 1.0
    missed = np.linalg.solve(score.information, score.gradient)
    least = float(np.linalg.eigvalsh(score.information)[0])
    sigma = 1.0 / np.sqrt(least) if least > 0 else float('inf')
    chi2 = float(score.gradient @ missed)
    return float(np.linalg.norm(missed)), float(sigma), float(chdtrc(3.0, chi2))
