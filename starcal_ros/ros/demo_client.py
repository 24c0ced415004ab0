# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Client of ``starcal demo``: waits for the nodes and their images, then requests a calibration.

It reports to its parent process in lines on standard output: ``ready`` when the nodes are
connected, ``collected N`` as images arrive, finally ``result MESSAGE`` or ``failed MESSAGE``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
import functools
from pathlib import Path
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_srvs.srv import Trigger

from starcal.msg import Calibration, EnsembleStatus
from starcal_ros.formats.messages.calibration_messages import calibration_from_message
from starcal_ros.formats.products.calibration_json import write_calibration
from starcal_ros.ros.lifecycle_node.inputs import LATCHED


class DemoClient(Node):
    """Holds the latest status and calibration, and the service client."""

    def __init__(self) -> None:
        super().__init__('starcal_demo')
        self.status: EnsembleStatus | None = None
        self.calibration: Calibration | None = None
        self.is_heard = False  # the observer reports the calibrator as a subscriber
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self.create_subscription(EnsembleStatus, 'ensemble_status', self._on_status, LATCHED)
        self.create_subscription(Calibration, 'calibration', self._on_calibration, LATCHED)
        self.calibrate = self.create_client(Trigger, 'calibrator/calibrate')

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'starcal: star_observer':
                values = {value.key: value.value for value in status.values}
                self.is_heard = int(values.get('listeners', 0)) > 0

    def _on_status(self, message: EnsembleStatus) -> None:
        self.status = message

    def _on_calibration(self, message: Calibration) -> None:
        self.calibration = message

    def images_seen(self) -> int:
        """Return the number of images that the calibrator has used or counted as refused."""
        status = self.status
        return (
            0
            if status is None
            else int(status.images) + sum(entry.count for entry in status.refused)
        )

    def has_seen(self, count: int) -> bool:
        """Return True once this many images have arrived."""
        return self.images_seen() >= count

    def spin_until(self, happened: Callable[[], bool], timeout_s: float) -> bool:
        """Spin until a condition holds; False after the timeout."""
        deadline = time.monotonic() + timeout_s
        while not happened():
            if time.monotonic() > deadline:
                return False
            rclpy.spin_once(self, timeout_sec=0.1)
        return True


def run(client: DemoClient, args: argparse.Namespace) -> int:
    """Run the exchange; exit status 0 accepted, 3 refused, 2 no result."""
    listening = (args.image_topic, args.attitude_topic, 'observations')

    def missing() -> list[str]:
        found = [topic for topic in listening if not client.count_subscribers(topic)]
        if not client.calibrate.service_is_ready():
            found.append('no service')
        # Messages sent before the observer has discovered the calibrator are lost.
        if not client.is_heard:
            found.append('subscriber of the observer')
        return found

    if not client.spin_until(lambda: not missing(), args.timeout):
        print(f'failed the nodes did not come up: {", ".join(missing())}', flush=True)
        return 2
    print('ready', flush=True)
    for count in range(1, args.images + 1):
        if not client.spin_until(functools.partial(client.has_seen, count), args.timeout):
            print(
                f'failed only {client.images_seen()} of {args.images} images arrived', flush=True
            )
            return 2
        print(f'collected {count}', flush=True)
    future = client.calibrate.call_async(Trigger.Request())
    if not client.spin_until(future.done, args.timeout):
        print('failed the calibrator did not answer', flush=True)
        return 2
    answer = future.result()
    if answer.success and client.spin_until(lambda: client.calibration is not None, args.timeout):
        write_calibration(calibration_from_message(client.calibration), args.output)
    print(f'result {answer.message}', flush=True)
    return 0 if answer.success else 3


def main() -> int:
    """Run the client."""
    parser = argparse.ArgumentParser()
    parser.add_argument('--images', type=int, required=True, help='number of images to wait for')
    parser.add_argument('--image-topic', required=True)
    parser.add_argument('--attitude-topic', required=True)
    parser.add_argument('--output', type=Path, required=True, help='calibration.json to write')
    parser.add_argument('--timeout', type=float, default=30.0, help='timeout of each step, s')
    args = parser.parse_args()
    rclpy.init()
    client = DemoClient()
    try:
        return run(client, args)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 130
    finally:
        client.destroy_node()
        rclpy.try_shutdown()


if __name__ == '__main__':
    sys.exit(main())
