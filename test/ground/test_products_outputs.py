# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files that a command may write."""

from __future__ import annotations

from pathlib import Path

from starcal_ground.products import same_as_one_of


def test_a_file_is_recognised_by_any_name(tmp_path: Path) -> None:
    path = tmp_path / 'a'
    path.write_text('')
    (tmp_path / 'link').symlink_to(path)
    (tmp_path / 'hard').hardlink_to(path)
    (tmp_path / 'other').write_text('')
    for name in ('a', 'link', 'hard', '../' + tmp_path.name + '/a'):
        assert same_as_one_of(tmp_path / name, [tmp_path / 'none', path])
    assert not same_as_one_of(tmp_path / 'other', [path])
    assert not same_as_one_of(tmp_path / 'none', [tmp_path / 'none'])
