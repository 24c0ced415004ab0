# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""One colour of an image: a plane of an RGB image, or the pixels of a colour in a Bayer mosaic."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

CHANNELS = ('red', 'green', 'blue')

# Encodings of sensor_msgs/image_encodings: the letters of their channels, and bytes per channel.
RGB_ENCODINGS = {
    f'{letters}{bits}': (letters, bits // 8)
    for letters in ('rgb', 'bgr', 'rgba', 'bgra')
    for bits in (8, 16)
}
BAYER_ENCODINGS = {
    f'bayer_{letters}{bits}': (letters, bits // 8)
    for letters in ('rggb', 'bggr', 'gbrg', 'grbg')
    for bits in (8, 16)
}


def plane(pixels: NDArray[Any], letters: str, channel: str) -> NDArray[Any]:
    """Pixels (h, w) of a channel of an image (h, w, c) whose channels have these letters."""
    return np.ascontiguousarray(pixels[:, :, letters.index(channel[0])])


def of_mosaic(pixels: NDArray[Any], letters: str, channel: str) -> NDArray[Any]:
    """
    Pixels (h // 2, w // 2) of a colour in a Bayer mosaic (h, w).

    Of green, those of the first of the two sites.  Pixel (u, v) is pixel (2 u + i, 2 v + j) of the
    mosaic with (i, j) from `site`: the prior camera must be one of this image.
    """
    i, j = site(letters, channel)
    height, width = pixels.shape
    return np.ascontiguousarray(pixels[j : height // 2 * 2 : 2, i : width // 2 * 2 : 2])


def site(letters: str, channel: str) -> tuple[int, int]:
    """Column and row (i, j) of the first site of a colour in a Bayer pattern, ``rggb``."""
    j, i = divmod(letters.index(channel[0]), 2)
    return i, j
