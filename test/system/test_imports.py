# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each module imports alone, and start-up imports stay small; see also `make lint`."""

from __future__ import annotations

from pathlib import Path
import subprocess
import sys

import pytest

PACKAGE = Path(__file__).parents[2] / 'starcal_ros'

MODULES = {
    '.'.join(path.relative_to(PACKAGE).with_suffix('').parts): path
    for path in sorted(PACKAGE.rglob('*.py'))
    if path.name != '__init__.py'
}


ALONE = """
import importlib, sys
for name in sys.argv[1:]:
    for known in [m for m in sys.modules if m.split('.')[0] == 'starcal_ros']:
        del sys.modules[known]
    importlib.import_module('starcal_ros.' + name)
    print(name)
assert 'rclpy' not in sys.modules
"""


def test_a_calibration_does_not_wait_for_what_it_seldom_needs() -> None:
    """scipy.stats alone would make the start, one second, a third longer."""
    show = 'import sys; from starcal_ros.cli.commands import calibrate; print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', show], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert 'scipy.special' in loaded and 'starcal_ros.pipeline.solve' in loaded
    seldom = {'scipy.stats', 'contourpy', 'starcal_ros.identification.blind.search'}
    assert not loaded & seldom


@pytest.mark.slow
def test_each_module_imports_alone() -> None:
    """No module needs another one imported first, and none imports ROS."""
    names = [
        m for m in MODULES if not m.startswith('ros.') or m.startswith(('ros.kept', 'ros.queue'))
    ]
    done = subprocess.run(
        [sys.executable, '-c', ALONE, *names], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == names
