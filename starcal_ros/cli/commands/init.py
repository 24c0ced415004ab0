# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal init`: the first parameter file of a bag or of photographs."""

from __future__ import annotations

import argparse
import shlex
import sys

from starcal_ros.cli.arguments import EXIT_ACCEPTED
from starcal_ros.cli.terminal import print_text
from starcal_ros.errors import OptionError
from starcal_ros.formats.images.photographs import image_paths
from starcal_ros.formats.products.camera_yaml import write_camera_info
from starcal_ros.formats.products.product_files import make_folder, write_atomically
from starcal_ros.pipeline import first_setup, night_sky
from starcal_ros.pipeline.topics import Topics

_PARAMS_FILE = 'params.yaml'


def init(args: argparse.Namespace, asked: Topics) -> int:
    """Write camera and parameters that the stars show, and print them."""
    params, camera = args.output / _PARAMS_FILE, args.output / first_setup.CAMERA_FILE
    for path in (params, camera):
        if path.exists():
            raise OptionError(f'{path}: exists; choose another folder (-o)')
    photographs = image_paths(args.bags)
    if photographs:
        chosen, notes = night_sky.photographs_of(
            photographs, args.focal_length_mm, args.pixel_size_um
        )
        for note in notes:
            print_text(note, file=sys.stderr)
        found = first_setup.of_photographs(chosen)
    else:
        found = first_setup.of_bags(args.bags, asked)
    make_folder(args.output)
    write_camera_info(found.camera, camera)
    write_atomically(params, found.parameter_file())
    for line in found.found:
        print_text(f'found: {line}')
    for line in found.to_state:
        print_text(f'left to state: {line}')
    print_text(f'written: {params}, {camera}')
    given = [f'--{kind}-topic={name}' for kind, name in vars(asked).items() if name]
    words = ['starcal', 'calibrate', *map(str, args.bags), '--params', str(params), *given]
    print_text(f'next: {shlex.join(words)} -o out')
    return EXIT_ACCEPTED
