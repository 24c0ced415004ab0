# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Nothing in the current folder is imported, by the tool nor by what it starts."""

import os
from pathlib import Path
import sys

import pytest
from starcal_tool import run, run_python  # type: ignore[import-not-found]

from starcal_ground.child_process import module_command

ROOT = Path(__file__).parents[2]
TOOL = 'starcal_ground.cli.main'
AS_A_MODULE = [sys.executable, '-m', TOOL]
# Modules of the standard library and of others that the tool imports, and one it may not.
PLANTED = ('yaml', 'typing', 'argparse', 'json', 'pickle', 'dataclasses', 'numpy', 'dask', 'rclpy')


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A folder with modules that leave a mark when they are imported."""
    for name in PLANTED:
        mark = f"open({str(tmp_path / 'marks')!r}, 'a').write({name!r} + '\\n')\n"
        (tmp_path / f'{name}.py').write_text(mark)
    return tmp_path


WITH_THIS_TREE = {**os.environ, 'PYTHONPATH': str(ROOT)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ('start', 'arguments'),
    [
        (AS_A_MODULE, ['--version']),
        # The lens is stated, so that the search for the camera, whose modules count too, is short.
        (AS_A_MODULE, ['diagnose', 'BAG', '--focal-length-mm', '18', '--pixel-size-um', '10']),
        (
            module_command(TOOL),
            ['trend', 'BAG', '-o', 'out', '--workers', '1', '--params', 'BAG/params.yaml'],
        ),
    ],
    ids=['version', 'diagnose', 'trend as a child process'],
)
def test_modules_of_the_current_folder_are_not_run(hostile, few_images, start, arguments) -> None:
    given = [word.replace('BAG', str(few_images)) for word in arguments]
    done = run(*start, *given, cwd=hostile, env=WITH_THIS_TREE)
    assert done.returncode == 0, done.stderr
    assert not (hostile / 'marks').exists(), (hostile / 'marks').read_text()


def test_the_marks_are_left_without_the_safe_path(hostile) -> None:
    """The test above could fail."""
    run_python('-c', 'import yaml', cwd=hostile, check=True)
    assert (hostile / 'marks').read_text() == 'yaml\n'


def test_other_programs_keep_their_path(tmp_path) -> None:
    (tmp_path / 'program.py').write_text('import starcal_ros, beside; print(beside.NAME)')
    (tmp_path / 'beside.py').write_text("NAME = 'beside'")
    for command in (['-m', 'program'], ['program.py']):
        done = run_python(*command, cwd=tmp_path, env=WITH_THIS_TREE)
        assert done.stdout == 'beside\n', done.stderr
