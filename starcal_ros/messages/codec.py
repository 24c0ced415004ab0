# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Records to messages and back, from the types of their fields and the marks on them (`arrays`).

The message of a record is ``starcal/msg/<its class>``; a field of the record is the field of that
name, in these forms:

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
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import check_shape, fields_of, FieldType
from starcal_ros.messages.fields import (
    flat_array,
    is_stamp,
    make_header,
    make_time,
    quaternion_from_message,
    quaternion_to_message,
    stamp_ns,
)
from starcal_ros.messages.types import Make, Message

T = TypeVar('T')

NOT_KNOWN = 2  # of a bool or None
_NUMBER_TYPES: Mapping[type, type[np.generic]] = {int: np.int64, float: np.float64}
_NO_NAMES: Mapping[str, str] = {}


def record_to_message(record: Any, make: Make, **others: object) -> Message:
    """Return the message of a record; ``others`` are fields that the record does not have."""
    type_name = f'starcal/msg/{type(record).__name__}'
    return make(type_name, **message_fields(record, make), **others)


def message_fields(
    record: Any,
    make: Make,
    frame_id: str = '',
    names: Mapping[str, str] = _NO_NAMES,
    leave_out: Collection[str] = (),
) -> dict[str, object]:
    """
    Fields of the message of a record.

    ``frame_id`` is that of its header; ``names`` maps fields of the record to fields of the
    message that have another name.
    """
    fields: dict[str, object] = {}
    record_type: Any = type(record)
    for name, kind in fields_of(record_type).items():
        if name in leave_out:
            continue
        value = getattr(record, name)
        if name == 'time_ns':
            fields['header'] = make_header(value, frame_id, make)
        elif _is_time(name, kind):
            fields[names.get(name, name.removesuffix('_ns'))] = make_time(value, make)
        elif name.endswith('_xyzw'):
            fields[names.get(name, name)] = quaternion_to_message(value, make)
        else:
            fields[names.get(name, name)] = _to_field(value, kind, make)
            fields |= _named_sizes(value, kind)
    return fields


def _is_time(name: str, kind: FieldType) -> bool:
    return kind.kind is int and name.endswith('_ns')


def _to_field(value: Any, kind: FieldType, make: Make) -> object:
    if kind.is_record:
        if not kind.optional:
            return record_to_message(value, make)
        return [] if value is None else [record_to_message(value, make)]
    if kind.kind is np.ndarray:
        assert kind.dtype is not None  # of an array
        return flat_array(value, kind.dtype.type)
    if kind.kind is tuple:
        assert kind.item is not None  # of a tuple
        if kind.item.kind in _NUMBER_TYPES:
            return flat_array(value, _NUMBER_TYPES[kind.item.kind])
        return [_to_field(item, kind.item, make) for item in value]
    if kind.item is not None:
        if kind.item.kind is int:
            type_name, key, of_value = 'starcal/msg/ReasonCount', 'reason', 'count'
        else:
            type_name, key, of_value = 'starcal/msg/KeyValue', 'key', 'value'
        return [make(type_name, **{key: k, of_value: v}) for k, v in value.items()]
    if kind.kind is bool and kind.optional:
        return NOT_KNOWN if value is None else int(value)
    return kind.kind(value)


def _named_sizes(value: Any, kind: FieldType) -> dict[str, object]:
    if kind.kind is not np.ndarray:
        return {}
    named = zip(kind.shape, value.shape, strict=True)
    return {str(name): size for name, size in named if _is_word(name)}


def _is_word(dimension: int | str) -> bool:
    return isinstance(dimension, str) and len(dimension) > 1


def record_from_message(record_type: type[T], message: Message) -> T:
    """
    The record of a message.

    Raises
    ------
    ValueError
        With the name of the field that does not fit the others or is not a number.
    """
    return record_type(**record_fields(record_type, message))


def record_fields(
    record_type: Any,
    message: Message,
    names: Mapping[str, str] = _NO_NAMES,
    leave_out: Collection[str] = (),
) -> dict[str, Any]:
    """
    Values of the fields of a record from its message, by name, some fields left out.

    A field that the message does not have, because an older version recorded it, is left to its
    default.

    Raises
    ------
    ValueError
        With the name of the field that does not fit the others or is not a number.
    """
    values: dict[str, Any] = {}
    sizes: dict[str, int] = {}
    for name, kind in fields_of(record_type).items():
        if name in leave_out:
            continue
        if name == 'time_ns':
            values[name] = _stamp_ns(message.header.stamp, 'header.stamp')
            continue
        is_time = _is_time(name, kind)
        field = names.get(name, name.removesuffix('_ns') if is_time else name)
        if not hasattr(message, field):
            if not kind.has_default:
                raise ValueError(f'{field}: not in the message')
            continue
        found = getattr(message, field)
        if is_time:
            values[name] = _stamp_ns(found, field)
        elif name.endswith('_xyzw'):
            values[name] = quaternion_from_message(found)
            _check_finite(values[name], kind, field)
        else:
            for dimension in filter(_is_word, kind.shape):
                sizes[str(dimension)] = int(getattr(message, str(dimension)))
            values[name] = _from_field(found, kind, field, sizes)
    return values


def _stamp_ns(stamp: Message, field: str) -> int:
    time_ns = stamp_ns(stamp)
    if not is_stamp(time_ns):
        raise ValueError(f'{field}: {time_ns} ns is not within the range of ROS stamps')
    return time_ns


def _from_field(found: Any, kind: FieldType, field: str, sizes: dict[str, int]) -> Any:
    if kind.is_record:
        if not kind.optional:
            return record_from_message(kind.kind, found)
        return record_from_message(kind.kind, found[0]) if len(found) else None
    if kind.kind is np.ndarray:
        return _array(found, kind, field, sizes)
    if kind.kind is tuple:
        assert kind.item is not None  # of a tuple
        item = kind.item
        items = tuple(_from_field(value, item, field, sizes) for value in found)
        check_shape((len(items),), kind.shape, field, sizes)
        return items
    if kind.item is not None:
        if kind.item.kind is int:
            return {str(entry.reason): int(entry.count) for entry in found}
        return {str(entry.key): str(entry.value) for entry in found}
    if kind.kind is bool and kind.optional:
        if found not in (0, 1, NOT_KNOWN):
            raise ValueError(f'{field}: {found} is none of 0, 1, {NOT_KNOWN}')
        return None if found == NOT_KNOWN else bool(found)
    value = kind.kind(found)
    _check_finite(value, kind, field)
    return value


def _array(found: Any, kind: FieldType, field: str, sizes: dict[str, int]) -> NDArray[Any]:
    flat = np.array(found, kind.dtype).reshape(-1)
    shape = [size if isinstance(size, int) else sizes.get(size, -1) for size in kind.shape]
    if shape.count(-1) == 1:
        known = math.prod(size for size in shape if size >= 0)
        shape[shape.index(-1)] = flat.size // known if known else 0
    elif -1 in shape:  # of the same name: a square
        side = math.isqrt(flat.size)
        shape = [side if size == -1 else size for size in shape]
    if flat.size != math.prod(shape):
        raise ValueError(f'{field}: {flat.size} numbers, not {" x ".join(map(str, shape))}')
    array = flat.reshape(shape)
    check_shape(array.shape, kind.shape, field, sizes)
    _check_finite(array, kind, field)
    return array


def _check_finite(value: Any, kind: FieldType, field: str) -> None:
    if kind.is_finite and not np.isfinite(value).all():
        raise ValueError(f'{field}: not finite')
