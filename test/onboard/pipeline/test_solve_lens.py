# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The lens model that is chosen: the smallest that describes the stars."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from random_pointings import honesty, of_random_pointings  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats
from starcal_ros.camera.projection import convert
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.pipeline.solve import estimate_with_smallest_lens


def with_lens(model: str, **coefficients: float) -> Scenario:
    """A campaign of a camera of a lens model, the prior of plumb_bob."""
    given: Scenario = of_random_pointings(5, images=6)
    camera, _ = convert(given.truth.camera, model)
    truth = dataclasses.replace(given.truth, camera=camera.replace(**coefficients))
    return dataclasses.replace(given, truth=truth)


def unmoved(pixels: Floats) -> Floats:
    return np.zeros_like(pixels)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('model', 'coefficients', 'chosen'),
    [
        ('plumb_bob', {}, ('plumb_bob',)),
        # 3 px in a corner of this lens, 0.22 from its axis.
        ('thin_prism', {'s1': 0.02, 's2': 0.3}, ('plumb_bob', 'thin_prism', 'tilted')),
        # To first order a small tilt is a principal point and a decentring.
        (
            'tilted',
            {'tau_x': 0.03, 'tau_y': -0.02},
            ('plumb_bob', 'rational_polynomial', 'thin_prism', 'tilted'),
        ),
    ],
)
def test_the_smallest_model_that_leaves_no_field_is_chosen(
    model: str, coefficients: dict[str, float], chosen: tuple[str, ...]
) -> None:
    given = with_lens(model, **coefficients)
    options = CalibrationOptions(
        star_tracker_sigma_arcsec=given.star_tracker_sigma_arcsec, velocity_sigma_m_s=10.0
    )
    found, prior = estimate_with_smallest_lens(true_observations(given), given.prior, options)
    assert prior.camera.model == found.geometry.camera.model and prior.camera.model in chosen
    # Where no model of those that converge is free of a field, the field is in the estimate.
    assert found.termination == 'converged'
    assert honesty(given, found, unmoved)[0] < 2.0
