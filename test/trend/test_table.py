# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The table grows, survives a crash and holds each row once."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from export_calibrations import calibration  # type: ignore[import-not-found]
import pyarrow.parquet as pq
import pytest

from starcal_ros.errors import ProductError
from starcal_ros.trend import table as trend_table
from starcal_ros.trend.rows import FAILED, RECORDED, Row, row_of
from starcal_ros.trend.table import Table


def row(key: str, time_ns: int = 5) -> Row:
    made = row_of(calibration(with_field=True), key, '/some/where.json', RECORDED, 21.5)
    return dataclasses.replace(made, time_ns=time_ns)


def test_rows_come_back_to_the_last_bit_in_order_of_time(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('b', 9))
        table.add(row('a', 3))
    again = Table(tmp_path)
    assert again.rows() == [row('a', 3), row('b', 9)]
    assert 'a' in again and 'c' not in again
    # Any reader of Parquet opens the folder.
    keys = pq.read_table(tmp_path / 'trend.parquet')['key'].to_pylist()
    assert sorted(keys) == ['a', 'b']


def test_a_key_counts_once(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('a'))
        table.add(row('a'))
    (part,) = (tmp_path / 'trend.parquet').iterdir()
    # As after a crash between writing a merged file and removing its parts.
    (part.parent / 'copy.parquet').write_bytes(part.read_bytes())
    assert len(Table(tmp_path).rows()) == 1


def test_parts_are_merged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trend_table, '_MERGE', 3)
    for k in range(7):
        with Table(tmp_path) as table:
            table.add(row(str(k), k))
    assert len(list((tmp_path / 'trend.parquet').iterdir())) <= 3
    assert [one.key for one in Table(tmp_path).rows()] == list('0123456')


def test_what_was_not_flushed_is_made_again(tmp_path: Path) -> None:
    table = Table(tmp_path)
    for k in range(20):
        table.add(row(str(k), k))
    # The process ends here: a batch is on disk, the rest is not, and no file is half written.
    assert len(Table(tmp_path).rows()) == 16


def test_failures_are_forgotten_on_request(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('a'))
        table.add(Row('b', 'x', FAILED, error='bad'))
    table = Table(tmp_path)
    table.forget_failed()
    assert [one.key for one in Table(tmp_path).rows()] == ['a'] and 'b' not in table


def test_a_damaged_part_is_named(tmp_path: Path) -> None:
    with Table(tmp_path) as table:
        table.add(row('a'))
    part = next((tmp_path / 'trend.parquet').iterdir())
    part.write_bytes(part.read_bytes()[:100])
    with pytest.raises(ProductError, match=part.name):
        Table(tmp_path)
