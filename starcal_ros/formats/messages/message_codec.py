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
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from starcal_ros.formats.messages.message_fields import (
    flat_array,
    Make,
    make_header,
    make_time,
    Message,
    quaternion_from_message,
    quaternion_to_message,
    stamp_ns,
)
from starcal_ros.record_fields import fields_of, FieldType, plain_record, read_record

T = TypeVar('T')

NOT_KNOWN = 2  # of a bool or None
_KNOWN = {0: False, 1: True, NOT_KNOWN: None}
_ENTRIES = {int: ('ReasonCount', 'reason', 'count'), str: ('KeyValue', 'key', 'value')}


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
        assert kind.dtype is not None  # of an array
        return flat_array(value, kind.dtype.type)
    if kind.kind is tuple:
        assert kind.item is not None  # of a tuple
        if kind.item.kind in (int, float):
            return flat_array(value, np.dtype(kind.item.kind).type)
        return [_field(kind.item, item, make) for item in value]
    if kind.kind is dict:
        assert kind.item is not None  # of a mapping
        name, key, of_value = _ENTRIES[kind.item.kind]
        return [make(f'starcal/msg/{name}', **{key: k, of_value: v}) for k, v in value.items()]
    if kind.kind is bool and kind.optional:
        return NOT_KNOWN if value is None else int(value)
    return kind.kind(value)


def plain_message(record_type: Any, message: Message) -> dict[str, Any]:
    """
    Plain values of the message of a record by the names of its fields; arrays have their shapes.

    Fields that a message of an older version lacks are omitted.

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
            values[field] = _shaped(np.asarray(getattr(message, field)), kind, field, sizes)
            sizes |= zip(kind.dimensions, values[field].shape, strict=True)
        else:
            values[field] = _value(kind, getattr(message, field))
            if kind.kind is tuple and kind.dimensions[0]:
                sizes[kind.dimensions[0]] = len(values[field])
    return values


def _value(kind: FieldType, found: Any) -> Any:
    if kind.is_record:
        if kind.optional and not len(found):
            return None
        return plain_message(kind.kind, found[0] if kind.optional else found)
    if kind.item is not None and kind.item.is_record:
        return [plain_message(kind.item.kind, item) for item in found]
    if kind.item is not None and kind.kind is dict:
        _, key, of_value = _ENTRIES[kind.item.kind]
        return {getattr(entry, key): getattr(entry, of_value) for entry in found}
    if kind.kind is bool and kind.optional:
        return _KNOWN.get(found, found)
    return found


def _shaped(
    flat: NDArray[Any], kind: FieldType, field: str, sizes: Mapping[int | str, int]
) -> NDArray[Any]:
    """A flat array of a message in its shape; unstated sizes follow from its length."""
    shape = [size if isinstance(size, int) else sizes.get(size, -1) for size in kind.dimensions]
    if shape.count(-1) == 1:
        known = math.prod(size for size in shape if size >= 0)
        shape[shape.index(-1)] = flat.size // known if known else 0
    elif -1 in shape:  # of the same name: a square
        shape = [math.isqrt(flat.size) if size == -1 else size for size in shape]
    if not flat.size and kind.low is not None and not kind.is_finite:
        return np.full(shape, math.nan, flat.dtype)  # left out: numbers that are not known
    if flat.size != math.prod(shape):
        raise ValueError(f'{field}: {flat.size} numbers, not {" x ".join(map(str, shape))}')
    return flat.reshape(shape)


def _is_word(dimension: int | str) -> bool:
    return isinstance(dimension, str) and len(dimension) > 1
