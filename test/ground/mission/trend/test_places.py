# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files by path and by URL, their identities, and failures that pass."""

from __future__ import annotations

from pathlib import Path
import shutil

import fsspec
from mission_files import TINY  # type: ignore[import-not-found]
import pytest
from trend_missions import make_mission, trend, write  # type: ignore[import-not-found]

from starcal_ground.cli.main import main
from starcal_ground.mission.trend import fleet
from starcal_ground.mission.trend.fleet import Cameras
from starcal_ground.mission.trend.trend_table import Table


@pytest.fixture
def mission(tmp_path: Path) -> Path:
    path: Path = make_mission(tmp_path)
    return path


def test_a_second_run_reads_no_file(mission: Path, monkeypatch, capsys) -> None:
    shutil.copytree(mission / '1', mission / 'copy')
    assert trend(mission) == 0
    capsys.readouterr()

    def unread(*_: object) -> None:
        raise AssertionError('a file is read')

    monkeypatch.setattr(fleet, 'compute', unread)
    assert trend(mission) == 0
    assert '0 new, 9 known, 0 failed' in capsys.readouterr().out


def test_a_file_that_a_worker_cannot_see_is_tried_again_by_the_next_run(mission: Path) -> None:
    found = list(fleet.find(str(mission), Cameras()))
    away = mission.rename(mission.parent / 'unmounted')
    done = fleet.update(Table(mission.parent), found)
    assert (done.failed, len(done.unreachable), Table(mission.parent).rows()) == (8, 8, [])
    assert 'not seen by this worker; mount it' in done.unreachable[0]
    away.rename(mission)
    assert fleet.update(Table(mission.parent), found) == fleet.Done(computed=8)


def test_relative_paths_are_made_absolute(mission: Path, monkeypatch) -> None:
    monkeypatch.chdir(mission.parent)
    assert main(['trend', 'mission', '-o', 'out']) == 0
    assert all(Path(row.path).is_absolute() for row in Table('out').rows())


@pytest.mark.slow
def test_bags_and_products_by_url(few_images: Path, tmp_path: Path, capsys) -> None:
    memory = fsspec.filesystem('memory')
    memory.rm('/fleet', recursive=True) if memory.exists('/fleet') else None
    memory.put(str(few_images), '/fleet/bag', recursive=True)
    write(tmp_path / 'one', 3)
    memory.put(str(tmp_path / 'one'), '/fleet/one', recursive=True)
    line = ['trend', 'memory://fleet', '-o', str(tmp_path)]
    line += ['--params', str(TINY / 'params.yaml')]
    assert main(line) == 0
    assert '2 new, 0 known, 0 failed' in capsys.readouterr().out
    assert main(line) == 0
    assert '0 new, 2 known, 0 failed' in capsys.readouterr().out
    paths = sorted(row.path for row in Table(tmp_path).rows())
    assert paths == ['memory://fleet/bag', 'memory://fleet/one/calibration.json']
    assert main([*line[:3], 'memory://fleet/out']) == 2
    assert 'results are written to a local folder, no URL' in capsys.readouterr().err


def test_an_unknown_protocol_is_one_line(tmp_path: Path, capsys) -> None:
    assert main(['trend', 'nowhere://fleet', '-o', str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert 'nowhere' in error and error.count('\n') == 1
