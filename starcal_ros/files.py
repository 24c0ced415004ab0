# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The one way to write a file.

A temporary file in the same folder is written, synced and renamed, and the folder is synced: a
reader, a kill and a power loss see the old file or the new one, each whole.  A kill may leave the
temporary file; it is locked while its writer lives, and the next write to that path removes it.
"""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import fcntl
import os
from pathlib import Path
import secrets
from typing import IO

PART = '.part'  # ends the name of a file that is not whole yet


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
            file.flush()
            os.fsync(number)
            part.replace(path)
        sync_folder(path.parent)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink()
        raise


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
