# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The door for text from outside: bounded regular files, strict YAML and JSON, plain values only.

Parameter files, camera files, ``metadata.yaml`` and ``calibration.json`` are read here, before
any code looks at their values.  Values are None, bool, int, float, str, list, and dict with str
keys.  Refused are duplicate keys, keys that are no text, integers beyond 64 bit, deep nesting,
NUL characters, lone surrogates, YAML aliases, and the YAML tags that construct objects.

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
_VALUES = 100_000  # of a YAML document; containers of a JSON document
_INT64 = 2**63
_INT64_DIGITS = 67  # binary, with the sign
_DIGITS = re.compile(r'[0-9]{400}')  # in a row: no number that a double or an integer needs
_SHOWN = 60  # characters of a value in an error message

_BOOL_WORDS = ('yes', 'no', 'true', 'false', 'on', 'off')
_LONE = re.compile('[\ud800-\udfff]')


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

    Raises OSError when the file cannot be read. Raises ValueError in one line, for a file that is
    not regular, is too large or no text.
    """
    try:
        return read_bytes(path, most_bytes).decode()
    except UnicodeDecodeError as error:
        raise ValueError('not a text file') from error


def read_bytes(path: Path, most_bytes: int, follow_links: bool = True) -> bytes:
    """
    Content of a regular file; never waits, as for a pipe, and never reads more.

    Raises OSError when the file cannot be read. Raises ValueError in one line, for a file that is
    not regular or is too large.
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

    Raises OSError when the file cannot be opened. Raises ValueError in one line, for a file that
    is not regular.
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

    Raises ValueError in one line, with the number of the line at fault.
    """
    if re.search(r'^%TAG', text, re.MULTILINE):
        raise ValueError('YAML tag directives are not read')
    try:
        _check_size(yaml.parse(text, Loader=_Loader))
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        raise ValueError(f'not YAML: {" ".join(str(error).split())}') from error
    except UnicodeError as error:
        raise ValueError('not YAML: a character that is none') from error


def json_value(text: str) -> Any:
    """
    Value of a JSON document; NaN and Infinity, which Python's parser takes, are refused.

    Raises ValueError in one line.
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

    Raises ValueError for one with them.
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


def _no_constant(name: str) -> object:
    raise ValueError(f'{name} is no number of JSON')


def _check_size(events: Iterator[Any]) -> None:
    """Raise ValueError for a document that is nested deep, large, or multiplies by aliases."""
    count = depth = 0
    for event in events:
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f'line {line}: YAML aliases are not read, nor by ROS: write it out')
        count += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEPTH:
            raise ValueError(f'line {line}: nested deeper than {_DEPTH}')
        if count > _VALUES:
            raise ValueError(f'line {line}: more than {_VALUES} values')


class _Placed(ValueError):
    """An error that names its line."""


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """Safe loader of plain values with unique keys; the one in C is a hundred times faster."""

    yaml_implicit_resolvers: Mapping[str, Any] = {}
    yaml_constructors: Mapping[str, Any] = {}

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """Value of a node; an error names its line."""
        try:
            return super().construct_object(node, deep)
        except (_Placed, yaml.YAMLError):
            raise
        except (ValueError, LookupError) as error:
            raise _Placed(f'line {node.start_mark.line + 1}: {error}') from error

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[str, Any]:
        """Mapping with different texts as keys."""
        found: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key, line = self.construct_object(key_node, deep), key_node.start_mark.line + 1
            if not isinstance(key, str):
                raise _Placed(f'line {line}: key {shown(key)} is not a text')
            if key in found:
                raise _Placed(f'line {line}: duplicate key {shown(key)}')
            found[key] = self.construct_object(value_node, deep)
        return found

    def construct_int(self, node: Any) -> int:
        """An integer of 64 bit."""
        digits = self.construct_scalar(node)
        if len(digits) > _INT64_DIGITS or not -_INT64 <= self.construct_yaml_int(node) < _INT64:
            raise ValueError(f'an integer of {len(digits)} digits is beyond 64 bit')
        return int(self.construct_yaml_int(node))

    def construct_text(self, node: Any) -> str:
        """A text that files and messages can hold."""
        return check_text(self.construct_scalar(node))

    def refuse(self, node: Any) -> Any:
        """Refuse a value with a tag that is not of the core schema."""
        raise ValueError(f'tag {shown(node.tag)} is not read')


_CONSTRUCTORS = {
    'null': _Loader.construct_yaml_null,
    'bool': _Loader.construct_yaml_bool,
    'int': _Loader.construct_int,
    'float': _Loader.construct_yaml_float,
    'str': _Loader.construct_text,
    'seq': lambda loader, node: loader.construct_sequence(node, deep=True),
    'map': lambda loader, node: loader.construct_mapping(node, deep=True),
}
for _kind, _constructor in _CONSTRUCTORS.items():
    _Loader.add_constructor(f'tag:yaml.org,2002:{_kind}', _constructor)
_Loader.add_constructor(None, _Loader.refuse)
# As the core schema of YAML and rcl read plain words; the first that matches counts.
for _kind, _pattern in (
    ('null', r'(~|null|Null|NULL|)\Z'),
    ('bool', '(' + '|'.join(f'{w}|{w.title()}|{w.upper()}' for w in _BOOL_WORDS) + r')\Z'),
    ('int', r'[-+]?(0|[1-9][0-9]*|0b[01]+|0x[0-9a-fA-F]+|0[0-7]+)\Z'),
    (
        'float',
        (
            r'([-+]?([0-9]+\.[0-9]*([eE][-+]?[0-9]+)?|\.[0-9]+([eE][-+]?[0-9]+)?'
            r'|[0-9]+[eE][-+]?[0-9]+|\.(inf|Inf|INF))|\.(nan|NaN|NAN))\Z'
        ),
    ),
):
    _Loader.add_implicit_resolver(f'tag:yaml.org,2002:{_kind}', re.compile(_pattern), None)
