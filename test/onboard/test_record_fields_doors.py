# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Each door with wrong values in each of its fields: refused in one line that names the field.

The values are drawn from the descriptions of the fields; that these are right is tested beside
each door, by values that are written out.
"""

from __future__ import annotations

from collections.abc import Iterator
import json
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
import pytest
from sample_records import calibration, plain  # type: ignore[import-not-found]

from starcal_ground.bags.player_options import PlayerOptions
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.formats.messages.record_messages import (
    calibration_from_message,
    calibration_to_message,
)
from starcal_ros.formats.products.product_files import calibration_from_content, calibration_text
from starcal_ros.options import from_mapping, option_fields
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES
from starcal_ros.record_fields import fields_of, FieldType
from starcal_ros.records import Calibration


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
