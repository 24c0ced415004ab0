# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Set-up of a calibration from whatever is given: what is stated, found by the stars, and assumed.

A camera that is not stated is that of the stars; with it the attitudes of a bag give their
direction and the alignment.  What is stated of a star tracker has to be there, unless the camera
alone is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
from dataclasses import dataclass
import functools
import math
from pathlib import Path
import re
import textwrap

import numpy as np
import yaml

from starcal_ground.bags import reader
from starcal_ground.bags.reader import OF_THE_STARS
from starcal_ground.bags.topics import (
    choose_image_topic,
    choose_topics,
    stated_tracker,
    Topics,
    without_attitudes,
)
from starcal_ground.campaign import Source, ThroughAir
from starcal_ground.images.image_series import FileFacts
from starcal_ground.images.photographs import image_paths, NOT_STATED
from starcal_ground.products import make_folder, write_camera_info
from starcal_ground.written_files import write_marked
from starcal_ros.errors import BagError, OptionError
from starcal_ros.estimation.options import tracker_sigma_is_given
from starcal_ros.formats.messages.message_codec import OBSERVATIONS_TYPE
from starcal_ros.pipeline.setup import files_of, load_setup, option_groups, paths_from, Setup
from starcal_ros.records import Ensemble, FOUND, PIXELS_OF
from starcal_ros.text import printable

PARAMETER_FILE, CAMERA_FILE = 'params.yaml', 'camera.yaml'
_LOOKED_AT = 20  # images, the first ones
_DIRECTIONS = ('st_to_inertial', 'inertial_to_st')


@dataclass(frozen=True)
class Given:
    """
    Bags or images, and what is stated of them.

    ``options`` are those of a parameter file ``params`` and of ``--set``, ``settings`` the names
    of the latter; ``lens`` is the focal length (mm) and the pixel size (um), 0 where not stated,
    ``facts`` what else is stated of image files.
    """

    paths: Sequence[Path]
    topics: Topics
    options: Mapping[str, object]
    params: Path | None = None
    settings: Sequence[str] = ()
    camera_alone: bool = False
    lens: tuple[float, float] = (0.0, 0.0)
    facts: FileFacts = NOT_STATED

    @property
    def states_camera(self) -> bool:
        """True if the camera need not be found."""
        return bool(self.options.get('camera_info_url'))

    @functools.cached_property
    def photographs(self) -> list[Path]:
        """Files of images; empty if bags are given."""
        return image_paths(self.paths)

    @functools.cached_property
    def is_by_stars(self) -> bool:
        """True if the attitudes are to be found from the stars; OptionError if they are stated."""
        if not self.photographs:
            return without_attitudes(self.paths, self.topics, self.options, self.camera_alone)
        if (stated := stated_tracker(self.options)) and not self.camera_alone:
            raise OptionError(
                f'{", ".join(stated)}: stated, but image files have no attitudes: give a bag that'
                ' has them (starcal import), or --camera-alone'
            )
        return True

    @functools.cached_property
    def recorded_alone(self) -> dict[str, object] | None:
        """Options for observations whose attitudes are those of their own stars, else None."""
        with contextlib.suppress(BagError):  # it is raised where the topics are needed
            if topic := choose_topics(self.paths, self.topics).observations:
                from starcal_ground.images.from_stars import options_of  # seldom needed, slow

                first = next(reader.read_observations(self.paths, topic), None)
                if first is not None and first.star_tracker == OF_THE_STARS:
                    return {**options_of(self.options), 'prior_alignment': (0.0,) * 4}
                return options_of(self.options) if self.camera_alone else None
        return None

    @functools.cached_property
    def checked(self) -> tuple[Setup | None, tuple[Path, ...]]:
        """
        The setup of bags with attitudes where the camera is stated, and the files of the options.

        Raises OptionError with the place of a bad option.
        """
        if any(self.lens) and (self.states_camera or not (self.photographs or all(self.lens))):
            raise OptionError(
                '--focal-length-mm, --pixel-size-um: a camera_info_url has them already'
                if self.states_camera
                else '--focal-length-mm, --pixel-size-um: bags need both'
            )
        if self.facts != NOT_STATED and not self.photographs:
            raise OptionError('--times, --flip: only of image files, which bags are made of')
        with self.with_place():
            if self.is_by_stars or not self.states_camera:
                frames = option_groups(self.options)['frames']
                setup = None
            elif alone := self.recorded_alone:
                setup = dataclasses.replace(load_setup(alone), is_aligned=True)
                frames = setup.frames
            else:
                setup = load_setup(self.options)
                frames = setup.frames
        return setup, (*filter(None, [self.params]), *files_of(frames).values())

    @contextlib.contextmanager
    def with_place(self) -> Iterator[None]:
        """Name the file, or ``--set``, of an option that is an error in the block."""
        try:
            yield
        except OptionError as error:
            # One option, an item of its list, or several: "name[2]: ...", "name, other: ...".
            names = re.findall(r'\w+', str(error).partition(':')[0])
            if not set(self.settings).isdisjoint(names):
                raise OptionError(f'--set {error}') from error
            raise OptionError(f'{self.params}: {error}' if self.params else str(error)) from error


def write_setup(source: Source, stated: Mapping[str, object], folder: Path) -> None:
    """
    Write ``params.yaml`` and ``camera.yaml``, which repeat the calibration of a source.

    ``stated`` are the options of its inputs; its topics are those that are read.
    """
    setup = source.setup
    values: dict[str, object] = {'lens_model': setup.frames.lens_model}
    if setup.has_tracker:
        values['attitude_direction'] = setup.attitude.attitude_direction
        values['prior_alignment'] = setup.prior.star_tracker_from_camera_xyzw.tolist()
    elif setup.site.observer == 'ground':  # stated by the images
        values |= dataclasses.asdict(setup.site)
    values |= paths_from(stated, Path.cwd())
    values['camera_info_url'] = CAMERA_FILE
    text = ''.join(f'{name}: {_in_a_line(value)}\n' for name, value in values.items())
    to_state = ''.join(f'# {name}: {what}\n' for name, what in assumed(source, stated))
    found = ''.join(f'# {printable(line)}\n' for line in source.notes)
    content = f'{found}/**:\n  ros__parameters:\n{textwrap.indent(text + to_state, 4 * " ")}'
    make_folder(folder)
    pixels_of = setup.origin.get(PIXELS_OF, '')
    write_camera_info(setup.prior.camera, folder / CAMERA_FILE, pixels_of=pixels_of)
    write_marked(folder / PARAMETER_FILE, content)


def assumed(
    source: Source, stated: Mapping[str, object], ensemble: Ensemble | None = None
) -> list[tuple[str, str]]:
    """
    Options that nobody has stated, each with what is assumed.

    The topics of the source are those read; ``ensemble``: the images, where they are at hand.
    """
    setup, topics = source.setup, source.topics
    has_tracker = setup.has_tracker
    has_velocity = bool(topics.velocity or topics.observations)
    rows = [
        ('star_tracker_sigma_arcsec', 'from the scatter of the images',
         has_tracker and not tracker_sigma_is_given(setup.calibration)),
        ('star_tracker_slow_arcsec', 'as large as its noise', has_tracker),
        ('stamp_offset_s', '0, stamps of the middle of the exposure', has_tracker),
        ('shutter', _assumed_shutter(ensemble), has_tracker),
        ('observer', 'space, about the Earth or the Sun' if has_tracker else 'by the stars',
         not (has_velocity or setup.site.observer == 'ground'
              or 'observer_velocity_m_s' in stated)),
    ]  # fmt: skip
    return [(name, text) for name, text, matters in rows if matters and name not in stated]


def _assumed_shutter(ensemble: Ensemble | None) -> str:
    """Text on a shutter that is not stated; by the rates of the images its time is estimated."""
    if ensemble is None:
        return 'unknown'
    if any(np.isfinite(image.star_tracker_rate_rad_s).all() for image in ensemble.images):
        return 'unknown, read out within 20 ms'
    return (
        'unknown, read out within 20 ms; with the turn of a low orbit in the sigma, since no image'
        ' has an angular rate: state the shutter, or record attitudes more often'
    )


def _in_a_line(value: object) -> str:
    """A value in YAML; alone it would end in a mark of the document."""
    return yaml.safe_dump([value], default_flow_style=True, width=math.inf).strip()[1:-1]


def source_of(
    given: Given,
    folder: Path,
    bag_folder: Path,
    on_notes: Callable[[Sequence[str]], None] = lambda notes: None,
) -> Source:
    """
    Source of any inputs: bags with attitudes or without, observations, photographs.

    Its topics are those asked for, and its notes sentences on what the stars show.  A camera that
    is found is written to a folder, bags of images and of the attitudes of their stars to
    ``bag_folder``; ``on_notes`` is told of files that are left out, before the search.

    Raises NotFromStars when the stars give no camera. Raises BagError when a bag cannot be read,
    or several topics have a type. Raises OptionError for options that do not go together.
    """
    setup, stated = given.checked
    with given.with_place():
        if not given.is_by_stars:
            setup, found = (setup, ()) if setup else _of_attitudes(given, folder)
            setup = _of_origin(setup, given.paths)
            files = (*reader.mcap_files(given.paths), *stated)
            return Source(tuple(given.paths), given.topics, setup, air_of(setup), found, files)
        from starcal_ground.images import night_sky  # the search of the sky is slow to load

        if not given.photographs:
            of_bags = given.paths, given.topics, given.options, bag_folder, given.lens
            source = night_sky.from_bags(*of_bags)
            files = (*reader.mcap_files(given.paths), *stated)
            setup = _of_origin(source.setup, given.paths)
            return dataclasses.replace(source, setup=setup, files=files)
        photographs, notes = night_sky.photographs_of(given.photographs, *given.lens, given.facts)
        on_notes(notes)
        source = night_sky.from_photographs(photographs, given.options, bag_folder)
        files = (*(one.path for one in photographs), *stated)
        return dataclasses.replace(source, files=files)


def _of_origin(setup: Setup, bags: Sequence[Path]) -> Setup:
    """A setup of bags with what they state of the files that they were made from."""
    return dataclasses.replace(setup, origin={**setup.origin, **reader.origin_of(bags)})


def air_of(setup: Setup) -> ThroughAir | None:
    """Search for the air of a camera on the ground, where nobody states its site; else None."""
    if setup.site.observer != 'ground' or setup.site.is_known:
        return None
    from starcal_ground.images.unknown_air import with_air  # seldom needed, slow

    return functools.partial(with_air, camera=setup.prior.camera, is_ground=True)


def _of_attitudes(given: Given, folder: Path) -> tuple[Setup, tuple[str, ...]]:
    """Setup of bags with attitudes whose camera is not stated, and sentences on it."""
    from starcal_ground.diagnosis.bags import aligned_by_stars
    from starcal_ground.images import from_stars, night_sky  # as in `source_of`

    if choose_topics(given.paths, given.topics).observations:
        raise OptionError(
            f'camera_info_url: not stated, and {OBSERVATIONS_TYPE} shows no camera: give the'
            ' parameter file of these observations (--params)'
        )
    topic = choose_image_topic(given.paths, given.topics)
    # The gate counts all images of the bags; these are the first ones.
    stated = option_groups(given.options)['calibration'].min_images
    few = {**given.options, 'min_images': min(stated, from_stars.FEWEST_IMAGES)}
    stars = night_sky.camera_of_bags(given.paths, topic, few, _LOOKED_AT, given.lens)
    make_folder(folder)
    write_camera_info(stars.camera, folder / CAMERA_FILE)
    options = {'lens_model': 'auto', **given.options}
    options['camera_info_url'] = str(folder / CAMERA_FILE)
    words = f'images of {topic}: {stars.in_a_sentence()}'
    ways = [options['attitude_direction']] if 'attitude_direction' in options else _DIRECTIONS
    setups = [
        dataclasses.replace(
            load_setup({**options, 'attitude_direction': way}), origin={FOUND: 'camera'}
        )
        for way in ways
    ]
    for setup in setups:
        if setup.is_aligned:  # stated; a wrong direction is named where no image matches
            return setup, (words,)
        found, diagnosis = aligned_by_stars(given.paths, given.topics, setup)
        if found.is_aligned:
            topic = choose_topics(given.paths, given.topics, setup).attitude
            read = setup.attitude.attitude_direction
            line = f'attitudes of {topic}: {read}, {diagnosis.images} images agree'
            return found, (words, line)
    return setups[0], (words,)  # why none is found is named where it is needed
