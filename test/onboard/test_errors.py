# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The one line that names a missing package."""

import sys

import pytest

from starcal_ros.errors import missing_package

# Module that is missing, extra of the command, end of the line.
MISSING = [
    ('jinja2', '', 'pip install Jinja2'),
    ('markupsafe', '', 'pip install Jinja2'),
    ('PIL', '', 'pip install Pillow'),
    ('PIL', 'mission', 'pip install Pillow'),
    ('rosbags', '', 'pip install mcap rosbags'),
    ('s3fs', 'mission', 'pip install s3fs'),
    ('dask', 'mission', "pip install '.[mission]' in the folder of starcal"),
]


@pytest.mark.parametrize(('name', 'extra', 'end'), MISSING)
def test_the_command_is_that_of_this_interpreter(name: str, extra: str, end: str) -> None:
    """A module of our own is no package to install."""
    line = missing_package(ModuleNotFoundError(name=name), extra)
    assert line == f'{name} is not installed: {sys.executable} -m {end}'
    with pytest.raises(ModuleNotFoundError):
        missing_package(ModuleNotFoundError(name='starcal_ros.nothing'))
