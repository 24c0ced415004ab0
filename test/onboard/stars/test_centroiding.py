# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Centroids of rendered stars: the Cramer-Rao bound, true covariances, no bias, good refusals."""

from collections import Counter
import dataclasses
import math

import numpy as np
import pytest
from sample_sky import measured, modelled, QUIET, star_grid  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import centroid_bound
from starcal_ground.simulation.rendering import expose, star_electrons
from starcal_ground.simulation.scenario import Detector
from starcal_ros.records import StarRefusal
from starcal_ros.stars import psf_fit
from starcal_ros.stars.centroiding import Centroids, measure_stars, shape_changed
from starcal_ros.stars.detection import detect, measure_background, sample_mesh
from starcal_ros.stars.image_model import CentroidOptions, model_image, saturation_level
from starcal_ros.stars.pixel_noise import blurred_px, PixelNoise, quantisation_step_dn
from starcal_ros.stars.psf_fit import fit_psf, noise_sums

SHAPE = (512, 640)
PSF, MOMENT = CentroidOptions(), CentroidOptions(centroid='moment')


def unlike_fluxes(seed: int, n: int) -> np.ndarray:
    """Electrons (n,) of stars over four magnitudes."""
    return np.asarray(300.0 * 50.0 ** np.random.default_rng([seed, 2]).uniform(size=n))


def exposed(
    seed: int, xy: np.ndarray, flux: np.ndarray, detector: Detector, more: float | np.ndarray = 0.0
) -> np.ndarray:
    """An image of stars of a flux (n,) in electrons, with more light added."""
    mean = star_electrons(xy, np.asarray(flux, float), detector.psf_sigma_px, SHAPE)
    return expose(
        mean + detector.background_electrons + more, detector, np.random.default_rng([seed, 1])
    )


def used(found: Centroids) -> np.ndarray:
    return np.asarray(found.refusal == StarRefusal.NONE)


def squares(found: Centroids, xy: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Squared errors (k, 2) of some stars over their variances."""
    return np.asarray((found.xy_px - xy)[good] ** 2 / found.covariance_px2[good][:, [0, 2]])


def rms(squared: list[np.ndarray]) -> float:
    return float(np.sqrt(np.concatenate(squared).mean()))


@pytest.mark.parametrize(
    ('psf_sigma_px', 'bits'), [(0.7, 8), (0.7, 12), (0.95, 12), (1.3, 8), (2.0, 12)]
)
def test_the_fit_reaches_the_cramer_rao_bound(psf_sigma_px: float, bits: int) -> None:
    detector = dataclasses.replace(QUIET, psf_sigma_px=psf_sigma_px)
    if bits == 8:  # the same stars on 256 steps: 16000 electrons peak at 3100
        detector = dataclasses.replace(detector, bits=8, electrons_per_dn=20.0, offset_dn=12.0)
    over_bound, over_sigma, refused = [], [], Counter[int]()
    for seed in range(6):
        xy = star_grid(seed)
        # The same contrast for any width: the area of the PSF.
        flux = (psf_sigma_px / 0.95) ** 2 * unlike_fluxes(seed, len(xy))
        found = measured(exposed(seed, xy, flux, detector), xy)
        bound, snr = centroid_bound(xy, flux, detector, SHAPE)
        good = (snr > 10) & used(found)
        refused.update(found.refusal[(snr > 10) & ~good].tolist())
        over_bound.append((found.xy_px - xy)[good] ** 2 / bound[good][:, [0, 1], [0, 1]])
        over_sigma.append(squares(found, xy, good))
    stars = sum(map(len, over_bound))
    assert stars > 2000 and refused.total() < 0.005 * stars, refused
    # Two coordinates of 2400 stars: the ratios are known to 1 %; three of those below 1.
    assert 0.97 < rms(over_bound) < 1.05 and 0.96 < rms(over_sigma) < 1.04


@pytest.mark.parametrize(
    ('psf_sigma_px', 'tail_px', 'part', 'brightest'),
    [
        (0.95, 0.0, 0.25, 5.3),
        (0.7, 2.0, 0.25, 6.3),
        (0.7, 2.5, 0.12, 5.3),
        (0.95, 2.5, 0.12, 6.3),
        (0.95, 3.0, 0.2, 5.3),
    ],
)
def test_stars_of_one_shape_are_measured_and_another_shape_is_refused(
    psf_sigma_px: float, tail_px: float, part: float, brightest: float
) -> None:
    """Comatic stars, with a part of the light in a tail; all were refused, or all but a few."""
    rng = np.random.default_rng(4)
    xy = star_grid(3)
    flux = 10 ** rng.uniform(brightest - 1.5, brightest, len(xy))  # electrons
    other = rng.choice(len(xy), 8, replace=False)
    tail = np.tile([tail_px, 0.5 * tail_px], (len(xy), 1))
    tail[other] = [-1.6, 1.9]  # as a companion, in another direction
    detector = dataclasses.replace(
        QUIET, bits=16, electrons_per_dn=40.0, offset_dn=500.0, psf_sigma_px=psf_sigma_px
    )
    both = np.concatenate([xy, xy + tail]), np.concatenate([(1 - part) * flux, part * flux])
    found = measured(exposed(5, *both, detector), xy)
    elongated = found.refusal == StarRefusal.ELONGATED
    # A companion that is as faint as the tails may be as near to the common shape as they are.
    assert elongated[other].sum() >= 4
    assert elongated.sum() < len(other) + 0.07 * len(xy)


def bias_with_phase_px(error_px: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Mean errors (10,) of coordinates by their place within the pixel."""
    bins = np.digitize((xy - np.rint(xy)).ravel(), np.linspace(-0.5, 0.5, 11)) - 1
    return np.asarray(np.bincount(bins, error_px.ravel()) / np.bincount(bins))


@pytest.mark.parametrize('psf_sigma_px', [0.7, 0.95, 2.0])
def test_no_bias_with_the_phase_in_the_pixel(psf_sigma_px: float) -> None:
    # So bright (16 bit) that a single centroid is good to 1.5e-3 sigma.
    detector = dataclasses.replace(
        QUIET, psf_sigma_px=psf_sigma_px, bits=16, electrons_per_dn=10.0, offset_dn=500.0
    )
    error, place = [], []
    for seed in range(4):
        xy = star_grid(10 + seed)
        found = measured(exposed(seed, xy, np.full(len(xy), 4e5), detector), xy)
        good = used(found)
        assert good.mean() > 0.99
        error.append((found.xy_px - xy)[good])
        place.append(xy[good])
    bias = bias_with_phase_px(np.concatenate(error), np.concatenate(place))
    # 330 centroids in each of ten bins: means good to 2e-4 px.
    assert len(bias) == 10 and np.abs(bias).max() < 0.002


@pytest.mark.parametrize('known', [True, False], ids=['known', 'unknown'])
def test_a_hot_pixel_takes_no_part_in_a_fit(known: bool) -> None:
    squared = []
    for seed in range(4):
        xy = star_grid(40 + seed)
        pixels = exposed(seed, xy, unlike_fluxes(seed, len(xy)), QUIET)
        model = modelled(pixels)
        u, v = np.rint(xy + np.array([2.0, -1.0])).astype(int).T
        pixels[v, u] += 400
        hot = np.sort(v * pixels.shape[1] + u) if known else np.empty(0, np.int64)
        found = measure_stars(pixels, xy, model, PSF, hot)
        good = used(found) & (found.snr > 10)
        assert good.mean() > 0.75
        squared.append(squares(found, xy, good))
    # Two coordinates of more than 1200 stars: known to 1.4 %.
    assert rms(squared) == pytest.approx(1.0, abs=0.05)


def test_moments_are_pulled_to_the_middle_of_the_pixel() -> None:
    # The paper's method cuts the wings off, at 3 px and at its threshold.
    detector = dataclasses.replace(QUIET, bits=16, electrons_per_dn=10.0, offset_dn=500.0)
    for flux, bias_px in ((4e5, 0.03), (8e3, 0.08)):
        xy = star_grid(20)
        found = measured(exposed(20, xy, np.full(len(xy), flux), detector), xy, MOMENT)
        good = used(found)
        assert good.mean() > 0.95
        error = (found.xy_px - xy)[good]
        assert np.abs(bias_with_phase_px(error, xy[good])).max() < bias_px
        assert np.sqrt((error**2).mean()) < 1.5 * bias_px


def test_background_and_noise_under_stars_and_a_gradient() -> None:
    xy = star_grid(3)
    flux = unlike_fluxes(3, len(xy))
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    glow = 0.15 * u + 0.1 * v  # electrons: 24 DN across, 13 DN down
    pixels = exposed(3, xy, flux, QUIET, glow)
    background = measure_background(pixels)
    places = np.stack([u[::37, ::41].ravel(), v[::37, ::41].ravel()], axis=-1).astype(float)
    glow_there = 0.15 * places[:, 0] + 0.1 * places[:, 1]
    level_dn = QUIET.offset_dn + (glow_there + QUIET.background_electrons) / 4.0
    noise_dn = np.sqrt(QUIET.noise_electrons**2 + glow_there) / 4.0
    level = sample_mesh(background.level_mesh, SHAPE, places) - level_dn
    noise = sample_mesh(background.noise_mesh, SHAPE, places) / noise_dn
    inner = (np.abs(places - [320, 256]) < [280, 216]).all(axis=1)
    # A cell of 256 samples knows its mean to 0.06 sigma; wings of stars lift it by as much more.
    assert np.abs(level[inner]).max() < 0.5 * noise_dn.max()
    assert np.abs(level[inner].mean()) < 0.2 * noise_dn.mean()
    # The gradient itself, 1.4 DN across a cell, adds 2 % to the spread; wings of stars the rest.
    assert 0.95 < np.median(noise[inner]) < 1.10
    assert background.noise_dn == pytest.approx(np.median(noise_dn), rel=0.10)


@pytest.mark.parametrize('read_noise', [2.0, 8.0, 40.0])
def test_noise_of_a_dark_image(read_noise: float) -> None:
    detector = dataclasses.replace(QUIET, read_noise_electrons=read_noise)
    pixels = expose(np.full(SHAPE, 4.5), detector, np.random.default_rng(4))
    background = measure_background(pixels)
    # A fourth of 327,680 pixels: 0.25 %; half a rounding step more where steps are coarse.
    assert background.noise_dn == pytest.approx(pixels.std(), rel=0.02)
    assert background.level_dn == pytest.approx(pixels.mean(), abs=0.03 * background.noise_dn)


def test_a_constant_image_has_the_noise_of_its_rounding() -> None:
    background = measure_background(np.full(SHAPE, 77, np.uint8))
    assert background.level_dn == 77
    assert background.noise_dn == pytest.approx(np.sqrt(1 / 12))
    assert len(detect(np.full(SHAPE, 77, np.uint8), background).snr) == 0


@pytest.mark.parametrize('shape', [(5, 7), (31, 33), (64, 40), (100, 1000)])
def test_images_of_any_size(shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(5).normal(100, 3, shape).astype(np.uint16)
    background = measure_background(pixels)
    assert background.level_dn == pytest.approx(99.5, abs=2.0)
    sources = detect(pixels, background)
    model = model_image(pixels, background, sources, PSF)
    assert model.psf_sigma_px == 0.0  # no stars to tell


def test_all_stars_above_eight_sigma_are_detected() -> None:
    found_all, total = 0, 0
    for seed in range(5):
        xy = star_grid(seed)
        flux = np.random.default_rng([seed, 2]).uniform(150, 1500, len(xy))
        pixels = exposed(seed, xy, flux, QUIET)
        sources = detect(pixels, measure_background(pixels))
        _, snr = centroid_bound(xy, flux, QUIET, SHAPE)
        distance = np.linalg.norm(xy[snr > 8][:, None] - sources.xy_px[None], axis=2)
        found_all += int((distance.min(axis=1) < 1.0).sum())
        total += len(distance)
        near = distance.min(axis=1)
        # At the faint end 0.2 px is one sigma of what a star of 8 sigma can say.
        assert np.sqrt(np.mean(near[near < 1.0] ** 2)) < 0.25
    # 8 less 5 is three sigma: one in 700, and most of these stars are brighter.
    assert total > 1500 and found_all > 0.998 * total


@pytest.mark.parametrize(('threshold', 'images'), [(3.5, 2), (4.5, 6)])
def test_noise_alone_gives_no_more_detections_than_it_should(threshold, images) -> None:
    # Local maxima of a Gaussian field above t sigma: (2 pi)^-3/2 L t exp(-t^2 / 2) per pixel with
    # L = 1 / (2 s^2) of the filter: 80 per image at 3.5 sigma, 2 at 4.5.
    density = (2 * np.pi) ** -1.5 * 0.5 * threshold * np.exp(-0.5 * threshold**2)
    expected = density * SHAPE[0] * SHAPE[1] * images
    detector = dataclasses.replace(QUIET, electrons_per_dn=1.0, offset_dn=100.0)
    count = 0
    for seed in range(images):
        pixels = expose(np.full(SHAPE, 4.5), detector, np.random.default_rng([seed, 6]))
        count += len(detect(pixels, measure_background(pixels), threshold).snr)
    # Poisson; the noise, 1 % off, changes the count by 12 % at 3.5 sigma and 20 % at 4.5.
    assert count < 1.25 * expected + 3 * np.sqrt(expected)
    assert count > 0.75 * expected - 3 * np.sqrt(expected)


def one_star(
    at: tuple[float, float] = (300.3, 200.6), flux: float = 8000.0, more: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """An image of the grid with the star nearest to a place moved there, and its place (1, 2)."""
    place = np.array([at])
    xy = star_grid(7)
    xy = xy[np.linalg.norm(xy - place, axis=1) > 24]
    fluxes = np.r_[np.full(len(xy), 4000.0), flux]
    more_light = np.zeros(SHAPE) if more is None else more
    return exposed(7, np.concatenate([xy, place]), fluxes, QUIET, more_light), place


both_methods = pytest.mark.parametrize('options', [PSF, MOMENT], ids=['psf', 'moment'])


@both_methods
def test_an_ordinary_star_is_measured_and_a_saturated_one_refused(options) -> None:
    pixels, place = one_star()
    found = measured(pixels, place, options)
    assert found.refusal[0] == StarRefusal.NONE
    assert np.abs(found.xy_px - place).max() < 0.1
    # A moment mask misses some of the wings.
    assert found.flux_dn[0] == pytest.approx(2000.0, rel=0.12)
    # The prediction need not be right to the pixel.
    off = measured(pixels, place + np.array([0.9, -0.8]), options)
    np.testing.assert_allclose(off.xy_px, found.xy_px, rtol=0, atol=0.01)
    pixels, place = one_star(flux=3e5)
    assert pixels.max() == 4095
    none = dataclasses.replace(options, max_saturated_pixels=0)
    assert measured(pixels, place, none).refusal[0] == StarRefusal.SATURATED


@pytest.mark.parametrize('off', [(0.4, 0.4), (-0.4, -0.4)])
def test_a_saturated_plateau_is_found_where_it_was_predicted(off: tuple[float, float]) -> None:
    """With its full flux; a window moved to one of its many brightest pixels may lose the star."""
    wide = dataclasses.replace(QUIET, psf_sigma_px=1.6)
    at = np.array([[300.3, 200.6]])
    xy = np.concatenate([at, [p for p in star_grid(3) if np.abs(p - at).max() > 25.0]])
    flux = np.r_[1.2e6, unlike_fluxes(3, len(xy) - 1)]
    pixels = exposed(3, xy, flux, wide)
    assert (pixels[195:206, 295:306] == 4095).sum() >= 9
    found = measured(pixels, at + np.array(off), PSF)
    assert found.refusal[0] == StarRefusal.NONE
    assert found.flux_dn[0] == pytest.approx(1.2e6 / wide.electrons_per_dn, rel=0.03)
    sigma_px = np.sqrt(found.covariance_px2[0, [0, 2]])
    assert (np.abs(found.xy_px - at)[0] < 4.0 * sigma_px + 0.005).all()


@pytest.mark.parametrize(
    ('dtype', 'step_dn', 'peak', 'count', 'expected'),
    [
        (np.uint8, 1, 255, 1, 0.98 * 255),
        (np.uint8, 1, 200, 4, 0.98 * 200),
        (np.uint16, 1, 65535, 1, 0.98 * 65535),
        (np.uint16, 257, 65535, 1, 0.98 * 65535),  # 8 bits
        (np.uint16, 16, 65520, 1, 0.98 * 65520),  # 12 bits in the high ones
        (np.uint16, 1, 65520, 1, 0.0),
        (np.uint16, 16, 4080, 1, 0.98 * 4080),  # 8 bits in the high ones of 12
        (np.uint16, 1, 3000, 3, 0.0),
        (np.uint16, 1, 3000, 4, 0.98 * 3000),
    ],
)
def test_the_saturation_level(dtype, step_dn, peak, count, expected) -> None:
    pixels: np.ndarray = np.random.default_rng(8).integers(20, 60, SHAPE).astype(dtype) * step_dn
    pixels.flat[:count] = peak
    assert quantisation_step_dn(pixels) == step_dn
    assert saturation_level(pixels, PSF, step_dn) == pytest.approx(expected)
    assert saturation_level(pixels, CentroidOptions(saturation_dn=123.0), step_dn) == 123.0


@pytest.mark.parametrize('step_dn', [1, 16, 257])
def test_the_few_stars_of_a_quiet_sky_show_the_step(step_dn: int) -> None:
    pixels = np.full((960, 1280), 5, np.uint16)
    pixels[101, 201:210] = [7, 30, 90, 140, 160, 130, 80, 20, 6]
    assert quantisation_step_dn(pixels * np.uint16(step_dn)) == step_dn


@pytest.mark.parametrize('psf_sigma_px', [0.7, 0.95, 2.0])
def test_of_a_star_at_the_border_the_fit_takes_what_is_in_the_image(psf_sigma_px: float) -> None:
    detector = dataclasses.replace(QUIET, psf_sigma_px=psf_sigma_px)
    height, width = SHAPE
    over_bound, over_sigma = [], []
    for seed in range(4):
        rng = np.random.default_rng([seed, 7])
        along = np.arange(30.0, height - 30.0, 20.0)
        across = rng.uniform(0.6, 6.0, (4, len(along)))
        sides = (
            *((across[0], along), (width - 1 - across[1], along)),
            *((along, across[2]), (along, height - 1 - across[3])),
        )
        corners = np.array([[1.3, 2.2], [width - 2.4, 1.1], [width - 3.2, height - 2.4]])
        rim = np.concatenate([*(np.stack(side, axis=-1) for side in sides), corners])
        inner = star_grid(seed, 40)
        xy = np.concatenate([rim, inner[(abs(inner - [320, 256]) < [280, 216]).all(1)]])
        flux = np.full(len(xy), 3000.0) * (psf_sigma_px / 0.95) ** 2
        found = measured(exposed(seed, xy, flux, detector), xy)
        edge = np.arange(len(xy)) < len(rim)
        bound, _ = centroid_bound(xy, flux, detector, SHAPE)
        good = edge & used(found)
        assert good.sum() > 0.97 * edge.sum(), Counter(found.refusal[edge].tolist())
        over_bound.append((found.xy_px - xy)[good] ** 2 / bound[good][:, [0, 1], [0, 1]])
        over_sigma.append(squares(found, xy, good))
    # 800 centroids of two coordinates: known to 1.8 %. The bound knows the background, the fit
    # finds it in a stamp that is cut; and a star on the rim is a little fainter in its luck.
    assert 0.94 < rms(over_bound) < 1.08 and 0.94 < rms(over_sigma) < 1.06


@both_methods
def test_where_no_star_is_none_is_measured(options: CentroidOptions) -> None:
    """With its core off the image, between the stars of the grid, and none asked for."""
    pixels, _ = one_star()
    height, width = SHAPE
    edge = np.array(
        [
            [0.4, 200.0], [width - 1.4, 200.0], [300.0, 0.4], [300.0, height - 1.4],
            [-50.0, 10.0], [1e9, 1e9], [np.nan, 5.0],
        ]
    )  # fmt: skip
    assert (measured(pixels, edge, options).refusal == StarRefusal.BORDER).all()
    refused = Counter(measured(pixels, star_grid(7)[5:200] + 12.0, options).refusal.tolist())
    # The moments count what stands above their threshold alone: one in 200 is noise.
    assert refused[StarRefusal.NONE] <= (0 if options is PSF else 2), refused
    assert set(refused) <= set(StarRefusal)
    found = measured(pixels, np.empty((0, 2)), options)
    assert found.xy_px.shape == (0, 2) and found.covariance_px2.shape == (0, 3)
    assert len(found.refusal) == 0


def test_lit_single_pixels_are_no_sources() -> None:
    hot = np.zeros(SHAPE)
    rng = np.random.default_rng(9)
    hot.flat[rng.choice(hot.size, 200, replace=False)] = rng.uniform(300, 6000, 200)
    pixels = expose(hot + QUIET.background_electrons, QUIET, rng)
    sources = detect(pixels, measure_background(pixels))
    # Two side by side may pass for a source, and one of 200 whose neighbours' noise helps: half of
    # the light of an undersampled star is in one pixel, and such stars must not be left out.
    assert len(sources.snr) <= 3


COSMIC_RAY = [(k, k // 2 - 1, 700.0) for k in range(-5, 6)]


def lit(*pixels: tuple[int, int, float]) -> np.ndarray:
    """Light in pixels by their distance from that of the star."""
    light = np.zeros(SHAPE)
    for right, down, electrons in pixels:
        light[201 + down, 300 + right] = electrons
    return light


@pytest.mark.parametrize('light', [lit((1, 0, 1500.0)), lit((1, 1, 1500.0)), lit(*COSMIC_RAY)])
def test_a_star_with_lit_pixels_in_its_core_is_refused(light: np.ndarray) -> None:
    """A hot pixel beside its middle, or a cosmic ray through it."""
    assert measured(*one_star(more=light)).refusal[0] == StarRefusal.ELONGATED


@pytest.mark.parametrize(
    ('flux', 'ray'), [(3000.0, (2, 0, 2e4)), (2e5, (-2, 1, 3000.0)), (3000.0, (-1, -2, 2e4))]
)
def test_a_star_beside_a_single_lit_pixel_is_measured(flux, ray) -> None:
    """Lit far above a faint star, and as bright as the flank of a bright one."""
    clean = measured(*one_star(flux=flux))
    found = measured(*one_star(flux=flux, more=lit(ray)))
    assert found.refusal[0] == StarRefusal.NONE
    # Without one pixel of its flank a star is hardly worse, and where it was.
    sigma_px = np.sqrt(found.covariance_px2[0, [0, 2]])
    assert (sigma_px < 1.3 * np.sqrt(clean.covariance_px2[0, [0, 2]])).all()
    assert (np.abs(found.xy_px - clean.xy_px)[0] < 2.0 * sigma_px).all()


@both_methods
def test_a_long_star_among_round_ones_is_refused(options: CentroidOptions) -> None:
    # Four exposures on a line of 4 px: sigma 1.8 px along it.
    line = np.array([[299.0, 200.0], [300.0, 200.4], [301.0, 200.8], [302.0, 201.2]])
    light = star_electrons(line, np.full(4, 2500.0), QUIET.psf_sigma_px, SHAPE)
    pixels, _ = one_star(at=(400.0, 400.0), more=light)
    # The grid has a star of its own there or not: ask where the line is brightest.
    xy = np.array([[300.5, 200.6]])
    assert measured(pixels, xy, options).refusal[0] in (StarRefusal.ELONGATED, StarRefusal.BLEND)


def test_without_enough_bright_stars_the_width_is_not_known() -> None:
    xy = star_grid(12)[:3]
    pixels = exposed(12, xy, np.full(3, 8000.0), QUIET)
    model = modelled(pixels)
    assert model.psf_sigma_px == 0.0
    found = measure_stars(pixels, xy, model, PSF)
    assert used(found).all() and np.abs(found.xy_px - xy).max() < 0.2


def test_the_noise_of_few_faint_stars_is_no_change_of_their_shape() -> None:
    """Their median scatters by more than the change that bright stars show."""
    xy = star_grid(14)
    model = modelled(exposed(14, xy, unlike_fluxes(14, len(xy)), QUIET))
    faint = exposed(15, xy, np.full(len(xy), 500.0), QUIET)
    groups = np.array_split(xy, len(xy) // 8)
    # A gain that is given is kept.
    given = modelled(faint, CentroidOptions(gain_e_per_dn=3.3))
    assert given.pixel_noise.gain_e_per_dn == pytest.approx(3.3)
    images = [measure_stars(faint, group, model, PSF) for group in groups]
    snr = np.concatenate([image.snr for image in images])
    assert len(images) > 50 and 8.0 < np.median(snr) < 15.0
    assert not any(shape_changed(image, model) for image in images)


def test_the_fit_itself_is_exact_on_its_own_model() -> None:
    rng = np.random.default_rng(13)
    centre = rng.uniform(-0.7, 0.7, (50, 2))
    flux, level = rng.uniform(500, 5000, 50), rng.uniform(0, 100, 50)
    stamps = np.array(
        [
            star_electrons(c[None] + 5, np.array([f]), 1.1, (11, 11)) + b
            for c, f, b in zip(centre, flux, level, strict=True)
        ]
    )
    fit = fit_psf(stamps, 1.1, np.full(50, 2.0), PixelNoise(4.0, 0.0))
    expected = np.concatenate([centre, flux[:, None], level[:, None]], axis=1)
    # The last step leaves some thousandth of a sigma, which is 0.01 px here, and the residual is
    # followed through it to first order: a tenth of the noise is left.
    np.testing.assert_allclose(fit.parameters, expected, rtol=1e-5, atol=1e-5)
    assert np.abs(fit.residual_dn).max() < 0.1 * 2.0
    assert np.abs(fit.shape_change).max() < 1e-4


@pytest.mark.parametrize(
    ('seed', 'min_snr', 'detector'),
    [
        *((4, 5.0, dataclasses.replace(QUIET, psf_sigma_px=width)) for width in (0.5, 0.95, 2.0)),
        *((5, min_snr, QUIET) for min_snr in (2.0, 30.0)),
        (6, 5.0, Detector(cosmic_rays=500.0, hot_fraction=1e-2)),
    ],
)
def test_the_fit_that_a_faint_star_is_spared_changes_nothing(
    seed: int, min_snr: float, detector: Detector, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng([seed, 3])
    xy = rng.uniform((0.0, 0.0), SHAPE[::-1], (2000, 2))  # blends, and stars off the border
    flux = np.sort(60.0 * 1000.0 ** rng.uniform(size=len(xy)) ** 3)[::-1]
    pixels, options = exposed(seed, xy, flux, detector), CentroidOptions(min_snr=min_snr)
    model = modelled(pixels)
    spared = measure_stars(pixels, xy, model, options)
    none = np.zeros(len(xy), bool)
    monkeypatch.setattr(psf_fit, 'surely_fainter', lambda *_: none)
    whole = measure_stars(pixels, xy, model, options)
    np.testing.assert_array_equal(spared.refusal, whole.refusal)
    for name in ('xy_px', 'covariance_px2', 'flux_dn', 'snr'):
        fitted = (getattr(centroids, name)[spared.fitted] for centroids in (spared, whole))
        np.testing.assert_array_equal(*fitted)
    # The shortcut is taken by at least a third of the faint stars.
    faint = np.count_nonzero(spared.refusal == StarRefusal.FAINT)
    assert len(whole.fitted) == len(xy) and faint > 100
    assert len(xy) - len(spared.fitted) > 0.33 * faint


@pytest.mark.parametrize(
    ('longest_px', 'flux_snr', 'min_snr'), [(0.0, 5.5, 5.0), (10.0, 6.5, 5.0), (10.0, 25.0, 20.0)]
)
def test_no_star_above_the_limit_is_surely_fainter(longest_px, flux_snr, min_snr) -> None:
    """Each star by its own path: in a roll the paths of one image differ."""
    count, noise_dn, noise = 2000, 5.0, PixelNoise(1.0, 0.0)
    rng = np.random.default_rng(1)
    paths_px = np.stack([np.linspace(0.0, longest_px, count), np.zeros(count)], axis=-1)
    sigma_px, width = np.ones(count), 2 * psf_fit.stamp_radius_px(1.0, longest_px) + 1
    sky_dn2 = 4.0 * math.pi * blurred_px(sigma_px, paths_px[:, 0]) ** 2 * noise_dn**2
    flux_dn = 0.5 * (flux_snr**2 + np.sqrt(flux_snr**4 + 4.0 * flux_snr**2 * sky_dn2))
    place_px = rng.uniform(-0.5, 0.5, (count, 2))
    light = psf_fit.light_in_stamps(place_px, flux_dn, sigma_px, width, paths_px)
    variance = noise_dn**2 + np.maximum(light, 0.0)
    pixels = (light + 100.0 + np.sqrt(variance) * rng.normal(size=light.shape)).reshape(
        count, width, width
    )
    stamps = psf_fit.Stamps(pixels, sigma_px, np.full((count, 1), noise_dn**2), streak_px=paths_px)
    guess = psf_fit.first_guess(stamps, psf_fit.border_level_dn(pixels))
    near, done = psf_fit.approach(stamps, guess, noise)
    fainter = psf_fit.surely_fainter(stamps, near, done, min_snr, noise)
    snr = psf_fit.fit_at(stamps, near, noise).snr
    assert np.count_nonzero(snr >= min_snr) > 100 and not (fainter & (snr >= min_snr)).any()


@pytest.mark.parametrize('gain', [0.5, 2.0, 8.0])
def test_a_lens_whose_stars_are_no_gaussians(gain: float) -> None:
    """Three lobes of one star are no noise: the core is trusted, and the gain is still found."""
    rng = np.random.default_rng(3)
    count, side = 80, 9
    place_px = rng.uniform(-0.5, 0.5, (count, 2))
    flux_dn = 10 ** rng.uniform(2.3, 3.9, count)
    lobes_px = np.array([[0.0, 0.0], [0.9, 0.5], [-0.3, 1.1]])
    share = np.array([0.75, 0.15, 0.10])
    places, fluxes = 4 + place_px[:, None] + lobes_px, np.outer(flux_dn, share)
    stars = zip(places, fluxes, strict=True)
    light = np.array([star_electrons(*star, 0.55, (side, side)) for star in stars])
    stamps = 20.0 + rng.poisson(light * gain) / gain + rng.normal(0.0, 1.5, light.shape)
    noise_dn, noise = np.full(count, 1.5), PixelNoise(1.0, 0.02)
    for _ in range(5):
        fit = fit_psf(stamps, 0.65, noise_dn, noise)
        noise = noise_sums(fit, noise_dn, noise).pixel_noise()
    off_px = fit.parameters[:, :2] - place_px
    off_px -= np.median(off_px, axis=0)  # the lobes' own centre: a turn of the camera
    sigma_px = np.sqrt(np.stack([fit.covariance[:, 0, 0], fit.covariance[:, 1, 1]], axis=-1))
    # 80 stars that the Gaussian misses by 4 % know the gain to a factor of two.
    assert gain / 2.2 < noise.gain_e_per_dn < 2.2 * gain and noise.psf_error > 0.02
    # Of 0.65 px over root N, and 0.006 px that change with the phase of the star in its pixel.
    bright = flux_dn > 1500
    expected_px = np.hypot(1.3 * 0.65 / np.sqrt(gain * flux_dn[bright]), 0.006)
    assert np.sqrt((off_px[bright] ** 2).mean() / (expected_px**2).mean()) < 1.15
    # What the PSF may be wrong by is taken as worse than it is, never as better.
    assert np.sqrt(((off_px / sigma_px) ** 2).mean()) < 1.0
