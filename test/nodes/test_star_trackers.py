# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes with two star trackers, of which the first falls silent."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

import pytest
from scipy.spatial.transform import Rotation
import yaml

if TYPE_CHECKING:
    from conftest import Client, StartNode

pytest.importorskip('rclpy')
pytest.importorskip('starcal.msg')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import QuaternionStamped
from mission_files import attitudes, images  # type: ignore[import-not-found]
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal_ground.bag_writer import attitude_to_message, BagWriter, image_to_message
from starcal_ros.constants import NANOSECONDS_PER_SECOND as SECOND_NS
from starcal_ros.formats.messages.record_messages import calibration_from_message
from starcal_ros.records import Image as ImageRecord
from starcal_ros.ros.node import make_message

pytestmark = pytest.mark.nodes

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


def test_one_takes_over_from_another(
    client: Client, start_node: StartNode, tiny_bag: Path, tmp_path: Path
) -> None:
    """Every image is used, and the calibration has the alignment to each star tracker."""
    params = parameter_file(tiny_bag, tmp_path / 'params.yaml')
    bag, samples = tmp_path / 'two', attitudes()
    with BagWriter(bag) as writer:
        for k, (time_ns, xyzw) in enumerate(samples):
            if k < 0.7 * len(samples):
                writer.write_attitude('/attitude', time_ns, xyzw, 'icrf')
            quaternion = (Rotation.from_quat(xyzw) * FIRST_FROM_OTHER).as_quat()
            writer.write_attitude('/other/attitude', time_ns, quaternion, 'icrf')
        for image in images():
            writer.write_image('/image', image, 'camera')
    for name in ('star_observer', 'calibrator'):
        start_node(name, ros=('--params-file', str(params)))
    client.until_listened()
    player = start_node('bag_player', ros=('-p', f'bag:={bag}', '-p', 'rate:=0.0'))
    assert player.wait(120.0) == 0, player.said()
    status = client.latched(EnsembleStatus, 'ensemble_status')
    client.until(lambda: status and status[-1].images == len(images()))
    answer = client.call(Trigger, '/calibrator/calibrate')
    assert answer.success, answer.message
    found = client.latched(Calibration, 'calibration')
    client.until(lambda: found)
    first, other = calibration_from_message(found[0]).star_trackers
    assert (first.frame, other.frame) == ('star_tracker', 'other')
    assert first.images + other.images == len(images()) and 0 < first.images < other.images


def test_a_slow_one_is_used_and_a_wrong_one_costs_no_image(
    client: Client, start_node: StartNode, tiny_bag: Path, tmp_path: Path
) -> None:
    """The first star tracker is right and comes later, the other is 5 degrees off."""
    params = parameter_file(tiny_bag, tmp_path / 'params.yaml', wrong_by_deg=5.0)
    patient = ('--params-file', str(params), '-p', 'attitude_timeout_s:=60.0')
    start_node('star_observer', ros=patient)
    found = client.collect(StarObservations, 'observations')
    health = client.collect(DiagnosticArray, '/diagnostics')
    first = client.publisher(QuaternionStamped, '/attitude')
    other = client.publisher(QuaternionStamped, '/other/attitude')
    shown = client.publisher(Image, '/image', 10)
    sent = 0

    def send(publisher: Any, *messages: Any) -> None:
        nonlocal sent
        for message in messages:
            publisher.publish(message)
        sent += len(messages)

    def send_attitudes(publisher: Any, image: ImageRecord) -> None:
        """Send those about an image."""
        mounted = Rotation.identity() if publisher is first else FIRST_FROM_OTHER
        for time_ns, xyzw in attitudes():
            if abs(time_ns - image.time_ns) < 2 * SECOND_NS:
                quaternion = (Rotation.from_quat(xyzw) * mounted).as_quat()
                send(publisher, attitude_to_message(time_ns, quaternion, 'icrf', make_message))

    def values() -> dict[str, str]:
        return {one.key: one.value for one in health[-1].status[0].values} if health else {}

    for k, image in enumerate(images()[:4]):
        if k >= 2:  # the delay of the first is known
            send(shown, image_to_message(image, 'camera', make_message))
        send_attitudes(other, image)
        client.until(lambda: values().get('messages') == str(sent))
        send_attitudes(first, image)
        # Before the next: samples of two topics may come in another order than they are sent.
        client.until(lambda: values().get('messages') == str(sent))
        client.until(lambda k=k: len(found) == max(0, k - 1))
    assert [(one.refusal, one.star_tracker) for one in found] == 2 * [('', '')]
    assert found[0].detail == '' and found[1].detail.startswith('other not used: no_match: ')
    client.until(lambda: values().get('attitudes_not_used') == 'other: 1')
    status = health[-1].status[0]
    assert status.level == DiagnosticStatus.WARN and status.message == found[1].detail


@pytest.mark.parametrize('wrong_by_deg', [5.0, 40.0])
def test_the_first_images_wait_for_a_late_one_beside_a_wrong_one(
    client: Client, start_node: StartNode, tiny_bag: Path, tmp_path: Path, wrong_by_deg: float
) -> None:
    """No delay is known yet: images are refused by the wrong one, then used by the late one."""
    params = parameter_file(tiny_bag, tmp_path / 'params.yaml', wrong_by_deg)
    start_node('star_observer', ros=('--params-file', str(params)))
    observed = client.collect(StarObservations, 'observations')
    client.until_listened()
    late = client.publisher(QuaternionStamped, '/attitude')
    wrong = client.publisher(QuaternionStamped, '/other/attitude')
    shown = client.publisher(Image, '/image', 10)

    def send_attitudes(publisher: Any, mounted: Rotation, until_ns: int) -> None:
        for time_ns, xyzw in attitudes():
            if time_ns <= until_ns:
                quaternion = (Rotation.from_quat(xyzw) * mounted).as_quat()
                publisher.publish(attitude_to_message(time_ns, quaternion, 'icrf', make_message))

    first = images()[:3]
    for image in first:
        shown.publish(image_to_message(image, 'camera', make_message))
    send_attitudes(wrong, FIRST_FROM_OTHER, first[-1].time_ns + 2 * SECOND_NS)
    client.until(lambda: len(observed) == len(first))
    assert {one.refusal for one in observed} == {'no_match'}
    send_attitudes(late, Rotation.identity(), first[-1].time_ns + 2 * SECOND_NS)
    client.until(lambda: len(observed) == 2 * len(first))
    again = observed[len(first) :]
    assert [(one.refusal, one.star_tracker) for one in again] == len(first) * [('', '')]
