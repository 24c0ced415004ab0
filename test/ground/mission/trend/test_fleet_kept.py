# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The calibration of each bag is kept beside the table, once, and makes no row of its own."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import shutil
from unittest import mock

from mission_files import TINY  # type: ignore[import-not-found]
import pytest

from starcal_ground.mission.trend import fleet
from starcal_ground.mission.trend.fleet import Answer, Cameras, KEPT_FOLDER, Task
from starcal_ground.mission.trend.trend_table import (
    COMPUTED,
    FAILED,
    failure,
    kept_name,
    Row,
    row_of,
    Table,
)
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.product_files import read_calibration

CAMERAS = Cameras(params=str(TINY / 'params.yaml'))


@pytest.fixture
def task(few_images: Path, tmp_path: Path) -> Task:
    """The one bag of a fleet whose folder is that of the output as well."""
    shutil.copytree(few_images, tmp_path / 'sat 1/2026-01')
    (found,) = fleet.find(str(tmp_path), CAMERAS)
    return dataclasses.replace(found, spacecraft='sat 1', camera='nav')


@pytest.mark.slow
def test_each_computed_row_has_its_calibration_after_any_kill(
    tmp_path: Path, task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:  # the run ends between the calibration and its row
        patch.setattr(Table, 'add', mock.Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            fleet.update(Table(tmp_path), [task])
    assert Table(tmp_path).rows() == [] and len(kept(tmp_path)) == 1
    found = list(fleet.find(str(tmp_path), CAMERAS))  # that calibration is no task
    assert [one.url for one in found] == [task.url]
    assert fleet.update(Table(tmp_path), [task]) == fleet.Done(computed=1)
    (row,) = Table(tmp_path).rows()
    name = f'{kept_name(row)}/calibration.json'
    assert kept(tmp_path) == [name]
    assert name.startswith('spacecraft=sat 1/camera=nav/2026-01-')
    calibration = read_calibration(tmp_path / KEPT_FOLDER / name)
    again = row_of(calibration, row.stamp, row.path, COMPUTED, row.temperature_degc)
    assert (again.values, again.sigmas) == (row.values, row.sigmas)
    assert calibration.covariance.shape == (len(row.sigmas),) * 2


def test_a_place_for_calibrations_that_cannot_be_written_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / KEPT_FOLDER).touch()
    bag = Answer(failure('1', '/bag', ''), '{}')
    monkeypatch.setattr(fleet, 'compute', lambda _: bag)
    with pytest.raises(ProductError, match='cannot be created'):
        fleet.update(Table(tmp_path), [Task('/bag', '1', ())])
    assert Table(tmp_path).rows() == []


def test_a_name_of_a_bag_is_one_folder() -> None:
    row = Row('0' * 64, 's3://b/fleet/..', FAILED, 'bad', spacecraft='../x', camera='')
    assert kept_name(row) == f'spacecraft=..%2Fx/camera=-/..-{"0" * 16}'
    long = dataclasses.replace(row, path=f'/{"é" * 200}.mcap')
    assert max(map(len, kept_name(long).split('/'))) < 255


def kept(output: Path) -> list[str]:
    """Kept calibrations by their names."""
    folder = output / KEPT_FOLDER
    return [str(path.relative_to(folder)) for path in sorted(folder.rglob('*.*'))]
