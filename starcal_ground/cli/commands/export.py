# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Write a calibration in the format of another tool.

Writes SPICE kernels (FK and IK, or CK with the attitude of each image), FITS headers with the
world coordinates of each image, an ALE fragment and ISIS keywords, YAML of OpenCV or ROS,
arguments of GIANT, a model of mrcal, or C99 source; prints the
parts that the format cannot represent and the error in pixels that this causes. SPICE kernels and
C represent the whole camera, as do the tables of starcal lookup.

  # frame and instrument kernel, including the star tracker frame
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-id -999100
  # with the frame names of the mission, whose frame kernel defines the star tracker
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-frame MSN_ST1
  # attitude of the camera at each image, by its stars
  starcal export out --to ck -o kernels --spacecraft-id -999 --kernels naif.tls clock.tsc
  # FITS headers of the images, for Astropy and DS9
  starcal export out --to wcs -o headers
  # for cv2.projectPoints
  starcal export out --to opencv -o opencv
  # C99 for flight software, and a later calibration as a table for it
  starcal export out --to c -o src
  starcal export newer --to c --table -o uplink
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments, terminal
from starcal_ground.mission.export.export_formats import export, format_named, FORMATS
from starcal_ground.mission.export.request import Request, SpiceNames
from starcal_ros.errors import OptionError
from starcal_ros.text import significant

if TYPE_CHECKING:
    from starcal_ros.records import StarObservations


def add_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    what = 'calibration.json or its folder'
    add('calibration', type=Path, metavar='DIR', help=what)
    what = '; '.join(f'{row.name}: {row.what}' for row in FORMATS)
    add('--to', required=True, metavar='FORMAT', help=what)
    what = 'folder for the files, created if absent'
    add('-o', '--output', type=Path, required=True, metavar='OUT', help=what)
    spice = command.add_argument_group('SPICE')
    what = 'NAIF ID of the spacecraft, negative'
    spice.add_argument('--spacecraft-id', type=int, metavar='ID', help=what)
    what = 'NAIF ID of the camera (default: 1000 times the spacecraft ID, minus 1)'
    spice.add_argument('--instrument-id', type=int, default=0, metavar='ID', help=what)
    what = (
        'frame ID of the star tracker; the kernel then defines its frame as a CK frame (default: '
        'the frame kernel of the mission does)'
    )
    spice.add_argument('--star-tracker-id', type=int, default=0, metavar='ID', help=what)
    for name in ('camera', 'star-tracker'):
        what = f'name of the {name.replace("-", " ")} frame (default: from the calibration)'
        spice.add_argument(f'--{name}-frame', default='', metavar='NAME', help=what)
    what = 'pixel size, micrometres, for a focal length in mm (default: pixels only)'
    spice.add_argument('--pixel-size-um', type=float, default=0.0, metavar='UM', help=what)
    what = 'LSK and SCLK of the spacecraft, for ck'
    spice.add_argument('--kernels', nargs='+', type=Path, default=(), metavar='FILE', help=what)
    what = 'star catalog of the images, for wcs (default: the one of the calibration)'
    add('--catalog', type=arguments.path, metavar='FILE', help=what)
    what = 'only the binary table, for compiled C code'
    add('--table', action='store_true', help=what)


def run(args: argparse.Namespace) -> int:
    from starcal_ground import products
    from starcal_ground.bags.reader import image_files, read_observations
    from starcal_ros.formats.products.product_files import calibration_file, read_calibration

    file = calibration_file(args.calibration)
    calibration = read_calibration(file)
    names = None
    if args.spacecraft_id is not None:
        names = arguments.record_of(SpiceNames, args)
    recorded = file.with_name(products.OBSERVATIONS_FILE)
    observations: tuple[StarObservations, ...] = ()
    names_of_images: dict[int, str] = {}
    if format_named(args.to).needs_observations:
        if not recorded.exists():
            raise OptionError(f'--to {args.to}: needs {recorded} with the stars of the images')
        observations = tuple(read_observations([recorded], products.OBSERVATIONS_TOPIC))
        names_of_images = image_files([recorded])
    asked = Request(names, args.table, observations, args.kernels, args.catalog, names_of_images)
    done = export(calibration, args.to, args.output, asked)
    written = ', '.join(str(args.output / name) for name in done.files)
    terminal.print_text(f'written: {written}')
    if not calibration.accepted:
        arguments.complain(
            f'warning: the gate refused this calibration: {"; ".join(calibration.reasons)}'
        )
    if not math.isfinite(done.worst_px):
        terminal.print_text('the format cannot see the whole detector: use spice or opencv')
    else:
        terminal.print_text(
            f'largest error of a pixel against the calibration: {significant(done.worst_px, 3)} px'
        )
    for loss in done.losses:
        terminal.print_text(f'left out: {loss.part}, {significant(loss.cost_px, 3)} px alone')
    return arguments.EXIT_ACCEPTED
