# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The node of the monitor: what it receives on the graph, and what it leaves out."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
import pty
import select
import struct
import subprocess
import sys
import termios
import time
from typing import Any, TYPE_CHECKING

import pytest
from sample_records import calibration, observations, status  # type: ignore[import-not-found]

if TYPE_CHECKING:
    from conftest import Client, StartNode

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal_ros.formats.messages.calibration_messages import (
    calibration_to_message,
    status_to_message,
)
from starcal_ros.formats.messages.observation_messages import observations_to_message
from starcal_ros.ros.lifecycle_node.message_factory import make_message
from starcal_ros.ros.monitor_client import Monitor

pytestmark = pytest.mark.nodes

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_what_the_nodes_publish_is_seen(client: Client) -> None:
    monitor = Monitor(client._context)
    client._executor.add_node(monitor)

    def publish(kind: Any, topic: str, message: Any, qos: Any = 10) -> None:
        publisher = client.node.create_publisher(kind, topic, qos)
        client.until(publisher.get_subscription_count)
        publisher.publish(message)

    try:
        record, counted, active = observations(), status(), calibration()
        sound = observations_to_message(record, 'camera', make_message)
        publish(StarObservations, 'observations', sound)
        client.until(lambda: monitor.seen.images == 1)
        assert monitor.seen.last is not None and len(monitor.seen.last) == len(record)
        publish(
            EnsembleStatus,
            'ensemble_status',
            status_to_message(counted, 'camera', make_message),
            LATCHED,
        )
        client.until(lambda: monitor.seen.status is not None)
        assert monitor.seen.status is not None and monitor.seen.status.images == counted.images
        message = calibration_to_message(active, make_message)
        publish(Calibration, 'candidate_calibration', message, LATCHED)
        client.until(lambda: monitor.seen.candidate is not None)
        publish(Calibration, 'calibration', message, LATCHED)
        client.until(lambda: monitor.seen.active is not None)
        assert monitor.seen.candidate is None
        healthy = DiagnosticStatus(
            level=DiagnosticStatus.WARN, name='starcal: star_observer', message='late'
        )
        other = DiagnosticStatus(name='another node', message='no concern of ours')
        publish(DiagnosticArray, '/diagnostics', DiagnosticArray(status=[healthy, other]))
        client.until(lambda: monitor.seen.health)
        assert monitor.seen.health == {'star_observer': (1, 'late')}
        sound.covariance_px2[0] = -1.0
        publish(StarObservations, 'observations', sound)
        client.until(lambda: 'monitor' in monitor.seen.health)
        assert 'not positive definite' in monitor.seen.health['monitor'][1]
        assert monitor.seen.images == 1
    finally:
        client._executor.remove_node(monitor)
        monitor.destroy_node()


def test_keys_call_the_calibrator_and_what_changes_it_is_confirmed(
    client: Client, start_node: StartNode, tiny_bag: Path
) -> None:
    """Typed into a terminal of the monitor, beside a calibrator without images."""
    start_node('calibrator', ros=('--params-file', str(tiny_bag / 'params.yaml')))
    client.until(lambda: client.node.count_services('calibrator/rollback'))
    main, end = pty.openpty()
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack('4H', 100, 120, 0, 0))
    command = [sys.executable, '-m', 'starcal_ros.ros.monitor_client']
    shown = b''

    def type_until(keys: str, expected: str) -> None:
        nonlocal shown
        shown = b''
        os.write(main, keys.encode())
        deadline_s = time.monotonic() + 60.0
        while expected.encode() not in shown:
            assert time.monotonic() < deadline_s, shown.partition(b'images')[0][-300:]
            if select.select([main], [], [], 0.2)[0]:
                shown += os.read(main, 65536)

    with subprocess.Popen(command, stdin=end, stdout=end, stderr=end) as monitor:
        try:
            type_until('', 'b roll back')
            type_until('b', 'rollback: press y to confirm')
            type_until('n', 'c calibrate')
            assert b'rollback: ' not in shown
            type_until('by', client.call(Trigger, 'calibrator/rollback').message)
            type_until('s', 'solve: ')
            os.write(main, b'q')
            assert monitor.wait(20.0) == 0
        finally:
            monitor.kill()
            os.close(main)
            os.close(end)
