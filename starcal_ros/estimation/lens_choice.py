# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The smallest lens model that describes the stars of an ensemble."""

from __future__ import annotations

import dataclasses
import math

from starcal_ros.camera_conversion import convert
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.lens import COEFFICIENTS
from starcal_ros.records import CameraGeometry, Ensemble


def estimate_with_smallest_lens(
    ensemble: Ensemble, prior: CameraGeometry, options: CalibrationOptions
) -> tuple[Estimate, CameraGeometry]:
    """
    Return the estimate with the smallest lens model that needs no field, and the prior with it.

    The model of the prior camera comes first, then those with more coefficients, ascending, then
    those with fewer.  A model is accepted where the test of a residual field (`residual_field`)
    has a p-value of at least ``max_field_p_value``: the test asks the residuals for structure over
    the detector, which a model does not lose by having more coefficients alone.  Where none is
    accepted, the model with the least evidence for a field is estimated with its field.

    Raises
    ------
    TooFewObservations
        When there are too few images or stars for the model of the prior camera.
    OptionError
        For options that do not go together.
    """
    # Every p-value is above it: a model gets no field, but what its stars do not exclude.
    is_tested = options.max_field_p_value > 0.0
    bare = options
    if is_tested:
        bare = dataclasses.replace(options, max_field_p_value=math.ulp(0.0))
    least, best = math.inf, prior
    own = len(COEFFICIENTS[prior.camera.model])
    for model in sorted(
        COEFFICIENTS,
        key=lambda name: (
            name != prior.camera.model,
            len(COEFFICIENTS[name]) < own,
            len(COEFFICIENTS[name]),
        ),
    ):
        camera, worst_px = convert(prior.camera, model)
        if not math.isfinite(worst_px):
            continue
        started = dataclasses.replace(prior, camera=camera)
        try:
            estimate = estimate_calibration(ensemble, started, bare)
        except TooFewObservations:
            if model == prior.camera.model:
                raise
            continue  # the stars do not determine a model that large
        test = estimate.field_test
        passes = test is not None and test.p_value >= options.max_field_p_value
        if passes or not is_tested:
            return estimate, started
        ratio = math.inf if test is None else test.log_likelihood_ratio
        if ratio < least:
            least, best = ratio, started
    return estimate_calibration(ensemble, best, options), best
