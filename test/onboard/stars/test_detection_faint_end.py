# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Stars that no fit could measure are left out, and no others."""

from __future__ import annotations

import numpy as np
import pytest

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.stars.detection import detectable_count, measure_background
from starcal_ros.stars.psf_fit import light_in_stamps

SIDE_PX, APART_PX, NOISE_DN, PSF_PX = 1024, 16, 4.0, 0.9
MIN_SNR = 5.0


def places(rng: np.random.Generator) -> Floats:
    """Pixels (3600, 2) of stars, each alone in its square."""
    middles = np.arange(APART_PX * 2, SIDE_PX - APART_PX * 2, APART_PX)
    grid = np.stack(np.meshgrid(middles, middles), axis=-1).reshape(-1, 2)
    return np.asarray(rng.permutation(grid) + rng.uniform(-0.5, 0.5, grid.shape))


def image_of(xy_px: Floats, flux_dn: Floats, rng: np.random.Generator) -> Pixels:
    pixels = rng.normal(100.0, NOISE_DN, (SIDE_PX, SIDE_PX))
    centre = np.rint(xy_px).astype(int)
    stamps = light_in_stamps(xy_px - centre, flux_dn, np.full(len(xy_px), PSF_PX), 9)
    for (u, v), light in zip(centre, stamps.reshape(-1, 9, 9), strict=True):
        pixels[v - 4 : v + 5, u - 4 : u + 5] += light
    shown: Pixels = np.rint(pixels.clip(0.0, 4095.0)).astype(np.uint16)
    return shown


def fluxes(brightest_snr: float, count: int) -> tuple[Floats, Floats]:
    """Fluxes (n,) that fall by 7.5 mag, and their signal-to-noise ratios: sky noise alone."""
    snr = brightest_snr * 10.0 ** (-3.0 * np.arange(count) / count)
    return snr * NOISE_DN * np.sqrt(4.0 * np.pi * PSF_PX**2), snr


@pytest.mark.parametrize('seed', range(5))
def test_the_stars_left_out_are_far_below_the_noise(seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = places(rng)
    flux, snr = fluxes(60.0, len(xy))
    pixels = image_of(xy, flux, rng)
    count = detectable_count(pixels, xy, measure_background(pixels), MIN_SNR)
    assert count < len(xy)
    # Its 3 x 3 pixels have two thirds of the ratio of a fit: the first dark group has 0.4.
    assert snr[count] < 0.1 * MIN_SNR


def test_stars_that_show_are_all_kept() -> None:
    rng = np.random.default_rng(7)
    xy = places(rng)
    flux, _ = fluxes(2000.0, len(xy))  # the faintest at 2 sigma
    pixels = image_of(xy, flux, rng)
    assert detectable_count(pixels, xy, measure_background(pixels), MIN_SNR) == len(xy)


def test_a_saturated_neighbour_or_hot_pixel_darkens_no_group() -> None:
    rng = np.random.default_rng(8)
    xy = places(rng)
    flux, snr = fluxes(60.0, len(xy))
    pixels = image_of(xy, flux, rng)
    whole = detectable_count(pixels, xy, measure_background(pixels), MIN_SNR)
    # One in thirty windows has a lit pixel in its border.
    u, v = np.rint(xy[::30]).astype(int).T
    pixels[v + 3, u] = 4095
    spoilt = detectable_count(pixels, xy, measure_background(pixels), MIN_SNR)
    # It takes 3 sigma from 8 of 256 stars, 0.1 of their mean, which falls by a quarter a group.
    assert abs(spoilt - whole) <= 2 * 256
    assert snr[spoilt] < 0.2 * MIN_SNR


def test_few_stars_are_all_measured() -> None:
    pixels = np.full((64, 64), 100, np.uint16)
    xy = np.full((200, 2), 30.0)
    assert detectable_count(pixels, xy, measure_background(pixels), MIN_SNR) == 200
    assert detectable_count(pixels, xy[:0], measure_background(pixels), MIN_SNR) == 0
