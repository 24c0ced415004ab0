# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Write a table of lines of sight and their sigma by pixel.

Writes u_px, v_px, the unit vector x, y, z in the camera frame, shape_sigma_arcsec (1-sigma of the
direction, common rotation removed) and, if there is an alignment, sigma_arcsec (in the star
tracker frame). The lines of sight include the residual field if there is one.

  # 25 x 25 pixels over the detector
  starcal lookup out -o lines_of_sight.csv
  # a fine table, for interpolation
  starcal lookup out -o lines_of_sight.npz --points 200
"""

from __future__ import annotations

import argparse
import io
from pathlib import Path
from typing import Any, TYPE_CHECKING

from starcal_ground.cli import arguments, terminal
from starcal_ros.errors import ProductError

if TYPE_CHECKING:
    from starcal_ros.assessment.lookup import LineOfSightTable

_MOST_POINTS = 2000  # pixels a side of a table of lines of sight: 1.8 GB of memory


def add_arguments(command: argparse.ArgumentParser) -> None:
    what = 'calibration.json or its folder'
    command.add_argument('calibration', type=arguments.path, metavar='DIR', help=what)
    arguments.add_output(command, 'FILE', 'table to write: .csv or .npz', required=True)
    points = arguments.number(int, 2, _MOST_POINTS)
    what = 'N x N pixels from corner to corner of the detector, u fastest (default: 25)'
    command.add_argument('--points', type=points, default=25, metavar='N', help=what)


def run(args: argparse.Namespace) -> int:
    from starcal_ros.assessment.lookup import line_of_sight_table
    from starcal_ros.camera import pixel_grid
    from starcal_ros.formats.products.product_files import calibration_file, read_calibration

    file = calibration_file(args.calibration)
    arguments.check_file(args.output, [file])
    calibration = read_calibration(file)
    camera = calibration.geometry.camera
    pixels = pixel_grid(camera, args.points, args.points)
    table = line_of_sight_table(camera, calibration.map_covariance, pixels)
    write_lookup_table(table, args.output, calibration.has_alignment)
    terminal.print_text(f'{len(pixels)} lines of sight written to {args.output}')
    return arguments.EXIT_ACCEPTED


def write_lookup_table(table: LineOfSightTable, path: Path, has_alignment: bool = True) -> None:
    """
    Write a table in the format of the file extension, .csv or .npz.

    A camera without an alignment has no sigma in the star tracker frame.
    Raises ProductError for another extension, or a file that cannot be written.
    """
    import numpy as np

    from starcal_ground.written_files import write_marked

    columns: dict[str, Any] = table.columns()  # the stub of savez_compressed wants no others
    if not has_alignment:
        del columns['sigma_arcsec']
    if path.suffix == '.csv':
        rows = (
            ','.join(repr(float(value)) for value in row)
            for row in zip(*columns.values(), strict=True)
        )
        write_marked(path, '\n'.join([','.join(columns), *rows]) + '\n')
    elif path.suffix == '.npz':
        memory = io.BytesIO()
        np.savez_compressed(memory, **columns)
        write_marked(path, memory.getvalue())
    else:
        raise ProductError(f'{path}: ends neither in .csv nor in .npz')
