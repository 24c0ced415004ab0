# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Size of an image file, read before it is decoded."""

from __future__ import annotations

import bz2
from collections.abc import Mapping
import contextlib
from pathlib import Path
import struct
from typing import NamedTuple
import zlib

from starcal_ros.untrusted import regular_file

_START_BYTES = 512
_BLOCK_BYTES = 2**20  # bzip2 gives its first byte after a block of 900 kB
PNG_HEADER_BYTES = 33
_PNG_START = b'\x89PNG\r\n\x1a\n\0\0\0\rIHDR'
_PNG_CHUNK = struct.Struct('>I4s')  # length, name
_PNG_MOST_CHUNKS = 100_000
_JPEG_MOST_SEGMENTS = 1000
# Colour type -> channels; a palette is decoded to three colours.
_PNG_CHANNELS: Mapping[int, int] = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_WIDTH, _HEIGHT, _CHANNELS = 256, 257, 277  # tags of TIFF 6.0
_TIFF_TYPES = {3: 'H', 4: 'I'}
_TIFF_MOST_ENTRIES = 1000


class Header(NamedTuple):
    """Size of an image file, px, and its channels."""

    width: int
    height: int
    channels: int


def png_header(content: bytes) -> Header | None:
    """Header at the start of a PNG (PNG 1.2, section 4.1.1); None if it is not a PNG."""
    if content[:16] != _PNG_START or len(content) < PNG_HEADER_BYTES:
        return None
    width, height, _, colour = struct.unpack_from('>IIBB', content, 16)
    return Header(width, height, _PNG_CHANNELS.get(colour, 0))


def jpeg_header(content: bytes) -> Header | None:
    """Header of a JPEG (ITU T.81, B.2.2), from its frame; None if it is not a JPEG."""
    if content[:2] != b'\xff\xd8':
        return None
    at = 2
    with contextlib.suppress(struct.error):
        for _ in range(_JPEG_MOST_SEGMENTS):
            mark, code, length = struct.unpack_from('>BBH', content, at)
            if mark != 0xFF:
                break
            if code == 0xFF:  # a byte of fill
                at += 1
                continue
            if 0xC0 <= code <= 0xCF and code not in (0xC4, 0xC8, 0xCC):  # tables, not a frame
                height, width, channels = struct.unpack_from('>HHB', content, at + 5)
                return Header(width, height, channels)
            at += 2 + length
    return None


def has_surplus(content: bytes, header: Header) -> bool:
    """
    True if a PNG inflates to far more than its pixels, which a decoder would throw away.

    A megabyte of compressed data can hold a gigabyte: seconds for nothing.
    """
    most = 2 * (2 * header.width * header.channels + 8) * header.height  # of 16 bit, interlaced
    inflate, at, size = zlib.decompressobj(), 8, 0
    for _ in range(_PNG_MOST_CHUNKS):
        if at + _PNG_CHUNK.size > len(content):
            return False
        length, name = _PNG_CHUNK.unpack_from(content, at)
        at += _PNG_CHUNK.size
        if name == b'IDAT':
            try:
                size += len(inflate.decompress(content[at : at + length], most - size + 1))
            except zlib.error:
                return False  # the decoder refuses it
            if size > most:
                return True
        at += length + 4  # its checksum
    return True


def tiff_header(content: bytes) -> Header | None:
    """Header of the first image of a TIFF (TIFF 6.0, section 2); None if it is not a TIFF."""
    order = {b'II*\0': '<', b'MM\0*': '>'}.get(content[:4])
    if order is None:
        return None
    tags = {_CHANNELS: 1}
    try:
        (start,) = struct.unpack_from(f'{order}I', content, 4)
        (count,) = struct.unpack_from(f'{order}H', content, start)
        for at in range(start + 2, start + 2 + min(count, _TIFF_MOST_ENTRIES) * 12, 12):
            tag, kind, number = struct.unpack_from(f'{order}HHI', content, at)
            if tag in (_WIDTH, _HEIGHT, _CHANNELS) and number == 1:
                (tags[tag],) = struct.unpack_from(f'{order}{_TIFF_TYPES[kind]}', content, at + 8)
        return Header(tags[_WIDTH], tags[_HEIGHT], tags[_CHANNELS])
    except (struct.error, KeyError):
        return None


def is_fits(path: Path) -> bool:
    """True for a FITS file, compressed or not; raises OSError or ValueError for no file."""
    with regular_file(path) as file:
        start = file.read(_START_BYTES)
        if start.startswith(b'\x1f\x8b'):
            with contextlib.suppress(zlib.error):
                start = zlib.decompressobj(31).decompress(start, 64)
        elif start.startswith(b'BZh'):
            with contextlib.suppress(OSError):
                start = bz2.BZ2Decompressor().decompress(start + file.read(_BLOCK_BYTES), 64)
    return start.startswith(b'SIMPLE  =')
