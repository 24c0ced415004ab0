# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Flat field and bad pixels: read, refused, and what they do to stars."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from astropy.io import fits
import cv2
import numpy as np
import pytest
from tiny_campaign import attitudes, image, SCENARIO, values  # type: ignore[import-not-found]

from starcal_ros.errors import OptionError
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.detector_frames import flattened
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import Image, StarObservations

HEIGHT, WIDTH = 512, 640


def response() -> np.ndarray:
    """A response that falls to 60 % in a corner and varies by 3 % from pixel to pixel."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    smooth = 1.0 - 0.4 * (u / WIDTH) * (v / HEIGHT)
    return np.asarray(smooth * np.random.default_rng(6).normal(1.0, 0.03, (HEIGHT, WIDTH)))


def observed(pixels: np.ndarray, setup: Setup) -> StarObservations:
    return observe.observe_next(Image(image().time_ns, pixels), attitudes(), setup)[0]


def test_a_flat_field_restores_the_flux_of_the_stars(camera_yaml: Path, tmp_path: Path) -> None:
    flat = response()
    fits.PrimaryHDU(flat.astype('f4') * 30000).writeto(tmp_path / 'flat.fits')
    offset = SCENARIO.detector.offset_dn
    dimmed = np.rint((image().pixels - offset) * flat + offset).clip(0, 4095).astype(np.uint16)
    setup = load_setup(values(camera_yaml, flat_field=str(tmp_path / 'flat.fits')))
    # The pedestal of a dark frame: the offset is no signal.
    detector = dataclasses.replace(setup.detector, pedestal_dn=round(offset))
    setup = dataclasses.replace(setup, detector=detector)
    plain = load_setup(values(camera_yaml))
    ideal, without, with_flat = (
        observed(image().pixels, plain), observed(dimmed, plain), observed(dimmed, setup)
    )  # fmt: skip

    def worst(found: StarObservations) -> tuple[float, float]:
        """Median relative error of the flux and of the position, px, of bright stars."""
        _, a, b = np.intersect1d(ideal.catalog_id, found.catalog_id, return_indices=True)
        bright = ideal.snr[a] > 30
        ratio = found.flux_dn[b] / ideal.flux_dn[a]
        ratio = ratio[bright] / np.median(ratio[bright])
        moved = np.linalg.norm(found.measured_px[b] - ideal.measured_px[a], axis=1)[bright]
        assert bright.sum() > 20
        return float(np.median(np.abs(ratio - 1))), float(np.median(moved))

    flux_without, moved_without = worst(without)
    flux_with, moved_with = worst(with_flat)
    assert flux_with < 0.3 * flux_without and moved_with < moved_without


def test_a_bad_pixel_is_left_out_of_the_stars(camera_yaml: Path, tmp_path: Path) -> None:
    plain = load_setup(values(camera_yaml))
    before = observed(image().pixels, plain)
    star = int(np.argmax(before.snr))
    u, v = np.rint(before.measured_px[star]).astype(int)
    bad = np.zeros((HEIGHT, WIDTH), np.uint8)
    bad[v, u] = 1
    cv2.imwrite(str(tmp_path / 'bad.png'), bad)
    setup = load_setup(values(camera_yaml, bad_pixel_map=str(tmp_path / 'bad.png')))
    assert setup.detector.hot.index.tolist() == [v * WIDTH + u]
    after = observed(image().pixels, setup)
    assert before.catalog_id[star] not in after.catalog_id
    assert after.refused_stars['hot_pixel'] == before.refused_stars.get('hot_pixel', 0) + 1


def test_pixels_without_response_are_bad(camera_yaml: Path, tmp_path: Path) -> None:
    flat = np.full((HEIGHT, WIDTH), 1000, np.uint16)
    flat[7, 9] = 50
    cv2.imwrite(str(tmp_path / 'flat.png'), flat)
    setup = load_setup(values(camera_yaml, flat_field=str(tmp_path / 'flat.png')))
    assert setup.detector.hot.index.tolist() == [7 * WIDTH + 9]
    same = flattened(image(), setup.detector.flat, 0)
    assert (same.pixels == image().pixels).all()


def test_the_dust_and_noise_of_a_flat_field_are_no_stars(
    camera_yaml: Path, tmp_path: Path
) -> None:
    """Specks of dust, rows of other gain and vignetting, with the noise of the photons."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    flat = response()
    for place in np.random.default_rng(8).uniform(0, [WIDTH, HEIGHT], (40, 2)):
        flat *= 1.0 - 0.2 * np.exp(-(np.hypot(u - place[0], v - place[1]) ** 2) / 8.0)
    flat[:, 100:110] *= 1.3
    counts = np.random.default_rng(9).poisson(20000.0 * flat).astype(np.uint16)
    cv2.imwrite(str(tmp_path / 'flat.png'), counts)
    setup = load_setup(values(camera_yaml, flat_field=str(tmp_path / 'flat.png')))
    assert setup.detector.flat is not None


def test_saturated_pixels_stay_at_the_peak() -> None:
    pixels = np.array([[4095, 2000], [1000, 4095]], np.uint16)
    flat = np.array([[1.5, 0.25], [0.5, 0.5]])
    found = flattened(Image(1, pixels), flat, 0).pixels
    assert found.tolist() == [[4095, 4095], [2000, 4095]]


@pytest.mark.parametrize(
    ('name', 'content', 'words'),
    [
        ('dark_frame', np.zeros((HEIGHT, WIDTH - 1), np.uint16), 'one channel of 640 x 512'),
        ('dark_frame', np.zeros((HEIGHT, WIDTH, 3), np.uint8), 'one channel of 640 x 512'),
        ('dark_frame', np.zeros((HEIGHT, WIDTH), np.float32), 'one channel of 640 x 512'),
        ('dark_frame', None, r'dark_frame: .*map.png: no such file'),
        ('flat_field', np.ones((HEIGHT, WIDTH - 1), np.uint8), 'one channel of 640 x 512'),
        ('flat_field', np.zeros((HEIGHT, WIDTH), np.uint8), 'median is .*not positive'),
        ('flat_field', image().pixels, 'shows [0-9]+ stars: it is a frame of the sky'),
        ('bad_pixel_map', np.zeros((3, 4), np.uint8), 'one channel of 640 x 512'),
        ('bad_pixel_map', np.ones((HEIGHT, WIDTH), np.uint8), 'marks 100% .* 0 for good pixels'),
        ('bad_pixel_map', None, 'bad_pixel_map: .*map.png: no such file'),
    ],
)
def test_a_file_that_does_not_fit_is_named(
    camera_yaml: Path, tmp_path: Path, name: str, content: np.ndarray | None, words: str
) -> None:
    is_float = content is not None and content.dtype == np.float32
    path = tmp_path / ('map.tiff' if is_float else 'map.png')
    if content is not None:
        cv2.imwrite(str(path), content)
    with pytest.raises(OptionError, match=words):
        load_setup(values(camera_yaml, **{name: str(path)}))
