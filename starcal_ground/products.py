# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The folder of products of a calibration, as the tool writes it, and places that may be written to.

The folder holds ``residuals.npz`` and, in place of a calibration that failed,
``not_calibrated.json``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
import contextlib
from dataclasses import dataclass, field, fields, replace
import hashlib
import io
import json
import os
from pathlib import Path
from types import MappingProxyType
import zipfile

import numpy as np
import yaml

from starcal_ground import written_files
from starcal_ground.bags import rosbag2
from starcal_ground.bags.reader import OF_THE_STARS
from starcal_ground.residuals import Residuals
from starcal_ground.written_files import is_marked
from starcal_ros import record_fields, untrusted
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, check_plausible
from starcal_ros.errors import errors_as, OptionError, ProductError
from starcal_ros.formats.messages.record_messages import camera_info_fields
from starcal_ros.formats.products import camera_yaml, product_files
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    check_drawable,
    FOUND,
    PIXELS_OF,
    StarObservations,
)

OBSERVATIONS_TOPIC = '/observations'
CAMERA_INFO_FILE = 'camera_info.yaml'
OBSERVATIONS_FILE, REPORT_FILE = 'observations.mcap', 'report.html'
RESIDUALS_FILE, NOT_CALIBRATED_FILE = 'residuals.npz', 'not_calibrated.json'
PRODUCT_FILES = (
    product_files.CALIBRATION_FILE,
    CAMERA_INFO_FILE,
    RESIDUALS_FILE,
    OBSERVATIONS_FILE,
    REPORT_FILE,
)
"""Names of the products of a calibration, without the thumbnails."""
_RESIDUALS_FORMAT = 1


def write_products(
    calibration: Calibration, folder: Path, residuals: Residuals | None = None
) -> None:
    """Write a calibration, its camera and residuals, if given; raises ProductError."""
    written_files.write_calibration(calibration, folder / product_files.CALIBRATION_FILE)
    name = calibration.provenance.get('camera_name', camera_yaml.DEFAULT_CAMERA_NAME)
    pixels_of = calibration.provenance.get(PIXELS_OF, '')
    write_camera_info(calibration.geometry.camera, folder / CAMERA_INFO_FILE, name, pixels_of)
    if residuals is not None:
        write_residuals(residuals, folder / RESIDUALS_FILE)
    (folder / NOT_CALIBRATED_FILE).unlink(missing_ok=True)


def write_camera_info(
    camera: CameraModel,
    path: Path,
    camera_name: str = camera_yaml.DEFAULT_CAMERA_NAME,
    pixels_of: str = '',
) -> None:
    """
    Write `camera_info_text`; raises ProductError when the file cannot be written.

    ``pixels_of`` says which pixels of image files are those of the camera, as a comment.
    """
    comment = f'# {PIXELS_OF}: {pixels_of}\n' if pixels_of else ''
    written_files.write_marked(path, comment + camera_info_text(camera, camera_name))


def camera_info_text(camera: CameraModel, camera_name: str) -> str:
    """
    ROS camera YAML as camera_info_manager reads it: the best camera without skew.

    Readers of ``CameraInfo`` ignore K[0,1] without a word, so it is 0 and the other parameters
    make up for it as well as they can (`CameraModel.ros_fit`).
    """
    info = camera_info_fields(camera)
    content = {
        'image_width': info['width'],
        'image_height': info['height'],
        'camera_name': camera_name,
        'camera_matrix': _matrix(3, info['k']),
        'distortion_model': info['distortion_model'],
        'distortion_coefficients': _matrix(1, info['d']),
        'rectification_matrix': _matrix(3, info['r']),
        'projection_matrix': _matrix(3, info['p']),
    }
    return yaml_text(content)


def yaml_text(content: object) -> str:
    """YAML of an object in its order, each list of numbers in one line."""
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=10_000)
    return text


def _matrix(rows: int, values: Floats) -> dict[str, object]:
    return {'rows': rows, 'cols': len(values) // rows, 'data': values.tolist()}


def write_observations(
    observations: Iterable[StarObservations],
    folder: Path,
    frame_id: str,
    has_tracker: bool = True,
    origin: Mapping[str, str] = MappingProxyType({}),
) -> None:
    """
    Write the observations of a calibration with the frame of its camera; raises BagError.

    Without a star tracker, the attitudes are those of the stars.  ``origin`` is the metadata of
    `BagWriter`.
    Where rosbag2 reads the bags, the wheel that writes them is absent: a warning says so.
    """
    path = folder / OBSERVATIONS_FILE
    if rosbag2.READS_BAGS:
        path.unlink(missing_ok=True)  # one that is there is of the products that are replaced
        from starcal_ground.bags.reader import log_damage

        log_damage(f'{path} is not written: mcap or rosbags is not installed: {rosbag2.INSTALL}')
        return
    from starcal_ground.bag_writer import BagWriter  # mcap is not needed for more

    with BagWriter(path, origin) as writer:
        for record in observations:
            if not has_tracker:
                record = replace(record, star_tracker=OF_THE_STARS)
            writer.write_observations(OBSERVATIONS_TOPIC, record, frame_id)


def write_residuals(residuals: Residuals, path: Path) -> None:
    """Write a NumPy archive with an array for each attribute; raises ProductError."""
    memory = io.BytesIO()
    columns = {'format': _RESIDUALS_FORMAT, **record_fields.plain_record(residuals)}
    # As `np.savez_compressed`, in a tenth of the time for 11 % more bytes: pixels and covariances
    # are noise, which hardly deflates.
    with zipfile.ZipFile(memory, 'w') as archive:
        for name, column in columns.items():
            kind = zipfile.ZIP_DEFLATED if np.ndim(column) < 2 else zipfile.ZIP_STORED
            np.save(file := io.BytesIO(), column, allow_pickle=False)
            # A name alone would get the time of the clock: each run writes the same bytes.
            archive.writestr(zipfile.ZipInfo(f'{name}.npy'), file.getvalue(), kind, 1)
    written_files.write_marked(path, memory.getvalue())


def read_residuals(path: Path) -> Residuals:
    """
    The residuals in an archive, equal to those written; raises ProductError.

    >>> from pathlib import Path
    >>> import starcal_ground
    >>> residuals = starcal_ground.read_residuals(Path('out/residuals.npz'))
    >>> residuals.residual_px.shape, int(residuals.used.sum())  # measured minus predicted
    ((2996, 2), 2996)
    """
    with errors_as(ProductError, path):
        names = ('format', *(field.name for field in fields(Residuals)))
        columns = untrusted.read_archive(path, names)
    if not np.array_equal(columns.pop('format', None), _RESIDUALS_FORMAT):
        raise ProductError(f'{path}: not of format {_RESIDUALS_FORMAT}')
    with errors_as(ProductError, path):
        residuals = record_fields.read_record(Residuals, columns)
    if (residuals.image >= len(residuals.image_time_ns)).any():
        raise ProductError(f'{path}: image names images that are not there')
    return residuals


@dataclass(frozen=True)
class NotCalibrated:
    """
    Why bags gave no calibration; ``cause`` and the rest as `starcal diagnose` has them.

    The counts are those of a calibration; ``images_used`` is None if no star was measured.
    """

    reason: str
    inputs: tuple[str, ...]
    images_refused: Mapping[str, int]
    cause: str = ''
    evidence: tuple[str, ...] = ()
    mend: tuple[str, ...] = ()
    software: str = ''
    images_used: int | None = None
    stars_used: int = 0
    stars_refused: Mapping[str, int] = field(default_factory=dict)

    @property
    def counts(self) -> tuple[str, ...]:
        """Images and stars, used and refused, as of a calibration; empty if none was measured."""
        if self.images_used is None:
            return ()
        return (
            f'images: {self.images_used} used, refused: {reasons_in_words(self.images_refused)}',
            f'stars: {self.stars_used} used, refused: {reasons_in_words(self.stars_refused)}',
        )


def refused_stars(observations: Iterable[StarObservations]) -> dict[str, int]:
    """Refused stars of images by their reason, the most frequent first."""
    counts: Counter[str] = Counter()
    for one in observations:
        counts.update(one.refused_stars)
    return {reason: count for reason, count in counts.most_common() if count}


def reasons_in_words(refused: Mapping[str, int]) -> str:
    """Numbers that are refused by their reason, in words."""
    return ', '.join(f'{count} {reason}' for reason, count in refused.items()) or 'none'


def write_not_calibrated(record: NotCalibrated, folder: Path) -> None:
    """Write the record of a failure and remove earlier products; raises ProductError."""
    content = {'calibrated': False, **record_fields.json_object(record)}
    written_files.write_marked(folder / NOT_CALIBRATED_FILE, json.dumps(content, indent=1) + '\n')
    for name in (product_files.CALIBRATION_FILE, CAMERA_INFO_FILE, RESIDUALS_FILE, REPORT_FILE):
        with errors_as(ProductError, folder / name, 'removed'):
            (folder / name).unlink(missing_ok=True)


def read_not_calibrated(folder: Path) -> NotCalibrated | None:
    """The record of a failure in a folder; None: there is none.  Raises ProductError."""
    path = folder / NOT_CALIBRATED_FILE
    if not path.is_file():
        return None
    content = product_files.read_json(path)
    try:
        return record_fields.read_record(NotCalibrated, content)
    except ValueError as error:
        raise ProductError(f'{path}: not a record of a failure: {error}') from error


def has_stated_prior(calibration: Calibration) -> bool:
    """False where nobody stated a camera: the prior is a first solution from the same images."""
    return 'camera' not in calibration.provenance.get(FOUND, '')


def prior_of(calibration: Calibration) -> CameraGeometry | None:
    """Camera and alignment stated before a calibration, of its model; None if not recorded."""
    if not has_stated_prior(calibration):
        return None
    camera = calibration.geometry.camera
    count = len(camera.parameters)
    try:
        numbers = np.array(untrusted.json_value(calibration.provenance['prior']), np.float64)
        if numbers.shape != (count + 4,):
            return None
        camera = replace(camera, parameters=numbers[:count], field=None)
        check_plausible(camera)
        prior = CameraGeometry(camera, numbers[count:])
        check_drawable(prior)
        return prior
    except (KeyError, ValueError, TypeError, OverflowError):
        return None


def make_folder(path: Path) -> None:
    """Make a folder and those above it where they are not there; raises ProductError."""
    with errors_as(ProductError, path, 'created'):
        path.mkdir(parents=True, exist_ok=True)


def check_outputs(outputs: Iterable[Path], inputs: Iterable[Path] = ()) -> None:
    """
    Check that a command may write its files: none is an input, and each is new or was its own.

    Its own is a file that starcal wrote and nothing changed since.  Raises ProductError naming the
    first file that would be replaced and the remedy.
    """
    inputs = tuple(inputs)
    for path in outputs:
        if same_as_one_of(path, inputs):
            raise ProductError(
                f'{path}: is an input of this command and would be replaced; choose another '
                'place (-o)'
            )
        if os.path.isdir(path):
            raise ProductError(f'{path}: is a folder, where a file is written; give another name')
        if os.path.lexists(path) and not _is_own(path):
            raise ProductError(
                f'{path}: was not written by starcal, or was changed or copied since (or its file'
                ' system keeps no extended attributes): give another name or remove it'
            )


def check_maker(bag: Path, record: Path) -> None:
    """
    Check that a bag is new, or was made by the command that keeps such a record beside it.

    Raises ProductError naming the bag: replaced, it would not be that of the files beside it.
    """
    if os.path.lexists(bag) and not os.path.lexists(record):
        raise ProductError(
            f'{bag}: was made by another command, without {record.name}: give another name or'
            ' remove its folder'
        )


def _is_own(path: Path) -> bool:
    with contextlib.suppress(OSError, ValueError), untrusted.regular_file(path, False) as file:
        return is_marked(file)
    return False


def same_as_one_of(path: Path, others: Iterable[Path]) -> bool:
    """True if a path names the same file, by whatever name, as one of the others."""
    try:
        own = path.stat()
    except OSError:
        return False  # there is no such file
    for other in others:
        with contextlib.suppress(OSError):
            if os.path.samestat(own, other.stat()):
                return True
    return False


def inputs_of(
    files: Iterable[Path], is_stopped: Callable[[], bool] = lambda: False
) -> dict[str, str]:
    """
    SHA-256 of the files that a calibration is made from, by their paths.

    ``is_stopped`` is polled between blocks of 1 MB, so that another thread can stop it early; the
    digests are then invalid.
    """
    digests = {}
    for path in files:
        digest = hashlib.sha256()
        with errors_as(OptionError, path), untrusted.regular_file(path) as file:
            while not is_stopped() and (block := file.read(1 << 20)):
                digest.update(block)
        digests[input_name(path)] = f'sha256:{digest.hexdigest()}'
    return digests


def input_name(path: Path) -> str:
    """Name of an input file in a provenance, in Unicode whatever its bytes are."""
    # Bytes that are not UTF-8 are written as Python writes them, \\xff.
    return os.fsencode(path).decode(errors='backslashreplace')
