# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The estimate with the lens model of the options, or the smallest that describes the stars."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import math

import numpy as np

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.camera.lens import LENSES
from starcal_ros.camera.projection import convert
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.solve import inputs_of_estimate
from starcal_ros.records import CameraGeometry, Ensemble


def estimated(ensemble: Ensemble, setup: Setup) -> Estimate:
    """The estimate of an ensemble with the lens model that the setup asks for."""
    given = inputs_of_estimate(ensemble, setup)
    if setup.frames.lens_model == 'auto':
        return estimate_with_smallest_lens(*given)
    return estimate_calibration(*given)


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
