# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal_ros` is what the nodes import, each module imports alone, and start-up imports few."""

from __future__ import annotations

import ast
from collections.abc import Iterator
import graphlib
from pathlib import Path

import pytest
from starcal_tool import run_python  # type: ignore[import-not-found]

import starcal_ros

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
BLOCKS = ('body', 'orelse', 'handlers', 'finalbody', 'cases')  # of an if, a try, a class
NODES = ('starcal_ros.ros.star_observer', 'starcal_ros.ros.calibrator')
# FITS of dark and flat frames are read by Astropy where it is installed.
STAYS_ON_THE_GROUND = {
    *('PIL', 'argcomplete', 'dask', 'fsspec', 'jinja2', 'rich', 'rosbag2_py', 'spiceypy'),
    'starcal_ground',
}


def import_statements(
    statements: list[ast.stmt], in_functions: bool
) -> Iterator[ast.Import | ast.ImportFrom]:
    """Import statements that run: none for types alone, and those of functions if asked for."""
    for one in statements:
        is_function = isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef))
        if isinstance(one, (ast.Import, ast.ImportFrom)):
            yield one
        elif isinstance(one, ast.If) and 'TYPE_CHECKING' in ast.unparse(one.test):
            yield from import_statements(one.orelse, in_functions)
        elif in_functions or not is_function:
            inner = [part for name in BLOCKS for part in getattr(one, name, [])]
            yield from import_statements(inner, in_functions)


def imported_by(name: str, in_functions: bool = True) -> set[str]:
    """Every name that a module imports: of modules, and of what is taken from them."""
    found: set[str] = set()
    for one in import_statements(ast.parse(MODULES[name].read_text()).body, in_functions):
        names = {alias.name for alias in one.names}
        if isinstance(one, ast.ImportFrom):
            names = {str(one.module), *(f'{one.module}.{each}' for each in names)}
        found |= names
    return found


def needed_by(name: str) -> set[str]:
    """Modules and packages run by an import, without those that the importing module is in."""
    found = imported_by(name, in_functions=False)
    for parts in [imported.split('.') for imported in found]:
        outer = {'.'.join(parts[:k]) for k in range(1, len(parts))}
        found |= {each for each in outer if not f'{name}.'.startswith(f'{each}.')}
    return found & MODULES.keys()


def closure(starts: tuple[str, ...]) -> dict[str, set[str]]:
    """What each module imports of those that the first ones reach, their packages included."""
    reached: dict[str, set[str]] = {}
    waiting = list(starts)
    while waiting:
        name = waiting.pop()
        if name in MODULES and name not in reached:
            reached[name] = imported_by(name)
            waiting += [*reached[name], name.rpartition('.')[0]]
    return reached


def test_all_of_starcal_ros_flies_and_needs_nothing_of_the_ground() -> None:
    """The nodes import it, or a consumer of calibrations on the vehicle does."""
    imported = closure(NODES)
    tops = {name.partition('.')[0] for names in imported.values() for name in names}
    assert 'numpy' in tops and not tops & STAYS_ON_THE_GROUND
    flies = imported.keys() | {'starcal_ros.entry_points'}
    assert {name for name in MODULES if name.startswith('starcal_ros')} - flies == set()
    consumed = [name for name in starcal_ros.__all__ if name != '__version__']
    assert {getattr(starcal_ros, name).__module__ for name in consumed} <= flies


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
    done = run_python('-c', show, check=True)
    loaded = set(done.stderr.split())
    assert {*needs.split()} <= loaded and not {*does_not_wait_for.split()} & loaded
