# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Messages to the plain values of `record_fields` and back, by the types of a record's fields.

The message of a record is ``starcal/msg/<its class>``; a field of the record is the field of that
name, or of the name given by `Named`, in these forms:

=====================================  ==============================================
record                                 message
=====================================  ==============================================
bool, int, float, str                  the same
int, name ends with ``_ns``            builtin_interfaces/Time, without that ending
``time_ns``                            ``header.stamp``
(4,) array, name ends with ``_xyzw``   geometry_msgs/Quaternion
bool or None                           uint8: 0 no, 1 yes, 2 unknown
tuple or array of numbers              sequence of their type, arrays row by row
size named in a `Shape` by a word      uint32 of that name
record                                 its message
record or None                         sequence of at most one
tuple of records                       sequence
mapping of counts                      sequence of starcal/ReasonCount
mapping of texts                       sequence of starcal/KeyValue
=====================================  ==============================================

Readers accept any object with the fields of the message, from rclpy or from rosbags.  Writers take
``make``, which builds a message from its type and its fields; sequences of numbers are passed as
flat numpy arrays of the field's type.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any, Protocol, TypeVar

import numpy as np

from starcal_ros.arrays import AnyArray, Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.record_fields import fields_of, FieldType, plain_record, read_record

IMAGE_TYPE = 'sensor_msgs/msg/Image'
COMPRESSED_TYPE = 'sensor_msgs/msg/CompressedImage'
IMAGE_TYPES = (IMAGE_TYPE, COMPRESSED_TYPE)
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
T = TypeVar('T')
NOT_KNOWN = 2  # stands for None in a field of bool or None
_KNOWN = {0: False, 1: True, NOT_KNOWN: None}
_ENTRIES = {int: ('ReasonCount', 'reason', 'count'), str: ('KeyValue', 'key', 'value')}


@dataclass(frozen=True)
class RawMessage:
    """A message as received or recorded; ``view`` is serialised CDR with its header."""

    topic: str
    type_name: str
    log_time_ns: int
    view: memoryview


class Make(Protocol):
    """Builds a message of a type, ``'pkg/msg/Name'``, from its fields."""

    def __call__(self, type_name: str, /, **fields: object) -> Message:
        """Return the message."""


def stamp_ns(stamp: Message) -> int:
    """Nanoseconds of a builtin_interfaces/Time, exactly."""
    return int(stamp.sec) * NANOSECONDS_PER_SECOND + int(stamp.nanosec)


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


def flat_array(values: object, dtype: type[np.generic]) -> AnyArray:
    """Numbers of any shape as a flat, contiguous array of the type of the field."""
    # Flat and contiguous: rclpy serialises a nested array as garbage without an error.
    return np.ascontiguousarray(values, dtype).reshape(-1)


def record_to_message(record: Any, make: Make) -> Message:
    """Return the message of a record."""
    return _made(type(record), plain_record(record), make)


def record_from_message(record_type: type[T], message: Message, path: str = '') -> T:
    """
    The record of a message; ``path`` is its path within an outer message.

    Raises ValueError in one line with the path of the field, its value and what is allowed.
    """
    return read_record(record_type, plain_message(record_type, message), path)


def message_fields(
    record_type: Any, values: Mapping[str, Any], make: Make, frame_id: str = ''
) -> dict[str, object]:
    """
    Fields of the message of a record.

    ``values`` come from `plain_record`; fields without a value are omitted.  ``frame_id`` is for
    the header.
    """
    fields: dict[str, object] = {}
    for name, kind in fields_of(record_type).items():
        if name not in values:
            continue
        value = values[name]
        if name == 'time_ns':
            fields['header'] = make_header(value, frame_id, make)
        elif kind.kind is int and name.endswith('_ns'):
            fields[kind.in_messages] = make_time(value, make)
        elif name.endswith('_xyzw'):
            fields[kind.in_messages] = quaternion_to_message(value, make)
        else:
            fields[kind.in_messages] = _field(kind, value, make)
            if kind.kind is np.ndarray:
                sizes = zip(kind.dimensions, value.shape, strict=True)
                fields |= {str(name): size for name, size in sizes if _is_word(name)}
    return fields


def _made(record_type: Any, values: Mapping[str, Any], make: Make) -> Message:
    type_name = f'starcal/msg/{record_type.__name__}'
    return make(type_name, **message_fields(record_type, values, make))


def _field(kind: FieldType, value: Any, make: Make) -> object:
    if kind.is_record:
        messages = [] if value is None else [_made(kind.kind, value, make)]
        return messages if kind.optional else messages[0]
    if kind.kind is np.ndarray:
        assert kind.dtype is not None  # arrays have one
        return flat_array(value, kind.dtype.type)
    if kind.kind is tuple:
        assert kind.item is not None  # tuples have one
        if kind.item.kind in (int, float):
            return flat_array(value, np.dtype(kind.item.kind).type)
        return [_field(kind.item, item, make) for item in value]
    if kind.kind is dict:
        assert kind.item is not None  # mappings have one
        name, key, of_value = _ENTRIES[kind.item.kind]
        return [make(f'starcal/msg/{name}', **{key: k, of_value: v}) for k, v in value.items()]
    if kind.kind is bool and kind.optional:
        return NOT_KNOWN if value is None else int(value)
    return kind.kind(value)


def plain_message(record_type: Any, message: Message) -> dict[str, Any]:
    """
    Plain values of the message of a record by the names of its fields; arrays have their shapes.

    Fields that the message does not have are omitted, and empty arrays that may be missing.

    Raises ValueError with the name of an array whose size contradicts other fields.
    """
    values: dict[str, Any] = {}
    sizes: dict[int | str, int] = {}
    for name, kind in fields_of(record_type).items():
        field = kind.in_messages
        if name == 'time_ns':
            values[field] = stamp_ns(message.header.stamp)
        elif not hasattr(message, field):
            continue
        elif kind.kind is int and name.endswith('_ns'):
            values[field] = stamp_ns(getattr(message, field))
        elif name.endswith('_xyzw'):
            values[field] = quaternion_from_message(getattr(message, field))
        elif kind.kind is np.ndarray:
            for word in filter(_is_word, kind.dimensions):
                sizes[word] = int(getattr(message, str(word)))
            flat = np.asarray(getattr(message, field))
            if kind.has_default and not flat.size:
                continue  # ROS has no other way to leave a sequence out
            values[field] = _shaped(flat, kind, field, sizes)
            sizes |= zip(kind.dimensions, values[field].shape, strict=True)
        else:
            values[field] = _value(kind, getattr(message, field))
            if kind.kind is tuple and kind.dimensions[0]:
                sizes[kind.dimensions[0]] = len(values[field])
    return values


def _value(kind: FieldType, value: Any) -> Any:
    if kind.is_record:
        if kind.optional and not len(value):
            return None
        return plain_message(kind.kind, value[0] if kind.optional else value)
    if kind.item is not None and kind.item.is_record:
        return [plain_message(kind.item.kind, item) for item in value]
    if kind.item is not None and kind.kind is dict:
        _, key, of_value = _ENTRIES[kind.item.kind]
        return {getattr(entry, key): getattr(entry, of_value) for entry in value}
    if kind.kind is bool and kind.optional:
        return _KNOWN.get(value, value)
    return value


def _shaped(
    flat: AnyArray, kind: FieldType, field: str, sizes: Mapping[int | str, int]
) -> AnyArray:
    """A flat array of a message in its shape; unstated sizes follow from its length."""
    shape = [size if isinstance(size, int) else sizes.get(size, -1) for size in kind.dimensions]
    if shape.count(-1) == 1:
        known = math.prod(size for size in shape if size >= 0)
        shape[shape.index(-1)] = flat.size // known if known else 0
    elif -1 in shape:  # both sides have the same name: a square
        shape = [math.isqrt(flat.size) if size == -1 else size for size in shape]
    if flat.size != math.prod(shape):
        raise ValueError(f'{field}: {flat.size} numbers, not {" x ".join(map(str, shape))}')
    return flat.reshape(shape)


def _is_word(dimension: int | str) -> bool:
    return isinstance(dimension, str) and len(dimension) > 1
