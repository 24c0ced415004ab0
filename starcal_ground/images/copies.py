# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images of a set that show one exposure twice.

Equal pixels are recognised by their digest.  An image that was encoded again, as in 8 bit or by
JPEG, shows the noise of the first on the same pixels, and its stars have not moved.  Two exposures
of one camera share more than nothing: the pattern of the detector, and faint stars if the pointing
is held.  The filter of the noise removes what is smooth over two pixels, rows and columns; the
pattern is removed by images that show other noise.  With K of them, what is left of a pattern of
any strength correlates by at most 1 / (K + 1), since their mean holds the pattern and 1 / K of the
variance of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import functools
import itertools
import math

import numpy as np
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Pixels, Singles
from starcal_ros.constants import utc_text
from starcal_ros.robust_statistics import MAD_TO_SIGMA

_SIDE_PX = 256  # in the middle: 16,000 cells, whose correlations by chance have a sigma of 0.016
_FEWEST_CELLS = 1000
# Correlation of the noise: two exposures of a real camera had at most 0.42, by faint stars at the
# same pixels; copies in 8 bit and JPEG of quality 85 keep 0.5 to 1 if it exceeds a digital number.
_LEAST_COMMON = 0.5
_BY_CHANCE = 0.1  # six sigma
# Without other images to show the pattern: it would have nine times the variance of the noise.
_LEAST_ALONE = 0.9
_MOST_OTHERS = 8  # images that show the pattern: a ninth of the noise is left in it
_BRIGHTEST, _FEWEST_STARS = 50, 8
_NEAR_PX = 1.0
# Error of the place of all stars: encoding again moves them by less, any pointing by more.
_SIGMAS, _STILL_PX = 5.0, 0.02


@dataclass(frozen=True)
class Fingerprint:
    """Stamp, stars (n, 2) from bright to faint, and noise, a unit vector or zeros, of an image."""

    time_ns: int
    stars_px: Floats
    noise: Singles


def noise_of(pixels: Pixels) -> Singles:
    """Noise in the middle of an image without its stars, a unit vector; zeros if there is none."""
    v, u = (max(0, (side - _SIDE_PX) // 2) // 8 * 8 for side in pixels.shape)
    part = pixels[v : v + _SIDE_PX, u : u + _SIDE_PX].astype(np.float32)
    rows, columns = (side // 2 for side in part.shape)
    # Compression keeps little of the noise of single pixels.
    part = part[: 2 * rows, : 2 * columns]
    part = part[::2] + part[1::2]
    noise = part[:, ::2] + part[:, 1::2]
    # Second differences down and across: free of slopes, rows, columns and most light of stars.
    for _ in range(2):
        noise = (noise[:-2] - 2.0 * noise[1:-1] + noise[2:]).T if len(noise) > 2 else noise[:0]
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(noise))) if noise.size else 0.0
    noise[np.abs(noise) > 3.0 * sigma] = 0.0
    length = float(np.linalg.norm(noise)) if noise.size > _FEWEST_CELLS else 0.0
    return np.asarray(noise.ravel() / length if length > 0 else np.zeros(noise.size), np.float32)


def equal_to(before_ns: int) -> str:
    """Words on an image whose pixels are those of an earlier one."""
    return f'its pixels are those of the image of {utc_text(before_ns)}'


def encoded_again(exposures: Sequence[Fingerprint]) -> dict[int, str]:
    """Words on each image that is an earlier one encoded again, by its stamp."""
    noise = np.array([one.noise for one in exposures])
    common = np.asarray(noise @ noise.T, np.float64)
    still = functools.cache(lambda i, k: _are_still(exposures[i], exposures[k]))
    kept: list[int] = []
    found: dict[int, str] = {}
    for i, one in enumerate(exposures):
        # A copy has more in common with its original than with any other exposure.
        first = max(kept, key=common[i].__getitem__, default=i)
        if first != i and common[i, first] > _LEAST_COMMON and still(first, i):
            others = [k for k in np.argsort(-common[i]).tolist() if k not in (i, first)]
            unlike = (k for k in others if common[i, k] <= _LEAST_COMMON or not still(i, k))
            part, limit = _without_pattern(
                common, i, first, [*itertools.islice(unlike, _MOST_OTHERS)]
            )
            if part > limit:
                found[one.time_ns] = (
                    f'it is the image of {utc_text(exposures[first].time_ns)}, encoded again:'
                    f' {part:.0%} of its noise is the same'
                )
                continue
        kept.append(i)
    return found


def _without_pattern(
    common: Floats, i: int, first: int, others: Sequence[int]
) -> tuple[float, float]:
    """Correlation of two images without what the mean of others explains, and its limit."""
    if not others:
        return float(common[i, first]), _LEAST_ALONE
    length = math.sqrt(common[np.ix_(others, others)].mean())
    a, b = (float(common[k, others].mean()) / max(length, 1e-9) for k in (i, first))
    part = (float(common[i, first]) - a * b) / math.sqrt(max((1 - a * a) * (1 - b * b), 1e-9))
    return part, max(_LEAST_COMMON, 1.0 / (len(others) + 1) + _BY_CHANCE)


def _are_still(one: Fingerprint, other: Fingerprint) -> bool:
    """True unless the brightest stars of an image are at other places in another."""
    stars = one.stars_px[:_BRIGHTEST]
    if min(len(stars), len(other.stars_px)) < _FEWEST_STARS:
        return True
    distance_px, nearest = cKDTree(other.stars_px).query(stars)
    near = distance_px < _NEAR_PX
    if near.mean() < 0.5:
        return False
    offset_px = stars[near] - other.stars_px[nearest[near]]
    middle_px = np.median(offset_px, axis=0)
    scatter_px = MAD_TO_SIGMA * np.median(np.abs(offset_px - middle_px), axis=0)
    # A median has 1.25 times the error of a mean.
    limit_px = _SIGMAS * 1.25 * scatter_px / math.sqrt(near.sum()) + _STILL_PX
    return bool((np.abs(middle_px) < limit_px).all())
