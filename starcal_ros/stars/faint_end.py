# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Where the catalog goes deeper than the image: stars that no fit could measure."""

from __future__ import annotations

import numpy as np

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.stars.detection import Background, windows_about

_GROUP = 256  # stars of one mean: its noise is 0.06 of that of a star
# Of the least signal-to-noise ratio, 3 mag: a star of a dark group that is measured nevertheless
# would be refused, as it is twenty times as bright as the catalog has it.
_DARK = 0.05
_MOST_SNR = 3.0  # of a star in a mean: a bright neighbour lies in the window or in its border
_RADIUS_PX = 3
_CORE_PIXELS = 9


def detectable_count(pixels: Pixels, xy_px: Floats, background: Background, min_snr: float) -> int:
    """
    Number of the stars at pixels (n, 2), brightest first, that may have ``min_snr``.

    Groups of stars of similar brightness show together what no single one does: the light in the
    3 x 3 pixels at each place, above the level of the border of its window.  The stars after the
    first dark group are left out.
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
