# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Seals of state files."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from starcal_ros.errors import OptionError
from starcal_ros.ros.archive import CHECKSUMS, read_seal, Seal

KEYED = Seal(b'sixteen bytes...')
CONTENT = {'number': 3, 'list': [0.1, None, 'µ'], 'schema': 1}


@pytest.mark.parametrize('seal', [CHECKSUMS, KEYED])
def test_a_sealed_object_comes_back(seal: Seal) -> None:
    assert seal.opened(seal.sealed(CONTENT).encode()) == CONTENT


def test_a_checksum_can_be_made_again_and_an_hmac_only_with_the_key() -> None:
    forged = {**CONTENT, 'number': 4}
    text = CHECKSUMS.sealed(forged).encode()
    assert CHECKSUMS.opened(text) == forged
    with pytest.raises(ValueError, match='the HMAC is missing'):
        KEYED.opened(text)
    other = Seal(b'another sixteen.').sealed(forged).encode()
    with pytest.raises(ValueError, match='the HMAC is wrong'):
        KEYED.opened(other)
    assert CHECKSUMS.opened(KEYED.sealed(CONTENT).encode()) == CONTENT  # the key was taken away


@pytest.mark.parametrize('data', [b'', b'[]', b'{}', b'3', b'\xff', b'[' * 10**5, b'{"a": 1}'])
def test_other_content_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="checksum|not JSON|not a JSON object|codec can't decode"):
        CHECKSUMS.opened(data)


def test_a_changed_value_is_found() -> None:
    content = json.loads(CHECKSUMS.sealed(CONTENT))
    content['number'] = 4
    with pytest.raises(ValueError, match='the checksum is wrong'):
        CHECKSUMS.opened(json.dumps(content).encode())


def test_the_mark_of_a_file_is_of_its_number_and_bytes() -> None:
    mark = KEYED.mark(7, b'bytes')
    assert len(mark) == 64
    KEYED.check_mark(mark, 7, b'bytes')
    for found, number, data in ((mark, 8, b'bytes'), (mark, 7, b'byte'), ('', 7, b'bytes')):
        with pytest.raises(ValueError, match='HMAC'):
            KEYED.check_mark(found, number, data)
    assert CHECKSUMS.mark(7, b'bytes') == ''
    CHECKSUMS.check_mark('anything', 7, b'bytes')


def test_the_key_file(tmp_path: Path) -> None:
    path = tmp_path / 'key'
    path.write_bytes(KEYED.key + b'\n')
    assert read_seal(str(path)) == KEYED
    assert read_seal('') == CHECKSUMS
    path.write_bytes(b'short')
    with pytest.raises(OptionError, match='holds 5 bytes, at least 16'):
        read_seal(str(path))
    os.mkfifo(tmp_path / 'fifo')
    for name in ('fifo', 'none', '.'):
        with pytest.raises(OptionError, match='state_key_file'):
            read_seal(str(tmp_path / name))
