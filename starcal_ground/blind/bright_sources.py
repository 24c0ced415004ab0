# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Brightest star-like sources of an image by their total light, saturated ones included."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.stars import detection
from starcal_ros.stars.detection import Background

_STAMP_PX = 7  # half width of a window; it holds a saturated star of 10 px
LONGEST_STREAK_PX = 2.0 * _STAMP_PX - 1  # the longest that a window shows whole, its ends blurred
_APART_PX = 10.0  # the fainter of two sources nearer than this counts as a part of the other
_MEASURED = 400  # sources measured, brightest by their peak
_KEPT = 200
_SMEARED = 2.0  # length over width from which a source is a streak
_STREAKS = 8  # fewest sources for a result


@dataclass(frozen=True)
class BrightSources:
    """
    Sources of an image, brightest first.

    ``xy_px`` (n, 2) centroids; ``flux_dn`` (n,); ``peak_dn`` (n,) brightest pixel, background
    included; ``long_px``, ``wide_px`` (n,): 1-sigma extents along the longest axis and across;
    ``along_rad`` (n,) direction of the longest axis from +u towards +v; ``background`` of the
    image.
    """

    xy_px: Floats
    flux_dn: Floats
    peak_dn: Floats
    long_px: Floats
    wide_px: Floats
    along_rad: Floats
    background: Background

    @property
    def rankings(self) -> tuple[Floats, Floats]:
        """Centroids by their light: of all sources, and of the compact ones, without glare."""
        # The structure of a corona is wide along both axes, as few stars are.
        middle_px = np.median(self.wide_px) if len(self.wide_px) else 0.0
        return self.xy_px, self.xy_px[self.wide_px <= middle_px]


def bright_sources(pixels: Pixels) -> BrightSources:
    """
    Sources of an image, ranked by the light in windows of 15 x 15 pixels, brightest first.

    Saturated stars keep their rank, and several maxima of one star are one source.  A centroid is
    good to a few tenths of a pixel.
    """
    background = detection.measure_background(pixels)
    found = detection.detect(pixels, background)
    centre = np.rint(found.xy_px[:_MEASURED]).astype(np.int64)
    stamps, outside = detection.stamps_at_edges(pixels, centre, _STAMP_PX)
    light = np.asarray(stamps - background.level_at(centre)[:, None, None], np.float32)
    light[outside | (light < 3.0 * background.noise_at(centre)[:, None, None])] = 0.0
    reach = np.arange(-_STAMP_PX, _STAMP_PX + 1, dtype=np.float32)
    # The second round is centred on the first centroid: neighbours at the rim then count less.
    offset: Floats = np.zeros((len(centre), 2))
    for radius_px in (4.0, 5.0):
        u2, v2 = (np.asarray((reach - offset[:, k, None]) ** 2, np.float32) for k in (0, 1))
        weight = light * (u2[:, None] + v2[:, :, None] <= radius_px**2)
        _, offset, _ = detection.second_moments(weight)
    total = light.sum(axis=(1, 2), dtype=np.float64)
    order = np.argsort(-total, kind='stable')
    order = order[total[order] > 0]
    order = order[detection.apart((centre + offset)[order], _APART_PX)][:_KEPT]
    _, _, moments_px2 = detection.second_moments(light[order])
    uu, vv, uv = moments_px2.T
    mean, half = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    return BrightSources(
        (centre + offset)[order],
        total[order],
        stamps[order].max(axis=(1, 2), initial=0.0),
        np.sqrt(np.maximum(mean + half, 0.0)),
        np.sqrt(np.maximum(mean - half, 0.0)),
        0.5 * np.arctan2(2 * uv, uu - vv),
        background,
    )


def smear(sources: BrightSources) -> tuple[float, float] | None:
    """
    Length, px, and direction, rad, of smeared stars; None if the stars are points.

    Only streaks with a common direction count, as in a slew; streaks of a roll are not detected.
    """
    bright = sources.long_px[:40] > 0
    ratio = sources.long_px[:40][bright] / np.maximum(sources.wide_px[:40][bright], 0.3)
    if len(ratio) < _STREAKS or np.median(ratio) < _SMEARED:
        return None
    double = np.exp(2j * sources.along_rad[:40][bright]).mean()  # an axis has two directions
    if abs(double) < 0.5:
        return None
    # The standard deviation of a uniform line is its length over the square root of twelve.
    length_px = math.sqrt(12.0) * float(np.median(sources.long_px[:40][bright]))
    return length_px, 0.5 * float(np.angle(double))
