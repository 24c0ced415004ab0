# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Processes without the second of processor time that their imports take."""

from collections.abc import Mapping
import faulthandler
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import pickle
import subprocess
import sys
from typing import Any

from starcal_ground import child_process

FORKSERVER = multiprocessing.get_context('forkserver')
FORKSERVER.set_forkserver_preload(
    [
        *('starcal_ros.ros.calibrator', 'starcal_ros.ros.star_observer'),
        *('starcal_ground.ros.bag_player', 'starcal_ground.ros.setup_finder'),
        *('starcal_ground.mission.ingest.recording', 'astropy.io.fits'),
        # What rclpy imports with a first message, of which it takes the C library.
        *('rosidl_generator_py', 'std_msgs.msg', 'type_description_interfaces.msg'),
    ]
)


class ForkedProcess:
    """A process like `subprocess.Popen`, forked from one with all imports, no threads, no ROS."""

    def __init__(self, target: Any, *arguments: object) -> None:
        self._process = FORKSERVER.Process(target=target, args=arguments, daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        return self._process.exitcode

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired('a node', timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def kill(self) -> None:
        self._process.kill()


class ForkedNode(ForkedProcess):
    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        super().__init__(_run, name, arguments, str(log), dict(os.environ))


class ForkedChild(child_process.ChildProcess):
    def __init__(self) -> None:
        requests, self_requests = FORKSERVER.Pipe(duplex=False)
        self_answers, answers = FORKSERVER.Pipe(duplex=False)
        self._process: Any = ForkedProcess(_answer, os.getcwd(), requests, answers)
        for connection in (requests, answers):
            connection.close()
        self._requests = os.fdopen(os.dup(self_requests.fileno()), 'wb')
        self._answers = os.fdopen(os.dup(self_answers.fileno()), 'rb')
        for connection in (self_requests, self_answers):
            connection.close()
        pickle.dump(sys.path, self._requests)


def _answer(folder: str, requests: Connection, answers: Connection) -> None:
    """In the new process: what `child_process` does as a module."""
    os.chdir(folder)
    for number, connection in enumerate((requests, answers)):
        os.dup2(connection.fileno(), number)
        connection.close()
    sys.stdin = os.fdopen(0, closefd=False)
    child_process.main()


def _run(name: str, arguments: list[str], log: str, environment: Mapping[str, str]) -> None:
    """In the new process: what the console script of the node does."""
    from starcal_ros import entry_points

    os.environ.clear()
    os.environ.update(environment)
    for number, path in enumerate((os.devnull, log, log)):
        opened = os.open(path, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_APPEND)
        os.dup2(opened, number)
        os.close(opened)
    faulthandler.enable()
    sys.argv = [name, *arguments]
    sys.exit(entry_points._run(name))
