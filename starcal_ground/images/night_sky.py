# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Set-up of a calibration from images alone: photographs, or bags without attitudes.

Photographs are written to one bag, and the rotations that `from_stars` finds to another.  The
calibration of these bags is the same as that of any bag.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import dataclasses
import functools
import itertools
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.bags import reader
from starcal_ground.bags.topics import choose_image_topic, stated_tracker, Topics
from starcal_ground.blind import search
from starcal_ground.blind.bright_sources import bright_sources
from starcal_ground.blind.images import FEWEST_SOURCES
from starcal_ground.campaign import Source
from starcal_ground.diagnosis.bags import refusals
from starcal_ground.images import from_stars as by_stars
from starcal_ground.images import photographs as image_files
from starcal_ground.images import stated as stated_facts
from starcal_ground.images.image_series import FileFacts
from starcal_ground.images.unknown_air import EARTH_M_S, with_air
from starcal_ground.mirror import MIRRORED, mirrored
from starcal_ground.products import input_name
from starcal_ros.camera import CameraModel
from starcal_ros.constants import CLOCKS_SET_NS
from starcal_ros.errors import NotFromStars
from starcal_ros.formats.messages.message_codec import VELOCITY_TYPE
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.pipeline.setup import load_setup, option_groups
from starcal_ros.records import (
    CameraGeometry,
    FOUND,
    Image,
    PIXELS_OF,
    refused_image,
    StarObservations,
    TIMES,
)
from starcal_ros.robust_statistics import MAD_TO_SIGMA
from starcal_ros.sky.astrometry import SiteOptions
from starcal_ros.sky.catalog import load_catalog, StarCatalog

_FEW = 5  # images that are looked at for stars, or whose stars show a tone curve
# The scatter of 15 brightnesses is known to a fifth.
_FEWEST_BRIGHTNESSES, _CLEARLY_LESS = 15, 0.8
_ATTITUDE_TOPIC = '/stars/attitude'
_NOWHERE = {'latitude_deg': 0.0, 'longitude_deg': 0.0}


def _through_air(
    stars: by_stars.FromStars,
    site: SiteOptions,
    is_located: bool,
    observations: Sequence[StarObservations],
) -> tuple[list[StarObservations], str]:
    """
    Observations, refracted if the stars show it and no site is given, and notes on them.

    ``is_located`` is False if neither the options nor the files state the site of the camera and
    its time.
    """
    images, note = [_in_words_of_stars(stars, one) for one in observations], ''
    if not is_located:
        images, note = with_air(images, stars.camera, site.observer == 'ground')
    lost = refusals(one for one in images if one.time_ns in stars.icrf_from_camera)
    notes = [note] if note else []
    notes += [
        f'{row.count} of {len(images)} images, identified by their brightest stars, are refused as'
        f' {row.reason}: {row.detail or row.meaning}'
        for row in lost
    ]
    return images, '; '.join(notes)


def _in_words_of_stars(stars: by_stars.FromStars, one: StarObservations) -> StarObservations:
    """Observations of a copy refused, and of an image not identified as such."""
    if one.time_ns in stars.copies:
        reason, detail = 'duplicate', stars.copies[one.time_ns]
    elif one.refusal in ('no_attitude', 'attitude_gap'):  # those of the stars were not found
        reason, detail = 'no_match', 'its stars were not identified'
    else:
        return one
    return refused_image(one.time_ns, one.width, one.height, reason, detail)


def photographs_of(
    paths: Sequence[Path],
    focal_length_mm: float = 0.0,
    pixel_um: float = 0.0,
    facts: FileFacts = image_files.NOT_STATED,
) -> tuple[list[image_files.Photograph], list[str]]:
    """
    Photographs of one camera in order of time, and notes on the omitted files.

    The length, the size of a pixel and ``facts`` are those that the user states of all files.
    Raises NotFromStars when no file can be read.
    """
    looked: list[image_files.Photograph] = []
    refusals = image_files.Refusals()
    for path in image_files.image_paths(paths):
        with refusals.of(path):
            looked.append(image_files.look_at(path, focal_length_mm, pixel_um, facts))
    groups = image_files.by_camera(looked)
    if not groups:
        raise NotFromStars('; '.join(['no image can be read', *refusals.lines()]))
    if len(groups) > 1:
        with_stars = {name: _shows_stars(group) for name, group in groups.items()}
        groups = dict(sorted(groups.items(), key=lambda item: not with_stars[item[0]]))
    (name, group), *others = groups.items()
    notes = refusals.lines()
    if others:
        left = ', '.join(
            f'{len(group)} of {other}{"" if with_stars[other] else ", which show no stars"}'
            for other, group in others
        )
        notes.append(f'{len(group)} images of {name} are used; left out: {left}')
    return image_files.in_order(group), notes


def _shows_stars(group: Sequence[image_files.Photograph]) -> bool:
    """True if one of a few images of a group, from its first to its last, shows stars."""
    few = [group[k * (len(group) - 1) // (_FEW - 1)] for k in range(min(_FEW, len(group)))]
    images = _images(few, image_files.Refusals())
    return any(
        by_stars.count_of_stars(image.pixels, bright_sources(image.pixels)) >= FEWEST_SOURCES
        for image in images
    )


def from_photographs(
    photographs: Sequence[image_files.Photograph], values: Mapping[str, object], folder: Path
) -> Source:
    """
    Source of a calibration of photographs, whose bags are written into a folder.

    The search starts at their stated focal length, if any.  Raises NotFromStars when the stars
    give no camera.
    """
    from starcal_ground.bag_writer import BagWriter  # bags with attitudes are read without mcap

    damaged, channel = image_files.Refusals(), str(values.get('image_channel', ''))
    size = photographs[0].width, photographs[0].height
    hints = {
        one.keywords: by_stars.ideal_camera(size, one.focal_px)
        for one in stated_facts.focal_lengths_of(photographs)
    }
    places = [one.pointing for one in photographs if one.pointing]
    catalog = _catalog_of(values)
    try:
        stars = _found(_images(photographs, damaged, channel), values, catalog, hints, places)
    except NotFromStars as error:
        raise NotFromStars('; '.join([str(error), *damaged.lines()])) from error
    if stars.mirrored and (stated_flip := photographs[0].flip):
        raise NotFromStars(
            f'--flip {stated_flip}: the stars show a mirror image with it: leave it out'
        )
    is_rendered, curve = _tone_curve(photographs, stars, catalog, channel)
    # A FITS file whose rows have no stated order is mirrored by that order.
    by_rows = stars.mirrored and not any(one.is_upright for one in photographs)
    stars = _half_turned(stars) if by_rows else stars
    flip = ('top-bottom' if by_rows else 'left-right') if stars.mirrored else ''
    bag = folder / 'images.mcap'
    names = {f'{reader.IMAGE_FILE}{one.time_ns}': input_name(one.path) for one in photographs}
    with BagWriter(bag, names) as writer:
        for image in _images(photographs, image_files.Refusals(), channel, is_rendered):
            if flip:
                image = Image(image.time_ns, mirrored(image.pixels, flip).copy())
            writer.write_image('/camera/image_raw', image, 'camera')
    site, words_of_site = (
        ({}, '') if 'observer' in values else stated_facts.site_of(photographs, stars)
    )
    stated = {**site, **values}
    is_located = 'observer' in stated or 'observer_velocity_m_s' in stated
    if is_located and not all(one.dated for one in photographs):
        stated, words_of_site = _at_unknown_time(stated)
        words_of_site += ': state it (--times)' * bool(words_of_site)
    pixels_of = [*dict.fromkeys(one.pixels_of for one in photographs)]
    if flip:
        shown = 'that the rows of the files are last to first' if by_rows else 'a mirror image'
        count = f'{len(stars.icrf_from_camera)} of {stars.images} images'
        pixels_of.append(f'{MIRRORED[flip]}: the stars of {count} show {shown}')
    notes = [
        *damaged.lines(),
        words_of_site,
        stated_facts.doubt_of_times(photographs),
        stated_facts.half_turns(stars),
        *curve,
    ]
    source = _set_up(stars, [bag], stated, folder, is_located, Topics(), [*filter(None, notes)])
    times, pixels = stated_facts.times_of(photographs), '; '.join(filter(None, pixels_of))
    stated_origin = {key: words for key, words in ((TIMES, times), (PIXELS_OF, pixels)) if words}
    setup = dataclasses.replace(source.setup, origin={**source.setup.origin, **stated_origin})
    notes = [f'the time is that {times}' * bool(times)]
    notes += [f'pixels of the camera: {pixels}' * bool(pixels)]
    return dataclasses.replace(source, setup=setup, notes=(*source.notes, *filter(None, notes)))


def _half_turned(stars: by_stars.FromStars) -> by_stars.FromStars:
    """The same of images mirrored top to bottom: those mirrored left to right, turned by 180."""
    camera = stars.camera
    values = dict(zip(camera.parameter_names, camera.parameters.tolist(), strict=True))
    changes = {'cx': camera.width - 1 - values['cx'], 'cy': camera.height - 1 - values['cy']}
    changes |= {name: -values[name] for name in ('p1', 'p2') if name in values}
    turn = Rotation.from_euler('z', math.pi)
    rotations = {time_ns: one * turn for time_ns, one in stars.icrf_from_camera.items()}
    return dataclasses.replace(stars, camera=camera.replace(**changes), icrf_from_camera=rotations)


def _images(
    photographs: Sequence[image_files.Photograph],
    refusals: image_files.Refusals,
    channel: str = '',
    is_rendered: bool | None = None,
    is_mirrored: bool = False,
) -> Iterator[Image]:
    """Images of the files that can be decoded, mirrored back if they are mirrored."""
    for one in photographs:
        with refusals.of(one.path):
            pixels = image_files.pixels_of_photograph(one.path, channel, is_rendered, one.flip)
            yield Image(one.time_ns, pixels[:, ::-1].copy() if is_mirrored else pixels)


def _tone_curve(
    photographs: Sequence[image_files.Photograph],
    stars: by_stars.FromStars,
    catalog: StarCatalog,
    channel: str,
) -> tuple[bool | None, list[str]]:
    """
    True if images of 8 bit are rendered in sRGB, False if they are linear, and a sentence on it.

    None, without a sentence, unless the brightnesses of their stars contradict what is assumed:
    that colour is rendered, and other images are linear.
    """
    none = image_files.Refusals()
    shown = [one for one in photographs if one.time_ns in stars.icrf_from_camera][:_FEW]
    if any(image.pixels.dtype != np.uint8 for image in _images(shown, none, channel, False)):
        return None, []
    assumed = any(image.pixels.dtype != np.uint8 for image in _images(shown, none, channel))
    scatter_mag = {}
    for is_rendered in (False, True):
        images = _images(shown, none, channel, is_rendered, stars.mirrored)
        errors_mag = np.concatenate(
            [by_stars.brightness_errors_mag(image, stars, catalog) for image in images]
        )
        if len(errors_mag) < _FEWEST_BRIGHTNESSES:
            return None, []
        scatter_mag[is_rendered] = MAD_TO_SIGMA * float(np.median(np.abs(errors_mag)))
    if scatter_mag[not assumed] > _CLEARLY_LESS * scatter_mag[assumed]:
        return None, []
    words = 'linear: no sRGB curve is' if assumed else 'rendered: the sRGB curve is'
    sentence = (
        f'the images are {words} undone, since the brightnesses of their stars scatter by'
        f' {scatter_mag[not assumed]:.1f} mag so, and by {scatter_mag[assumed]:.1f} otherwise'
    )
    return not assumed, [sentence]


def from_bags(
    bags: Sequence[Path],
    topics: Topics,
    values: Mapping[str, object],
    folder: Path,
    lens: tuple[float, float] = (0.0, 0.0),
) -> Source:
    """
    Source of a calibration of bags without attitudes; attitudes by the stars go into a folder.

    Raises NotFromStars when the stars give no camera, or the images are mirrored.
    """
    stars = camera_of_bags(bags, choose_image_topic(bags, topics), values, lens=lens)
    types = {topic.type_name for topic in reader.topics(bags)}
    is_located = VELOCITY_TYPE in types or bool({'observer', 'observer_velocity_m_s'} & {*values})
    note = ''
    if is_located and min(stars.icrf_from_camera) < CLOCKS_SET_NS:
        values, note = _at_unknown_time(values)
    return _set_up(stars, bags, values, folder, is_located, topics, [note] * bool(note))


def _at_unknown_time(values: Mapping[str, object]) -> tuple[dict[str, object], str]:
    """Options for images without a date, and a note on a site: its zenith is unknown too."""
    has_site = any(values.get(name, nowhere) != nowhere for name, nowhere in _NOWHERE.items())
    note = 'the site is not used: the images have no date' * has_site
    return {'velocity_sigma_m_s': EARTH_M_S, **values, **_NOWHERE}, note


def camera_of_bags(
    bags: Sequence[Path],
    topic: str,
    values: Mapping[str, object],
    most: int | None = None,
    lens: tuple[float, float] = (0.0, 0.0),
) -> by_stars.FromStars:
    """
    Camera and rotations of the images of bags, at most the first few.

    ``lens`` is the focal length (mm) and the pixel size (um), 0 where not given.
    Raises NotFromStars when the stars give no camera, or the images are mirrored.
    """
    read = reader.read_images(bags, topic, channel=str(values.get('image_channel', '')))
    refused: list[StarObservations] = []
    images = itertools.islice(_of_one_size(read, refused), most)
    first, hints = next(images, None), {}
    if first is not None and all(lens):
        height, width = first.pixels.shape
        focal_px = 1000.0 * lens[0] / lens[1]
        hints = {image_files.GIVEN: by_stars.ideal_camera((width, height), focal_px)}
    catalog, every = _catalog_of(values), itertools.chain([first] if first else [], images)
    try:
        stars = _found(every, values, catalog, hints)
    except NotFromStars as error:
        if not refused:
            raise
        words = f'{len(refused)} images refused as {refused[0].refusal}: {refused[0].detail}'
        raise NotFromStars(f'{topic}: {words}; {error}') from error
    if stars.mirrored:
        raise NotFromStars('the images are mirrored: mirror them where they are read out')
    return stars


def _of_one_size(
    records: Iterable[Image | StarObservations], refused: list[StarObservations]
) -> Iterator[Image]:
    """Images of the size of the first: a calibration refuses the others as ``wrong_size``."""
    shape = None
    for image in records:
        if isinstance(image, StarObservations):
            refused.append(image)
        elif image.pixels.shape == (shape or image.pixels.shape):
            shape = image.pixels.shape
            yield image


def _found(
    images: Iterator[Image],
    values: Mapping[str, object],
    catalog: StarCatalog,
    hints: Mapping[str, CameraModel],
    places: Sequence[tuple[float, float]] = (),
) -> by_stars.FromStars:
    """
    Camera and rotations; the camera file of the options has priority over the hints.

    ``hints`` are cameras by what states them, ``places`` the right ascensions and declinations
    (degrees) that images state.
    """
    if url := str(values.get('camera_info_url', '')):
        hints = {url: read_camera_info(url)}
    too_few = stated_facts.too_few_stars(hints, catalog, bool(values.get('catalog')), places)
    least = option_groups(values)['calibration'].min_images
    try:
        return by_stars.from_stars(images, catalog, [*hints.values()], least, too_few)
    finally:
        if values.get('catalog'):  # another reading of the file would not use them
            search.forget_indices()


def _catalog_of(values: Mapping[str, object]) -> StarCatalog:
    path = str(values.get('catalog', ''))
    return load_catalog(Path(path) if path else None)


def _set_up(
    stars: by_stars.FromStars,
    bags: Sequence[Path],
    values: Mapping[str, object],
    folder: Path,
    is_located: bool,
    given: Topics,
    notes: Sequence[str] = (),
) -> Source:
    from starcal_ground.bag_writer import BagWriter  # as above

    attitudes = folder / 'attitudes.mcap'
    with BagWriter(attitudes) as writer:
        for time_ns in sorted(stars.icrf_from_camera):
            xyzw = stars.icrf_from_camera[time_ns].as_quat()
            writer.write_attitude(_ATTITUDE_TOPIC, time_ns, xyzw, 'icrf')
    prior = CameraGeometry(stars.camera, np.array([0.0, 0.0, 0.0, 1.0]))
    # Nobody has stated a lens: beyond the stars a wrong one is off by more than any field shows.
    stated = {} if values.get('camera_info_url') else {'lens_model': 'auto'}
    setup = load_setup({**stated, **by_stars.options_of(values)}, prior=prior)
    setup = dataclasses.replace(setup, origin={FOUND: 'camera'})
    notes = [*notes, stars.in_a_sentence()]
    if unused := stated_tracker(values):
        notes.append(f'not used, since the attitudes are those of the stars: {", ".join(unused)}')
    topics = dataclasses.replace(given, attitude=_ATTITUDE_TOPIC)
    is_located = is_located and (setup.site.observer == 'space' or setup.site.is_known)
    through_air = functools.partial(_through_air, stars, setup.site, is_located)
    return Source((*bags, attitudes), topics, setup, through_air, tuple(notes))
