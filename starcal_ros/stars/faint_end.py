# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Number of catalog stars that are bright enough to be measured in an image."""

from __future__ import annotations

import numpy as np

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.stars.detection import Background, windows_about

_GROUP = 256  # stars of one mean: its noise is 0.06 of that of a star
# Share of the smallest signal-to-noise ratio, 3 mag.  A measurable star in a dark group would be
# refused anyway, since it is twenty times as bright as in the catalog.
_DARK = 0.05
_MOST_SNR = 3.0  # limits the effect of a bright neighbour on the mean of a group
_RADIUS_PX = 3
_CORE_PIXELS = 9


def detectable_count(pixels: Pixels, xy_px: Floats, background: Background, min_snr: float) -> int:
    """
    Number of the stars at pixels (n, 2), brightest first, that may have ``min_snr``.

    The signal-to-noise ratio of 3 x 3 pixels above the border of their window is averaged over
    groups of stars of similar brightness, since noise hides a single faint star.  Stars after the
    first dark group are not counted.
    """
    height, width = pixels.shape
    if len(xy_px) <= _GROUP:
        return len(xy_px)
    inner = np.array([width, height]) - 1 - _RADIUS_PX
    # A window at the edge is moved inside: it shows no star, and few windows are at an edge.
    centre = np.clip(np.rint(xy_px).astype(np.int64), _RADIUS_PX, inner)
    windows = windows_about(pixels, centre, _RADIUS_PX).astype(np.float32)
    core = windows[:, 2:-2, 2:-2].sum(axis=(1, 2))
    windows[:, 1:-1, 1:-1] = 0.0
    border_pixels = 4 * (2 * _RADIUS_PX)
    light = core - _CORE_PIXELS / border_pixels * windows.sum(axis=(1, 2))
    noise = background.noise_at(xy_px) * np.sqrt(
        _CORE_PIXELS * (1.0 + _CORE_PIXELS / border_pixels)
    )
    snr = np.clip(light / noise, -_MOST_SNR, _MOST_SNR)
    groups = len(snr) // _GROUP
    mean = snr[: groups * _GROUP].reshape(groups, _GROUP).mean(axis=1)
    dark = np.flatnonzero(mean < _DARK * min_snr)
    return (int(dark[0]) + 1) * _GROUP if len(dark) else len(xy_px)
