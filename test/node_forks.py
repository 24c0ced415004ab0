# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Node processes forked from one that has imported the nodes: an import costs 0.9 s of a core.

``python -m node_forks`` reads an order for each node, a line of JSON, and forks.  The child runs
the entry point as ``python -m starcal_ros.entry_points`` does, to the end of the interpreter.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

NODES = ('star_observer', 'calibrator', 'bag_player')


class Fork:
    """A process of which a file tells the exit status; the part of `subprocess.Popen` in use."""

    def __init__(self, pid: int, status: Path) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._status = status

    def poll(self) -> int | None:
        """Return the exit status, negative for a signal; None while it runs."""
        if self.returncode is None and self._status.exists():
            self.returncode = os.waitstatus_to_exitcode(int(self._status.read_text()))
        return self.returncode

    def wait(self, timeout_s: float = float('inf')) -> int:
        """Wait for the exit status; `subprocess.TimeoutExpired` if there is none in time."""
        deadline_s = time.monotonic() + timeout_s
        while (status := self.poll()) is None:
            if time.monotonic() > deadline_s:
                raise subprocess.TimeoutExpired(f'process {self.pid}', timeout_s)
            time.sleep(0.01)
        return status

    def send_signal(self, number: int) -> None:
        """Send a signal to the process if it runs."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        """Kill the process if it runs."""
        self.send_signal(signal.SIGKILL)


class Forks:
    """The process that forks; its environment is that of the first order."""

    def __init__(self) -> None:
        self._server = subprocess.Popen(
            [sys.executable, '-m', 'node_forks'],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={
                **os.environ,
                'PYTHONFAULTHANDLER': '1',
                'PYTHONPATH': os.pathsep.join(map(str, (Path(__file__).parent, *sys.path))),
            },
            text=True,
        )

    def start(self, arguments: list[str], log: Path) -> Fork:
        """Start a node with its output in a file."""
        assert self._server.stdin is not None and self._server.stdout is not None
        log.touch()
        order = {'arguments': arguments, 'log': str(log), 'environment': dict(os.environ)}
        print(json.dumps(order), file=self._server.stdin, flush=True)
        return Fork(int(self._server.stdout.readline()), _status_of(log))

    def close(self) -> None:
        """End the process that forks."""
        self._server.communicate()


def _status_of(log: Path) -> Path:
    return log.with_suffix('.status')


def _serve() -> int:
    """Fork for each order; return the exit status, in the child that of the node."""
    from starcal_ros import entry_points

    for name in NODES:
        importlib.import_module(f'starcal_ros.ros.{name}')
    for line in iter(sys.stdin.readline, ''):
        order = json.loads(line)
        with contextlib.suppress(ChildProcessError):  # no keeper is left
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        if os.fork():
            continue
        log = Path(order['log'])
        node = os.fork()
        if node:
            print(node, flush=True)
            _keep(node, _status_of(log))
        _redirect(log)
        os.environ.clear()
        os.environ.update(order['environment'])
        sys.argv = [entry_points.__file__, *order['arguments']]
        return entry_points._run(sys.argv.pop(1))
    return 0


def _keep(node: int, status: Path) -> None:
    """Wait for a node, write its status, and end."""
    # As a terminal's shell, it outlives an interrupt of the node's group.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    _, ended = os.waitpid(node, 0)
    part = status.with_suffix('.part')
    part.write_text(str(ended))
    part.rename(status)
    os._exit(0)


def _redirect(log: Path) -> None:
    """Write output to a file, read nothing."""
    for descriptor, path, flags in (
        (0, os.devnull, os.O_RDONLY),
        (1, log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
    ):
        opened = os.open(path, flags, 0o644)
        os.dup2(opened, descriptor)
        os.close(opened)
    os.dup2(1, 2)


if __name__ == '__main__':
    sys.exit(_serve())
