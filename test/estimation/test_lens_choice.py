"""The lens model that is chosen: the smallest that describes the stars."""

from __future__ import annotations

import dataclasses

from estimation.test_residual_field import of_random_pointings  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ros.camera import convert, line_of_sight, pixel_grid, project
from starcal_ros.estimation.lens_choice import estimate_with_smallest_lens
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.simulation.centroids import true_observations
from starcal_ros.simulation.scenario import Scenario


def with_lens(model: str, **coefficients: float) -> Scenario:
    """A campaign of a camera of a lens model, the prior of plumb_bob."""
    given: Scenario = of_random_pointings(5)
    camera, _ = convert(given.truth.camera, model)
    truth = dataclasses.replace(given.truth, camera=camera.replace(**coefficients))
    return dataclasses.replace(given, truth=truth)


@pytest.mark.parametrize(
    ('model', 'coefficients'),
    [
        ('plumb_bob', {}),
        # A few pixels in a corner of this lens, 0.22 from its axis.
        ('thin_prism', {'s1': 0.02, 's2': 0.3}),
        ('tilted', {'tau_x': 0.03, 'tau_y': -0.02}),
    ],
)
def test_the_model_of_the_lens_is_found(model: str, coefficients: dict[str, float]) -> None:
    given = with_lens(model, **coefficients)
    options = CalibrationOptions(star_tracker_sigma_arcsec=given.star_tracker_sigma_arcsec)
    found, prior = estimate_with_smallest_lens(true_observations(given), given.prior, options)
    print(found.geometry.camera.model, found.field_test)
    assert prior.camera.model == found.geometry.camera.model
    assert found.field_test is not None and found.field_test.p_value >= options.max_field_p_value
    if model == 'plumb_bob':
        assert found.geometry.camera.model == model
    pixels = pixel_grid(given.truth.camera, 9, 9)
    moved = project(found.geometry.camera, line_of_sight(given.truth.camera, pixels)) - pixels
    print(np.abs(moved - moved.mean(axis=0)).max())
