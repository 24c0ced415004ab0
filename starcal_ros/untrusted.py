# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The door for files from outside: bounded regular files, strict YAML and JSON, plain values only.

Every file of a user is opened here.  Parameter files, camera files, ``metadata.yaml`` and
``calibration.json`` are read here, before any code looks at their values.  Values are None, bool,
int, float, str, list, and dict with str keys.  Refused are duplicate keys, keys that are no text,
numbers of over 400 digits, deep nesting, NUL characters, lone surrogates, YAML aliases, and the
YAML tags that construct objects.

YAML differs from PyYAML in two points, as the parser of rcl does: ``1e-6`` is a number, and dates
stay texts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
import contextlib
import json
import os
from pathlib import Path
import re
import stat
from typing import Any, IO
import zipfile

import yaml

PARAMETER_BYTES = 256 * 1024  # parameter or camera file: thirty times the longest in use
PRODUCT_BYTES = 8 * 1024 * 1024  # a calibration.json with the covariance of a field has 1 MB
ARCHIVE_BYTES = 1 << 30  # catalog, residuals or message, inflated: 30 million stars

_DEPTH = 32
_VALUES = 100_000  # values of a YAML document; containers of a JSON document
# Python takes quadratic time to read an integer, or refuses it from 4300 digits.
_DIGITS = re.compile(r'[0-9]{400}')
_SHOWN = 60  # characters of a value in an error message

_TAG = 'tag:yaml.org,2002:'
_KINDS = ('null', 'bool', 'int', 'float', 'str', 'seq', 'map')
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


def read_archive(
    path: Path, names: Iterable[str], most_bytes: int = ARCHIVE_BYTES
) -> dict[str, Any]:
    """
    Arrays of a NumPy archive by name, of those asked for that it has; others are not inflated.

    Raises OSError when the file cannot be read. Raises ValueError in one line, for a file that is
    not regular, is too large, also inflated, or is no archive.
    """
    import numpy as np  # most commands that read text need no numerics to begin

    with regular_file(path) as file:
        if os.fstat(file.fileno()).st_size > most_bytes:  # so large its directory may be
            raise ValueError(f'larger than {most_bytes // 1024} kB')
        # The exceptions of a damaged archive have no common base class.
        try:
            archive = zipfile.ZipFile(file)
            there = archive.NameToInfo
            members = {name: there[f'{name}.npy'] for name in names if f'{name}.npy' in there}
            if sum(member.file_size for member in members.values()) > most_bytes:
                raise ValueError(f'inflates to more than {most_bytes // 1024} kB')
            read: Any = np.lib.format.read_array
            return {name: read(archive.open(member)) for name, member in members.items()}
        except Exception as error:
            words = ' '.join(f'{error}'.split())
            raise ValueError(f'not a NumPy archive: {words}') from error


@contextlib.contextmanager
def regular_file(path: Path, follow_links: bool = True) -> Iterator[IO[bytes]]:
    """A regular file, open to read; never waits.  Raises OSError, or ValueError in one line."""
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow_links else os.O_NOFOLLOW)
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(open(path, 'rb', opener=lambda at, _: os.open(at, flags)))
        except ValueError as error:  # the name has a NUL or half a surrogate pair
            raise ValueError('not the name of a file') from error
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError('not a regular file')
        yield file


def yaml_value(text: str) -> Any:
    """Value of a YAML document, None of an empty one; raises ValueError in one line."""
    if re.search(r'^%TAG', text, re.MULTILINE):
        raise ValueError('YAML tag directives are not read')
    _check_digits(text)
    try:
        _check_size(yaml.parse(text, Loader=_Loader))
        return _checked(yaml.load(text, _Loader))
    except (yaml.YAMLError, LookupError) as error:  # LookupError: !!bool of another word
        raise ValueError(f'not YAML: {" ".join(str(error).split())}') from error


def json_value(text: str) -> Any:
    """Value of a JSON document without NaN and Infinity; raises ValueError in one line."""
    _check_digits(text)
    if text.count('[') + text.count('{') > _VALUES:
        raise ValueError(f'more than {_VALUES} lists and objects')
    try:
        return _checked(json.loads(text, object_pairs_hook=_object, parse_constant=_no_constant))
    except json.JSONDecodeError as error:
        raise ValueError(f'not JSON: {error}') from error
    except RecursionError as error:
        raise ValueError(f'not JSON: nested deeper than {_DEPTH}') from error


def check_text(text: str) -> str:
    """Return a text; raises ValueError for one with NUL or lone surrogates."""
    if '\0' in text:
        raise ValueError('a text with a NUL character')
    if _LONE.search(text):
        raise ValueError('a text with half a surrogate pair')
    return text


def _check_digits(text: str) -> None:
    if _DIGITS.search(text):
        raise ValueError('a number of more than 400 digits')


def _checked(value: Any, depth: int = 0) -> Any:
    """Return a value; raises ValueError for one that is nested deep, or a text in it."""
    if isinstance(value, str):
        check_text(value)
    elif isinstance(value, (list, dict)):
        if depth == _DEPTH:
            raise ValueError(f'nested deeper than {_DEPTH}')
        for member in value if isinstance(value, list) else (*value, *value.values()):
            if isinstance(member, (str, list, dict)):  # no call for each of many numbers
                _checked(member, depth + 1)
    return value


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    values = dict(pairs)
    if len(values) < len(pairs):
        ((twice, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f'duplicate key {shown(twice)}')
    return values


def _no_constant(name: str) -> object:
    raise ValueError(f'{name} is not a number of JSON')


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


class _Loader(getattr(yaml, 'CSafeLoader', yaml.SafeLoader)):  # type: ignore[misc]
    """Safe loader of plain values with unique keys; the one in C is a hundred times faster."""

    yaml_implicit_resolvers: Mapping[str, Any] = {}
    # The constructor of no tag refuses all other tags.
    yaml_constructors: Mapping[str | None, Any] = {
        tag: constructor
        for tag, constructor in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.removeprefix(_TAG) in _KINDS
    }

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[str, Any]:
        """Mapping with different texts as keys."""
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            key, line = self.construct_object(key_node, deep), key_node.start_mark.line + 1
            if not isinstance(key, str):
                raise ValueError(f'line {line}: key {shown(key)} is not a text')
            if key in mapping:
                raise ValueError(f'line {line}: duplicate key {shown(key)}')
            mapping[key] = self.construct_object(value_node, deep)
        return mapping


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
    _Loader.add_implicit_resolver(_TAG + _kind, re.compile(_pattern), None)
