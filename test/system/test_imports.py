# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each module imports alone, and start-up imports stay small; see also `make lint`."""

from __future__ import annotations

import ast
from collections.abc import Iterator
import graphlib
from pathlib import Path
import subprocess
import sys

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


def test_a_calibration_does_not_wait_for_what_it_seldom_needs() -> None:
    """scipy.stats alone would make the start, one second, a third longer."""
    show = 'import sys; from starcal_ground.cli import into_folder;'
    show += ' from starcal_ground.images import first_setup; print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', show], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert 'scipy.special' in loaded and 'starcal_ros.pipeline.solve' in loaded
    seldom = {'scipy.stats', 'starcal_ground.blind.search'}
    assert not loaded & seldom


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


def test_none_imports_ros() -> None:
    imports = ''.join(f'import {name}\n' for name in WITHOUT_ROS)
    show = f"import sys\n{imports}print('rclpy' in sys.modules)"
    done = subprocess.run([sys.executable, '-c', show], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ('False\n', '')
