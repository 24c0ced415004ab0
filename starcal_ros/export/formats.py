# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of a calibration in a format of another tool."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import pixel_grid
from starcal_ros.errors import OptionError
from starcal_ros.export.giant import giant_json
from starcal_ros.export.losses import Fitted, fitted, Loss, temperature_losses
from starcal_ros.export.spice import spice_kernels, SpiceNames
from starcal_ros.export.yaml_formats import kalibr_yaml, opencv_yaml, transform_yaml
from starcal_ros.options import nearest
from starcal_ros.products.camera_yaml import CAMERA_INFO_FILE, write_camera_info
from starcal_ros.products.files import write_atomically
from starcal_ros.products.lookup_table import write_lookup_table
from starcal_ros.records import Calibration

FORMATS = ('spice', 'opencv', 'kalibr', 'ros', 'giant', 'csv')
CSV_POINTS = 65  # pixels a side


@dataclass(frozen=True)
class Exported:
    """
    Files written, the largest error of a pixel in them against the calibration, and its parts.

    The error is infinite where the format cannot see the whole detector.
    """

    files: tuple[Path, ...]
    worst_px: float
    losses: tuple[Loss, ...]


def export(
    calibration: Calibration, kind: str, folder: Path, names: SpiceNames | None, topic: str = ''
) -> Exported:
    """
    Write a calibration to a folder in one of `FORMATS`.

    Parameters
    ----------
    names : SpiceNames or None
        Needed for ``spice`` only.
    topic : str
        Image topic, for kalibr.

    Raises
    ------
    OptionError
        For an unknown format, or names that SPICE does not allow.
    ProductError
        When a file cannot be written.
    """
    if kind not in FORMATS:
        raise OptionError(
            f'--to: {kind!r} is not one of {", ".join(FORMATS)}{nearest(kind, FORMATS)}'
        )
    if kind == 'spice':
        if names is None:
            raise OptionError('--to spice: give the NAIF ID of the spacecraft, --spacecraft-id')
        fk, ik, losses = spice_kernels(calibration, names)
        return _written(folder, {'camera.tf': fk, 'camera.ti': ik}, 0.0, losses)
    if kind == 'csv':
        camera = calibration.geometry.camera
        table = line_of_sight_table(
            camera, calibration.map_covariance, pixel_grid(camera, CSV_POINTS, CSV_POINTS)
        )
        path = folder / 'lines_of_sight.csv'
        write_lookup_table(table, path)
        return Exported((path,), 0.0, temperature_losses(calibration))
    if kind == 'ros':
        found = fitted(calibration, calibration.geometry.camera.model, ('skew',))
        path = folder / CAMERA_INFO_FILE
        write_camera_info(calibration.geometry.camera, path, calibration.child_frame)
        written = _of_fit(folder, {'alignment.yaml': transform_yaml(calibration)}, found)
        return Exported((path, *written.files), written.worst_px, written.losses)
    if kind == 'opencv':
        text, found = opencv_yaml(calibration)
        return _of_fit(folder, {'opencv.yaml': text}, found)
    if kind == 'kalibr':
        text, found = kalibr_yaml(calibration, topic)
        return _of_fit(folder, {'camchain.yaml': text}, found)
    text, found = giant_json(calibration)
    return _of_fit(folder, {'giant_camera.json': text}, found)


def _of_fit(folder: Path, texts: dict[str, str], found: Fitted) -> Exported:
    return _written(folder, texts, found.worst_px, found.losses)


def _written(
    folder: Path, texts: dict[str, str], worst_px: float, losses: tuple[Loss, ...]
) -> Exported:
    for name, text in texts.items():
        write_atomically(folder / name, text)
    return Exported(tuple(folder / name for name in texts), worst_px, losses)
