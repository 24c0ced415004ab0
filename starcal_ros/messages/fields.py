# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Parts that messages of several types share: stamps, headers, quaternions and arrays.

Functions that read take any object with the fields of the message, received by rclpy or decoded by
rosbags.  Functions that build take ``make``, which returns a message of a type from its fields;
sequences of numbers are passed to it as flat numpy arrays of the type of the field.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.constants import MAX_STAMP_NS, NANOSECONDS_PER_SECOND
from starcal_ros.messages.types import Make, Message


def stamp_ns(stamp: Message) -> int:
    """Nanoseconds of a builtin_interfaces/Time, exactly."""
    return int(stamp.sec) * NANOSECONDS_PER_SECOND + int(stamp.nanosec)


def is_stamp(time_ns: int) -> bool:
    """Whether a ROS message can hold a time: no clock of ROS is before 1970."""
    return 0 <= time_ns <= MAX_STAMP_NS


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
    """(4,) xyzw of a geometry_msgs/Quaternion, as on the wire and unchecked."""
    return np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)


def vector_to_message(xyz: Floats, make: Make) -> Message:
    """Return a geometry_msgs/Vector3 of (3,)."""
    x, y, z = (float(value) for value in xyz)
    return make('geometry_msgs/msg/Vector3', x=x, y=y, z=z)


def flat_array(values: object, dtype: type[np.generic]) -> NDArray[Any]:
    """Numbers of any shape as a flat, contiguous array of the type of the field."""
    # Flat and contiguous: rclpy serialises a nested array as garbage without an error.
    return np.ascontiguousarray(values, dtype).reshape(-1)


def counts_of_reasons(reasons: Sequence[str], counts: Sequence[int]) -> Mapping[str, int]:
    """
    Mapping of reason to count, from a field of reasons and a field of counts.

    Raises
    ------
    ValueError
        When the fields are not of one length.
    """
    if len(reasons) != len(counts):
        raise ValueError(f'{len(reasons)} reasons but {len(counts)} counts')
    return {str(reason): int(count) for reason, count in zip(reasons, counts, strict=True)}
