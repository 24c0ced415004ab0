# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images in FITS, TIFF and PNG files: kind and size before they are decoded, values, cards."""

from __future__ import annotations

import bz2
from collections.abc import Iterator, Mapping
import contextlib
import math
import os
from pathlib import Path
import struct
from typing import Any, NamedTuple
import warnings
import zlib

import numpy as np

from starcal_ros.arrays import AnyArray
from starcal_ros.errors import errors_as, IngestError, needing
from starcal_ros.formats.messages import sensor_messages
from starcal_ros.untrusted import regular_file

_RGB, _GREY = 3, 2
MOST_VALUES = sensor_messages.MOST_PIXELS  # per image: of all channels, or planes of FITS
MOST_BYTES = 2**29  # a larger file is not decoded
_START_BYTES = 512
_BLOCK_BYTES = 2**20  # bzip2 gives its first byte after a block of 900 kB
_WIDTH, _HEIGHT, _CHANNELS = 256, 257, 277  # tags of TIFF 6.0
_TIFF_TYPES = {3: 'H', 4: 'I'}
_TIFF_MOST_ENTRIES = 1000


class Card(NamedTuple):
    """Value and comment of a FITS keyword."""

    value: Any
    comment: str = ''


def read_image(
    path: Path, hdu: str = '', channel: str = '', bayer: str = ''
) -> tuple[AnyArray, Mapping[str, Card]]:
    """
    Unscaled values (height, width) of an image file and its FITS cards; raises IngestError.

    ``hdu`` is the number or name of a FITS extension, empty for the first image; ``channel`` is
    red, green or blue of a colour image, ``bayer`` the pattern of a mosaic.
    """
    if is_fits(path):
        values, header = read_fits(path, hdu)
    else:
        content = content_of(path)
        if not (sensor_messages.png_header(content) or tiff_header(content)):
            raise IngestError(f'{path}: not an image in FITS, TIFF or PNG')
        values, header = decoded(path, content), {}
        values = values[:, :, 2::-1] if values.ndim == _RGB else values  # BGR, with alpha last
    is_colour = values.ndim == _RGB and values.shape[2] == _RGB
    if (is_colour or bayer) and channel not in sensor_messages.CHANNELS:
        raise IngestError(f'{path}: a colour image: choose --channel red, green or blue')
    if is_colour:
        values = sensor_messages.plane(values, 'rgb', channel)
    elif bayer:
        values = sensor_messages.of_mosaic(values, bayer.lower(), channel)
    _check_shape(path, values.shape)
    return values, header


def _check_shape(path: Path, shape: tuple[int, ...]) -> None:
    if not (len(shape) == _GREY or shape[_GREY:] == (_RGB,)) or min(shape) < 2:
        raise IngestError(
            f'{path}: array of shape {shape}, neither an image nor three colour planes: write '
            'each image to its own file'
        )


def tiff_header(content: bytes, page: int = 0) -> sensor_messages.Header | None:
    """Header of an image of a TIFF (TIFF 6.0, section 2); None if it is not there, or no TIFF."""
    order = {b'II*\0': '<', b'MM\0*': '>'}.get(content[:4])
    if order is None:
        return None
    tags = {_CHANNELS: 1}
    try:
        (start,) = struct.unpack_from(f'{order}I', content, 4)
        for _ in range(page):
            (count,) = struct.unpack_from(f'{order}H', content, start)
            (start,) = struct.unpack_from(f'{order}I', content, start + 2 + count * 12)
        if not start:
            return None
        (count,) = struct.unpack_from(f'{order}H', content, start)
        for at in range(start + 2, start + 2 + min(count, _TIFF_MOST_ENTRIES) * 12, 12):
            tag, kind, number = struct.unpack_from(f'{order}HHI', content, at)
            if tag in (_WIDTH, _HEIGHT, _CHANNELS) and number == 1:
                (tags[tag],) = struct.unpack_from(f'{order}{_TIFF_TYPES[kind]}', content, at + 8)
        return sensor_messages.Header(tags[_WIDTH], tags[_HEIGHT], tags[_CHANNELS])
    except (struct.error, KeyError):
        return None


def is_fits(path: Path) -> bool:
    """True for a FITS file, compressed or not; raises IngestError."""
    with errors_as(IngestError, path), regular_file(path) as file:
        start = file.read(_START_BYTES)
        if start.startswith(b'\x1f\x8b'):
            with contextlib.suppress(zlib.error):
                start = zlib.decompressobj(31).decompress(start, 64)
        elif start.startswith(b'BZh'):
            with contextlib.suppress(OSError):
                start = bz2.BZ2Decompressor().decompress(start + file.read(_BLOCK_BYTES), 64)
    return start.startswith(b'SIMPLE  =')


def read_fits(path: Path, hdu: str) -> tuple[AnyArray, Mapping[str, Card]]:
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
    _check_shape(path, values.shape)
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


def decoded(path: Path, content: bytes) -> AnyArray:
    """Values of an image file of one image, by `sensor_messages.decoded`; raises IngestError."""
    header = sensor_messages.png_header(content) or tiff_header(content)
    with errors_as(IngestError, path):
        if header and math.prod(header) > MOST_VALUES:
            raise ValueError(f'its header claims {header.width} x {header.height} pixels')
        if header and tiff_header(content, 1) == header:
            raise ValueError('several images: write each image to its own file')
        return sensor_messages.decoded(content, header)
