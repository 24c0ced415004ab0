# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images in FITS, TIFF and PNG files: kind and size before they are decoded, values, cards.

The pixels of FITS are those of the largest image of the file, its overscan cut off, its first row
at the top, by the keywords `ROW_ORDER`, `REGION` and `WITHOUT_LIGHT`.
"""

from __future__ import annotations

import bz2
from collections.abc import Iterator, Mapping
import contextlib
import math
import os
from pathlib import Path
import re
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

# Extensions that are of the image and no image of the sky, by their names.
_OF_ANOTHER = re.compile(r'BPM|MASK|DQ|ERR|VAR|WHT|WEIGHT|IVAR|UNC|NOISE|BACK|BKG|FLAG|THUMB')
_SECTION = re.compile(r'\[(\d+):(\d+),(\d+):(\d+)\]')
# Keywords, of which the first in a header counts.
ROW_ORDER = ('ROWORDER',)
REGION = ('TRIMSEC', 'DATASEC')
WITHOUT_LIGHT = ('BIASSEC',)


class Card(NamedTuple):
    """Value and comment of a FITS keyword."""

    value: Any
    comment: str = ''


class FitsImage(NamedTuple):
    """
    Unscaled values (height, width), or with three channels, of a FITS file, and its cards.

    ``pixels_of`` states which pixels of the file the values are, empty for all of them, in order;
    ``first`` are the column and row of the first of them in the file, rows from the top.
    """

    values: AnyArray
    header: Mapping[str, Card]
    pixels_of: str = ''
    first: tuple[int, int] = (0, 0)


def read_image(path: Path) -> AnyArray:
    """Values of a FITS, TIFF or PNG, (height, width) or with channels; raises IngestError."""
    if is_fits(path):
        return read_fits(path).values
    content = content_of(path)
    if not (sensor_messages.png_header(content) or tiff_header(content)):
        raise IngestError(f'{path}: not an image in FITS, TIFF or PNG')
    values = in_rgb(decoded(path, content))
    check_shape(path, values.shape)
    return values


def in_rgb(values: AnyArray) -> AnyArray:
    """Values of `decoded` with the channels red, green and blue."""
    return values[:, :, 2::-1] if values.ndim == _RGB else values  # BGR, with alpha last


def check_shape(path: Path, shape: tuple[int, ...]) -> None:
    """Raise IngestError for an array that is neither an image nor three colour planes."""
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


def read_fits(path: Path, hdu: str = '') -> FitsImage:
    """Image ``hdu`` of a FITS file, or the largest one; raises IngestError."""
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
                unit, words = units[int(hdu) if hdu.lstrip('-').isdigit() else hdu], ''
            else:
                unit, words = _largest(units)
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
        text = ' '.join(str(error).split())[:160]
        raise IngestError(f'{path}: not readable as FITS: {text}') from error
    values = values.squeeze()
    if values.ndim == _RGB and values.shape[0] == _RGB:
        values = np.moveaxis(values, 0, -1)  # a cube of three planes
    check_shape(path, values.shape)
    image = _upright(values.astype(values.dtype.newbyteorder('=')), header)
    return image._replace(pixels_of=', '.join(filter(None, [words, image.pixels_of])))


def _largest(units: Any) -> tuple[Any, str]:
    """The largest image of a file, the first of equal ones, and words where there are several."""
    images = [
        (k, unit)
        for k, unit in enumerate(units)
        if unit.is_image and unit.header.get('NAXIS', 0) >= _GREY
    ]
    of_sky = [one for one in images if not _OF_ANOTHER.search(str(one[1].name).upper())] or images
    if not of_sky:
        return None, ''
    sides = [(unit.header['NAXIS1'], unit.header['NAXIS2']) for _, unit in of_sky]
    most = max(sides, key=math.prod)
    number, unit = of_sky[sides.index(most)]
    count = sides.count(most)
    return unit, f'HDU {number} of {count} images of one size' * (count > 1)


def _upright(values: AnyArray, header: Mapping[str, Card]) -> FitsImage:
    """The image without overscan, its first row at the top."""
    height, width = values.shape[:2]
    (left, right), (low, high), words = _region(header, width, height)
    values = values[low:high, left:right]
    if _text(header, ROW_ORDER).upper().startswith('BOTTOM'):
        words = ', '.join(filter(None, [words, 'rows last to first (ROWORDER)']))
        return FitsImage(values[::-1], header, words, (left, height - high))
    return FitsImage(values, header, words, (left, low))


def _text(header: Mapping[str, Card], keywords: tuple[str, ...]) -> str:
    """Text of the first of some keywords that a header has; empty if none."""
    return next((str(header[key].value).strip() for key in keywords if key in header), '')


def _region(
    header: Mapping[str, Card], width: int, height: int
) -> tuple[tuple[int, int], tuple[int, int], str]:
    """
    First and end column, and row, of the light in an image, counted from 0, and words on it.

    A region of the size of the image was cut by the program that wrote it.
    """
    whole = (0, width), (0, height)
    stating = [key for key in REGION if key in header]
    for key in stating:
        section = _section(str(header[key].value), width, height)
        if section is not None:
            return *section, _in_words(*section, key) * (section != whole)
    if stating:
        return *whole, f'{stating[0]} is not in the image: nothing cut off'
    strip = _section(_text(header, WITHOUT_LIGHT), width, height)
    if strip is None:
        return *whole, ''
    (left, right), (low, high) = strip
    kept = whole
    if (low, high) == whole[1] and (left == 0) != (right == width):
        kept = ((right, width) if left == 0 else (0, left)), (0, height)
    elif (left, right) == whole[0] and (low == 0) != (high == height):
        kept = (0, width), ((high, height) if low == 0 else (0, low))
    return *kept, _in_words(*kept, WITHOUT_LIGHT[0]) * (kept != whole)


def _section(text: str, width: int, height: int) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Columns and rows of a section, from 0, without the end; None if it is not in the image."""
    match = _SECTION.fullmatch(text.replace(' ', ''))
    if not match:
        return None
    x, y = (sorted(map(int, match.groups()[k : k + 2])) for k in (0, 2))
    if (x[1] - x[0] + 1, y[1] - y[0] + 1) == (width, height):
        return (0, width), (0, height)
    if x[0] < 1 or y[0] < 1 or x[1] > width or y[1] > height or x[0] == x[1] or y[0] == y[1]:
        return None
    return (x[0] - 1, x[1]), (y[0] - 1, y[1])


def _in_words(columns: tuple[int, int], rows: tuple[int, int], key: str) -> str:
    return f'columns {columns[0] + 1} to {columns[1]}, rows {rows[0] + 1} to {rows[1]} ({key})'


def _cards(header: Any) -> dict[str, Card]:
    """Cards of a header of astropy; the first of duplicate keywords counts."""
    cards: dict[str, Card] = {}
    for card in header.cards:
        try:
            value = Card(card.value, card.comment)
        except Exception:  # astropy cannot parse it: keep the text, fail only where it is used
            value = Card(str(card.image)[10:].strip())
        cards.setdefault(str(card.keyword).upper(), value)
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
