# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes, velocities and temperatures of the spacecraft, to messages and back."""

from __future__ import annotations

import math

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.messages.fields import (
    make_header,
    quaternion_from_message,
    quaternion_to_message,
    stamp_ns,
    vector_to_message,
)
from starcal_ros.messages.types import (
    ATTITUDE_TYPE,
    Make,
    Message,
    TEMPERATURE_TYPE,
    VELOCITY_TYPE,
)


def attitude_from_message(message: Message) -> tuple[int, Floats]:
    """
    Stamp and (4,) xyzw of an attitude, as on the wire and unchecked.

    Of a geometry_msgs/QuaternionStamped, PoseStamped or TransformStamped, or a sensor_msgs/Imu;
    NaN for an Imu that marks its orientation as not known (first covariance -1).
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
    """Stamp and (3,) m/s of a geometry_msgs/TwistStamped."""
    linear = message.twist.linear
    return stamp_ns(message.header.stamp), np.array([linear.x, linear.y, linear.z], np.float64)


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
    """Return a sensor_msgs/Temperature; its variance is 0, which stands for unknown in ROS."""
    return make(
        TEMPERATURE_TYPE,
        header=make_header(time_ns, frame_id, make),
        temperature=float(temperature_degc),
        variance=0.0,
    )
