# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Values of YAML files, each checked for its kind; an error names file and key.

A kind is a function that returns the value, or raises ValueError with the expected kind.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from pathlib import Path
from typing import TypeVar

from starcal_ros.errors import ProductError
from starcal_ros.untrusted import shown

T = TypeVar('T')


class CheckedValues:
    """Checked look-ups in a nested mapping from a file; every error names file and key."""

    def __init__(self, path: Path, content: Mapping[str, object]) -> None:
        self.path = path
        self._content = content

    def get(self, dotted_key: str, kind: Callable[[object], T]) -> T:
        """Value at a key, converted by `kind`, which raises ValueError with the expected form."""
        value: object = self._content
        for key in dotted_key.split('.'):
            if not isinstance(value, dict) or key not in value:
                raise ProductError(f'{self.path}: key {dotted_key!r} is missing')
            value = value[key]
        try:
            return kind(value)
        except ValueError as error:
            raise ProductError(
                f'{self.path}: {dotted_key}: {shown(value)} is not {error}'
            ) from error


def finite_number(value: object) -> float:
    """A finite number, and no text of one."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError('a number')
    if not math.isfinite(value):
        raise ValueError('a finite number')
    return float(value)


def whole_number(value: object) -> int:
    """A whole number, and no text of one."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError('a whole number')
    return value


def string(value: object) -> str:
    """A text."""
    if not isinstance(value, str):
        raise ValueError('a text')
    return value


def list_of(kind: Callable[[object], T]) -> Callable[[object], list[T]]:
    """The kind of a list of items of a kind."""

    def items(value: object) -> list[T]:
        if not isinstance(value, list):
            raise ValueError('a list')
        return [kind(item) for item in value]

    return items


def row_of_numbers(*counts: int) -> Callable[[object], list[float]]:
    """The kind of a list of so many numbers."""

    def row(value: object) -> list[float]:
        items = list_of(finite_number)(value)
        if len(items) not in counts:
            raise ValueError(' or '.join(map(str, counts)) + ' numbers')
        return items

    return row
