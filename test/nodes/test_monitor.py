# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The node of the monitor: what it receives on the graph, and what it leaves out."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

import pytest
from sample_records import calibration, observations, status  # type: ignore[import-not-found]

if TYPE_CHECKING:
    from conftest import Client

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.qos import DurabilityPolicy, QoSProfile

from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal_ros.messages.calibration import calibration_to_message
from starcal_ros.messages.observations import observations_to_message
from starcal_ros.messages.status import status_to_message
from starcal_ros.nodes.lifecycle_node.message_factory import make_message
from starcal_ros.nodes.monitor import Monitor

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
