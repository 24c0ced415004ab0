# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tasks on processes and on a cluster: each result once, whatever ends."""

from __future__ import annotations

from collections.abc import Iterator
import os
from pathlib import Path

from distributed import LocalCluster
import psutil  # type: ignore[import-untyped]
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from starcal_ros.cli import main
from starcal_ros.mission.trend import workers

pytestmark = pytest.mark.slow

TINY = Path(__file__).parents[3] / 'bags/tiny'


@pytest.fixture
def scheduler() -> Iterator[str]:
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol='tcp://',
        host='127.0.0.1', dashboard_address=None,
        scheduler_kwargs={'dashboard_address': '127.0.0.1:0'},
    ) as cluster:  # fmt: skip
        yield str(cluster.scheduler_address)


def test_a_cluster_that_is_there_gives_the_same_results(scheduler: str) -> None:
    results = dict(workers.stream_each(int, [*'123', 'x'], scheduler=scheduler))
    assert isinstance(results.pop('x'), ValueError)
    assert results == {item: int(item) for item in '123'}


def blas_threads(_: int) -> int:
    blas = [library for library in threadpool_info() if library['user_api'] == 'blas']
    return max(int(library['num_threads']) for library in blas)


def test_a_worker_of_a_cluster_computes_on_one_thread(scheduler: str) -> None:
    """One without a nanny has those of its processors; this one is in our process."""
    with threadpool_limits(2, user_api='blas'):
        assert list(workers.stream_each(blas_threads, [0], scheduler=scheduler)) == [(0, 1)]
        assert blas_threads(0) == 2


@pytest.mark.parametrize('count', [1, 2])
def test_each_result_comes_once_whatever_workers_are_killed(count: int) -> None:
    """Idle or at work; an exception and a process that ends each time cost themselves only."""
    us = psutil.Process()
    earlier = {child.pid for child in us.children()}  # of other tests
    items, results = [*'1234', 'x', *'5678'], {}
    for item, result in workers.stream_each(int, items, workers=count):
        assert item not in results
        results[item] = result
        if len(results) < 6:
            for child in us.children():
                if child.pid not in earlier:
                    child.kill()
    assert isinstance(results.pop('x'), ValueError)
    assert results == {item: int(item) for item in items if item != 'x'}
    ended = dict(workers.stream_each(os._exit, [3, 4, 5], workers=count))
    assert all('ended with status' in str(error) for error in ended.values()) and len(ended) == 3


@pytest.mark.parametrize('count', [0, 2])
def test_items_are_taken_when_they_are_submitted(count: int) -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for k in range(100):
            taken.append(k)
            yield k

    for done, _ in enumerate(workers.stream_each(abs, items(), workers=count)):
        assert len(taken) <= done + 2 * count + 1
    assert len(taken) == 100


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['--workers', '1', '--scheduler', 'x'], 'not allowed with'),
        (['--workers', '-1'], '--workers: -1 is not within 0'),
        (['--scheduler', 'tcp://127.0.0.1:1'], '--scheduler: tcp://127.0.0.1:1: '),
        (['--scheduler', 'nonsense'], '--scheduler: nonsense: not tcp://HOST:PORT'),
        (['--scheduler', 'ucx://127.0.0.1:1'], 'ucx://127.0.0.1:1: not tcp://HOST'),
        (['--scheduler', 'inproc://1/2/3'], 'inproc://1/2/3: not tcp://HOST:PORT'),
    ],
)
def test_bad_arguments_are_one_line(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(workers, '_CONNECT_S', 0.5)
    monkeypatch.setattr(os, 'environ', dict(os.environ))
    line = ['trend', str(TINY), '-o', str(tmp_path / 'out'), '--params', str(TINY / 'params.yaml')]
    try:
        status = main.main([*line, *arguments])
    except SystemExit as error:
        status = int(error.code or 0)
    out, err = capsys.readouterr()
    assert status == 2 and out == ''
    assert err.startswith('starcal: ') and err.count('\n') == 1 and words in err
