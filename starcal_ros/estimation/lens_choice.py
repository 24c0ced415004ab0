# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The smallest lens model that describes the stars of an ensemble."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.camera.conversion import convert
from starcal_ros.camera.lens import COEFFICIENTS
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.calibration_options import CalibrationOptions
from starcal_ros.records import CameraGeometry, Ensemble

# Twice the log likelihood of a field that is not there: the 1 % level of three amplitudes.
_CHANCE = 9.0
_PER_COEFFICIENT = 2.0  # Akaike 1974: less of a likelihood ratio is what any coefficient takes


def estimate_with_smallest_lens(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> tuple[Estimate, CameraGeometry]:
    """
    Return the estimate with the smallest lens model that needs no field, and the prior with it.

    The model of the prior camera comes first, then the others by the number of their coefficients.
    A model is accepted where the likelihood of a field beside it is not larger than chance makes
    it: structure over the detector, which a model does not lose by having more coefficients alone.
    Where none is accepted, the model with the least evidence for a field is, each coefficient
    counted as 2.

    Raises
    ------
    TooFewObservations
        When there are too few images or stars for the model of the prior camera.
    OptionError
        For options that do not go together.
    """
    least = math.inf
    best: tuple[Estimate, CameraGeometry] | None = None
    others = sorted(COEFFICIENTS.keys() - {prior.camera.model}, key=lambda m: len(COEFFICIENTS[m]))
    for model in (prior.camera.model, *others):
        camera, worst_px = convert(prior.camera, model)
        if not math.isfinite(worst_px):
            continue
        started = dataclasses.replace(prior, camera=camera)
        try:
            estimate = estimate_calibration(ensemble, started, options)
        except TooFewObservations:
            if model == prior.camera.model:
                raise
            continue  # the stars do not determine a model that large
        if estimate.termination != 'converged' and best is not None:
            continue  # lost on the way: its lack of a field means nothing
        found = estimate.geometry.camera
        if not np.isfinite(line_of_sight(found, pixel_grid(found, 15, 15))).all():
            continue  # beyond the stars it folds
        ratio = estimate.posterior.field.likelihood_ratio
        if ratio < _CHANCE:
            return estimate, started
        if ratio + _PER_COEFFICIENT * len(COEFFICIENTS[model]) < least:
            least = ratio + _PER_COEFFICIENT * len(COEFFICIENTS[model])
            best = estimate, started
    if best is None:
        raise TooFewObservations('no lens model describes the prior camera')
    return best
