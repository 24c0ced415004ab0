# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Kind of a file by its content, and size of an image before it is decoded.

The first bytes decide, not the name.  Each kind that is not read names the command that makes a
readable file of it.
"""

from __future__ import annotations

import bz2
from collections.abc import Mapping
from dataclasses import dataclass
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
# Colour type -> channels; a palette is decoded to three colours.
_PNG_CHANNELS: Mapping[int, int] = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_WIDTH, _HEIGHT, _CHANNELS = 256, 257, 277  # tags of TIFF 6.0
_TIFF_TYPES = {3: 'H', 4: 'I'}
_TIFF_MOST_ENTRIES = 1000


@dataclass(frozen=True)
class FileKind:
    """
    Kind of a file: its name with an article, and whether it is an image.

    ``instead`` is empty if the kind is read, else the command that makes a readable file of FILE.
    """

    name: str
    is_image: bool = False
    instead: str = ''


MCAP = FileKind('an MCAP bag')
SQLITE_BAG = FileKind('an SQLite bag')
ROS_1_BAG = FileKind('a ROS 1 bag')
UNKNOWN = FileKind('a file of no known format')
JPEG, PNG, TIFF, FITS, RAW = (
    FileKind(name, is_image=True)
    for name in ('a JPEG', 'a PNG', 'a TIFF', 'a FITS file', 'a camera raw file')
)
_MAGICK = 'magick FILE FILE.png'
_HEIF = FileKind('a HEIF image (HEIC)', True, 'heif-convert FILE FILE.jpg')
_VIDEO = FileKind('a video', True, 'ffmpeg -i FILE FILE_%04d.png')
_UNZIP = FileKind('a zip archive', instead='unzip FILE -d unzipped')
# Offset and bytes; the first that match count.
_MAGIC: tuple[tuple[int, bytes, FileKind], ...] = (
    (0, b'\x89MCAP0\r\n', MCAP),
    (0, b'SQLite format 3', SQLITE_BAG),
    (0, b'#ROSBAG V', ROS_1_BAG),
    (0, b'\xff\xd8\xff', JPEG),
    (0, b'\x89PNG\r\n\x1a\n', PNG),
    (0, b'SIMPLE  =', FITS),
    (0, b'FUJIFILMCCD-RAW', RAW),
    (8, b'CR\x02', RAW),
    (0, b'IIRO', RAW),
    (0, b'IIRS', RAW),
    (0, b'MMOR', RAW),
    (0, b'IIU\0', RAW),
    (0, b'II*\0', TIFF),
    (0, b'MM\0*', TIFF),
    (4, b'ftypcrx ', RAW),
    (4, b'ftypavif', FileKind('an AVIF image', True, _MAGICK)),
    (4, b'ftyphe', _HEIF),
    (4, b'ftypmif1', _HEIF),
    (4, b'ftypmsf1', _HEIF),
    (4, b'ftyp', _VIDEO),
    (8, b'AVI ', _VIDEO),
    (0, b'\x1aE\xdf\xa3', _VIDEO),  # Matroska and WebM
    (0, b'LUCAM-RECORDER', _VIDEO),  # SER
    (0, b'XISF0100', FileKind('an XISF image', True, 'save it as FITS where it was made')),
    (8, b'WEBP', FileKind('a WebP image', True, _MAGICK)),
    (0, b'GIF8', FileKind('a GIF image', True, _MAGICK)),
    (0, b'\0\0\0\x0cjP  ', FileKind('a JPEG 2000 image', True, _MAGICK)),
    (0, b'8BPS', FileKind('a Photoshop image', True, _MAGICK)),
    (0, b'(\xb5/\xfd', FileKind('a file compressed by zstd', instead='zstd -d FILE')),
    (0, b'\x04"M\x18', FileKind('a file compressed by lz4', instead='lz4 -d FILE')),
    (0, b'\xfd7zXZ\0', FileKind('a file compressed by xz', instead='xz -dk FILE')),
    (0, b'BZh', FileKind('a file compressed by bzip2', instead='bunzip2 -k FILE')),
    (0, b'\x1f\x8b', FileKind('a file compressed by gzip', instead='gunzip -k FILE')),
    (0, b'PK\x03\x04', _UNZIP),
    (257, b'ustar', FileKind('a tar archive', instead='tar xf FILE')),
)
# Camera raw has the first bytes of a TIFF in these, whose first image is a preview.
_RAW_ENDINGS = ('.dng', '.nef', '.nrw', '.arw', '.sr2', '.pef', '.srw', '.3fr', '.iiq', '.raw')
_BMP_RESERVED = slice(6, 10)
_COMPRESSED_FITS = (b'\x1f\x8b', b'BZh')  # astropy reads them


def kind_of(path: Path) -> FileKind:
    """Kind of a regular file; raises OSError, or ValueError in one line for another file."""
    with regular_file(path) as file:
        start = file.read(_START_BYTES)
        if start.startswith(_COMPRESSED_FITS):
            start += file.read(_BLOCK_BYTES)
            if _inflated(start).startswith(b'SIMPLE  ='):
                return FITS
    if start.startswith(b'BM') and start[_BMP_RESERVED] == bytes(4):
        return FileKind('a BMP image', is_image=True)
    kinds = (kind for at, magic, kind in _MAGIC if start[at : at + len(magic)] == magic)
    kind = next(kinds, UNKNOWN)
    return RAW if kind is TIFF and path.name.lower().endswith(_RAW_ENDINGS) else kind


def _inflated(start: bytes) -> bytes:
    """First bytes of the content of a file compressed by gzip or bzip2."""
    is_gzip = start.startswith(b'\x1f\x8b')
    try:
        if is_gzip:
            return zlib.decompressobj(31).decompress(start, 64)
        return bz2.BZ2Decompressor().decompress(start, 64)
    except (zlib.error, OSError):
        return b''


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
