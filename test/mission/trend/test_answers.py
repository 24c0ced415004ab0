# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibration of each bag is kept beside the table, once, and makes no row of its own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import shutil
from unittest import mock

from mission_files import TINY  # type: ignore[import-not-found]
import pytest

from starcal_ros.formats.products.calibration_json import read_calibration
from starcal_ros.mission.trend import fleet, tasks
from starcal_ros.mission.trend.answers import compute
from starcal_ros.mission.trend.rows import COMPUTED, FAILED, kept_name, Row, row_of
from starcal_ros.mission.trend.tasks import Cameras, KEPT_FOLDER, Task
from starcal_ros.mission.trend.trend_table import Table
from starcal_ros.report import page

CAMERAS = Cameras(params=str(TINY / 'params.yaml'))


@pytest.fixture
def task(tmp_path: Path) -> Task:
    """The one bag of a fleet whose folder is that of the output as well."""
    shutil.copytree(TINY, tmp_path / 'sat 1/2026-01')
    (found,) = tasks.find(str(tmp_path), CAMERAS)
    return dataclasses.replace(found, spacecraft='sat 1', camera='nav')


@pytest.mark.slow
def test_each_computed_row_has_its_calibration_after_any_kill(tmp_path: Path, task: Task) -> None:
    # The worker ends between the calibration and its row.
    assert isinstance(compute(dataclasses.replace(task, table=Table(tmp_path).folder)), Row)
    assert Table(tmp_path).rows() == [] and len(kept(tmp_path)) == 1
    found = list(tasks.find(str(tmp_path), CAMERAS))  # that calibration is no task
    assert [one.url for one in found] == [task.url]
    with Table(tmp_path) as table:
        assert fleet.update(table, [task], with_reports=True).computed == 1
    (row,) = Table(tmp_path).rows()
    names = [f'{kept_name(row)}/{name}' for name in ('calibration.json', 'report.html')]
    assert kept(tmp_path) == names
    text = (tmp_path / KEPT_FOLDER / names[1]).read_text()
    assert 'Residual' in text and '@sha256' not in text
    assert kept_name(row).startswith('spacecraft=sat 1/camera=nav/2026-01-')
    calibration = read_calibration(tmp_path / KEPT_FOLDER / names[0])
    again = row_of(calibration, row.key, row.path, COMPUTED, row.temperature_degc)
    assert (again.values, again.sigmas) == (row.values, row.sigmas)
    assert calibration.covariance.shape == (len(row.sigmas),) * 2


@pytest.mark.slow
def test_a_page_that_cannot_be_drawn_fails_its_bag_alone(tmp_path: Path, task: Task) -> None:
    table = Table(tmp_path)
    task = dataclasses.replace(task, table=table.folder, with_report=True)
    with mock.patch.object(page, '_context', side_effect=RuntimeError('no figure')):
        row = compute(task)
    assert isinstance(row, Row)
    assert row.error == f'{task.url}: the products cannot be drawn: RuntimeError: no figure'
    assert not row.is_passing and row.stamp == task.stamp


@pytest.mark.slow
def test_a_worker_that_does_not_see_the_table_keeps_nothing(tmp_path: Path, task: Task) -> None:
    table = tmp_path / 'not mounted/trend.parquet'
    row = compute(dataclasses.replace(task, table=str(table)))
    assert isinstance(row, Row) and row.is_passing and not table.parent.exists()
    assert f'{table}: cannot be written: not seen by this worker; mount it' in row.error


def test_a_name_of_a_bag_is_one_folder() -> None:
    row = Row('0' * 64, 's3://b/fleet/..', FAILED, 'bad', spacecraft='../x', camera='')
    assert kept_name(row) == f'spacecraft=..%2Fx/camera=-/..-{"0" * 16}'
    long = dataclasses.replace(row, path=f'/{"é" * 200}.mcap')
    assert max(map(len, kept_name(long).split('/'))) < 255


def kept(output: Path) -> list[str]:
    """Kept calibrations by their names."""
    folder = output / KEPT_FOLDER
    return [str(path.relative_to(folder)) for path in sorted(folder.rglob('*.*'))]
