# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes, velocities and temperatures of the spacecraft, to messages and back."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
import math
import operator
from typing import TypeVar

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.formats.messages.message_fields import (
    ATTITUDE_TYPE,
    Make,
    make_header,
    Message,
    quaternion_from_message,
    quaternion_to_message,
    stamp_ns,
    TEMPERATURE_TYPE,
    vector_to_message,
    VELOCITY_TYPE,
)

T = TypeVar('T')
_STAMP_NS = operator.itemgetter(0)
# The Earth moves at 3e4 m/s; a value beyond this limit would displace all stars.
_MAX_VELOCITY_M_S = 1e6


def attitude_from_message(message: Message) -> tuple[int, Floats]:
    """
    Stamp and (4,) xyzw of an attitude, as on the wire and unchecked.

    The message is a geometry_msgs/QuaternionStamped, PoseStamped or TransformStamped, or a
    sensor_msgs/Imu; NaN for an Imu that marks its orientation as not known (first covariance -1).
    """
    if hasattr(message, 'quaternion'):
        quaternion = message.quaternion
    elif hasattr(message, 'pose'):
        quaternion = message.pose.orientation
    elif hasattr(message, 'transform'):
        quaternion = message.transform.rotation
    else:
        quaternion = message.orientation
        if message.orientation_covariance[0] == -1.0:
            return stamp_ns(message.header.stamp), np.full(4, math.nan)
    return stamp_ns(message.header.stamp), quaternion_from_message(quaternion)


def attitude_to_message(
    time_ns: int, quaternion_xyzw: Floats, frame_id: str, make: Make
) -> Message:
    """Return a geometry_msgs/QuaternionStamped; ``frame_id`` is the inertial frame."""
    return make(
        ATTITUDE_TYPE,
        header=make_header(time_ns, frame_id, make),
        quaternion=quaternion_to_message(quaternion_xyzw, make),
    )


def velocity_from_message(message: Message) -> tuple[int, Floats]:
    """
    Stamp and (3,) m/s of a geometry_msgs/TwistStamped.

    Raises ValueError for a velocity that no spacecraft has; it is to be left out and counted.
    """
    linear = message.twist.linear
    velocity_m_s = np.array([linear.x, linear.y, linear.z], np.float64)
    if not float(np.abs(velocity_m_s).max()) < _MAX_VELOCITY_M_S:
        raise ValueError(
            f'velocity {velocity_m_s.tolist()} m/s is not plausible for a spacecraft: left out'
        )
    return stamp_ns(message.header.stamp), velocity_m_s


def velocity_to_message(time_ns: int, velocity_m_s: Floats, frame_id: str, make: Make) -> Message:
    """Return a geometry_msgs/TwistStamped without rotation."""
    return make(
        VELOCITY_TYPE,
        header=make_header(time_ns, frame_id, make),
        twist=make(
            'geometry_msgs/msg/Twist',
            linear=vector_to_message(velocity_m_s, make),
            angular=vector_to_message(np.zeros(3), make),
        ),
    )


def temperature_from_message(message: Message) -> tuple[int, float]:
    """Stamp and degrees Celsius of a sensor_msgs/Temperature; NaN where it is not finite."""
    temperature_degc = float(message.temperature)
    known = math.isfinite(temperature_degc)
    return stamp_ns(message.header.stamp), temperature_degc if known else math.nan


def temperature_to_message(
    time_ns: int, temperature_degc: float, frame_id: str, make: Make
) -> Message:
    """Return a sensor_msgs/Temperature; its variance is 0, which means unknown in ROS."""
    return make(
        TEMPERATURE_TYPE,
        header=make_header(time_ns, frame_id, make),
        temperature=float(temperature_degc),
        variance=0.0,
    )


def latest_at(samples: Sequence[tuple[int, T]], time_ns: int, without: T) -> T:
    """
    Last sample at or before a time, else the first after it; ``without`` if there are none.

    ``samples`` are in the order of their stamps.  Within a minute, the velocity of a spacecraft
    changes by under 10 m/s (0.007 arcsec), and the temperature of a camera by less than the
    resolution of its sensor.
    """
    if not samples:
        return without
    return samples[max(0, bisect.bisect_right(samples, time_ns, key=_STAMP_NS) - 1)][1]
