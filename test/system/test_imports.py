# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each module imports alone, and start-up imports stay small; see also `make lint`."""

from __future__ import annotations

import ast
from collections.abc import Iterator
import graphlib
from pathlib import Path
import subprocess
import sys

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ('starcal_ros', 'starcal_ground')
MODULES = {
    '.'.join(
        (path.parent if path.stem == '__init__' else path.with_suffix('')).relative_to(ROOT).parts
    ): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob('*.py'))
}
WITHOUT_ROS = [
    name for name in MODULES
    if '.ros.' not in name or name.endswith(('.ros.archive', '.ros.image_queue', '.ros.state'))
]  # fmt: skip
BLOCKS = ('body', 'orelse', 'handlers', 'finalbody')  # of an if, a try, a class


def run_at_import(statements: list[ast.stmt]) -> Iterator[ast.Import | ast.ImportFrom]:
    """Import statements of a module that its import runs: none of functions or for types alone."""
    for one in statements:
        if isinstance(one, (ast.Import, ast.ImportFrom)):
            yield one
        elif isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef)):
            continue
        elif isinstance(one, ast.If) and 'TYPE_CHECKING' in ast.unparse(one.test):
            yield from run_at_import(one.orelse)
        else:
            yield from run_at_import([part for name in BLOCKS for part in getattr(one, name, [])])


def needed_by(name: str) -> set[str]:
    """
    Modules and packages that the import of a module needs whole.

    The packages of an imported module are run before it, but those that the importing module is
    in are running already.
    """
    found = set()
    for one in run_at_import(ast.parse(MODULES[name].read_text()).body):
        names = [alias.name for alias in one.names]
        if isinstance(one, ast.ImportFrom):
            names = [str(one.module), *(f'{one.module}.{each}' for each in names)]
        for imported in names:
            parts = imported.split('.')
            outer = {'.'.join(parts[:k]) for k in range(1, len(parts))}
            found |= {imported} | {each for each in outer if not f'{name}.'.startswith(f'{each}.')}
    return found & MODULES.keys()


def test_each_module_imports_alone() -> None:
    """No module needs another one imported first: none needs itself, through whatever others."""
    graph = {name: needed_by(name) for name in MODULES}
    assert 'starcal_ros.camera.projection' in graph['starcal_ros.camera']
    assert 'starcal_ground.campaign' in graph['starcal_ground.cli.into_folder']
    graphlib.TopologicalSorter(graph).prepare()  # CycleError names the modules


HELP = """import contextlib
from starcal_ground.cli.main import main
with contextlib.suppress(SystemExit): main(['--help'])"""
ONE_COMMAND = 'from starcal_ground.cli.main import parser; parser(["lookup", "plan"])'
CALIBRATE = 'import starcal_ground.cli.into_folder, starcal_ground.images.first_setup'
COMMANDS = 'starcal_ground.cli.commands'


@pytest.mark.parametrize(
    ('start', 'needs', 'does_not_wait_for'),
    [
        ('import starcal_ros', '', 'numpy cv2'),
        ('import starcal_ground', '', 'numpy cv2 starcal_ground.api'),
        # Half a second of imports would be felt at each press of the tab key.
        (HELP, '', 'numpy scipy cv2 mcap rosbags rclpy rich argcomplete'),
        (ONE_COMMAND, f'{COMMANDS}.lookup', f'numpy {COMMANDS}.plan {COMMANDS}.calibrate'),
        # scipy.stats alone would make this start, one second, a third longer.
        (
            CALIBRATE,
            'scipy.special starcal_ros.pipeline.solve',
            'scipy.stats starcal_ground.blind.search',
        ),
        ('\n'.join(f'import {name}' for name in WITHOUT_ROS), '', 'rclpy'),
    ],
    ids=['on board', 'ground', 'help', 'a command', 'a calibration', 'all without ROS'],
)
def test_a_start_does_not_wait_for_what_it_seldom_needs(start, needs, does_not_wait_for) -> None:
    show = f'{start}\nimport sys; print(*sys.modules, file=sys.stderr)'
    done = subprocess.run([sys.executable, '-c', show], capture_output=True, text=True, check=True)
    loaded = set(done.stderr.split())
    assert {*needs.split()} <= loaded and not {*does_not_wait_for.split()} & loaded
