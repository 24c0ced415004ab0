# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A mission of eight calibrations, a day each."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from export_calibrations import calibration  # type: ignore[import-not-found]

from starcal_ground.products import write_products

DAY_NS = 86400 * 10**9


def write(folder: Path, day: int, **changed: object) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    stamps = {'first_image_ns': day * DAY_NS, 'time_ns': day * DAY_NS + 9}
    write_products(dataclasses.replace(calibration(), **stamps, **changed), folder)
    return folder


def make_mission(tmp_path: Path) -> Path:
    for day in range(8):
        write(tmp_path / f'mission/{day}', day)
    return tmp_path / 'mission'
