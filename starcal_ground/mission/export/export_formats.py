# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Files of a calibration in a format of another tool.

A format is a row of `FORMATS`: its name, its line of help, what it needs and what makes its files.
Help, checks, the interface document and the tests read the rows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_ground.mission.export.request import Request
from starcal_ros.errors import OptionError

if TYPE_CHECKING:
    from starcal_ground.mission.export.exported import Content
    from starcal_ros.records import Calibration


@dataclass(frozen=True)
class Format:
    """
    A row of `FORMATS`.

    ``what`` is its line of help, ``files`` and ``left_out`` its cells in docs/mission_export.md.
    """

    name: str
    what: str
    files: str
    left_out: str
    make: Callable[[Calibration, Request], Content]
    needs_alignment: bool = False
    needs_observations: bool = False
    has_table: bool = False


Maker = Callable[['Calibration', Request], 'Content']


def _by(module: str, name: str) -> Maker:
    """A function of this folder; `starcal --help` reads the rows without its imports, a second."""

    def make(made: Calibration, asked: Request) -> Content:
        maker: Maker = getattr(importlib.import_module(f'{__package__}.{module}'), name)
        return maker(made, asked)

    return make


FORMATS = (
    Format(
        'spice',
        'FK and IK of SPICE',
        '`camera.tf`: the camera as TKFRAME in the star tracker frame; `camera.ti`: field of view,'
        ' lens model, skew, field, sigmas, with the equations in comments',
        'changes with temperature are keywords that SPICE does not apply',
        _by('spice', 'spice_kernels'),
        needs_alignment=True,
    ),
    Format(
        'ck',
        'attitude at each image for SPICE, with --kernels',
        '`camera.bc`: attitude at each image by its stars, type 3 (below)',
        'sigma and attitudes between images',
        _by('spice', 'ck_of_images'),
        needs_alignment=True,
        needs_observations=True,
    ),
    Format(
        'wcs',
        'FITS header with TAN-SIP for each image',
        '`image0001.wcs` and so on, in the order of `observations.mcap`: places of the catalog at'
        ' the date of the image, by its stars; `SIPERR` and `STARRMS` are the errors, px (below)',
        'sigma; fields beyond 170 degrees',
        _by('wcs', 'wcs_of_images'),
        needs_observations=True,
    ),
    Format(
        'isd',
        'ALE and ISIS',
        "`camera_isd.json`: the camera's keys of an ALE ISD (`radtan`); `camera_isis.ti`: ISIS"
        ' keywords (`OD_K`)',
        'field and terms that `plumb_bob` lacks; ISIS: all but radial distortion',
        _by('camera_models', 'isd_files'),
    ),
    Format(
        'c',
        'C99 source, or with --table its numbers alone',
        '`starcal_camera.h` and `starcal_camera.c` for flight software, or `starcal_camera.bin`'
        ' with `--table` ([onboard.md](onboard.md))',
        '1-sigma of the changes with temperature',
        _by('c_camera', 'c_content'),
        has_table=True,
    ),
    Format(
        'giant',
        'arguments of GIANT',
        "`giant_camera.json`: arguments of GIANT's `OpenCVModel`",
        'field, tilt, `equidistant`',
        _by('camera_models', 'giant_json'),
    ),
    Format(
        'mrcal',
        'a model of mrcal',
        '`camera.cameramodel`; its reference frame is the star tracker',
        'skew, field, tilt, `equidistant`',
        _by('camera_models', 'mrcal_cameramodel'),
    ),
    Format(
        'opencv',
        'YAML of OpenCV',
        '`opencv.yaml` for `cv2.FileStorage`',
        'skew, field',
        _by('camera_models', 'opencv_yaml'),
    ),
    Format(
        'ros',
        'YAML of ROS',
        '`camera_info.yaml` and `alignment.yaml` (TransformStamped)',
        'skew, field',
        _by('camera_models', 'ros_yaml'),
        needs_alignment=True,
    ),
)


def format_named(name: str) -> Format:
    """The row of a name; raises OptionError for an unknown one."""
    for row in FORMATS:
        if row.name == name:
            return row
    from starcal_ros.record_fields import nearest

    names = [row.name for row in FORMATS]
    raise OptionError(f'--to: {name!r} is not one of {", ".join(names)}{nearest(name, names)}')


def export(calibration: Calibration, kind: str, folder: Path, asked: Request) -> Content:
    """
    Write a calibration to a folder, made if absent, in one of `FORMATS`; return what was written.

    Raises OptionError for an unknown format, for something that it needs and that is missing,
    and for names that SPICE does not allow. Raises ProductError when a file cannot be written, and
    as `check_outputs` does.
    """
    from starcal_ground.products import check_outputs, make_folder
    from starcal_ground.written_files import write_marked

    row = format_named(kind)
    if asked.table and not row.has_table:
        others = ' or '.join(other.name for other in FORMATS if other.has_table)
        raise OptionError(f'--table: only --to {others} has a table, not {kind}')
    if row.needs_alignment and not calibration.has_alignment:
        others = ', '.join(other.name for other in FORMATS if not other.needs_alignment)
        raise OptionError(
            f'--to {kind}: the calibration is of the camera alone, without the alignment that'
            f' {kind} needs; choose one of {others}'
        )
    made = row.make(calibration, asked)
    check_outputs((folder / name for name in made.files), asked.kernels)
    make_folder(folder)
    for name, content in made.files.items():
        write_marked(folder / name, content)
    return made
