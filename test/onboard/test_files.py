# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The one way to write a file."""

import os
from pathlib import Path

import pytest

from starcal_ros.errors import ProductError
from starcal_ros.files import replacing
from starcal_ros.formats.products.product_files import write_atomically


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize('error', [KeyboardInterrupt, OSError, SystemExit])
def test_an_exception_leaves_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / 'a'
    path.write_text('old')

    def interrupted() -> None:
        with replacing(path) as file:
            file.write(b'new')
            raise error

    with pytest.raises(error):
        interrupted()
    assert path.read_text() == 'old' and names(tmp_path) == ['a']


def test_a_failed_write_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch) -> None:
    path = tmp_path / 'c.json'
    write_atomically(path, 'old')

    def full(_: int) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with pytest.raises(ProductError, match='No space left'):
        write_atomically(path, 'new')
    assert path.read_text() == 'old' and names(tmp_path) == ['c.json']


def test_a_link_is_replaced_and_its_target_is_not_written(tmp_path: Path) -> None:
    target, path = tmp_path / 'target', tmp_path / 'a'
    target.write_text('input')
    path.symlink_to(target)
    with replacing(path) as file:
        file.write(b'new')
    assert target.read_text() == 'input'
    assert path.read_text() == 'new' and not path.is_symlink()


def test_unfinished_files_of_ended_writers_are_removed_and_no_others(tmp_path: Path) -> None:
    path = tmp_path / 'a[1]'
    (tmp_path / '.a[1].12345678.part').write_text('of a process that was killed')
    (tmp_path / '.b.12345678.part').write_text('of another file')
    os.mkfifo(tmp_path / '.a[1].fifo.part')
    with replacing(path) as outer:
        outer.write(b'outer')
        with replacing(path) as inner:  # another writer, which lives
            inner.write(b'inner')
        assert path.read_text() == 'inner'
    assert path.read_text() == 'outer'
    assert names(tmp_path) == ['.b.12345678.part', 'a[1]']
