# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The table grows, survives a kill at any instant and holds each row once."""

from collections.abc import Callable
import gc
import math
import os
from pathlib import Path
import signal
import sqlite3
import subprocess
import sys
import threading
from typing import Any

from export_calibrations import calibration  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ground.mission.trend.trend_table import (
    COMPUTED,
    FAILED,
    RECORDED,
    Row,
    Table,
    TABLE_FILE,
)
from starcal_ros.errors import ProductError


def row(stamp: str, time_ns: int = 5, kind: str = RECORDED, **changed: Any) -> Row:
    made = None if kind == FAILED else calibration(with_field=True)
    given = {'temperature_degc': 21.5, 'calibration': made, **changed}
    return Row(stamp, '/some/where.json', kind, time_ns=time_ns, **given)


def failure(stamp: str, error: str) -> Row:
    return row(stamp, kind=FAILED, error=error)


def table_of(folder: Path, *rows: Row) -> Table:
    table = Table(folder)
    for one in rows:
        table.add(one)
    return table


def test_rows_come_back_to_the_last_bit_in_order_of_time(tmp_path) -> None:
    """Also where their table is dropped in another thread."""
    rows = [row('a', 3), row('b', 9), row('c', 10, temperature_degc=math.nan)]
    tables = [table_of(tmp_path, *rows[::-1])]
    thread = threading.Thread(target=tables.clear)
    thread.start()
    thread.join()
    gc.collect()
    assert str(Table(tmp_path).rows()) == str(rows)  # NaN differs from itself


ROWS = {  # what replaces what: rows that are added, stamps and cameras that are left
    'a camera has another name now': ([row('a', camera='x'), row('a', camera='y')], ['a y']),
    'another stamp': ([row('a', camera='x'), row('b', camera='x')], ['a x', 'b x']),
    'a failure is mended': ([failure('a', 'bad'), row('a')], ['a ']),
    'it fails again': ([failure('a', 'bad'), failure('a', 'worse')], ['worse ']),
}


@pytest.mark.parametrize('case', ROWS)
def test_a_row_replaces_what_it_mends(tmp_path, case) -> None:
    rows, expected = ROWS[case]
    table_of(tmp_path, *rows)
    left = Table(tmp_path).rows()
    assert [f'{one.error or one.stamp} {one.camera}' for one in left] == expected


def test_rows_come_one_camera_after_the_other(tmp_path) -> None:
    table = table_of(tmp_path, *(row(stamp, camera=stamp[0]) for stamp in ('x1', 'y1', 'x2')))
    other = table_of(tmp_path, row('y2', camera='y'))  # another run, at the same time
    for each in (table, other, Table(tmp_path)):
        stamps = [[one.stamp for one in rows] for rows in each.cameras()]
        assert stamps == [['x1', 'x2'], ['y1', 'y2']]
    assert table.names() == [('', 'x'), ('', 'y')]


OLD = 'starcal 0.0.1'
KNOWN = {  # a row, and whether its task is done with
    'recorded': (row('a', software=OLD), True),
    'computed': (row('a', kind=COMPUTED), True),
    'computed by another version': (row('a', kind=COMPUTED, software=OLD), False),
    'failed': (failure('a', 'bad'), True),
    'failed with another version': (row('a', kind=FAILED, error='bad', software=OLD), False),
    'of another stamp': (row('b'), False),
    'of another camera': (row('a', camera='x'), False),
}


@pytest.mark.parametrize('case', KNOWN)
def test_a_row_of_this_version_is_not_made_again(tmp_path, case) -> None:
    made, expected = KNOWN[case]
    table = table_of(tmp_path, made)
    assert table.has('a', '', '') is expected
    table.forget_failures(but=[made.stamp, 'none'])
    assert [one.stamp for one in table.rows()] == [made.stamp]
    table.forget_failures(but=['none'])
    assert len(table.rows()) == (not made.error)


_KILLED = """
import os, signal, sys
sys.path[:0] = sys.argv[2:]
from test_trend_table import row, Table
table = Table(sys.argv[1])
for k in range(5):
    table.add(row(str(k), k))
with table.transaction():
    table.add(row('5', 5))
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_kill_loses_no_row_that_was_added(tmp_path) -> None:
    here = Path(__file__).parent
    line = [sys.executable, '-c', _KILLED, str(tmp_path), str(here), str(here.parents[2])]
    assert subprocess.run(line).returncode == -signal.SIGKILL
    assert [one.stamp for one in Table(tmp_path).rows()] == list('01234')


def changed_by(*statements: str) -> Callable[[Path], object]:
    """Statements that another program runs on a table with a row."""

    def change(path: Path) -> None:
        path.unlink()
        table_of(path.parent, row('a'))
        other = sqlite3.connect(path)
        for statement in statements:
            other.execute(statement)
        other.commit()
        other.close()

    return change


def content(made: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(made(path.read_bytes()))


def replaced_by(make: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda path: (path.rename(path.with_suffix('.old')), make(path))


SET = 'update calibration set'
HOSTILE = {
    'binary': content(lambda _: np.random.default_rng(1).bytes(10_000)),
    'text': content(lambda _: b'key,path\n1,2\n'),
    'truncated': content(lambda sound: sound[: len(sound) // 2]),
    'torn': content(lambda sound: sound[:5000] + bytes(15_000) + sound[20_000:]),
    'another database': changed_by('drop table calibration', 'create table calibration (a)'),
    'a view': changed_by(
        'drop index of_camera',
        'create view v as with recursive n(k) as (select 1 union all select k + 1 from n) '
        'select k from n',
    ),
    'a trigger': changed_by(
        'create trigger t after insert on calibration begin delete from calibration; end'
    ),
    'no object': changed_by(f"{SET} calibration = '7'"),
    'no JSON': changed_by(f"{SET} calibration = '[1'"),
    'nested': changed_by(f"{SET} calibration = '{'[' * 100}{']' * 100}'"),
    'unknown lens': changed_by(f"{SET} calibration = json_set(calibration, '$.model', 'fish')"),
    'out of the calendar': changed_by(f'{SET} time_ns = {2**63 - 1}'),
    'long text': changed_by(f"{SET} path = '{'x' * 1_000_000}'"),
    'no text': changed_by(f"{SET} path = cast(x'fffe' as text)"),
    'a pipe': replaced_by(os.mkfifo),
    'a device': replaced_by(lambda path: path.symlink_to('/dev/zero')),
    'a link to nothing': replaced_by(lambda path: path.symlink_to('nowhere')),
    'a folder': replaced_by(Path.mkdir),
}


@pytest.mark.parametrize('kind', HOSTILE)
def test_a_damaged_table_is_named_and_left_alone(tmp_path, kind) -> None:
    table_of(tmp_path, *(row(str(k), k) for k in range(20)))
    path = tmp_path / TABLE_FILE
    HOSTILE[kind](path)
    before = path.read_bytes() if path.is_file() and not path.is_symlink() else b''
    with pytest.raises(ProductError, match=r'trend\.sqlite: ') as caught:
        Table(tmp_path).rows()
    assert len(str(caught.value)) < 300 + len(str(path)) and '\n' not in str(caught.value)
    assert before == (path.read_bytes() if before else b'')
