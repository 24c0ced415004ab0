# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Frames that are no textbook: cut off at black, masked, undersampled, sloping, of faint stars."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from sample_sky import corona, measured, modelled, QUIET, star_grid  # type: ignore[import-not-found]

from starcal_ground.bags import reader
from starcal_ground.simulation.rendering import expose, star_electrons
from starcal_ros.arrays import Floats, Pixels
from starcal_ros.records import Image, StarRefusal
from starcal_ros.stars.centroiding import measure_stars
from starcal_ros.stars.detection import (
    Background,
    detect,
    detectable_count,
    measure_background,
    sample_background,
    sample_mesh,
)
from starcal_ros.stars.frame_checks import fingerprint, sample_rows, screen, ScreeningOptions
from starcal_ros.stars.image_model import CentroidOptions
from starcal_ros.stars.pixel_noise import NoiseSums

SHAPE = (512, 640)
WISPR = Path(__file__).parents[4] / 'shared' / 'realsky' / 'wispr_i_2022'


@pytest.mark.parametrize('measure', [measure_background, sample_background])
def test_noise_cut_off_at_black_is_that_of_its_upper_half(measure: object) -> None:
    # Noise of 2 DN about a pedestal of -1 DN: 60 % of the pixels are at zero.
    noise = np.random.default_rng(1).normal(-1.0, 2.0, SHAPE)
    pixels = np.clip(np.rint(noise), 0, 255).astype(np.uint8)
    background: Background = measure(pixels)  # type: ignore[operator]
    # The 2-sigma quantile is 3 DN, above a median of 0.
    assert 1.3 <= background.noise_dn <= 2.1


def test_a_black_sky_has_few_false_sources() -> None:
    # A sky at -2 sigma: one pixel in 20 is above black.
    noise = np.random.default_rng(2).normal(-1.0, 0.9, SHAPE)
    pixels = np.clip(np.rint(noise), 0, 255).astype(np.uint8)
    sources = detect(pixels, measure_background(pixels))
    assert len(sources.snr) <= 10


@pytest.mark.parametrize('read_noise', [1.0, 3.0], ids=['under half a step', 'over a step'])
@pytest.mark.parametrize('step_dn', [1, 16, 17, 257], ids='step of {}'.format)
def test_values_that_step_are_measured_as_those_of_fewer_bits(step_dn, read_noise) -> None:
    """8 bits in the high ones of 12 (16) or scaled to 16 (257): the sigma is that of 8 bits."""
    xy = star_grid(3, 32)
    detector = dataclasses.replace(
        QUIET, bits=8, read_noise_electrons=read_noise, electrons_per_dn=3.0, offset_dn=10.0
    )
    flux = np.random.default_rng(4).uniform(50.0, 6000.0, len(xy))
    shown = expose(star_electrons(xy, flux, 0.95, SHAPE), detector, np.random.default_rng(5))
    assert shown.max() == 255
    stepped = shown.astype(np.uint16) * step_dn
    sample = sample_rows(stepped)
    mark = fingerprint(Image(1, stepped), sample)
    screen(sample, mark, None, 0.0, None, ScreeningOptions())
    for measure in (measure_background, sample_background):
        scaled = measure(stepped).noise_dn / step_dn
        assert scaled == pytest.approx(measure(shown).noise_dn, rel=1e-5)
    expected, found = measured(shown, xy), measured(stepped, xy)
    np.testing.assert_array_equal(found.refusal, expected.refusal)
    # Single precision of the background, whose level is 10 steps: 1e-6 of a step.
    good = expected.refusal == StarRefusal.NONE
    assert np.count_nonzero(good) > 150
    np.testing.assert_allclose(found.xy_px[good], expected.xy_px[good], rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        found.covariance_px2[good], expected.covariance_px2[good], rtol=1e-3, atol=1e-9
    )


def test_a_masked_border_does_not_raise_the_noise() -> None:
    pixels = np.random.default_rng(3).normal(1000.0, 20.0, SHAPE).round().astype(np.uint16)
    whole = measure_background(pixels)
    masked = pixels.copy()
    masked[:14], masked[-9:], masked[:, -20:] = 0, 0, 0
    found = measure_background(masked)
    at_edges = np.array([[300.0, 16.0], [610.0, 250.0], [300.0, 500.0]])
    for name in ('noise_mesh', 'level_mesh'):
        at = [sample_mesh(getattr(one, name), SHAPE, at_edges) for one in (found, whole)]
        # A cell of 200 samples tells its noise to 5 % and its level to 1.4 DN.
        assert at[0] == pytest.approx(at[1], rel=0.15)


def test_undersampled_stars_are_found_and_their_covariance_holds() -> None:
    # Half of the light of a star in the middle of a pixel is in that pixel.
    detector = dataclasses.replace(QUIET, psf_sigma_px=0.47)
    squared, found_share = [], []
    for seed in range(4):
        xy = star_grid(seed, 32)
        mean = star_electrons(xy, np.full(len(xy), 6000.0), detector.psf_sigma_px, SHAPE)
        rng = np.random.default_rng([seed, 1])
        pixels = expose(mean + detector.background_electrons, detector, rng)
        sources = detect(pixels, measure_background(pixels))
        nearest = np.linalg.norm(xy[:, None] - sources.xy_px[None], axis=2).min(axis=1)
        found_share.append((nearest < 1.0).mean())
        found = measured(pixels, xy)
        good = found.refusal == StarRefusal.NONE
        assert good.mean() > 0.95
        error = found.xy_px - xy
        squared.append(error[good] ** 2 / found.covariance_px2[good][:, [0, 2]])
    assert min(found_share) > 0.97
    # 1000 stars: 1.6 %.  The width of the PSF itself is known to 2 %.
    assert np.sqrt(np.concatenate(squared).mean()) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize('slope', [0.1, 0.5])
def test_a_steady_slope_is_subtracted(slope: float) -> None:
    # In noise per pixel: without it, a slope of 0.5 pulls every star by two of its sigmas.
    detector = dataclasses.replace(QUIET, psf_sigma_px=1.0, bits=16)
    normalised, signed = [], []
    for seed in range(3):
        xy = star_grid(seed, 32)
        mean = star_electrons(xy, np.full(len(xy), 2500.0), detector.psf_sigma_px, SHAPE)
        dark = np.full(SHAPE, detector.background_electrons)
        noise_dn = measure_background(expose(dark, detector, np.random.default_rng(0))).noise_dn
        sky = dark + slope * noise_dn * detector.electrons_per_dn * np.arange(SHAPE[1])
        pixels = expose(mean + sky, detector, np.random.default_rng([seed, 1]))
        found = measured(pixels, xy)
        good = found.refusal == StarRefusal.NONE
        assert good.mean() > 0.8
        error = (found.xy_px - xy)[good] / np.sqrt(found.covariance_px2[good][:, [0, 2]])
        normalised.append(error**2)
        signed.append(error[:, 0])
    # 600 stars: a mean to 0.04 sigma, an rms to 2 %.
    assert abs(np.concatenate(signed).mean()) < 0.15
    assert np.sqrt(np.concatenate(normalised).mean()) == pytest.approx(1.0, abs=0.12)


@pytest.mark.parametrize('scale_px', [30.0, 60.0])
def test_light_that_the_mesh_does_not_show_pulls_no_star(scale_px: float) -> None:
    # An amplifier's glow of 200 DN at an edge; with a level alone the mean at 60 px is 0.9 sigma.
    detector = dataclasses.replace(QUIET, bits=16)
    glow = 200.0 * detector.electrons_per_dn * np.exp(-np.arange(SHAPE[1]) / scale_px)
    errors = []
    for seed in range(3):
        xy = star_grid(seed)
        light = star_electrons(xy, np.full(len(xy), 4000.0), detector.psf_sigma_px, SHAPE)
        sky = light + glow + detector.background_electrons
        pixels = expose(sky, detector, np.random.default_rng([seed, 1]))
        model = dataclasses.replace(modelled(pixels), background=sample_background(pixels))
        found = measure_stars(pixels, xy, model, CentroidOptions())
        lit = (found.refusal == StarRefusal.NONE) & (xy[:, 0] < 3.0 * scale_px)
        errors.append((found.xy_px - xy)[lit] / np.sqrt(found.covariance_px2[lit][:, [0, 2]]))
    error = np.concatenate(errors)
    # Over 120 stars: a mean to 0.09 sigma.  The noise of the model contains the glow already.
    assert len(error) > 120 and abs(error[:, 0].mean()) < 0.25
    assert 0.8 < np.sqrt((error**2).mean()) < 1.12


def test_the_gain_is_no_refuge_for_an_error_of_the_psf() -> None:
    # Two regressors that nearly coincide: the one that shows less is left out.
    rng = np.random.default_rng(5)
    signal = rng.uniform(500.0, 3000.0, 400)
    columns = np.stack([np.full(400, 25.0), signal, signal * 9000.0])
    truth = np.array([1.0, 0.0, 0.0004])
    variance = truth @ columns
    weight = 1.0 / variance
    squared = variance * rng.chisquare(1, 400)
    A = columns * weight
    noise = NoiseSums(A @ A.T, A @ (squared * weight)).pixel_noise()
    modelled = 25.0 * noise.background + signal / noise.gain_e_per_dn
    modelled += noise.psf_error**2 * signal * 9000.0
    # Either explains the pixels; their variance is what must be right, to 7 % of 400 squares.
    assert (modelled / variance).mean() == pytest.approx(1.0, abs=0.2)


def test_a_steep_sky_is_measured_in_small_cells() -> None:
    small = measure_background(corona()).level_mesh
    assert (sample_background(corona()).level_mesh == small).all()
    flat = np.random.default_rng(7).normal(500.0, 5.0, corona().shape).astype(np.uint16)
    assert sample_background(flat).level_mesh.size < small.size


@pytest.mark.skipif(not WISPR.exists(), reason='images of others, not part of the tree')
def test_stars_beside_the_corona_are_measured() -> None:
    """Two images of a telescope near the Sun, whose sky spans a factor of 200."""
    for image in reader.read_images([WISPR], '/opnav/image_raw'):
        assert isinstance(image, Image)
        sample = sample_rows(image.pixels)
        screen(sample, fingerprint(image, sample), None, 0.0, None, ScreeningOptions())
        found = detect(image.pixels, measure_background(image.pixels))
        assert len(found.snr) > 300


NOISE_DN, PSF_PX, MIN_SNR = 4.0, 0.9, 5.0


def sky(seed: int, brightest_snr: float) -> tuple[Floats, Floats, Pixels]:
    """Places (n, 2) of stars in squares of their own, ratios (n,) to the sky's noise, an image."""
    rng = np.random.default_rng(seed)
    xy = rng.permutation(star_grid(seed, 16, (1024, 1024)))[:3600]
    snr = brightest_snr * 10.0 ** (-3.0 * np.arange(len(xy)) / len(xy))  # 7.5 mag
    flux_dn = snr * NOISE_DN * np.sqrt(4.0 * np.pi * PSF_PX**2)
    light = star_electrons(xy, flux_dn, PSF_PX, (1024, 1024))
    shown = np.rint((light + rng.normal(100.0, NOISE_DN, light.shape)).clip(0.0, 4095.0))
    return xy, snr, shown.astype(np.uint16)


def kept(pixels: Pixels, xy: Floats) -> int:
    return detectable_count(pixels, xy, measure_background(pixels), MIN_SNR)


@pytest.mark.parametrize('seed', [0, 3])
def test_the_stars_left_out_are_far_below_the_noise(seed: int) -> None:
    xy, snr, pixels = sky(seed, 60.0)
    count = kept(pixels, xy)
    assert count < len(xy)
    # Its 3 x 3 pixels have two thirds of the ratio of a fit: the first dark group has 0.4.
    assert snr[count] < 0.1 * MIN_SNR


def test_few_stars_and_stars_that_show_are_all_kept() -> None:
    xy, _, pixels = sky(7, 2000.0)  # the faintest at 2 sigma
    assert kept(pixels, xy) == len(xy)
    empty = np.full((64, 64), 100, np.uint16)
    assert [kept(empty, np.full((count, 2), 30.0)) for count in (200, 0)] == [200, 0]


def test_a_saturated_neighbour_or_hot_pixel_darkens_no_group() -> None:
    xy, snr, pixels = sky(8, 60.0)
    whole = kept(pixels, xy)
    # One in thirty windows has a lit pixel in its border.
    u, v = np.rint(xy[::30]).astype(int).T
    pixels[v + 3, u] = 4095
    spoilt = kept(pixels, xy)
    # It takes 3 sigma from 8 of 256 stars, 0.1 of their mean, which falls by a quarter a group.
    assert abs(spoilt - whole) <= 2 * 256
    assert snr[spoilt] < 0.2 * MIN_SNR
