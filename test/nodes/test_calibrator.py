# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibrator: requests at once, its driver, and its consumers where none is active."""

from collections.abc import Iterator
import contextlib
import dataclasses
from pathlib import Path
import subprocess
import sys
import threading
from types import SimpleNamespace
from typing import Any

from geometry_msgs.msg import TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from managers import ACTIVATE, DEACTIVATE  # type: ignore[import-not-found]
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import Trigger
from vehicle import Client, IMAGES, in_this_process, REMAPS, tiny_observations  # type: ignore[import-not-found]

from starcal.msg import Calibration
from starcal_ground.bags import reader
from starcal_ground.ros.monitor_client import Monitor
from starcal_ros.formats.messages.record_messages import (
    alignment_to_message,
    calibration_from_message,
    camera_info_to_message,
)
from starcal_ros.records import Activation
from starcal_ros.records import Ensemble as EnsembleRecord
from starcal_ros.ros.archive import Archive
from starcal_ros.ros.calibrator import Calibrator
from starcal_ros.ros.node import make_message, OK, WARN
from starcal_ros.ros.state import Answer

pytestmark = pytest.mark.nodes


@pytest.fixture
def calibrator(ros_domain: None, tiny_bag: Path) -> Iterator[Calibrator]:
    """An active calibrator in this process that holds the images of the small bag."""
    with in_this_process(Calibrator, tiny_bag) as node:
        for image in tiny_observations().images:
            node._state.add(image)
        yield node


def test_what_is_latched_is_what_is_active(client, calibrator) -> None:
    """The thread of the earlier of two activations may be the last to publish."""
    state = calibrator._state
    assert state.solve().success
    earlier, later = state.solve(estimate=('fx', 'fy'), force=True), state.rollback()
    assert earlier.active and later.active

    def tell(answer: Answer) -> None:
        for _ in range(20):
            calibrator._publish_and_answer(answer, Trigger.Response())

    threads = [threading.Thread(target=tell, args=(answer,)) for answer in (earlier, later)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    calibrator._publish_and_answer(earlier, Trigger.Response())
    infos = client.latched(CameraInfo, 'camera_info')
    alignments = client.latched(TransformStamped, 'alignment')
    calibrations = client.latched(Calibration, 'calibration')
    client.until(lambda: infos and alignments and calibrations)
    active = state.active
    assert active is not None and active is later.calibration
    found = calibration_from_message(calibrations[0])
    assert (found.number, found.active_since_ns) == (active.number, active.active_since_ns)
    assert infos == [camera_info_to_message(active, make_message)]
    assert alignments == [alignment_to_message(active, make_message)]


def test_diagnostics_are_of_the_limits_of_today(client, calibrator) -> None:
    """Cleaned up, configured with a tighter limit, and back, in one process."""
    assert calibrator._on_calibrate(None, Trigger.Response()).success
    latched: list[Any] = client.latched(CameraInfo, 'camera_info')

    def configure(max_change_px: float) -> dict[str, object]:
        calibrator.trigger_deactivate()
        calibrator.trigger_cleanup()
        parameter = Parameter('max_change_px', Parameter.Type.DOUBLE, max_change_px)
        assert calibrator.set_parameters([parameter])[0].successful
        calibrator.trigger_configure()
        calibrator.trigger_activate()
        return dict(calibrator.health()[2])

    strict = configure(1e-6)
    assert strict['active'] == 'none' and str(strict['last_gate']).startswith('refused: calib')
    client.until(lambda: latched and latched[-1].k[0] == 0)
    assert not calibrator._on_calibrate(None, Trigger.Response()).success
    relaxed = configure(10.0)
    told = [relaxed[key] for key in ('active', 'last_gate', 'last_answer')]
    assert told == [1, 'accepted', '']
    client.until(lambda: latched[-1].k[0] > 0)


def test_a_transition_is_in_the_diagnostics_at_once(calibrator) -> None:
    service: Any
    (service,) = (one for one in calibrator.services if one.srv_type is ChangeState)
    for transition, level in ((DEACTIVATE, WARN), (ACTIVATE, OK)):
        asked = ChangeState.Request(transition=Transition(id=transition))
        assert service.callback(asked, ChangeState.Response()).success
        assert calibrator._level == level


def transform(frame: str, x: float) -> TransformStamped:
    made = TransformStamped(child_frame_id=frame)
    made.transform.translation.x = x
    return made


def test_a_transform_of_another_node_is_named(calibrator, monkeypatch) -> None:
    """Only to a frame that this node publishes too, and not its own message."""
    monkeypatch.setattr(calibrator, 'count_publishers', lambda topic: 2)
    own = transform(calibrator._setup.frames.camera_frame, 0.0)
    calibrator._own_transforms.append(own)
    calibrator._on_transforms(SimpleNamespace(transforms=[own, transform('other', 1.0)]))
    assert calibrator._foreign_transforms() == ''
    foreign = transform(f'/{own.child_frame_id}', 1.0)
    calibrator._on_transforms(SimpleNamespace(transforms=[foreign]))
    assert f'publishes {own.child_frame_id} too' in calibrator._foreign_transforms()


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


@contextlib.contextmanager
def driver(kept: Path) -> Iterator[None]:
    process = subprocess.Popen([sys.executable, '-c', DRIVER, str(kept), SERVICE])
    try:
        yield
    finally:
        process.kill()
        process.wait()


def until_told(client: Client, outcome: str, level: bytes) -> None:
    def is_so() -> bool:
        newest, _, values = client.health('calibrator')
        return (newest, values.get('camera_driver')) == (level, outcome)

    client.until(is_so)


def test_driver_is_told_and_its_failures_are_seen(vehicle) -> None:
    calibrator = vehicle.start_filled(f'set_camera_info_service:={SERVICE}')
    vehicle.calibrate()

    until_told(vehicle, 'service not available; will be sent when it is', b'\x01')

    # A driver that takes the call and never answers: nobody spins its node.
    with contextlib.closing(Client()) as silent:
        silent.node.create_service(SetCameraInfo, SERVICE, lambda _, answer: answer)
        until_told(vehicle, 'no answer within 5 s', b'\x01')
        # The first failure was that the service was not there.
        assert int(vehicle.health('calibrator')[2]['camera_driver_failures']) >= 2

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
    failures = ('service not available', 'no answer within 5 s', 'refused: sensor busy')
    for outcome in (*failures, 'accepted'):
        assert f'{SERVICE}: {outcome}' in said
    assert 'Traceback' not in said


def test_a_driver_process_that_restarts(vehicle, tmp_path) -> None:
    """The next one starts at once, while DDS takes the one that was killed as still there."""
    vehicle.start_filled(f'set_camera_info_service:={SERVICE}')
    vehicle.calibrate()
    published = vehicle.until_latched(CameraInfo, 'camera_info')
    for name in ('first', 'second'):
        kept = tmp_path / name
        with driver(kept):
            vehicle.until(kept.exists)
            until_told(vehicle, 'accepted', b'\x00')
        assert deserialize_message(kept.read_bytes(), CameraInfo) == published[-1]


# How the heir of a calibrator differs, and why it has no active calibration.
STRICT = ('max_change_px:=1e-6',)
HEIRS = {
    'stricter limits': (STRICT, 'state', 'calibration 1 is not active, the gate'),
    'an empty folder': ((), 'empty', ''),
}


@pytest.mark.parametrize('name', HEIRS)
def test_consumers_return_to_the_prior(vehicle, name, tiny, tmp_path) -> None:
    values, folder, why = HEIRS[name]
    stored = dataclasses.replace(tiny, number=1, active_since_ns=1)
    with contextlib.closing(Archive(tmp_path / 'state', 'camera')) as archive:
        archive.keep(EnsembleRecord(), (Activation(1, 0, stored),))
    vehicle.start('star_observer', 'attitude_timeout_s:=0.0', ros=REMAPS)
    kept = f'state_dir:={tmp_path}/state'
    first = vehicle.start('calibrator', kept)
    vehicle.until_value('calibration', '1')
    infos: list[Any] = vehicle.collect(CameraInfo, 'image_camera_info')
    images = vehicle.publisher(Image, IMAGES)
    image = next(reader.read_raw([vehicle.bag], [IMAGES])).data
    vehicle.until(lambda: (images.publish(image), infos)[1])
    assert infos[-1].k[0] > 0

    monitor = Monitor(vehicle._context)
    vehicle._executor.add_node(monitor)
    vehicle.until(lambda: monitor.received.active is not None)
    first.stop()
    place = f'state_dir:={tmp_path}/{folder}'
    heir = vehicle.start('calibrator', place, *values, ros=('-r', '__node:=heir'))
    vehicle.until_value('calibration', 'prior')
    vehicle.until(lambda: 'images' in vehicle.health('heir')[2])
    level, text, values = vehicle.health('heir')
    withheld = str(int(bool(why)))
    assert (values['active'], values['state_refused_calibrations']) == ('none', withheld)
    if why:
        assert level == b'\x01' and text.startswith(f'{why} refuses it now: largest change')
        assert 'max_change_px' in text and text in heir.said()
        assert values['last_gate'] == f'refused: {text}'
    assert f'state_dir {tmp_path}/{folder}; no calibration active; 0 images' in heir.said()
    vehicle.until(lambda: vehicle.health()[0] == b'\x01')
    assert 'the prior predicts the stars' in vehicle.health()[1] and why in vehicle.health()[1]
    vehicle.until(lambda: monitor.received.active is None)
    assert why in monitor.received.why_none
    vehicle._executor.remove_node(monitor)
    monitor.destroy_node()
    vehicle.until(lambda: (images.publish(image), infos[-1].k[0] == 0)[1])
    assert not infos[-1].k.any() and infos[-1].width == stored.geometry.camera.width
    assert infos[-1].header.frame_id != ''

    # A late subscriber is told so too.
    calibrations = vehicle.latched(Calibration, 'calibration')
    cameras = vehicle.latched(CameraInfo, 'camera_info')
    alignments = vehicle.latched(TransformStamped, 'alignment')
    vehicle.until(lambda: calibrations and cameras and alignments)
    (none,) = calibrations
    assert (none.number, none.accepted, none.camera.width) == (0, False, 0)
    assert [why in reason for reason in none.reasons] == [True] * bool(why)
    assert not cameras[0].k.any() and not cameras[0].d
    rotation = alignments[0].transform.rotation
    assert (rotation.x, rotation.y, rotation.z, rotation.w) == (0.0, 0.0, 0.0, 0.0)

    heir.stop()
    vehicle.start('calibrator', kept, ros=('-r', '__node:=third'))
    vehicle.until_value('calibration', '1')
    vehicle.until(lambda: 'the prior predicts the stars' not in vehicle.health()[1])
