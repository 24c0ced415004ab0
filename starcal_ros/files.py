# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The one way to write a file.

A temporary file in the same folder is written, synced and renamed, and the folder is synced: a
reader, a kill and a power loss see the old file or the new one, each whole.  A kill may leave the
temporary file; it is locked while its writer lives, and the next write to that path removes it.

Each file has the digest of its content as an extended attribute, by which starcal knows later that
it wrote the file and that nothing has changed it since.  A page, which is written again and again,
has it as its last line too, since not all file systems keep attributes.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
import hashlib
import os
from pathlib import Path
import secrets
from typing import IO

PART = '.part'  # ends the name of a file that is not whole yet
_MARK = 'user.starcal.sha256'


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """
    A file to write to, which replaces ``path`` when the block ends without an exception.

    A link at ``path`` is replaced, never followed. Raises OSError when the file cannot be written;
    the old one is then unchanged.
    """
    _remove_abandoned(path)
    part = path.with_name(f'.{path.name}.{secrets.token_hex(4)}{PART}')
    try:
        # Exclusive: a link that waits under this name must not be written through.
        number = os.open(part, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        with os.fdopen(number, 'w+b') as file:
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            yield file
            mark(file)
            os.fsync(number)
            part.replace(path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


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


def _remove_abandoned(path: Path) -> None:
    """Remove unfinished files for a place whose writers have ended."""
    parts = []
    with contextlib.suppress(OSError), os.scandir(path.parent) as entries:
        beside = [entry.name for entry in entries if entry.name.startswith(f'.{path.name}.')]
        parts = [path.with_name(name) for name in beside if name.endswith(PART)]
    for part in parts:
        with contextlib.suppress(OSError):
            number = os.open(part, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            try:
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
                part.unlink()
            finally:
                os.close(number)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder, new and removed, survive a power loss; raises OSError."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
