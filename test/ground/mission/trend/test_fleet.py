# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Cameras and parameters from a pattern; the example for Kubernetes in docs/mission_trend.md."""

from __future__ import annotations

from collections.abc import Iterator
import contextlib
import os
from pathlib import Path
import re
import socket
import subprocess
import sys
from typing import Any

import pytest
from trend_rows import write  # type: ignore[import-not-found]
import yaml

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


def test_the_names_are_replaced_in_the_path_of_the_parameters(tmp_path) -> None:
    cameras = Cameras('{spacecraft}/*', str(tmp_path / '{spacecraft}.yaml'))
    assert cameras.params_of('B/y.mcap') == str(tmp_path / 'B.yaml')
    assert Cameras().params_of('x') == ''


@pytest.mark.parametrize(
    'text', ['cameras.csv', '{camera', '{other}/x', '{camera}/{camera}', '{spacecraft}/{camera}}']
)
def test_a_bad_pattern_is_one_line(text) -> None:
    with pytest.raises(StarcalError, match='not a pattern with') as caught:
        Cameras(text)
    assert '\n' not in str(caught.value)


@pytest.mark.slow
def test_two_spacecraft_with_equal_lenses_are_two_series(tmp_path) -> None:
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


_DOCUMENT = (Path(__file__).parents[4] / 'docs/mission_trend.md').read_text()
_PLACE = Path(sys.executable).parent
_START_S = 240.0


def example(language: str, word: str) -> str:
    fences = re.findall(rf'```{language}\n(.*?)```', _DOCUMENT, re.DOTALL)
    (found,) = (text for text in fences if word in text)
    return str(found)


@contextlib.contextmanager
def container(
    cluster: dict[str, Any], part: str, *more: str, **environment: str
) -> Iterator[None]:
    """The process of a container, with the variables that the operator gives it."""
    (found,) = cluster['spec'][part]['spec']['containers']
    line = [re.sub(r'\$\((\w+)\)', lambda name: environment[name[1]], a) for a in found['args']]
    process = subprocess.Popen(
        [_PLACE / line[0], *line[1:], *more],
        env={**os.environ, **environment},
        stderr=subprocess.DEVNULL,
    )
    try:
        yield
    finally:
        process.terminate()
        process.wait()


@pytest.mark.slow
def test_the_containers_of_kubernetes_find_each_other() -> None:
    from distributed import Client  # its import takes a second

    cluster = yaml.safe_load(example('yaml', 'DaskCluster'))
    with socket.create_server(('127.0.0.1', 0)) as free:
        port = free.getsockname()[1]
    address, name = f'tcp://127.0.0.1:{port}', 'starcal-default-worker-1'
    with (
        container(cluster, 'scheduler', '--port', str(port), '--dashboard-address', ':0'),
        container(cluster, 'worker', DASK_SCHEDULER_ADDRESS=address, DASK_WORKER_NAME=name),
        Client(address, timeout=_START_S) as client,
    ):
        client.wait_for_workers(1, timeout=_START_S)
        (worker,) = client.scheduler_info()['workers'].values()
        assert (worker['name'], worker['nthreads']) == (name, 1)
