# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of a calibration in a format of another tool."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import functools
from pathlib import Path

from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import pixel_grid
from starcal_ros.errors import OptionError
from starcal_ros.formats.products.camera_yaml import CAMERA_INFO_FILE, write_camera_info
from starcal_ros.formats.products.lookup_table import write_lookup_table
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.mission.export import camera_models
from starcal_ros.mission.export.c_camera import c_files, c_table, TABLE_FILE
from starcal_ros.mission.export.ck import write_ck
from starcal_ros.mission.export.isd import isd_json, isis_kernel
from starcal_ros.mission.export.losses import Fitted, fitted, Loss, temperature_losses
from starcal_ros.mission.export.spice import check_names, spice_kernels, SpiceNames
from starcal_ros.record_codec import nearest
from starcal_ros.records import Calibration, StarObservations

FORMATS = ('spice', 'ck', 'isd', 'opencv', 'kalibr', 'ros', 'giant', 'mrcal', 'csv', 'c')
_OF_ALIGNMENT = ('ros', 'spice', 'ck')
_OF_SPICE = ('spice', 'ck', 'isd')
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
    calibration: Calibration,
    kind: str,
    folder: Path,
    names: SpiceNames | None,
    topic: str = '',
    table: bool = False,
    observations: Iterable[StarObservations] = (),
    kernels: Sequence[Path] = (),
) -> Exported:
    """
    Write a calibration to a folder in one of `FORMATS`.

    Raises OptionError for an unknown format, or names that SPICE does not allow. Raises
    ProductError when a file cannot be written.

    Parameters
    ----------
    names : SpiceNames or None
        Needed for ``spice``, ``ck`` and ``isd``.
    topic : str
        Image topic, for kalibr.
    table : bool
        For ``c``: the binary table alone.
    observations, kernels
        For ``ck``: of the images, and the LSK and SCLK of the spacecraft.
    """
    if kind not in FORMATS:
        raise OptionError(
            f'--to: {kind!r} is not one of {", ".join(FORMATS)}{nearest(kind, FORMATS)}'
        )
    if table and kind != 'c':
        raise OptionError(f'--table: only --to c has a table, not {kind}')
    if kind in _OF_ALIGNMENT and not calibration.has_alignment:
        others = ', '.join(one for one in FORMATS if one not in _OF_ALIGNMENT)
        raise OptionError(
            f'--to {kind}: the calibration is of the camera alone, without the alignment that'
            f' {kind} needs; choose one of {others}'
        )
    if kind == 'c':
        made = {TABLE_FILE: c_table(calibration)} if table else c_files(calibration)
        return _written(folder, made, 0.0, ())
    if kind in _OF_SPICE:
        if names is None:
            raise OptionError(f'--to {kind}: give the NAIF ID of the spacecraft, --spacecraft-id')
        check_names(names)
    if kind == 'ck' and names:
        path = folder / 'camera.bc'
        return Exported((path,), 0.0, write_ck(calibration, observations, names, kernels, path))
    if kind == 'isd' and names:
        text, found = isd_json(calibration, names.pixel_size_um)
        isis, loss = isis_kernel(calibration, names)
        texts = {'camera_isd.json': text, 'camera_isis.ti': isis}
        return _written(folder, texts, found.worst_px, (*found.losses, loss))
    if kind == 'spice' and names:
        fk, ik, losses = spice_kernels(calibration, names)
        return _written(folder, {'camera.tf': fk, 'camera.ti': ik}, 0.0, losses)
    if kind == 'csv':
        camera = calibration.geometry.camera
        sights = line_of_sight_table(
            camera, calibration.map_covariance, pixel_grid(camera, CSV_POINTS, CSV_POINTS)
        )
        path = folder / 'lines_of_sight.csv'
        write_lookup_table(sights, path)
        return Exported((path,), 0.0, temperature_losses(calibration))
    if kind == 'ros':
        path = folder / CAMERA_INFO_FILE
        write_camera_info(calibration.geometry.camera, path, calibration.child_frame)
        found = fitted(calibration, calibration.geometry.camera.model, ('skew',))
        texts = {'alignment.yaml': camera_models.transform_yaml(calibration)}
        done = _written(folder, texts, found.worst_px, found.losses)
        return dataclasses.replace(done, files=(path, *done.files))
    makers: Mapping[str, tuple[str, Callable[[Calibration], tuple[str, Fitted]]]] = {
        'opencv': ('opencv.yaml', camera_models.opencv_yaml),
        'kalibr': ('camchain.yaml', functools.partial(camera_models.kalibr_yaml, topic=topic)),
        'mrcal': ('camera.cameramodel', camera_models.mrcal_cameramodel),
        'giant': ('giant_camera.json', camera_models.giant_json),
    }
    name, make = makers[kind]
    text, found = make(calibration)
    return _written(folder, {name: text}, found.worst_px, found.losses)


def _written(
    folder: Path, texts: Mapping[str, str | bytes], worst_px: float, losses: tuple[Loss, ...]
) -> Exported:
    for name, text in texts.items():
        write_atomically(folder / name, text)
    return Exported(tuple(folder / name for name in texts), worst_px, losses)
