# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The marks that describe the fields of records; the one reader and the one writer of records.

A record is a frozen dataclass.  The types of its fields with their marks, such as
``Annotated[Floats, Finite(), Shape(('n', 2))]``, are its only description.

`read_record` makes a record of plain values, which JSON, YAML, ROS parameters and messages have in
common: None, bool, int, float, str, lists or arrays of numbers, and mappings with texts as keys.
`plain_record` is its inverse.

Reading is strict.  A value of another type or out of range, a wrong shape and a missing key are
errors of one line with the path of the field, the value and what is allowed.  A key may be missing
where its field has a default, the value for not known; of an array that may hold NaN it is NaN in
the shape of the others.  Keys without a field are ignored.  None in place of a number is NaN, an
unknown number, unless the field is marked `Finite`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import dataclasses
import difflib
import functools
import math
import sys
import textwrap
import types
from typing import Annotated, Any, get_args, get_origin, get_type_hints, TypeVar, Union

import numpy as np

from starcal_ros.arrays import AnyArray, Floats, Mask
from starcal_ros.constants import MAX_STAMP_NS
from starcal_ros.untrusted import check_text, shown

MOST = sys.float_info.max


@dataclasses.dataclass(frozen=True)
class Shape:
    """
    Shape of an array or length of a tuple; a number, or a name, for each dimension.

    A name is the same size in all fields of the record.  A name of one letter follows from the
    arrays themselves; a longer one (``map_rows``) is a field of its own in a message, where arrays
    are flat.
    """

    dimensions: tuple[int | str, ...]


@dataclasses.dataclass(frozen=True)
class Within:
    """Smallest and largest number allowed, neither infinite; NaN, an unknown number, is within."""

    low: float = -MOST
    high: float = MOST


@dataclasses.dataclass(frozen=True)
class Finite:
    """Numbers that must be known and finite."""

    is_finite: bool = True


@dataclasses.dataclass(frozen=True)
class Unit:
    """Vectors along the last axis whose length is 1 to a tolerance."""

    unit_tolerance: float


@dataclasses.dataclass(frozen=True)
class OneOf:
    """The texts allowed."""

    choices: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Most:
    """Most characters of a text, and most items of a tuple or mapping."""

    most_characters: int | None = None
    most_items: int | None = None


@dataclasses.dataclass(frozen=True)
class Named:
    """
    Name of a field in messages, where it differs from its own.

    The name of a time has no ``_ns`` there, and ``time_ns`` is that of the header.
    """

    in_messages: str


Count = Annotated[int, Within(0, 2**32 - 1)]
"""A number of things, as messages hold it."""
Stamp = Annotated[int, Within(0, MAX_STAMP_NS)]
"""Nanoseconds since 1970 that a ROS stamp can hold: until 2038."""
Quaternion = Annotated[Floats, Finite(), Shape((4,))]


@dataclasses.dataclass(frozen=True)
class FieldType:
    """
    Type of a field of a record, or of the items of one, with its marks.

    ``kind`` is bool, int, float or str, a record, or tuple, dict or numpy.ndarray; ``item`` is the
    type of the items of a tuple or of a mapping from str, ``dtype`` that of an array.
    ``optional`` allows None, ``are_different`` forbids an item twice.  The other attributes are
    those of the marks; without a `Shape` there is one dimension of any length.
    """

    kind: type[Any]
    is_record: bool = False
    optional: bool = False
    has_default: bool = False
    item: FieldType | None = None
    dtype: np.dtype[Any] | None = None
    in_messages: str = ''
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
    def may_be_unknown(self) -> bool:
        """True if NaN, an unknown number, is within the range allowed."""
        return self.low is not None and not self.is_finite

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
    kinds = {}
    for field in dataclasses.fields(record_type):
        kind = _field_type(hints[field.name])
        name = field.name.removesuffix('_ns') if kind.kind is int else field.name
        kinds[field.name] = dataclasses.replace(
            kind,
            has_default=field.default is not missing or field.default_factory is not missing,
            in_messages=kind.in_messages or {'time_ns': 'header.stamp'}.get(field.name, name),
        )
    return kinds


def _field_type(hint: Any, marks: tuple[object, ...] = ()) -> FieldType:
    if get_origin(hint) is Annotated:
        hint, *inner = get_args(hint)
        marks = (*inner, *marks)
    origin, arguments = get_origin(hint), get_args(hint)
    if hasattr(origin, '__value__'):  # NDArray is a type alias of PEP 695 since NumPy 2.5
        hint = origin.__value__[arguments]
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


_LINES, _WIDTH = 3, 96  # lines and columns in which a record is shown


class Record:
    """
    Base of records with arrays: compared by their numbers, and shown in three lines.

    Two are equal if they are of one type and all their fields are, arrays by shape and numbers;
    unknown numbers (NaN) are equal.
    """

    def __eq__(self, other: object) -> bool:
        """Compare all fields."""
        if type(self) is not type(other):
            return NotImplemented
        names = (field.name for field in dataclasses.fields(self))  # type: ignore[arg-type]
        return all(_is_equal(getattr(self, name), getattr(other, name)) for name in names)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        """Return name and fields in three lines."""
        names = (field.name for field in dataclasses.fields(self))  # type: ignore[arg-type]
        words = ', '.join(f'{name}={_in_short(getattr(self, name))}' for name in names)
        text = f'{type(self).__name__}({words})'
        indent, end = {'subsequent_indent': '  '}, {'max_lines': _LINES, 'placeholder': ' ...)'}
        return '\n'.join(textwrap.wrap(text, _WIDTH, **indent, **end))  # type: ignore[arg-type]


def _is_equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=np.asarray(a).dtype.kind in 'fc')
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_is_equal(a[key], b[key]) for key in a)
    if isinstance(a, (tuple, list)) and isinstance(b, (tuple, list)):
        return len(a) == len(b) and all(map(_is_equal, a, b))
    return bool(a == b) or (a != a and b != b)  # NaN alone differs from itself


def _in_short(value: Any) -> str:
    if isinstance(value, np.ndarray) and value.size > 4:
        return f'<{" x ".join(map(str, value.shape))} {value.dtype}>'
    if isinstance(value, (tuple, list, Mapping)) and len(str(value)) > 60:
        return f'<{len(value)} items>'
    text = repr(value)
    return text if len(text) <= 60 and '\n' not in text else f'{type(value).__name__}(...)'


T = TypeVar('T')

_PLAIN = {bool, int, float, str, np.ndarray, type(None)}
_INT64 = 2**63
_KINDS = {'f': 'fiu', 'i': 'iu', 'u': 'iu', 'b': 'b'}  # kinds of arrays that each is made of
_COMPARED = 100  # characters: of a word of a million, each comparison takes seconds


def plain_record(record: Any) -> dict[str, Any]:
    """Plain values of a record by field; arrays stay arrays, nested records are mappings."""
    return {f.name: _plain(getattr(record, f.name)) for f in dataclasses.fields(record)}


def _plain(value: Any) -> Any:
    if type(value) in _PLAIN:
        return value
    if dataclasses.is_dataclass(value):
        return plain_record(value)
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


def json_object(record: Any) -> dict[str, Any]:
    """
    Plain values of a record or mapping for JSON.

    Arrays are lists, a number that is not finite is null.
    """
    plain: dict[str, Any] = _json_value(_plain(record))
    return plain


def _json_value(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _json_value(item) for name, item in value.items()}
    if isinstance(value, np.ndarray):
        finite = value.dtype.kind != 'f' or np.isfinite(value).all()
        return value.tolist() if finite else _json_value(value.tolist())
    if isinstance(value, list):
        return [_json_value(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_record(record_type: type[T], content: object, path: str = '') -> T:
    """
    The record of a mapping of plain values; ``path`` is the place of the mapping in its source.

    A nested record may be one already.  Raises ValueError in one line with the path of a field,
    its value and what is allowed.
    """
    if isinstance(content, record_type):
        return content
    if not isinstance(content, dict):
        raise _refused(path, content, 'an object')
    values: dict[str, Any] = {}
    sizes: dict[str, int] = {}
    left_out: list[str] = []
    of_type: Any = record_type
    for name, kind in fields_of(of_type).items():
        names = (name, kind.in_messages)
        key = next((key for key in names if key in content), None)
        if key is not None:
            values[name] = read_value(kind, content[key], _inside(path, key), sizes)
        elif not kind.has_default:
            known = ' or '.join(repr(_inside(path, key)) for key in dict.fromkeys(names))
            raise ValueError(f'key {known} is missing')
        elif kind.kind is np.ndarray and kind.may_be_unknown:
            left_out.append(name)
    for name in left_out:  # a column has as many rows as those that are there
        kind = fields_of(of_type)[name]
        shape = [sizes.get(side, 0) if isinstance(side, str) else side for side in kind.dimensions]
        values[name] = np.full(shape, math.nan, kind.dtype)
    try:
        return record_type(**values)
    except ValueError as error:  # the record's own checks
        raise ValueError(_inside(path, ' '.join(str(error).split()))) from error


def read_value(kind: FieldType, value: object, path: str, sizes: dict[str, int]) -> Any:
    """
    A value of a type; ``sizes`` are those of the named dimensions of its record, and grow.

    Raises ValueError in one line with the path of the field, its value and what is allowed.
    """
    if value is None and kind.optional:
        return None
    if kind.is_record:
        return read_record(kind.kind, value, path)
    if kind.kind is np.ndarray:
        return _array(kind, value, path, sizes)
    if kind.kind is tuple:
        return _tuple(kind, value, path, sizes)
    if kind.kind is dict:
        return _mapping(kind, value, path, sizes)
    if kind.kind is str:
        return _text(kind, value, path)
    if kind.kind is bool:
        if not isinstance(value, bool):
            raise _refused(path, value, 'true or false')
        return value
    return _number(kind, value, path)


def check_shape(
    shape: tuple[int, ...], dimensions: tuple[int | str, ...], path: str, sizes: dict[str, int]
) -> None:
    """Check a shape; ``sizes`` of named dimensions grow.  Raises ValueError with the path."""
    expected = tuple(
        side if isinstance(side, int) else sizes.setdefault(side, size) if side else size
        for side, size in zip(dimensions, shape, strict=False)
    )
    if shape != expected or len(shape) != len(dimensions):
        wanted = expected if len(shape) == len(dimensions) else dimensions
        numbers, allowed = (' x '.join(map(str, sides)) or '1' for sides in (shape, wanted))
        raise ValueError(f'{path}: {numbers} numbers, not {allowed}')


def nearest(word: str, known: Iterable[str]) -> str:
    """Suggestion for an unknown word, to append to an error message; '' without a close match."""
    near = difflib.get_close_matches(word[:_COMPARED], known, 1)
    return f' (did you mean {near[0]}?)' if near else ''


def _inside(path: str, name: str) -> str:
    return f'{path}.{name}' if path else name


def _refused(path: str, value: object, allowed: str) -> ValueError:
    return ValueError(f'{path or "content"}: {shown(value)} is not {allowed}')


def _text(kind: FieldType, value: object, path: str) -> str:
    if not isinstance(value, str):
        raise _refused(path, value, 'a text')
    if kind.most_characters is not None and len(value) > kind.most_characters:
        raise _refused(path, value, f'a text of at most {kind.most_characters} characters')
    if kind.choices and value not in kind.choices:
        words = ', '.join(filter(None, kind.choices))
        raise _refused(path, value, f'one of {words}{nearest(value, kind.choices)}')
    try:
        return check_text(value)
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error


def _number(kind: FieldType, value: object, path: str) -> float:
    if value is None and kind.kind is float and not kind.is_finite:
        return math.nan
    number = value.item() if isinstance(value, np.generic) else value
    is_whole = kind.kind is int
    is_part = is_whole and isinstance(number, float) and not number.is_integer()
    if isinstance(number, bool) or not isinstance(number, (int, float)) or is_part:
        raise _refused(path, value, 'a whole number' if is_whole else 'a number')
    if is_whole:
        number = int(number)
        if not -_INT64 <= number < _INT64:
            raise _refused(path, value, 'within 64 bit')
    else:
        try:
            number = float(number)
        except OverflowError as error:
            raise _refused(path, value, 'a finite number') from error
    low, high = kind.low, kind.high
    if (kind.is_finite and not math.isfinite(number)) or (low is not None and math.isinf(number)):
        raise _refused(path, value, 'a finite number')
    if low is not None and high is not None and (number < low or number > high):
        raise _refused(path, value, kind.allowed)
    return number


def _tuple(kind: FieldType, value: object, path: str, sizes: dict[str, int]) -> tuple[Any, ...]:
    assert kind.item is not None  # tuples have one
    items = value.tolist() if hasattr(value, 'tolist') else value  # NumPy and array.array
    if not isinstance(items, (list, tuple)):
        is_number = isinstance(value, (int, float))
        raise _refused(path, value, f'a list, such as [{value}]' if is_number else 'a list')
    _check_count(kind, len(items), path)
    check_shape((len(items),), kind.dimensions, path, sizes)
    item = kind.item
    values = tuple(read_value(item, items[k], f'{path}[{k}]', {}) for k in range(len(items)))
    if kind.are_different and len(set(values)) < len(values):
        twice = next(item for item in values if values.count(item) > 1)
        raise ValueError(f'{path}: {twice} is given twice')
    return values


def _mapping(kind: FieldType, value: object, path: str, sizes: dict[str, int]) -> dict[str, Any]:
    assert kind.item is not None  # mappings have one
    if not isinstance(value, Mapping):
        raise _refused(path, value, 'an object')
    _check_count(kind, len(value), path)
    return {
        _text(kind, name, path): read_value(kind.item, item, f'{path}.{name[:_COMPARED]}', sizes)
        for name, item in value.items()
    }


def _check_count(kind: FieldType, count: int, path: str) -> None:
    if kind.most_items is not None and count > kind.most_items:
        raise ValueError(f'{path}: {count} values, at most {kind.most_items} are read')


def _array(kind: FieldType, value: object, path: str, sizes: dict[str, int]) -> AnyArray:
    assert kind.dtype is not None  # arrays have one
    wanted, depth = kind.dtype, len(kind.dimensions)
    if isinstance(value, np.ndarray):
        array = value
    else:
        item = FieldType(float if wanted.kind == 'f' else int, is_finite=kind.is_finite)
        rows = _rows(item, value, path, depth)
        try:
            array = np.array(rows, np.float64 if wanted.kind == 'f' else np.int64)
        except OverflowError as error:
            raise ValueError(f'{path}: a number is out of the range of {wanted}') from error
        if array.ndim < depth:  # no rows: their length is not in the source
            array = array.reshape(
                0, *(d if isinstance(d, int) else 0 for d in kind.dimensions[1:])
            )
    if wanted.kind in 'iu' and array.size and array.dtype != wanted:
        least, most = np.iinfo(wanted).min, np.iinfo(wanted).max
        if array.min() < least or array.max() > most:
            raise ValueError(f'{path}: a number is out of the range of {wanted}')
    check_shape(array.shape, kind.dimensions, path, sizes)
    if array.dtype.kind not in _KINDS[wanted.kind]:
        raise _refused(path, array, f'an array of {wanted}')
    array = array.astype(wanted)  # a copy: the source may change
    _check_numbers(kind, array, path)
    return array


def _rows(item: FieldType, value: object, path: str, depth: int) -> Any:
    """Lists of numbers, each checked for its type; None is NaN."""
    if depth == 0:
        return _number(item, value, path)
    if not isinstance(value, list):
        raise _refused(path, value, 'a list')
    kinds = set(map(type, value))
    if depth == 1 and (kinds <= {int} or (item.kind is float and kinds <= {int, float})):
        return value  # at once: grids have thousands
    rows = [_rows(item, row, f'{path}[{k}]', depth - 1) for k, row in enumerate(value)]
    if depth > 1 and len(set(map(len, rows))) > 1:
        raise ValueError(f'{path}: rows of different length')
    return rows


def _check_numbers(kind: FieldType, array: AnyArray, path: str) -> None:
    """Refuse the first number of an array, or the first vector, that is not allowed."""
    if kind.is_finite or kind.low is not None:
        wrong = ~np.isfinite(array) if kind.is_finite else np.isinf(array)
        if wrong.any():
            raise _refused(*_first(wrong, array, path), 'a finite number')
    if kind.low is not None and kind.high is not None:
        wide = array.astype(np.float64)  # single precision does not hold the limits
        wrong = (wide < kind.low) | (wide > kind.high)
        if wrong.any():
            raise _refused(*_first(wrong, array, path), kind.allowed)
    if kind.unit_tolerance is not None:
        with np.errstate(over='ignore'):
            length = np.linalg.norm(array, axis=-1)
        wrong = np.abs(length - 1.0) > kind.unit_tolerance  # NaN where the marks allow it
        if wrong.any():
            place, norm = _first(wrong, length, path)
            raise ValueError(f'{place}: length {norm:.6g} is not 1')


def _first(where: Mask, array: AnyArray, path: str) -> tuple[str, Any]:
    """Path and value of the first number that a mask marks."""
    index = np.argwhere(where)[0].tolist()
    return path + ''.join(f'[{k}]' for k in index), array[tuple(index)].item()
