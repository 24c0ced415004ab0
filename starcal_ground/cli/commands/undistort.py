# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Write images without the distortion of their calibrated camera.

The images become those of a pinhole camera of the same size, principal point and mean focal
length, whose camera_info.yaml is written beside them. Colours and bits stay; FITS become TIFF.
Images are mirrored, with a line that says so, if those of the calibration were.

  # photographs of the camera that `starcal calibrate photos -o out` has calibrated
  starcal undistort out photos -o straight
"""

from __future__ import annotations

import argparse
from pathlib import Path

from starcal_ground.cli import arguments, terminal
from starcal_ros.errors import IngestError
from starcal_ros.text import counted


def add_arguments(command: argparse.ArgumentParser) -> None:
    what = 'calibration.json or its folder'
    command.add_argument('calibration', type=arguments.path, metavar='DIR', help=what)
    what = 'images: files, folders, or patterns in quotes'
    command.add_argument('images', type=arguments.path, metavar='IMAGE', nargs='+', help=what)
    what = 'folder for the images, created if absent'
    arguments.add_output(command, 'OUT', what, required=True)


def run(args: argparse.Namespace) -> int:
    from starcal_ground import products, undistortion
    from starcal_ground.images.photographs import images_of, Refusals
    from starcal_ground.mirror import MIRRORED
    from starcal_ros.formats.products.product_files import calibration_file, read_calibration

    calibration = read_calibration(calibration_file(args.calibration))
    paths = images_of(args.images)
    products.make_folder(args.output)
    outputs = [undistortion.written_to(path, args.output) for path in paths]
    if repeated := next((path for path in outputs if outputs.count(path) > 1), None):
        raise IngestError(f'{repeated}: of several images: straighten them into several folders')
    camera: Path = args.output / products.CAMERA_INFO_FILE
    products.check_outputs([*outputs, camera], paths)
    maps = undistortion.undistort_maps(calibration)
    left_out, written = Refusals(), 0
    for path, output in zip(paths, outputs, strict=True):
        with left_out.of(path):
            undistortion.undistort_file(path, calibration, maps, output)
            written += 1
    if written:
        straight = undistortion.straight_camera(calibration.geometry.camera)
        products.write_camera_info(straight, camera)
    for line in left_out.lines():
        terminal.print_text(line)
    if not written:
        raise IngestError(f'{args.images[0]}: no image of the camera was read')
    for flip in undistortion.flips_of(calibration):
        terminal.print_text(f'{MIRRORED[flip]}, as the images of the calibration were')
    terminal.print_text(f'{counted(written, "image")} and {camera.name} written to {args.output}')
    return arguments.EXIT_ACCEPTED
