# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal trend` over the simulated calibrations of a fleet, all of which its table has."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from dataclasses import dataclass, field
import itertools
from pathlib import Path
import subprocess
import sys
import tempfile
import time

import numpy as np
from scipy.spatial.transform import Rotation

from bench.table import Table
from starcal_ground.mission.trend import fleet
from starcal_ground.mission.trend.fleet import Cameras
from starcal_ground.mission.trend.trend_table import RECORDED, Row
from starcal_ground.mission.trend.trend_table import Table as Rows
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SECONDS_PER_YEAR
from starcal_ros.records import Calibration, CameraGeometry

MOST_MB, MOST_S = 300.0, 20.0  # at 100,000 rows; over 10,000
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


def run(quick: bool) -> Iterator[Table]:
    """Runs over simulated rows with nothing new."""
    with tempfile.TemporaryDirectory(prefix='starcal-fleet-') as folder:
        made = Table('starcal trend with nothing new', ('rows', 's', 'peak MB'))
        for k, cameras in enumerate((4, 10) if quick else (400, 1000)):
            each = 100 if k else 25
            made.add(each * cameras, *nothing_new(Path(folder, f'rows{k}'), cameras, each))
        made.notes.append(f'limits: {MOST_S:g} s over 10,000 rows, {MOST_MB:g} MB at 100,000 rows')
        yield made


def nothing_new(folder: Path, cameras: int, each: int) -> tuple[float, float]:
    """Wall time and peak memory of a client, all of whose files have a row in its table."""
    rng = np.random.default_rng(each)
    names = [f'sat{k:04d}' for k in range(cameras)]
    for name, k in itertools.product(names, range(each)):
        path = folder / f'fleet/{name}/nav/{k:03d}/calibration.json'
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
        [*line, '-o', str(folder / 'out'), '--cameras', '{spacecraft}/{camera}/*'],
        check=True,
        capture_output=True,
        text=True,
    )
    wall_s = time.perf_counter() - start_s
    if f'0 new, {cameras * each} known, 0 failed' not in done.stdout:
        raise AssertionError(done.stdout)
    return wall_s, int(done.stdout.split()[-2]) * 1024 / 1e6


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
    px_rad = 1 / months[0][0]
    own_rad = np.array([SIGMA_BORESIGHT_ARCSEC, SIGMA_BORESIGHT_ARCSEC, 3.0]) * ARCSECOND_RAD
    from_errors = np.zeros((13, 13))  # parameters and alignment by independent errors
    from_errors[:10, :10] = np.diag(_SIGMAS)
    from_errors[10:, 10:] = np.diag(own_rad)
    from_errors[10, 4], from_errors[11, 3] = -px_rad * _SIGMAS[4], px_rad * _SIGMAS[3]
    rows = []
    for month, truth in enumerate(months):
        error = from_errors @ rng.normal(size=13)
        turn_rad = truth[10:] * ARCSECOND_RAD + error[10:]
        camera = CameraModel(1296, 1024, truth[:10] + error[:10], 'plumb_bob')
        first_ns = round((50 + month / 12) * SECONDS_PER_YEAR) * NANOSECONDS_PER_SECOND
        calibration = dataclasses.replace(
            _SAMPLE,
            time_ns=first_ns + 100,
            first_image_ns=first_ns,
            geometry=CameraGeometry(camera, Rotation.from_rotvec(turn_rad).as_quat()),
            covariance=from_errors @ from_errors.T,
        )
        row = Row(f'{name} {month}', f'/fleet/{name}/{month:03d}', RECORDED, name, 'nav')
        rows.append(dataclasses.replace(row, time_ns=first_ns + 50, calibration=calibration))
    return rows


_SAMPLE = Calibration(
    time_ns=0,
    geometry=CameraGeometry(CameraModel(1296, 1024, np.ones(10)), np.array([0.0, 0.0, 0.0, 1.0])),
    covariance=np.zeros((13, 13)),
    method='hierarchical',
    estimated=(),
    residual_rms_px=0.1,
    variance_factor=1.0,
    images_used=16,
    images_refused={},
    stars_used=500,
    stars_rejected=0,
    alignment_scatter_arcsec=0.0,
    star_tracker_sigma_arcsec=(3.0, 3.0, 10.0),
    centroid_scale=1.0,
    centroid_floor_px=0.0,
    dropped_catalog_ids=(),
    misfit_images_ns=(),
    singular_values=(),
    weakest_direction='',
    zero_skew_cost_px=0.0,
    iterations=1,
    termination='',
    accepted=True,
    reasons=(),
    parent_frame='star_tracker',
    child_frame='camera',
    provenance={},
)
