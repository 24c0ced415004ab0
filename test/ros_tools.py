# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The real ROS 2 tools, where they are: the `ros2` command, launch, rosbag2, sros2, Cyclone DDS.

PyPI has none of them. ``STARCAL_ROS2_TOOLS`` names a folder with ``bin/ros2`` and ``env.sh``;
without it, ``../shared/ros2tools/install.sh`` beside this repository makes one for Jazzy.
"""

from collections.abc import Callable, Mapping
from importlib import metadata
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from packaging.requirements import Requirement
import pytest
from starcal_tool import run  # type: ignore[import-not-found]
from vehicle import LoggedProcess, with_log  # type: ignore[import-not-found]

BESIDE = Path(__file__).parents[2] / 'shared' / 'ros2tools' / 'install.sh'
PROFILE = Path(__file__).parents[1] / 'config' / 'cyclonedds.xml'
JAZZY_RCLPY = '7.'  # compiled tools serve the ROS they were built against alone
# rosdep has no key for them, or a vehicle can do without.
WITHOUT_KEY = ('mcap', 'rosbags', 'threadpoolctl', 'dask', 'distributed')
# As sitecustomize.py at the start of a Python process: these cannot be imported.
HIDDEN = f"""
import sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition('.')[0] in {WITHOUT_KEY}:
            raise ModuleNotFoundError(f'No module named {{name!r}}', name=name.partition('.')[0])

sys.meta_path.insert(0, Hidden())
"""
RUN_S = 240.0  # a command of ros2 takes 2 s; busy cores make that much of it


def required(installed: metadata.Distribution, extra: str = '') -> set[str]:
    """Names of the distributions that one needs with one of its extras, directly or not."""
    found: set[str] = set()
    waiting = [(installed, extra)]
    while waiting:
        distribution, of_extra = waiting.pop()
        for text in distribution.requires or ():
            requirement = Requirement(text)
            if requirement.marker and not requirement.marker.evaluate({'extra': of_extra}):
                continue
            name = requirement.name.lower().replace('_', '-')
            if name not in found:
                found.add(name)
                waiting.append((metadata.distribution(name), ''))
    return found


def find_tools(made_once: Callable[..., Path]) -> Path:
    """Return the folder of the tools, made once if need be; skip the test without them."""
    given = os.environ.get('STARCAL_ROS2_TOOLS', '')
    if given:
        return Path(given)
    if not BESIDE.exists():
        pytest.skip('no real ROS 2 tools: STARCAL_ROS2_TOOLS is not set')
    if not metadata.version('rclpy').startswith(JAZZY_RCLPY):
        pytest.skip('the real ROS 2 tools beside this repository are built for Jazzy')

    def install(folder: Path) -> None:
        made = run(BESIDE, sys.prefix, folder)
        if made.returncode:
            pytest.skip(f'the real ROS 2 tools are not for this Python: {made.stderr[-200:]}')

    return made_once('ros2tools', install)


class RosTools:
    """Runs the tools and starts processes with them in their environment, on one middleware."""

    def __init__(self, tools: Path, rmw: str, logs: Path, more: Mapping[str, str]) -> None:
        lines = run('bash', '-c', f'. {tools}/env.sh && env -0', check=True).stdout.split('\0')
        self.environment = dict(line.split('=', 1) for line in lines if '=' in line)
        self.environment |= {'PYTHONUNBUFFERED': '1', 'PYTHONFAULTHANDLER': '1'}
        self.environment |= {'RMW_IMPLEMENTATION': rmw, **more}
        if rmw == 'rmw_cyclonedds_cpp':
            # The wheels' rmw_implementation looks for libraries beside itself alone.
            self.environment['LD_PRELOAD'] = f'{tools}/native/lib/lib{rmw}.so'
            # Cyclone DDS starts no node with an element that it does not know.
            self.environment['CYCLONEDDS_URI'] = PROFILE.as_uri()
        self._ros2 = str(tools / 'bin' / 'ros2')
        self._logs = logs
        self._started: list[LoggedProcess] = []

    def run(
        self, *arguments: str | Path, timeout_s: float = RUN_S
    ) -> subprocess.CompletedProcess[str]:
        """Run `ros2` to its end, again if it found no node: it looks once, after half a second."""
        deadline_s = time.monotonic() + RUN_S
        while True:
            done: subprocess.CompletedProcess[str] = run(
                self._ros2, *arguments, env=self.environment, timeout=timeout_s, input=''
            )
            if 'Node not found' not in done.stderr or time.monotonic() > deadline_s:
                return done

    def until(self, expected: str, *arguments: str | Path) -> str:
        """Output of `ros2`, run again until it holds what is expected."""
        deadline_s = time.monotonic() + RUN_S
        while expected not in (done := self.run(*arguments)).stdout:
            assert time.monotonic() < deadline_s, (arguments, done.stdout, done.stderr)
        return done.stdout

    def start(self, *arguments: str | Path) -> LoggedProcess:
        return self._start([self._ros2, *map(str, arguments)])

    def start_node(self, name: str, *ros: str | Path) -> LoggedProcess:
        package = 'starcal_ground' if name in ('bag_player', 'setup_finder') else 'starcal_ros'
        module = f'{package}.ros.{name}'
        return self._start([sys.executable, '-m', module, '--ros-args', *map(str, ros)])

    def _start(self, command: list[str]) -> LoggedProcess:
        """Start a process that leads a group with its children."""
        log = self._logs / f'{len(self._started)}.log'
        process = with_log(command, log, env=self.environment, start_new_session=True)
        self._started.append(LoggedProcess(' '.join(command), log, process))
        return self._started[-1]

    def close(self, failed: bool) -> None:
        """Kill what has not ended by itself; after a failed test, print what all wrote."""
        for one in self._started:
            if one.process.poll() is None:
                # Python's fault handler answers SIGABRT with the stacks of all threads.
                os.killpg(one.process.pid, signal.SIGABRT if failed else signal.SIGKILL)
            status = one.process.wait()
            if failed:
                print(f'{one.name}, exit status {status}:\n{one.said()}')
