# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Copies of an exposure are recognised; other exposures of the same camera and sky are none."""

from collections.abc import Callable
from pathlib import Path
import re

import cv2
import numpy as np
import pytest
from scipy.ndimage import fourier_gaussian, fourier_shift

from starcal_ground.images.from_stars import _sources
from starcal_ground.images.photographs import pixels_of_photograph
from starcal_ros.arrays import Floats, Pixels
from starcal_ros.records import Image

SIZE = 320, 400
NOISE_DN = 20.0  # read-out and photons of the sky
S = 1_000_000_000
REAL_SKY = Path(__file__).parents[4] / 'shared' / 'realsky'


def sky(seed: int, psf_px: float = 1.0, faint: int = 0) -> Floats:
    """Light of 60 stars, and of faint ones of 0.5 to 10 sigma that no list of sources has."""
    rng = np.random.default_rng(seed)
    light = np.zeros(SIZE)
    flux = NOISE_DN * np.r_[10 ** rng.uniform(2.2, 3.4, 60), 10 ** rng.uniform(-0.3, 1.0, faint)]
    light[rng.integers(8, SIZE[0] - 8, len(flux)), rng.integers(8, SIZE[1] - 8, len(flux))] = flux
    return np.fft.ifft2(fourier_gaussian(np.fft.fft2(light), psf_px)).real.clip(0)


def exposed(
    light: Floats, seed: int, shift_px: float = 0.0, pattern: float = 0.0, hot: float = 0.002
) -> Pixels:
    """A shifted 16-bit exposure; pattern, in variances of the noise, and hot pixels are fixed."""
    rng, fixed = np.random.default_rng([seed, 1]), np.random.default_rng(0)
    moved = rng.normal(0.0, max(shift_px, 1e-9), 2)
    seen = np.fft.ifft2(fourier_shift(np.fft.fft2(light), moved)).real.clip(0)
    level = 200.0 + seen + np.sqrt(pattern) * NOISE_DN * fixed.normal(size=SIZE)
    level += NOISE_DN * fixed.exponential(60.0, SIZE) * (fixed.random(SIZE) < hot)
    noise = rng.normal(size=SIZE) * np.sqrt(NOISE_DN**2 + 0.1 * NOISE_DN * seen)
    pixels: Pixels = np.rint(level + noise).clip(0, 65535).astype(np.uint16)
    return pixels


def eight(pixels: Pixels, noise_dn: float) -> Pixels:
    """An image in 8 bit, its noise of that many digital numbers."""
    level = (pixels - 200.0) * noise_dn / NOISE_DN + 30.0
    return np.asarray(np.rint(level).clip(0, 255), np.uint8)


def jpeg(pixels: Pixels, quality: int) -> Pixels:
    coded = cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_UNCHANGED))


def words_on(frames: list[Pixels]) -> dict[int, str]:
    _, _, copies = _sources(Image((k + 1) * S, one) for k, one in enumerate(frames))
    return {time_ns // S - 1: words for time_ns, words in copies.items()}


@pytest.mark.parametrize(
    ('psf_px', 'faint', 'pattern', 'shift_px'),
    [(0.5, 2500, 0.0, 0.0), (0.5, 2500, 5.0, 0.5), (1.3, 2500, 5.0, 0.0), (1.0, 0, 0.0, 0.5)],
)
def test_exposures_of_one_field_and_camera_are_no_copies(psf_px, faint, pattern, shift_px) -> None:
    light = sky(1, psf_px, faint)
    assert not words_on([exposed(light, k, shift_px, pattern) for k in range(5)])


COPIES: dict[str, Callable[[Pixels], Pixels]] = {
    'in 8 bit': lambda pixels: eight(pixels, 1.0),
    'in 8 bit, coarse': lambda pixels: eight(pixels, 0.5),
    'in fewer bits': lambda pixels: np.asarray(pixels >> 3, np.uint16),
    'by a curve': lambda pixels: np.sqrt(65535.0 * pixels).astype(np.uint16),
    'JPEG 95': lambda pixels: jpeg(eight(pixels, 2.0), 95),
    'JPEG 85': lambda pixels: jpeg(eight(pixels, 5.0), 85),
    'JPEG 75': lambda pixels: jpeg(eight(pixels, 8.0), 75),
}


@pytest.mark.parametrize('name', COPIES)
def test_an_exposure_encoded_again_is_a_copy(name) -> None:
    frames = [exposed(sky(k), k, pattern=3.0) for k in range(4)]
    again = COPIES[name](frames[0])
    (number, words), *others = words_on([*frames, again]).items()
    assert number == 4 and not others
    assert re.fullmatch(
        r'it is the image of 1970-01-01 00:00:01\.000 UTC, encoded again: \d+% of its noise is the'
        ' same',
        words,
    )


def test_equal_pixels_are_a_copy_wherever_it_stands() -> None:
    frames = [exposed(sky(k), k) for k in range(3)]
    words = words_on([*frames, *frames])
    assert list(words) == [3, 4, 5]
    assert words[3].startswith('its pixels are those of the image of 1970-01-01 00:00:01')


@pytest.mark.parametrize('name', ['microobs', 'polaris', 'lco_kb82'])
def test_real_exposures_are_no_copies(name) -> None:
    """Microobs: faint stars on the same pixels, for minutes."""
    files = sorted(path for path in (REAL_SKY / name).glob('*.*') if path.suffix != '.csv')
    if not files:
        pytest.skip(f'{REAL_SKY / name} is absent')
    frames = [pixels_of_photograph(path) for path in files]
    assert not words_on(frames)
    assert words_on([*frames, frames[0]]).keys() == {len(frames)}
