# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The record of a failed calibration, and files recognised as our own until they are changed."""

import errno
import os

import pytest

from starcal_ground.products import (
    NOT_CALIBRATED_FILE,
    NotCalibrated,
    read_not_calibrated,
    same_as_one_of,
    write_not_calibrated,
)
from starcal_ground.written_files import is_marked, mark, replacing, write_marked
from starcal_ros.errors import ProductError

RECORD = NotCalibrated(
    'too few', ('a.mcap', 'b'), {'no_match': 3}, 'clock', ('seen',), ('stamp_offset_s: 3.0',), 'x',
    4, 25, {'faint': 2},
)  # fmt: skip


def test_round_trip_without_older_products(tmp_path) -> None:
    assert read_not_calibrated(tmp_path) is None
    kept = tmp_path / 'observations.mcap'
    for name in ('calibration.json', 'camera_info.yaml', 'residuals.npz', 'report.html'):
        (tmp_path / name).write_text('old')
    kept.write_text('stars')
    write_not_calibrated(RECORD, tmp_path)
    assert read_not_calibrated(tmp_path) == RECORD
    assert {path.name for path in tmp_path.iterdir()} == {NOT_CALIBRATED_FILE, kept.name}


@pytest.mark.parametrize('text', ['', '[]', '{"reason": "x"}', '{"images_refused": 3}'])
def test_damage_is_one_line(tmp_path, text) -> None:
    (tmp_path / NOT_CALIBRATED_FILE).write_text(text)
    with pytest.raises(ProductError, match='not a record of a failure: |not JSON: '):
        read_not_calibrated(tmp_path)


def test_a_file_is_recognised_by_any_name(tmp_path) -> None:
    path = tmp_path / 'a'
    path.write_text('')
    (tmp_path / 'link').symlink_to(path)
    (tmp_path / 'hard').hardlink_to(path)
    (tmp_path / 'other').write_text('')
    for name in ('a', 'link', 'hard', '../' + tmp_path.name + '/a'):
        assert same_as_one_of(tmp_path / name, [tmp_path / 'none', path])
    assert not same_as_one_of(tmp_path / 'other', [path])
    assert not same_as_one_of(tmp_path / 'none', [tmp_path / 'none'])


def test_a_file_is_known_until_it_is_changed(tmp_path) -> None:
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
    tmp_path, monkeypatch, name, change, is_known
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
