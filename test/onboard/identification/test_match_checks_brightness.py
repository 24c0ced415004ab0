# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Brightnesses expose false matches and do not affect true ones."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from starcal_ros.errors import ImageRefused
from starcal_ros.identification.match_checks import refuse_by_brightness
from starcal_ros.identification.star_finder import IdentificationOptions
from starcal_ros.records import StarRefusal
from starcal_ros.stars.centroiding import Centroids
from starcal_ros.stars.detection import Background
from starcal_ros.stars.image_model import ImageModel, uniform_width
from starcal_ros.stars.pixel_noise import PixelNoise

SHAPE = (512, 640)
MIN_SNR = 5.0
ZERO_POINT = 17.0  # a star of that magnitude gives 1 DN
MESH = np.ones((1, 1), np.float32)
MODEL = ImageModel(
    Background(0.0 * MESH, 2.0 * MESH, 0.0, 2.0, SHAPE),
    uniform_width(0.95, SHAPE[1], SHAPE[0]),
    PixelNoise(4.0, 0.0),
    4095.0,
    np.zeros(3),
    np.zeros(3),
)


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


def judged(magnitude: np.ndarray, place: np.ndarray, centroids: Centroids) -> np.ndarray:
    most_mag = IdentificationOptions().max_brightness_scatter_mag
    return refuse_by_brightness(magnitude, place, centroids, MODEL, MIN_SNR, most_mag)


@pytest.mark.parametrize('scatter_mag', [0.0, 0.15, 0.3])
@pytest.mark.parametrize('count', [4, 8, 60, 600])
def test_a_true_sky_is_left_alone(count: int, scatter_mag: float) -> None:
    # 5 sigma of what is measured: of four stars the scatter itself is known to a half.
    for seed in range(20):
        assert (judged(*sky(count, scatter_mag, seed)) == StarRefusal.NONE).all()


def test_brightnesses_drawn_anew_are_no_match() -> None:
    for seed in range(100):
        magnitude, place, centroids = sky(20, 0.2, seed)
        rng = np.random.default_rng(seed)
        shuffled = dataclasses.replace(centroids, flux_dn=rng.permutation(centroids.flux_dn))
        with pytest.raises(ImageRefused, match='no_match: .* brightnesses scatter by'):
            judged(magnitude, place, shuffled)


def test_a_camera_far_from_the_band_of_the_catalog_need_not_be_asked() -> None:
    assert (refuse_by_brightness(*sky(60, 1.5), MODEL, MIN_SNR, 100.0) == StarRefusal.NONE).all()


def test_one_star_unlike_the_others_is_ambiguous() -> None:
    magnitude, place, centroids = sky(60, 0.2)
    flux = centroids.flux_dn.copy()
    flux[[3, 40]] *= [10.0, 0.1]
    refusal = judged(magnitude, place, dataclasses.replace(centroids, flux_dn=flux))
    assert np.flatnonzero(refusal == StarRefusal.AMBIGUOUS).tolist() == [3, 40]


def test_a_bright_star_that_is_gone_is_not_called_faint() -> None:
    magnitude, place, centroids = sky(60, 0.2)
    # Two that should stand out, and one that is at the limit: 40 DN are 5 sigma here.
    gone, limit = np.argsort(magnitude)[[0, 1]], 12.5
    magnitude[7] = limit
    refusal = centroids.refusal.copy()
    refusal[[*gone, 7]] = StarRefusal.FAINT
    found = judged(magnitude, place, dataclasses.replace(centroids, refusal=refusal))
    assert (found[gone] == StarRefusal.NOT_DETECTED).all() and found[7] == StarRefusal.FAINT


def test_the_few_of_a_part_that_misses_its_stars_are_ambiguous() -> None:
    magnitude, place, centroids = sky(300, 0.2)
    corner = (place > [427, 342]).all(axis=1)
    met = np.flatnonzero(corner)[:3]
    refusal = np.where(corner, StarRefusal.NOT_DETECTED, centroids.refusal)
    refusal[met] = StarRefusal.NONE
    assert corner.sum() > 20
    found = judged(magnitude, place, dataclasses.replace(centroids, refusal=refusal))
    assert (found[met] == StarRefusal.AMBIGUOUS).all()
    assert (found[~corner] == StarRefusal.NONE).all()


def test_stars_missing_everywhere_are_no_sign_of_a_wrong_match() -> None:
    magnitude, place, centroids = sky(300, 0.2)
    rng = np.random.default_rng(3)
    refusal = np.where(rng.uniform(size=300) < 0.6, StarRefusal.NOT_DETECTED, centroids.refusal)
    found = judged(magnitude, place, dataclasses.replace(centroids, refusal=refusal))
    np.testing.assert_array_equal(found, refusal)
