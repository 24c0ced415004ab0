# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Malformed messages and requests to real nodes, callers that end, and kills of both nodes."""

from collections.abc import Iterable
import contextlib
import itertools
import random
import subprocess
import sys
from typing import Any

from attacks import BAG, calibration, many, observations  # type: ignore[import-not-found]
import cv2
from flight import Flight  # type: ignore[import-not-found]
from geometry_msgs.msg import QuaternionStamped, TransformStamped, TwistStamped
from lifecycle_msgs.srv import ChangeState, GetState
from managers import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, Manager  # type: ignore[import-not-found]
from mutants import is_decodable, mutated, not_finite  # type: ignore[import-not-found]
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Temperature
from std_srvs.srv import Trigger
from vehicle import BOTH, Client, IMAGES, latched_qos, NodeProcess, REMAPS, Vehicle  # type: ignore[import-not-found]

from starcal.msg import Calibration, StarObservations
from starcal.srv import Calibrate
from starcal_ground.bag_writer import attitude_to_message, image_to_message
from starcal_ground.bags import reader
from starcal_ros.formats.messages.record_messages import (
    calibration_to_message,
    observations_to_message,
)
from starcal_ros.records import Image as ImageRecord
from starcal_ros.ros.node import make_message

pytestmark = [pytest.mark.nodes, pytest.mark.slow]

# Fields that may be NaN or infinite by the interface document.
MAY_BE_INFINITE = frozenset(
    (
        *('temperature_degc', 'velocity_sigma_m_s', 'zenith_icrf', 'predicted_sigma', 'found'),
        *('star_tracker_rate_rad_s', 'star_tracker_rate_sigma_rad_s', 'attitude_gap_s', 'limit'),
        *('shape_px', 'shape_p_value', 'rotation_arcsec', 'p_value'),
    )
)
SHUTDOWNS = (5, 6, 7)  # a node rightly executes it


class Received:
    """Number of messages that a node has received, from its diagnostics."""

    def __init__(self, client: Client, node: str) -> None:
        self._client, self._node = client, node
        self._state = client.node.create_client(GetState, f'/{node}/get_state')
        client.until(lambda: self.count() is not None and self._state.service_is_ready())

    def count(self) -> int | None:
        """Messages received, up to a second old; None before the first diagnostics."""
        values = self._client.health(self._node)[2]
        return int(values['messages']) if values else None

    def send(self, publisher: Any, messages: Iterable[Any], at_once: int = 500) -> None:
        """Publish messages; return once the node has received all that can be decoded."""
        for batch in batches(messages, at_once):
            before = self.count() or 0
            sent = sum(map(is_decodable, batch))
            for message, _ in batch:
                publisher.publish(message)
            self._client.until(lambda: (self.count() or 0) - before >= sent)  # noqa: B023


def batches(messages: Iterable[Any], size: int) -> Iterable[list[Any]]:
    left = iter(messages)
    return iter(lambda: list(itertools.islice(left, size)), [])


def assert_finite(messages: Iterable[Any]) -> None:
    for message in messages:
        assert not_finite(message, MAY_BE_INFINITE) == []


def assert_requests_are_answered(
    client: Client, kind: Any, name: str, template: Any, process: NodeProcess
) -> None:
    service = client.node.create_client(kind, name)
    client.until(service.service_is_ready)
    for request, _ in mutated(template, 20):
        if isinstance(request, bytes):  # rclpy clients cannot send them
            continue
        if hasattr(request, 'transition') and request.transition.id in SHUTDOWNS:
            continue
        if hasattr(request, 'dry_run'):
            request.dry_run = True
        assert_finite([client.ask(service, request)])
    assert process.process.poll() is None


def assert_common_requests_are_answered(client: Client, name: str, process: NodeProcess) -> None:
    """Mutants of the requests that every node answers; afterwards it is active again."""
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=8.0)
    given = [Parameter(name='magnitude_limit', value=value)]
    change = ChangeState.Request()
    change.transition.id = CONFIGURE
    atomically = SetParametersAtomically
    for kind, service, request in (
        (SetParameters, 'set_parameters', SetParameters.Request(parameters=given)),
        (atomically, 'set_parameters_atomically', atomically.Request(parameters=given)),
        (ChangeState, 'change_state', change),
    ):
        assert_requests_are_answered(client, kind, f'/{name}/{service}', request, process)
    manager = Manager(client, name)
    for transition in (CONFIGURE, ACTIVATE):  # each may be refused
        manager.change(transition)
    assert manager.state() == 'active'


def small_image() -> Any:
    record = ImageRecord(10**18, np.zeros((4, 4), np.uint16))
    return image_to_message(record, 'camera', make_message)


@pytest.mark.parametrize('kind', [Image, CompressedImage])
def test_every_image_is_answered(vehicle, kind) -> None:
    template = small_image()
    if kind is CompressedImage:
        data = cv2.imencode('.png', np.zeros((4, 4), np.uint16))[1].tobytes()
        template = kind(header=template.header, format='mono16; png compressed', data=data)
    node = vehicle.start('star_observer', 'attitude_timeout_s:=0.0', ros=REMAPS)
    answers = vehicle.collect(StarObservations, 'observations')
    infos = vehicle.collect(CameraInfo, 'image_camera_info')
    vehicle.until_listened()
    images = vehicle.publisher(kind, IMAGES)
    for batch in batches(mutated(template, 20), 20):  # as many as the queue holds
        before = len(answers)
        for message, _ in batch:
            images.publish(message)
        vehicle.until(lambda: len(answers) - before >= len(batch))  # noqa: B023
    assert_finite([*answers, *infos])
    # One that is cut off is counted with its reason, and the node goes on.
    counted = sum(answer.refusal == 'bad_layout' for answer in answers) + 1
    images.publish(serialize_message(template)[:40])
    vehicle.until(lambda: answers[-1].detail.startswith(f'{IMAGES}: 40 bytes are no'))
    vehicle.until_value('refused_bad_layout', str(counted))
    assert node.process.poll() is None


def test_the_star_observer_measures_images_after_hostile_messages(vehicle) -> None:
    node = vehicle.start('star_observer', ros=REMAPS)
    answers = vehicle.collect(StarObservations, 'observations')
    received = Received(vehicle, 'star_observer')
    header = small_image().header
    attitude = attitude_to_message(10**18, np.array([0.0, 0.0, 0.0, 1.0]), 'icrf', make_message)
    for kind, topic, template in (
        (QuaternionStamped, '/star_tracker/attitude', attitude),
        (TwistStamped, '/spacecraft/velocity', TwistStamped(header=header)),
        (Temperature, 'temperature', Temperature(header=header)),
    ):
        received.send(vehicle.publisher(kind, topic), mutated(template, 20))
    latched = vehicle.publisher(Calibration, 'calibration', latched_qos())
    sound = calibration_to_message(calibration(), make_message)
    received.send(latched, mutated(sound, 20), at_once=1)  # a latched topic holds one message
    assert_common_requests_are_answered(vehicle, 'star_observer', node)
    latched.publish(sound)
    vehicle.start_player(vehicle.bag)
    images = len(list(reader.read_images([BAG], IMAGES)))
    # Stamps that went far ahead and come back cost the first images.
    vehicle.until(lambda: sum(not answer.refusal for answer in answers) >= images // 2)
    assert_finite(answers)
    assert node.process.poll() is None


def test_the_calibrator_calibrates_after_hostile_messages(vehicle, tmp_path) -> None:
    """Those that pass for observations are saved as well."""
    state = f'state_dir:={tmp_path}/state'
    node = vehicle.start('calibrator', 'max_images:=30', state)
    published = [
        vehicle.statuses(),
        *(vehicle.latched(Calibration, t) for t in ('calibration', 'candidate_calibration')),
        vehicle.latched(CameraInfo, 'camera_info'),
        vehicle.latched(TransformStamped, 'alignment'),
    ]
    received = Received(vehicle, 'calibrator')
    publisher = vehicle.publisher(StarObservations, 'observations')
    brightest = observations()[0]
    brightest = brightest.select(np.argsort(np.argsort(-brightest.flux_dn)) < 40)
    template = observations_to_message(brightest, 'camera', make_message)
    received.send(publisher, mutated(template, 60))
    statuses = published[0]
    vehicle.until(lambda: statuses and 0 < statuses[-1].images == statuses[-1].images_saved)
    assert {entry.reason for entry in statuses[-1].refused} >= {'bad_observations'}
    request = Calibrate.Request(method='magic', estimate=['fx', 'fz'])
    assert_requests_are_answered(vehicle, Calibrate, '/calibrator/solve', request, node)
    assert_common_requests_are_answered(vehicle, 'calibrator', node)
    vehicle.call(Trigger, '/calibrator/reset')
    vehicle.until_images(0)
    vehicle.fill(observations())
    vehicle.calibrate()
    assert_finite(itertools.chain.from_iterable(published))
    assert node.process.poll() is None


@pytest.fixture
def filled(vehicle: Vehicle) -> NodeProcess:
    node = vehicle.start('calibrator')
    vehicle.fill(observations())
    return node


def test_callers_at_once_and_callers_that_end(client, filled) -> None:
    callers = [client.node.create_client(Trigger, '/calibrator/calibrate') for _ in range(10)]
    client.until(lambda: all(caller.service_is_ready() for caller in callers))
    futures = [caller.call_async(Trigger.Request()) for caller in callers]
    client.until(lambda: all(future.done() for future in futures))
    assert all(future.result().success for future in futures)
    caller = subprocess.Popen([sys.executable, '-c', CALLER], stdout=subprocess.PIPE)
    assert caller.stdout is not None
    caller.stdout.readline()
    caller.kill()
    caller.wait()
    caller.stdout.close()
    assert client.call(Trigger, '/calibrator/calibrate').success
    assert filled.process.poll() is None


CALLER = """
import time, rclpy
from std_srvs.srv import Trigger
rclpy.init()
node = rclpy.create_node('caller')
client = node.create_client(Trigger, 'calibrator/calibrate')
client.wait_for_service()
client.call_async(Trigger.Request())
print('called', flush=True)
time.sleep(60)
"""


def test_calls_to_a_deactivated_node_are_answered_and_a_second_calibrator_is_named(
    vehicle, filled
) -> None:
    calls = [(vehicle.node.create_client(Calibrate, '/calibrator/solve'), Calibrate.Request())]
    for name in ('calibrate', 'rollback'):
        service = vehicle.node.create_client(Trigger, f'/calibrator/{name}')
        calls.append((service, Trigger.Request()))
    vehicle.until(lambda: all(service.service_is_ready() for service, _ in calls))
    manager = Manager(vehicle, 'calibrator')
    for transitions in ((DEACTIVATE, ACTIVATE), (DEACTIVATE, CLEANUP, CONFIGURE, ACTIVATE)):
        futures = [service.call_async(request) for service, request in calls]
        for transition in transitions:
            manager.change(transition)
        vehicle.until(lambda: all(future.done() for future in futures))  # noqa: B023
    assert filled.process.poll() is None
    # A second one is warned of.
    vehicle.start('calibrator', ros=('-r', '__node:=double'))
    vehicle.until(lambda: 'another node publishes' in vehicle.health('calibrator')[1])
    vehicle.calibrate()


def test_kill_9_loses_no_image_that_was_saved(vehicle, tmp_path) -> None:
    """Kills at random during images and solves, and of nodes that start."""
    choose = random.Random(2)
    with contextlib.closing(Flight(vehicle, tmp_path)) as flight:
        for k in range(many(3)):
            flight.fly(choose.uniform(0.1, 2.5))
            names = (('calibrator',), ('star_observer',), BOTH)[k % 3]
            flight.kill(*names)
            if k % 5 == 1:
                flight.kill_at_start(names[0], choose.uniform(0.0, 3.0))
        flight.fly(0.5)
    assert flight.undelivered <= 4  # one stop of the transport, which is not ours
    assert flight.reported > 0 and flight.answered_ns
    assert not list((tmp_path / 'state').rglob('*.damaged'))
