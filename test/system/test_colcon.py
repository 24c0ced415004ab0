# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The package in a ROS workspace: colcon builds it; messages and a node run from there."""

import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys

from managers import Manager  # type: ignore[import-not-found]
import pytest
from starcal_tool import run, run_python  # type: ignore[import-not-found]

ROOT = Path(__file__).resolve().parents[2]
BUILT = ('CMakeLists.txt', 'package.xml', 'setup.cfg', 'msg', 'srv')
TESTED = ('bench', 'docs', 'pyproject.toml', 'studies', 'test', 'tools', 'README.md', 'LICENSE')
INSTALLED = ('launch', 'config', 'bags/tiny')
PACKAGES = ('starcal_ros', 'starcal_ground')
NODE_STOPS_WITHIN_S = 240.0

pytestmark = [pytest.mark.packaging, pytest.mark.slow]

# The messages in use, not only the Python files that wrap them, must be those of the workspace.
ORIGINS = """
from rclpy.serialization import serialize_message
import starcal
from starcal.msg import Calibration
import starcal_ros

serialize_message(Calibration())
print(starcal.__file__)
print(starcal_ros.__file__)
print(*{line.split()[-1] for line in open('/proc/self/maps') if 'libstarcal__' in line}, sep='\\n')
"""

# Most of the time goes into the headers of 23 interfaces: one unit reads them once for a library.
TOGETHER = """
function(compile_together)
  get_property(targets DIRECTORY PROPERTY BUILDSYSTEM_TARGETS)
  foreach(target ${targets})
    get_target_property(kind ${target} TYPE)
    if(kind STREQUAL "SHARED_LIBRARY" AND target MATCHES "typesupport_fastrtps_c(pp)?$")
      set_target_properties(${target} PROPERTIES UNITY_BUILD ON UNITY_BUILD_BATCH_SIZE 0)
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL compile_together)
"""


@pytest.fixture(scope='module')
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a workspace with a copy of this package, built on the environment as underlay."""
    workspace = tmp_path_factory.mktemp('workspace')
    package = workspace / 'src' / 'starcal'
    package.mkdir(parents=True)
    for name in filter(lambda name: (ROOT / name).exists(), BUILT + PACKAGES + INSTALLED + TESTED):
        if (ROOT / name).is_dir():
            ignore = shutil.ignore_patterns('__pycache__')
            shutil.copytree(ROOT / name, package / name, ignore=ignore)
        else:
            shutil.copy(ROOT / name, package)
    together = workspace / 'together.cmake'
    together.write_text(TOGETHER)
    definitions = (
        *('-DBUILD_TESTING=ON', f'-DPython3_EXECUTABLE={sys.executable}'),
        f'-DCMAKE_PROJECT_INCLUDE={together}',
    )
    built = colcon(workspace, 'build', '--base-paths', 'src', '--cmake-args', *definitions)
    assert built.returncode == 0, built.stdout + built.stderr
    assert 'LICENSE' not in built.stderr, built.stderr
    return workspace


def colcon(workspace: Path, *arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
    underlay = {'AMENT_PREFIX_PATH': sys.prefix, 'CMAKE_PREFIX_PATH': sys.prefix}
    env = os.environ | underlay | {'COLCON_HOME': str(workspace)} | more
    made: subprocess.CompletedProcess[str] = run_python(
        '-m', 'colcon', *arguments, cwd=workspace, env=env, stdin=subprocess.DEVNULL
    )
    return made


def in_workspace(workspace: Path, *command: str | Path) -> list[str]:
    """Return the command that runs another one with the workspace sourced, as one process."""
    sourced = f'. {workspace}/install/local_setup.sh && exec "$@"'
    return ['sh', '-c', sourced, 'sh', *map(str, command)]


def test_imports_come_from_the_install_space(workspace) -> None:
    command = in_workspace(workspace, sys.executable, '-c', ORIGINS)
    shown = run(*command, cwd=workspace)
    assert shown.returncode == 0, shown.stderr
    origins = shown.stdout.split()
    assert len(origins) > 3  # the two packages and the libraries of the messages
    assert [o for o in origins if not o.startswith(f'{workspace}/install/starcal/')] == []


def test_everything_is_installed_that_the_package_reads(workspace) -> None:
    prefix = workspace / 'install' / 'starcal'
    executables = {path.name for path in (prefix / 'lib' / 'starcal').iterdir()}
    assert executables == {
        *('starcal', 'star_observer', 'calibrator', 'bag_player', 'setup_finder')
    }
    for folder in INSTALLED:
        there = {path.name for path in (prefix / 'share/starcal' / folder).iterdir()}
        assert there == {path.name for path in (ROOT / folder).iterdir()} - {'__pycache__'}
    sources = next(prefix.glob('lib/python3.*/site-packages/starcal_ros'))
    for path in (ROOT / 'starcal_ros/sky/data').iterdir():
        if path.is_file():
            assert (sources / 'sky/data' / path.name).read_bytes() == path.read_bytes()


def test_colcon_test_runs_the_suite(workspace) -> None:
    """All of it is collected, by colcon as by make; a few of it are run."""
    chosen = '-k "test_constants or test_a_match_that_is_right"'  # which imports the benches
    tested = colcon(
        *(workspace, 'test', '--base-paths', 'src', '--return-code-on-test-failure'),
        PYTEST_ADDOPTS=chosen,
    )
    assert tested.returncode == 0, tested.stdout + tested.stderr
    shown = colcon(workspace, 'test-result', '--all')
    assert 'test.xunit.xml' in shown.stdout and '0 errors, 0 failures' in shown.stdout
    summary = re.search(r'Summary: (\d+) tests', shown.stdout)
    assert summary and int(summary[1]) > 2, shown.stdout


def test_node_from_the_install_space_comes_up_and_stops(workspace, client, monkeypatch) -> None:
    monkeypatch.setenv('ROS_LOG_DIR', str(workspace / 'log'))
    executable = workspace / 'install/starcal/lib/starcal/star_observer'
    arguments = ('--ros-args', '-r', '__ns:=/from_colcon', '-p', 'autostart:=false')
    command = in_workspace(workspace, executable, *arguments)
    node = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        # Its name is in the graph before its constructor ends; an answer shows that it spins.
        assert Manager(client, 'from_colcon/star_observer').state() == 'unconfigured'
        node.send_signal(signal.SIGINT)
        output = node.communicate(timeout=NODE_STOPS_WITHIN_S)[0]
    finally:
        node.kill()
        node.wait()
    assert node.returncode == 0, output
    assert 'Traceback' not in output
