# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Hot pixels from a dark frame, and from images between which the stars move over the detector.

A single pixel that is lit again after the sky has moved on is a defect of the detector.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices, Mask, Pixels
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.records import StarRefusal
from starcal_ros.robust_statistics import MAD_TO_SIGMA, median
from starcal_ros.stars.pixel_noise import quantisation_step_dn, rounding_noise_dn

_SCANNED_PX = 1 << 19  # pixels scanned per image, in 0.1 ms; larger images are scanned by strips
_MOVED_PX = 5.0  # the light of a star that has moved so far has left its pixels
# Mean of the four adjacent pixels over the peak: 0.2 for a star of 0.47 px on the centre of one.
# A limit for sharper stars would miss hot pixels in the noise and in the wings of stars.
_SPILT = 0.2
_BESIDE = np.array([[1, -1, 0, 0], [0, 0, 1, -1]])[:, :, None]  # offsets in rows and columns
CORE_PX = 1.5  # a hot pixel this near spoils the peak of a star
_WIDE_PSF_PX = 1.5  # each pixel of such a star has under 7 % of its light: the fit can omit one
# Above the background, in pixel noise: noise alone never reaches it.
_HOT_SIGMA = 10.0
_MOST = 100_000  # bounds the list; a detector with more has another fault


@dataclass(frozen=True)
class Strip:
    """Single lit pixels of one part of the detector, sorted, and the attitude of the camera."""

    lit: Indices
    icrf_from_camera: Rotation


@dataclass(frozen=True)
class HotPixels:
    """
    Hot pixels of a detector found so far, and the state of the search.

    ``index`` (n,) flat pixel indices, row by row from 0, sorted; ``strips`` the parts of the
    detector as last scanned; ``next_strip`` the number of the part to be scanned next.
    """

    index: Indices
    strips: tuple[Strip | None, ...] = ()
    next_strip: int = 0


NO_HOT_PIXELS = HotPixels(np.empty(0, np.int64))


def hot_in_dark(dark: Pixels | None) -> HotPixels:
    """Hot pixels of a dark frame: far above its median, in units of the spread of its pixels."""
    if dark is None:
        return NO_HOT_PIXELS
    level = median(dark)
    spread = MAD_TO_SIGMA * median(np.abs(dark[::4, ::4] - level))
    limit = level + _HOT_SIGMA * max(spread, rounding_noise_dn(quantisation_step_dn(dark)))
    return HotPixels(np.flatnonzero(dark > limit)[:_MOST])


def with_bad_pixels(hot: HotPixels, bad: Indices) -> HotPixels:
    """Hot pixels and bad ones, flat indices (k,), together."""
    return replace(hot, index=np.union1d(hot.index, bad)) if len(bad) else hot


def learn_hot_pixels(
    known: HotPixels,
    pixels: Pixels,
    background_dn: float,
    noise_dn: float,
    icrf_from_camera: Rotation,
    camera: CameraModel,
) -> HotPixels:
    """
    Hot pixels after one more image; one strip of it is scanned.

    ``pixels`` (height, width) are without the dark frame.  A pixel is hot if it is lit again after
    ``icrf_from_camera`` has moved the stars there by more than a PSF: a roll moves none at its
    axis.  A scan of a strip is replaced once they have moved at half of the pixels lit again.
    """
    height = pixels.shape[0]
    count = -(-pixels.size // _SCANNED_PX)
    strips = known.strips or (None,) * count
    before = strips[known.next_strip]
    following = (known.next_strip + 1) % count
    if before is not None:
        turn = before.icrf_from_camera.inv() * icrf_from_camera
        moved_rad = _MOVED_PX / float(camera.parameters[0])
        if turn.magnitude() < moved_rad:
            return HotPixels(known.index, strips, following)
    rows = (known.next_strip * height // count, (known.next_strip + 1) * height // count)
    lit = _single_lit(pixels, rows, background_dn, _HOT_SIGMA * noise_dn)
    index = known.index
    if before is not None:
        again = np.intersect1d(before.lit, lit, assume_unique=True)
        v, u = np.divmod(again, pixels.shape[1])
        direction = line_of_sight(camera, np.stack([u, v], axis=-1).astype(np.float64))
        moved = np.linalg.norm(turn.apply(direction) - direction, axis=-1) >= moved_rad
        index = np.union1d(index, again[moved])[:_MOST]
        if 2 * np.count_nonzero(moved) < len(again):
            return HotPixels(index, strips, following)
    strip = Strip(lit, icrf_from_camera)
    return HotPixels(
        index, (*strips[: known.next_strip], strip, *strips[known.next_strip + 1 :]), following
    )


def _single_lit(
    pixels: Pixels, rows: tuple[int, int], background_dn: float, threshold_dn: float
) -> Indices:
    """Flat indices of the lit pixels in some rows whose four neighbours are dark."""
    height, width = pixels.shape
    # An integer, since a comparison with a float converts every pixel.
    floor_dn = min(max(math.floor(background_dn + threshold_dn), 0), np.iinfo(pixels.dtype).max)
    lit = np.flatnonzero(pixels[rows[0] : rows[1]] > floor_dn)
    v, u = np.divmod(lit + rows[0] * width, width)
    inner = (u >= 1) & (u < width - 1) & (v >= 1) & (v < height - 1)
    v, u = v[inner], u[inner]
    single = lit_alone(pixels, v, u, background_dn)
    return np.asarray((v * width + u)[single][:_MOST], np.int64)


def lit_alone(
    pixels: Pixels | Floats, v: Indices, u: Indices, background_dn: float | Floats
) -> Mask:
    """Mask (k,) of pixels, none at the rim, with less light beside them than a star has."""
    beside = pixels[v + _BESIDE[0], u + _BESIDE[1]].sum(axis=0, dtype=np.float64)
    peak = pixels[v, u] - background_dn
    return np.asarray(0.25 * beside - background_dn < _SPILT * peak)


def hot_in_stamps(hot: Indices, centre: Indices, radius: int, width: int) -> Mask:
    """Mask (n, 2 radius + 1, 2 radius + 1) of the hot pixels in windows about pixels (n, 2)."""
    side = 2 * radius + 1
    hot_pixel = np.zeros((len(centre), side, side), bool)
    if len(hot) == 0:
        return hot_pixel
    row = centre[:, 1, None] + np.arange(-radius, radius + 1)
    first = row * width + centre[:, 0, None] - radius
    low = np.searchsorted(hot, first)
    beyond = hot.take(low, mode='clip') - first
    star, line = np.nonzero((beyond >= 0) & (beyond < side))
    low, first = low[star, line], first[star, line]
    high = np.searchsorted(hot, first + side)
    for k in range(int((high - low).max(initial=0))):
        more = low + k < high
        hot_pixel[star[more], line[more], hot[low[more] + k] - first[more]] = True
    return hot_pixel


def refuse_on_hot_pixels(
    xy_px: Floats,
    refusal: NDArray[np.uint8],
    hot: Indices,
    width: int,
    window_px: int,
    psf_sigma_px: float,
) -> NDArray[np.uint8]:
    """
    Codes (n,) of `StarRefusal` for stars at (n, 2), ``HOT_PIXEL`` where one is the cause.

    A hot pixel at the peak spoils a star of few pixels, because the other pixels hold little of
    its light.  A hot pixel elsewhere in the window (half width ``window_px``) is the cause if the
    star was refused for its shape.
    """
    if len(hot) == 0:
        return refusal
    v, u = np.divmod(hot, width)
    tree = cKDTree(np.stack([u, v], axis=-1))
    candidates = np.flatnonzero(
        np.isin(refusal, (StarRefusal.NONE, StarRefusal.ELONGATED, StarRefusal.AMBIGUOUS))
    )
    core, _ = tree.query(xy_px[candidates], distance_upper_bound=CORE_PX)
    cause = np.isfinite(core) & (psf_sigma_px < _WIDE_PSF_PX)
    misshapen = refusal[candidates] != StarRefusal.NONE
    window, _ = tree.query(
        xy_px[candidates[misshapen]], p=np.inf, distance_upper_bound=window_px + 0.5
    )
    cause[misshapen] |= np.isfinite(window)
    changed = refusal.copy()
    changed[candidates[cause]] = StarRefusal.HOT_PIXEL
    return changed
