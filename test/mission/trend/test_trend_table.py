# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The table grows, survives a crash and holds each row once."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path

from export_calibrations import calibration  # type: ignore[import-not-found]
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from starcal_ros.errors import ProductError
from starcal_ros.mission.trend import trend_table
from starcal_ros.mission.trend.rows import failure, RECORDED, Row, row_of
from starcal_ros.mission.trend.trend_table import Table
from starcal_ros.pipeline.provenance import software_version


def row(key: str, time_ns: int = 5) -> Row:
    made = row_of(calibration(with_field=True), key, '/some/where.json', RECORDED, 21.5)
    return dataclasses.replace(made, time_ns=time_ns)


def test_rows_come_back_to_the_last_bit_in_order_of_time(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('b', 9))
        table.add(row('a', 3))
    again = Table(tmp_path)
    assert again.rows() == [row('a', 3), row('b', 9)]
    # Any reader of Parquet opens the folder.
    keys = pq.read_table(tmp_path / 'trend.parquet')['key'].to_pylist()
    assert sorted(keys) == ['a', 'b']


def test_a_key_counts_once(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('a'))
        table.add(row('a'))
    (part,) = (tmp_path / 'trend.parquet').rglob('*.parquet')
    # As after a crash between writing a merged file and removing its parts.
    (part.parent / 'copy.parquet').write_bytes(part.read_bytes())
    assert len(Table(tmp_path).rows()) == 1


def test_parts_are_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trend_table, '_MERGE', 3)
    for k in range(7):
        with Table(tmp_path) as table:
            table.add(row(str(k), k))
    assert len(list((tmp_path / 'trend.parquet').rglob('*.parquet'))) == 1
    assert [one.key for one in Table(tmp_path).rows()] == list('0123456')


def test_a_full_file_of_a_camera_is_left_and_each_camera_is_read_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trend_table, '_FULL', 3)
    with Table(tmp_path) as table:
        for k in range(3):
            table.add(of_camera(f'x{k}', 'x'))
        table.add(of_camera('y0', 'y'))
    (full,) = tmp_path.rglob('camera=x/*.parquet')
    read: list[str] = []
    arrow = Table._arrow

    def noted(self: Table, part: str) -> pa.Table:
        read.append(part)
        return arrow(self, part)

    monkeypatch.setattr(Table, '_arrow', noted)
    with Table(tmp_path) as table:
        for name in ('x3', 'y1'):
            table.add(of_camera(name, name[0]))
    assert full.exists() and str(full) not in read
    parts = [len(list(tmp_path.rglob(f'camera={name}/*.parquet'))) for name in 'xy']
    assert parts == [2, 1]
    assert [len(rows) for rows in Table(tmp_path).cameras()] == [4, 2]
    monkeypatch.setattr(Table, '_arrow', arrow)
    table = Table(tmp_path)
    with table:
        table.add(of_camera('x0', 'z'))  # has another name now
    assert not full.exists()
    assert [len(rows) for rows in Table(tmp_path).cameras()] == [3, 2, 1]


def test_what_was_not_flushed_is_made_again(tmp_path: Path) -> None:
    table = Table(tmp_path)
    for k in range(20):
        table.add(row(str(k), k))
    # The process ends here: a batch is on disk, the rest is not, and no file is half written.
    assert len(Table(tmp_path).rows()) == 16


def test_rows_of_another_run_stay(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('a', 1))
        other = Table(tmp_path)
        other.add(row('b', 2))
        other.flush()
    assert [one.key for one in Table(tmp_path).rows()] == ['a', 'b']


def test_rows_come_one_camera_after_the_other_and_once(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(of_camera('a', 'x'))
        table.add(of_camera('b', 'y'))
    (part,) = tmp_path.rglob('camera=x/*.parquet')
    before = part.read_bytes()
    with Table(tmp_path) as table:
        table.add(of_camera('a', 'z'))  # its camera has another name now
    part.parent.mkdir(exist_ok=True)
    part.write_bytes(before)  # as after a crash before its removal
    running = Table(tmp_path)
    running.add(of_camera('c', 'y'))
    running.flush()
    again = Table(tmp_path)
    found = [[(one.key, one.camera) for one in rows] for rows in again.cameras() if rows]
    assert found == [[('b', 'y'), ('c', 'y')], [('a', 'z')]] and again.camera_count() == 2


def of_camera(key: str, camera: str) -> Row:
    return dataclasses.replace(row(key), camera=camera)


def test_failures_are_forgotten_on_request(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('a'))
        table.add(failure('b', 'x', 'bad'))
    table = Table(tmp_path)
    table.forget_failed()
    assert [one.key for one in Table(tmp_path).rows()] == ['a']


def test_failures_of_an_older_version_are_forgotten(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        for key in ('now', 'gone', 'before', 'unreached'):
            software = f'starcal {"0.0.1" if key == "before" else software_version()}'
            made = dataclasses.replace(failure(key, 'x', 'bad'), stamp=key, software=software)
            table.add(dataclasses.replace(made, is_passing=key == 'unreached'))
    table.forget_failed(but={'now', 'before', 'unreached'})
    assert [one.key for one in Table(tmp_path).rows()] == ['now']


def test_numbers_that_are_not_known_come_back(tmp_path: Path) -> None:
    """As null, and as the NaN that earlier versions wrote."""
    unknown = dataclasses.replace(row('a'), temperature_degc=math.nan, residual_rms_px=math.nan)
    with Table(tmp_path) as table:
        table.add(unknown)
    pq.write_table(
        pa.Table.from_pylist([{**dataclasses.asdict(unknown), 'key': 'b'}], trend_table.SCHEMA),
        tmp_path / 'trend.parquet/old.parquet',
    )
    for one in Table(tmp_path).rows():
        assert math.isnan(one.temperature_degc) and math.isnan(one.residual_rms_px)


def parquet(**changed: object) -> bytes:
    """A file with the row ``a``, some of its columns replaced; None: removed."""
    content = {**dataclasses.asdict(row('a')), **changed}
    content = {name: value for name, value in content.items() if value is not None}
    memory = pa.BufferOutputStream()
    pq.write_table(pa.Table.from_pylist([content]), memory)
    return bytes(memory.getvalue().to_pybytes())


def many_equal_rows() -> bytes:
    memory = pa.BufferOutputStream()
    pq.write_table(pa.table({'number': pa.array(np.zeros(2**25 + 1, np.int8))}), memory)
    return bytes(memory.getvalue().to_pybytes())


HOSTILE = {
    'empty': lambda: b'',
    'truncated': lambda: parquet()[:-100],
    'torn': lambda: parquet()[:500] + bytes(500) + parquet()[1000:],
    'binary': lambda: np.random.default_rng(1).bytes(10_000),
    'text': lambda: b'key,path\n1,2\n',
    'another table': lambda: parquet(key=None, values=None),
    'number as text': lambda: parquet(width='wide'),
    'text as number': lambda: parquet(path=5),
    'float as whole number': lambda: parquet(time_ns=0.5),
    'binary as text': lambda: parquet(software=b'\xff\xfe'),
    'null': lambda: parquet(values=[None] * 10),
    'nan': lambda: parquet(values=[math.nan] * 10),
    'too few': lambda: parquet(values=[1.0]),
    'no quaternion': lambda: parquet(star_tracker_from_camera_xyzw=[0.0] * 4),
    'huge': lambda: parquet(values=[1e300] * 10),
    'huge sigma': lambda: parquet(sigmas=[1e200] * 13),
    'negative size': lambda: parquet(width=-1),
    'out of the calendar': lambda: parquet(time_ns=2**63 - 1),
    'unknown lens': lambda: parquet(lens_model='fish'),
    'list as text': lambda: parquet(path=['a', 'b']),
    'nested': lambda: parquet(names={'a': [{'b': [['c']]}]}),
    'long text': lambda: parquet(path='x' * 10_000_000),
    'many equal rows': many_equal_rows,
}


@pytest.mark.parametrize('kind', HOSTILE)
def test_a_damaged_part_is_named(tmp_path: Path, kind: str) -> None:
    with Table(tmp_path) as table:
        table.add(row('good'))
    part = tmp_path / 'trend.parquet/part.parquet'
    part.write_bytes(HOSTILE[kind]())
    with pytest.raises(ProductError, match=r'part\.parquet: .*; remove the file') as caught:
        Table(tmp_path).rows()
    assert len(str(caught.value)) < 300 + len(str(part)) and '\n' not in str(caught.value)
    part.unlink()
    assert [one.key for one in Table(tmp_path).rows()] == ['good']


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def link_to_device(path: Path) -> None:
    path.symlink_to('/dev/zero')


def link_to_nothing(path: Path) -> None:
    path.symlink_to('nowhere')


@pytest.mark.parametrize('make', [make_pipe, link_to_device, link_to_nothing, Path.mkdir])
def test_a_part_that_is_no_file_is_named(tmp_path: Path, make) -> None:
    Table(tmp_path)
    make(tmp_path / 'trend.parquet/part.parquet')
    with pytest.raises(ProductError, match=r'part\.parquet: .*; remove the file'):
        Table(tmp_path)
