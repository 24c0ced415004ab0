# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Malformed messages from hypothesis: wrong fields, truncated and changed bytes."""

import copy
import math
import re
from typing import Any

from attacks import drawn  # type: ignore[import-not-found]
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

_INTEGERS = re.compile(r'(u?)int(8|16|32|64)')
_ARRAY = re.compile(r'(.+)\[(\d+)\]')
_SEQUENCE = re.compile(r'sequence<(.+?)(?:, (\d+))?>')


def mutated(template: Any, count: int) -> list[tuple[Any, type[Any]]]:
    """Draw mutants of a message, one in sixteen as bytes, each with the type of the message."""
    whole = serialize_message(template)
    mutants_so_far: list[tuple[Any, type[Any]]] = []

    @drawn(count)
    @given(st.integers(0, 15).flatmap(lambda k: mutants(template) if k else _spoilt(whole)))
    def draw(mutant: Any) -> None:
        mutants_so_far.append((mutant, type(template)))

    draw()
    return mutants_so_far


def is_decodable(mutant: tuple[Any, type[Any]]) -> bool:
    """True for a message, and for bytes that are one."""
    message, kind = mutant
    if not isinstance(message, bytes):
        return True
    try:
        deserialize_message(message, kind)
    except Exception:
        return False
    return True


@st.composite
def _spoilt(draw: st.DrawFn, whole: bytes) -> bytes:
    """Truncated bytes with changes near the start, where the lengths are."""
    content = bytearray(whole[: draw(st.integers(4, len(whole)))])
    for _ in range(draw(st.integers(0, 4))):
        content[draw(st.integers(4, max(4, min(len(content) - 1, 200)))) % len(content)] = draw(
            st.integers(0, 255)
        )
    return bytes(content)


@st.composite
def mutants(draw: st.DrawFn, template: Any) -> Any:
    """Copies of a message with up to four fields replaced."""
    mutant = copy.deepcopy(template)
    kinds = mutant.get_fields_and_field_types()
    for name in draw(st.lists(st.sampled_from(sorted(kinds)), max_size=4, unique=True)):
        old = getattr(mutant, name)
        if hasattr(old, 'get_fields_and_field_types'):
            setattr(mutant, name, draw(mutants(old)))
        else:
            setattr(mutant, name, draw(_values(kinds[name], old)))
    return mutant


def _values(kind: str, old: Any) -> st.SearchStrategy[Any]:
    """Values for a field of a ROS type; arrays may keep their length."""
    fixed, sequence = _ARRAY.fullmatch(kind), _SEQUENCE.fullmatch(kind)
    if fixed:
        size = int(fixed[2])
        return st.lists(_single(fixed[1]), min_size=size, max_size=size)
    if sequence:
        if '/' in sequence[1]:
            most = int(sequence[2] or 4)
            return st.lists(mutants(old[0]), max_size=most) if len(old) else st.just([])
        element = _single(sequence[1])
        kept = list(old[:64])
        return st.one_of(
            st.lists(element, max_size=8),
            st.just(kept),
            st.tuples(st.integers(0, max(len(kept) - 1, 0)), element).map(
                lambda one: [*kept[: one[0]], one[1], *kept[one[0] + 1 :]]
            ),
            st.tuples(st.integers(0, max(len(old) - 1, 0)), element).map(
                lambda one: _with(old, *one)
            ),
        )
    return _single(kind)


def _with(old: Any, index: int, value: Any) -> Any:
    changed = list(old)
    changed[index : index + 1] = [value]
    return changed


def _single(kind: str) -> st.SearchStrategy[Any]:
    integer = _INTEGERS.fullmatch(kind)
    if integer:
        bits = int(integer[2])
        low, high = (0, 2**bits - 1) if integer[1] else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return st.one_of(st.sampled_from([low, high, 0, 1]), st.integers(low, high))
    if kind in ('float', 'double'):
        special = [math.nan, math.inf, -math.inf, 0.0, -1.0, 1.0]
        any_float = st.floats(width=32) if kind == 'float' else st.floats()
        return st.one_of(st.sampled_from(special), any_float)
    if kind in ('boolean', 'bool'):
        return st.booleans()
    if kind in ('octet', 'byte'):
        return st.integers(0, 255)
    if kind == 'string':
        characters = st.characters(exclude_categories=['Cs'], exclude_characters='\0')
        return st.text(characters, max_size=40)
    raise TypeError(kind)


def not_finite(message: Any, allowed: frozenset[str]) -> list[str]:
    """Names of the fields of a message with non-finite numbers."""
    found = []
    for name in message.get_fields_and_field_types():
        value = getattr(message, name)
        if name in allowed:
            continue
        if hasattr(value, 'get_fields_and_field_types'):
            found += [f'{name}.{inner}' for inner in not_finite(value, allowed)]
        elif isinstance(value, float):
            found += [] if math.isfinite(value) else [name]
        elif not isinstance(value, (str, bytes)) and hasattr(value, '__len__'):
            for one in value:
                if hasattr(one, 'get_fields_and_field_types'):
                    found += [f'{name}.{inner}' for inner in not_finite(one, allowed)]
            numbers = [one for one in value if isinstance(one, float)]
            found += [] if all(map(math.isfinite, numbers)) else [name]
    return found
