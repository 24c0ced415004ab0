# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Places that a command may write to; imports little, since ``starcal --help`` answers at once."""

from collections.abc import Iterable
import contextlib
import os
from pathlib import Path

from starcal_ros.errors import errors_as, ProductError
from starcal_ros.files import is_marked
from starcal_ros.untrusted import regular_file

OBSERVATIONS_FILE, REPORT_FILE = 'observations.mcap', 'report.html'


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
    with contextlib.suppress(OSError, ValueError), regular_file(path, False) as file:
        return is_marked(file)
    return False


def same_as_one_of(path: Path, others: Iterable[Path]) -> bool:
    """True if a path names the same file, by whatever name, as one of the others."""
    try:
        own = path.stat()
    except OSError:
        return False  # there is no such file
    for other in others:
        with contextlib.suppress(OSError):
            if os.path.samestat(own, other.stat()):
                return True
    return False
