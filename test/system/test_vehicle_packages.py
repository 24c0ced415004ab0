# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What a vehicle has: packages with a key of rosdep, and a Debian package with these."""

from __future__ import annotations

import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
from xml.etree import ElementTree

import pytest
from ros_tools import HIDDEN  # type: ignore[import-not-found]

ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / 'bags' / 'tiny'


@pytest.fixture
def vehicle(tmp_path: Path) -> dict[str, str]:
    """Environment of a process without the packages that have no key."""
    (tmp_path / 'sitecustomize.py').write_text(HIDDEN)
    return os.environ | {'PYTHONPATH': f'{tmp_path}:{ROOT}'}


def run(environment: dict[str, str], *words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.nodes
def test_the_nodes_run_and_what_needs_more_costs_one_line(vehicle) -> None:
    pytest.importorskip('starcal.msg')
    source = """
import sys
from starcal_ros.errors import ArchiveError
from starcal_ros.pipeline.setup import CalibratorOptions
import starcal_ros.ros.star_observer
from starcal_ros.ros.calibrator import Calibrator
from starcal_ros.ros.state import CalibratorState
assert not {'mcap', 'rosbags', 'threadpoolctl'} & sys.modules.keys()
try:
    CalibratorState(int).open(None, CalibratorOptions(state_dir='state'))
except ArchiveError as error:
    print(error)
"""
    done = run(vehicle, '-c', source)
    assert done.returncode == 0, done.stderr
    assert 'python -m pip install mcap rosbags, or leave state_dir' in done.stdout
    params = TINY / 'params.yaml'
    for words in (
        ('starcal_ros.entry_points', 'bag_player'),
        ('starcal_ground.cli.main', 'calibrate', TINY, '--params', params, '-o', 'none'),
    ):
        refused = run(vehicle, '-m', *words)
        assert refused.returncode == 2, refused.stderr
        assert 'python -m pip install mcap rosbags' in refused.stderr
        assert refused.stderr.count('\n') == 1


def test_the_debian_package_has_the_dependencies_of_package_xml() -> None:
    package = ElementTree.parse(ROOT / 'package.xml')
    control = (ROOT / 'debian/control').read_text()
    listed = re.findall(
        r'^ ((?:ros-jazzy|python3)-[a-z0-9-]+)', control.partition('Depends:\n $')[2], re.M
    )
    keys = {str(one.text) for kind in ('depend', 'exec_depend') for one in package.iter(kind)}
    expected = {
        key if key.startswith('python3-') else f'ros-jazzy-{key.replace("_", "-")}' for key in keys
    }
    assert set(listed) == expected
    version = (ROOT / 'debian/changelog').read_text().partition('(')[2].partition('-')[0]
    assert version == package.findtext('version')


def test_without_ros_the_debian_build_says_where_it_stops(tmp_path) -> None:
    if not shutil.which('dh'):
        pytest.skip('no debhelper')
    for name in ('debian', 'CMakeLists.txt', 'package.xml'):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    build = ('debian/rules', 'build', f'ROS_PREFIX={tmp_path}/none')
    done = subprocess.run(build, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert f'no ROS 2 in {tmp_path}/none' in done.stderr
