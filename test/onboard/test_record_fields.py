# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Records to JSON and back by the types of their fields: a new field needs no other edit.

Then wrong values of each field at each door, drawn from the descriptions of the fields; that
these are right is tested beside each door, by values that are written out.
"""

from collections.abc import Iterator, Mapping
import dataclasses
from dataclasses import dataclass
import json
import math
from pathlib import Path
import re
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
import pytest
from sample_records import assert_same, calibration, plain  # type: ignore[import-not-found]

from starcal_ground.bags.player_options import PlayerOptions
from starcal_ros.arrays import Floats
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.formats.messages.record_messages import (
    calibration_from_message,
    calibration_to_message,
)
from starcal_ros.formats.products.product_files import calibration_from_content, calibration_text
from starcal_ros.options import from_mapping, option_fields
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES
from starcal_ros.record_fields import (
    Count,
    fields_of,
    FieldType,
    Finite,
    json_object,
    read_record,
    Record,
    Shape,
    Within,
)
from starcal_ros.records import Calibration


@dataclass(frozen=True)
class Knot:
    """Nested, with an array of a stated shape."""

    places_px: Annotated[Floats, Shape(('n', 2))]
    used: Annotated[NDArray[np.int64], Within(0), Shape(('n',))]
    weight: Annotated[float, Finite()] = 1.0


@dataclass(frozen=True)
class Field:
    """One of each kind."""

    name: str
    count: Count
    one: Knot
    grid: Annotated[Floats, Shape(('rows', 'cols'))]
    maybe: Knot | None = None
    knots: tuple[Knot, ...] = ()
    pair: Annotated[tuple[float, ...], Shape((2,))] = (0.0, math.nan)
    flag: bool | None = None
    by_name: Mapping[str, Annotated[float, Finite()]] | None = None

    def __post_init__(self) -> None:
        if self.count > 9:
            raise ValueError(f'count: {self.count} is over 9')


def knot(n: int) -> Knot:
    return Knot(np.arange(2.0 * n).reshape(n, 2) / 7, np.arange(n), 1 / 3)


FIELD = Field(
    'a', 3, knot(2), np.array([[1.0, 2.0]]), knot(1), (knot(0), knot(3)), (0.1, 0.2), False,
    {'k1': -1e-300},
)  # fmt: skip


def test_a_record_comes_back_to_the_last_bit() -> None:
    text = json.dumps(json_object(FIELD), allow_nan=False)
    assert_same(read_record(Field, json.loads(text)), FIELD)


def test_a_field_with_a_default_may_be_missing() -> None:
    content = json_object(FIELD)
    for name in ('maybe', 'knots', 'pair', 'flag', 'by_name'):
        del content[name]
    found = read_record(Field, {**content, 'of a later version': 1})
    assert found.maybe is None and found.knots == () and found.flag is None


@pytest.mark.parametrize(
    ('key', 'value', 'error'),
    [
        ('name', 3, 'name: 3 is not a text'),
        ('count', -1, 'count: -1 is not within 0 to 4294967295'),
        ('count', 10, 'count: 10 is over 9'),
        ('count', 1.5, 'count: 1.5 is not a whole number'),
        ('one', None, 'one: None is not an object'),
        ('one', {}, "key 'one.places_px' is missing"),
        ('one', {'places_px': [[1.0]], 'used': [1]}, 'one.places_px: 1 x 1 numbers, not 1 x 2'),
        ('one', {'places_px': [[1, 2]], 'used': []}, 'one.used: 0 numbers, not 1'),
        ('one', {'places_px': [[1, 2]], 'used': [-1]}, r'one.used\[0\]: -1 is not at least 0'),
        ('one', {'places_px': [1, 2], 'used': []}, r'one.places_px\[0\]: 1 is not a list'),
        ('one', {'places_px': [], 'used': [], 'weight': None}, 'one.weight: None is not a number'),
        ('grid', [[1.0], [1.0, 2.0]], 'grid: rows of different length'),
        ('grid', [[10**400]], 'grid: a number is out of the range of float64'),
        ('knots', {}, 'knots: {} is not a list'),
        ('knots', [{}], r"key 'knots\[0\].places_px' is missing"),
        ('pair', [1.0], 'pair: 1 numbers, not 2'),
        ('pair', ['1', 2], r"pair\[0\]: '1' is not a number"),
        ('flag', 0, 'flag: 0 is not true or false'),
        ('by_name', {'k': None}, 'by_name.k: None is not a number'),
    ],
)
def test_a_wrong_value_is_refused_by_its_key(key: str, value: object, error: str) -> None:
    with pytest.raises(ValueError, match=error) as caught:
        read_record(Field, {**json_object(FIELD), key: value})
    assert '\n' not in str(caught.value) and len(str(caught.value)) < 150


@dataclass(frozen=True, eq=False, repr=False)
class Shown(Record):
    """A record with arrays."""

    name: str
    value: float
    numbers: np.ndarray
    parts: tuple[object, ...] = ()


ONE = Shown('one', math.nan, np.array([1.0, math.nan]), (np.zeros(2), 3))
# What differs from ONE, and whether it is equal.
COMPARED = {
    'copy': ({'numbers': ONE.numbers.copy(), 'parts': (np.zeros(2), 3)}, True),
    'number': ({'numbers': np.array([2.0, math.nan])}, False),
    'shape': ({'numbers': np.array([[1.0, math.nan]])}, False),
    'part': ({'parts': (np.ones(2), 3)}, False),
    'value': ({'value': 1.0}, False),
    'text': ({'name': 'two'}, False),
    'mapping': ({'parts': ({'a': np.zeros(2)},)}, False),
    'words': ({'numbers': np.array(['a', 'b'])}, False),
}


@pytest.mark.parametrize('name', COMPARED)
def test_records_with_arrays_are_compared_by_their_numbers(name: str) -> None:
    changes, expected = COMPARED[name]
    other = dataclasses.replace(ONE, **changes)  # type: ignore[arg-type]
    assert (other == ONE) is expected
    assert ONE != 'one'


def test_a_large_record_is_shown_in_three_lines() -> None:
    large = Shown('<b>' + 'x' * 500, 1.0, np.zeros((300, 2)), tuple(range(1000)))
    assert repr(large) == (
        'Shown(name=str(...), value=1.0, numbers=<300 x 2 float64>, parts=<1000 items>)'
    )
    assert repr(dataclasses.replace(large, parts=(large,) * 3)).count('\n') <= 2


def wrong_values(kind: FieldType, sound: Any) -> Iterator[tuple[Any, str]]:
    """Plain values that a field must not have, each with words of its refusal."""
    low, high = kind.low, kind.high
    if kind.kind is str:
        yield 3, 'is not a text'
    elif kind.kind is bool:
        yield 'yes', 'is not true or false'
    elif kind.is_record or kind.kind is dict:
        yield 3, 'is not an object'
    elif kind.kind in (int, float):
        yield '1', 'is not a whole number' if kind.kind is int else 'is not a number'
    else:
        yield 3, 'is not a list'
    if kind.kind is str and kind.choices:
        yield 'magic', 'is not one of'
    elif kind.kind is str and kind.most_characters:
        yield 'x' * (kind.most_characters + 1), 'is not a text of at most'
    elif kind.kind is float and (kind.is_finite or low is not None):
        yield math.inf, 'is not a finite number'
    if kind.kind in (int, float) and low is not None and high is not None:
        outside = [low - 1] * (low > -1e300) + [high + 1] * (high < 1e300)
        yield from ((value, f'is not {kind.allowed}') for value in outside)
    if isinstance(sound, list) and isinstance(kind.dimensions[0], int):
        yield sound[:-1], 'numbers, not'


def fields_in(record_type: Any, content: dict[str, Any], path: str = '') -> Iterator[Any]:
    """Mapping, key, type and path of each field of a record in plain values, inner ones too."""
    for name, kind in fields_of(record_type).items():
        value = content.get(name)
        if name not in content:
            continue
        yield content, name, kind, path + name
        if kind.is_record and value is not None:
            yield from fields_in(kind.kind, value, f'{path}{name}.')
        elif kind.item is not None and kind.item.is_record and value:
            yield from fields_in(kind.item.kind, value[0], f'{path}{name}[0].')


def test_a_calibration_file() -> None:
    content, tried = json.loads(calibration_text(calibration())), 0
    for held, name, kind, path in list(fields_in(Calibration, content)):
        sound = held.pop(name)
        if not kind.has_default:
            with pytest.raises(ProductError, match=re.escape(f"c.json: key '{path}")):
                calibration_from_content(Path('c.json'), content)
        for wrong, words in wrong_values(kind, sound):
            held[name] = wrong
            with pytest.raises(ProductError, match=f'{re.escape(path)}.*{words}') as caught:
                calibration_from_content(Path('c.json'), content)
            assert '\n' not in str(caught.value)
            tried += 1
        held[name] = sound
    assert tried > 100


@pytest.mark.parametrize('options', [*OPTION_CLASSES, *NODE_OPTION_CLASSES, PlayerOptions])
def test_an_option(options: type) -> None:
    for field in option_fields(options):
        kind, default = field.metadata['kind'], field.default
        sound = list(default) if isinstance(default, tuple) else default
        for wrong, words in wrong_values(kind, sound):
            with pytest.raises(OptionError, match=f'^{field.name}: .*{words}'):
                from_mapping(options, {field.name: wrong})


def arrays_in(record_type: Any, message: Any) -> Iterator[Any]:
    """Message, field and type of each array in the message of a record, inner ones too."""
    for kind in fields_of(record_type).values():
        value = getattr(message, kind.in_messages, None)
        if kind.kind is np.ndarray and isinstance(value, np.ndarray):
            yield message, kind.in_messages, kind
        elif kind.is_record and kind.optional and value:
            yield from arrays_in(kind.kind, value[0])
        elif kind.item is not None and kind.item.is_record and value:
            yield from arrays_in(kind.item.kind, value[0])


def test_arrays_in_the_message_of_a_calibration() -> None:
    message, tried = calibration_to_message(calibration(), plain), set()
    for held, name, kind in arrays_in(Calibration, message):
        sound = getattr(held, name)
        if len(kind.dimensions) > 1:
            setattr(held, name, sound[:-1])
            with pytest.raises(ValueError, match=f'{name}: .* numbers, not'):
                calibration_from_message(message)
            tried.add(name)
            setattr(held, name, sound)
    assert tried >= {'stars', 'matrix', 'coefficients', 'covariance'}, tried
