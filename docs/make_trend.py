# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A simulated mission of five years, and its trend page: ``python -m docs.make_trend DIR``.

A calibration a month.  The temperature of the camera follows the seasons and its focal length the
temperature; the boresight drifts; a manoeuvre shakes the camera like a launch after 20 months;
another star tracker takes over after 41.  A new calibration is activated once a year.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import math
import os
from pathlib import Path
import sys

import numpy as np
import PIL.Image
from scipy.spatial.transform import Rotation

from docs.make_images import draw_page, FOLDER
from starcal_ground.cli.main import main as starcal
from starcal_ground.products import write_observations, write_products
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Inertial, Scenario, scenario
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.pipeline import solve
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.records import Calibration, CameraGeometry, Ensemble

MONTHS = 60
SIZE = (1184, 1664)  # of the picture, px
SHOCK, NEW_TRACKER = 20, 41  # the first months after them
FOCAL_PER_DEGC = 4e-5
SHOCK_FOCAL_PX, SHOCK_CX_PX = 0.35, -0.6
SHOCK_ARCSEC, TRACKER_ARCSEC = (25.0, -40.0, 60.0), (-90.0, 140.0, 35.0)
DRIFT_ARCSEC_PER_YEAR = 4.0  # about x
_MONTH_S = 365.25 * 86400 / 12
_START_NS = 1_767_225_600 * NANOSECONDS_PER_SECOND  # 2026-01-01
_IMAGES = 16


def temperature_degc(month: int) -> float:
    """Temperature of the camera: seasons."""
    return 20.0 + 8.0 * math.sin(2 * math.pi * (month + 1.5) / 12)


def truth(month: int, first: CameraGeometry) -> CameraGeometry:
    """Camera and alignment of a month."""
    shaken, changed = month >= SHOCK, month >= NEW_TRACKER
    factor = 1 + FOCAL_PER_DEGC * (temperature_degc(month) - 20.0)
    fx, _, fy, cx, _ = first.camera.intrinsics
    camera = first.camera.replace(
        fx=fx * factor + SHOCK_FOCAL_PX * shaken,
        fy=fy * factor + SHOCK_FOCAL_PX * shaken,
        cx=cx + SHOCK_CX_PX * shaken,
    )
    moved = np.array([DRIFT_ARCSEC_PER_YEAR * month / 12, 0.0, 0.0])
    moved += np.array(SHOCK_ARCSEC) * shaken + np.array(TRACKER_ARCSEC) * changed
    before = Rotation.from_quat(first.star_tracker_from_camera_xyzw)
    after = before * Rotation.from_rotvec(moved * ARCSECOND_RAD)
    return CameraGeometry(camera, after.as_quat())


def campaign(month: int, base: Scenario) -> Scenario:
    """The images of a month: sixteen star fields at random, star tracker noise of 3 arcsec."""
    rng = np.random.default_rng([18, month])
    fields = tuple(
        (rng.uniform(0, 360), math.degrees(math.asin(rng.uniform(-1, 1))), rng.uniform(0, 360))
        for _ in range(_IMAGES)
    )
    return dataclasses.replace(
        base,
        seed=1000 + month,
        truth=truth(month, base.truth),
        star_tracker_sigma_arcsec=(3.0, 3.0, 10.0),
        pointing=Inertial(fields),
        start_ns=_START_NS + round(month * _MONTH_S) * NANOSECONDS_PER_SECOND,
        image_count=_IMAGES,
        magnitude_limit=7.5,
    )


def calibrations(months: int = MONTHS) -> Iterator[tuple[Calibration, Ensemble]]:
    """One calibration a month with its observations; that of each January is activated."""
    base = scenario('small', seed=18)
    options = {'star_tracker_sigma_arcsec': [3.0, 3.0, 10.0]}
    active, number = None, 0
    for month in range(months):
        one = campaign(month, base)
        setup = load_setup(options, prior=base.prior)
        ensemble = Ensemble()
        for image in true_observations(one).images:
            warm = dataclasses.replace(image, temperature_degc=temperature_degc(month))
            ensemble = solve.add_to_ensemble(ensemble, warm, setup)
        found = solve.solve(ensemble, setup, active=active)
        if month % 12 == 0:
            number += 1
            found = dataclasses.replace(
                found, number=number, active_since_ns=found.time_ns, forced=not found.accepted
            )
            active = found
        yield found, ensemble


def write_mission(folder: Path, months: int = MONTHS) -> Path:
    """Write the calibrations of the mission, a folder for each month, with temperatures."""
    for month, (calibration, ensemble) in enumerate(calibrations(months)):
        path = folder / f'{month:02d}'
        path.mkdir(parents=True, exist_ok=True)
        write_products(calibration, path)
        write_observations(ensemble.images, path, 'camera')
    return folder


def main() -> int:
    """Write mission and page into the folder of the first argument, and draw the page."""
    folder, picture = Path(sys.argv[1]).resolve(), FOLDER.resolve() / 'trend.png'
    write_mission(folder / 'mission')
    os.chdir(folder)  # the page names the mission as it is given
    status = starcal(['trend', 'mission', '-o', '.'])
    if draw_page(folder / 'trend.html', picture, SIZE):
        with PIL.Image.open(picture) as drawn:  # lines in few colours
            drawn.convert('RGB').quantize(192).save(picture, optimize=True)
    return status


if __name__ == '__main__':
    sys.exit(main())
