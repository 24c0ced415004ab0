# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Frames that are unfit as a whole are refused by name; sound ones of any kind are not."""

from collections.abc import Callable
import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
import pytest
from sample_sky import corona  # type: ignore[import-not-found]

from starcal_ground.simulation import rendering, scenario
from starcal_ros.arrays import Pixels
from starcal_ros.errors import ImageRefused
from starcal_ros.records import Image
from starcal_ros.stars.frame_checks import (
    Fingerprint,
    fingerprint,
    sample_rows,
    screen,
    ScreeningOptions,
    slope_left,
)

SCENARIO = scenario.scenario('tiny', seed=3)
HEIGHT, WIDTH = SCENARIO.truth.camera.height, SCENARIO.truth.camera.width
HALF = HEIGHT // 2
S = 1_000_000_000


@functools.cache
def frame(index: int = 0) -> NDArray[np.uint16]:
    return rendering.render(SCENARIO, scenario.scene(SCENARIO, index), index).pixels  # type: ignore[return-value]


def refusal(
    pixels: Pixels,
    before: Fingerprint | None = None,
    saturation_dn: float = 0.0,
    dark: Pixels | None = None,
    **options: float,
) -> str:
    """The reason for which a frame is refused; empty for a sound one."""
    sample = sample_rows(pixels)
    seen = fingerprint(Image(S, pixels), sample)
    try:
        screen(sample, seen, before, saturation_dn, dark, ScreeningOptions(**options))
    except ImageRefused as refused:
        return refused.reason if refused.detail else 'without a word'
    return ''


def known(pixels: Pixels, time_ns: int = 0) -> Fingerprint:
    """What a frame before leaves behind."""
    return fingerprint(Image(time_ns, pixels), sample_rows(pixels))


@pytest.mark.parametrize('index', [0, 1, 5])
def test_sound_frames_pass(index: int) -> None:
    before = known(frame(index - 1)) if index else None
    assert refusal(frame(index), before) == ''


@pytest.mark.parametrize('shape', [(1, 1), (2, 3), (63, 70), (64, 64), (129, 1000)])
def test_frames_of_any_size_are_judged(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).poisson(100.0, shape).astype(np.uint16)
    assert refusal(noise) in ('', 'blank')
    assert refusal(np.zeros(shape, np.uint8)) == 'blank'


def part(source: Any, rows: slice = slice(None), columns: slice = slice(None)) -> Pixels:
    """A frame with other values in a part."""
    pixels = frame().copy()
    pixels[rows, columns] = source
    return pixels


LOWER, UPPER = slice(HALF, None), slice(None, HALF)


@pytest.mark.parametrize(
    ('reason', 'made'),
    [
        ('blank', lambda: np.zeros((HEIGHT, WIDTH), np.uint8)),
        ('blank', lambda: np.full((HEIGHT, WIDTH), 300, np.uint16)),
        ('overexposed', lambda: np.full((HEIGHT, WIDTH), 255, np.uint8)),
        ('overexposed', lambda: np.full((HEIGHT, WIDTH), 4095, np.uint16)),
        ('overexposed', lambda: part(65535, rows=slice(None, HEIGHT // 3))),
        ('incomplete', lambda: part(0, rows=LOWER)),
        ('incomplete', lambda: part(0, rows=UPPER)),
        ('incomplete', lambda: part(0, columns=slice(WIDTH // 2, None))),
        # A value like the sky's own is no sky either: it has no noise.
        ('incomplete', lambda: part(int(np.median(frame())), rows=LOWER)),
        ('incomplete', lambda: part(0, rows=slice(100, 100 + HEIGHT // 20))),
        ('incomplete', lambda: part(frame()[HALF - 1], LOWER)),
        ('incomplete', lambda: part(frame()[:HALF], LOWER)),
    ],
)
def test_a_lost_frame_is_refused(reason: str, made: Callable[[], Pixels]) -> None:
    assert refusal(made()) == reason


def test_packets_lost_at_a_regular_distance_are_noticed() -> None:
    """Two rows in sixteen: an eighth, wherever the sampled rows fall."""
    for first in range(16):
        pixels = frame().copy()
        pixels[first::16] = pixels[first + 1 :: 16] = 0
        assert refusal(pixels) == 'incomplete'


def test_a_frame_shown_again_is_frozen() -> None:
    assert refusal(frame(), known(frame())) == 'frozen'
    assert refusal(frame(), known(frame(), time_ns=S)) == ''  # delivered twice
    assert refusal(frame(1), known(frame())) == ''
    assert refusal(frame()[:100], known(frame())) == ''


def test_a_frame_without_noise_is_known_again() -> None:
    """Eight bits, no light but the stars: only all pixels tell two frames apart."""
    one, other = (np.zeros((HEIGHT, WIDTH), np.uint8) for _ in range(2))
    one[::50, ::70], other[::50, 3::70] = 200, 200
    assert refusal(one, known(one)) == 'frozen'
    assert refusal(other, known(one)) == ''


def test_a_frame_half_of_the_one_before_is_incomplete() -> None:
    for time_ns in (0, S):  # whichever stamp it carries
        assert refusal(part(frame(1)[HALF:], LOWER), known(frame(1), time_ns)) == 'incomplete'


@pytest.mark.parametrize('noise_dn', [0.3, 1.0, 4.0])
def test_a_dark_sky_cut_off_at_zero_is_sound(noise_dn: float) -> None:
    """An eight-bit camera without offset: darker corners read zero, without a fault."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    falls = 1.5 * noise_dn * np.hypot(u - WIDTH / 2, v - HEIGHT / 2) / HALF
    sky = np.random.default_rng(2).normal(noise_dn - falls, noise_dn)
    assert refusal(np.clip(np.rint(sky), 0, 255).astype(np.uint8)) == ''


def test_a_bright_disc_is_no_loss() -> None:
    """The Moon over a tenth of the field: constant, but saturated, and the rest is sound."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    pixels = frame().copy()
    pixels[np.hypot(u - WIDTH / 2, v - HALF) < 0.178 * np.sqrt(HEIGHT * WIDTH)] = 4095
    assert refusal(pixels) == ''
    assert refusal(pixels, saturation_dn=4200.0) == 'incomplete'


def ramp(slope: float, level_dn: float = 200.0, across: Any = None) -> Pixels:
    """Noise of 5 DN on a sky that rises by a slope in that noise per pixel, across."""
    noise = np.random.default_rng(4).normal(level_dn, 5.0, (HEIGHT, WIDTH))
    rise = np.arange(WIDTH) if across is None else across
    return np.rint(noise + 5.0 * slope * rise).astype(np.uint16)


@pytest.mark.parametrize('slope', [0.0, 0.03, 0.5, 3.0])
def test_a_steady_slope_of_the_sky_is_no_glare(slope: float) -> None:
    # It is subtracted before the stars are fitted.  Means of 128 pixels give the change of a slope
    # from one cell to the next to 0.003 noise per pixel.
    assert slope_left(sample_rows(ramp(slope)), 65536) < 0.006
    assert refusal(ramp(slope)) == ''


def bent(slope: float) -> Pixels:
    """As `ramp`, with waves of 256 px whose slope has that amplitude."""
    return ramp(slope, 900.0, 256 / (2 * np.pi) * np.sin(2 * np.pi * np.arange(WIDTH) / 256.0))


def test_a_bent_sky_is_glare_but_what_the_dark_frame_explains() -> None:
    assert (refusal(bent(0.02)), refusal(bent(0.5))) == ('', 'glare')
    glow = bent(0.5).astype(np.int64) - ramp(0.0)
    assert refusal(bent(0.5), dark=np.maximum(glow - glow.min(), 0).astype(np.uint16)) == ''


def test_a_corona_dead_rows_and_stuck_columns_are_no_glare() -> None:
    assert refusal(corona()) == ''  # it is subtracted cell by cell
    # One per cent of the rows and columns: cells are judged by the rest of their pixels.
    rng = np.random.default_rng(5)
    pixels = rng.normal(200.0, 5.0, (2048, 1024)).astype(np.uint16)
    pixels[rng.choice(2048, 20, replace=False)] = 0
    pixels[:, rng.choice(1024, 10, replace=False)] = 4095
    assert slope_left(sample_rows(pixels), 4095) < 0.006
    assert refusal(pixels) == ''


@pytest.mark.parametrize(('quality', 'offset_dn'), [(60, -20), (60, 20), (75, 0)])
def test_a_compressed_sky_is_complete(quality: int, offset_dn: int) -> None:
    """JPEG leaves blocks without noise, and rows of blocks that are equal."""
    bytes_ = np.clip(frame().astype(np.int64) + offset_dn, 0, 255).astype(np.uint8)
    coded = cv2.imencode('.jpg', bytes_, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    pixels: Pixels = cv2.imdecode(coded, cv2.IMREAD_UNCHANGED)  # type: ignore[assignment]
    assert refusal(pixels) == ''
    lost = pixels.copy()
    lost[LOWER] = 0
    assert refusal(lost) == 'incomplete'
