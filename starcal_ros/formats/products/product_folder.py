# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The folder of products of a calibration, as the tool writes it, and that of a calibrator's state.

It holds ``residuals.npz`` and, in place of a calibration that failed, ``not_calibrated.json``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
import io
import json
from pathlib import Path

import numpy as np

from starcal_ros.assessment.residuals import Residuals
from starcal_ros.errors import errors_as, ProductError
from starcal_ros.formats.products.camera_yaml import (
    CAMERA_INFO_FILE,
    DEFAULT_CAMERA_NAME,
    write_camera_info,
)
from starcal_ros.formats.products.product_files import (
    CALIBRATION_FILE,
    OBSERVATIONS_FILE,
    read_json,
    REPORT_FILE,
    write_atomically,
    write_calibration,
)
from starcal_ros.record_fields import json_object, plain_record, read_record
from starcal_ros.records import Calibration, StarObservations
from starcal_ros.untrusted import read_archive

OBSERVATIONS_TOPIC = '/observations'
STATE_CALIBRATIONS, STATE_ENSEMBLE = 'calibrations', 'ensemble'  # in a state folder
RESIDUALS_FILE, NOT_CALIBRATED_FILE = 'residuals.npz', 'not_calibrated.json'
PRODUCT_FILES = (
    CALIBRATION_FILE,
    CAMERA_INFO_FILE,
    OBSERVATIONS_FILE,
    RESIDUALS_FILE,
    REPORT_FILE,
)
"""Names of the products of a calibration, without the thumbnails."""
_RESIDUALS_FORMAT = 1


def write_products(
    calibration: Calibration, folder: Path, residuals: Residuals | None = None
) -> None:
    """Write a calibration, its camera and residuals, if given; raises ProductError."""
    write_calibration(calibration, folder / CALIBRATION_FILE)
    name = calibration.provenance.get('camera_name', DEFAULT_CAMERA_NAME)
    write_camera_info(calibration.geometry.camera, folder / CAMERA_INFO_FILE, name)
    if residuals is not None:
        write_residuals(residuals, folder / RESIDUALS_FILE)
    (folder / NOT_CALIBRATED_FILE).unlink(missing_ok=True)


def write_observations(
    observations: Iterable[StarObservations], folder: Path, frame_id: str
) -> None:
    """Write the observations of a calibration with the frame of its camera; raises BagError."""
    from starcal_ros.formats.bag.writer import BagWriter  # a vehicle may not have mcap

    with BagWriter(folder / OBSERVATIONS_FILE) as writer:
        for record in observations:
            writer.write_observations(OBSERVATIONS_TOPIC, record, frame_id)


def calibration_file(path: Path) -> Path:
    """
    Path of the calibration in a folder, the last in a state folder, or the file itself.

    Raises ProductError if there is none.
    """
    if not path.is_dir():
        return path
    if (path / CALIBRATION_FILE).exists():
        return path / CALIBRATION_FILE
    activated = (path / STATE_CALIBRATIONS).glob(f'{8 * "[0-9]"}*_calibration_*.json')
    last = max(activated, key=lambda file: int(file.name.partition('_')[0]), default=None)
    if last is None:
        raise ProductError(f'{path}: the folder holds no {CALIBRATION_FILE}')
    return last


def write_residuals(residuals: Residuals, path: Path) -> None:
    """Write a NumPy archive with an array for each attribute; raises ProductError."""
    memory = io.BytesIO()
    np.savez_compressed(memory, format=_RESIDUALS_FORMAT, **plain_record(residuals))
    write_atomically(path, memory.getvalue())


def read_residuals(path: Path) -> Residuals:
    """The residuals in an archive, equal to those written; raises ProductError."""
    with errors_as(ProductError, path):
        names = ('format', *(field.name for field in fields(Residuals)))
        columns = read_archive(path, names)
    if not np.array_equal(columns.pop('format', None), _RESIDUALS_FORMAT):
        raise ProductError(f'{path}: not of format {_RESIDUALS_FORMAT}')
    with errors_as(ProductError, path):
        residuals = read_record(Residuals, columns)
    if (residuals.image >= len(residuals.image_time_ns)).any():
        raise ProductError(f'{path}: image names images that are not there')
    return residuals


@dataclass(frozen=True)
class NotCalibrated:
    """Why bags gave no calibration; ``cause`` and the rest as `starcal diagnose` has them."""

    reason: str
    inputs: tuple[str, ...]
    images_refused: Mapping[str, int]
    cause: str = ''
    evidence: tuple[str, ...] = ()
    mend: tuple[str, ...] = ()
    software: str = ''


def write_not_calibrated(record: NotCalibrated, folder: Path) -> None:
    """Write the record of a failure and remove earlier products; raises ProductError."""
    content = {'calibrated': False, **json_object(record)}
    write_atomically(folder / NOT_CALIBRATED_FILE, json.dumps(content, indent=1) + '\n')
    for name in (CALIBRATION_FILE, CAMERA_INFO_FILE, RESIDUALS_FILE, REPORT_FILE):
        with errors_as(ProductError, folder / name, 'removed'):
            (folder / name).unlink(missing_ok=True)


def read_not_calibrated(folder: Path) -> NotCalibrated | None:
    """The record of a failure in a folder; None: there is none.  Raises ProductError."""
    path = folder / NOT_CALIBRATED_FILE
    if not path.is_file():
        return None
    content = read_json(path)
    try:
        return read_record(NotCalibrated, content)
    except ValueError as error:
        raise ProductError(f'{path}: not a record of a failure: {error}') from error
