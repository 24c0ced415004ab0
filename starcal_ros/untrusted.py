# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The door for text from outside: bounded regular files, strict YAML and JSON, plain values only.

Parameter files, camera files, ``metadata.yaml`` and ``calibration.json`` are read here, before
any code looks at their values.  Values are None, bool, int, float, str, list, and dict with str
keys.  Refused are duplicate keys, keys that are no text, integers beyond 64 bit, deep nesting,
NUL characters, lone surrogates, and the YAML tags that construct objects.

YAML differs from PyYAML in two points, as the parser of rcl does: ``1e-6`` is a number, and dates
stay texts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import json
import os
from pathlib import Path
import re
import stat
from typing import Any, IO

import yaml

PARAMETER_BYTES = 256 * 1024  # of a parameter or camera file: thirty times the longest in use
METADATA_BYTES = 4 * 1024 * 1024  # 5000 topics
PRODUCT_BYTES = 8 * 1024 * 1024  # a calibration.json with the covariance of a field has 1 MB

_DEPTH = 32
_VALUES = 100_000  # of a YAML document, aliases expanded; containers of a JSON document
_INT64 = 2**63
_INT64_DIGITS = 20  # with the sign
_DIGITS = re.compile(r'[0-9]{400}')  # in a row: no number that a double or an integer needs
_SHOWN = 60  # characters of a value in an error message

_NULL = frozenset(['', '~', 'null', 'Null', 'NULL'])
_BOOL = {
    spelling: value
    for value, words in ((True, 'yes true on'), (False, 'no false off'))
    for word in words.split()
    for spelling in (word, word.capitalize(), word.upper())
}
_WHOLE = re.compile(r'[-+]?(0|[1-9][0-9]*)\Z')
_BASED = re.compile(r'[-+]?0(b[01]+|x[0-9a-fA-F]+|o?[0-7]+)\Z')
_REAL = re.compile(
    r'[-+]?([0-9]+\.[0-9]*([eE][-+]?[0-9]+)?|\.[0-9]+([eE][-+]?[0-9]+)?|[0-9]+[eE][-+]?[0-9]+)\Z'
)
_SPECIAL = re.compile(r'([-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))\Z')
_LONE = re.compile('[\ud800-\udfff]')
_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)  # the other is a hundred times slower
_TAG = 'tag:yaml.org,2002:'
_CORE_TAGS = frozenset(
    _TAG + kind for kind in ('str', 'int', 'float', 'bool', 'null', 'seq', 'map')
)
_OF_TAG: Mapping[str, type | tuple[type, ...]] = {
    f'{_TAG}int': int,
    f'{_TAG}float': (int, float),
    f'{_TAG}bool': bool,
    f'{_TAG}null': type(None),
}


def shown(value: object) -> str:
    """Text of a value for an error message, cut to 60 characters."""
    if isinstance(value, (str, list, tuple)) and len(value) > _SHOWN:
        value = value[:_SHOWN]  # the text of a list of a million is not made to show its start
    elif isinstance(value, int) and abs(value) >= 10**_SHOWN:
        return 'an integer of more than 60 digits'  # Python refuses to print one of 5000
    text = repr(value)
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + '...'


def read_text(path: Path, most_bytes: int) -> str:
    """
    Text of a regular file in UTF-8.

    Raises
    ------
    OSError
        When the file cannot be read.
    ValueError
        In one line, for a file that is not regular, is too large or no text.
    """
    try:
        return read_bytes(path, most_bytes).decode()
    except UnicodeDecodeError as error:
        raise ValueError('not a text file') from error


def read_bytes(path: Path, most_bytes: int, follow_links: bool = True) -> bytes:
    """
    Content of a regular file; never waits, as for a pipe, and never reads more.

    Raises
    ------
    OSError
        When the file cannot be read.
    ValueError
        In one line, for a file that is not regular or is too large.
    """
    with regular_file(path, follow_links) as file:
        # A read allocates all that it is asked for; a file of /proc has the size 0.
        size = os.fstat(file.fileno()).st_size
        content = file.read(min(most_bytes, max(size, 2**20)) + 1)
    if len(content) > most_bytes:
        raise ValueError(f'larger than {most_bytes // 1024} kB')
    return content


@contextlib.contextmanager
def regular_file(path: Path, follow_links: bool = True) -> Iterator[IO[bytes]]:
    """
    A regular file, open to read; never waits, as for a pipe.

    Raises
    ------
    OSError
        When the file cannot be opened.
    ValueError
        In one line, for a file that is not regular.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow_links else os.O_NOFOLLOW)
    try:
        number = os.open(path, flags)
    except ValueError as error:  # of a name with NUL or half a surrogate pair
        raise ValueError('not the name of a file') from error
    with os.fdopen(number, 'rb') as file:
        if not stat.S_ISREG(os.fstat(number).st_mode):
            raise ValueError('not a regular file')
        yield file


def yaml_value(text: str) -> Any:
    """
    Value of a YAML document; None of an empty one.

    Raises
    ------
    ValueError
        In one line, with the number of the line at fault.
    """
    if re.search(r'^%TAG', text, re.MULTILINE):
        raise ValueError('YAML tag directives are not read')
    try:
        return _Document(yaml.parse(text, Loader=_LOADER)).value()
    except yaml.YAMLError as error:
        raise ValueError(f'not YAML: {" ".join(str(error).split())}') from error
    except UnicodeError as error:
        raise ValueError('not YAML: a character that is none') from error


def json_value(text: str) -> Any:
    """
    Value of a JSON document; NaN and Infinity, which Python's parser takes, are refused.

    Raises
    ------
    ValueError
        In one line.
    """
    try:
        if _DIGITS.search(text):  # Python takes quadratic time, or refuses from 4300 digits
            raise ValueError('a number of more than 400 digits')
        if text.count('[') + text.count('{') > _VALUES:
            raise ValueError(f'more than {_VALUES} lists and objects')
        found = json.loads(text, object_pairs_hook=_object, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        raise ValueError(f'not JSON: {error}') from error
    except RecursionError as error:
        raise ValueError(f'not JSON: nested deeper than {_DEPTH}') from error
    level = [found]
    for _ in range(_DEPTH):
        level = [inner for value in level for inner in _inner(value)]
        if not level:
            return found
    raise ValueError(f'not JSON: nested deeper than {_DEPTH}')


def check_text(text: str) -> str:
    """
    Return a text without NUL and lone surrogates, which no file and no message can hold.

    Raises
    ------
    ValueError
        For one with them.
    """
    if '\0' in text:
        raise ValueError('a text with a NUL character')
    if _LONE.search(text):
        raise ValueError('a text with half a surrogate pair')
    return text


def _inner(value: object) -> Iterator[object]:
    """Containers in a value; its texts are checked."""
    members: list[object] = []
    if isinstance(value, str):
        check_text(value)
    elif isinstance(value, list):
        members = value
    elif isinstance(value, dict):
        members = [*value, *value.values()]
    for member in members:
        if isinstance(member, str):
            check_text(member)
        elif isinstance(member, (list, dict)):
            yield member


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f'key {shown(twice)} stands twice')
    return found


def _integer(digits: str) -> int:
    if len(digits) > _INT64_DIGITS or not -_INT64 <= int(digits) < _INT64:
        raise ValueError(f'an integer of {len(digits)} digits is beyond 64 bit')
    return int(digits)


def _no_constant(name: str) -> object:
    raise ValueError(f'{name} is no number of JSON')


class _Document:
    """Builder of the value of a YAML document from its events."""

    def __init__(self, events: Iterator[Any]) -> None:
        self._events = events
        self._anchored: dict[str, tuple[Any, int]] = {}  # values, and how many each holds
        self._count = 0

    def value(self) -> Any:
        """Value of the one document."""
        found = None
        documents = 0
        for event in self._events:
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    raise ValueError('several YAML documents, not one')
                found = self._value(next(self._events), 0)
        return found

    def _value(self, event: Any, depth: int) -> Any:
        line = event.start_mark.line + 1
        if depth > _DEPTH:
            raise _Placed(f'line {line}: nested deeper than {_DEPTH}')
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchored:
                raise _Placed(f'line {line}: alias {shown(event.anchor)} of no value before it')
            found, size = self._anchored[event.anchor]
            self._grow(size, line)
            return found
        before = self._count
        self._grow(1, line)
        if event.tag not in (None, '!', *_CORE_TAGS):
            raise _Placed(f'line {line}: tag {shown(event.tag)} is not read')
        try:
            if isinstance(event, yaml.ScalarEvent):
                found = _scalar(event)
            elif isinstance(event, yaml.SequenceStartEvent):
                found = self._list(depth)
            else:
                found = self._mapping(depth)
        except _Placed:
            raise
        except ValueError as error:
            raise _Placed(f'line {line}: {error}') from error
        if event.anchor is not None:
            self._anchored[event.anchor] = (found, self._count - before)
        return found

    def _grow(self, count: int, line: int) -> None:
        self._count += count
        if self._count > _VALUES:
            raise _Placed(f'line {line}: more than {_VALUES} values')

    def _list(self, depth: int) -> list[Any]:
        found = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            found.append(self._value(event, depth + 1))
        return found

    def _mapping(self, depth: int) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            key = self._value(event, depth + 1)
            line = event.start_mark.line + 1
            if not isinstance(key, str):
                raise _Placed(f'line {line}: key {shown(key)} is not a text')
            if key in found:
                raise _Placed(f'line {line}: key {shown(key)} stands twice')
            found[key] = self._value(next(self._events), depth + 1)
        return found


class _Placed(ValueError):
    """An error that names its line."""


def _scalar(event: Any) -> Any:
    """Value of a scalar by its text, as the core schema of YAML and rcl read it."""
    text, tag = event.value, event.tag
    if tag == '!' or (tag is None and not event.implicit[0]):
        return check_text(text)
    found = check_text(text) if tag and tag.endswith(':str') else _plain(text)
    if tag and not isinstance(found, _OF_TAG.get(tag, object)):
        raise ValueError(f'{shown(text)} is not of its tag {tag}')
    return found


def _plain(text: str) -> Any:
    if text in _NULL:
        return None
    if text in _BOOL:
        return _BOOL[text]
    if _WHOLE.match(text):
        return _integer(text)
    if _BASED.match(text):
        bits = text.lstrip('+-')
        base = {'b': 2, 'x': 16}.get(bits[1], 8)
        if len(bits) > 66:
            raise ValueError(f'an integer of {len(bits)} digits is beyond 64 bit')
        number = int(bits.replace('o', ''), base) if base == 8 else int(bits, base)
        return _integer(str(-number if text.startswith('-') else number))
    if _REAL.match(text):
        return float(text)
    if _SPECIAL.match(text):
        return float(text.replace('.', ''))
    return check_text(text)
