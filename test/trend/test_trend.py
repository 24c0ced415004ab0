# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The command over a folder tree: rows, increments, workers, poison and versions."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import re
import shutil

from export_calibrations import calibration  # type: ignore[import-not-found]
from fleet_tasks import kill_on_poison, kill_once  # type: ignore[import-not-found]
from mission_files import TINY  # type: ignore[import-not-found]
import pytest

from starcal_ros.cli.main import main
from starcal_ros.products.calibration_json import write_calibration
from starcal_ros.products.folder import write_products
from starcal_ros.trend import fleet, tasks
from starcal_ros.trend.rows import COMPUTED, Row
from starcal_ros.trend.table import Table
from starcal_ros.trend.tasks import Task

DAY_NS = 86400 * 10**9


def write(folder: Path, day: int, **changed: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    stamps = {'first_image_ns': day * DAY_NS, 'time_ns': day * DAY_NS + 9}
    write_products(dataclasses.replace(calibration(), **stamps, **changed), folder)
    return folder


@pytest.fixture
def mission(tmp_path: Path) -> Path:
    for day in range(8):
        write(tmp_path / f'mission/{day}', day)
    return tmp_path / 'mission'


def trend(mission: Path, *more: str) -> int:
    return main(['trend', str(mission), '-o', str(mission.parent / 'out'), *more])


def test_copies_are_computed_once(mission: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(mission / '3', mission / 'copy/of/3')
    assert trend(mission) == 0
    said = '8 new, 0 known before, 0 failed, 1 the same as another'
    assert said in capsys.readouterr().out
    rows = Table(mission.parent / 'out').rows()
    assert len(rows) == 8 and 'copy' not in ' '.join(row.path for row in rows)


def test_only_what_is_new_is_computed(mission: Path, capsys, monkeypatch) -> None:
    assert trend(mission) == 0
    assert '8 new, 0 known before, 0 failed' in capsys.readouterr().out
    write(mission / 'later/deep', 100)
    called: list[Task] = []
    compute = tasks.compute

    def counted(task: Task) -> Row:
        called.append(task)
        return compute(task)

    monkeypatch.setattr(fleet, 'compute', counted)
    assert trend(mission) == 0
    assert '1 new, 8 known before' in capsys.readouterr().out and len(called) == 1
    page = (mission.parent / 'out/trend.html').read_text()
    assert '9 calibrations' in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # it needs no network


def test_a_copy_counts_once_and_the_tree_may_move(mission: Path, capsys) -> None:
    assert trend(mission) == 0
    capsys.readouterr()
    moved = mission.rename(mission.parent / 'elsewhere')
    shutil.copytree(moved / '1', moved / 'copy')
    assert trend(moved) == 0
    assert '0 new, 8 known before, 0 failed, 1 the same as another' in capsys.readouterr().out


def test_a_bad_calibration_costs_itself(mission: Path, capsys) -> None:
    (mission / '3/calibration.json').write_text('{"schema": 1}')
    assert trend(mission) == 0
    out = capsys.readouterr().out
    assert '7 new' in out and '1 failed' in out and 'mission/3/calibration.json' in out
    assert 'Not calibrated' in (mission.parent / 'out/trend.html').read_text()
    write_calibration(calibration(), mission / '3/calibration.json')
    assert trend(mission) == 0
    assert '1 new, 7 known before, 0 failed' in capsys.readouterr().out
    assert trend(mission, '--retry') == 0
    assert '0 new, 8 known before' in capsys.readouterr().out


def test_bags_are_calibrated_with_parameters(tmp_path: Path, capsys) -> None:
    shutil.copytree(TINY, tmp_path / 'fleet/one')
    (tmp_path / 'fleet/two').mkdir()
    (tmp_path / 'fleet/two/poison.mcap').write_bytes(b'\x89MCAP0\r\n' + bytes(1000))
    line = ['trend', str(tmp_path / 'fleet'), '-o', str(tmp_path / 'out')]
    assert main([*line, '--params', str(TINY / 'params.yaml')]) == 0
    assert '1 new, 0 known before, 1 failed' in capsys.readouterr().out
    good = [row for row in Table(tmp_path / 'out').rows() if not row.error]
    assert [row.kind for row in good] == [COMPUTED] and good[0].accepted


def test_observations_of_another_version_are_calibrated_again(tmp_path: Path, capsys) -> None:
    folder = tmp_path / 'mission/one'
    params = str(TINY / 'params.yaml')
    assert main(['calibrate', str(TINY), '--params', params, '-o', str(folder)]) == 0
    text = (folder / 'calibration.json').read_text()
    (folder / 'calibration.json').write_text(re.sub(r'"starcal [^"]*"', '"starcal 0.0.1"', text))
    capsys.readouterr()
    assert trend(tmp_path / 'mission') == 0
    assert '2 new' in capsys.readouterr().out
    page = (tmp_path / 'out/trend.html').read_text()
    assert 'The same observations with this version' in page
    # The same code again, from the observations and the options beside them.
    assert '<td class="text">starcal 0.0.1</td>' in page and '<td>0.000</td>' in page


@pytest.mark.parametrize(
    ('line', 'words'),
    [
        ('trend {t}/none -o {t}/out', 'no such folder'),
        ('trend {t} -o {t}/out', 'no calibration.json below it'),
        ('trend {t} -o {t}/out --workers -1', '--workers'),
    ],
)
def test_bad_input_is_one_line(tmp_path: Path, capsys, line: str, words: str) -> None:
    assert main(line.format(t=tmp_path).split()) == 2
    error = capsys.readouterr().err
    assert words in error and error.count('\n') == 1


@pytest.mark.slow
def test_a_bag_that_kills_its_worker_costs_itself(mission: Path, monkeypatch) -> None:
    found = [*tasks.find(mission, None), Task('poison', Path('poison'), is_bag=False)]
    monkeypatch.setattr(fleet, 'compute', kill_on_poison)
    with Table(mission.parent / 'out') as table:
        done = fleet.update(table, found, workers=2)
    assert (done.computed, done.failed) == (8, 1)
    rows = Table(mission.parent / 'out').rows()
    errors = [row.error for row in rows if row.error]
    assert len(errors) == 1 and 'ended with status -9, the last of 3 times' in errors[0]


@pytest.mark.slow
def test_a_worker_killed_in_the_run_loses_and_doubles_nothing(mission, monkeypatch) -> None:
    marker = mission.parent / 'marker'
    marker.touch()
    found = [dataclasses.replace(t, params=str(marker)) for t in tasks.find(mission, None)]
    monkeypatch.setattr(fleet, 'compute', kill_once)
    with Table(mission.parent / 'out') as table:
        done = fleet.update(table, found, workers=2)
    assert (done.computed, done.failed) == (8, 0) and not marker.exists()
    keys = [row.key for row in Table(mission.parent / 'out').rows()]
    assert sorted(keys) == sorted(task.key for task in found)
