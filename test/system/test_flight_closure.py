# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
`starcal_ros` is what the nodes import, and what a consumer of calibrations imports on the vehicle.

Imports inside functions count; those for a type checker alone do not.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import starcal_ros

ROOT = Path(__file__).parents[2]
MODULES = {
    '.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'): path
    for path in sorted((ROOT / 'starcal_ros').rglob('*.py'))
}
NODES = ('starcal_ros.ros.star_observer', 'starcal_ros.ros.calibrator')
CONSUMED = [name for name in starcal_ros.__all__ if name != '__version__']
# FITS of dark and flat frames are read by Astropy where it is installed.
STAYS_ON_THE_GROUND = {
    *('PIL', 'argcomplete', 'dask', 'fsspec', 'jinja2', 'rich', 'rosbag2_py', 'spiceypy'),
    'starcal_ground',
}


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a module that run; the body of ``if TYPE_CHECKING`` does not."""
    for one in ast.iter_child_nodes(tree):
        if isinstance(one, ast.If) and getattr(one.test, 'id', '') == 'TYPE_CHECKING':
            continue
        yield one
        yield from statements(one)


def imported_by(name: str) -> set[str]:
    """Every name that a module imports, at its start or later."""
    found: set[str] = set()
    for one in statements(ast.parse(MODULES[name].read_text())):
        if isinstance(one, ast.Import):
            found |= {alias.name for alias in one.names}
        elif isinstance(one, ast.ImportFrom):
            found |= {str(one.module), *(f'{one.module}.{alias.name}' for alias in one.names)}
    return found


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


def test_all_of_starcal_ros_flies() -> None:
    flies = closure(NODES).keys() | {'starcal_ros.entry_points'}
    assert MODULES.keys() - flies == set()
    assert {getattr(starcal_ros, name).__module__ for name in CONSUMED} <= flies


def test_what_flies_needs_nothing_of_the_ground() -> None:
    tops = {name.partition('.')[0] for names in closure(NODES).values() for name in names}
    assert 'numpy' in tops and not tops & STAYS_ON_THE_GROUND
