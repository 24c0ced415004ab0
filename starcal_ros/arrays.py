# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Array types, and marks for shape and range of the fields of records.

A mark stands in the type of the field, ``Annotated[Floats, Shape(('k', 'k'))]``.  The codecs of
files and messages read the fields of a record with their marks (`fields_of`), so a field is
described once.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import functools
import types
from typing import Annotated, Any, get_args, get_origin, get_type_hints, Union

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]  # (h, w) grey or (h, w, 3) BGR, for display
Pixels = NDArray[np.uint8] | NDArray[np.uint16]  # detector counts, indexed [v, u]


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
class AtLeast:
    """The smallest value allowed."""

    low: int


@dataclass(frozen=True)
class Finite:
    """Numbers that must be finite; without this mark, NaN stands for an unknown number."""


Count = Annotated[int, AtLeast(0)]


def to_digits(values: Floats, digits: int) -> Floats:
    """Return numbers rounded to so many significant digits: texts of them are as short."""
    rounded = [float(f'{value:.{digits - 1}e}') for value in values.ravel().tolist()]
    return np.array(rounded, np.float64).reshape(values.shape)


@dataclass(frozen=True)
class FieldType:
    """
    Type of a field of a record, or of the items of one.

    Attributes
    ----------
    kind : type
        bool, int, float or str, a record, or tuple, dict or numpy.ndarray.
    marks : tuple
        `Shape`, `AtLeast`, `Finite`.
    optional : bool
        Whether None is allowed.
    has_default : bool
    item : FieldType or None
        Of a tuple or a mapping from str.
    dtype : numpy.dtype or None
        Of an array.
    """

    kind: type[Any]
    marks: tuple[object, ...] = ()
    optional: bool = False
    has_default: bool = False
    item: FieldType | None = None
    dtype: np.dtype[Any] | None = None

    @property
    def is_record(self) -> bool:
        """True if the kind is a record."""
        return dataclasses.is_dataclass(self.kind)

    @property
    def shape(self) -> tuple[int | str, ...]:
        """Dimensions; one of any length where there is no mark."""
        found = [mark.dimensions for mark in self.marks if isinstance(mark, Shape)]
        return found[0] if found else ('',)

    @property
    def is_finite(self) -> bool:
        """True if numbers must be finite."""
        return any(isinstance(mark, Finite) for mark in self.marks)


@functools.cache
def fields_of(record_type: Any) -> dict[str, FieldType]:
    """Types of the fields of a record by name, in order."""
    hints = get_type_hints(record_type, include_extras=True)
    missing = dataclasses.MISSING
    return {
        field.name: dataclasses.replace(
            _field_type(hints[field.name]),
            has_default=field.default is not missing or field.default_factory is not missing,
        )
        for field in dataclasses.fields(record_type)
    }


def _field_type(hint: Any, outer: tuple[object, ...] = ()) -> FieldType:
    marks: tuple[object, ...] = ()
    if get_origin(hint) is Annotated:
        hint, *marks_found = get_args(hint)
        marks = tuple(marks_found)
    marks = (*marks, *outer)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        (inner,) = (argument for argument in arguments if argument is not type(None))
        return dataclasses.replace(_field_type(inner, marks), optional=True)
    if origin is None:
        return FieldType(hint, marks)
    if origin is np.ndarray:
        return FieldType(np.ndarray, marks, dtype=np.dtype(get_args(arguments[1])[0]))
    of_items = tuple(mark for mark in marks if not isinstance(mark, Shape))
    if origin is tuple:
        return FieldType(tuple, marks, item=_field_type(arguments[0], of_items))
    return FieldType(dict, marks, item=_field_type(arguments[1], of_items))  # a Mapping


def check_shape(
    found: tuple[int, ...], dimensions: tuple[int | str, ...], name: str, sizes: dict[str, int]
) -> None:
    """
    Compare a shape with its description; ``sizes`` of the named dimensions grow.

    Raises
    ------
    ValueError
        With the name of the field, when they differ.
    """
    expected = tuple(
        dimension
        if isinstance(dimension, int)
        else sizes.setdefault(dimension, size)
        if dimension
        else size
        for dimension, size in zip(dimensions, found, strict=True)
    )
    if found != expected:
        texts = (' x '.join(map(str, shape)) for shape in (found, expected))
        raise ValueError('{}: {} numbers, not {}'.format(name, *texts))
