# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Contradictions of priors, departures from the model and lost lines, each with its number."""

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from worlds import (  # type: ignore[import-not-found]
    campaign,
    displaced,
    each_image,
    estimate_of,
    estimated,
    HEIGHT,
    honesty,
    observed,
    of_random_pointings,
    WIDTH,
)

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.model_checks import detector_step, model_checks
from starcal_ros.constants import SPEED_OF_LIGHT_M_S
from starcal_ros.records import Amplitude, Ensemble, HeldTerm, ModelChecks, StarObservations
from studies import worlds

CORNER_PX = float(np.hypot(WIDTH, HEIGHT)) / 2.0
LIMIT_SIGMA = 5.0  # the gate's, of a held term


def held(checks: ModelChecks, name: str) -> HeldTerm:
    return next(term for term in checks.held if term.name == name)


def amplitude(checks: ModelChecks, name: str) -> Amplitude:
    """That of the maximum, which is another number than the size with its uncertainty."""
    return next(o for o in checks.amplitudes if o.name == f'{name}, most likely amplitude')


@functools.cache
def with_cx_off(off_px: float) -> tuple[Scenario, Ensemble]:
    """A campaign with a true principal point that is off the prior."""
    given = of_random_pointings(8)
    moved = given.truth.camera.replace(cx=float(given.prior.camera.parameters[3]) + off_px)
    truth = dataclasses.replace(given.truth, camera=moved)
    given = dataclasses.replace(given, truth=truth)
    return given, true_observations(given)


def test_a_sound_camera_contradicts_nothing_and_has_no_step() -> None:
    """Four campaigns: a ratio of 20 is a 1e-5 level, the least p-value under 1e-3 in 1 of 250."""
    for seed in range(1, 5):
        checks = model_checks(estimated(*observed(seed, images=6)))
        assert {'cx', 'cy'} <= {term.name for term in checks.held}
        # NaN, of what the stars alone do not determine, is no contradiction.
        assert not any(term.significance >= 4.5 for term in checks.held)
        assert all(one.likelihood_ratio < 20.0 for one in checks.amplitudes)
        assert checks.field_rms_px < 0.01 and checks.image_variation_px < 0.05
        assert checks.step.p_value > 1e-3


IS_HELD = {'estimate': ('fx', 'skew', 'fy', 'cy', 'distortion')}
HAS_NARROW_PRIOR = {'prior_sigma': tuple(2.0 if k in (3, 4) else 0.0 for k in range(10))}


@pytest.mark.parametrize(
    ('off_px', 'stated'),
    [(-30.0, IS_HELD), (3.0, IS_HELD), (30.0, HAS_NARROW_PRIOR)],
)
def test_a_principal_point_that_is_not_where_it_is_assumed_is_named(off_px, stated) -> None:
    given, ensemble = with_cx_off(off_px)
    checks = model_checks(estimated(given, ensemble, **stated))
    cx = held(checks, 'cx')
    assert cx.assumed == pytest.approx(given.prior.camera.parameters[3], abs=1e-9)
    # A field of tenths of a pixel takes the shift, and hid it from one step of the estimate.
    assert cx.significance > 2 * LIMIT_SIGMA
    assert cx.estimated - cx.assumed == pytest.approx(off_px, abs=1.5)
    assert stated is IS_HELD or held(checks, 'cy').significance < 3.0


def test_a_prior_that_is_right_is_not_contradicted_and_a_weak_one_moves_nothing() -> None:
    cx = held(model_checks(estimated(*with_cx_off(30.0))), 'cx')
    assert cx.estimated - cx.assumed == pytest.approx(30.0, abs=1.5)  # the stars know it to 0.3 px
    assert cx.sigma == pytest.approx(0.03 * WIDTH, rel=0.01)  # what the prior claims
    assert cx.significance < 1.0


WRONG_M_S = 60e3 * np.array([0.6, 0.0, -0.8])  # twice the Earth's: its sign is wrong


@pytest.mark.parametrize(
    ('sigma_m_s', 'least_sigmas'), [(8000.0, LIMIT_SIGMA), (10.0, 4 * LIMIT_SIGMA)]
)
def test_a_velocity_that_is_wrong_beyond_its_prior_is_in_the_sigma_and_named(
    sigma_m_s: float, least_sigmas: float
) -> None:
    """As without a topic, and given: a camera that changes between images takes its place."""
    given, ensemble = observed(9)

    def moved(_: int, image: StarObservations) -> dict[str, Floats]:
        e = image.direction_icrf + WRONG_M_S / SPEED_OF_LIGHT_M_S
        return {'direction_icrf': e / np.linalg.norm(e, axis=1)[:, None]}

    found = estimated(given, each_image(ensemble, moved), velocity_sigma_m_s=sigma_m_s)
    checks = model_checks(found)
    terms = [held(checks, f'velocity_{axis}_m_s') for axis in 'xyz']
    assert max(term.significance for term in terms) > least_sigmas
    assert np.linalg.norm([term.estimated for term in terms] + WRONG_M_S) < 0.1 * 60e3
    assert honesty(given, found, np.zeros_like)[0] < 2.0
    if sigma_m_s == 10.0:
        assert amplitude(checks, 'change from image to image').likelihood_ratio > 50.0


def test_a_time_of_readout_that_is_stated_wrong_is_named_beside_that_of_the_stars() -> None:
    """The record had the difference of both, and 0 as what is assumed."""
    world = worlds.World(rate_deg_s=0.42, row_s=20e-6, tracker_arcsec=5.0)
    found = estimate_of(campaign(world, 2), shutter='rolling', readout_s=-0.02)
    readout = held(model_checks(found), 'readout_s')
    assert readout.assumed == -0.02
    # By stars that know it to some milliseconds: 1024 rows of 20 us.
    assert readout.estimated == pytest.approx(0.0205, abs=0.005)
    assert readout.significance > 4.0


def test_the_step_the_field_and_the_predictions_are_in_the_record() -> None:
    given, ensemble = observed(6)

    def ripple(pixels: Floats) -> Floats:
        x, y = 4.0 * np.pi * pixels[:, 0] / WIDTH, 3.0 * np.pi * pixels[:, 1] / WIDTH
        return 0.3 * np.stack([np.sin(x + 0.3) * np.cos(y), np.cos(x - y)], axis=-1)

    checks = model_checks(estimated(given, displaced(ensemble, ripple)))
    field = amplitude(checks, 'field')
    assert field.likelihood_ratio > 100.0
    # 0.15 px rms along u, 0.21 along v; the lens and the alignment take a part.
    assert 0.08 < checks.field_rms_px < 0.25 < checks.field_worst_px < 1.5
    assert 0.05 < field.value < 0.5
    assert checks.step.p_value > 1e-6
    assert checks.predictions


def breathing(ensemble: Ensemble, scales: Floats) -> Ensemble:
    middle = np.array([WIDTH - 1, HEIGHT - 1]) / 2.0

    def scaled(k: int, image: StarObservations) -> dict[str, Floats]:
        return {'measured_px': image.measured_px + scales[k] * (image.measured_px - middle)}

    return each_image(ensemble, scaled)  # type: ignore[no-any-return]


@pytest.mark.slow
def test_a_focal_length_that_breathes_is_estimated_image_by_image() -> None:
    given, ensemble = observed(9)
    scales = np.random.default_rng(9).normal(size=12) * 3e-4  # a quarter of a pixel in a corner
    still = estimated(given, ensemble)
    found = estimated(given, breathing(ensemble, scales))
    checks = model_checks(found)
    change = amplitude(checks, 'change from image to image')
    assert change.likelihood_ratio > 100.0
    assert amplitude(model_checks(still), 'change from image to image').likelihood_ratio < 15.0
    focal_px = float(found.geometry.camera.parameters[0])
    assert checks.image_variation_px == pytest.approx(scales.std() * CORNER_PX, rel=0.5)
    # The shapes are those that were made, but for what the mean of twelve takes.
    shown = found.posterior.of_images[:, 3] / focal_px
    np.testing.assert_allclose(shown - shown.mean(), scales - scales.mean(), atol=4e-5)
    # The scale varies, the others do not.
    scale_px, *others_px = found.posterior.shapes.sigma_px
    assert max(others_px) < 0.1 * scale_px
    # The camera of one image scatters by that about the mean, which adds 1 in 12 of the variance;
    # what neighbours may share comes to it.
    assert 1.0 < found.covariance[0, 0] / scale_px**2 * 12.0 < 15.0
    # What is left of the stars is their noise again.
    np.testing.assert_allclose(
        found.residual_px[found.kept].std(), still.residual_px[still.kept].std(), rtol=0.02
    )


@pytest.mark.parametrize('sigma_m_s', [20e3, 10.0], ids=['not given', 'given'])
def test_a_lens_that_warms_is_no_velocity(sigma_m_s: float) -> None:
    """0.08 px in the corner: without a trend the velocity was 62 sigma off, a given one 12."""
    made = worlds.simulate(worlds.World(48, 'strip', tracker_arcsec=2.0), 1)
    scales = 6e-5 * np.sqrt(3.0) * np.linspace(-1.0, 1.0, 48)  # a ramp of unit rms
    made = dataclasses.replace(made, ensemble=breathing(made.ensemble, scales))
    found = estimate_of(made, shutter='global', velocity_sigma_m_s=sigma_m_s)
    mean, covariance = found.posterior.mean, found.posterior.covariance
    layout = found.linear.layout
    velocity, trend = layout.of(['velocity']), layout.of(['trend'])
    off_m_s = mean[velocity]
    chi2 = off_m_s @ np.linalg.solve(covariance[np.ix_(velocity, velocity)], off_m_s)
    assert chi2 < 16.3  # of three numbers, by chance in 1 of 1000
    sigma_px = float(covariance[trend, trend][0]) ** 0.5
    true_px = scales.std() * found.geometry.camera.parameters[0]
    assert abs(mean[trend][0] - true_px) < 3.0 * sigma_px < true_px  # shown, and to 3 sigma
    assert not any(term.significance >= 4.5 for term in model_checks(found).held)


def test_a_velocity_that_stars_show_to_no_possible_size_is_not_tested() -> None:
    """Three images with stars in a third of the detector show one component to 700 km/s."""
    given, ensemble = observed(9, images=3)
    images = tuple(
        image.select(np.abs(image.measured_px - [WIDTH / 2, HEIGHT / 2]).max(axis=1) < 200.0)
        for image in ensemble.images
    )
    found = estimated(given, Ensemble(images), method='per_image', velocity_sigma_m_s=8000.0)
    terms = [term for term in model_checks(found).held if 'velocity' in term.name]
    assert [np.isfinite(term.significance) for term in terms] == [True, True, False]


@pytest.mark.slow
def test_a_velocity_that_takes_the_place_of_a_tilt_is_no_contradiction() -> None:
    """A fisheye that looks one way has no tilt term; a field flat at the border left 6.8 sigma."""
    tilted = functools.partial(worlds.tilt, 0.1)
    lens: dict[str, Any] = {'model': 'equidistant', 'field_deg': 90.0, 'corner': -0.02}
    stars: dict[str, Any] = {'magnitude_limit': 5.3, 'zero_point_dn': 8e5, 'bright_px': 0.03}
    made = worlds.simulate(worlds.World(40, 'small', lens=tilted, **lens, **stars), 1)
    found = estimate_of(made, shutter='global')
    terms = [term for term in model_checks(found).held if 'velocity' in term.name]
    assert 3.0 < max(term.significance for term in terms) <= LIMIT_SIGMA


@pytest.mark.parametrize(
    ('across', 'moved', 'place_px', 'size_px'),
    [('u', 'u', 0.85 * WIDTH, -1.0), ('v', 'v', 0.5 * HEIGHT, -1.0), ('u', 'v', 400.0, 0.3)],
    ids=['a lost column', 'a lost row', 'columns shifted along themselves'],
)
def test_lines_that_are_lost_or_shifted_are_found_where_they_are(
    across: str, moved: str, place_px: float, size_px: float
) -> None:
    given, ensemble = observed(7)

    def shifted(pixels: Floats) -> Floats:
        beyond = pixels[:, 'uv'.index(across)] > place_px
        return np.outer(beyond, size_px * (np.array(['u', 'v']) == moved))

    step = detector_step(estimated(given, displaced(ensemble, shifted)))
    assert (step.across, step.moved) == (across, moved) and step.p_value < 1e-6
    assert abs(step.place_px - place_px) < 0.8 * WIDTH / 97 + 2.0  # of the places, and the stars
    assert 0.3 < step.size_px / size_px < 1.0  # the field takes the rest
