# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of products: text of limited size, and contents written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
import contextlib
import os
from pathlib import Path
from typing import Any

from starcal_ros import untrusted
from starcal_ros.errors import errors_as, ProductError
from starcal_ros.files import is_marked, replacing, same_as_one_of

OBSERVATIONS_FILE = 'observations.mcap'
REPORT_FILE = 'report.html'


def read_text(path: Path, most_bytes: int) -> str:
    """Text of a file in UTF-8 of at most ``most_bytes``; raises ProductError."""
    with errors_as(ProductError, path):
        return untrusted.read_text(path, most_bytes)


def read_json(path: Path) -> Any:
    """Value of a JSON file, as `untrusted.json_value` reads it; raises ProductError."""
    with errors_as(ProductError, path):
        return untrusted.json_value(read_text(path, untrusted.PRODUCT_BYTES))


def write_atomically(path: Path, content: str | bytes) -> None:
    """
    Replace a file whole: readers, and a power loss, see the old one or the new one.

    Raises ProductError when the file cannot be written; the old one is then unchanged.
    """
    with errors_as(ProductError, path, 'written'), replacing(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def make_folder(path: Path) -> None:
    """Make a folder and those above it where they are not there; raises ProductError."""
    with errors_as(ProductError, path, 'created'):
        path.mkdir(parents=True, exist_ok=True)


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path] = ()) -> None:
    """
    Check that a command may write its files: none is an input, and each is new or was its own.

    Its own is a file that starcal wrote and nothing changed since.  Raises ProductError naming the
    first file that would be replaced and the remedy.
    """
    inputs = tuple(inputs)
    for path in outputs:
        if same_as_one_of(path, inputs):
            raise ProductError(
                f'{path}: is an input of this command and would be replaced; choose another '
                'place (-o)'
            )
        if os.path.isdir(path):
            raise ProductError(f'{path}: is a folder, where a file is written; give another name')
        if os.path.lexists(path) and not _is_own(path):
            raise ProductError(
                f'{path}: was not written by starcal, or was changed or copied since (or its file'
                ' system keeps no extended attributes): give another name or remove it'
            )


def _is_own(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError), untrusted.regular_file(path, False) as file:
        return is_marked(file)
    return False
