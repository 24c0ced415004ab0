# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Names of the message types, and the parts that messages of several types share.

Readers accept any object with the fields of the message, from rclpy or from rosbags.  Writers take
``make``, which builds a message from its type and its fields; sequences of numbers are passed as
flat numpy arrays of the field's type.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.constants import MAX_STAMP_NS, NANOSECONDS_PER_SECOND

IMAGE_TYPE = 'sensor_msgs/msg/Image'
COMPRESSED_TYPE = 'sensor_msgs/msg/CompressedImage'
ATTITUDE_TYPE = 'geometry_msgs/msg/QuaternionStamped'
VELOCITY_TYPE = 'geometry_msgs/msg/TwistStamped'
TEMPERATURE_TYPE = 'sensor_msgs/msg/Temperature'
CAMERA_INFO_TYPE = 'sensor_msgs/msg/CameraInfo'
ALIGNMENT_TYPE = 'geometry_msgs/msg/TransformStamped'
POSE_TYPE = 'geometry_msgs/msg/PoseStamped'
IMU_TYPE = 'sensor_msgs/msg/Imu'
OBSERVATIONS_TYPE = 'starcal/msg/StarObservations'
CALIBRATION_TYPE = 'starcal/msg/Calibration'
STATUS_TYPE = 'starcal/msg/EnsembleStatus'

ATTITUDE_TYPES = (ATTITUDE_TYPE, POSE_TYPE, ALIGNMENT_TYPE, IMU_TYPE)
"""Types of message that may hold attitudes; the first is for nothing else."""

Message = Any  # a message class of rclpy or of rosbags: they share field names and nothing else


class Make(Protocol):
    """Builds a message of a type, ``'pkg/msg/Name'``, from its fields."""

    def __call__(self, type_name: str, /, **fields: object) -> Message:
        """Return the message."""


def stamp_ns(stamp: Message) -> int:
    """Nanoseconds of a builtin_interfaces/Time, exactly."""
    return int(stamp.sec) * NANOSECONDS_PER_SECOND + int(stamp.nanosec)


def nearest_stamp_ns(time_ns: int) -> int:
    """The nearest time that a ROS message can hold."""
    return min(max(time_ns, 0), MAX_STAMP_NS)


def offset_ns(seconds: float) -> int:
    """Whole nanoseconds of an offset in seconds."""
    return round(seconds * NANOSECONDS_PER_SECOND)


def make_header(time_ns: int, frame_id: str, make: Make) -> Message:
    """Return a std_msgs/Header of a time in nanoseconds."""
    return make('std_msgs/msg/Header', stamp=make_time(time_ns, make), frame_id=frame_id)


def make_time(time_ns: int, make: Make) -> Message:
    """Return a builtin_interfaces/Time of a time in nanoseconds."""
    sec, nanosec = divmod(time_ns, NANOSECONDS_PER_SECOND)
    return make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)


def quaternion_to_message(xyzw: Floats, make: Make) -> Message:
    """Return a geometry_msgs/Quaternion of (4,)."""
    x, y, z, w = (float(value) for value in xyzw)
    return make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w)


def quaternion_from_message(quaternion: Message) -> Floats:
    """Components (4,) of a geometry_msgs/Quaternion, x y z w, not validated."""
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)


def vector_to_message(xyz: Floats, make: Make) -> Message:
    """Return a geometry_msgs/Vector3 of (3,)."""
    x, y, z = (float(value) for value in xyz)
    return make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def flat_array(values: object, dtype: type[np.generic]) -> NDArray[Any]:
    """Numbers of any shape as a flat, contiguous array of the type of the field."""
    # Flat and contiguous: rclpy serialises a nested array as garbage without an error.
    return np.ascontiguousarray(values, dtype).reshape(-1)
