# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Bags whose images are compressed and whose attitudes are poses."""

from dataclasses import replace
import itertools
from pathlib import Path
import threading
import time
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from mission_files import attitudes, images  # type: ignore[import-not-found]
import pytest
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from sample_records import assert_same, attitude_message, observations  # type: ignore[import-not-found]
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import String

from starcal.msg import StarObservations
from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags import reader
from starcal_ground.ros import bag_player
from starcal_ros.formats.bag import typestore
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import (
    COMPRESSED_TYPE,
    make_header,
    OBSERVATIONS_TYPE,
    POSE_TYPE,
    stamp_ns,
    TEMPERATURE_TYPE,
)
from starcal_ros.formats.messages.record_messages import (
    observations_from_message,
    observations_to_message,
)

pytestmark = pytest.mark.nodes

IMAGES = 24  # more than the queue of twenty holds


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    messages: list[tuple[int, str, str, Any]] = []
    shown, first_ns, last_ns = images()[:8], attitudes()[0][0], attitudes()[-1][0]
    shifts_ns = [turn * (last_ns - first_ns + 10**9) for turn in range(IMAGES // len(shown))]
    for time_ns, xyzw in ((ns + shift_ns, q) for shift_ns in shifts_ns for ns, q in attitudes()):
        message = attitude_message(POSE_TYPE, time_ns, xyzw)
        messages.append((time_ns, '/attitude', POSE_TYPE, message))
    for shift_ns, image in itertools.product(shifts_ns, shown):
        message = make_message(
            COMPRESSED_TYPE,
            header=make_header(image.time_ns + shift_ns, 'camera', make_message),
            format='mono16; png compressed',
            data=cv2.imencode('.png', image.pixels)[1].reshape(-1),
        )
        messages.append((image.time_ns + shift_ns, '/image/compressed', COMPRESSED_TYPE, message))
    with BagWriter(tmp_path / 'bag') as writer:
        for time_ns, topic, kind, message in sorted(messages, key=lambda one: one[0]):
            writer.write(topic, kind, time_ns, message)
    return tmp_path / 'bag'


def test_compressed_images_are_paced_for_the_node_that_observes(vehicle, bag) -> None:
    """Or a queue of twenty overflows; other subscribers of the images may start first."""
    found: list[Any] = vehicle.collect(StarObservations, 'observations')
    vehicle.collect(CompressedImage, '/image/compressed')
    vehicle.collect(PoseStamped, '/attitude')
    patient = 'wait_for_subscribers_s:=100.0'
    player = vehicle.start_player(bag, patient, 'wait_for_topic:=observations')
    vehicle.until(lambda: bool(vehicle.node.count_publishers('/attitude')))
    time.sleep(1.5)  # three times as long as the player waits for further subscribers
    ros = ('-r', 'image:=image/compressed')
    vehicle.start('star_observer', 'attitude_timeout_s:=60.0', ros=ros)
    assert player.wait() == 0, player.said()
    vehicle.until(lambda: len(found) == IMAGES)
    assert [one.refusal for one in found] == [''] * IMAGES
    assert all(len(one.catalog_id) > 50 for one in found)
    stamps_ns = [stamp_ns(one.header.stamp) for one in found]
    sent = reader.read_raw([bag], ['/image/compressed'])
    assert stamps_ns == [raw.log_time_ns for raw in sent]
    assert 'playing anyway' not in player.said()


def test_images_wait_until_the_observer_reports_all_that_listen_to_it(vehicle, bag) -> None:
    """One that had not discovered the calibrator yet published to nobody."""
    node, name = vehicle.node, vehicle.node.get_fully_qualified_name()
    health = node.create_publisher(DiagnosticArray, '/diagnostics', 10)
    found: list[Any] = vehicle.collect(CompressedImage, '/image/compressed')
    vehicle.collect(PoseStamped, '/attitude')
    vehicle.collect(StarObservations, 'observations')  # and the player listens too
    node.create_publisher(StarObservations, 'observations', 10)

    def report(listeners: str) -> bool:
        values = [KeyValue(key='listeners', value=listeners)]
        status = DiagnosticStatus(hardware_id=name, values=values)
        health.publish(DiagnosticArray(status=[status]))
        return bool(found)

    patient = 'wait_for_subscribers_s:=100.0'
    vehicle.start_player(bag, patient, 'wait_for_topic:=observations')
    vehicle.until(lambda: bool(node.count_publishers('/attitude')))
    assert not vehicle.holds(lambda: report('1'), 2.0)  # four times as long as where all are heard
    vehicle.until(lambda: report('2'))


def test_what_was_latched_is_latched(vehicle, tmp_path, monkeypatch) -> None:
    """As /tf_static, whose listeners connect to no publisher of another durability."""
    as_recorded = {**typestore.offered_qos(), 'durability': 'transient_local'}
    monkeypatch.setattr(typestore, 'offered_qos', lambda: as_recorded)
    with BagWriter(tmp_path / 'latched.mcap') as writer:
        message = make_message('std_msgs/msg/String', data='kept')
        writer.write('/latched', 'std_msgs/msg/String', 5, message)
    found = vehicle.latched(String, '/latched')
    player = vehicle.start_player(tmp_path / 'latched.mcap')
    vehicle.until(lambda: bool(found))
    assert player.wait() == 0 and [one.data for one in found] == ['kept']


def test_of_several_types_on_a_topic_one_is_played(vehicle, tmp_path) -> None:
    """The bytes of the others went out as messages of it; a name of another tool ended it."""
    with BagWriter(tmp_path / 'mixed.mcap') as writer:
        for k, topic in enumerate(('/mixed', '/mixed', '/mixed', '/of another tool')):
            kind, fields = 'std_msgs/msg/String', dict[str, Any](data=str(k))
            if k == 1:
                kind, header = TEMPERATURE_TYPE, make_header(k, '', make_message)
                fields = {'header': header, 'temperature': 0.0, 'variance': 0.0}
            writer._channels.pop(topic, None)
            writer.write(topic, kind, k, make_message(kind, **fields))
    found: list[Any] = vehicle.collect(String, '/mixed')
    player = vehicle.play(tmp_path / 'mixed.mcap')
    vehicle.until(lambda: len(found) == 2)
    assert [one.data for one in found] == ['0', '2']
    assert f'/mixed: {TEMPERATURE_TYPE} is not std_msgs/msg/String: skipped' in player.said()
    assert 'String is on no topic that ROS can have: skipped' in player.said()


def test_messages_of_another_version_are_played_as_those_of_this_one(vehicle, tmp_path) -> None:
    """Their bytes went out as they were, and their fields were read as others."""
    now = typestore.described(OBSERVATIONS_TYPE)[0]
    definition = now.replace('string detail\n', 'float64 later\n')
    store = typestore.typestore_of(OBSERVATIONS_TYPE, definition)
    message = observations_to_message(observations(), 'camera', make_message)
    names = [name for name, _ in store.fielddefs[OBSERVATIONS_TYPE][1] if name != 'later']
    older = {name: getattr(message, name) for name in names}
    data = store.serialize_cdr(
        store.types[OBSERVATIONS_TYPE](**older, later=0.5), OBSERVATIONS_TYPE
    )
    bag = tmp_path / 'older.mcap'
    with bag.open('wb') as stream:
        writer = typestore.started(stream)
        for topic, text in (('/older', definition), ('/other', 'int8 x\n')):
            schema = writer.register_schema(OBSERVATIONS_TYPE, 'ros2msg', text.encode())
            channel = writer.register_channel(topic, 'cdr', schema)
            for k in range(3):
                writer.add_message(channel, k, bytes(data), publish_time=k)
        writer.finish()
    found, other = (vehicle.collect(StarObservations, topic) for topic in ('/older', '/other'))
    player = vehicle.play(bag)
    vehicle.until(lambda: len(found) == 3)
    assert other == []
    for one in found:
        assert_same(observations_from_message(one), replace(observations(), detail=''))
    words = '/other: starcal/msg/StarObservations is defined in the bag as'
    assert player.said().count(words) == 1


def test_a_shutdown_that_wakes_nothing_ends_the_player() -> None:
    """A signal wakes executors, then shuts down ROS: one that waits between sees only the last."""
    context = Context()
    context.init()
    executor = SingleThreadedExecutor(context=context)
    runs = threading.Event()
    executor.create_task(runs.set)
    listener = threading.Thread(target=bag_player._listen, args=[executor], daemon=True)
    listener.start()
    assert runs.wait(240.0)
    handle: Any = context.handle
    handle.shutdown()
    listener.join(240.0)  # the wait has an end after 1 s; the rest is for a busy machine
    assert not listener.is_alive()
    executor.shutdown()
