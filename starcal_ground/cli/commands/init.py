# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Write the first parameter file of a bag or of photographs.

Finds the camera from the stars of the images, and if the bag has attitudes, their direction and
the alignment. Writes params.yaml and camera.yaml, and lists the values that were found and those
that you have to state.

  # the bag in the repository, without prior knowledge
  starcal init bags/tiny -o first
  # photographs of the night sky
  starcal init 'night/*.jpg' -o first
"""

import argparse
import shlex

from starcal_ground.cli import arguments, terminal


def add_arguments(command: argparse.ArgumentParser) -> None:
    arguments.add_bags(command, arguments.BAGS_OR_IMAGES)
    what = 'folder for params.yaml and camera.yaml, created if absent'
    arguments.add_output(command, 'DIR', what, required=True)
    arguments.add_lens(command)
    arguments.add_topics(command)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.images import first_setup, night_sky
    from starcal_ground.images.photographs import image_paths
    from starcal_ground.outputs import check_outputs, make_folder
    from starcal_ground.products import write_camera_info
    from starcal_ros.formats.bag import reader
    from starcal_ros.formats.products.product_files import write_atomically

    params, camera = args.output / 'params.yaml', args.output / first_setup.CAMERA_FILE
    photographs, topics = image_paths(args.bags), arguments.topics(args)
    check_outputs((params, camera), photographs or reader.files_of_bags(args.bags))
    if photographs:
        chosen, notes = night_sky.photographs_of(
            photographs, args.focal_length_mm, args.pixel_size_um
        )
        arguments.print_notes(notes)
        setup = first_setup.of_photographs(chosen)
    else:
        setup = first_setup.of_bags(args.bags, topics)
    make_folder(args.output)
    write_camera_info(setup.camera, camera)
    write_atomically(params, setup.parameter_file())
    for line in setup.found:
        terminal.print_text(f'found: {line}')
    for line in setup.to_state:
        terminal.print_text(f'left to state: {line}')
    terminal.print_text(f'written: {params}, {camera}')
    given = [f'--{kind}-topic={name}' for kind, name in vars(topics).items() if name]
    words = ['starcal', 'calibrate', *map(str, args.bags), '--params', str(params), *given]
    terminal.print_text(f'next: {shlex.join(words)} -o out')
    return arguments.EXIT_ACCEPTED
