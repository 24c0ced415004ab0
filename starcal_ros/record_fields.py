# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Marks that describe the fields of records, in the types of the fields.

A record is a frozen dataclass.  The types of its fields with their marks, such as
``Annotated[Floats, Finite(), Shape(('n', 2))]``, are its only description: `record_codec` reads
and writes records by them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import functools
import sys
import types
from typing import Annotated, Any, get_args, get_origin, get_type_hints, Union

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.constants import MAX_STAMP_NS

MOST = sys.float_info.max


@dataclass(frozen=True)
class Shape:
    """
    Shape of an array or length of a tuple; a number, or a name, for each dimension.

    A name is the same size in all fields of the record.  A name of one letter follows from the
    arrays themselves; a longer one (``map_rows``) is a field of its own in a message, where arrays
    are flat.
    """

    dimensions: tuple[int | str, ...]


@dataclass(frozen=True)
class Within:
    """Smallest and largest number allowed, neither infinite; NaN, an unknown number, is within."""

    low: float = -MOST
    high: float = MOST


@dataclass(frozen=True)
class Finite:
    """Numbers that must be known and finite."""

    is_finite: bool = True


@dataclass(frozen=True)
class Unit:
    """Vectors along the last axis whose length is 1 to a tolerance."""

    unit_tolerance: float


@dataclass(frozen=True)
class OneOf:
    """The texts allowed."""

    choices: tuple[str, ...]


@dataclass(frozen=True)
class Most:
    """Most characters of a text, and most items of a tuple or mapping."""

    most_characters: int | None = None
    most_items: int | None = None


@dataclass(frozen=True)
class Named:
    """
    Names of a field that differ from its own: in messages, and in files of version 0.1.

    In messages, the name of a time has no ``_ns``, and ``time_ns`` is that of the header.
    """

    in_messages: str = ''
    formerly: str = ''


Count = Annotated[int, Within(0)]
Stamp = Annotated[int, Within(0, MAX_STAMP_NS)]
"""Nanoseconds since 1970 that a ROS stamp can hold: until 2038."""
Quaternion = Annotated[Floats, Finite(), Shape((4,))]


@dataclass(frozen=True)
class FieldType:
    """
    Type of a field of a record, or of the items of one, with its marks.

    ``kind`` is bool, int, float or str, a record, or tuple, dict or numpy.ndarray; ``item`` is the
    type of the items of a tuple or of a mapping from str, ``dtype`` that of an array.
    ``optional`` allows None, ``are_different`` forbids an item twice, ``in_messages`` and
    ``formerly`` are other names of the field.  The other attributes are those of the marks;
    without a `Shape` there is one dimension of any length.
    """

    kind: type[Any]
    is_record: bool = False
    optional: bool = False
    has_default: bool = False
    item: FieldType | None = None
    dtype: np.dtype[Any] | None = None
    in_messages: str = ''
    formerly: str = ''
    dimensions: tuple[int | str, ...] = ('',)
    low: float | None = None
    high: float | None = None
    is_finite: bool = False
    unit_tolerance: float | None = None
    choices: tuple[str, ...] = ()
    most_characters: int | None = None
    most_items: int | None = None
    are_different: bool = False

    @property
    def allowed(self) -> str:
        """The range allowed, in words."""
        low, high = self.low, self.high
        if high == MOST:
            return f'at least {low}'
        return f'at most {high}' if low == -MOST else f'within {low} to {high}'


@functools.cache
def fields_of(record_type: Any) -> dict[str, FieldType]:
    """Types of the fields of a record by name, in order."""
    hints = get_type_hints(record_type, include_extras=True)
    missing = dataclasses.MISSING
    found = {}
    for field in dataclasses.fields(record_type):
        kind = _field_type(hints[field.name])
        name = field.name.removesuffix('_ns') if kind.kind is int else field.name
        found[field.name] = dataclasses.replace(
            kind,
            has_default=field.default is not missing or field.default_factory is not missing,
            in_messages=kind.in_messages or {'time_ns': 'header.stamp'}.get(field.name, name),
            formerly=kind.formerly or field.name,
        )
    return found


def _field_type(hint: Any, marks: tuple[object, ...] = ()) -> FieldType:
    if get_origin(hint) is Annotated:
        hint, *inner = get_args(hint)
        marks = (*inner, *marks)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        (hint,) = (argument for argument in arguments if argument is not type(None))
        return dataclasses.replace(_field_type(hint, marks), optional=True)
    limits: dict[str, Any] = {}
    for mark in marks:
        limits |= vars(mark)
    if origin is None:
        return FieldType(hint, dataclasses.is_dataclass(hint), **limits)
    if origin is np.ndarray:
        return FieldType(np.ndarray, dtype=np.dtype(get_args(arguments[1])[0]), **limits)
    of_items = tuple(mark for mark in marks if not isinstance(mark, (Shape, Named)))
    if origin is tuple:
        return FieldType(tuple, item=_field_type(arguments[0], of_items), **limits)
    return FieldType(dict, item=_field_type(arguments[1], of_items), **limits)  # a Mapping
