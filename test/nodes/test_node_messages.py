# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Records as generated messages, their bytes and back; the log of a node, which quotes texts."""

import array
import dataclasses
from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sample_records import assert_same, calibration, observations, status  # type: ignore[import-not-found]

from starcal_ground.bag_writer import image_to_message
from starcal_ground.ros.bag_player import BagPlayer
from starcal_ros.formats.bag import typestore as bag_types
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_from_message,
    calibration_to_message,
    camera_info_to_message,
    observations_from_message,
    observations_to_message,
    status_to_message,
)
from starcal_ros.records import Image
from starcal_ros.ros import node
from starcal_ros.ros.node import make_message, message_class, StarcalNode
from starcal_ros.ros.printable_log import PrintableLog, PrintableLogger

pytestmark = pytest.mark.nodes


def through_wire(message: Any) -> Any:
    return deserialize_message(serialize_message(message), type(message))


def test_records_survive_the_wire() -> None:
    record = observations()
    message = through_wire(observations_to_message(record, 'cam', make_message))
    assert_same(record, observations_from_message(message))
    # The checks of the model stay in calibration.json.
    result = dataclasses.replace(calibration(), model_checks=None)
    message = through_wire(calibration_to_message(result, make_message))
    assert_same(result, calibration_from_message(message))
    message = status_to_message(status(), 'cam', make_message)
    assert through_wire(message) == message


def test_both_kinds_of_message_are_the_same_on_the_wire() -> None:
    """Nodes and bag writer serialise equal messages, up to padding bytes."""
    for build in (
        lambda make: observations_to_message(observations(), 'cam', make),
        lambda make: calibration_to_message(calibration(), make),
        lambda make: camera_info_to_message(calibration(), make),
        lambda make: alignment_to_message(calibration(), make),
        lambda make: image_to_message(Image(5, np.ones((4, 6), np.uint16)), 'c', make),
    ):
        live, recorded = build(make_message), build(bag_types.make_message)
        data = bag_types.typestore().serialize_cdr(recorded, recorded.__msgtype__)
        assert len(serialize_message(live)) == len(data)
        assert deserialize_message(bytes(data), type(live)) == live


def test_numbers_are_handed_over_as_rclpy_takes_them_whole() -> None:
    """It copies the elements of an ndarray one by one: half a second for an image of 8 MB."""
    for field, dtype, code in (
        ('sequence<uint8>', np.uint8, 'B'),
        ('sequence<double, 9>', np.float64, 'd'),
        ('sequence<float>', np.float32, 'f'),
    ):
        numbers = node._as_field(np.arange(6).astype(dtype)[::2], field)
        assert numbers == array.array(code, [0, 2, 4])
    fixed = np.zeros(9)
    assert node._as_field(fixed, 'double[9]') is fixed


def test_unknown_types_are_import_errors() -> None:
    """As a bag may have them; no other module is imported for its name."""
    for name in (
        *('', 'no_such_msgs/msg/Thing', 'sensor_msgs/msg/NoSuchThing', 'sensor_msgs/msg/_image'),
        *('/msg/Image', 'sensor_msgs/Image', 'os/path/join', 'std_srvs/srv/Empty', 'a/msg/b/c'),
    ):
        with pytest.raises(ImportError):
            message_class(name)


def test_a_line_that_logs_without_end_fills_no_disk(capfd, monkeypatch) -> None:
    """Ten images a second are refused for ten minutes; another line logs as ever."""
    now_s = 0.0
    monkeypatch.setattr('starcal_ros.ros.printable_log.time.monotonic', lambda: now_s)
    logger = PrintableLogger('refusing')
    for k in range(6000):
        now_s = 0.1 * k
        logger.warning(f'image {k} refused')
    logger.warning('stamps went back')
    said = [line.partition(']: ')[2] for line in capfd.readouterr().err.splitlines()]
    assert said[:100] == [f'image {k} refused' for k in range(100)]
    # One a minute is one of six hundred; the quotient may round to one image more.
    later = [int(line.rpartition('(and ')[2].partition(' left out)')[0]) for line in said[101:-1]]
    assert len(later) in (8, 9) and set(later) <= {599, 600}
    assert said[-1] == 'stamps went back'


def test_escape_sequences_do_not_reach_the_terminal(client, capfd) -> None:
    """At each severity, from lines of their own."""
    assert issubclass(StarcalNode, PrintableLog) and issubclass(BagPlayer, PrintableLog)
    node = PrintableLog('quoting', context=client._context)
    try:
        node.get_logger().info('topic \x1b[2J')
        node.get_logger().warning('topic \x1b]0;title\x07')
        node.get_logger().error('line\ncalibrator: ok')
    finally:
        node.destroy_node()
    said = ''.join(capfd.readouterr())
    assert '\x1b' not in said and '\x07' not in said
    for text in ('topic \\x1b[2J', 'topic \\x1b]0;title\\x07', 'line\\ncalibrator: ok'):
        assert f'[quoting]: {text}\n' in said
