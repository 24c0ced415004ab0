# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The record of a calibration that failed, ``not_calibrated.json``, in place of its products."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
import json
from pathlib import Path

from starcal_ros.errors import ProductError
from starcal_ros.products.calibration_json import CALIBRATION_FILE
from starcal_ros.products.camera_yaml import CAMERA_INFO_FILE
from starcal_ros.products.files import read_text, REPORT_FILE, write_atomically
from starcal_ros.products.residuals_npz import RESIDUALS_FILE
from starcal_ros.untrusted import json_value, PRODUCT_BYTES

NOT_CALIBRATED_FILE = 'not_calibrated.json'


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
    """
    Write the record of a failure and remove the products of an earlier calibration.

    Raises
    ------
    ProductError
        When the folder cannot be changed.
    """
    content = {'calibrated': False, **asdict(record)}
    write_atomically(folder / NOT_CALIBRATED_FILE, json.dumps(content, indent=1) + '\n')
    try:
        for name in (CALIBRATION_FILE, CAMERA_INFO_FILE, RESIDUALS_FILE, REPORT_FILE):
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise ProductError(f'{folder / name}: cannot be removed: {error.strerror}') from error


def read_not_calibrated(folder: Path) -> NotCalibrated | None:
    """
    The record of a failure in a folder; None: there is none.

    Raises
    ------
    ProductError
        When it cannot be read.
    """
    path = folder / NOT_CALIBRATED_FILE
    if not path.is_file():
        return None
    try:
        content = json_value(read_text(path, PRODUCT_BYTES))
        refused = {str(name): int(count) for name, count in content['images_refused'].items()}
        inputs, evidence, mend = (
            tuple(str(line) for line in content[name]) for name in ('inputs', 'evidence', 'mend')
        )
        reason, cause, software = (str(content[name]) for name in ('reason', 'cause', 'software'))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ProductError(f'{path}: not a record of a failure: {error}') from error
    return NotCalibrated(reason, inputs, refused, cause, evidence, mend, software)
