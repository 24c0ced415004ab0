# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files that the tool recognises as its own until they are changed."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from starcal_ground.written_files import is_marked, mark, replacing, write_marked


def test_a_file_is_known_until_it_is_changed(tmp_path: Path) -> None:
    path = tmp_path / 'a'
    with replacing(path) as file:
        file.write(b'new')
    with path.open('r+b') as file:
        assert is_marked(file)
        file.write(b'N')
        file.flush()
        assert not is_marked(file)
        mark(file)
        assert is_marked(file)
    copy = tmp_path / 'b'
    copy.write_bytes(path.read_bytes())
    with copy.open('rb') as file:
        assert not is_marked(file)


@pytest.mark.parametrize(
    ('name', 'change', 'is_known'),
    [
        ('a.html', b'', True),
        ('a.json', b'', False),
        ('a.html', b'and more', False),
        ('a.html', b'\n', False),
    ],
)
def test_a_page_is_known_where_a_file_system_keeps_no_attributes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, change: bytes, is_known: bool
) -> None:
    def unsupported(*_: object) -> None:
        raise OSError(errno.ENOTSUP, 'Operation not supported')

    monkeypatch.setattr(os, 'setxattr', unsupported)
    monkeypatch.setattr(os, 'getxattr', unsupported)
    for text in ('<html></html>\n', ''):
        write_marked(tmp_path / name, text)
        with (tmp_path / name).open('r+b') as file:
            file.seek(0, os.SEEK_END)
            file.write(change)
            assert is_marked(file) is is_known
    with (tmp_path / name).open('w+b') as file:
        assert not is_marked(file)  # empty
