# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Spacecraft, camera and parameters from a pattern."""

from __future__ import annotations

from pathlib import Path
import re

import pytest
from trend_missions import write  # type: ignore[import-not-found]

from starcal_ground.cli.main import main
from starcal_ground.mission.trend.fleet import Cameras
from starcal_ground.mission.trend.series import groups
from starcal_ground.mission.trend.trend_table import Table
from starcal_ros.errors import StarcalError


@pytest.mark.parametrize(
    ('pattern', 'name', 'expected'),
    [
        ('{spacecraft}/{camera}/*.mcap', 'A/nav/bag.mcap', ('A', 'nav')),
        ('{spacecraft}/{camera}/*.mcap', 'A/nav/2026/calibration.json', ('A', 'nav')),
        ('{spacecraft}/{camera}/*.mcap', 'A/bag.mcap', ('A', 'bag.mcap')),
        ('{spacecraft}/{camera}/*.mcap', 'bag.mcap', ('', '')),
        ('data/{spacecraft}_{camera}.*', 'data/A_nav.mcap', ('A', 'nav')),
        ('*/{camera}', '2026/nav', ('', 'nav')),
        ('', 'A/nav/bag.mcap', ('', '')),
    ],
)
def test_a_pattern_names_spacecraft_and_camera(pattern, name, expected) -> None:
    assert Cameras(pattern).of(name) == dict(zip(('spacecraft', 'camera'), expected, strict=True))


def test_the_names_are_replaced_in_the_path_of_the_parameters(tmp_path: Path) -> None:
    cameras = Cameras('{spacecraft}/*', str(tmp_path / '{spacecraft}.yaml'))
    assert cameras.params_of('B/y.mcap') == str(tmp_path / 'B.yaml')
    assert Cameras().params_of('x') == ''


@pytest.mark.parametrize(
    'text', ['cameras.csv', '{camera', '{other}/x', '{camera}/{camera}', '{spacecraft}/{camera}}']
)
def test_a_bad_pattern_is_one_line(text: str) -> None:
    with pytest.raises(StarcalError, match='not a pattern with') as caught:
        Cameras(text)
    assert '\n' not in str(caught.value)


@pytest.mark.slow
def test_two_spacecraft_with_equal_lenses_are_two_series(tmp_path: Path) -> None:
    for day in range(4):
        for name in ('A', 'B'):
            write(tmp_path / f'fleet/{name}/nav/{day}', day, stars_used=100 + ord(name))
    line = ['trend', str(tmp_path / 'fleet'), '-o', str(tmp_path / 'out')]
    assert main(line) == 0
    assert len(groups(Table(tmp_path / 'out').rows())) == 1
    # The names apply to what is in the table as well.
    assert main([*line, '--cameras', '{spacecraft}/{camera}/*']) == 0
    rows = Table(tmp_path / 'out').rows()
    assert {(row.spacecraft, row.camera) for row in rows} == {('A', 'nav'), ('B', 'nav')}
    assert sorted(map(len, groups(rows).values())) == [4, 4]
    page = (tmp_path / 'out/trend.html').read_text()
    assert re.findall('<h2>([AB])', page) == ['A', 'B']
