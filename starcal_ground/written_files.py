# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Files of the tool, written by `starcal_ros.files.replacing` with a mark.

The mark is the digest of the content as an extended attribute, which shows later that starcal
wrote the file and that nothing has changed it since.  A page, which is written again and again,
has it as its last line too, since not all file systems keep attributes.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import hashlib
import os
from pathlib import Path
from typing import IO, TYPE_CHECKING

from starcal_ros import files
from starcal_ros.errors import errors_as, ProductError

if TYPE_CHECKING:
    from starcal_ros.records import Calibration

_MARK = 'user.starcal.sha256'


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A file to write to as by `starcal_ros.files.replacing`, marked when the block ends."""
    with files.replacing(path) as file:
        yield file
        mark(file)


def write_marked(path: Path, content: str | bytes) -> None:
    """
    Replace a file whole as by `replacing`, and seal an HTML page.

    Raises ProductError when the file cannot be written; the old one is then unchanged.
    """
    data = content.encode() if isinstance(content, str) else content
    with errors_as(ProductError, path, 'written'), replacing(path) as file:
        file.write(sealed(data) if path.suffix == '.html' else data)


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write ``calibration.json``, NaN and infinity as null; raises ProductError if it cannot."""
    # The help of the tool imports this module, and needs no numerics.
    from starcal_ros.formats.products.product_files import calibration_text

    write_marked(path, calibration_text(calibration))


def mark(file: IO[bytes]) -> None:
    """Mark an open file as written by starcal with its present content."""
    file.flush()
    # A file system without extended attributes, or a Python without them (macOS).
    with contextlib.suppress(OSError, AttributeError):
        os.setxattr(file.fileno(), _MARK, _digest(file))


def is_marked(file: IO[bytes]) -> bool:
    """True if starcal wrote an open file, and its content has not changed since."""
    with contextlib.suppress(OSError, AttributeError):
        if os.getxattr(file.fileno(), _MARK) == _digest(file):
            return True
    length = file.seek(0, os.SEEK_END) - len(_seal(b''))
    if length < 0:
        return False
    digest = _seal(_digest(file, length))
    file.seek(length)
    return file.read() == digest


def sealed(page: bytes) -> bytes:
    """An HTML page with its mark as the last line, which every file system keeps."""
    return page + _seal(hashlib.sha256(page).hexdigest().encode())


def _seal(digest: bytes) -> bytes:
    return b'\n<!-- starcal sha256 %-64s -->\n' % digest


def _digest(file: IO[bytes], length: int | None = None) -> bytes:
    """SHA-256 of an open file, or of its first bytes, in hexadecimal."""
    file.seek(0)
    digest = hashlib.sha256()
    while block := file.read(1 << 20 if length is None else min(1 << 20, length - file.tell())):
        digest.update(block)
    return digest.hexdigest().encode()
