# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Records to JSON and back, from the types of their fields and the marks on them (`arrays`).

Writing: a number that is not finite is null, which is all that JSON has for it; arrays and tuples
are lists; a nested record is an object with a key for each field.  Reading is strict: a value of
another type, a missing key, a wrong shape and a number out of range are errors that name the key.
A key may be missing only where its field has a default; keys without a field are ignored.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
import dataclasses
import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import AtLeast, check_shape, fields_of, FieldType
from starcal_ros.untrusted import shown

T = TypeVar('T')

_INT64 = 2**63


def to_json(record: Any) -> dict[str, Any]:
    """The JSON object of a record: a frozen dataclass."""
    return {
        field.name: _written(getattr(record, field.name)) for field in dataclasses.fields(record)
    }


def from_json(record_type: type[T], content: object, key: str = '') -> T:
    """
    The record of a JSON object; ``key`` is the place of the object in its file.

    Raises
    ------
    ValueError
        In one line with the key and the expected form.
    """
    values = fields_from_json(record_type, content, key)
    try:
        return record_type(**values)
    except ValueError as error:  # the record's own checks
        prefix = f'{key}.' if key else ''
        raise ValueError(prefix + ' '.join(str(error).split())) from error


def fields_from_json(
    record_type: Any, content: object, key: str = '', leave_out: Collection[str] = ()
) -> dict[str, Any]:
    """
    Values of the fields of a record from a JSON object, by name, some fields left out.

    Raises
    ------
    ValueError
        In one line with the key and the expected form.
    """
    if not isinstance(content, dict):
        raise _error(key, content, 'an object')
    prefix = f'{key}.' if key else ''
    values: dict[str, Any] = {}
    sizes: dict[str, int] = {}
    for name, kind in fields_of(record_type).items():
        if name in leave_out or (kind.has_default and name not in content):
            continue
        if name not in content:
            raise ValueError(f'key {prefix + name!r} is missing')
        values[name] = _read(kind, content[name], prefix + name, sizes)
    return values


def _written(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_json(value)
    if isinstance(value, Mapping):
        return {str(name): _written(item) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        finite = value.dtype.kind != 'f' or np.isfinite(value).all()
        return value.tolist() if finite else _written(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_written(item) for item in value]
    if isinstance(value, np.generic):
        return _written(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def _read(kind: FieldType, value: object, key: str, sizes: dict[str, int]) -> Any:
    """A value of a type; ``sizes`` are those of the named dimensions of its record."""
    if value is None and kind.optional:
        return None
    if kind.is_record:
        return from_json(kind.kind, value, key)
    if kind.kind is tuple:
        return _tuple(kind, value, key, sizes)
    if kind.kind is np.ndarray:
        return _array(kind, value, key, sizes)
    if kind.item is not None:
        if not isinstance(value, dict):
            raise _error(key, value, 'an object')
        item = kind.item
        return {name: _read(item, found, f'{key}.{name}', sizes) for name, found in value.items()}
    return _scalar(kind.kind, kind, value, key)


def _scalar(wanted: type[Any], kind: FieldType, value: object, key: str) -> Any:
    if wanted is float:
        return _number(value, key, null=not kind.is_finite)
    if wanted is int:
        low = max((mark.low for mark in kind.marks if isinstance(mark, AtLeast)), default=-_INT64)
        if isinstance(value, bool) or not isinstance(value, int):
            raise _error(key, value, 'a whole number')
        if not low <= value < _INT64:
            raise _error(key, value, f'in the range {low} to {_INT64 - 1}')
        return value
    if not isinstance(value, wanted):
        raise _error(key, value, {bool: 'true or false', str: 'a text'}[wanted])
    return value


def _number(value: object, key: str, null: bool) -> float:
    if value is None and null:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _error(key, value, 'a number')
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise _error(key, value, 'a finite number')
    return number


def _are_numbers(value: object) -> bool:
    """Whether a value is a list of finite numbers: tested at once, as grids have thousands."""
    if not isinstance(value, list) or not set(map(type, value)) <= {float, int}:
        return False
    try:
        return all(map(math.isfinite, value))
    except OverflowError:  # an integer that no float holds
        return False


def _items(value: object, key: str) -> list[Any]:
    if not isinstance(value, list):
        raise _error(key, value, 'a list')
    return value


def _tuple(kind: FieldType, value: object, key: str, sizes: dict[str, int]) -> tuple[Any, ...]:
    assert kind.item is not None  # of a tuple
    found = _items(value, key)
    items = tuple(_read(kind.item, item, f'{key}[{k}]', sizes) for k, item in enumerate(found))
    check_shape((len(items),), kind.shape, key, sizes)
    return items


def _array(kind: FieldType, value: object, key: str, sizes: dict[str, int]) -> NDArray[Any]:
    assert kind.dtype is not None  # of an array
    wanted = float if kind.dtype.kind == 'f' else int

    def rows(value: object, key: str, depth: int) -> Any:
        if depth == 0:
            return _scalar(wanted, kind, value, key)
        if depth == 1 and wanted is float and _are_numbers(value):
            return value
        found = [rows(item, f'{key}[{k}]', depth - 1) for k, item in enumerate(_items(value, key))]
        if depth > 1 and len({len(row) for row in found}) > 1:
            raise ValueError(f'{key}: rows of different length')
        return found

    found = rows(value, key, len(kind.shape))
    array = np.array(found, np.float64 if wanted is float else np.int64)
    if kind.dtype.kind != 'f' and array.size:
        low, high = np.iinfo(kind.dtype).min, np.iinfo(kind.dtype).max
        if array.min() < low or array.max() > high:
            raise ValueError(f'{key}: a number is out of the range of {kind.dtype}')
    array = array.astype(kind.dtype)
    if array.ndim < len(kind.shape):  # no rows: their length is not in the file
        array = array.reshape(0, *(d if isinstance(d, int) else 0 for d in kind.shape[1:]))
    check_shape(array.shape, kind.shape, key, sizes)
    return array


def _error(key: str, value: object, expected: str) -> ValueError:
    return ValueError(f'{key or "content"}: {shown(value)} is not {expected}')
