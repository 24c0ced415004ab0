# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Brightness and lost lines expose false matches, not true ones; a wrong prior is not refused."""

import dataclasses
import functools
import re
from typing import Any

import numpy as np
import pytest
from sample_sky import exposure_of, image_model, started, with_pixels  # type: ignore[import-not-found]

from starcal_ground.simulation.scenario import scenario
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.match_checks import find_line_loss, refuse_by_brightness
from starcal_ros.identification.star_finder import (
    Exposure,
    IdentificationOptions,
    observe_stars,
    StarSearch,
)
from starcal_ros.identification.tracking import track_stars
from starcal_ros.records import StarRefusal
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.stars.centroiding import Centroids

SCENARIO = scenario('tiny', seed=31)
PRIOR = SCENARIO.prior
SEARCH = StarSearch(load_catalog(None, 9.0))
SHAPE = (PRIOR.camera.height, PRIOR.camera.width)


@functools.cache
def exposure(index: int) -> Exposure:
    _, exposed = exposure_of(SCENARIO, index)
    return exposed  # type: ignore[no-any-return]


def with_lost_rows(index: int, row: int, lost: int) -> Exposure:
    """A frame with lost rows: all rows below are shifted up."""
    whole = exposure(index)
    pixels = whole.image.pixels.copy()
    pixels[row:-lost] = whole.image.pixels[row + lost :]
    return with_pixels(whole, pixels)  # type: ignore[no-any-return]


# 1 % of the focal length and 0.08 of k1: 6 px in a corner.
FX, _, FY, *_ = PRIOR.camera.intrinsics
OFF = PRIOR.camera.replace(fx=1.01 * FX, fy=1.01 * FY, k1=PRIOR.camera.distortion[0] + 0.08)
WRONG = dataclasses.replace(PRIOR, camera=OFF)
PRIORS = {'prior': PRIOR, 'wrong prior': WRONG}


@pytest.mark.parametrize(
    ('prior', 'index'), [('prior', 0), ('wrong prior', 2), ('wrong prior', 7)]
)
def test_an_intact_frame_is_accepted(prior: str, index: int) -> None:
    assert not observe_stars(exposure(index), PRIORS[prior], SEARCH)[0].refusal


@pytest.mark.parametrize(
    ('prior', 'row', 'lost'),
    [
        ('prior', 100, 2),
        ('wrong prior', 100, 3),
        ('prior', 256, 1),
        ('wrong prior', 256, 3),
        ('wrong prior', 380, 2),
    ],
)
def test_lost_rows_are_found(prior: str, row: int, lost: int) -> None:
    with pytest.raises(ImageRefused, match='incomplete: stars below row') as refused:
        observe_stars(with_lost_rows(0, row, lost), PRIORS[prior], SEARCH)
    row_found, down_px = re.findall(r'row (\d+) .*, ([-+.\d]+)\)', refused.value.detail)[0]
    assert abs(int(row_found) - row) < 40  # a tenth of the rows holds a dozen stars
    assert float(down_px) == pytest.approx(-lost, abs=0.3)  # the smooth part takes some


def test_lost_rows_are_found_while_tracking() -> None:
    _, known = started(exposure(0), PRIOR, SEARCH)
    assert not track_stars(exposure(1), known, SEARCH)[0].refusal
    with pytest.raises(ImageRefused, match='incomplete'):
        track_stars(with_lost_rows(1, 256, 1), known, SEARCH)


def places(n: int) -> np.ndarray:
    return np.asarray(np.random.default_rng(1).uniform([0, 0], [SHAPE[1], SHAPE[0]], (n, 2)))


@pytest.mark.parametrize('n', [0, 1, 19, 20, 60, 151, 400])
def test_noise_alone_makes_no_tear(n: int) -> None:
    rng = np.random.default_rng(2)
    xy = places(n)
    for _ in range(50):
        sigma = 10 ** rng.uniform(-2, -0.5, n)
        measured = xy + sigma[:, None] * rng.normal(size=(n, 2))
        assert find_line_loss(xy, measured, sigma, SHAPE) is None


def test_wrong_stars_on_one_side_make_no_tear() -> None:
    rng = np.random.default_rng(3)
    xy, sigma = places(150), np.full(150, 0.1)
    for _ in range(20):
        measured = xy + 0.1 * rng.normal(size=(150, 2))
        below = np.flatnonzero(xy[:, 1] > 400)
        wrong = rng.choice(below, len(below) // 3, replace=False)
        measured[wrong] += rng.uniform(0.5, 3.0, (len(wrong), 2))
        assert find_line_loss(xy, measured, sigma, SHAPE) is None


def test_columns_that_are_shifted_are_told() -> None:
    rng = np.random.default_rng(4)
    xy, sigma = places(100), np.full(100, 0.1)
    measured = xy + 0.1 * rng.normal(size=(100, 2)) + np.outer(xy[:, 1] > 300, [4.0, 0.0])
    tear = find_line_loss(xy, measured, sigma, SHAPE)
    assert tear is not None
    row, off_px = tear
    assert abs(row - 300) < 12  # the next of the rows that are tried
    np.testing.assert_allclose(off_px, [4.0, 0.0], rtol=0, atol=0.2)


MIN_SNR = 5.0
ZERO_POINT = 17.0  # a star of that magnitude gives 1 DN
MODEL = image_model(2.0, SHAPE)


def sky(count: int, scatter_mag: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray, Centroids]:
    """Magnitudes, pixels and centroids of good stars with scattered brightnesses."""
    rng = np.random.default_rng(seed)
    magnitude = rng.uniform(3.0, 8.0, count)
    flux = 10.0 ** (0.4 * (ZERO_POINT - magnitude + rng.normal(0.0, scatter_mag, count)))
    place = rng.uniform([0, 0], [SHAPE[1] - 1, SHAPE[0] - 1], (count, 2))
    many = np.zeros(count)
    return magnitude, place, Centroids(
        xy_px=place,
        covariance_px2=np.tile([0.01, 0.0, 0.01], (count, 1)),
        flux_dn=flux,
        snr=many + 50.0,
        refusal=np.full(count, StarRefusal.NONE, np.uint8),
        fit=None,
        fitted=np.empty(0, np.intp),
        psf_sigma_px=many + 0.95,
        noise_dn=many + 2.0,
        modelled=np.zeros(count, bool),
    )  # fmt: skip


def judged(
    magnitude: np.ndarray, place: np.ndarray, centroids: Centroids, **changes: Any
) -> np.ndarray:
    """Refusals of the stars of a sky with some columns changed."""
    most_mag = IdentificationOptions().max_brightness_scatter_mag
    changed = dataclasses.replace(centroids, **changes)
    return refuse_by_brightness(magnitude, place, changed, MODEL, MIN_SNR, most_mag)


@pytest.mark.parametrize(('count', 'scatter_mag'), [(4, 0.3), (8, 0.15), (60, 0.3), (600, 0.0)])
def test_a_true_sky_is_left_alone(count: int, scatter_mag: float) -> None:
    # 5 sigma of what is measured: of four stars the scatter itself is known to a half.
    for seed in range(20):
        assert (judged(*sky(count, scatter_mag, seed)) == StarRefusal.NONE).all()
    # A camera far from the band of the catalog need not be asked.
    assert (refuse_by_brightness(*sky(60, 1.5), MODEL, MIN_SNR, 100.0) == StarRefusal.NONE).all()


def test_brightnesses_drawn_anew_are_no_match() -> None:
    for seed in range(100):
        shown = sky(20, 0.2, seed)
        shuffled_dn = np.random.default_rng(seed).permutation(shown[2].flux_dn)
        with pytest.raises(ImageRefused, match='no_match: .* brightnesses scatter by'):
            judged(*shown, flux_dn=shuffled_dn)


def test_one_star_unlike_the_others_is_ambiguous() -> None:
    magnitude, place, centroids = sky(60, 0.2)
    flux = centroids.flux_dn.copy()
    flux[[3, 40]] *= [10.0, 0.1]
    refusal = judged(magnitude, place, centroids, flux_dn=flux)
    assert np.flatnonzero(refusal == StarRefusal.AMBIGUOUS).tolist() == [3, 40]


def test_a_bright_star_that_is_gone_is_not_called_faint() -> None:
    magnitude, place, centroids = sky(60, 0.2)
    # Two that should stand out, and one that is at the limit: 40 DN are 5 sigma here.
    gone, limit = np.argsort(magnitude)[[0, 1]], 12.5
    magnitude[7] = limit
    refusal = centroids.refusal.copy()
    refusal[[*gone, 7]] = StarRefusal.FAINT
    found = judged(magnitude, place, centroids, refusal=refusal)
    assert (found[gone] == StarRefusal.NOT_DETECTED).all() and found[7] == StarRefusal.FAINT


def test_the_few_of_a_part_that_misses_its_stars_are_ambiguous() -> None:
    magnitude, place, centroids = sky(300, 0.2)
    corner = (place > [427, 342]).all(axis=1)
    met = np.flatnonzero(corner)[:3]
    refusal = np.where(corner, StarRefusal.NOT_DETECTED, centroids.refusal)
    refusal[met] = StarRefusal.NONE
    assert corner.sum() > 20
    found = judged(magnitude, place, centroids, refusal=refusal)
    assert (found[met] == StarRefusal.AMBIGUOUS).all()
    assert (found[~corner] == StarRefusal.NONE).all()
    # Stars that miss everywhere are no sign of a wrong match.
    missing = np.random.default_rng(3).uniform(size=300) < 0.6
    refusal = np.where(missing, StarRefusal.NOT_DETECTED, centroids.refusal)
    found = judged(magnitude, place, centroids, refusal=refusal)
    np.testing.assert_array_equal(found, refusal)
