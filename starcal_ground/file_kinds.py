# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Kind of a file by its content: images, bags, and what people give in their place.

The first bytes decide, not the name.  Each kind that is not read names the command that makes a
readable file of it.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
import shlex

from starcal_ros.errors import IngestError, NotABag, StarcalError
from starcal_ros.formats.image_files import is_fits
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.untrusted import regular_file

_START_BYTES, _YAML_BYTES = 512, 2**18
_YAML_FILES = (
    (b'ros__parameters', 'parameters', '--params '),
    (b'camera_matrix', 'a camera file', '--set camera_info_url='),
)
_OF_IMAGES = (
    ': starcal calibrate, inspect, diagnose and plan take images alone; starcal import makes a bag'
    ' of image files and attitudes'
)
_NOR_IMAGES = ', nor images (FITS, TIFF, PNG, JPEG, camera raw), which calibrate takes'
# Topics of other types may be unknown to the converter, which then stops.
_CONVERTED = frozenset(
    [
        codec.IMAGE_TYPE,
        codec.COMPRESSED_TYPE,
        *codec.ATTITUDE_TYPES,
        codec.VELOCITY_TYPE,
        codec.TEMPERATURE_TYPE,
    ]
)


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


def kind_of(path: Path) -> FileKind:
    """Kind of a regular file; raises OSError or IngestError for none."""
    if is_fits(path):
        return FITS
    with regular_file(path) as file:
        start = file.read(_START_BYTES)
    if start.startswith(b'BM') and start[_BMP_RESERVED] == bytes(4):
        return FileKind('a BMP image', is_image=True)
    kinds = (kind for at, magic, kind in _MAGIC if start[at : at + len(magic)] == magic)
    kind = next(kinds, UNKNOWN)
    return RAW if kind is TIFF and path.name.lower().endswith(_RAW_ENDINGS) else kind


def explained(error: StarcalError) -> str:
    """Text of an error; where a bag was expected, with what is there, and what helps."""
    if isinstance(error, NotABag):
        place = error.place
        with contextlib.suppress(OSError, ValueError, IngestError):
            instead = _instead_of_any(place) if place.is_dir() else _instead(place, kind_of(place))
            if instead:
                return f'{str(error).partition(" (did")[0]}{instead}'
            return f'{error}{"" if " (did" in str(error) else _NOR_IMAGES}'
    return str(error)


def _instead_of_any(folder: Path) -> str:
    """The first file of use in a folder without MCAP files."""
    for file in sorted(folder.iterdir()):
        with contextlib.suppress(OSError, ValueError, IngestError):
            kind = SQLITE_BAG if file.suffix == '.db3' else kind_of(file)
            if kind.is_image or kind.instead or kind in (SQLITE_BAG, ROS_1_BAG):
                return f', but {file.name}:{_instead(file, kind).removeprefix(" but")}'
    return ''


def _instead(file: Path, kind: FileKind) -> str:
    """End of an error message on a file that is no MCAP bag: what it is, and what helps."""
    if kind.is_image:
        return f' but {kind.name}{_OF_IMAGES}'
    if kind.instead:
        return f' but {kind.name}: {kind.instead.replace("FILE", shlex.quote(str(file)))}'
    if kind is UNKNOWN and file.suffix in ('.yaml', '.yml'):
        with regular_file(file) as opened:
            content = opened.read(_YAML_BYTES)
        for word, name, option in _YAML_FILES:
            if word in content:
                return f' but {name}: give a bag or images, and {option}{shlex.quote(str(file))}'
    if kind not in (SQLITE_BAG, ROS_1_BAG):
        return _NOR_IMAGES
    # rosbags converts the folder with its metadata.yaml, not the file in it.
    source = file.parent if kind is SQLITE_BAG else file
    command = ['rosbags-convert', '--src', str(source)]
    command += ['--dst', str(source.with_name(f'{source.stem}_mcap')), '--dst-storage', 'mcap']
    if names := _convertible(source):
        command += ['--include-topic', *names]
    return f' but {kind.name}: {shlex.join(command)} makes one'


def _convertible(source: Path) -> list[str]:
    """Topics that starcal reads of a bag of another kind; none where it cannot be opened."""
    try:
        from rosbags.highlevel import AnyReader  # seldom needed, slow to load

        from starcal_ros.formats.bag.typestore import typestore
    except ModuleNotFoundError:  # rosbags-convert is of the same package
        return []
    # The exceptions of a damaged bag have no common base class.
    with contextlib.suppress(Exception), AnyReader([source], default_typestore=typestore()) as bag:
        return sorted(name for name, topic in bag.topics.items() if topic.msgtype in _CONVERTED)
    return []
