# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Lost columns and rows are found where they are, and nowhere on a sound detector."""

from __future__ import annotations

import numpy as np
import pytest
from random_pointings import displaced, estimated, HEIGHT, of_random_pointings, WIDTH  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import true_observations
from starcal_ros.arrays import Floats
from starcal_ros.assessment.model_checks import detector_step


@pytest.mark.slow
@pytest.mark.parametrize(('across', 'share'), [('u', 0.2), ('u', 0.85), ('v', 0.5)])
def test_a_lost_line_is_found_where_it_is(across: str, share: float) -> None:
    given = of_random_pointings(7)
    axis = 'uv'.index(across)
    place_px = share * (WIDTH, HEIGHT)[axis]

    def lost(pixels: Floats) -> Floats:
        moved = np.zeros_like(pixels)
        moved[:, axis] = -(pixels[:, axis] > place_px).astype(float)
        return moved

    step = detector_step(estimated(given, displaced(true_observations(given), lost)))
    assert (step.across, step.moved) == (across, across) and step.p_value < 1e-9
    assert abs(step.place_px - place_px) < 0.8 * WIDTH / 97 + 2.0  # of the places, and the stars
    assert -1.0 < step.size_px < -0.3  # the field takes the rest


def test_columns_that_are_shifted_along_themselves_are_found() -> None:
    given = of_random_pointings(8)

    def shifted(pixels: Floats) -> Floats:
        return np.stack([0.0 * pixels[:, 0], 0.3 * (pixels[:, 0] > 400.0)], axis=-1)

    step = detector_step(estimated(given, displaced(true_observations(given), shifted)))
    assert (step.across, step.moved) == ('u', 'v') and step.p_value < 1e-6
    assert abs(step.place_px - 400.0) < WIDTH / 48 and step.size_px > 0.15


@pytest.mark.slow
def test_a_sound_detector_has_no_step() -> None:
    """Twelve detectors: the least of their p-values is under 1e-3 in 1 of 80 runs."""
    p_values = []
    for seed in range(1, 13):
        given = of_random_pointings(seed, images=6)
        p_values.append(detector_step(estimated(given, true_observations(given))).p_value)
    assert min(p_values) > 1e-3
