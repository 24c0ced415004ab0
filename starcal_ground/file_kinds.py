# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Kind of a file by its content, not its name, and what helps where a bag was expected."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
import glob
from pathlib import Path
import shlex

from starcal_ros.errors import BagError, IngestError, StarcalError
from starcal_ros.formats.image_files import is_fits
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.untrusted import regular_file

_START_BYTES = 64
IMAGES_READ = 'FITS, TIFF, PNG, JPEG, camera raw'
_OF_IMAGES = (
    ': starcal calibrate, diagnose and plan take images alone; starcal import makes a bag'
    ' of image files and attitudes'
)
_NOR_IMAGES = f', nor images ({IMAGES_READ}), which calibrate takes'
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
    """Kind of a file: its name with an article, and whether it is an image."""

    name: str
    is_image: bool = False


MCAP = FileKind('an MCAP bag')
SQLITE_BAG = FileKind('an SQLite bag')
ROS_1_BAG = FileKind('a ROS 1 bag')
ZSTD = FileKind('a file compressed by zstd')
UNKNOWN = FileKind('a file of no known format')
JPEG, PNG, TIFF, FITS, RAW = (
    FileKind(name, is_image=True)
    for name in ('a JPEG', 'a PNG', 'a TIFF', 'a FITS file', 'a camera raw file')
)
# Offset and bytes; the first that match count.
_MAGIC: tuple[tuple[int, bytes, FileKind], ...] = (
    (0, b'\x89MCAP0\r\n', MCAP),
    (0, b'SQLite format 3', SQLITE_BAG),
    (0, b'#ROSBAG V', ROS_1_BAG),
    (0, b'\x28\xb5\x2f\xfd', ZSTD),
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
)
# Camera raw has the first bytes of a TIFF in these, whose first image is a preview.
_RAW_ENDINGS = ('.dng', '.nef', '.nrw', '.arw', '.sr2', '.pef', '.srw', '.3fr', '.iiq', '.raw')
_BMP_RESERVED = slice(6, 10)


class NotABag(BagError):
    """A file or folder, ``place``, is no MCAP bag."""

    def __init__(self, text: str, place: Path) -> None:
        super().__init__(text)
        self.place = place


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


def matching(pattern: Path) -> list[Path]:
    """The path if it exists, else those that a pattern matches, by name; a folder is literal."""
    there = next((path for path in (pattern, *pattern.parents) if path.exists()), Path())
    if there == pattern or not glob.has_magic(str(pattern)):
        return [pattern]
    rest = str(pattern.relative_to(there))
    return sorted(there / name for name in glob.glob(rest, root_dir=there))


def explained(error: StarcalError) -> str:
    """Text of an error; where a bag was expected, with what is there, and what helps."""
    words = str(error)
    if not isinstance(error, NotABag):
        return words
    with contextlib.suppress(OSError):
        if instead := _instead(error.place):
            return words.partition(' (did')[0] + instead
    return words if ' (did' in words else words + _NOR_IMAGES


def _instead(place: Path) -> str:
    """First file of use in a place without an MCAP bag and what helps, to append to an error."""
    is_folder = place.is_dir()
    for file in sorted(place.iterdir()) if is_folder else [place]:
        with contextlib.suppress(OSError, ValueError, IngestError):
            kind = SQLITE_BAG if file.suffix == '.db3' else kind_of(file)
            start = f', but {file.name}: {kind.name}' if is_folder else f' but {kind.name}'
            if kind.is_image:
                return start + _OF_IMAGES
            if kind is ZSTD:
                return f'{start}: {shlex.join(["zstd", "-d", str(file)])}'
            if kind in (SQLITE_BAG, ROS_1_BAG):
                return f'{start}: {_conversion(file, kind)} makes one'
    inside = [folder for folder in sorted(place.glob('*/')) if _has_image(folder)]
    names = ', '.join(folder.name for folder in inside[:3])
    return (
        f', but folders with images ({names}): give {shlex.quote(f"{place}/*")}' if names else ''
    )


def _has_image(folder: Path) -> bool:
    for file in folder.iterdir():
        with contextlib.suppress(OSError, ValueError, IngestError):
            if kind_of(file).is_image:
                return True
    return False


def _conversion(file: Path, kind: FileKind) -> str:
    """Command that makes an MCAP bag of one of another kind."""
    # rosbags converts the folder with its metadata.yaml, not the file in it.
    source = file.parent if kind is SQLITE_BAG else file
    command = ['rosbags-convert', '--src', str(source)]
    command += ['--dst', str(source.with_name(f'{source.stem}_mcap')), '--dst-storage', 'mcap']
    if names := _convertible(source):
        command += ['--include-topic', *names]
    return shlex.join(command)


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
