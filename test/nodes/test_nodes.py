# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The nodes as processes: services, refusals, faults, parameters, signals; replay; permissions."""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import json
from pathlib import Path
from typing import Any, TYPE_CHECKING
from xml.etree import ElementTree

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
from managers import ACTIVATE, CLEANUP, CONFIGURE, DEACTIVATE, Manager  # type: ignore[import-not-found]
import numpy as np
import pytest
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.expand_topic_name import expand_topic_name
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, Imu, Temperature
from std_srvs.srv import Trigger
from vehicle import (  # type: ignore[import-not-found]
    ATTITUDES,
    BOTH,
    Client,
    IMAGES,
    latched_qos,
    parameters,
    REMAPS,
    tiny_observations,
)

from starcal.msg import Calibration, EnsembleStatus, StarObservations
from starcal.srv import Calibrate, LineOfSightTable
from starcal_ground.bag_writer import (
    attitude_to_message,
    BagWriter,
    image_to_message,
    temperature_to_message,
)
from starcal_ground.bags import reader
from starcal_ground.cli.main import main
from starcal_ground.written_files import write_calibration
from starcal_ros.formats.messages import message_codec
from starcal_ros.formats.messages.message_codec import make_header, stamp_ns
from starcal_ros.formats.messages.record_messages import (
    calibration_from_message,
    calibration_to_message,
    camera_info_to_message,
    observations_to_message,
)
from starcal_ros.formats.messages.sensor_messages import image_from_message
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration
from starcal_ros.records import Image as ImageRecord
from starcal_ros.records import refused_image
from starcal_ros.ros.node import make_message

if TYPE_CHECKING:
    from starcal_ros.records import Calibration as CalibrationRecord

pytestmark = pytest.mark.nodes


def blank(stamp_ns: int, **change: Any) -> Any:
    """Return an image message of a dark sky with some fields changed."""
    pixels = np.zeros((8, 8), np.uint16)
    message = image_to_message(ImageRecord(stamp_ns, pixels), '', make_message)
    for name, value in change.items():
        setattr(message, name, value)
    return message


def attitude(stamp_ns: int) -> Any:
    return attitude_to_message(stamp_ns, np.array([0, 0, 0, 1.0]), '', make_message)


def test_nodes_and_tool_give_the_same_calibration(vehicle, tiny) -> None:
    """The observations have rates and the sigma of the velocity, the picture the image's size."""
    for name in BOTH:
        vehicle.start(name, ros=REMAPS)
    pictures = vehicle.collect(Image, 'annotated_image', 5)
    answers: list[Any] = vehicle.collect(StarObservations, 'observations')
    # The player waits for the observer; calibrator and client must not miss the first image.
    vehicle.until_listened(listeners=2)
    vehicle.play(vehicle.bag)
    vehicle.until_images(json.loads((vehicle.bag / 'truth.json').read_text())['images'])
    vehicle.until(lambda: pictures and len(answers) == 10)
    assert {answer.velocity_sigma_m_s for answer in answers} == {10.0}
    rates_rad_s = np.array([answer.star_tracker_rate_rad_s for answer in answers])
    # The camera is still.
    assert rates_rad_s.shape == (10, 3) and np.abs(rates_rad_s).max() < 1e-12
    picture = pictures[0]
    assert picture.encoding == 'bgr8'
    assert (picture.height, picture.width) == (answers[0].height, answers[0].width)
    assert len(picture.data) == picture.height * picture.width * 3
    assert np.ptp(np.frombuffer(picture.data, np.uint8)) > 100
    vehicle.calibrate()
    found = vehicle.until_latched(Calibration, 'calibration')
    live = calibration_from_message(found[0])
    # On a busy machine the velocity after an image may come too late: the one before it, of half a
    # second earlier, moves the stars by 1e-8 px.
    sigma = np.sqrt(np.diag(tiny.covariance))
    off = live.geometry.camera.parameters - tiny.geometry.camera.parameters
    assert np.abs(off / sigma[:10]).max() < 1e-5
    turn = live.geometry.star_tracker_from_camera.inv() * tiny.geometry.star_tracker_from_camera
    assert (np.abs(turn.as_rotvec()) < 1e-5 * sigma[10:]).all()
    off = (live.covariance - tiny.covariance) / np.outer(sigma, sigma)
    assert np.abs(off).max() < 1e-5
    assert live.residual_rms_px == pytest.approx(tiny.residual_rms_px, rel=1e-6)
    assert (live.stars_used, live.stars_rejected) == (tiny.stars_used, tiny.stars_rejected)
    assert live.images_refused == tiny.images_refused
    # The digest of the observations has that velocity in it.
    ours = {k: v for k, v in tiny.provenance.items() if not k.startswith('input ')}
    digest = 'observations_sha256'
    assert dict(live.provenance) == ours | {digest: live.provenance[digest]}


def test_after_a_second_request_images_of_a_wrong_set_up_are_used(vehicle, tmp_path) -> None:
    """The observer measures the images that matched no star again with the first calibration."""
    bag, out = tmp_path / 'bag', tmp_path / 'out'
    wrong = ('--seed', '7', '--images', '6', '--alignment-error', '1.0', '--focal-error', '6')
    assert main(['simulate', '--scenario', 'tiny', *wrong, '-o', str(bag)]) == 0
    given = ('--params', str(bag / 'params.yaml'), '--no-report')
    assert main(['calibrate', str(bag), *given, '-o', str(out)]) == 0
    for name in BOTH:
        vehicle.start_node(name, *parameters(bag), *REMAPS)
    vehicle.until_listened()
    vehicle.play(bag)
    found = vehicle.latched(Calibration, 'calibration')
    for images in (4, 6):
        vehicle.until_images(images)
        vehicle.calibrate()
        vehicle.until(lambda images=images: found and found[-1].images_used == images)
    live = calibration_from_message(found[-1])
    offline = read_calibration(out / CALIBRATION_FILE)
    off = live.geometry.camera.parameters - offline.geometry.camera.parameters
    # The order of the images differs: sums round differently.
    assert np.abs(off / offline.sigma[:-3]).max() < 1e-4
    np.testing.assert_allclose(live.sigma, offline.sigma, rtol=1e-4)


def test_each_service_of_a_calibrator(vehicle, tmp_path) -> None:
    """Dry runs, bad requests, a table, roll-back, reset: one calibration is ever published."""
    vehicle.start('calibrator')
    # A call that changes nothing: if its answer is lost, it is called again.
    none = vehicle.call(Trigger, '/calibrator/rollback')
    assert not none.success and none.message == 'no calibration is active'
    vehicle.fill(tiny_observations().images)
    vehicle.calibrate()
    published: list[Any] = vehicle.until_latched(Calibration, 'calibration')
    # All but k3, which is zero in truth: the gate would name any other that is held.
    names = ['fx', 'skew', 'fy', 'cx', 'cy', 'k1', 'k2', 'p1', 'p2']
    trial = vehicle.call(Calibrate, '/calibrator/solve', dry_run=True, estimate=names)
    assert trial.success and 'would be activated' in trial.message, trial.message
    assert list(trial.calibration.estimated) == names
    bad = vehicle.call(Calibrate, '/calibrator/solve', estimate=['fz'])
    assert not bad.success and 'fz' in bad.message
    assert bad.calibration.stars_used == 0
    bad = vehicle.call(Calibrate, '/calibrator/solve', method='magic')
    assert not bad.success and 'magic' in bad.message
    for estimate in (['fx'] * 100_000, ['fx', 'fx'], ['x' * 10**6]):
        bad = vehicle.call(Calibrate, '/calibrator/solve', estimate=estimate)
        assert not bad.success and len(bad.message) <= 200

    answer = vehicle.call(LineOfSightTable, '/calibrator/lookup', points=7)
    assert answer.success and '49 lines of sight' in answer.message
    active = calibration_from_message(published[0])
    write_calibration(active, tmp_path / 'calibration.json')
    table = tmp_path / 'table.csv'
    assert main(['lookup', str(tmp_path), '-o', str(table), '--points', '7']) == 0
    columns = np.genfromtxt(table, delimiter=',', names=True)
    assert len(columns) == 49
    assert columns.dtype.names is not None
    for name in columns.dtype.names:
        np.testing.assert_array_equal(getattr(answer, name), columns[name])
    budget = active.sigma_budget
    assert [part.cause for part in answer.sigma_budget] == [part.cause for part in budget]
    assert answer.sigma_budget[0].map_arcsec == budget[0].map_arcsec > 0.0
    default = vehicle.call(LineOfSightTable, '/calibrator/lookup')
    assert len(default.u_px) == 25**2
    for points in (1, 201, 2**32 - 1):
        refused = vehicle.call(LineOfSightTable, '/calibrator/lookup', points=points)
        assert not refused.success and f'points: {points}' in refused.message

    reset = vehicle.call(Trigger, '/calibrator/reset')
    dropped = f'{len(tiny_observations().images)} images dropped'
    assert reset.success and reset.message.startswith(dropped)
    vehicle.until_images(0)
    assert not vehicle.call(Trigger, '/calibrator/calibrate').success
    assert len(published) == 1
    vehicle.fill(tiny_observations().images)
    vehicle.calibrate()
    back = vehicle.call(Trigger, '/calibrator/rollback')
    assert back.success and 'activated again' in back.message
    none = vehicle.call(Trigger, '/calibrator/rollback')
    assert not none.success and 'no calibration before' in none.message


def test_gate_refusal_and_force(vehicle) -> None:
    """A refused candidate is only in the response, unless it is forced."""
    calibrator = vehicle.start_filled('max_change_px:=1e-6')
    found = vehicle.until_latched(Calibration, 'calibration')
    answer = vehicle.call(Trigger, '/calibrator/calibrate')
    assert not answer.success and answer.message.startswith('refused by the gate')
    solved = vehicle.call(Calibrate, '/calibrator/solve')
    assert not solved.success and solved.calibration.stars_used > 0
    assert solved.calibration.reasons and not solved.calibration.accepted
    vehicle.until(lambda: 'refused by the gate' in vehicle.health('calibrator')[1])
    assert [one.number for one in found] == [0]  # that none is active
    candidate = vehicle.until_latched(Calibration, 'candidate_calibration')
    assert candidate[0].reasons and candidate[0].number == 0
    forced = vehicle.call(Calibrate, '/calibrator/solve', force=True)
    assert forced.success and not forced.calibration.accepted
    vehicle.until(lambda: found[1:])
    assert found[1].reasons[-1] == 'activated by request despite the gate'
    assert found[1].forced and found[1].number == 1
    vehicle.until(lambda: 'active despite the gate' in vehicle.health('calibrator')[1])
    assert calibrator.process.poll() is None


def test_an_image_waits_for_its_attitude_and_has_the_temperature(vehicle) -> None:
    """The attitudes are those of an Imu, which the node takes by the type of their publisher."""
    ros = (*REMAPS, '-r', 'temperature:=/box')
    vehicle.start('star_observer', 'attitude_timeout_s:=60.0', ros=ros)
    answers: list[Any] = vehicle.collect(StarObservations, 'observations')
    images = vehicle.publisher(Image, IMAGES, 10)
    attitudes = vehicle.publisher(Imu, ATTITUDES)
    temperatures = vehicle.publisher(Temperature, '/box')
    first = next(reader.read_raw([vehicle.bag], [IMAGES]))
    for offset_ns, degc in ((-2 * 10**9, 3.5), (-(10**9), -7.25), (10**9, 40.0)):
        message = temperature_to_message(
            first.log_time_ns + offset_ns, degc, 'camera', make_message
        )
        temperatures.publish(message)
    assert temperatures.wait_for_all_acked()
    vehicle.until_listened()
    images.publish(first.data)
    vehicle.until_value('images_waiting', '1')
    assert not answers
    for raw in reader.read_raw([vehicle.bag], [ATTITUDES]):
        decoded, sample = reader.decode(raw), Imu()
        sample.header = make_header(raw.log_time_ns, 'icrf', make_message)
        for axis in 'xyzw':
            setattr(sample.orientation, axis, getattr(decoded.quaternion, axis))
        attitudes.publish(sample)
    vehicle.until(lambda: answers)
    assert answers[0].refusal == '' and len(answers[0].catalog_id) > 50
    assert answers[0].temperature_degc == -7.25


def test_overrun_is_answered(vehicle) -> None:
    vehicle.start('star_observer', 'attitude_timeout_s:=60.0')
    answers: list[Any] = vehicle.collect(StarObservations, 'observations')
    images = vehicle.publisher(Image, 'image', 50)
    attitudes = vehicle.publisher(QuaternionStamped, 'attitude')
    vehicle.until_listened()
    for first, end in ((1, 20), (21, 30), (31, 40)):
        for k in range(first, end + 1):
            images.publish(blank(k))
        # DDS itself keeps no more than twenty: these are taken before the next are sent.
        vehicle.until_value('images_waiting', str(end))
    attitudes.publish(attitude(100_000_000_000))
    vehicle.until(lambda: len(answers) == 40)
    assert [a.refusal for a in answers] == ['wrong_size'] * 20 + ['overrun'] * 20


def test_camera_info_per_image(vehicle, tiny) -> None:
    """The active calibration with the header of each image; never the prior or a candidate."""
    candidate = dataclasses.replace(tiny, accepted=False, reasons=('bad',))
    observer = vehicle.start('star_observer', 'attitude_timeout_s:=0.0')
    best_effort = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    lossy = vehicle.collect(CameraInfo, 'image_camera_info', best_effort)
    infos: list[Any] = vehicle.collect(CameraInfo, 'image_camera_info')
    answers: list[Any] = vehicle.collect(StarObservations, 'observations')
    images = vehicle.publisher(Image, 'image', 50)
    calibrations = vehicle.node.create_publisher(Calibration, 'calibration', latched_qos())
    camera = tiny.geometry.camera
    vehicle.until_listened()

    def show(stamp_ns: int, frame_id: str = 'opnav', **size: int) -> Any:
        message = blank(stamp_ns, **{'width': camera.width, 'height': camera.height, **size})
        message.header.frame_id = frame_id
        images.publish(message)
        return message.header

    def publish(calibration: CalibrationRecord, said: str) -> None:
        calibrations.publish(calibration_to_message(calibration, make_message))
        vehicle.until(lambda: said in observer.said())

    show(1)
    publish(candidate, 'calibration: refused by the gate')
    show(2)
    vehicle.until(lambda: len(answers) == 2)
    publish(tiny, 'predicting stars with the active calibration')
    headers = [show(3), show(4, width=8, height=8), show(7), show(5, 'other')]
    vehicle.until(lambda: len(answers) == 6 and len(infos) == 3)
    # Nothing of the first two comes later: what is of one publisher comes in order.
    assert [info.header for info in infos] == [headers[0], *headers[2:]]
    expected = camera_info_to_message(tiny, make_message)
    for info in infos:
        expected.header = info.header
        assert info == expected
    forced = dataclasses.replace(candidate, forced=True)
    calibrations.publish(calibration_to_message(forced, make_message))
    vehicle.until(lambda: observer.said().count('predicting stars') == 2)
    header = show(8)
    vehicle.until(lambda: len(infos) == 4)
    assert infos[-1].header == header
    # Best effort may lose some of them, also all of a few.
    vehicle.until(lambda: lossy or not show(9))
    assert lossy[0].k[0] > 0


def test_calibrator_collects_while_it_solves(vehicle) -> None:
    """Observations that arrive during a calibration are all counted, bad ones are logged."""
    calibrator = vehicle.start_filled()
    observations = vehicle.publisher(StarObservations, 'observations')
    solve = vehicle.node.create_client(Calibrate, '/calibrator/solve')
    vehicle.until(solve.service_is_ready)
    futures = [solve.call_async(Calibrate.Request(dry_run=True)) for _ in range(5)]
    observations.publish(StarObservations(catalog_id=[1, 2], snr=[1.0]))
    of_other = dataclasses.replace(tiny_observations().images[0], time_ns=1)
    observations.publish(observations_to_message(of_other, 'right_camera', make_message))
    for k in range(300):
        refused = refused_image(k, 8, 8, 'no_stars', '')
        observations.publish(observations_to_message(refused, '', make_message))
    vehicle.until(lambda: all(future.done() for future in futures))
    assert all(future.result().success for future in futures)
    expected, told = [('bad_observations', 2), ('no_stars', 300)], vehicle.statuses()
    vehicle.until(lambda: [(one.reason, one.count) for one in told[-1].refused] == expected)
    assert 'direction_icrf: 0 numbers, not 2 x 3' in calibrator.said()
    assert "header.frame_id: 'right_camera' is not camera, camera_frame" in calibrator.said()
    assert 'Traceback' not in calibrator.said()


OBSERVER, CALIBRATOR = BOTH


@pytest.mark.parametrize(
    ('name', 'arguments', 'text'),
    [
        (OBSERVER, lambda f, _: parameters(f, 'max_attitude_gap_s:=soon'), 'max_attitude_gap_s'),
        (CALIBRATOR, lambda f, _: parameters(f, 'catalog:=/no/such.npz'), '/no/such.npz'),
        (
            OBSERVER,
            lambda f, _: parameters(f, 'magnitude_limt:=6.0'),
            'magnitude_limt: no such parameter (did you mean magnitude_limit?)',
        ),
        (CALIBRATOR, lambda *_: ('-p', 'magnitude_limit:=6.0'), 'camera_info_url'),
        (OBSERVER, lambda *_: ('--params-file', '/no/such/params.yaml'), '/no/such/params.yaml'),
        (CALIBRATOR, lambda _, scratch: ('--params-file', str(scratch / 'a.yaml')), 'a.yaml'),
        ('bag_player', lambda *_: (), 'bag: path of the bag to play is missing'),
        ('bag_player', lambda f, _: parameters(f, 'bag:=/no/bag'), '/no/bag: no such file or fol'),
        ('bag_player', lambda *_: ('-p', 'bag:=x', '-p', 'rate:=-1.0'), 'rate'),
        (
            'bag_player',
            lambda *_: ('-p', 'bagg:=x'),
            'bagg: no such parameter (did you mean bag?)',
        ),
    ],
)
def test_bad_parameters(start_node, tiny_bag, tmp_path, name, arguments, text) -> None:
    """A bad parameter ends a node with status 2 and one line that names it."""
    (tmp_path / 'a.yaml').write_text('/**:\n  ros__parameters: {psf: {a: [1, b')
    node = start_node(name, *arguments(tiny_bag, tmp_path))
    assert node.wait() == 2
    (line,) = (line for line in node.said().splitlines() if line.startswith(f'{name}: '))
    assert text in line and 'Traceback' not in node.said()


def test_parameters_while_running(vehicle) -> None:
    """Parameters have descriptions, and those in use cannot be changed."""
    node = vehicle.start('star_observer', 'max_attitude_gap_s:=3')
    described = vehicle.call(
        DescribeParameters,
        '/star_observer/describe_parameters',
        names=['max_attitude_gap_s', 'attitude_direction', 'max_images'],
    )
    gap, direction, images = described.descriptors
    assert gap.floating_point_range[0].from_value == 0.0
    assert 'inertial_to_st' in direction.description
    assert images.integer_range[0].to_value == 100_000
    manager = Manager(vehicle, 'star_observer')
    vehicle.until(lambda: manager.state() == 'active')
    assert 'in use' in set_gap(vehicle, 1.0)
    assert manager.change(DEACTIVATE) and manager.change(CLEANUP)
    assert set_gap(vehicle, 1.0) == ''
    assert 'max_attitude_gap_s' in set_gap(vehicle, -1.0)
    assert 'Type' in set_gap(vehicle, 1.0, 41)
    known = '(did you mean max_attitude_gap_s?)'
    assert known in set_gap(vehicle, 1.0, name='max_atitude_gap_s')
    assert manager.change(CONFIGURE) and manager.change(ACTIVATE)
    assert node.process.poll() is None


def set_gap(
    client: Client,
    value: float,
    kind: int = ParameterType.PARAMETER_DOUBLE,
    name: str = 'max_attitude_gap_s',
) -> str:
    """Set a parameter; return the reason of a refusal, '' if accepted."""
    number = ParameterValue(type=kind, double_value=value)
    parameter = Parameter(name=name, value=number)
    answer = client.call(SetParameters, '/star_observer/set_parameters', parameters=[parameter])
    return '' if answer.results[0].successful else str(answer.results[0].reason)


def test_player_loses_nothing(vehicle, tmp_path) -> None:
    random = np.random.default_rng(2)
    with BagWriter(tmp_path / 'large') as writer:
        for k in range(24):
            pixels = random.integers(0, 4096, (1024, 1296)).astype(np.uint16)
            for j in range(40):
                writer.write_attitude('/attitude', k * 10**9 + j, np.array([0, 0, 0, 1.0]), 'i')
            writer.write_image('/image', ImageRecord(k * 10**9 + 40, pixels), 'camera')
    # A listener that is slow to take loses what its own history has no room for.
    images: list[Any] = vehicle.collect(Image, '/image', 24)
    attitudes: list[Any] = vehicle.collect(QuaternionStamped, '/attitude', 24 * 40)
    player = vehicle.start_player(tmp_path / 'large')
    vehicle.until(lambda: player.process.poll() is not None)
    assert player.process.returncode == 0, player.said()
    vehicle.until(lambda: len(images) == 24 and len(attitudes) == 24 * 40)
    sound = list(reader.read_images([tmp_path / 'large'], '/image'))
    for message, image in zip(images, sound, strict=True):
        got = image_from_message(message)
        assert got.time_ns == image.time_ns and isinstance(image, ImageRecord)
        np.testing.assert_array_equal(got.pixels, image.pixels)
    stamps = [message_codec.stamp_ns(m.header.stamp) for m in attitudes]
    assert stamps == sorted(stamps)


ROOT = Path(__file__).parents[2]


def test_a_bag_plays_again_by_its_clock(vehicle) -> None:
    """Nodes as in replay.launch.py, with a namespace and /clock; a second pass adds nothing."""
    for name in BOTH:
        ros = ('-r', '__ns:=/cam', '-r', f'__node:={name}', *REMAPS, '--log-level', 'info')
        vehicle.start(name, 'autostart:=true', 'use_sim_time:=true', ros=ros)
    vehicle.until(lambda: vehicle.node.count_subscribers('/cam/observations'))
    status = vehicle.latched(EnsembleStatus, '/cam/ensemble_status')
    health = vehicle.collect(DiagnosticArray, '/diagnostics')
    # Simulated time without a /clock yet: diagnostics come all the same, and warn of it.

    def warned() -> set[str]:
        told = [one.status[0] for one in health if one.status[0].level == b'\x01']
        return {one.name for one in told if one.message.startswith('no /clock: ')}

    vehicle.until(lambda: len(warned()) == 2)
    vehicle.start_player(vehicle.bag, 'loop:=true', 'clock:=true', ros=('-r', '__ns:=/cam'))

    def restarts() -> int:
        told = (one.status[0] for one in health if 'star_observer' in one.status[0].name)
        values = [int(v.value) for s in told for v in s.values if v.key == 'restarts']
        return max(values, default=0)

    vehicle.until(lambda: restarts() >= 1)
    images = len(list(reader.read_images([vehicle.bag], IMAGES)))
    vehicle.until(lambda: status and status[-1].images == images)
    stamps = [raw.log_time_ns for raw in reader.read_raw([vehicle.bag])]

    def is_within_the_bag() -> bool:
        return min(stamps) <= stamp_ns(health[-1].header.stamp) <= max(stamps) + 10**9

    vehicle.until(is_within_the_bag)  # whatever pass: the diagnostics take the time from /clock


def test_the_policies_name_what_the_nodes_have(vehicle, tmp_path) -> None:
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write_image('/image', ImageRecord(1, np.zeros((2, 2), np.uint8)), 'camera')
        writer.write_attitude('/attitude', 1, np.array([0, 0, 0, 1.0]), 'icrf')
        writer.write_velocity('/velocity', 1, np.zeros(3), 'icrf')
        writer.write_temperature('/temperature', 1, 20.0, 'camera')
    vehicle.start_player(tmp_path / 'bag', 'clock:=true', 'wait_for_subscribers_s:=100.0')
    for name in BOTH:
        # Nobody may listen to the player, or it plays and ends.
        remaps = ('-r', 'image:=/elsewhere') if name == 'star_observer' else ()
        vehicle.start(name, ros=remaps)
    for name in (*BOTH, 'bag_player'):
        path = ROOT / 'config' / 'security' / f'{name}.policy.xml'
        profile = ElementTree.parse(path).getroot().find('enclaves/enclave/profiles/profile')
        assert profile is not None and profile.get('node') == name and profile.get('ns') == '/'
        allowed = {
            (kind, expand_topic_name(str(element.text), name, '/'))
            for group in profile
            for kind in ('publish', 'subscribe', 'reply', 'request')
            if group.get(kind) == 'ALLOW'
            for element in group
        }
        if importlib.util.find_spec('tf2_msgs') is None:
            allowed -= {('publish', '/tf_static'), ('subscribe', '/tf_static')}
        vehicle.until(functools.partial(shows, vehicle, name, allowed))
        assert of_graph(vehicle, name) == allowed, name


def of_graph(client: Client, name: str) -> set[tuple[str, str]]:
    """Names of the topics and services of a node, by the policy tags."""
    node = client.node
    found = set()
    for kind, ask in (
        ('publish', node.get_publisher_names_and_types_by_node),
        ('subscribe', node.get_subscriber_names_and_types_by_node),
        ('reply', node.get_service_names_and_types_by_node),
        ('request', node.get_client_names_and_types_by_node),
    ):
        found |= {(kind, topic) for topic, _ in ask(name, '/')}
    if ('subscribe', '/elsewhere') in found:
        found = {*found - {('subscribe', '/elsewhere')}, ('subscribe', '/image')}
    return found


def shows(client: Client, name: str, allowed: set[tuple[str, str]]) -> bool:
    return name in client.node.get_node_names() and of_graph(client, name) >= allowed
