# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A fleet of small bags by `starcal trend` on two worker processes, one killed in the run."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
import itertools
import os
from pathlib import Path
import shutil
import statistics
import tempfile
import time

import psutil  # type: ignore[import-untyped]

from bench.table import Table, verdict
from starcal_ros.mission.trend import fleet, tasks
from starcal_ros.mission.trend.tasks import Cameras, Task
from starcal_ros.mission.trend.trend_table import Table as Rows

LEAST_EFFICIENCY = 0.85
_WORKERS = 2
_TINY = Path(__file__).parents[1] / 'bags/tiny'
_PARAMS = _TINY / 'params.yaml'
_LIBRARY = b'starcal'  # in the header of the bag, which nothing reads


@dataclass
class Watch:
    """Memory of the processes at each row, MB, and the kill of one worker at a row."""

    kill_at: int
    parent_mb: list[float] = field(default_factory=list)
    worker_mb: list[float] = field(default_factory=list)
    killed: int = 0

    def on_row(self) -> None:
        """Note the memory, and kill a worker when its time has come."""
        us = psutil.Process()
        workers = [p for p in us.children() if 'starcal_ros.child_process' in p.cmdline()]
        self.parent_mb.append(us.memory_info().rss / 1e6)
        self.worker_mb.append(max(p.memory_info().rss / 1e6 for p in workers))
        if len(self.parent_mb) == self.kill_at:
            workers[0].kill()
            self.killed += 1


def run(quick: bool) -> Iterator[Table]:
    """One bag after another alone, then all on two workers."""
    count, alone = (8, 2) if quick else (500, 20)
    with tempfile.TemporaryDirectory(prefix='starcal-fleet-') as name:
        folder = Path(name)
        copy_bags(folder / 'fleet', count)
        found = list(tasks.find(str(folder / 'fleet'), Cameras(params=str(_PARAMS))))
        before = one_bag_s(found[:alone], folder / 'before')
        watch = Watch(kill_at=count // 2)
        start_s, start_processor_s = time.perf_counter(), processor_s()
        with Rows(folder / 'out') as table:
            fleet.update(table, found, _WORKERS, on_row=watch.on_row)
        wall_s = time.perf_counter() - start_s
        used_s = (processor_s() - start_processor_s) / count
        after = one_bag_s(found[-alone:], folder / 'after')
        rows = Rows(folder / 'out').rows()
    one_s, one_used_s = ((a + b) / 2 for a, b in zip(before, after, strict=True))
    efficiency = count * one_s / (_WORKERS * wall_s)
    stamps = Counter(row.stamp for row in rows)
    made = Table(f'starcal trend over {count} bags on {_WORKERS} workers', ('quantity', 'value'))
    made.add('one bag alone, before, s', before[0])
    made.add('one bag alone, after, s', after[0])
    made.add(f'{count} bags, s', wall_s)
    made.add('efficiency, wall time', efficiency)
    made.add('processor time of a bag alone, s', one_used_s)
    made.add(f'processor time of a bag of {count}, s', used_s)
    made.add('efficiency, processor time', one_used_s / used_s)
    made.add('workers killed with SIGKILL', watch.killed)
    made.add('bags lost', sum(task.stamp not in stamps for task in found))
    made.add('bags counted twice', sum(n > 1 for n in stamps.values()))
    made.add('bags failed', sum(bool(row.error) for row in rows))
    for who, values in (('this process', watch.parent_mb), ('largest worker', watch.worker_mb)):
        tenth = max(1, len(values) // 10)
        made.add(f'{who}, second tenth, MB', statistics.mean(values[tenth : 2 * tenth]))
        made.add(f'{who}, last tenth, MB', statistics.mean(values[-tenth:]))
    made.notes.append(f'efficiency {verdict(efficiency, LEAST_EFFICIENCY)}')
    yield made


def copy_bags(folder: Path, count: int) -> None:
    """Copies of the small bag, each with a digest of its own."""
    content = (_TINY / 'tiny_0.mcap').read_bytes()
    assert content[:64].count(_LIBRARY) == 1
    for k in range(count):
        bag = folder / f'{k:04d}'
        bag.mkdir(parents=True)
        shutil.copyfile(_TINY / 'metadata.yaml', bag / 'metadata.yaml')
        (bag / 'tiny_0.mcap').write_bytes(content.replace(_LIBRARY, f'{k:07d}'.encode(), 1))


def one_bag_s(found: list[Task], folder: Path) -> tuple[float, float]:
    """
    Wall and processor time of a bag on one worker.

    The wall time is the median without the first bag, before which the worker starts.
    """
    ends_s: list[float] = []
    start_s = processor_s()
    with Rows(folder) as table:
        fleet.update(table, found, 1, on_row=lambda: ends_s.append(time.perf_counter()))
    wall_s = statistics.median(b - a for a, b in itertools.pairwise(ends_s))
    return wall_s, (processor_s() - start_s) / len(found)


def processor_s() -> float:
    """Processor time of this process and of its children that have ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system
