"""
The folder of products of a calibration, as the tool and the calibrator write it.

``products/files.py`` and the modules of the single files describe what is in it.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from starcal_ros.assessment.residuals import Residuals
from starcal_ros.bag.writer import BagWriter
from starcal_ros.errors import ProductError
from starcal_ros.products.calibration_json import CALIBRATION_FILE, write_calibration
from starcal_ros.products.camera_yaml import CAMERA_INFO_FILE, write_camera_info
from starcal_ros.products.files import OBSERVATIONS_FILE
from starcal_ros.products.residuals_npz import RESIDUALS_FILE, write_residuals
from starcal_ros.records import Calibration, StarObservations

OBSERVATIONS_TOPIC = '/observations'


def write_products(
    calibration: Calibration, folder: Path, residuals: Residuals | None = None
) -> None:
    """
    Write a calibration, its camera and, where given, its residuals into a folder.

    Raises
    ------
    ProductError
        When a file cannot be written.
    """
    write_calibration(calibration, folder / CALIBRATION_FILE)
    write_camera_info(calibration.geometry.camera, folder / CAMERA_INFO_FILE)
    if residuals is not None:
        write_residuals(residuals, folder / RESIDUALS_FILE)


def write_observations(
    observations: Iterable[StarObservations], folder: Path, frame_id: str
) -> None:
    """
    Write the observations of a calibration into a folder; ``frame_id`` is the camera's.

    Raises
    ------
    BagError
        When the file cannot be written.
    """
    with BagWriter(folder / OBSERVATIONS_FILE) as writer:
        for record in observations:
            writer.write_observations(OBSERVATIONS_TOPIC, record, frame_id)


def calibration_file(path: Path) -> Path:
    """
    Path of the calibration in a folder, or of the file itself.

    Raises
    ------
    ProductError
        When the folder holds none.
    """
    if not path.is_dir():
        return path
    if not (path / CALIBRATION_FILE).exists():
        raise ProductError(f'{path}: the folder holds no {CALIBRATION_FILE}')
    return path / CALIBRATION_FILE
