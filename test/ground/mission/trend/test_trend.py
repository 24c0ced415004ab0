# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A trend of a folder tree or a URL: rows, increments, workers, poison, versions and cameras."""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import json
import os
from pathlib import Path
import re
import shutil
import socket
import subprocess
import sys
from typing import Any

import dask
from fleet_tasks import kill_on_poison, kill_once  # type: ignore[import-not-found]
import fsspec
from mission_files import TINY  # type: ignore[import-not-found]
import pytest
from starcal_tool import assert_refused, Starcal  # type: ignore[import-not-found]
from trend_rows import write  # type: ignore[import-not-found]
import yaml

from starcal_ground.mission.trend import fleet
from starcal_ground.mission.trend.fleet import Cameras, Task
from starcal_ground.mission.trend.series import groups
from starcal_ground.mission.trend.trend_table import COMPUTED, RECORDED, Row, Table
from starcal_ros.errors import StarcalError

Trend = Callable[..., str]


@pytest.fixture
def mission(tmp_path: Path) -> Path:
    for day in range(8):
        write(tmp_path / f'mission/{day}', day)
    return tmp_path / 'mission'


@pytest.fixture
def trend(starcal: Starcal) -> Trend:
    """The output of a trend of a mission that succeeds."""

    def run(mission: Path, *more: object) -> str:
        answer = starcal('trend', mission, '-o', mission.parent / 'out', *more)
        assert answer.status == 0, answer
        return str(answer.words)

    return run


def test_only_what_is_new_is_computed(mission, trend, monkeypatch) -> None:
    out = trend(mission)
    assert '8 new, 0 known, 0 failed' in out
    assert 'plumb_bob: sound. The active calibration is the newest one. No step or drift' in out
    write(mission / 'later/deep', 100)
    called: list[Task] = []
    compute = fleet.compute

    def counted(task: Task) -> Row:
        called.append(task)
        return compute(task)

    monkeypatch.setattr(fleet, 'compute', counted)
    assert '1 new, 8 known' in trend(mission) and len(called) == 1
    page = (mission.parent / 'out/trend.html').read_text()
    assert '9 calibrations' in page
    assert not re.search(r'(src|href)="(?!data:|#)', page)  # it needs no network


def test_the_tree_may_move_and_a_copy_has_a_row(mission, trend, starcal, monkeypatch) -> None:
    monkeypatch.chdir(mission.parent)
    assert starcal('trend', 'mission', '-o', 'out').status == 0
    assert all(Path(row.path).is_absolute() for row in Table('out').rows())
    moved = mission.rename(mission.parent / 'elsewhere')
    shutil.copytree(moved / '1', moved / 'copy')
    assert '1 new, 8 known, 0 failed' in trend(moved)
    page = (mission.parent / 'out/trend.html').read_text()
    assert '9 calibrations' in page and '<p class="sub">8 calibrations' in page


@pytest.mark.slow
def test_a_bad_calibration_costs_itself_until_it_is_repaired(mission, trend) -> None:
    (mission / '3/calibration.json').write_text('{"schema": 1}')
    out = trend(mission)
    assert '7 new' in out and '1 failed' in out and 'mission/3/calibration.json' in out
    assert 'Not calibrated' in (mission.parent / 'out/trend.html').read_text()
    write(mission / '3', 3)
    out = trend(mission)
    assert '1 new, 7 known, 0 failed' in out and 'calibration.json' not in out
    assert 'Not calibrated' not in (mission.parent / 'out/trend.html').read_text()


@pytest.mark.slow
def test_a_failure_is_tried_again_with_another_camera_file(few_images, tmp_path, starcal) -> None:
    """The parameters name files that decide as well, and so does the metadata of a bag."""
    shutil.copytree(few_images, tmp_path / 'fleet/one')
    shutil.copytree(TINY, tmp_path / 'setup')
    camera, params = tmp_path / 'setup/camera.yaml', tmp_path / 'setup/params.yaml'
    good = camera.read_text()
    camera.write_text(re.sub('image_width: [0-9]+', 'image_width: 500', good))
    line = ['trend', tmp_path / 'fleet', '-o', tmp_path / 'out', '--params', params]
    for words in ('1 failed', '0 failed'):
        status, out, _ = starcal(*line)
        assert status == 3 and words in out
        assert 'The images are 640 x 512, the prior camera is of 500 x 512' in out
        assert 'fainter stars' not in out
    camera.write_text(good)
    assert '1 new, 0 known, 0 failed' in starcal(*line).out
    camera.write_text('image_width: wide')
    assert_refused(starcal(*line))


def test_a_path_that_is_not_utf_8_costs_nothing(mission, trend) -> None:
    (mission / '3').rename(os.fsdecode(os.fsencode(mission) + b'/caf\xe9'))
    bad = write(Path(os.fsdecode(os.fsencode(mission) + b'/\xff')), 9)
    (bad / 'calibration.json').write_text('')
    moved = mission.rename(os.fsdecode(os.fsencode(mission) + b'\xe9'))
    out = trend(moved)
    assert '8 new, 0 known, 1 failed' in out and '\\udcff/calibration.json' in out
    assert '0 new, 9 known, 0 failed' in trend(moved)
    named = trend(moved, '--cameras', '{spacecraft}/*')  # which names a camera
    assert '8 new, 0 known, 1 failed' in named


def test_what_is_no_file_costs_itself(mission, trend) -> None:
    made = (('pipe', 'x.mcap'), ('pipe', 'calibration.json'))
    links = ((target, 'x.mcap') for target in ('/dev/zero', '/dev/tty', 'nowhere', 'x.mcap'))
    folders = (('folder', name) for name in ('x.mcap', 'calibration.json'))
    for k, (kind, name) in enumerate((*made, *links, *folders)):
        (mission / f'odd{k}').mkdir()
        path = mission / f'odd{k}' / name
        if kind == 'pipe':
            os.mkfifo(path)
        elif kind == 'folder':
            path.mkdir()
        else:
            path.symlink_to(kind)
    out = trend(mission, '--params', TINY / 'params.yaml')
    # A folder in place of a file is one without a bag or a calibration in it.
    assert '8 new, 0 known, 6 failed' in out


@pytest.mark.slow
def test_a_link_to_no_file_costs_itself_and_not_its_bag(mission, few_images, trend) -> None:
    for k, target in enumerate(('/dev/zero', 'nowhere')):
        (mission / f'odd{k}').mkdir()
        (mission / f'odd{k}/x.mcap').symlink_to(target)
        (mission / f'odd{k}/metadata.yaml').write_text('')
        shutil.copy(few_images / 'tiny_0.mcap', mission / f'odd{k}/good.mcap')
    assert '10 new, 0 known, 0 failed' in trend(mission, '--params', TINY / 'params.yaml')


def test_a_number_that_no_page_can_show_is_left_out(mission, trend) -> None:
    path = mission / '3/calibration.json'
    wild = json.loads(path.read_text())
    wild['covariance'][0][0] = 1e300
    path.write_text(json.dumps(wild))
    assert '8 new, 0 known, 0 failed' in trend(mission)
    assert '<b>fx</b>Not tested' not in (mission.parent / 'out/trend.html').read_text()


@pytest.mark.slow
def test_a_bag_that_kills_its_worker_costs_itself(mission, monkeypatch) -> None:
    found = [Task('poison', 'poison'), *fleet.find(str(mission), Cameras())]
    monkeypatch.setattr(fleet, 'compute', kill_on_poison)
    table = Table(mission.parent)
    assert fleet.update(table, found, workers=1) == fleet.Done(computed=8, failed=1)
    errors = [row.error for row in Table(mission.parent).rows() if row.error]
    assert errors == ['ends its worker process, also alone: out of memory?']


@pytest.mark.slow
def test_a_worker_killed_in_the_run_loses_and_doubles_nothing(mission, monkeypatch) -> None:
    marker = mission.parent / 'marker'
    marker.touch()
    found = [
        dataclasses.replace(t, camera=str(marker)) for t in fleet.find(str(mission), Cameras())
    ]
    monkeypatch.setattr(fleet, 'compute', kill_once)
    done = fleet.update(Table(mission.parent), found, workers=2)
    assert done == fleet.Done(computed=8) and not marker.exists()
    stamps = [row.stamp for row in Table(mission.parent).rows()]
    assert sorted(stamps) == sorted(task.stamp for task in found)


@pytest.mark.slow
def test_a_worker_killed_while_it_starts_is_one_line_and_the_next_run_goes_on(
    mission, tmp_path, starcal, trend
) -> None:
    killing = tmp_path / 'killing.py'
    killing.write_text('import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n')
    with dask.config.set({'distributed.worker.preload': [str(killing)]}):
        answer = starcal('trend', mission, '-o', mission.parent / 'out', '--workers', 1)
    assert_refused(answer, '--workers: 1: Dask ended', 'run again')
    assert '8 new, 0 known, 0 failed' in trend(mission)


def test_a_file_that_a_worker_cannot_see_is_tried_again_by_the_next_run(mission) -> None:
    found = list(fleet.find(str(mission), Cameras()))
    away = mission.rename(mission.parent / 'unmounted')
    done = fleet.update(Table(mission.parent), found)
    assert (done.failed, len(done.unreachable), Table(mission.parent).rows()) == (8, 8, [])
    assert 'not seen by this worker; mount it' in done.unreachable[0]
    away.rename(mission)
    assert fleet.update(Table(mission.parent), found) == fleet.Done(computed=8)


@pytest.mark.slow
def test_bags_and_products_by_url(few_images, tmp_path, starcal) -> None:
    memory = fsspec.filesystem('memory')
    memory.rm('/fleet', recursive=True) if memory.exists('/fleet') else None
    memory.put(str(few_images), '/fleet/bag', recursive=True)
    write(tmp_path / 'one', 3)
    memory.put(str(tmp_path / 'one'), '/fleet/one', recursive=True)
    line = ['trend', 'memory://fleet', '--params', TINY / 'params.yaml', '-o']
    for words in ('2 new, 0 known, 0 failed', '0 new, 2 known, 0 failed'):
        status, out, _ = starcal(*line, tmp_path)
        assert status == 0 and words in out
    kinds = {row.path: row.kind for row in Table(tmp_path).rows()}
    assert kinds == {
        'memory://fleet/bag': COMPUTED,
        'memory://fleet/one/calibration.json': RECORDED,
    }
    no_folder = starcal(*line, 'memory://fleet/out')
    assert_refused(no_folder, 'results are written to a local folder, no URL')


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


def test_names_fill_the_path_of_the_parameters_and_a_bad_pattern_is_one_line() -> None:
    cameras = Cameras('{spacecraft}/*', '/a/{spacecraft}.yaml')
    assert cameras.params_of('B/y.mcap') == '/a/B.yaml'
    assert Cameras().params_of('x') == ''
    bad = ('cameras.csv', '{camera', '{other}/x', '{camera}/{camera}', '{spacecraft}/{camera}}')
    for text in bad:
        with pytest.raises(StarcalError, match='not a pattern with') as caught:
            Cameras(text)
        assert '\n' not in str(caught.value)


@pytest.mark.slow
def test_two_spacecraft_with_equal_lenses_are_two_series(tmp_path, trend) -> None:
    for day in range(4):
        for name in ('A', 'B'):
            write(tmp_path / f'fleet/{name}/nav/{day}', day, stars_used=100 + ord(name))
    trend(tmp_path / 'fleet')
    assert len(groups(Table(tmp_path / 'out').rows())) == 1
    # The names apply to what is in the table as well.
    trend(tmp_path / 'fleet', '--cameras', '{spacecraft}/{camera}/*')
    rows = Table(tmp_path / 'out').rows()
    assert {(row.spacecraft, row.camera) for row in rows} == {('A', 'nav'), ('B', 'nav')}
    assert sorted(map(len, groups(rows).values())) == [4, 4]
    page = (tmp_path / 'out/trend.html').read_text()
    assert re.findall('<h2>([AB])', page) == ['A', 'B']


_DOCUMENT = Path(__file__).parents[4] / 'docs/mission_trend.md'
_PLACE = Path(sys.executable).parent
_START_S = 240.0


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


@pytest.mark.packaging
@pytest.mark.slow
def test_the_containers_of_kubernetes_find_each_other() -> None:
    from distributed import Client  # its import takes a second

    fences = re.findall(r'```yaml\n(.*?)```', _DOCUMENT.read_text(), re.DOTALL)
    (cluster,) = (yaml.safe_load(text) for text in fences if 'DaskCluster' in text)
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
