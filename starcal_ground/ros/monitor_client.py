# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Node of ``starcal monitor``: receives what the nodes publish and draws it in the terminal.

It publishes nothing and calls no service.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.node import Node
from rich.console import Console
from rich.live import Live

from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal_ground.cli.monitor_view import Received, view
from starcal_ros import records
from starcal_ros.formats.messages import message_codec, record_messages
from starcal_ros.ros.inputs import LATCHED
from starcal_ros.ros.node import end_quietly, is_overdue, until_told_to_end
from starcal_ros.text import counted

NAME = 'monitor'
_PREFIX = 'starcal: '  # begins the names of our nodes in the diagnostics
_PERIOD_S = 0.25


class Monitor(Node):
    """Holds what has been received; a message that cannot be read is left out and counted."""

    def __init__(self, context: rclpy.Context | None = None) -> None:
        super().__init__('starcal_monitor', context=context)
        self.received = Received(namespace=self.get_namespace().strip('/'))
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
                words = f'{counted(self._unread, "message")} not readable, the last: {error}'
                self._set(health={**self.received.health, 'monitor': (1, words)})

        return run

    def _set(self, **changes: Any) -> None:
        self.received = dataclasses.replace(self.received, **changes)

    def _on_observations(self, message: Any) -> None:
        self.received = self.received.with_image(
            record_messages.observations_from_message(message)
        )

    def _on_status(self, message: Any) -> None:
        self._set(status=message_codec.record_from_message(records.EnsembleStatus, message))

    def _on_calibration(self, message: Any) -> None:
        active = record_messages.active_from_message(message)
        why_none = record_messages.why_none_is_active(message) if active is None else ''
        # An earlier candidate has been replaced by this decision.
        self._set(active=active, why_none=why_none, candidate=None)

    def _on_candidate(self, message: Any) -> None:
        candidate, active = record_messages.calibration_from_message(message), self.received.active
        if active is None or candidate.time_ns >= active.time_ns:
            self._set(candidate=candidate)

    def _on_diagnostics(self, message: Any) -> None:
        health = dict(self.received.health)
        for status in message.status:
            if status.name.startswith(_PREFIX):
                level = int.from_bytes(status.level, 'little')
                health[status.name.removeprefix(_PREFIX)] = (level, status.message)
        self._set(health=health)


def run(monitor: Monitor, once_after_s: float | None, console: Console) -> int:
    """Draw until a signal ends it, or once after some seconds."""
    if once_after_s is not None:
        deadline_s = time.monotonic() + once_after_s
        while time.monotonic() < deadline_s:
            rclpy.spin_once(monitor, timeout_sec=max(deadline_s - time.monotonic(), 0.0))
        console.print(view(monitor.received))
        return 0
    with Live(view(monitor.received), console=console, auto_refresh=False, screen=True) as live:
        while monitor.context.ok() and not is_overdue():
            deadline_s = time.monotonic() + _PERIOD_S
            while (left_s := deadline_s - time.monotonic()) > 0:
                rclpy.spin_once(monitor, timeout_sec=left_s)
            live.update(view(monitor.received), refresh=True)
    return 0


def main() -> int:
    """Run the monitor; a signal ends it with status 0."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--once', type=float, metavar='S', help='print one view after S seconds')
    monitor: Monitor | None = None

    def work() -> int:
        nonlocal monitor
        args = parser.parse_args(rclpy.utilities.remove_ros_args(sys.argv)[1:])
        monitor = Monitor()
        return run(monitor, args.once, Console())

    return until_told_to_end(NAME, None, work, lambda: end_quietly(monitor))


if __name__ == '__main__':
    sys.exit(main())
