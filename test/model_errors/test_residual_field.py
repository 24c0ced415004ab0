# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The field beside the lens model: its basis, its test, its estimate with a true sigma."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from random_pointings import (  # type: ignore[import-not-found]
    displaced,
    estimated,
    HEIGHT,
    honesty,
    of_random_pointings,
    WIDTH,
)

from starcal_ros.arrays import Floats
from starcal_ros.assessment.model_checks import model_checks
from starcal_ros.camera import line_of_sight, pixel_grid, project
from starcal_ros.detector_field import basis, degrees, DetectorField
from starcal_ros.records import Ensemble
from starcal_ros.simulation.centroids import true_observations
from starcal_ros.simulation.scenario import Scenario, scenario


def ripple(pixels: Floats) -> Floats:
    """0.2 px rms, waves of half the detector, that no lens model has."""
    x, y = 4.0 * np.pi * pixels[:, 0] / WIDTH, 3.0 * np.pi * pixels[:, 1] / WIDTH
    return 0.3 * np.stack([np.sin(x + 0.3) * np.cos(y), np.cos(x - y)], axis=-1)


def test_the_basis_is_orthonormal_over_the_detector() -> None:
    nodes, weights = np.polynomial.legendre.leggauss(12)
    u, v = np.meshgrid((nodes + 1) * WIDTH / 2 - 0.5, (nodes + 1) * HEIGHT / 2 - 0.5)
    phi = basis(np.stack([u.ravel(), v.ravel()], -1), WIDTH, HEIGHT, 8)
    weight = np.outer(weights, weights).ravel() / 4.0
    # Gauss-Legendre is exact for these degrees: what is left is rounding.
    np.testing.assert_allclose((phi.T * weight) @ phi, np.eye(phi.shape[1]), atol=1e-12)


def test_a_camera_with_a_field_projects_what_it_sees() -> None:
    given = scenario('small', 1).truth.camera
    rng = np.random.default_rng(2)
    coefficients = 0.2 * rng.normal(size=(2, len(degrees(5))))
    camera = dataclasses.replace(given, field=DetectorField(WIDTH, HEIGHT, 5, coefficients))
    pixels = pixel_grid(camera, 9, 7)
    # Twelve steps of a contraction by 0.05 and less leave under 1e-9 px.
    np.testing.assert_allclose(
        project(camera, line_of_sight(camera, pixels)), pixels, rtol=0, atol=1e-9
    )


def test_a_sound_camera_gets_a_field_no_more_often_than_the_p_value_says() -> None:
    """Forty cameras: p-values under 10 % in 4 of them; 11 and more has a probability of 1e-3."""
    small = [estimated(*_sound(seed)).field_test for seed in range(1, 41)]
    p_values = np.array([test.p_value for test in small if test is not None])
    assert len(p_values) == 40
    assert (p_values < 0.1).sum() <= 10
    assert p_values.min() > 1e-5


def _sound(seed: int) -> tuple[Scenario, Ensemble]:
    given = of_random_pointings(seed, images=4)
    return given, true_observations(given)


def test_what_no_star_shows_is_in_the_sigma_and_moves_nothing() -> None:
    given, ensemble = _sound(3)
    found = estimated(given, ensemble)
    bare = estimated(given, ensemble, residual_field=False)
    assert found.geometry.camera.field is not None and not found.geometry.camera.has_field
    np.testing.assert_array_equal(
        found.geometry.camera.parameters, bare.geometry.camera.parameters
    )
    # A sound camera pays less than a third of its sigma for it.
    assert 1.0 < honesty(given, bare, _nothing)[0] / honesty(given, found, _nothing)[0] < 1.3


def test_a_lens_error_that_the_test_may_miss_is_in_the_sigma() -> None:
    """An error that the test finds in two of twenty campaigns: without, 1.14 sigma, with, 1.00."""
    ratios, bare_ratios = [], []
    for seed in range(1, 21):
        given = of_random_pointings(seed, images=4)
        ensemble = displaced(true_observations(given), _faint)
        found = estimated(given, ensemble)
        ratios.append(honesty(given, found, _faint)[0])
        bare = estimated(given, ensemble, residual_field=False)
        bare_ratios.append(honesty(given, bare, _faint)[0])
    rms, bare_rms = (float(np.sqrt(np.mean(np.square(r)))) for r in (ratios, bare_ratios))
    # Ten degrees of freedom a campaign, common to both: the ratio of the two is a few per cent.
    assert rms < 0.95 * bare_rms and 0.7 < rms < 1.25


def _nothing(pixels: Floats) -> Floats:
    return np.zeros_like(pixels)


def _faint(pixels: Floats) -> Floats:
    """A thin prism of 4th order, 0.02 px in a corner when the lens model has fitted it."""
    from_centre = (pixels - [(WIDTH - 1) / 2, (HEIGHT - 1) / 2]) / np.hypot(WIDTH, HEIGHT)
    r2 = 4.0 * (from_centre**2).sum(axis=1)
    return 0.06 * np.stack([r2 * (r2 - 0.6), 0.0 * r2], axis=-1)


@pytest.mark.parametrize('method', ['hierarchical', 'per_image', 'single'])
def test_a_lens_error_is_estimated_with_a_true_sigma(method: str) -> None:
    given = of_random_pointings(5)
    if method == 'single':  # which takes the star tracker as perfect
        given = dataclasses.replace(given, star_tracker_sigma_arcsec=(1e-3,) * 3)
    ensemble = displaced(true_observations(given), ripple)
    found = estimated(given, ensemble, method=method)
    assert found.geometry.camera.field is not None
    ratio, error_arcsec = honesty(given, found, ripple)
    # A hundred degrees of freedom scatter the ratio by a tenth; the limits are those of trust.
    assert 0.7 < ratio < 1.5
    bare = estimated(given, ensemble, method=method, residual_field=False)
    assert honesty(given, bare, ripple)[1] > 5 * error_arcsec


def test_a_dominant_wave_is_found() -> None:
    """A product of two waves, as a figure error has."""
    given = of_random_pointings(4, images=6)
    numbers = 5.0, 6.5  # rad per half length of the longer side

    def figure(pixels: Floats) -> Floats:
        x, y = ((2.0 * pixels[:, k] / WIDTH) * numbers[k] for k in (0, 1))
        return 0.3 * np.stack([np.sin(x + 0.3) * np.cos(y), np.cos(x) * np.sin(y + 1.0)], axis=-1)

    found = estimated(given, displaced(true_observations(given), figure))
    prior = found.problem.field_prior
    assert prior is not None
    for wave in prior.waves:
        assert wave is not None
        # A wave of 2 periods over the detector has a line 1.6 rad per half length wide.
        np.testing.assert_allclose([wave.along_u, wave.along_v], numbers, atol=0.8)
    # Twenty degrees of freedom scatter the ratio by a fifth.
    assert 0.5 < honesty(given, found, figure)[0] < 1.5


def test_a_needed_field_that_is_not_estimated_is_known() -> None:
    given = of_random_pointings(6)
    found = estimated(given, displaced(true_observations(given), ripple), residual_field=False)
    assert found.geometry.camera.field is None
    checks = model_checks(found)
    assert checks.field_p_value < 1e-12 and checks.field_rms_px == 0.0


def test_lost_columns_are_found_where_they_are() -> None:
    given = of_random_pointings(7)

    def lost(pixels: Floats) -> Floats:
        return np.stack([-(pixels[:, 0] > 648.0).astype(float), 0.0 * pixels[:, 1]], axis=-1)

    step = model_checks(estimated(given, displaced(true_observations(given), lost))).step
    assert (step.across, step.moved) == ('u', 'u') and step.p_value < 1e-9
    assert abs(step.place_px - 648.0) < 0.8 * WIDTH / 30  # the places looked at lie as far apart
    assert abs(step.size_px) > 0.5


def test_a_held_principal_point_that_is_wrong_is_named() -> None:
    given = of_random_pointings(8)
    true = given.truth.camera
    cx = float(true.intrinsics[3]) + 15.0
    given = dataclasses.replace(
        given, truth=dataclasses.replace(given.truth, camera=true.replace(cx=cx))
    )
    found = estimated(
        given,
        true_observations(given),
        estimate=('fx', 'skew', 'fy', 'cy', 'distortion'),
        residual_field=False,
    )
    (held,) = [term for term in model_checks(found).held if term.name == 'cx']
    assert held.significance > 10
    assert abs(held.asked - cx) < 5 * held.sigma


def test_images_of_one_pointing_that_repeat_their_errors_count_once() -> None:
    given = of_random_pointings(10, images=3)
    once = true_observations(given)
    copies = [
        dataclasses.replace(image, time_ns=image.time_ns + k)
        for image in once.images
        for k in range(5)
    ]
    found, alone = (estimated(given, Ensemble(tuple(images))) for images in (copies, once.images))
    assert found.pointings == 3
    # All errors come again: five images are worth one.
    np.testing.assert_allclose(found.repetition[found.kept], 5.0, rtol=0.05)
    np.testing.assert_allclose(
        np.sqrt(found.covariance[0, 0] / alone.covariance[0, 0]), 1.0, rtol=0.2
    )
