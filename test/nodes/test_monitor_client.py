# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The node of the monitor: what it receives on the graph, and what it leaves out."""

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import pytest
from sample_records import calibration, observations, status  # type: ignore[import-not-found]
from vehicle import latched_qos  # type: ignore[import-not-found]

from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal_ground.ros.monitor_client import Monitor
from starcal_ros.formats.messages.record_messages import (
    calibration_to_message,
    observations_to_message,
    status_to_message,
)
from starcal_ros.ros.node import make_message

pytestmark = pytest.mark.nodes


def test_what_the_nodes_publish_is_seen(client) -> None:
    monitor = Monitor(client._context)
    client._executor.add_node(monitor)

    def publish(kind: Any, topic: str, message: Any, qos: Any = 10) -> None:
        client.publisher(kind, topic, qos).publish(message)

    try:
        record, counted, active = observations(), status(), calibration()
        sound = observations_to_message(record, 'camera', make_message)
        publish(StarObservations, 'observations', sound)
        client.until(lambda: monitor.received.images == 1)
        assert monitor.received.last is not None and len(monitor.received.last) == len(record)
        collected = status_to_message(counted, 'camera', make_message)
        publish(EnsembleStatus, 'ensemble_status', collected, latched_qos())
        client.until(lambda: monitor.received.status is not None)
        ensemble = monitor.received.status
        assert ensemble is not None and ensemble.images == counted.images
        message = calibration_to_message(active, make_message)
        publish(Calibration, 'candidate_calibration', message, latched_qos())
        client.until(lambda: monitor.received.candidate is not None)
        publish(Calibration, 'calibration', message, latched_qos())
        client.until(lambda: monitor.received.active is not None)
        assert monitor.received.candidate is None
        late = DiagnosticStatus(level=b'\x01', name='starcal: star_observer', message='late')
        other = DiagnosticStatus(name='another node', message='no concern of ours')
        publish(DiagnosticArray, '/diagnostics', DiagnosticArray(status=[late, other]))
        client.until(lambda: monitor.received.health)
        assert monitor.received.health == {'star_observer': (1, 'late')}
        sound.covariance_px2[0] = -1.0
        publish(StarObservations, 'observations', sound)
        client.until(lambda: 'monitor' in monitor.received.health)
        assert 'not positive definite' in monitor.received.health['monitor'][1]
        assert monitor.received.images == 1
    finally:
        client._executor.remove_node(monitor)
        monitor.destroy_node()


def test_a_signal_while_it_draws_ends_it_without_a_traceback(client, start_node) -> None:
    """Signals at other times: test_node_lifecycle.py, for all that end by `until_told_to_end`."""
    monitor = start_node('starcal_ground.ros.monitor_client', '-r', '__node:=ended', forked=False)
    client.until(lambda: 'ended' in client.node.get_node_names())
    assert monitor.stop() == 0 and 'Traceback' not in monitor.said(), monitor.said()


@pytest.mark.parametrize(
    ('client_name', 'remap'),
    [('monitor_client', '__ns:=bad name'), ('calibrate_client', ':=')],
)
def test_a_bad_remap_is_answered_without_a_traceback(start_node, client_name, remap) -> None:
    """The last line is ours, after those that rcl logs; one ends with its own interpreter."""
    module, is_forked = f'starcal_ground.ros.{client_name}', remap != ':='
    process = start_node(module, '-r', remap, forked=is_forked)
    assert process.wait() == 2 and 'Traceback' not in process.said(), process.said()
    last = process.said().splitlines()[-1]
    assert last.startswith(f'{client_name.removesuffix("_client")}') and remap in last
