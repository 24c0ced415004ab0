# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The door of untrusted text: plain values, and what is refused with its line."""

import json
import math
import os
from pathlib import Path
import re
from typing import Any
import zipfile

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import yaml

from starcal_ros.untrusted import json_value, read_archive, read_text, shown, yaml_value


@pytest.mark.parametrize(
    ('text', 'value'),
    [
        ('1e-6', 1e-6),
        ('-2E+3', -2000.0),
        ('.5', 0.5),
        ('3.', 3.0),
        ('0x1F', 31),
        ('010', 8),
        ('-0b11', -3),
        ('08', '08'),
        ('2026-13-01', '2026-13-01'),
        ('12:30:45', '12:30:45'),
        ('yes', True),
        ('Off', False),
        ('"yes"', 'yes'),
        ('!!str 5', '5'),
        ('!!float 5', 5),
        ('~', None),
        ('-.INF', -math.inf),
        ('[1, {a: b}]', [1, {'a': 'b'}]),
        ('', None),
    ],
)
def test_values_of_yaml(text: str, value: object) -> None:
    assert yaml_value(text) == value


REFUSED = {
    yaml_value: [
        ('a: 1\na: 2', "line 2: duplicate key 'a'"),
        ('5: 1', 'line 1: key 5 is not a text'),
        ('no: 1', 'line 1: key False is not a text'),
        ('a: ' + 5000 * '9', 'a number of more than 400 digits'),
        ('a: "\\0"', 'a text with a NUL character'),
        ('a: !!python/object/apply:os.system [x]', 'for the tag .* line 1, column 4'),
        ('a: !!timestamp 2026-05-15', 'for the tag .* line 1, column 4'),
        ('a: !!bool 5', 'not YAML'),
        ('%TAG ! x\n---\na: 1', 'tag directives'),
        (40 * '[' + 40 * ']', 'line 1: nested deeper than 32'),
        # PyYAML 6.1 has a limit of its own.
        (100_000 * '[', 'nested deeper|maximum nesting depth'),
        # Written out, nine levels of ten aliases each would be a gigabyte.
        ('a: &a [*a]', 'line 1: YAML aliases are not read'),
        ('[' + 100_000 * '1,' + '1]', 'more than 100000 values'),
        ('--- 1\n--- 2', 'not YAML: expected a single document'),
        ('a: [', 'not YAML: .*line 2, column 1'),
        ('x\ud800', 'surrogates not allowed'),
    ],
    json_value: [
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "duplicate key 'c'"),
        ('[NaN]', 'NaN is not a number of JSON'),
        ('5' * 5000, 'a number of more than 400 digits'),
        ('["\\ud800"]', 'half a surrogate pair'),
        ('{"\\u0000": 1}', 'NUL'),
        (40 * '[' + 40 * ']', 'nested deeper than 32'),
        (100_000 * '[', 'nested deeper'),
        ('[' + 100_001 * '[],' + '1]', 'more than 100000 lists'),
        ('', 'not JSON: Expecting value'),
    ],
}


@pytest.mark.parametrize(
    ('read', 'text', 'says'), [(read, *row) for read, rows in REFUSED.items() for row in rows]
)
def test_yaml_and_json_that_are_refused(read: Any, text: str, says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        read(text)
    assert '\n' not in str(caught.value) and len(str(caught.value)) < 300


# A text of digits and an E is a number here, which PyYAML writes without quotes; JSON's Infinity
# is replaced below.
letters = st.text(
    st.characters(exclude_categories=['Cs'], exclude_characters='\0'), max_size=9
).filter(lambda text: not re.search(r'\d[eE]|Infinity', text))
scalars = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False) | letters
)  # fmt: skip
documents = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(letters, inner, max_size=4),
)


@settings(max_examples=100)
@given(documents)
def test_what_the_libraries_write_comes_back(value: object) -> None:
    assert yaml_value(yaml.safe_dump(value)) == value
    assert json_value(json.dumps(value).replace('Infinity', '1e999')) == value


def test_only_regular_files_of_limited_size_are_read(tmp_path: Path) -> None:
    pipe, file = tmp_path / 'pipe', tmp_path / 'file'
    os.mkfifo(pipe)
    file.write_bytes(b'1234')
    assert read_text(file, 4) == '1234'
    with pytest.raises(ValueError, match='larger than 0 kB'):
        read_text(file, 3)
    for path in (pipe, Path('/dev/zero')):
        with pytest.raises(ValueError, match='not a regular file'):
            read_text(path, 4)
    file.write_bytes(b'\xff')
    with pytest.raises(ValueError, match='not a text file'):
        read_text(file, 4)
    for name in ('a\0b', '\ud800'):
        with pytest.raises(ValueError, match='not the name of a file'):
            read_text(tmp_path / name, 4)
    with pytest.raises(IsADirectoryError):
        read_text(tmp_path, 4)
    still_open = map(os.path.realpath, Path('/proc/self/fd').iterdir())
    assert not {str(tmp_path), str(pipe)} & {*still_open}


def test_an_archive_is_inflated_as_far_as_it_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / 'a.npz'
    np.savez_compressed(path, a=np.arange(3), b=np.zeros(10**6))
    with zipfile.ZipFile(path, 'a') as archive:
        archive.writestr('c.npy', 'no array')
    assert read_archive(path, ('a', 'none'), 10**5)['a'].tolist() == [0, 1, 2]
    for names, says in ((['b'], 'inflates to more than 97 kB'), (['c'], 'not a NumPy archive')):
        with pytest.raises(ValueError, match=says):
            read_archive(path, names, 10**5)
    os.truncate(path, 10**9)
    with pytest.raises(ValueError, match='larger than 97 kB'):
        read_archive(path, ['a'], 10**5)
    path.write_bytes(b'PK\x05\x06')
    with pytest.raises(ValueError, match='not a NumPy archive: '):
        read_archive(path, ['a'])


@pytest.mark.parametrize(
    'value',
    [10**6000, ['x'] * 10**6, 'x' * 10**6, {'a': 'x' * 99}],
    ids=['int', 'list', 'str', 'dict'],
)
def test_a_shown_value_is_short(value: object) -> None:
    assert len(shown(value)) <= 60
