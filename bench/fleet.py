# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A fleet of small bags by `starcal trend` on two worker processes, client and a worker killed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
import dataclasses
from dataclasses import dataclass, field
import hashlib
import itertools
from pathlib import Path
import shutil
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np
import psutil  # type: ignore[import-untyped]
from scipy.spatial.transform import Rotation

from bench.table import Table, verdict
from starcal_ground.mission.trend import fleet
from starcal_ground.mission.trend.fleet import Cameras, KEPT_FOLDER, Task
from starcal_ground.mission.trend.series import SECONDS_PER_YEAR
from starcal_ground.mission.trend.trend_table import COMPUTED, kept_name, Row
from starcal_ground.mission.trend.trend_table import Table as Rows
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND

LEAST_EFFICIENCY = 0.85
MOST_MB, MOST_S = 300.0, 20.0  # of a run with nothing new: at 100,000 rows; over 10,000 keys
_WORKERS = 2
_TINY = Path(__file__).parents[1] / 'bags/tiny'
_PARAMS = _TINY / 'params.yaml'
SIGMA_CENTRE_PX, SIGMA_BORESIGHT_ARCSEC = 0.3, 0.2  # of simulated rows
_SIGMAS = np.array(
    [0.05, 0.01, 0.05, SIGMA_CENTRE_PX, SIGMA_CENTRE_PX, 1e-4, 1e-3, 3e-3, 1e-5, 1e-5]
)
_CLIENT = """
import sys
from starcal_ground.cli.main import main
main(sys.argv[1:])
with open('/proc/self/status') as file:
    print(next(line for line in file if line.startswith('VmHWM:')))
"""
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
        workers = [p for p in us.children() if 'spawn_main' in ' '.join(p.cmdline())]
        self.parent_mb.append(us.memory_info().rss / 1e6)
        self.worker_mb.append(max(p.memory_info().rss / 1e6 for p in workers))
        if len(self.parent_mb) == self.kill_at:
            workers[0].kill()
            self.killed += 1


def run(quick: bool) -> Iterator[Table]:
    """Bags that are calibrated, then runs over simulated rows with nothing new."""
    with tempfile.TemporaryDirectory(prefix='starcal-fleet-') as name:
        folder = Path(name)
        yield of_bags(folder, *((8, 2) if quick else (500, 20)))
        made = Table('starcal trend with nothing new', ('rows', 's', 'peak MB'))
        for k, cameras in enumerate((4, 10) if quick else (400, 1000)):
            each = 100 if k else 25
            made.add(each * cameras, *nothing_new(folder / f'rows{k}', cameras, each))
        made.notes.append(f'limits: {MOST_S:g} s over 10,000 keys, {MOST_MB:g} MB at 100,000 rows')
        yield made


def of_bags(folder: Path, count: int, alone: int) -> Table:
    """One bag after another alone, then all: a client that is killed, and one that goes on."""
    root, output = folder / 'fleet', folder / 'out'
    copy_bags(root, count)
    found = list(fleet.find(str(root), Cameras(params=str(_PARAMS))))
    before_s = one_bag_s(found[:alone], folder / 'before')
    watch = Watch(kill_at=count // 4)
    start_s = time.perf_counter()
    killed_client(root, output, count // 4)
    fleet.update(Rows(output), found, _WORKERS, on_row=watch.on_row)
    wall_s = time.perf_counter() - start_s
    after_s = one_bag_s(found[-alone:], folder / 'after')
    rows = Rows(output).rows()
    efficiency = count * (before_s + after_s) / 2 / (_WORKERS * wall_s)
    stamps = Counter(row.stamp for row in rows)
    values: dict[str, float] = {
        'one bag alone, before, s': before_s,
        'one bag alone, after, s': after_s,
        f'{count} bags, s': wall_s,
        'efficiency': efficiency,
        'clients killed with SIGKILL': 1,
        'workers killed with SIGKILL': watch.killed,
        'bags lost': sum(task.stamp not in stamps for task in found),
        'bags counted twice': sum(n > 1 for n in stamps.values()),
        'bags failed': sum(bool(row.error) for row in rows),
        'calibrations lost or left over': len(
            set(kept(output)) ^ {output / KEPT_FOLDER / kept_name(row) for row in rows}
        ),
    }
    for who, of_row in (('this process', watch.parent_mb), ('largest worker', watch.worker_mb)):
        tenth = max(1, len(of_row) // 10)
        values[f'{who}, second tenth, MB'] = statistics.mean(of_row[tenth : 2 * tenth])
        values[f'{who}, last tenth, MB'] = statistics.mean(of_row[-tenth:])
    title = f'starcal trend over {count} bags with {_WORKERS} workers'
    made = Table(title, ('quantity', 'value'), list(values.items()))
    made.notes.append(f'efficiency {verdict(efficiency, LEAST_EFFICIENCY)}')
    return made


def kept(output: Path) -> list[Path]:
    """Folders of kept calibrations."""
    return [path.parent for path in (output / KEPT_FOLDER).rglob('calibration.json')]


def killed_client(root: Path, output: Path, count: int) -> None:
    """Run the command, and kill it once so many calibrations are kept."""
    line = [sys.executable, '-m', 'starcal_ground.cli.main', 'trend', str(root), '-o', str(output)]
    line += ['--params', str(_PARAMS), '--workers', str(_WORKERS)]
    with subprocess.Popen(line, stdout=subprocess.DEVNULL) as client:
        while client.poll() is None and len(kept(output)) < count:
            time.sleep(0.5)
        client.kill()


def nothing_new(folder: Path, cameras: int, each: int) -> tuple[float, float]:
    """Wall time and peak memory of a client, all of whose keys are rows of its table."""
    rng = np.random.default_rng(each)
    names = [f'sat{k:04d}' for k in range(cameras)]
    for name, k in itertools.product(names, range(each)):
        path = folder / f'fleet/{name}/{k:03d}/calibration.json'
        path.parent.mkdir(parents=True)
        path.touch()
    found = fleet.find(str(folder / 'fleet'), Cameras())
    (folder / 'out').mkdir()
    table = Rows(folder / 'out')
    with table.transaction():
        for name in names:
            truth = simulated_truth(rng)
            months = [truth.of_month(month) for month in range(each)]
            for row, task in zip(simulated_rows(name, months, rng), found, strict=False):
                table.add(dataclasses.replace(row, stamp=task.stamp))
    line = [sys.executable, '-c', _CLIENT, 'trend', str(folder / 'fleet')]
    start_s = time.perf_counter()
    done = subprocess.run(
        [*line, '-o', str(folder / 'out')], check=True, capture_output=True, text=True
    )
    wall_s = time.perf_counter() - start_s
    if f'0 new, {cameras * each} known, 0 failed' not in done.stdout:
        raise AssertionError(done.stdout)
    return wall_s, int(done.stdout.split()[-2]) * 1024 / 1e6


def copy_bags(folder: Path, count: int) -> None:
    """Copies of the small bag, each with a digest of its own."""
    content = (_TINY / 'tiny_0.mcap').read_bytes()
    assert content[:64].count(_LIBRARY) == 1
    for k in range(count):
        bag = folder / f'{k:04d}'
        bag.mkdir(parents=True)
        shutil.copy(_TINY / 'metadata.yaml', bag)
        (bag / 'tiny_0.mcap').write_bytes(content.replace(_LIBRARY, f'{k:07d}'.encode(), 1))


def one_bag_s(found: list[Task], folder: Path) -> float:
    """Median wall time of a bag on one worker, without the first, before which it starts."""
    ends_s: list[float] = []
    folder.mkdir()
    fleet.update(Rows(folder), found, 1, on_row=lambda: ends_s.append(time.perf_counter()))
    return statistics.median(b - a for a, b in itertools.pairwise(ends_s))


@dataclass(frozen=True)
class Truth:
    """A simulated camera: at first, its drift, and its step after a month."""

    parameters: Floats
    alignment_arcsec: Floats
    drift_per_year: Floats = field(default_factory=lambda: np.zeros(13))
    step: Floats = field(default_factory=lambda: np.zeros(13))
    step_after: int = -1

    def of_month(self, month: int) -> Floats:
        """Parameters and alignment (arcsec) of a month."""
        start = np.concatenate([self.parameters, self.alignment_arcsec])
        is_after = 0 <= self.step_after < month
        return np.asarray(start + self.drift_per_year * month / 12 + self.step * is_after)


def simulated_truth(rng: np.random.Generator) -> Truth:
    """A camera of a fleet of one design, 20 degrees wide, as it was built."""
    mean = np.array([3641.5, 0.0, 3642.3, 651.25, 505.75, -0.051, 0.117, 0.01, 5e-4, 3e-4])
    scatter = np.array([4.0, 0.1, 4.0, 6.0, 6.0, 2e-3, 1e-2, 1e-2, 1e-4, 1e-4])
    scattered = mean + rng.normal(0, scatter)
    scattered[2] += scattered[0] - mean[0]
    return Truth(scattered, rng.normal(0, 300.0, 3))


def simulated_rows(name: str, months: list[Floats], rng: np.random.Generator) -> list[Row]:
    """
    Rows of the calibrations of a camera whose parameters and alignment each month are given.

    The errors of the principal point and of the alignment trade: together they move the boresight
    by its much smaller error.
    """
    names = CameraModel(1296, 1024, months[0][:10]).parameter_names
    px_arcsec = 1 / months[0][0] / ARCSECOND_RAD
    sigma_arcsec = np.hypot(SIGMA_CENTRE_PX * px_arcsec, SIGMA_BORESIGHT_ARCSEC)
    sigmas = (*_SIGMAS.tolist(), *(np.array([sigma_arcsec, sigma_arcsec, 3.0]) * ARCSECOND_RAD))
    rows = []
    for month, truth in enumerate(months):
        error = rng.normal(0, _SIGMAS)
        turn = rng.normal(0, (SIGMA_BORESIGHT_ARCSEC, SIGMA_BORESIGHT_ARCSEC, 3.0))
        turn += np.array([-error[4], error[3], 0.0]) * px_arcsec
        quaternion = Rotation.from_rotvec((truth[10:] + turn) * ARCSECOND_RAD).as_quat()
        first_ns = round((50 + month / 12) * SECONDS_PER_YEAR) * NANOSECONDS_PER_SECOND
        rows.append(
            Row(
                key=hashlib.sha256(f'{name} {month}'.encode()).hexdigest(),
                path=f'/fleet/{name}/{month:03d}',
                kind=COMPUTED,
                software='starcal 0',
                time_ns=first_ns + 50,
                first_ns=first_ns,
                last_ns=first_ns + 100,
                accepted=True,
                child_frame='camera',
                lens_model='plumb_bob',
                width=1296,
                height=1024,
                names=names,
                values=tuple((truth[:10] + error).tolist()),
                sigmas=tuple(map(float, sigmas)),
                star_tracker_from_camera_xyzw=tuple(quaternion.tolist()),
                boresight_sigma_arcsec=(SIGMA_BORESIGHT_ARCSEC,) * 2,
                spacecraft=name,
                camera='nav',
                stamp=f'{name} {month}',
            )
        )
    return rows
