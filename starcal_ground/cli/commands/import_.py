# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Make a bag from images and attitudes in the formats of a mission.

Images are FITS (also tiled, scaled or floating point), TIFF or PNG. Attitudes of one or more star
trackers are CCSDS AEM, CSV, or SPICE CK with SCLK and LSK. Velocities are CCSDS OEM, CSV or SPK.
Times in UTC, TAI, TT, TDB and GPS are converted to UTC. With --camera it also writes a parameter
file to calibrate the bag.

  # FITS and an attitude ephemeris
  starcal import --images 'night/*.fits' --attitude attitude.aem -o bag --camera prior.yaml
  # SPICE kernels for attitude and velocity
  starcal import --images night --attitude ck.bc clk.tsc lsk.tls --star-tracker ST1 -o bag
  # PNG with a table of times and one of attitudes
  starcal import --images 'night/*.png' --times times.csv --attitude attitude.csv -o bag
"""

import argparse
from collections.abc import Sequence
import dataclasses
from pathlib import Path

from starcal_ground.cli import arguments
from starcal_ground.cli.terminal import print_text, progress_bar
from starcal_ros.errors import OptionError
from starcal_ros.text import counted


def add_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    what = 'images: files, folders, or patterns in quotes'
    add('--images', nargs='+', type=arguments.path, required=True, metavar='IMAGE', help=what)
    what = 'AEM, CSV, or SPICE kernels (CK, SCLK, LSK and, for a frame by name, FK)'
    add('--attitude', nargs='+', type=Path, required=True, metavar='FILE', help=what)
    what = 'OEM, CSV, or SPICE kernels (SPK with the Earth or the Sun, LSK); default: the Earth'
    add('--velocity', nargs='+', type=Path, metavar='FILE', help=what)
    what = 'bag folder or .mcap file to write'
    add('-o', '--output', type=Path, required=True, metavar='BAG', help=what)
    what = 'star tracker frame: a body frame of the AEM, or a frame name or number of the CK'
    add('--star-tracker', default='', metavar='FRAME', help=what)
    what = 'frames of further star trackers in the same files'
    add('--more-star-trackers', nargs='+', default=(), metavar='FRAME', help=what)
    what = 'name or NAIF ID of the spacecraft in the SPK'
    add('--spacecraft', default='', metavar='BODY', help=what)
    what = 'FITS keyword of the middle of the exposure (default: by the standard keywords)'
    add('--time-key', default='', metavar='KEY', help=what)
    arguments.add_file_facts(command)
    what = 'FITS keyword of the camera temperature, degC, e.g. CCD-TEMP'
    add('--temperature-key', default='', metavar='KEY', help=what)
    what = 'FITS extension by number or name (default: the largest image)'
    add('--hdu', default='', metavar='N', help=what)
    what = 'colour to take from an RGB image or a mosaic'
    add('--channel', default='', choices=('red', 'green', 'blue'), help=what)
    what = 'Bayer pattern of a mosaic (default: by the header), read at half the width and height'
    add('--bayer', default='', choices=('rggb', 'bggr', 'gbrg', 'grbg'), help=what)
    what = 'range of pixel values that is mapped to 16 bit (default: the range of all images)'
    add('--value-range', nargs=2, type=float, metavar=('LOW', 'HIGH'), help=what)
    what = 'prior camera, ROS YAML or .cameramodel of mrcal; params.yaml is written then'
    add('--camera', type=Path, metavar='FILE', help=what)
    what = (
        'prior orientation x y z w of the camera in the star tracker frame, then in the frame of'
        ' each further star tracker; of a single star tracker it may be left out: it is then found'
        ' from the first images'
    )
    add('--alignment', nargs='+', type=float, default=(), metavar='Q', help=what)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.images.image_series import ImageOptions
    from starcal_ground.images.photographs import images_of
    from starcal_ground.mission.ingest import mission_records, recording, sources
    from starcal_ground.products import inputs_of
    from starcal_ros.formats.products.camera_yaml import read_camera_info

    needed = 4 * (1 + len(args.more_star_trackers))
    given = len(args.alignment)
    if args.camera and given != needed and (given or args.more_star_trackers):
        raise OptionError(
            f'--alignment: {given} numbers, {needed} are needed: x y z w for each star tracker;'
            ' only that of a single one is found from the images'
        )
    if args.camera:  # the images take their time
        read_camera_info(args.camera)
    paths = images_of(args.images)
    inputs = [args.times, args.camera, *args.attitude, *(args.velocity or ())]
    recording.check_place(args.output, [*paths, *filter(None, inputs)], args.camera)
    times = arguments.file_facts(args).times
    options = dataclasses.replace(arguments.record_of(ImageOptions, args), times=times)
    with mission_records.Guard() as guard, progress_bar(2 * len(paths), 'images') as advance:
        files = recording.look_at_all(paths, options, guard, advance)
        stamps = [file.time_ns for file in files]
        attitudes, *others = (
            guard.call(_names(args.attitude), sources.attitudes, args.attitude, frame, stamps)
            for frame in (args.star_tracker, *args.more_star_trackers)
        )
        further = dict(
            zip(map(recording.frame_name, args.more_star_trackers), others, strict=True)
        )
        velocities = args.velocity and guard.call(
            _names(args.velocity), sources.velocities, args.velocity, args.spacecraft, stamps
        )
        prior = args.camera and recording.Prior(args.camera, tuple(args.alignment) or (0.0,) * 4)
        given_files = [*paths, *args.attitude, *(args.velocity or ()), *filter(None, [args.times])]
        made = recording.write_bag(
            args.output,
            files,
            options,
            guard,
            attitudes,
            velocities,
            prior,
            advance,
            further,
            inputs_of(given_files),
        )
    print_text(f'bag {made.bag}: {counted(len(files), "image")}')
    for note in made.notes:
        print_text(f'note: {note}')
    if made.params:
        print_text(f'calibrate with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return arguments.EXIT_ACCEPTED


def _names(paths: Sequence[Path]) -> str:
    return ', '.join(map(str, paths))
