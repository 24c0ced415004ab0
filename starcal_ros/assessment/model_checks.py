# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Where the data contradict the model of a calibration.

What is unknown is estimated with a prior; here is what goes beyond it: unknowns far from their
priors, amplitudes with their likelihood ratios, a step of the detector, and the predictions of
what was left out.
"""

from __future__ import annotations

import math

import numpy as np

from starcal_ros.assessment.detector_step import detector_step
from starcal_ros.assessment.predictions import predictions
from starcal_ros.camera import CameraModel, pixel_grid
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.equations import equations
from starcal_ros.records import Amplitude, HeldTerm, ModelChecks

_GRID = 25
_SHOWN = 0.01  # of the prior variance of an unknown, below which the stars say nothing of it


def model_checks(estimate: Estimate) -> ModelChecks:
    """Return what the stars of an estimate show of the model that it assumes."""
    camera = estimate.geometry.camera
    rms_px, worst_px = _field_px(camera)
    return ModelChecks(
        amplitudes=_amplitudes(estimate),
        field_rms_px=rms_px,
        field_worst_px=worst_px,
        held=_held_terms(estimate),
        step=detector_step(estimate),
        image_variation_px=_image_variation_px(estimate),
        predictions=predictions(estimate),
    )


def _amplitudes(estimate: Estimate) -> tuple[Amplitude, ...]:
    """Return the estimated amplitudes, each with twice its log likelihood against none."""
    found = estimate.posterior
    octaves = float(np.sqrt((np.exp(found.field.log_px) ** 2).sum()))
    shape = float(np.sqrt((np.exp(found.shape.log_px) ** 2).sum()))
    return (
        Amplitude('field', octaves, 'px', found.field.likelihood_ratio),
        Amplitude('change from image to image', shape, 'px', found.shape.likelihood_ratio),
        *(
            Amplitude(error.name, math.sqrt(error.variance_px2), 'px', error.likelihood_ratio)
            for error in estimate.shared_errors
        ),
        *(
            Amplitude(
                f'slow error of star tracker {k + 1}, {one.correlation}',
                one.slow,
                'sigma',
                one.likelihood_ratio,
            )
            for k, one in enumerate(estimate.tracker_errors)
        ),
    )


def _image_variation_px(estimate: Estimate) -> float:
    """1-sigma change of the camera from image to image in a corner, px."""
    camera = estimate.geometry.camera
    corner_px = 0.5 * math.hypot(camera.width, camera.height)
    sigma_px = float(np.linalg.norm(np.exp(estimate.posterior.shape.log_px)))
    return sigma_px * corner_px / float(camera.parameters[0])


def _field_px(camera: CameraModel) -> tuple[float, float]:
    """RMS per axis and largest length of the field over the detector, px."""
    if camera.field is None:
        return 0.0, 0.0
    moved = camera.field.displacement_px(pixel_grid(camera, _GRID, _GRID))
    return float(np.sqrt((moved**2).mean())), float(np.linalg.norm(moved, axis=1).max())


def _held_terms(estimate: Estimate) -> tuple[HeldTerm, ...]:
    """
    Return unknowns that are held or have a stated prior, with what the stars ask for.

    A held parameter is tested by one more Newton step with it free.
    """
    found, layout, problem = estimate.posterior, estimate.layout, estimate.problem
    terms = []
    arrow = equations(
        estimate.sums, problem, estimate.state, layout, estimate.posterior.shape_sigma_px
    )
    camera = np.arange(layout.count)[layout.places['camera']]
    for k in np.setdiff1d(camera, found.estimated):
        cross = arrow.information[k]
        information = float(cross[k] - cross @ found.working @ cross)
        if information <= 1e-9 * cross[k]:
            continue
        step = float(arrow.gradient[k] - cross @ found.mean) / information
        held = float(estimate.state.parameters[k - camera[0]])
        terms.append(HeldTerm(layout.labels[k], held, held + step, information**-0.5))
    total, working = np.diag(found.covariance), found.working_variance
    stated = layout.of(['camera', 'mountings', 'velocity', 'readout', 'stamps'])
    first = layout.places['mountings'].start if 'mountings' in layout else layout.count
    for k in np.intersect1d(stated, found.estimated):
        precision = layout.prior_precision[k]
        prior_variance = 1.0 / precision if precision else math.inf
        # Of the estimate about the prior mean: the part of the prior that shows, and noise.
        apart2 = prior_variance - 2.0 * working[k] + total[k]
        if np.isfinite(prior_variance) and working[k] < (1.0 - _SHOWN) * prior_variance:
            off = float(layout.prior_offset[k] + found.mean[k])
            prior = 0.0
            if k in camera:
                prior = float(problem.prior_parameters[k - camera[0]])
            name, unit = layout.labels[k], 1.0
            head = (k - first) // 3 + 1
            if 1 <= head < len(estimate.star_trackers):
                frame = estimate.star_trackers[head].frame
                name, unit = f'mounting of {frame} {name[-1]}_deg', math.degrees(1.0)
            apart = unit * math.sqrt(apart2)
            terms.append(HeldTerm(name, prior, prior + unit * off, apart))
    return tuple(terms)
