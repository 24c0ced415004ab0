# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Predicted stars against the simulated scene, and the polynomial correction of predictions."""

import numpy as np
import pytest

from starcal_ground.simulation.scenario import scenario, Scene, scene
from starcal_ros.camera import CameraModel, line_of_sight, project
from starcal_ros.identification.prediction import (
    fit_warp,
    in_image,
    predict,
    Prediction,
    warp_degree,
)
from starcal_ros.records import CameraGeometry
from starcal_ros.robust_statistics import RAYLEIGH_TO_SIGMA
from starcal_ros.sky.astrometry import apparent_directions
from starcal_ros.sky.catalog import load_catalog

SCENARIO = scenario('tiny', seed=6)
CATALOG = load_catalog(None, 9.0)
HALF_PX = 320.0


def predicted(one: Scene, magnitude_limit: float = 9.0, margin_rad: float = 0.0) -> Prediction:
    attitude = scene(SCENARIO, 2, attitude_noise=False).icrf_from_star_tracker_xyzw
    return predict(SCENARIO.truth, attitude, one.time_ns, CATALOG, magnitude_limit, margin_rad)


def test_prediction_at_the_truth_is_the_scene() -> None:
    one = scene(SCENARIO, 2)
    found = predicted(one, margin_rad=np.radians(1.5))
    place = dict(zip(CATALOG.id[found.catalog_index].tolist(), found.xy_px, strict=True))
    for number, pixel in zip(one.catalog_id.tolist(), one.pixel_px, strict=True):
        np.testing.assert_allclose(place[number], pixel, rtol=0, atol=1e-6)
    brightness = CATALOG.magnitude[found.catalog_index]
    assert (np.diff(brightness) >= 0).all()


def test_stars_beyond_magnitude_and_margin_are_left_out() -> None:
    one = scene(SCENARIO, 2)
    wide = predicted(one, margin_rad=np.radians(1.5))
    few = predicted(one, magnitude_limit=7.0, margin_rad=np.radians(1.5))
    np.testing.assert_array_equal(
        few.catalog_index, wide.catalog_index[CATALOG.magnitude[wide.catalog_index] <= 7.0]
    )
    outside = ~in_image(wide.xy_px, wide.camera)
    assert 0 < np.count_nonzero(outside) < len(outside)
    exact = predicted(one)
    np.testing.assert_array_equal(exact.catalog_index, wide.catalog_index[~outside])
    shown = wide.select(~outside)
    for column in ('catalog_index', 'direction_icrf', 'direction_camera', 'xy_px'):
        np.testing.assert_array_equal(getattr(shown, column), getattr(exact, column))
    assert shown.px_per_rad == exact.px_per_rad == SCENARIO.truth.camera.parameters[0]


def test_a_star_beyond_the_fold_of_the_lens_is_not_predicted_in_the_image() -> None:
    """The corners of this prior have no line of sight: beyond 42 degrees the radius decreases."""
    camera = CameraModel(800, 640, np.r_[550.0, 0.0, 550.0, 399.5, 319.5, -0.4, np.zeros(4)])
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    geometry = CameraGeometry(camera, upright)
    found = predict(geometry, upright, SCENARIO.start_ns, CATALOG, 9.0, margin_rad=0.1)
    sky = apparent_directions(CATALOG, SCENARIO.start_ns)
    ahead = sky[sky[:, 2] > np.cos(np.radians(50.0))]
    shown = np.count_nonzero(in_image(project(camera, ahead), camera, margin_px=55.0))
    assert 1000 < len(found.xy_px) < shown - 1000
    # The inverse ends at 1e-14 of the image plane, next to a fold with its root.
    mapped_back = line_of_sight(camera, found.xy_px)
    np.testing.assert_allclose(mapped_back, found.direction_camera, rtol=0, atol=1e-6)


def bent(xy_px: np.ndarray) -> np.ndarray:
    """Shift and barrel distortion up to 3 px."""
    uv = (xy_px - HALF_PX) / HALF_PX
    return np.asarray([0.5, -0.25] + uv * (uv**2).sum(axis=1, keepdims=True))


def test_a_polynomial_is_found_among_outliers() -> None:
    rng = np.random.default_rng(2)
    predicted_px = rng.uniform(0, 2 * HALF_PX, (200, 2))
    noise_px = rng.normal(0, 0.1, (200, 2))
    noise_px[::10] = rng.uniform(-8, 8, (20, 2))
    at_px = rng.uniform(50, 2 * HALF_PX - 50, (100, 2))
    measured_px = predicted_px + bent(predicted_px) + noise_px
    correction, scatter_px = fit_warp(predicted_px, measured_px, np.full(200, 0.1), at_px, HALF_PX)
    # 21 terms from 180 stars of 0.1 px: 0.035 px at a typical place, four of those.
    assert np.abs(correction - bent(at_px)).max() < 0.14
    # The sigma per axis, to 10 % from 200 stars; the outliers lift it by as much at most.
    assert 0.08 < scatter_px < 0.12


def test_a_polynomial_is_found_whatever_its_size() -> None:
    predicted_px = np.random.default_rng(3).uniform(0, 2 * HALF_PX, (200, 2))
    shift = bent(predicted_px) - np.median(bent(predicted_px), axis=0)
    one_px = shift / (np.median(np.hypot(*shift.T)) * RAYLEIGH_TO_SIGMA)
    for size in (0.5, 1.0, 2.0):
        measured_px = predicted_px + size * one_px
        sigma_px = np.full(200, 0.1)
        warp_px, scatter_px = fit_warp(predicted_px, measured_px, sigma_px, predicted_px, HALF_PX)
        assert np.abs(warp_px - size * one_px).max() < 1e-3 and scatter_px < 0.02


@pytest.mark.parametrize(('stars', 'degree'), [(4, 0), (12, 1), (36, 3), (150, 5)])
def test_few_stars_carry_few_terms(stars: int, degree: int) -> None:
    assert warp_degree(stars) == degree
    assert warp_degree(stars - 1) < degree or stars == 4
