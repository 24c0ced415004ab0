# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Arguments of the commands for missions: export, import and trend."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

HELP: dict[str, tuple[str, str, str]] = {
    'export': (
        'write a calibration in the format of another tool',
        (
            'Writes SPICE kernels (FK and IK), YAML of OpenCV, kalibr or ROS, arguments of GIANT, '
            'or a table of lines of sight; prints what the format cannot hold and its cost in '
            'pixels. SPICE kernels and tables hold everything.'
        ),
        """\
  # frame and instrument kernel; the star tracker frame is defined too
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-id -999100
  # with the frame names of the mission, whose frame kernel defines the star tracker
  starcal export out --to spice -o kernels --spacecraft-id -999 --star-tracker-frame MSN_ST1
  # for cv2.projectPoints
  starcal export out --to opencv -o opencv""",
    ),
    'import': (
        'make a bag from images and attitudes in the formats of a mission',
        (
            'Images are FITS (tiled, scaled and floating point too), TIFF or PNG; attitudes CCSDS '
            'AEM, CSV or SPICE CK with SCLK and LSK; velocities CCSDS OEM, CSV or SPK. Times of '
            'UTC, TAI, TT, TDB and GPS become UTC. With --camera a parameter file to calibrate '
            'the bag is written beside it.'
        ),
        """\
  # FITS and an attitude ephemeris
  starcal import --images 'night/*.fits' --attitude attitude.aem -o bag --camera prior.yaml
  # SPICE kernels for attitude and velocity
  starcal import --images 'night/*.fits' --attitude ck.bc clk.tsc lsk.tls --star-tracker ST1 -o bag
  # PNG with a table of times and one of attitudes
  starcal import --images 'night/*.png' --times times.csv --attitude attitude.csv -o bag""",
    ),
    'trend': (
        'follow calibrations over years',
        (
            'Reads every calibration.json and state folder under ROOT, calibrates bags with '
            '--params, and observations of older versions again, into a Parquet table that grows; '
            'writes trend.html: each parameter, boresight and alignment over time, steps and '
            'drifts with p-values, and what a recalibration would have changed.'
        ),
        """\
  # all calibrations of a mission; run again, only what is new is computed
  starcal trend mission -o trend
  # a thousand bags on two processes
  starcal trend fleet -o trend --params camera.yaml --workers 2
  # on a Dask cluster that sees the same files
  starcal trend /data/fleet -o trend --params camera.yaml --scheduler tcp://host:8786""",
    ),
}


def _export(command: argparse.ArgumentParser) -> None:
    what = 'calibration.json or its folder'
    command.add_argument('calibration', type=Path, metavar='DIR', help=what)
    what = 'format: spice, opencv, kalibr, ros, giant or csv'
    command.add_argument('--to', required=True, metavar='FORMAT', help=what)
    what = 'folder for the files, created if absent'
    command.add_argument('-o', '--output', type=Path, required=True, metavar='OUT', help=what)
    spice = command.add_argument_group('SPICE')
    what = 'NAIF ID of the spacecraft, negative'
    spice.add_argument('--spacecraft-id', type=int, metavar='ID', help=what)
    what = 'NAIF ID of the camera (default: 1000 times that of the spacecraft, minus 1)'
    spice.add_argument('--instrument-id', type=int, default=0, metavar='ID', help=what)
    what = (
        'frame ID of the star tracker; the kernel then defines its frame as a CK frame (default: '
        'the frame kernel of the mission does)'
    )
    spice.add_argument('--star-tracker-id', type=int, default=0, metavar='ID', help=what)
    for name in ('camera', 'star-tracker'):
        what = f'name of the {name.replace("-", " ")} frame (default: that of the calibration)'
        spice.add_argument(f'--{name}-frame', default='', metavar='NAME', help=what)
    what = 'pixel size, micrometres, for a focal length in mm (default: pixels only)'
    spice.add_argument('--pixel-size-um', type=float, default=0.0, metavar='UM', help=what)
    what = 'image topic, for kalibr'
    command.add_argument('--image-topic', default='', metavar='T', help=what)


def _import(command: argparse.ArgumentParser) -> None:
    what = 'image files; a pattern in quotes is expanded here'
    command.add_argument('--images', nargs='+', required=True, metavar='FILE', help=what)
    what = 'AEM, CSV, or SPICE kernels (CK, SCLK, LSK and, for a frame by name, FK)'
    command.add_argument(
        '--attitude', nargs='+', type=Path, required=True, metavar='FILE', help=what
    )
    what = 'OEM, CSV, or SPICE kernels (SPK with the Earth or the Sun, LSK); default: the Earth'
    command.add_argument('--velocity', nargs='+', type=Path, metavar='FILE', help=what)
    what = 'bag folder or .mcap file to write; replaces an earlier import, no other file'
    command.add_argument('-o', '--output', type=Path, required=True, metavar='BAG', help=what)
    what = 'star tracker frame: a body frame of the AEM, or a frame name or number of the CK'
    command.add_argument('--star-tracker', default='', metavar='FRAME', help=what)
    what = 'name or NAIF ID of the spacecraft in the SPK'
    command.add_argument('--spacecraft', default='', metavar='BODY', help=what)
    what = 'FITS keyword of the middle of the exposure (default: DATE-AVG, else from DATE-BEG)'
    command.add_argument('--time-key', default='', metavar='KEY', help=what)
    what = 'CSV with columns file and time_utc (or time_tai, time_tdb, time_gps, time_ns)'
    command.add_argument('--times', type=Path, metavar='FILE', help=what)
    what = 'FITS keyword of the camera temperature, degC, e.g. CCD-TEMP'
    command.add_argument('--temperature-key', default='', metavar='KEY', help=what)
    what = 'FITS extension by number or name (default: the first image)'
    command.add_argument('--hdu', default='', metavar='N', help=what)
    what = 'colour to take from an RGB image or a mosaic'
    command.add_argument('--channel', default='', choices=('red', 'green', 'blue'), help=what)
    what = 'Bayer pattern of a mosaic; the image then has half the width and height'
    command.add_argument(
        '--bayer', default='', choices=('rggb', 'bggr', 'gbrg', 'grbg'), help=what
    )
    what = 'range of pixel values that is mapped to 16 bit (default: that of all images)'
    command.add_argument('--value-range', nargs=2, type=float, metavar=('LOW', 'HIGH'), help=what)
    what = 'ROS camera YAML of the prior camera; params.yaml is written then'
    command.add_argument('--camera', type=Path, metavar='FILE', help=what)
    what = (
        'prior orientation of the camera in the star tracker frame (default: found from the first'
        ' images)'
    )
    command.add_argument(
        '--alignment', nargs=4, type=float, default=(0.0, 0.0, 0.0, 0.0), help=what,
        metavar=('X', 'Y', 'Z', 'W'),
    )  # fmt: skip


def _trend(command: argparse.ArgumentParser) -> None:
    what = 'folder tree with calibrations and bags'
    command.add_argument('root', type=Path, metavar='ROOT', help=what)
    what = 'folder for trend.html and the table trend.parquet, created if absent'
    command.add_argument('-o', '--output', type=Path, required=True, metavar='DIR', help=what)
    what = 'ROS parameter file for bags without a calibration beside them'
    command.add_argument('--params', type=Path, metavar='FILE', help=what)
    what = 'try what failed before again'
    command.add_argument('--retry', action='store_true', help=what)
    where = command.add_mutually_exclusive_group()
    what = 'worker processes (default: 0, in-process)'
    where.add_argument('--workers', type=int, default=0, metavar='N', help=what)
    what = 'address of a Dask scheduler, e.g. tcp://host:8786'
    where.add_argument('--scheduler', default='', metavar='ADDRESS', help=what)


ARGUMENTS: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    'export': _export,
    'import': _import,
    'trend': _trend,
}
