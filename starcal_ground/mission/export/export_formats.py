# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Files of a calibration in a format of another tool."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from starcal_ground.mission.export import camera_models, spice
from starcal_ground.mission.export.c_camera import c_files, c_table, TABLE_FILE
from starcal_ground.mission.export.exported import Content
from starcal_ground.products import check_outputs
from starcal_ros.errors import OptionError
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.record_fields import nearest
from starcal_ros.records import Calibration, StarObservations

FORMATS = ('spice', 'ck', 'isd', 'opencv', 'ros', 'giant', 'mrcal', 'c')
_OF_ALIGNMENT = ('ros', 'spice', 'ck')
_OF_SPICE = ('spice', 'ck', 'isd')


def export(
    calibration: Calibration,
    kind: str,
    folder: Path,
    names: spice.SpiceNames | None,
    table: bool = False,
    observations: Iterable[StarObservations] = (),
    kernels: Sequence[Path] = (),
) -> Content:
    """
    Write a calibration to a folder in one of `FORMATS`; return what was written.

    Raises OptionError for an unknown format, or names that SPICE does not allow. Raises
    ProductError when a file cannot be written, and as `check_outputs` does.

    Parameters
    ----------
    names : SpiceNames or None
        Needed for ``spice``, ``ck`` and ``isd``.
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
        others = ', '.join(other for other in FORMATS if other not in _OF_ALIGNMENT)
        raise OptionError(
            f'--to {kind}: the calibration is of the camera alone, without the alignment that'
            f' {kind} needs; choose one of {others}'
        )
    if kind in _OF_SPICE:
        if names is None:
            raise OptionError(f'--to {kind}: give the NAIF ID of the spacecraft, --spacecraft-id')
        spice.check_names(names)
    naif = names or spice.SpiceNames(0)
    makers: Mapping[str, Callable[[], Content]] = {
        'spice': lambda: spice.spice_kernels(calibration, naif),
        'ck': lambda: spice.ck_of_images(calibration, observations, naif, kernels),
        'isd': lambda: camera_models.isd_files(calibration, naif),
        'opencv': lambda: camera_models.opencv_yaml(calibration),
        'ros': lambda: camera_models.ros_yaml(calibration),
        'giant': lambda: camera_models.giant_json(calibration),
        'mrcal': lambda: camera_models.mrcal_cameramodel(calibration),
        'c': lambda: Content(
            {TABLE_FILE: c_table(calibration)} if table else c_files(calibration)
        ),
    }
    made = makers[kind]()
    check_outputs((folder / name for name in made.files), kernels)
    for name, content in made.files.items():
        write_atomically(folder / name, content)
    return made
