# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Folders that the tool writes to, and parts of it that may not be installed."""

from __future__ import annotations

from pathlib import Path

from starcal_ros.errors import OptionError

# setup.cfg
_MODULES_OF_EXTRAS = (
    'contourpy',
    'dask',
    'distributed',
    'jinja2',
    'markupsafe',
    'pyarrow',
    'weasyprint',
)
_WITHOUT_KEY = ('mcap', 'rosbags')  # needed, but rosdep has no key for them


def make_folder(path: Path) -> None:
    """
    Make a folder and those above it where they are not there.

    Raises OptionError when it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OptionError(f'{path}: cannot create the folder: {error.strerror}') from error


def missing_extra(error: ModuleNotFoundError, extra: str) -> str:
    """One line that names the extra to install; raises what is missing for another reason."""
    if error.name in _WITHOUT_KEY:
        return f'{error.name} is not installed: pip install {" ".join(_WITHOUT_KEY)}'
    if error.name not in _MODULES_OF_EXTRAS:
        raise error
    return f"{error.name} is not installed: pip install 'starcal_ros[{extra}]'"
