# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Checks of a frame as a whole, before any star is searched, and of a flat field.

A sample of rows, each with the row below it, is enough for all checks: 5 % of the pixels of a
five-megapixel frame.  Noise makes a row of an intact frame differ from every other row of any
frame.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import hashlib
import math
from typing import Any
import zlib

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Indices, Mask, Pixels, Singles
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.options import option
from starcal_ros.records import Image
from starcal_ros.robust_statistics import MAD_TO_SIGMA, median
from starcal_ros.stars.detection import detect, filled, measure_background, smooth_mesh
from starcal_ros.stars.pixel_noise import CONVERTER_ENDS, quantisation_step_dn, rounding_noise_dn

_ROWS = 64
_GOLDEN = 0.618034
_BELOW_STEP_PX = 8  # the row below is only compared: every eighth pixel is enough
_SEGMENT_PX = 64  # a piece of a row: as wide as a cell of the background
_BY_CHANCE = 1e-6  # largest probability of equal adjacent rows at which they count as a fault
# Error of a slope by central differences between cells, interpolated to the middle of two:
# (1/6 + 1/8) of its second difference.
_SLOPE_LEFT = 7.0 / 24.0
# The limb of a planet or the Sun exceeds it; a disc over a tenth of the field does not.
_MAX_SATURATED_FRACTION = 0.2
# In pixel noise per pixel; this slope pulls the centroid of a star of 1 px by 0.25 sigma.
_MAX_SLOPE = 0.05
_UNIT_DN = 30000  # level of a response of 1 in the 16-bit image that is searched for stars
_STAR_SIGMA = 8.0  # detection limit in a flat field: the noise of five megapixels stays below
_LEAST_RESPONSE = 0.1  # a darker row or column is not brought to the level of the others


@dataclass(frozen=True)
class ScreeningOptions:
    """Limit beyond which a damaged frame is refused."""

    max_lost_fraction: float = option(
        0.02,
        'largest fraction of missing pixels in an image (constant, repeated, or left from the'
        ' previous image); raise it for a detector with dead rows',
        low=0.0,
        high=1.0,
    )


@dataclass(frozen=True)
class Fingerprint:
    """
    Checksums of a frame, to recognise it when it is delivered again.

    ``rows`` (k,) are checksums of the sampled rows that hold noise, 0 for the others; ``digest``
    is that of all sampled rows, or of all pixels if no row holds noise.
    """

    time_ns: int
    rows: NDArray[np.uint32]
    digest: str


@dataclass(frozen=True)
class RowSample:
    """
    Rows of a frame at almost regular distances, with the rows below them.

    ``row`` (k,) numbers of the rows, ``step`` their mean distance, px; ``pixels`` (k, width) the
    rows; ``below`` every eighth pixel of the rows below them; ``noisy`` (k, m) mask of the
    segments that hold noise; ``constant`` (k, m) mask of the segments with a single pixel value;
    ``step_dn`` the quantisation step of the frame.
    """

    row: Indices
    step: int
    pixels: Pixels
    below: Pixels
    noisy: Mask
    constant: Mask
    step_dn: int

    @functools.cached_property
    def distinctive(self) -> Mask:
        """Mask (k,) of the rows that no other row equals by chance."""
        return np.asarray(self.noisy.mean(axis=1) >= 0.5)


def sample_rows(pixels: Pixels) -> RowSample:
    """Rows of a frame (height, width), each with the row below it."""
    height = len(pixels)
    step = max(1, height // _ROWS)
    count = max(1, (height - 1) // step)
    # Irregular within their steps, so that packets lost at a regular distance do not all fall
    # between the rows; the same in each quarter, so that a repeated quarter is recognised.
    within = (np.arange(count) % (_ROWS // 4)) * _GOLDEN % 1.0
    row = np.arange(count) * step + (within * step).astype(np.int64)
    picked = pixels[row]
    segments = _segments(picked)
    unlike = _mean_of_each(segments != segments[:, :, :1])
    return RowSample(
        row=row,
        pixels=picked,
        below=pixels[np.minimum(row + 1, height - 1), ::_BELOW_STEP_PX],
        step=step,
        # A quarter, less the rounding of a mean.  Noise of a third of the quantisation step makes
        # this many pixels differ; one or two stars do not.
        noisy=unlike > 0.249,
        constant=unlike == 0.0,
        step_dn=quantisation_step_dn(pixels),
    )


def _segments(rows: Pixels) -> Pixels:
    """Rows (k, width) cut into segments (k, m, length), without an incomplete last one."""
    k, width = rows.shape
    length = min(_SEGMENT_PX, width)
    count = width // length
    return rows[:, : count * length].reshape(k, count, length)


def _mean_of_each(segments: NDArray[Any]) -> Singles:
    """Means (k, m) of (k, m, length)."""
    length = segments.shape[2]
    # As a product: NumPy takes ten times as long for sums of many short rows of integers.
    return segments.astype(np.float32) @ np.full(length, 1.0 / length, np.float32)


def fingerprint(image: Image, sample: RowSample) -> Fingerprint:
    """Checksums of a frame by its sampled rows."""
    distinctive = sample.distinctive
    rows = np.array([zlib.crc32(row) for row in sample.pixels], np.uint32) * distinctive
    # Without noise a few rows may equal those of another frame: only all pixels are decisive.  To
    # digest them always would double the time of a frame (27 ms for five megapixels).
    decisive = sample.pixels if distinctive.any() else image.pixels
    digest = hashlib.blake2b(decisive.tobytes(), digest_size=16).hexdigest()
    return Fingerprint(image.time_ns, rows, digest)


def screen(
    sample: RowSample,
    fingerprint: Fingerprint,
    before: Fingerprint | None,
    saturation_dn: float,
    dark: Pixels | None,
    options: ScreeningOptions,
) -> None:
    """
    Refuse a frame that cannot be measured.

    ``before`` is the previous frame, used or not.  Pixels of ``saturation_dn`` or more are
    saturated; 0 stands for the end of the converter's range.  Slopes of the frame ``dark``
    (height, width) do not count as glare.

    Raises ImageRefused ``overexposed``, ``blank``, ``frozen``, ``incomplete`` or ``glare``.
    """
    least_dn = _saturation_dn(sample, saturation_dn)
    part = np.count_nonzero(sample.pixels >= least_dn) / sample.pixels.size
    if part > _MAX_SATURATED_FRACTION:
        raise ImageRefused('overexposed', f'{part:.0%} of the pixels are at {least_dn}')
    if sample.constant.all() and np.ptp(sample.pixels) == 0:
        raise ImageRefused('blank', f'every pixel is {int(sample.pixels[0, 0])}')
    if before is not None:
        _refuse_repeated(fingerprint, before, options)
    _refuse_incomplete(sample, fingerprint, least_dn, options)
    slope = slope_left(sample, least_dn, dark)
    if slope > _MAX_SLOPE:
        raise ImageRefused(
            'glare',
            f'the background is uneven within {_SEGMENT_PX} px: its slope is {slope:.2f} of the'
            f' noise per pixel, over {_MAX_SLOPE}',
        )


def _saturation_dn(sample: RowSample, saturation_dn: float) -> int:
    """Least value of a saturated pixel."""
    peak = int(sample.pixels.max())
    if not saturation_dn:
        is_end = peak / sample.step_dn in CONVERTER_ENDS
        saturation_dn = 0.98 * peak if is_end else peak + 1.0
    # An integer, since a comparison with a float converts every pixel.
    return math.ceil(saturation_dn)


def _refuse_repeated(current: Fingerprint, before: Fingerprint, options: ScreeningOptions) -> None:
    """Refuse a frame that repeats the previous frame, as a whole or in some rows."""
    if len(before.rows) != len(current.rows):
        return
    since_s = (current.time_ns - before.time_ns) / NANOSECONDS_PER_SECOND
    if current.digest == before.digest:
        if since_s == 0.0:
            return  # the same frame delivered twice: the camera is not stuck
        raise ImageRefused('frozen', f'the pixels of the image {since_s:.3f} s before')
    part = float(((current.rows != 0) & (before.rows == current.rows)).mean())
    if part > options.max_lost_fraction:
        detail = f'{part:.0%} of its rows are of the image {since_s:.3f} s before'
        raise ImageRefused('incomplete', detail)


def _refuse_incomplete(
    sample: RowSample, fingerprint: Fingerprint, least_dn: int, options: ScreeningOptions
) -> None:
    """Refuse a frame with lost parts: repeated rows or constant segments."""
    distinctive = sample.distinctive
    _, first = np.unique(fingerprint.rows, return_index=True)
    again = np.ones(len(distinctive), bool)
    again[first] = False
    again |= _repeats_below(sample)
    repeated = float((distinctive & again).mean())
    if repeated > options.max_lost_fraction:
        raise ImageRefused('incomplete', f'{repeated:.0%} of its rows repeat others')
    alive = ~sample.constant
    if alive.all() or not alive.any():
        return
    saturated = _segments(sample.pixels)[:, :, 0] >= least_dn
    # A dark or compressed sky is constant in places too, but near the level around them.
    sharp = sample.noisy[alive].mean() > 0.9
    lost = float((sample.constant & ~saturated & (_off_level(sample, alive) | sharp)).mean())
    if lost > options.max_lost_fraction:
        raise ImageRefused('incomplete', f'{lost:.0%} of it is constant')


def _repeats_below(sample: RowSample) -> Mask:
    """Mask (k,) of the rows that equal the row below; none where chance may do that."""
    equal = sample.pixels[:, ::_BELOW_STEP_PX] == sample.below
    repeats = equal.all(axis=1)
    # Compression makes rows of one block equal: the other rows then have many equal pixels.
    by_chance = equal[~repeats].mean() ** equal.shape[1] if not repeats.all() else 0.0
    return np.asarray(repeats & (by_chance < _BY_CHANCE))


def _off_level(sample: RowSample, alive: Mask) -> Mask:
    """Mask (k, m) of the segments that differ from the nearest live one beyond the noise."""
    level = np.median(_segments(sample.pixels), axis=2)
    beside = alive[:, 1:] & alive[:, :-1]
    step = np.abs(np.diff(level, axis=1))[beside]
    # Neighbours of a compressed sky differ by its quantisation, which leaves no noise in a block.
    scatter_dn = MAD_TO_SIGMA * median(step) / math.sqrt(2.0) if step.size else 0.0
    noise_dn = max(_noise_dn(sample, alive), scatter_dn)
    return np.asarray(np.abs(level - filled(level, alive)) > 5.0 * noise_dn)


def _noise_dn(sample: RowSample, alive: Mask) -> float:
    """1-sigma noise of a pixel, from differences to the pixel below, which are free of slopes."""
    # One pixel of each segment: 2500 of five megapixels give the noise to 2 %.
    here = _segments(sample.pixels)[:, :, 0].astype(np.int32)
    below = sample.below[:, :: _SEGMENT_PX // _BELOW_STEP_PX][:, : here.shape[1]]
    spread = median(np.abs(here - below)[alive])
    return max(MAD_TO_SIGMA * spread / math.sqrt(2.0), rounding_noise_dn(sample.step_dn))


def slope_left(sample: RowSample, least_dn: int, dark: Pixels | None = None) -> float:
    """
    Median slope of the image minus its background in cells, in noise per pixel.

    Cells with pixels of ``least_dn`` or more are left out as saturated.  A slope g pulls the
    centroid of a star of any flux by up to 5 sigma_px^2 g of its own sigma (Gaussian of width
    sigma_px, white noise).
    """
    pixels = _sorted_cells(sample.pixels, sample.step)
    mesh = _middle_mean(pixels)
    mesh[pixels[:, :, -pixels.shape[2] // 4] >= least_dn] = np.inf
    if min(mesh.shape) < 4:
        return 0.0  # too small to separate a slope from its stars
    mesh = smooth_mesh(mesh)
    mesh[np.isinf(mesh)] = np.nan
    if dark is not None:
        glow = _middle_mean(_sorted_cells(dark[sample.row], sample.step))
        mesh = mesh - smooth_mesh(glow)
    cell_v_px = sample.pixels.shape[0] * sample.step / len(mesh)
    down = np.diff(mesh, 3, axis=0)[:, 1:-2] / cell_v_px
    across = np.diff(mesh, 3, axis=1)[1:-2] / _SEGMENT_PX
    third = np.hypot(down, across)
    third = third[np.isfinite(third)]
    everywhere = np.ones(sample.constant.shape, bool)
    return _SLOPE_LEFT * median(third) / _noise_dn(sample, everywhere) if third.size else 0.0


def _sorted_cells(rows: Pixels, step: int) -> Singles:
    """Every second pixel of square cells of sampled rows (down, across, n), ascending in each."""
    segments = _segments(rows)[:, :, ::2]
    k, m, length = segments.shape
    per_cell = max(1, min(_SEGMENT_PX // step, k))
    down = k // per_cell
    cells = segments[: down * per_cell].reshape(down, per_cell, m, length).transpose(0, 2, 1, 3)
    # NumPy takes four times as long to sort integers of 16 bits.
    return np.sort(cells.reshape(down, m, -1).astype(np.float32), axis=2)


def _middle_mean(ascending: Singles) -> Singles:
    """Means (down, across) of the middle half of each cell, free of stars and dead columns."""
    count = ascending.shape[2]
    return _mean_of_each(ascending[:, :, count // 4 : count - count // 4])


def excess_of_stars(response: Floats) -> int:
    """
    Number of star-like bright spots of a response (height, width) beyond that of dark ones.

    Pixels of a flat field are as often dark as bright, and its dust is dark; stars are bright.
    """
    level = np.nan_to_num(response, nan=1.0, posinf=1.0, neginf=1.0)
    # Columns and rows with another gain have edges, whose maxima are not stars either.
    level = level / np.maximum(np.median(level, axis=0), _LEAST_RESPONSE)
    level = level / np.maximum(np.median(level, axis=1), _LEAST_RESPONSE)[:, None] * _UNIT_DN
    bright, dark = (
        detect(pixels, measure_background(pixels), _STAR_SIGMA)
        for pixels in (
            np.clip(np.rint(values), 0, 2 * _UNIT_DN).astype(np.uint16)
            for values in (level, 2 * _UNIT_DN - level)
        )
    )
    return len(bright.snr) - len(dark.snr)
