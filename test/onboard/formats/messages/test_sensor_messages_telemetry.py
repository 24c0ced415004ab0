# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Messages of attitude, velocity and temperature: round trips; their stamps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from sample_records import plain, TIME_NS  # type: ignore[import-not-found]

from starcal_ground.bag_writer import temperature_to_message, velocity_to_message
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.message_codec import (
    ALIGNMENT_TYPE,
    ATTITUDE_TYPE,
    ATTITUDE_TYPES,
    IMU_TYPE,
    make_header,
    POSE_TYPE,
    quaternion_to_message,
    stamp_ns,
    vector_to_message,
)
from starcal_ros.formats.messages.sensor_messages import (
    attitude_from_message,
    latest_at,
    temperature_from_message,
    velocity_from_message,
)


@pytest.mark.parametrize('time_ns', [0, 1, 999_999_999, TIME_NS, -1])
def test_stamps_are_exact(time_ns: int) -> None:
    """A stamp keeps every nanosecond, before 1970 too."""
    header = make_header(time_ns, '', plain)
    assert 0 <= header.stamp.nanosec < 10**9
    assert stamp_ns(header.stamp) == time_ns


def test_velocity_round_trip() -> None:
    """Components come back in their own places."""
    message = velocity_to_message(6, np.array([1.0, -2.0, 3e4]), 'icrf', plain)
    time_ns, velocity = velocity_from_message(message)
    assert time_ns == 6
    np.testing.assert_array_equal(velocity, [1.0, -2.0, 3e4])


BAD_SPEEDS_M_S = (np.nan, np.inf, -np.inf, 3e8, -3.1e5, 1e300)


@pytest.mark.parametrize('axis', range(3))
@pytest.mark.parametrize('speed_m_s', BAD_SPEEDS_M_S)
def test_a_velocity_of_no_spacecraft_is_refused(axis: int, speed_m_s: float) -> None:
    velocity = np.zeros(3)
    velocity[axis] = speed_m_s
    with pytest.raises(ValueError, match='is faster than any spacecraft: left out'):
        velocity_from_message(velocity_to_message(6, velocity, 'icrf', plain))


def test_temperature_round_trip() -> None:
    message = temperature_to_message(7, -12.5, 'camera', make_message)
    assert temperature_from_message(message) == (7, -12.5)
    # What a sensor says that has failed is not known: it would have each image refused.
    for failed_degc in (np.inf, np.nan, -999.0):
        message = temperature_to_message(7, failed_degc, 'camera', make_message)
        assert np.isnan(temperature_from_message(message)[1])


@pytest.mark.parametrize('kind', ATTITUDE_TYPES)
def test_attitudes_of_each_type_are_read(kind: str) -> None:
    message = attitude_message(kind)
    time_ns, xyzw = attitude_from_message(message)
    assert time_ns == 5
    np.testing.assert_array_equal(xyzw, XYZW)
    if kind == IMU_TYPE:
        message.orientation_covariance[0] = -1.0  # sensor_msgs/Imu: orientation not known
        assert np.isnan(attitude_from_message(message)[1]).all()


XYZW = np.array([0.1, 0.7, -0.1, 0.7])


def attitude_message(kind: str) -> Any:
    """A message of a type with the attitude `XYZW` at 5 ns."""
    rotation = quaternion_to_message(XYZW, make_message)
    zero = vector_to_message(np.zeros(3), make_message)
    fields: dict[str, Any] = {'header': make_header(5, 'icrf', make_message)}
    if kind == ATTITUDE_TYPE:
        fields['quaternion'] = rotation
    elif kind == POSE_TYPE:
        point = make_message('geometry_msgs/msg/Point', x=1.0, y=2.0, z=3.0)
        pose = make_message('geometry_msgs/msg/Pose', position=point, orientation=rotation)
        fields['pose'] = pose
    elif kind == ALIGNMENT_TYPE:
        transform = make_message(
            'geometry_msgs/msg/Transform', translation=zero, rotation=rotation
        )
        fields |= {'child_frame_id': 'st', 'transform': transform}
    else:
        fields |= {
            'orientation': rotation,
            'orientation_covariance': np.zeros(9),
            'angular_velocity': zero,
            'angular_velocity_covariance': np.zeros(9),
            'linear_acceleration': zero,
            'linear_acceleration_covariance': np.zeros(9),
        }
    return make_message(kind, **fields)


def test_the_last_sample_at_or_before_an_image_counts() -> None:
    samples = [(10, 'a'), (20, 'b'), (30, 'c')]
    for time_ns, sample in ((5, 'a'), (10, 'a'), (29, 'b'), (30, 'c'), (99, 'c')):
        assert latest_at(samples, time_ns, 'none') == sample
    assert latest_at([], 5, 'none') == 'none'
