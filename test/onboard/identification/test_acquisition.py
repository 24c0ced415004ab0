# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Acquisition without pixels: predictions match their sources, or the image is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.scenario import scenario, scene
from starcal_ros.camera import project
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.acquisition import acquire
from starcal_ros.identification.prediction import in_image, predict, Prediction
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.stars.detection import Sources

SCENARIO = scenario('tiny', seed=6)
TRUTH = SCENARIO.truth
WIDTH, HEIGHT = TRUTH.camera.width, TRUTH.camera.height
REACH_PX, ROLL_RAD = 50.0, 0.09


def prediction() -> Prediction:
    one = scene(SCENARIO, 4, attitude_noise=False)
    attitude = one.icrf_from_star_tracker_xyzw
    return predict(TRUTH, attitude, one.time_ns, load_catalog(None, 9.0), 9.0, 0.03)


def sources(xy_px: np.ndarray) -> Sources:
    """Sources of equal brightness from a search of the whole image."""
    xy_px = xy_px[in_image(xy_px, WIDTH, HEIGHT)]
    return Sources(xy_px, np.full(len(xy_px), 100.0), float(WIDTH * HEIGHT))


@pytest.mark.parametrize('turn_deg', [(0.0, 0.0, 0.0), (1.0, -0.8, 0.0), (-0.5, 0.9, 4.5)])
def test_a_rotated_camera_is_found(turn_deg: tuple[float, ...]) -> None:
    """A third of the stars is missing and a third of the sources are false."""
    expected = prediction()
    turn = Rotation.from_rotvec(np.radians(turn_deg))
    turned_px = project(TRUTH.camera, turn.apply(expected.direction_camera))
    rng = np.random.default_rng(3)
    missing = rng.uniform(size=len(turned_px)) < 1 / 3
    strange = rng.uniform([0, 0], [WIDTH, HEIGHT], (np.count_nonzero(missing), 2))
    shown_px = turned_px.copy()
    shown_px[missing] = strange
    found_px = acquire(expected, sources(shown_px), TRUTH, REACH_PX, ROLL_RAD)
    inside = in_image(turned_px, WIDTH, HEIGHT)
    # Of a strange source within 2 px of a missing star a smooth correction makes a tenth.
    assert np.abs(found_px - turned_px)[inside].max() < 0.3


@pytest.mark.parametrize('seed', range(5))
def test_other_stars_match_nothing(seed: int) -> None:
    strange = np.random.default_rng(seed).uniform([0, 0], [WIDTH, HEIGHT], (150, 2))
    with pytest.raises(ImageRefused, match='no_match'):
        acquire(prediction(), sources(strange), TRUTH, REACH_PX, ROLL_RAD)


def test_a_turn_beyond_the_reach_matches_nothing() -> None:
    expected = prediction()
    turn = Rotation.from_rotvec(np.radians([4.0, 0.0, 0.0]))
    shown = sources(project(TRUTH.camera, turn.apply(expected.direction_camera)))
    with pytest.raises(ImageRefused, match='no_match'):
        acquire(expected, shown, TRUTH, REACH_PX, ROLL_RAD)


def test_a_match_in_one_part_only_is_refused() -> None:
    """One ninth of the image holds the predicted stars, the rest other ones."""
    expected = prediction()
    shown_px = np.random.default_rng(6).uniform([0, 0], [WIDTH, HEIGHT], expected.xy_px.shape)
    corner = (expected.xy_px < [WIDTH / 3, HEIGHT / 3]).all(axis=1)
    shown_px[corner] = expected.xy_px[corner]
    assert np.count_nonzero(corner & in_image(expected.xy_px, WIDTH, HEIGHT)) > 8
    with pytest.raises(ImageRefused, match='no_match'):
        acquire(expected, sources(shown_px), TRUTH, REACH_PX, ROLL_RAD)
    acquire(expected, sources(expected.xy_px), TRUTH, REACH_PX, ROLL_RAD)
