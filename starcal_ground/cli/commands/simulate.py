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
  # the camera of sim a year later, when it has drifted, for starcal trend
  starcal simulate -o sim4 --scenario small --seed 4 --camera-seed 1 --date 2027-05-15T07:40 \
      --focal-drift 100
  # a deliberate mistake, to practise the diagnosis
  starcal simulate -o mirrored --scenario tiny --flip
"""

from __future__ import annotations

import argparse
import dataclasses

from starcal_ground.cli import arguments
from starcal_ground.cli.terminal import print_text, progress_bar
from starcal_ground.mirror import MIRRORED
from starcal_ros.constants import CLOCKS_SET_NS, MAX_STAMP_NS
from starcal_ros.errors import OptionError
from starcal_ros.text import counted


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
    what = 'time of the first image, UTC in ISO 8601 (default: a night of May 2026)'
    add('--date', type=arguments.parse_time, metavar='T', help=what)
    since = 'per year since the date of the scenario, to rehearse a trend'
    what = f'growth of the focal length, parts per million {since}'
    add('--focal-drift', type=number(float, -1e4, 1e4), default=0.0, metavar='PPM', help=what)
    what = f'turn of the camera about its x axis, arcsec {since}'
    drift = number(float, -1e4, 1e4)
    add('--alignment-drift', type=drift, default=0.0, metavar='ARCSEC', help=what)
    add = command.add_argument_group('mistakes to rehearse, see "starcal diagnose"').add_argument
    what = 'mirror the images (default where no side is given: left-right)'
    flips = tuple(MIRRORED)
    add('--flip', nargs='?', default='', const=flips[0], choices=flips, help=what)
    what = 'angle of a counterclockwise rotation of the images, degrees'
    angles = (0, 90, 180, 270)
    add('--rotate', dest='rotate_deg', type=int, choices=angles, default=0, help=what)
    what = 'direction of the attitudes in the bag; the parameter file has st_to_inertial'
    directions = ('st_to_inertial', 'inertial_to_st')
    add('--attitude-direction', choices=directions, default=directions[0], help=what)
    what = 'order of the numbers of the quaternions in the bag'
    add('--quaternion-order', choices=('xyzw', 'wxyz'), default='xyzw', help=what)
    for name, low, high, metavar, what in (
        ('alignment-error', -180, 180, 'DEG', 'error of the prior alignment, degrees'),
        ('focal-error', -90, 400, 'PERCENT', 'error of the prior focal length, percent'),
        ('clock-error', -1e9, 1e9, 'S', 'delay of the image stamps, s, over 0.75'),
    ):
        add(f'--{name}', dest=f'{name.replace("-", "_")}_{metavar.lower()}',
            type=number(float, low, high), default=0.0, metavar=metavar, help=what)  # fmt: skip
    what = 'length of the streak of a star, px'
    length = number(int, 1, 200)
    add('--smear', dest='smear_px', type=length, default=1, metavar='PX', help=what)
    what = 'tone curve: pixel values grow with light to the power 1/G'
    add('--gamma', type=number(float, 0.2, 5), default=1.0, metavar='G', help=what)


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
    drifts = args.focal_drift, args.alignment_drift
    if args.date:
        scenario = synthetic.at_date(scenario, args.date(scenario.start_ns), *drifts)
        end_ns = scenario.time_ns(scenario.image_count)
        if not CLOCKS_SET_NS < scenario.start_ns <= end_ns < MAX_STAMP_NS:
            raise OptionError('--date: not within 1990 to 2037, the stamps that are read')
    elif any(drifts):
        raise OptionError('--focal-drift, --alignment-drift: need --date, until which they act')
    mistakes = arguments.record_of(simulated_bag.Mistakes, args)
    still_s = max(synthetic.ATTITUDE_OFFSETS_S)
    if 0 < abs(mistakes.clock_error_s) <= still_s:
        raise OptionError(
            f'--clock-error: {mistakes.clock_error_s:g} s changes no result: in the scenarios the'
            f' camera is at rest, or turns evenly, within {still_s:g} s of an image; give more'
        )
    with progress_bar(scenario.image_count, 'images') as advance:
        made = simulated_bag.write_bag(
            scenario, args.output, on_image=lambda _: advance(), mistakes=mistakes
        )
    print_text(f'bag {made.bag}, {counted(scenario.image_count, "image")}, seed {args.seed}')
    print_text(f'truth {made.truth}')
    if scenario.table is not None:
        table = made.params.with_name(made.params.name.replace('params.yaml', 'gaia.csv'))
        print_text(f'first: starcal catalog {table} -o {table.with_suffix(".npz")}')
    print_text(f'calibrate with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return arguments.EXIT_ACCEPTED
