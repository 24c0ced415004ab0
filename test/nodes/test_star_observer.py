# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The star observer: what its threads share, and two star trackers, one of which falls silent."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
import threading
from typing import Any

from geometry_msgs.msg import QuaternionStamped, TwistStamped
from mission_files import attitudes, images  # type: ignore[import-not-found]
import pytest
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image
from vehicle import in_this_process  # type: ignore[import-not-found]
import yaml

from starcal.msg import Calibration, StarObservations
from starcal_ground.bag_writer import attitude_to_message, BagWriter, image_to_message
from starcal_ros.constants import NANOSECONDS_PER_SECOND as SECOND_NS
from starcal_ros.formats.messages.record_messages import (
    calibration_from_message,
    calibration_to_message,
)
from starcal_ros.records import Image as ImageRecord
from starcal_ros.ros.node import make_message
from starcal_ros.ros.star_observer import StarObserver

pytestmark = pytest.mark.nodes


@pytest.fixture
def observer(ros_domain: None, tiny_bag: Path) -> Iterator[StarObserver]:
    with in_this_process(StarObserver, tiny_bag) as node:
        yield node


def test_the_worker_alone_changes_prediction_and_counts(observer, tiny) -> None:
    """A calibration that arrives while the worker measures waits for it."""
    busy, go_on, done = threading.Event(), threading.Event(), threading.Event()

    def hold() -> None:
        busy.set()
        assert go_on.wait(240.0)

    observer._queue.call(hold)
    assert busy.wait(240.0)
    observer._on_calibration(calibration_to_message(tiny, make_message))
    prior = observer._setup.prior
    assert observer._geometry is prior
    observer._queue.call(done.set)
    go_on.set()
    assert done.wait(240.0)
    assert observer._geometry is not prior


@pytest.mark.parametrize('changed', [{'child_frame': 'other'}, {'parent_frame': 'other'}])
def test_a_calibration_of_other_frames_is_not_used(observer, tiny, changed) -> None:
    other = replace(tiny, **changed)
    with pytest.raises(ValueError, match="'other'.*, not .'camera', 'star_tracker'"):
        observer._on_calibration(calibration_to_message(other, make_message))


def test_the_first_image_awaits_a_velocity_that_has_a_publisher(observer, client) -> None:
    assert observer._is_told()
    client.publisher(TwistStamped, observer.resolve_topic_name('velocity'))
    client.until(lambda: not observer._is_told())
    message = TwistStamped()
    message.header.frame_id = 'icrf'
    observer.taking(observer._on_velocity)(message)
    assert observer._is_told()


FIRST_FROM_OTHER = Rotation.from_euler('xyz', [100.0, -20.0, 35.0], degrees=True)


def parameter_file(bag: Path, path: Path, wrong_by_deg: float = 0.0) -> Path:
    """Parameters with a second star tracker, whose alignment may be wrong."""
    parameters = yaml.safe_load((bag / 'params.yaml').read_text())
    values = parameters['/**']['ros__parameters']
    first_from_camera = Rotation.from_quat(values['prior_alignment'])
    wrong = Rotation.from_euler('x', wrong_by_deg, degrees=True)
    values['more_star_trackers'] = ['other']
    alignment = (wrong * FIRST_FROM_OTHER.inv() * first_from_camera).as_quat()
    values['more_alignments'] = [float(x) for x in alignment]
    path.write_text(yaml.safe_dump(parameters))
    return path


def attitude_messages(mounted: Rotation, from_ns: int, to_ns: int) -> list[Any]:
    """Attitudes of the small bag in a span of time, by a star tracker mounted like this."""
    return [
        attitude_to_message(
            time_ns, (Rotation.from_quat(xyzw) * mounted).as_quat(), 'icrf', make_message
        )
        for time_ns, xyzw in attitudes()
        if from_ns < time_ns < to_ns
    ]


def test_one_takes_over_from_another(vehicle, tmp_path) -> None:
    params = parameter_file(vehicle.bag, tmp_path / 'params.yaml')
    bag, samples, shown = tmp_path / 'two', attitudes(), images()[4:]
    with BagWriter(bag) as writer:
        for k, (time_ns, xyzw) in enumerate(samples):
            if k < 0.7 * len(samples):
                writer.write_attitude('/attitude', time_ns, xyzw, 'icrf')
            quaternion = (Rotation.from_quat(xyzw) * FIRST_FROM_OTHER).as_quat()
            writer.write_attitude('/other/attitude', time_ns, quaternion, 'icrf')
        for image in shown:
            writer.write_image('/image', image, 'camera')
    for name in ('star_observer', 'calibrator'):
        vehicle.start_node(name, '--params-file', str(params))
    vehicle.until_listened()
    vehicle.play(bag)
    vehicle.until_images(len(shown))
    vehicle.calibrate()
    found = vehicle.until_latched(Calibration, 'calibration')
    first, other = calibration_from_message(found[0]).star_trackers
    assert (first.frame, other.frame) == ('star_tracker', 'other')
    assert first.images + other.images == len(shown)
    # Of an image that has both, the one whose next sample comes first: three have the other alone.
    assert 0 < first.images <= len(shown) - 3


def test_a_slow_one_is_used_and_a_wrong_one_costs_no_image(vehicle, tmp_path) -> None:
    """The first star tracker is right and comes later, the other is 5 degrees off."""
    params = parameter_file(vehicle.bag, tmp_path / 'params.yaml', wrong_by_deg=5.0)
    patient = ('--params-file', str(params), '-p', 'attitude_timeout_s:=60.0')
    vehicle.start_node('star_observer', *patient)
    found = vehicle.collect(StarObservations, 'observations')
    first = vehicle.publisher(QuaternionStamped, '/attitude')
    other = vehicle.publisher(QuaternionStamped, '/other/attitude')
    shown = vehicle.publisher(Image, '/image', 10)
    vehicle.until_listened()
    sent = 0

    def send(publisher: Any, *messages: Any) -> None:
        nonlocal sent
        for message in messages:
            publisher.publish(message)
        sent += len(messages)

    def send_attitudes(publisher: Any, image: ImageRecord) -> None:
        """Send those about an image; wait until they have come."""
        mounted = Rotation.identity() if publisher is first else FIRST_FROM_OTHER
        about = (image.time_ns - 2 * SECOND_NS, image.time_ns + 2 * SECOND_NS)
        send(publisher, *attitude_messages(mounted, *about))
        vehicle.until_value('messages', str(sent))

    for k, image in enumerate(images()[:4]):
        if k >= 2:  # the delay of the first is known
            send(shown, image_to_message(image, 'camera', make_message))
        # One after the other: samples of two topics may come in another order.
        send_attitudes(other, image)
        send_attitudes(first, image)
        vehicle.until(lambda k=k: len(found) == max(0, k - 1))
    assert [(one.refusal, one.star_tracker) for one in found] == 2 * [('', '')]
    assert found[0].detail == '' and found[1].detail.startswith('other not used: no_match: ')
    vehicle.until_value('attitudes_not_used', 'other: 1')
    assert vehicle.health()[:2] == (b'\x01', found[1].detail)


def test_the_first_images_wait_for_a_late_one_beside_a_wrong_one(vehicle, tmp_path) -> None:
    """No delay is known yet: images are refused by the wrong one, then used by the late one."""
    params = parameter_file(vehicle.bag, tmp_path / 'params.yaml', wrong_by_deg=40.0)
    vehicle.start_node('star_observer', '--params-file', str(params))
    observed = vehicle.collect(StarObservations, 'observations')
    vehicle.until_listened()
    late = vehicle.publisher(QuaternionStamped, '/attitude')
    wrong = vehicle.publisher(QuaternionStamped, '/other/attitude')
    shown = vehicle.publisher(Image, '/image', 10)

    first = images()[:3]
    until_ns = first[-1].time_ns + 2 * SECOND_NS
    for image in first:
        shown.publish(image_to_message(image, 'camera', make_message))
    for message in attitude_messages(FIRST_FROM_OTHER, 0, until_ns):
        wrong.publish(message)
    vehicle.until(lambda: len(observed) == len(first))
    assert {one.refusal for one in observed} == {'no_match'}
    for message in attitude_messages(Rotation.identity(), 0, until_ns):
        late.publish(message)
    vehicle.until(lambda: len(observed) == 2 * len(first))
    again = observed[len(first) :]
    assert [(one.refusal, one.star_tracker) for one in again] == len(first) * [('', '')]
