# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated pixels against analytic truth and noise statistics."""

import dataclasses
import math

import numpy as np
import pytest
from sample_sky import QUIET  # type: ignore[import-not-found]

from starcal_ground.simulation.rendering import (
    cosmic_ray_electrons,
    expose,
    fixed_pattern,
    render,
    star_electrons,
)
from starcal_ground.simulation.scenario import scenario, scene
from starcal_ros.camera import project


@pytest.mark.parametrize('sigma_px', [0.6, 0.95, 1.5])
def test_a_star_has_its_flux_at_its_place(sigma_px) -> None:
    pixels = np.array([[20.0, 21.0], [41.3, 20.8], [19.5, 44.5], [45.02, 47.77]])
    flux = np.array([1e4, 2e4, 3e4, 4e4])
    image = star_electrons(pixels, flux, sigma_px, (64, 70))
    v, u = np.mgrid[:64, :70]
    for (u0, v0), electrons in zip(pixels, flux, strict=True):
        near = image * (np.hypot(u - u0, v - v0) < 11)
        # 6 sigma stamps: 2e-9 of the light is left out on each side.
        assert near.sum() == pytest.approx(electrons, rel=1e-8)
        # Sampling at one pixel moves the centre of intensity by exp(-2 pi^2 sigma^2) / pi px
        # (the first alias): 3e-4 px for the sharpest of these.
        alias_px = math.exp(-2 * math.pi**2 * sigma_px**2) / math.pi
        assert abs((near * u).sum() / near.sum() - u0) < 1.01 * alias_px + 1e-7
        assert abs((near * v).sum() / near.sum() - v0) < 1.01 * alias_px + 1e-7


def test_a_pixel_holds_the_integral_of_the_gaussian_which_the_border_cuts() -> None:
    image = star_electrons(np.array([[10.3, 9.6]]), np.array([1.0]), 0.95, (20, 20))
    fine = (np.arange(-500, 500) + 0.5) / 1000
    along_u = np.exp(-((11 + fine - 10.3) ** 2) / (2 * 0.95**2))
    along_v = np.exp(-((8 + fine - 9.6) ** 2) / (2 * 0.95**2))
    expected = along_u.mean() * along_v.mean() / (2 * math.pi * 0.95**2)
    assert image[8, 11] == pytest.approx(expected, rel=1e-6)  # midpoint rule with 1e-3 px steps
    # A star on the outer edge of the border pixels leaves one half inside.
    pixels = np.array([[-0.5, 10.0], [30.0, 19.5], [-50.0, -50.0]])
    image = star_electrons(pixels, np.array([1000.0, 500.0, 1e6]), 1.0, (20, 40))
    assert image.sum() == pytest.approx(500 + 250, rel=1e-8)


def test_noise_has_the_mean_and_variance_of_its_sources() -> None:
    detector = dataclasses.replace(QUIET, electrons_per_dn=2.0, read_noise_electrons=5.0)
    count = 400_000
    for mean in (0.0, 4.5, 200.0):
        counts = expose(np.full((400, 1000), mean), detector, np.random.default_rng(3))
        electrons = (counts.astype(np.float64) - detector.offset_dn) * detector.electrons_per_dn
        variance = mean + 5.0**2 + 2.0**2 / 12  # photons, reading, rounding
        # Five standard errors of a mean, and of a variance of nearly Gaussian noise.
        assert abs(electrons.mean() - mean) < 5 * math.sqrt(variance / count)
        assert abs(electrons.var() / variance - 1) < 5 * math.sqrt(2 / count)


@pytest.mark.parametrize(('bits', 'dtype'), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_the_converter_saturates(bits, dtype) -> None:
    detector = dataclasses.replace(QUIET, bits=bits)
    counts = expose(np.array([[1e7, 0.0]]), detector, np.random.default_rng(5))
    assert counts.dtype == dtype
    assert counts[0, 0] == 2**bits - 1
    dark = dataclasses.replace(detector, offset_dn=-1000.0)
    assert expose(np.zeros((2, 2)), dark, np.random.default_rng(5)).max() == 0


def test_hot_pixels_stay_where_they_are() -> None:
    tiny = scenario('tiny')
    pattern = fixed_pattern(tiny)
    hot = pattern > tiny.detector.background_electrons
    assert hot.sum() == round(tiny.detector.hot_fraction * pattern.size)
    assert np.array_equal(pattern, fixed_pattern(tiny))
    hottest = pattern > 1000
    expected = tiny.detector.offset_dn + pattern[hottest].mean() / tiny.detector.electrons_per_dn
    for index in (0, 1):
        pixels = render(tiny, scene(tiny, index), index, pattern).pixels
        # Photon noise of a kilo-electron and 8 e- reading over some ten pixels: 2 per cent.
        assert pixels[hottest].mean() == pytest.approx(expected, rel=0.1)


def test_cosmic_rays_leave_tracks() -> None:
    detector = dataclasses.replace(QUIET, cosmic_rays=50.0)
    signal = cosmic_ray_electrons(detector, (512, 640), np.random.default_rng(6))
    lit = np.count_nonzero(signal)
    # Tracks of 4 px in the mean, 50 of them, less those over the border: several pixels each.
    assert 100 < lit < 1000
    # Log-normal charge: mean 3000 exp(0.7^2 / 2) = 3833 e- a track; 50 +- 7 tracks of it.
    assert 50 * 3833 * 0.5 < signal.sum() < 50 * 3833 * 1.5
    none = dataclasses.replace(QUIET, cosmic_rays=0.0)
    assert not cosmic_ray_electrons(none, (512, 640), np.random.default_rng(6)).any()


def test_an_image_is_the_same_whatever_was_made_before() -> None:
    tiny = scenario('tiny', 7)
    alone = render(tiny, scene(tiny, 3), 3)
    render(tiny, scene(tiny, 2), 2)
    again = render(scenario('tiny', 7), scene(tiny, 3), 3, fixed_pattern(tiny))
    assert alone.time_ns == again.time_ns
    assert np.array_equal(alone.pixels, again.pixels)
    other = dataclasses.replace(tiny, seed=8)
    assert not np.array_equal(alone.pixels, render(other, scene(other, 3), 3).pixels)


def test_rendered_stars_stand_where_the_camera_puts_them() -> None:
    tiny = scenario('tiny')
    shown = scene(tiny, 4)
    pixels = render(tiny, shown, 4).pixels.astype(np.float64)
    directions = shown.direction_icrf @ shown.camera_from_icrf.T
    assert np.allclose(project(tiny.truth.camera, directions), shown.pixel_px, atol=1e-9)
    inside = (shown.pixel_px > 10).all(axis=1) & (shown.pixel_px < [629, 501]).all(axis=1)
    bright = np.flatnonzero(inside)[np.argsort(shown.magnitude[inside])[:10]]
    detector = tiny.detector
    mean = star_electrons(shown.pixel_px, shown.flux_electrons, detector.psf_sigma_px, (512, 640))
    for k in bright:
        u, v = np.rint(shown.pixel_px[k]).astype(int)
        window = np.s_[v - 3 : v + 4, u - 3 : u + 4]
        star = (pixels[window] - detector.offset_dn) * detector.electrons_per_dn
        star -= detector.background_electrons
        expected = mean[window].sum()
        assert expected > 0.99 * shown.flux_electrons[k]  # with what neighbours add
        noise = math.sqrt(expected + star.size * detector.noise_electrons**2)
        assert abs(star.sum() - expected) < 5 * noise
