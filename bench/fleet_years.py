# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A simulated fleet with a bag a day of each camera.

``python -m bench.fleet_years CAMERAS DAYS [--without-page]``
A run with nothing new, and one with a new day.  The listing of the store and the calibrations are
simulated; the table on disk, its index and the page are those of `starcal trend`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
import contextlib
import dataclasses
import functools
import hashlib
from pathlib import Path
import posixpath
import re
import tempfile
import time
from unittest import mock

import numpy as np

from bench.fleet import simulated_rows, simulated_truth
from bench.table import Table
from starcal_ground.mission.trend import fleet, places, trend_page
from starcal_ground.mission.trend.fleet import Answer, Cameras, Task
from starcal_ground.mission.trend.places import Entry
from starcal_ground.mission.trend.trend_table import Row
from starcal_ground.mission.trend.trend_table import Table as Rows
from starcal_ros.constants import NANOSECONDS_PER_SECOND

_PARAMS = Path(__file__).parents[1] / 'bags/tiny/params.yaml'
_ROOT = 's3://archive/fleet'
_NAMES = Cameras(re.compile('(?P<spacecraft>[^/]+)/'), params=str(_PARAMS))
_DAY_NS = 86400 * NANOSECONDS_PER_SECOND


def run(cameras: int, days: int, with_page: bool) -> Table:
    """Processor time and peak memory of the steps of two runs over the rows of years."""
    title = f'starcal trend, {cameras} cameras, {days} days'
    made = Table(title, ('run', 'step', 'processor s', 'peak MB'))
    names, rows = [f'sat{k:04d}' for k in range(cameras)], days_of_a_camera(days + 1)
    with tempfile.TemporaryDirectory(prefix='starcal-fleet-') as folder:
        write_table(Path(folder), names, rows[:-1])
        for run, last in (('nothing new', days), ('a new day', days + 1)):
            listings = functools.partial(listings_of, names, last)
            add = functools.partial(made.add, run)
            table = Rows(folder)
            with (
                step(add, 'list, skip, add'),
                mock.patch.object(places, 'listings', listings),
                mock.patch.object(fleet, 'compute', functools.partial(answer, rows)),
            ):
                done = fleet.update(table, fleet.find(_ROOT, _NAMES))
            if with_page:
                with step(add, 'page'):
                    trend_page.write_page(table.cameras(), len(names), Path(folder), _ROOT)
            expected = fleet.Done(computed=cameras * (last - days), known=cameras * days)
            if done != expected:
                raise AssertionError(done)
        made.notes.append(f'table {table.path.stat().st_size / 1e6:.0f} MB')
        if with_page:
            page_mb = Path(folder, trend_page.TREND_FILE).stat().st_size / 1e6
            made.notes.append(f'page {page_mb:.1f} MB')
    return made


@contextlib.contextmanager
def step(add: Callable[..., None], name: str) -> Iterator[None]:
    """Add the processor time and the peak memory of a block to a table."""
    Path('/proc/self/clear_refs').write_text('5')  # the peak begins anew
    start_s = time.process_time()
    yield
    used_s = time.process_time() - start_s
    lines = Path('/proc/self/status').read_text().splitlines()
    add(name, used_s, int(next(s for s in lines if 'VmHWM' in s).split()[1]) * 1024 / 1e6)


def days_of_a_camera(count: int) -> list[Row]:
    """Rows of a camera that does not change, one a day."""
    rng = np.random.default_rng(1)
    truths = [simulated_truth(rng).of_month(0)] * count
    return [
        dataclasses.replace(
            row,
            time_ns=day * _DAY_NS + 50,
            first_ns=day * _DAY_NS,
            last_ns=day * _DAY_NS + 100,
            images=16,
            stars=3000,
            residual_rms_px=float(rng.normal(0.1, 0.01)),
            temperature_degc=float(rng.normal(20.0, 1.0)),
            camera='',
        )
        for day, row in enumerate(simulated_rows('', truths, rng))
    ]


def listings_of(names: Sequence[str], days: int, root: str) -> Iterator[list[Entry]]:
    """Lists of the files of each camera after so many days."""
    for camera in names:
        found = []
        for day in range(days):
            for file in ('bag_0.mcap', 'metadata.yaml'):
                name = f'{camera}/{day:05d}/{file}'
                etag = hashlib.md5(name.encode()).hexdigest()
                found.append(Entry(f'{root}/{name}', name, 100_000 + day, etag))
        yield found


def answer(rows: Sequence[Row], task: Task) -> Answer:
    """Row of a bag in place of its calibration."""
    row = dataclasses.replace(
        rows[int(posixpath.basename(task.url))],
        key=hashlib.sha256(task.url.encode()).hexdigest(),
        path=task.url,
        stamp=task.stamp,
        size_bytes=task.size,
        spacecraft=task.spacecraft,
    )
    return Answer(row.key, row)


def write_table(folder: Path, names: Sequence[str], rows: Sequence[Row]) -> None:
    """Write the table that runs on each of the days leave."""
    table, listings = Rows(folder), functools.partial(listings_of, names, len(rows))
    with table.transaction(), mock.patch.object(places, 'listings', listings):
        for task in fleet.find(_ROOT, _NAMES):
            row = answer(rows, task).row
            assert row
            table.add(row)


if __name__ == '__main__':
    parser = argparse.ArgumentParser(prog='python -m bench.fleet_years')
    parser.add_argument('cameras', type=int)
    parser.add_argument('days', type=int)
    parser.add_argument('--without-page', action='store_true')
    asked = parser.parse_args()
    print(run(asked.cameras, asked.days, not asked.without_page).text())
