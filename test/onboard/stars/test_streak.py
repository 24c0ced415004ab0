# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Light along a path, and the place of a star over an exposure."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.camera import CameraModel, line_of_sight, project
from starcal_ros.stars.detection import measure_background, Sources
from starcal_ros.stars.psf_fit import light_in_stamps, stamp_radius_px
from starcal_ros.stars.streak import refined, Streak, without_streaks

CAMERA = CameraModel(
    800, 640, np.array([500.0, 0.0, 500.0, 399.5, 319.5, -0.05, 0.01, 0.0, 0.0, 0.0])
)
PARTS = (np.arange(2000) + 0.5) / 2000 - 0.5


@pytest.mark.parametrize(
    ('sigma_px', 'length_px', 'angle_rad'),
    [(0.5, 10.0, 0.0), (0.5, 6.0, 0.5), (0.95, 2.0, 2.0), (0.95, 10.0, 0.5), (2.0, 10.0, 2.0)],
)
def test_light_of_a_streak_is_the_mean_of_its_places(sigma_px, length_px, angle_rad) -> None:
    path_px = length_px * np.array([math.cos(angle_rad), math.sin(angle_rad)])
    middle_px, width = np.array([0.2, -0.3]), 2 * stamp_radius_px(sigma_px, length_px) + 1
    one, places_px = np.ones(1), middle_px + PARTS[:, None] * path_px
    many = np.ones(len(PARTS))
    exact = light_in_stamps(places_px, many / many.sum(), sigma_px * many, width).sum(axis=0)
    light = light_in_stamps(middle_px[None], one, sigma_px * one, width, path_px[None])
    # The quadrature has some nodes only, and fits are good to a hundredth of a pixel.
    assert np.abs(light[0] - exact).max() < 1e-4 * exact.max()


@pytest.mark.parametrize('turn_rad', [[0.0, 0.0, 0.03], [0.01, -0.015, 0.0], [0.005, 0.01, 0.02]])
def test_the_mean_of_a_bent_path_is_known(turn_rad: list[float]) -> None:
    turn = np.array(turn_rad)
    middle_px = np.array([[40.0, 30.0], [760.0, 320.0], [399.5, 600.0], [399.5, 319.5]])
    direction = line_of_sight(CAMERA, middle_px)
    places_px = np.array(
        [project(CAMERA, Rotation.from_rotvec(-part * turn).apply(direction)) for part in PARTS]
    )
    streak = Streak(CAMERA, turn)
    bend_px = places_px.mean(axis=0) - middle_px
    assert np.abs(streak.bend_px(middle_px) - bend_px).max() < 1e-3 * np.abs(bend_px).max() + 1e-6
    # Straight to first order.
    path_px = places_px[-1] - places_px[0]
    assert np.abs(streak.at(middle_px) - path_px).max() < 0.03 * np.abs(path_px).max()


def test_a_source_without_a_line_of_sight_hides_no_turn() -> None:
    """The corners of a lens that folds are seen by no pixel, but hot pixels shine there."""
    parameters = np.array([700.0, 0.0, 700.0, 499.5, 499.5, -0.35, 0.0, 0.0, 0.0, 0.0])
    streak = Streak(CameraModel(1000, 1000, parameters), np.array([0.006, 0.004, 0.0]))
    rng = np.random.default_rng(1)
    xy_px = np.concatenate([rng.uniform(300.0, 700.0, (30, 2)), [[2.0, 2.0]]])
    moments_px2 = streak.moments_px2(xy_px) + np.array([1.0, 1.0, 0.0])
    start = Streak(streak.camera, 0.8 * streak.turn_rad)
    turn, variance_px2, _ = refined(start, 1.0, xy_px, moments_px2)
    # Without noise: what is left is the last step of the fit, and the pull of the outlier.
    np.testing.assert_allclose(turn.turn_rad[:2], streak.turn_rad[:2], rtol=0.01)
    assert abs(variance_px2 - 1.0) < 0.01


def test_a_source_at_the_limit_of_a_body_ends_the_search() -> None:
    """Windows carry light to the next one, so the last of a batch may be a body there alone."""
    v, u = np.mgrid[:600, :600]
    pixels = np.full((600, 600), 100.0)
    pixels[294:316, 292:309] = 1100.0
    pixels[313:316, 292:309] = 360.0
    xy_px = [(50, 500), (150, 520), (450, 80), (520, 520), (300, 300), (100, 100)]
    for x, y in xy_px[:4]:
        pixels += 3000.0 * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2.0 * 1.5**2))
    snr = np.array([15.0, 14.0, 13.0, 12.0, 10.0, 5.0])
    sources = Sources(np.array(xy_px, np.float64), snr, 600.0**2)
    image = np.rint(pixels).astype(np.uint16)
    camera = CameraModel(600, 600, np.array([1000.0, 0.0, 1000.0, 299.5, 299.5, *np.zeros(5)]))
    found, streak = without_streaks(image, measure_background(image), sources, camera)
    assert streak is None and len(found.snr) == len(sources.snr)
