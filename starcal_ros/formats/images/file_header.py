# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Size and channels of a PNG or TIFF, and bounds of its pixels, read before one is decoded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import struct
import zlib

PNG_HEADER_BYTES = 33

_PNG = struct.Struct('>8sI4sIIBB7x')  # signature, length, name, width, height, depth, colour
_PNG_SIGNATURE = b'\x89PNG\r\n\x1a\n'
_PNG_CHUNK = struct.Struct('>I4s')  # length, name
_PNG_MOST_CHUNKS = 100_000
# Colour type -> channels; a palette is decoded to three colours.
_PNG_CHANNELS: Mapping[int, int] = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_TIFF_ENTRY_BYTES = 12
_WIDTH, _HEIGHT, _CHANNELS = 256, 257, 277  # tags of TIFF 6.0
_TIFF_TYPES = {3: 'H', 4: 'I'}
_TIFF_MOST_ENTRIES = 1000
_JPEG_START, _JPEG_SCAN, _JPEG_END = b'\xff\xd8', b'\xff\xda', b'\xff\xd9'


@dataclass(frozen=True)
class Header:
    """Size of an image file, px, and its channels."""

    width: int
    height: int
    channels: int


def png_header(content: bytes) -> Header | None:
    """Header at the start of a PNG (PNG 1.2, section 4.1.1); None if it is not a PNG."""
    if len(content) < _PNG.size:
        return None
    signature, length, name, width, height, _, colour = _PNG.unpack_from(content)
    if (signature, length, name) != (_PNG_SIGNATURE, 13, b'IHDR'):
        return None
    return Header(width, height, _PNG_CHANNELS.get(colour, 0))


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
    try:
        (start,) = struct.unpack_from(f'{order}I', content, 4)
        (count,) = struct.unpack_from(f'{order}H', content, start)
        tags = {_CHANNELS: 1}
        for k in range(min(count, _TIFF_MOST_ENTRIES)):
            at = start + 2 + k * _TIFF_ENTRY_BYTES
            tag, kind, number = struct.unpack_from(f'{order}HHI', content, at)
            if tag in (_WIDTH, _HEIGHT, _CHANNELS):
                if number != 1 or kind not in _TIFF_TYPES:
                    return None
                (tags[tag],) = struct.unpack_from(f'{order}{_TIFF_TYPES[kind]}', content, at + 8)
        return Header(tags[_WIDTH], tags[_HEIGHT], tags[_CHANNELS])
    except (struct.error, KeyError):
        return None


def is_cut_jpeg(content: bytes) -> bool:
    """
    True for a JPEG without an end (ISO 10918-1, annex B).

    Some versions of OpenCV fill what is missing with grey.
    """
    if not content.startswith(_JPEG_START):
        return False
    at = len(_JPEG_START)
    # A thumbnail in a segment before the scan has an end of its own.
    while content[at : at + 1] == b'\xff' and content[at : at + 2] != _JPEG_SCAN:
        at += 2 + int.from_bytes(content[at + 2 : at + 4], 'big')
    return content.find(_JPEG_END, at) < 0
