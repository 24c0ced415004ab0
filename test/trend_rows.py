# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rows of a trend whose differences are known, and a mission of eight calibrations, a day each."""

import dataclasses
from pathlib import Path

from export_calibrations import calibration  # type: ignore[import-not-found]
from geometries import turned  # type: ignore[import-not-found]
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.mission.trend.fleet import row_of, Task
from starcal_ground.mission.trend.trend_table import RECORDED, Row
from starcal_ground.products import write_products
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.records import Calibration

DAY_NS = 86400 * 10**9


def made(day: int, rotation_arcsec: tuple[float, ...] = (0, 0, 0), **changed: object) -> Row:
    """Row of a day, its camera turned by a rotation about its axes."""
    one: Calibration = calibration()
    turn = Rotation.from_rotvec(np.array(rotation_arcsec) * ARCSECOND_RAD)
    stamps = {'first_image_ns': day * DAY_NS, 'time_ns': day * DAY_NS + 100}
    one = dataclasses.replace(one, geometry=turned(one.geometry, turn), **stamps, **changed)  # type: ignore[arg-type]
    return row_of(Task(f'/{day}', str(day)), RECORDED, one)


def write(folder: Path, day: int, **changed: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    stamps = {'first_image_ns': day * DAY_NS, 'time_ns': day * DAY_NS + 9}
    write_products(dataclasses.replace(calibration(), **stamps, **changed), folder)
    return folder
