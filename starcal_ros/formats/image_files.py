# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Values and header cards of images in FITS, TIFF and PNG files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import math
import os
from pathlib import Path
from typing import Any, NamedTuple
import warnings

import cv2
import numpy as np
from numpy.typing import NDArray

from starcal_ros.errors import errors_as, IngestError, needing
from starcal_ros.formats import image_headers
from starcal_ros.formats.image_headers import has_surplus, png_header, tiff_header
from starcal_ros.formats.messages.sensor_messages import CHANNELS, of_mosaic, plane
from starcal_ros.untrusted import regular_file

_RGB, _GREY = 3, 2
MOST_VALUES = 2**27  # per image, all colours; the nodes have the same limit
MOST_BYTES = 2**29  # a larger file is not decoded


class Card(NamedTuple):
    """Value and comment of a FITS keyword."""

    value: Any
    comment: str = ''


def read_image(
    path: Path, hdu: str = '', channel: str = '', bayer: str = ''
) -> tuple[NDArray[Any], Mapping[str, Card]]:
    """
    Unscaled values (height, width) of an image file and its FITS cards; raises IngestError.

    ``hdu`` is the number or name of a FITS extension, empty for the first image; ``channel`` is
    red, green or blue of a colour image, ``bayer`` the pattern of a mosaic.
    """
    if is_fits(path):
        values, header = read_fits(path, hdu)
    else:
        content = content_of(path)
        if not (png_header(content) or tiff_header(content)):
            raise IngestError(f'{path}: not an image in FITS, TIFF or PNG')
        values, header = decoded(path, content), {}
        values = values[:, :, 2::-1] if values.ndim == _RGB else values  # BGR, with alpha last
    is_colour = values.ndim == _RGB and values.shape[2] == _RGB
    if (is_colour or bayer) and channel not in CHANNELS:
        raise IngestError(f'{path}: a colour image: choose --channel red, green or blue')
    if is_colour:
        values = plane(values, 'rgb', channel)
    elif bayer:
        values = of_mosaic(values, bayer.lower(), channel)
    if values.ndim != _GREY or min(values.shape) < 2:
        raise IngestError(
            f'{path}: array of shape {values.shape}, neither an image nor three colour planes: '
            'write each image to its own file'
        )
    return values, header


def is_fits(path: Path) -> bool:
    """True if a file is FITS by its content, compressed or not; raises IngestError."""
    with errors_as(IngestError, path):
        return image_headers.is_fits(path)


def read_fits(path: Path, hdu: str) -> tuple[NDArray[Any], Mapping[str, Card]]:
    """Values and cards of the image ``hdu``, or the first, of a FITS file; raises IngestError."""
    with needing('mission', IngestError, path):
        from astropy.io import fits
    try:
        # Not mapped to memory: scaled data cannot be, and files are read one at a time.
        with (
            _truncation_is_an_error(),
            regular_file(path) as file,
            fits.open(file, memmap=False, uint=True) as units,
        ):
            if hdu:
                unit = units[int(hdu) if hdu.lstrip('-').isdigit() else hdu]
            else:
                unit = next(
                    (u for u in units if u.is_image and u.header.get('NAXIS', 0) >= 2), None
                )
            if unit is None or not unit.is_image:
                raise IngestError(f'{path}: no image in the FITS file')
            sides = [unit.header.get(f'NAXIS{k + 1}', 0) for k in range(unit.header['NAXIS'])]
            # A compressed image of a few kilobytes can claim gigabytes of pixels.
            if math.prod(sides) > MOST_VALUES or unit.data is None:
                raise IngestError(f'{path}: no image of up to {MOST_VALUES} values')
            # The time may be in the primary header, the image in an extension.
            header = {**_cards(units[0].header), **_cards(unit.header)}
            values = np.asarray(unit.data)
    except (IngestError, MemoryError):
        raise
    except Exception as error:  # astropy raises any exception on a damaged file
        words = ' '.join(str(error).split())[:160]
        raise IngestError(f'{path}: not readable as FITS: {words}') from error
    values = values.squeeze()
    if values.ndim == _RGB and values.shape[0] == _RGB:
        values = np.moveaxis(values, 0, -1)  # a cube of three planes
    return values.astype(values.dtype.newbyteorder('=')), header


def _cards(header: Any) -> dict[str, Card]:
    """Cards of a header of astropy; the first of duplicate keywords counts."""
    cards: dict[str, Card] = {}
    for card in header.cards:
        try:
            value = Card(card.value, card.comment)
        except Exception:  # astropy cannot parse it: keep the text, fail only where it is used
            value = Card(str(card.image)[10:].strip())
        cards.setdefault(card.keyword, value)
    return cards


@contextlib.contextmanager
def _truncation_is_an_error() -> Iterator[None]:
    """Raise on astropy's warning of a truncated file, and drop its other warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        warnings.filterwarnings('error', message='File may have been truncated')
        yield


def content_of(path: Path, first_bytes: int = MOST_BYTES) -> bytes:
    """Content of an image file, or its first bytes; raises IngestError if it cannot be read."""
    with errors_as(IngestError, path), regular_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > MOST_BYTES:
            raise ValueError(f'larger than {MOST_BYTES // 2**20} MB')
        return file.read(min(size, first_bytes))


def decoded(path: Path, content: bytes) -> NDArray[Any]:
    """
    Values of an image file without EXIF rotation, colour as BGR; raises IngestError.

    The size in the header of a PNG or TIFF is checked before anything is decoded.
    """
    header = png_header(content) or tiff_header(content)
    if header and header.width * header.height * header.channels > MOST_VALUES:
        raise IngestError(f'{path}: its header claims {header.width} x {header.height} pixels')
    if header and png_header(content) and has_surplus(content, header):
        raise IngestError(f'{path}: inflates to far more than its pixels')
    values = None
    with contextlib.suppress(cv2.error):
        values = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise IngestError(f'{path}: damaged, or in a format that OpenCV cannot read')
    return np.asarray(values)
