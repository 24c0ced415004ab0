# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Diagnostics of the running nodes: keys and levels as in docs/diagnostics.md."""

import array
import itertools
import math
from pathlib import Path
import re
import time

from geometry_msgs.msg import QuaternionStamped, Twist, TwistStamped
import pytest
from rclpy.qos import qos_profile_sensor_data, QoSProfile
from sensor_msgs.msg import Image, Temperature
from std_srvs.srv import Trigger
from vehicle import ATTITUDES, BOTH, IMAGES, REMAPS, tiny_observations  # type: ignore[import-not-found]

from starcal.msg import Calibration, StarObservations
from starcal_ground.bags import reader
from starcal_ros.constants import SPEED_OF_LIGHT_M_S
from starcal_ros.records import IMAGE_REFUSALS
from starcal_ros.ros.node import make_message
from starcal_ros.sky.astrometry import earth_velocity_c

pytestmark = pytest.mark.nodes

DOCUMENT = Path(__file__).parents[2] / 'docs' / 'diagnostics.md'


def documented(*tables: str) -> set[str]:
    """Keys in the document; those with a reason in the name once per reason."""
    keys: set[str] = set()
    for table in ('both nodes', *tables):
        marks = f'<!-- diagnostics of {table} -->\n(.*?)<!-- end -->'
        found = re.search(marks, DOCUMENT.read_text(), re.DOTALL)
        assert found, table
        keys |= set(re.findall(r'^\| `(.*?)`', found[1], re.MULTILINE))
    if 'refused_…' in keys:
        keys.remove('refused_…')
        keys |= {f'refused_{reason}' for reason in IMAGE_REFUSALS}
    return keys


def test_observer_says_what_the_document_says(vehicle) -> None:
    vehicle.start('star_observer', 'attitude_timeout_s:=60.0', ros=REMAPS)
    vehicle.until(lambda: vehicle.health()[1] == 'waiting for images')
    level, _, values = vehicle.health()
    assert level == b'\x00' and set(values) == documented('star_observer')
    assert values['latency_median_s'] == values['attitude_gap_s'] == 'none'

    images = vehicle.publisher(Image, IMAGES, 10)
    attitudes = vehicle.publisher(QuaternionStamped, ATTITUDES)
    samples = list(reader.read_raw([vehicle.bag], [ATTITUDES]))
    images.publish(next(reader.read_raw([vehicle.bag], [IMAGES])).data)
    for sample in samples:
        attitudes.publish(sample.data)
    vehicle.until_value('images_used', '1')
    vehicle.until_value('attitudes', str(len(samples)))
    # It is known once the observations are published, which are counted before.
    vehicle.until(lambda: vehicle.health()[2]['latency_median_s'] != 'none')
    level, text, values = vehicle.health()
    assert (level, text) == (b'\x00', 'observing')
    assert set(values) == documented('star_observer')
    stamps_ns = [sample.log_time_ns for sample in samples]
    steps_s = [(b - a) / 1e9 for a, b in itertools.pairwise(stamps_ns)]
    assert float(values['attitude_gap_s']) == pytest.approx(max(steps_s), abs=0.001)
    assert 0 < float(values['image_rate_hz']) < float(values['attitude_rate_hz'])
    assert 0 < float(values['latency_median_s']) == float(values['latency_worst_s'])
    assert int(values['memory_peak_mb']) > 10
    assert values['callback_errors'] == '0'


def test_images_that_the_middleware_loses_are_counted(vehicle) -> None:
    """A publisher with a short history sends large images faster than they can be received."""
    vehicle.start('star_observer', ros=REMAPS)
    images = vehicle.publisher(Image, IMAGES, 1)
    large = make_message('sensor_msgs/msg/Image', width=2592, height=2048, encoding='mono8')
    large.data = array.array('B', bytes(2592 * 2048))

    def is_counted() -> bool:
        images.publish(large)
        return 'lost before they reached the node' in vehicle.health()[1]

    vehicle.until(is_counted)
    level, _, values = vehicle.health()
    assert level == b'\x01' and int(values['images_lost']) > 0


def test_calibrator_diagnostics_match_the_document(vehicle, tmp_path) -> None:
    history = tmp_path / 'state' / 'calibrations'
    history.mkdir(parents=True)
    (history / '00000001_calibration_00000001.json').write_text('{"schema": 1}')
    vehicle.start('calibrator', f'state_dir:={tmp_path / "state"}')
    vehicle.until(lambda: 'images' in vehicle.health('calibrator')[2])
    level, text, values = vehicle.health('calibrator')
    assert set(values) == documented('calibrator')
    assert level == b'\x01' and text.startswith('set aside as damaged: ')
    assert '00000001_calibration_00000001.json' in text
    assert values['state_damaged_files'] == '1'
    assert (values['active'], values['calibration_age_s']) == ('none', 'none')
    assert (values['last_gate'], values['camera_driver']) == ('none', 'none')

    vehicle.fill(tiny_observations().images)
    vehicle.calibrate()
    vehicle.until(lambda: vehicle.health('calibrator')[2].get('active') != 'none')
    _, _, values = vehicle.health('calibrator')
    assert set(values) == documented('calibrator')
    assert values['last_gate'] == 'accepted'
    # On this machine's clock, within the time a test may take.
    assert 0 <= float(values['calibration_age_s']) < 600
    assert math.isfinite(float(values['disk_free_mb']))


def test_nodes_that_are_not_active(vehicle) -> None:
    for name in BOTH:
        vehicle.start(name, 'autostart:=false')
    for name in BOTH:
        vehicle.until(lambda name=name: vehicle.health(name)[0])
        level, text, values = vehicle.health(name)
        assert (level, text) == (b'\x01', 'not active: unconfigured')
        assert set(values) == documented()


def test_a_silent_topic_is_warned_of_once_and_sensor_data_are_received(vehicle) -> None:
    """Best effort, as drivers offer it: all inputs connect, remapped or not."""
    node = vehicle.start('star_observer', ros=REMAPS)
    vehicle.until(lambda: f'{ATTITUDES}: no message in 5 s, from 0 pub' in node.said())
    assert node.said().count(f'{IMAGES}: no message in 5 s') == 1
    publishers = [
        vehicle.node.create_publisher(kind, topic, qos_profile_sensor_data)
        for kind, topic in (
            (QuaternionStamped, ATTITUDES),
            (TwistStamped, '/spacecraft/velocity'),
            (Temperature, '/temperature'),
            (Image, IMAGES),
        )
    ]
    vehicle.until(lambda: all(one.get_subscription_count() for one in publishers))
    # Where all connect, nothing is left to warn of.
    vehicle.until(lambda: vehicle.health()[:2] == (b'\x00', 'waiting for images'))
    publishers[0].publish(QuaternionStamped())
    vehicle.until_value('messages', '1')


def test_a_driver_that_stops_is_named_until_it_sends_again(vehicle) -> None:
    node = vehicle.start('star_observer', ros=REMAPS)
    attitudes = vehicle.publisher(QuaternionStamped, ATTITUDES, 10)
    sample = next(reader.read_raw([vehicle.bag], [ATTITUDES])).data
    vehicle.until(lambda: vehicle.health()[1] == 'waiting for images')
    begin_s = time.monotonic()

    def has_streamed() -> bool:
        attitudes.publish(sample)
        return time.monotonic() > begin_s + 6.0  # a stream: more than five seconds

    vehicle.until(has_streamed)
    assert vehicle.health()[:2] == (b'\x00', 'waiting for images')
    vehicle.until(lambda: f'{ATTITUDES}: no message for ' in vehicle.health()[1])
    assert vehicle.health()[0] == b'\x01'
    assert node.said().count(f'{ATTITUDES}: no message for ') == 1

    def is_well() -> bool:
        attitudes.publish(sample)
        return tuple(vehicle.health()[:2]) == (b'\x00', 'waiting for images')

    vehicle.until(is_well)


def test_a_driver_in_another_namespace_is_named(vehicle) -> None:
    for name in BOTH:
        vehicle.start(name)
    vehicle.node.create_publisher(Image, '/sat2/camera/image_raw', 10)
    there = '/sat2/camera/image_raw has a publisher'
    vehicle.until(lambda: f'/image: {there}' in vehicle.health()[1])
    assert vehicle.health()[0] == b'\x01'
    answer = vehicle.call(Trigger, '/calibrator/calibrate')
    words = f'no message on /observations: {there} and no subscriber; too'
    assert answer.message.startswith(words)
    assert len(answer.message) <= 200


IMPLAUSIBLE = 'm/s is faster than any spacecraft: left out; send m/s'


def test_velocities_of_no_spacecraft_are_counted_and_logged_once(vehicle) -> None:
    """They were an error each in the log; one of a usual mistake was taken without a word."""
    observer = vehicle.start('star_observer', ros=REMAPS)
    velocity = vehicle.publisher(TwistStamped, '/spacecraft/velocity')
    vehicle.collect(StarObservations, 'observations')
    vehicle.until_listened()

    def send(*speeds_m_s: float, x_m_s: float = 0.0, z_m_s: float = 0.0) -> None:
        for speed_m_s in speeds_m_s:
            message = TwistStamped()
            linear = message.twist.linear
            linear.x, linear.y, linear.z = x_m_s, speed_m_s, z_m_s
            velocity.publish(message)

    send(7000.0)
    doubt = 'the velocity may be relative to the Earth: add the barycentric velocity of the Earth'
    vehicle.until(lambda: vehicle.health()[:2] == (b'\x01', doubt))
    vehicle.until(lambda: doubt in observer.said())
    send(math.nan, math.inf, 3e8)
    vehicle.until_value('velocities_left_out', '3')
    level, text, _ = vehicle.health()
    assert level == b'\x01' and text == 'velocity [0.0, 300000000.0, 0.0] ' + IMPLAUSIBLE
    x_m_s, y_m_s, z_m_s = SPEED_OF_LIGHT_M_S * earth_velocity_c(0)  # at the stamp of all
    send(y_m_s, x_m_s=x_m_s, z_m_s=z_m_s)
    vehicle.until_value('messages', '5')
    level, text, values = vehicle.health()
    assert (level, text) == (b'\x00', 'waiting for images')
    assert (values['velocities_left_out'], values['callback_errors']) == ('3', '0')
    vehicle.until(lambda: observer.said().count(IMPLAUSIBLE) > 0)
    assert observer.said().count(IMPLAUSIBLE) == observer.said().count(doubt) == 1


def test_a_publisher_that_is_not_received_is_named(vehicle) -> None:
    """By its name on the graph: the image was asked for as reliable, the calibration latched."""
    fixed = 'qos_overrides.{}.subscription.reliability:={}'.format
    given = fixed(IMAGES, 'reliable'), fixed('/spacecraft/velocity', 'best_effort')
    observer = vehicle.start('star_observer', *given, ros=REMAPS)
    image = vehicle.node.create_publisher(Image, IMAGES, qos_profile_sensor_data)
    refused = '/opnav/image_raw: Best effort publisher and reliable subscription'
    vehicle.until(lambda: vehicle.health()[1] == f'not received: {refused}')
    assert vehicle.health()[0] == b'\x01'
    assert refused in observer.said()
    vehicle.node.destroy_publisher(image)
    # What is fixed for one topic is no rule for the others.
    shown = vehicle.node.get_subscriptions_info_by_topic
    for topic, fixed_to in ((ATTITUDES, 'RELIABLE'), ('/spacecraft/velocity', 'BEST_EFFORT')):
        assert [one.qos_profile.reliability.name for one in shown(topic)] == [fixed_to]
    latched = vehicle.node.create_publisher(Calibration, '/calibration', QoSProfile(depth=1))
    refused = '/calibration: Volatile publisher and transient local subscription'
    vehicle.until(lambda: vehicle.health()[1] == f'not received: {refused}')
    vehicle.node.destroy_publisher(latched)
    vehicle.node.create_publisher(Twist, '/spacecraft/velocity', 10)
    refused = '/spacecraft/velocity: a publisher sends geometry_msgs/msg/Twist, not '
    refused += 'geometry_msgs/msg/TwistStamped'
    vehicle.until(lambda: vehicle.health()[1] == f'not received: {refused}')
