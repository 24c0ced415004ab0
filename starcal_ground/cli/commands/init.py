# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal init`: first camera file and parameters of a bag or photographs, from their stars."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
import dataclasses
from dataclasses import dataclass
from pathlib import Path
import shlex
import sys
import textwrap

import numpy as np
import yaml

from starcal_ground.cli.arguments import EXIT_ACCEPTED
from starcal_ground.cli.terminal import print_text
from starcal_ground.images import night_sky
from starcal_ground.images.from_stars import FromStars
from starcal_ground.images.photographs import image_paths, Photograph
from starcal_ground.outputs import check_outputs, make_folder
from starcal_ground.products import write_camera_info
from starcal_ros.camera import CameraModel
from starcal_ros.errors import OptionError
from starcal_ros.formats.bag import reader
from starcal_ros.formats.messages.message_codec import ATTITUDE_TYPES, VELOCITY_TYPE
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.pipeline.diagnosis.bags import diagnose_bags
from starcal_ros.pipeline.diagnosis.diagnose import found_alignment
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.pipeline.topics import choose_image_topic, choose_topics, Topics
from starcal_ros.records import CameraGeometry

CAMERA_FILE, _PARAMS_FILE = 'camera.yaml', 'params.yaml'
_LOOKED_AT = 20  # images, the first ones
_DIRECTIONS = ('st_to_inertial', 'inertial_to_st')
_OF_TRACKER = (
    'star_tracker_sigma_arcsec: 1-sigma noise about x, y, z; until then by the scatter of images',
    'stamp_offset_s: from the image stamp to the middle of the exposure; until then 0',
    'shutter: global, or rolling with readout_s; until then unknown',
)
_OF_PLACE = (
    'observer: ground, with latitude_deg, longitude_deg and height_m, or space; until then by the'
    ' stars'
)
_OF_VELOCITY = (
    'observer: ground with its site, or observer_velocity_m_s; until then an orbit about the Earth'
)


@dataclass(frozen=True)
class FirstSetup:
    """
    Camera and options that were found, what was found in words, and the options left to state.

    ``options`` are those of the parameter file but for the camera.
    """

    camera: CameraModel
    options: Mapping[str, object]
    found: tuple[str, ...]
    to_state: tuple[str, ...]

    def parameter_file(self) -> str:
        """Text of the parameter file, with what is left to state as comments."""
        values = {'camera_info_url': CAMERA_FILE, **self.options}
        options = yaml.safe_dump(values, sort_keys=False, default_flow_style=None)
        found = ''.join(f'# {line}\n' for line in self.found)
        to_state = ''.join(f'# {line}\n' for line in self.to_state)
        parameters = textwrap.indent(options + to_state, 4 * ' ')
        return f'{found}/**:\n  ros__parameters:\n{parameters}'


def of_photographs(photographs: Sequence[Photograph]) -> FirstSetup:
    """
    The camera of photographs, and their site where they state it.

    Raises NotFromStars when the stars give no camera.
    """
    found, notes = night_sky.camera_of_photographs(photographs[:_LOOKED_AT], {})
    options = night_sky.site_of(photographs)
    to_state = () if options else (_OF_PLACE,)
    return FirstSetup(found.camera, options, (found.in_a_sentence(), *notes), to_state)


def of_bags(bags: Sequence[Path], asked: Topics) -> FirstSetup:
    """
    The camera of a bag, and the alignment and direction of its attitudes where it has any.

    Raises NotFromStars when the stars give no camera. Raises BagError when a bag cannot be read,
    or several topics have a type. Raises OptionError when attitudes and images do not agree.
    """
    topic = choose_image_topic(bags, asked)
    camera = night_sky.camera_of_bags(bags, topic, {}, _LOOKED_AT)
    there = {one.type_name for one in reader.topics(bags)}
    words = f'images of {topic}: {camera.in_a_sentence()}'
    has_velocity = VELOCITY_TYPE in there
    kinds = [kind for kind, type_name in ATTITUDE_TYPES.items() if type_name in there]
    if not kinds:
        return FirstSetup(camera.camera, {}, (words,), () if has_velocity else (_OF_PLACE,))
    options, attitudes = _aligned(bags, asked, camera, kinds[0])
    to_state = _OF_TRACKER if has_velocity else (*_OF_TRACKER, _OF_VELOCITY)
    return FirstSetup(camera.camera, options, (words, attitudes), to_state)


def _aligned(
    bags: Sequence[Path], asked: Topics, camera: FromStars, kind: str
) -> tuple[dict[str, object], str]:
    """Options of the attitudes in a bag, and a line on them."""
    prior = CameraGeometry(camera.camera, np.array([0.0, 0.0, 0.0, 1.0]))
    said = ''
    for direction in _DIRECTIONS:
        options: dict[str, object] = {'attitude_direction': direction, 'attitude_message': kind}
        setup = dataclasses.replace(load_setup(options, prior=prior), is_aligned=False)
        topics = choose_topics(bags, asked, setup)
        found = diagnose_bags(bags, asked, setup)
        alignment, sentence = found_alignment(found)
        if alignment is not None:
            line = f'attitudes of {topics.attitude}: {direction}, {found.images} images agree'
            return {**options, 'prior_alignment': alignment}, line
        said = said or sentence
    raise OptionError(f'{bags[0]}: the attitudes do not fit the images: {said}')


def init(args: argparse.Namespace, asked: Topics) -> int:
    """Write camera and parameters that the stars show, and print them."""
    params, camera = args.output / _PARAMS_FILE, args.output / CAMERA_FILE
    photographs = image_paths(args.bags)
    check_outputs((params, camera), photographs or reader.files_of_bags(args.bags))
    if photographs:
        chosen, notes = night_sky.photographs_of(
            photographs, args.focal_length_mm, args.pixel_size_um
        )
        for note in notes:
            print_text(note, file=sys.stderr)
        found = of_photographs(chosen)
    else:
        found = of_bags(args.bags, asked)
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
