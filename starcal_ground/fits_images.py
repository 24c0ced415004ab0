# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""FITS images with the colour mosaic that their header states, checked by the levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import re
from typing import NamedTuple

import numpy as np

from starcal_ground.fits_keywords import stated, text_of, value_of
from starcal_ros.arrays import AnyArray
from starcal_ros.errors import IngestError
from starcal_ros.formats import image_files
from starcal_ros.formats.image_files import Card

_PATTERN = re.compile('[RGBCMYW]{4}')  # a colour filter mosaic of 2 x 2 pixels
_OTHER_GREENS = 0.05
_PATTERNS = ('RGGB', 'BGGR', 'GBRG', 'GRBG')


class FileImage(NamedTuple):
    """
    Unscaled values (height, width), or with three channels, of an image file.

    ``header`` are its FITS cards, ``mosaic`` its Bayer pattern, empty for none; ``pixels_of``
    states which pixels of the file the values are, empty for all of them, in order.
    """

    values: AnyArray
    header: Mapping[str, Card]
    mosaic: str = ''
    pixels_of: str = ''


def read_fits(path: Path, hdu: str = '') -> FileImage:
    """Image ``hdu`` of a FITS file, or the largest one; raises IngestError."""
    image = image_files.read_fits(path, hdu)
    pattern = text_of(image.header, 'mosaic').upper()
    if image.values.ndim != 2 or not _PATTERN.fullmatch(pattern):
        return FileImage(image.values, image.header, '', image.pixels_of)
    key = stated(image.header, 'mosaic')
    if pattern not in _PATTERNS:
        raise IngestError(
            f'{path}: {key} {pattern}: of mosaics {", ".join(_PATTERNS)} are read: write one'
            ' colour of it to a file'
        )
    letters = _at_first_pixel(pattern, image)
    words = ', '.join(filter(None, [image.pixels_of, f'mosaic {letters} ({key})']))
    return FileImage(image.values, image.header, letters.lower(), words)


def _at_first_pixel(pattern: str, image: image_files.FitsImage) -> str:
    """Letters of a pattern, row by row, from the first pixel of an image on."""
    header, (left, top) = image.header, image.first
    x, y = (
        int(value_of(header, key)) if (key := stated(header, f'first {side} in the mosaic')) else 0
        for side in ('column', 'row')
    )
    rows = [pattern[:2], pattern[2:]]
    shifted = [rows[(j + y + top) % 2][(i + x + left) % 2] for j in (0, 1) for i in (0, 1)]
    if _has_other_greens(image.values, shifted):
        shifted = shifted[2:] + shifted[:2]
    return ''.join(shifted)


def _has_other_greens(values: AnyArray, letters: Sequence[str]) -> bool:
    """
    True if the two sites without green of a mosaic have one level, and those of green have not.

    A program that turns an image over, or counts rows from the other end, leaves the keyword as
    it is.  The greens of a detector differ by a percent or two.
    """
    levels = [float(np.nanmedian(values[j::2, i::2])) for j in (0, 1) for i in (0, 1)]
    greens = [level for level, letter in zip(levels, letters, strict=True) if letter == 'G']
    others = [level for level, letter in zip(levels, letters, strict=True) if letter != 'G']
    green, other = float(np.ptp(greens)), float(np.ptp(others))
    return green > _OTHER_GREENS * abs(float(np.mean(levels))) and other < green / 3.0
