# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Topics of bags that a calibration reads, and the star observations of their images."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import dataclasses
from pathlib import Path
import re

from starcal_ground.bags import reader
from starcal_ground.bags.frames import Frame, read_frames
from starcal_ground.bags.reader import OF_THE_STARS
from starcal_ground.bags.reader import Topics as Topics
from starcal_ros.constants import CLOCKS_SET_NS, utc_text
from starcal_ros.errors import BagError
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.pipeline.observe import observe_next, Track
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Image, StarObservations
from starcal_ros.text import counted

_OF_A_STAR_TRACKER = (
    *('prior_alignment', 'star_tracker_sigma_arcsec', 'star_tracker_slow_arcsec'),
    'more_star_trackers',
)
_LIKE_ATTITUDES = re.compile('Odometry|Pose|TFMessage|Transform|Quaternion|Attitude|Orientation')
_CAMERA_ALONE = 'starcal calibrate --camera-alone estimates the camera without an alignment'

Wanted = Callable[[int], bool]
OnImage = Callable[[Image, StarObservations, CameraGeometry], None]

_RAW = codec.IMAGE_TYPE
_WITHOUT = {
    'image': 'record the images, or make a bag of image files with starcal import',
    'attitude': (
        'record the attitudes of the star tracker, give the bag that holds them as well, or make'
        ' a bag of both with starcal import'
    ),
}


def choose_topics(paths: Sequence[Path], requested: Topics, setup: Setup | None = None) -> Topics:
    """
    Topics that a calibration of bags reads: images and telemetry, or recorded observations.

    A topic that was not requested must be the only one of its type.  Recorded observations are
    read if they are requested or the bags hold no images.  Raises BagError when a topic is
    missing, or several have its type.
    """
    there = reader.topics(paths)
    kinds = {topic.type_name for topic in there}
    only_recorded = kinds.isdisjoint(codec.IMAGE_TYPES) and codec.OBSERVATIONS_TYPE in kinds
    if requested.observations or (only_recorded and not requested.image):
        kind = codec.OBSERVATIONS_TYPE
        recorded = _choose(paths, kind, requested.observations, 'observations')
        return _without_others(there, Topics(observations=recorded))
    image = choose_image_topic(paths, requested)
    attitude, more = _choose_attitudes(paths, there, requested.attitude, setup)
    velocity, temperature = requested.velocity, requested.temperature
    if velocity or codec.VELOCITY_TYPE in kinds:
        velocity = _choose(paths, codec.VELOCITY_TYPE, velocity, 'velocity')
    options = setup.calibration if setup else None
    used = options and (options.focal_temperature_order or options.alignment_temperature)
    thermometers = sum(topic.type_name == codec.TEMPERATURE_TYPE for topic in there)
    # A spacecraft has many: the topic must be unique only if the calibration uses it.
    if temperature or thermometers == 1 or (thermometers and used):
        temperature = _choose(paths, codec.TEMPERATURE_TYPE, temperature, 'temperature')
    chosen = Topics(image, attitude, velocity, temperature, more_attitudes=more)
    return _without_others(there, chosen)


def _without_others(there: Sequence[reader.Topic], chosen: Topics) -> Topics:
    """Return the chosen topics, with a warning of messages on them that are not read."""
    names = {name for name, _ in chosen.read}
    for topic in there:
        if topic.name in names and (topic.name, topic.type_name) not in chosen.read:
            reader.log_damage(
                f'{topic.name}: {counted(topic.count, "message")} of {topic.type_name} not read'
            )
    return chosen


def choose_image_topic(paths: Sequence[Path], requested: Topics) -> str:
    """Topic of the images of bags; raises BagError when it is missing, or there are several."""
    there = [t for t in reader.topics(paths) if t.type_name in codec.IMAGE_TYPES]
    there.sort(key=lambda t: (t.name != f'/{requested.image.lstrip("/")}', t.type_name != _RAW))
    return _choose(paths, there[0].type_name if there else _RAW, requested.image, 'image')


def _choose_attitudes(
    paths: Sequence[Path], there: Sequence[reader.Topic], requested: str, setup: Setup | None
) -> tuple[str, tuple[str, ...]]:
    """
    Topics of the first and of each further star tracker; empty, with a warning: not in the bags.

    A star tracker may drop out, but not all of them.
    """
    # All types on a topic are read; the first of `ATTITUDE_TYPES` among them states its purpose.
    kinds = {
        topic.name: kind
        for kind in reversed(codec.ATTITUDE_TYPES)
        for topic in there
        if topic.type_name == kind
    }
    named = [f'/{one.frame.lstrip("/")}/attitude' for one in setup.mountings] if setup else []
    more = tuple(name if name in kinds else '' for name in named)
    for name in set(named) - set(more):
        reader.log_damage(
            f'{name}: no such topic of attitudes; the star tracker that more_star_trackers names'
            ' is left out'
        )
    first = [name for name in sorted(kinds) if name not in named]
    if setup and not (requested or first) and any(more):
        reader.log_damage(
            'no topic of attitudes but those of more_star_trackers; the first star tracker,'
            f' {setup.frames.star_tracker_frame}, is left out'
        )
        return '', more
    # Poses, transforms and orientations of an Imu may be those of anything else.
    likely = [name for name in first if kinds[name] == codec.ATTITUDE_TYPE] or first
    if len(likely) > 1 and not requested:
        listed = ', '.join(f'{name} ({kinds[name].rpartition("/")[2]})' for name in likely)
        raise BagError(
            f'{", ".join(map(str, paths))}: several topics may hold the attitudes: {listed};'
            ' choose one with --attitude-topic'
        )
    name = requested or ''.join(likely)
    own = [kind for topic, kind in kinds.items() if topic.lstrip('/') == name.lstrip('/')]
    try:
        return _choose(paths, own[0] if own else codec.ATTITUDE_TYPE, name, 'attitude'), more
    except BagError as error:
        alone = '' if first else f'; {_CAMERA_ALONE}'
        raise BagError(f'{error}{_not_read(there, requested)}{alone}') from error


def _not_read(there: Sequence[reader.Topic], requested: str) -> str:
    """Return which topics seem to hold attitudes in messages that are not read, and the remedy."""
    return ''.join(
        f'; {topic.name} is a {topic.type_name.rpartition("/")[2]}, which is not read: publish its'
        ' orientation as a QuaternionStamped or PoseStamped, and choose that with --attitude-topic'
        for topic in there
        if topic.type_name not in codec.ATTITUDE_TYPES
        and _LIKE_ATTITUDES.search(topic.type_name.rpartition('/')[2])
        and (not requested or topic.name.lstrip('/') == requested.lstrip('/'))
    )


def _choose(paths: Sequence[Path], type_name: str, requested: str, what: str) -> str:
    try:
        return reader.choose_topic(paths, type_name, requested)
    except BagError as error:
        several = any(topic.type_name == type_name for topic in reader.topics(paths))
        # Messages that are lost with a part of the file were recorded.
        missing = '' if reader.damage_of(paths) else _WITHOUT.get(what, '')
        remedy = f'choose one with --{what}-topic' if several else missing
        raise BagError(f'{error}{remedy and "; "}{remedy}') from error


def warn_of_clock(time_ns: int) -> None:
    """Log a warning, once, where a stamp is of a clock that was never set."""
    if time_ns < CLOCKS_SET_NS:
        reader.log_damage(
            f'images are stamped before {utc_text(CLOCKS_SET_NS)[:10]}: the clock was not set, and'
            ' motions of stars and velocity of the Earth are those of a wrong date, which the'
            ' sigmas do not include: stamp images and attitudes in UTC'
        )


def read(
    paths: Sequence[Path],
    topics: Topics,
    setup: Setup,
    on_image: OnImage | None = None,
    wanted: Wanted | None = None,
    is_sequence: bool = True,
) -> Iterator[StarObservations]:
    """
    Observations of bags, as recorded or measured in the images, with few images in memory.

    ``on_image`` is called with each decoded image, its observations and the geometry that
    predicted its stars.  Images whose stamp is not ``wanted`` are skipped.  Unless they are a
    sequence, each is measured without those before it.  Raises BagError when the bag cannot be
    read or a topic is not in it.
    """
    if topics.observations:
        for record in reader.read_observations(paths, topics.observations):
            if wanted is not None and not wanted(record.time_ns):
                continue
            if record.star_tracker == OF_THE_STARS:
                if setup.has_tracker:
                    raise BagError(
                        f'{paths[0]}: observations of a camera alone, where a star tracker is set'
                        ' up: starcal calibrate takes them without one'
                    )
                record = dataclasses.replace(record, star_tracker='')
            yield record
        return
    track = Track(setup.prior)
    for frame in _frames(paths, topics, setup):
        time_ns = frame.time_ns if isinstance(frame, StarObservations) else frame.image.time_ns
        if wanted is not None and not wanted(time_ns):
            continue
        if isinstance(frame, StarObservations):
            yield frame
        else:
            warn_of_clock(time_ns)
            track = track if is_sequence else Track(setup.prior)
            # The stamps of a bag are all known: these are not images of a wrong stamp.
            if track.latest_ns is not None and time_ns < track.latest_ns:
                track = _rewound(track)
            predicted_with = track.geometry
            observations, track = _of_frame(frame, setup, track)
            if on_image is not None:
                on_image(frame.image, observations, predicted_with)
            yield observations


def _frames(
    paths: Sequence[Path], topics: Topics, setup: Setup
) -> Iterator[Frame | StarObservations]:
    size = (setup.prior.camera.width, setup.prior.camera.height)
    channel = setup.frames.image_channel
    return read_frames(paths, topics, setup.attitude, size=size, channel=channel)


def _of_frame(frame: Frame, setup: Setup, track: Track) -> tuple[StarObservations, Track]:
    return observe_next(
        frame.image,
        frame.attitudes,
        setup,
        track,
        frame.velocity_m_s,
        frame.temperature_degc,
        frame.more_attitudes,
    )


def without_attitudes(
    bags: Sequence[Path],
    requested: Topics,
    options: Mapping[str, object],
    camera_alone: bool = False,
) -> bool:
    """
    Return True if bags of images are to be calibrated by their stars alone.

    So are bags without attitudes and observations, unless the options state a star tracker, which
    is then missing; and all bags if the camera alone is requested.
    """
    there = reader.topics(bags)
    kinds = {topic.type_name for topic in there}
    has_images = not kinds.isdisjoint(codec.IMAGE_TYPES)
    if camera_alone:
        return has_images
    others = {*codec.ATTITUDE_TYPES, codec.OBSERVATIONS_TYPE}
    by_stars = not (kinds & others or requested.attitude or stated_tracker(options))
    if has_images and by_stars and (unread := _not_read(there, '')):
        reader.log_damage(f'no attitude is read, so the camera alone is calibrated{unread}')
    return has_images and by_stars


def stated_tracker(options: Mapping[str, object]) -> list[str]:
    """Names of the options that state a star tracker."""
    values = {name: options.get(name) or () for name in _OF_A_STAR_TRACKER}
    # A bad value is refused where the options are read.
    return [
        name for name, value in values.items() if not isinstance(value, Iterable) or any(value)
    ]


def _rewound(track: Track) -> Track:
    """State that takes an image of any stamp next, and searches it."""
    trackers = {
        name: dataclasses.replace(tracker, camera=None) for name, tracker in track.trackers.items()
    }
    return dataclasses.replace(track, latest_ns=None, trackers=trackers)
