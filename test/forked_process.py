# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Processes of nodes without the second of processor time that their imports take."""

from __future__ import annotations

from collections.abc import Mapping
import faulthandler
import multiprocessing
import os
from pathlib import Path
import subprocess
import sys

FORKSERVER = multiprocessing.get_context('forkserver')
FORKSERVER.set_forkserver_preload(
    [f'starcal_ros.ros.{name}' for name in ('bag_player', 'calibrator', 'star_observer')]
)


class ForkedProcess:
    """
    A node in a process forked from one that has imported all nodes.

    That one has no threads and no part in ROS.  The methods are those of `subprocess.Popen`.
    """

    def __init__(self, name: str, arguments: list[str], log: Path) -> None:
        given = (name, arguments, str(log), dict(os.environ))
        self._process = FORKSERVER.Process(target=_run, args=given, daemon=True)
        self._process.start()
        assert self._process.pid is not None
        self.pid = self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit status; None before the end."""
        return self._process.exitcode

    def poll(self) -> int | None:
        """Return the same."""
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status when the process has ended."""
        self._process.join(timeout)
        if self.returncode is None:
            raise subprocess.TimeoutExpired('a node', timeout or 0.0)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal."""
        os.kill(self.pid, number)

    def kill(self) -> None:
        """Send SIGKILL."""
        self._process.kill()


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
    sys.exit(getattr(entry_points, name)())
