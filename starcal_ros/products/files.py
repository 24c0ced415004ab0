# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of products, read as text and replaced whole or not at all."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from starcal_ros.errors import ProductError

OBSERVATIONS_FILE = 'observations.mcap'
REPORT_FILE = 'report.html'

PART = '.part'  # ends the name of a file that is not whole yet


def read_text(path: Path) -> str:
    """
    The text of a file in UTF-8.

    Raises
    ------
    ProductError
        When the file cannot be read or is no text.
    """
    try:
        return path.read_text(encoding='utf-8')
    except OSError as error:
        raise ProductError(f'{path}: cannot be read: {error.strerror}') from error
    except UnicodeDecodeError as error:
        raise ProductError(f'{path}: not a text file') from error


def write_atomically(path: Path, content: str | bytes) -> None:
    """
    Replace a file whole: readers, and a power loss, see the old one or the new one.

    Raises
    ------
    ProductError
        When the file cannot be written; the old one then stands as it was.
    """
    part = path.with_name(f'.{path.name}.{os.getpid()}{PART}')
    try:
        with part.open('wb') as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
        sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise ProductError(f'{path}: cannot be written: {error.strerror}') from error


def sync_folder(folder: Path) -> None:
    """Have the names in a folder, new and gone, outlast a power loss; raises OSError."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)
