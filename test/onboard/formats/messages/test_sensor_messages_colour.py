# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Colour images of messages: the plane or the sites of one colour."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from starcal_ros.errors import ImageRefused
from starcal_ros.formats.messages.sensor_messages import (
    BAYER_ENCODINGS,
    CHANNELS,
    decode_image,
    RGB_ENCODINGS,
)

LETTER = {'red': 'r', 'green': 'g', 'blue': 'b'}


def raw(encoding: str, width: int, height: int, step: int, data: bytes) -> Any:
    """Return the fields of a sensor_msgs/Image that are read."""
    sizes = {'width': width, 'height': height, 'step': step}
    return SimpleNamespace(encoding=encoding, is_bigendian=False, data=data, **sizes)


@pytest.mark.parametrize('channel', CHANNELS)
@pytest.mark.parametrize('encoding', list(RGB_ENCODINGS))
def test_a_plane_is_taken_whatever_its_place(encoding: str, channel: str) -> None:
    letters, size = RGB_ENCODINGS[encoding]
    dtype = np.uint8 if size == 1 else np.uint16
    pixels = np.random.default_rng(1).integers(0, 200, (5, 7, len(letters)), dtype)
    padded = np.zeros((5, 7 * len(letters) * size + 3), np.uint8)
    padded[:, :-3] = pixels.reshape(5, -1).view(np.uint8)
    found = decode_image(raw(encoding, 7, 5, padded.shape[1], padded.tobytes()), 1, channel)
    expected = pixels[:, :, letters.index(LETTER[channel])]
    assert found.pixels.dtype == dtype and (found.pixels == expected).all()


@pytest.mark.parametrize('channel', CHANNELS)
@pytest.mark.parametrize('encoding', list(BAYER_ENCODINGS))
def test_the_sites_of_a_colour_are_taken(encoding: str, channel: str) -> None:
    letters, size = BAYER_ENCODINGS[encoding]
    # Each pixel holds the letter of its colour: an odd row and column are left over.
    pattern = np.array([ord(letter) for letter in letters], np.uint8).reshape(2, 2)
    mosaic = np.tile(pattern, (3, 4))[:5, :7].astype(np.uint8 if size == 1 else np.uint16)
    step = 7 * size
    found = decode_image(raw(encoding, 7, 5, step, mosaic.tobytes()), 1, channel)
    assert found.pixels.shape == (2, 3) and (found.pixels == ord(LETTER[channel])).all()


def test_a_colour_image_without_a_channel_is_refused_with_the_remedy() -> None:
    for encoding in ('rgb8', 'bayer_rggb8'):
        with pytest.raises(ImageRefused, match='set image_channel'):
            decode_image(raw(encoding, 2, 2, 6, bytes(12)), 1)
