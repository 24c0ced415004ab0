# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Render a bag with known truth.

Renders images of real stars with a simulated camera and writes the truth, a prior camera and a
parameter file beside the bag.

  # 24 images of 1296 x 1024, in a few seconds
  starcal simulate -o sim --scenario small
  # calibrate them
  starcal calibrate sim --params sim/params.yaml -o out
  # another draw of the camera and the noise
  starcal simulate -o sim2 --scenario small --seed 2
  # the camera of sim with other noise, twelve stars in each image
  starcal simulate -o sim3 --scenario small --seed 3 --camera-seed 1 --stars-per-image 12
"""

from __future__ import annotations

import argparse
import dataclasses

from starcal_ground.cli import arguments
from starcal_ground.cli.terminal import print_text, progress_bar


def add_arguments(command: argparse.ArgumentParser) -> None:
    add, number = command.add_argument, arguments.number
    arguments.add_output(command, 'BAG', 'bag folder or .mcap file to write', required=True)
    names = ('tiny', 'small', 'paper', 'narrow')
    what = 'scenario: tiny, small, paper, or narrow, with stars below the bundled catalog'
    add('--scenario', required=True, choices=names, metavar='NAME', help=what)
    what, seed = 'seed of the truth and the noise (default: 1)', number(int, 0, 2**63 - 1)
    add('--seed', type=seed, default=1, metavar='N', help=what)
    what = (
        'seed of the camera and its mounting: the same camera with other noise (default: --seed)'
    )
    add('--camera-seed', type=number(int, 0), metavar='N', help=what)
    what = 'number of images (default: from the scenario)'
    add('--images', type=number(int, 1), metavar='N', help=what)
    what = 'draw only the N brightest stars of each image'
    add('--stars-per-image', type=number(int, 1), metavar='N', help=what)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.simulation import scenario as synthetic
    from starcal_ground.simulation import simulated_bag

    camera_seed = args.seed if args.camera_seed is None else args.camera_seed
    scenario = synthetic.scenario(args.scenario, camera_seed)
    scenario = dataclasses.replace(
        scenario,
        seed=args.seed,
        image_count=args.images or scenario.image_count,
        stars_per_image=args.stars_per_image,
    )
    with progress_bar(scenario.image_count, 'images') as advance:
        made = simulated_bag.write_bag(scenario, args.output, on_image=lambda _: advance())
    print_text(f'bag {made.bag}, {scenario.image_count} images, seed {args.seed}')
    print_text(f'truth {made.truth}')
    if scenario.table is not None:
        table = made.params.with_name(made.params.name.replace('params.yaml', 'gaia.csv'))
        print_text(f'first: starcal catalog {table} -o {table.with_suffix(".npz")}')
    print_text(f'calibrate with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return arguments.EXIT_ACCEPTED
