# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""set_camera_info client: each active calibration is sent; failures of a real service."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
import subprocess
import sys
from typing import Any

import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo
from sensor_msgs.srv import SetCameraInfo
from vehicle import Client, Vehicle  # type: ignore[import-not-found]

pytestmark = pytest.mark.nodes

SERVICE = '/opnav/set_camera_info'

# Keeps the camera that it receives in a file, as drivers do, until it is killed.
DRIVER = """
from pathlib import Path
import sys
import rclpy
from rclpy.serialization import serialize_message
from sensor_msgs.srv import SetCameraInfo

def keep(request, response):
    part = Path(sys.argv[1] + '.part')
    part.write_bytes(serialize_message(request.camera_info))
    part.rename(sys.argv[1])
    response.success = True
    return response

rclpy.init()
node = rclpy.create_node('camera_driver')
node.create_service(SetCameraInfo, sys.argv[2], keep)
rclpy.spin(node)
"""


@contextmanager
def driver(kept: Path) -> Iterator[None]:
    """A camera driver in a process of its own."""
    process = subprocess.Popen([sys.executable, '-c', DRIVER, str(kept), SERVICE])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def until_told(client: Client, outcome: str, level: bytes) -> None:
    """Wait for the level and the outcome of the driver in the diagnostics."""

    def is_so() -> bool:
        newest, _, values = client.health('calibrator')
        return (newest, values.get('camera_driver')) == (level, outcome)

    client.until(is_so)


def test_driver_is_told_and_its_failures_are_seen(vehicle: Vehicle) -> None:
    """A missing, silent, refusing and accepting driver: outcome, count and retry of each."""
    calibrator = vehicle.start_filled(f'set_camera_info_service:={SERVICE}')
    vehicle.calibrate()

    until_told(vehicle, 'service not available; will be sent when it is', b'\x01')

    # A driver that takes the call and never answers: nobody spins its node.
    with closing(Client()) as silent:
        silent.node.create_service(SetCameraInfo, SERVICE, lambda _, answer: answer)
        until_told(vehicle, 'no answer within 5 s', b'\x01')
        # The first failure was that the service was not there; then it is called again.
        vehicle.until(lambda: int(vehicle.health('calibrator')[2]['camera_driver_failures']) >= 3)

    received: list[Any] = []
    accepts = False

    def answer(request: Any, response: Any) -> Any:
        received.append(request.camera_info)
        response.success = accepts
        response.status_message = '' if accepts else 'sensor\nbusy'
        return response

    vehicle.node.create_service(SetCameraInfo, SERVICE, answer)
    until_told(vehicle, 'refused: sensor busy', b'\x01')

    accepts = True  # it is called again without a request
    until_told(vehicle, 'accepted', b'\x00')
    published = vehicle.until_latched(CameraInfo, 'camera_info')
    assert received[-1] == published[-1]

    before = len(received)
    vehicle.calibrate()
    vehicle.until(lambda: len(received) > before)
    said = calibrator.said()
    for outcome in (
        'service not available',
        'no answer within 5 s',
        'refused: sensor busy',
        'accepted',
    ):
        assert f'{SERVICE}: {outcome}' in said
    assert 'Traceback' not in said


def test_a_driver_process_that_restarts(vehicle: Vehicle, tmp_path: Path) -> None:
    """
    A driver in another process receives the calibration that was active before it started.

    The next one starts at once, while DDS takes the one that was killed as still there.
    """
    vehicle.start_filled(f'set_camera_info_service:={SERVICE}')
    vehicle.calibrate()
    published = vehicle.until_latched(CameraInfo, 'camera_info')
    for name in ('first', 'second'):
        kept = tmp_path / name
        with driver(kept):
            vehicle.until(kept.exists)
            until_told(vehicle, 'accepted', b'\x00')
        assert deserialize_message(kept.read_bytes(), CameraInfo) == published[-1]
