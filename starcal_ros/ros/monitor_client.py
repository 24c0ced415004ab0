# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Node of ``starcal monitor``: receives what the nodes publish and draws it in the terminal.

It publishes nothing, and calls services of the calibrator by keys alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import contextlib
import dataclasses
import os
import select
import sys
import termios
import time
import tty
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rich.console import Console
from rich.live import Live
from std_srvs.srv import Trigger

from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal.srv import Calibrate
from starcal_ros.cli.commands.monitor import Seen, view
from starcal_ros.formats.messages.calibration_messages import (
    calibration_from_message,
    status_from_message,
)
from starcal_ros.formats.messages.observation_messages import observations_from_message
from starcal_ros.ros.lifecycle_node.inputs import LATCHED
from starcal_ros.ros.lifecycle_node.node_process import shut_down

_PREFIX = 'starcal: '  # of the diagnostics of our nodes
_PERIOD_S = 0.25
_SERVICES = {'c': 'calibrate', 's': 'solve', 'b': 'rollback', 'x': 'reset'}
_TRIED = ('solve',)  # as a dry run: it changes nothing, so it is not asked back
HELP = 'c calibrate   s solve, dry run   b roll back   x reset   q quit'


class Monitor(Node):
    """Holds what has been received; a message that cannot be read is left out and counted."""

    def __init__(self, context: rclpy.Context | None = None) -> None:
        super().__init__('starcal_monitor', context=context)
        self.seen = Seen()
        self._unread = 0
        for kind, topic, qos, callback in (
            (StarObservations, 'observations', 100, self._on_observations),
            (EnsembleStatus, 'ensemble_status', LATCHED, self._on_status),
            (Calibration, 'calibration', LATCHED, self._on_calibration),
            (Calibration, 'candidate_calibration', LATCHED, self._on_candidate),
            (DiagnosticArray, '/diagnostics', 10, self._on_diagnostics),
        ):
            self.create_subscription(kind, topic, self._reading(callback), qos)

    def _reading(self, callback: Any) -> Any:
        """The callback, which leaves a message out that is not of this version or not sound."""

        def run(message: Any) -> None:
            try:
                callback(message)
            except (AttributeError, ValueError) as error:
                self._unread += 1
                words = f'{self._unread} messages cannot be read, the last: {error}'
                self._set(health={**self.seen.health, 'monitor': (1, words)})

        return run

    def _set(self, **changes: Any) -> None:
        self.seen = dataclasses.replace(self.seen, **changes)

    def _on_observations(self, message: Any) -> None:
        self.seen = self.seen.with_image(observations_from_message(message))

    def _on_status(self, message: Any) -> None:
        self._set(status=status_from_message(message))

    def _on_calibration(self, message: Any) -> None:
        # An earlier candidate has been replaced by this decision.
        self._set(active=calibration_from_message(message), candidate=None)

    def _on_candidate(self, message: Any) -> None:
        candidate, active = calibration_from_message(message), self.seen.active
        if active is None or candidate.time_ns >= active.time_ns:
            self._set(candidate=candidate)

    def _on_diagnostics(self, message: Any) -> None:
        health = dict(self.seen.health)
        for status in message.status:
            if status.name.startswith(_PREFIX):
                level = int.from_bytes(status.level, 'little')
                health[status.name.removeprefix(_PREFIX)] = (level, status.message)
        self._set(health=health)


class Keys:
    """
    Calls services of the calibrator; a key that changes its state must be followed by ``y``.

    `line` is the help, a question, or the last answer.
    """

    def __init__(self, node: Node) -> None:
        # Relative names, so that a namespace or a remap leads to another calibrator.
        self._clients = {
            name: node.create_client(
                Calibrate if name == 'solve' else Trigger,
                node.resolve_service_name(f'calibrator/{name}'),
            )
            for name in _SERVICES.values()
        }
        self._asked = self._wanted = ''
        self._future: Any = None
        self._answer = ''

    def line(self) -> str:
        """Text to show beside the panels; sends a request once the calibrator is there."""
        if self._asked:
            return f'{self._asked}: press y to confirm, any other key to cancel'
        if not self._wanted:
            return f'{HELP}\n{self._answer}' if self._answer else HELP
        client = self._clients[self._wanted]
        if self._future is None:
            if not client.service_is_ready():
                return f'{self._wanted}: no service {client.srv_name} yet'
            request = (
                Calibrate.Request(dry_run=True) if self._wanted in _TRIED else Trigger.Request()
            )
            self._future = client.call_async(request)
        if not self._future.done():
            return f'{self._wanted}: no answer yet'
        self._answer = f'{self._wanted}: {self._future.result().message}'
        self._wanted, self._future = '', None
        return f'{HELP}\n{self._answer}'

    def press(self, key: str) -> None:
        """Take a key; others than those of `HELP` cancel a question."""
        asked, self._asked = self._asked, ''
        name = asked if key == 'y' else _SERVICES.get(key, '')
        if not name or (asked and key != 'y') or self._future is not None:
            return
        if asked or name in _TRIED:
            self._wanted = name
        else:
            self._asked = name


@contextlib.contextmanager
def single_keys() -> Iterator[bool]:
    """The terminal gives each key at once, without echo; False where there is no terminal."""
    if not sys.stdin.isatty():
        yield False
        return
    number = sys.stdin.fileno()
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)
        yield True
    finally:
        termios.tcsetattr(number, termios.TCSADRAIN, before)


def pressed() -> str:
    """Keys pressed since the last call."""
    number = sys.stdin.fileno()
    if not select.select([number], [], [], 0.0)[0]:
        return ''
    return os.read(number, 64).decode(errors='ignore')


def run(monitor: Monitor, once_after_s: float | None, console: Console) -> int:
    """Draw until interrupted or `q`, or once after some seconds."""
    if once_after_s is not None:
        deadline_s = time.monotonic() + once_after_s
        while time.monotonic() < deadline_s:
            rclpy.spin_once(monitor, timeout_sec=max(deadline_s - time.monotonic(), 0.0))
        console.print(view(monitor.seen))
        return 0
    keys = Keys(monitor)
    with (
        single_keys() as has_keys,
        Live(view(monitor.seen), console=console, auto_refresh=False, screen=True) as live,
    ):
        while True:
            deadline_s = time.monotonic() + _PERIOD_S
            while (left_s := deadline_s - time.monotonic()) > 0:
                rclpy.spin_once(monitor, timeout_sec=left_s)
            for key in pressed() if has_keys else '':
                if key == 'q':
                    return 0
                keys.press(key)
            live.update(view(monitor.seen, keys.line() if has_keys else ''), refresh=True)


def main() -> int:
    """Run the monitor."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--once', type=float, metavar='S', help='print one view after S seconds')
    args = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
    rclpy.init()
    monitor = Monitor()
    try:
        return run(monitor, args.once, Console())
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    finally:
        monitor.destroy_node()
        shut_down()


if __name__ == '__main__':
    sys.exit(main())
