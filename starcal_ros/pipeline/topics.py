"""Which topics of a bag a calibration is made from."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from starcal_ros.bag import reader
from starcal_ros.errors import BagError
from starcal_ros.messages.types import (
    ATTITUDE_TYPE,
    COMPRESSED_TYPE,
    IMAGE_TYPE,
    OBSERVATIONS_TYPE,
    TEMPERATURE_TYPE,
    VELOCITY_TYPE,
)
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.observe import OnImage
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import StarObservations


@dataclass(frozen=True)
class Topics:
    """A topic for each kind of message: asked for, or found; empty: not said, or none."""

    image: str = ''
    attitude: str = ''
    velocity: str = ''
    temperature: str = ''
    observations: str = ''


def choose_topics(paths: Sequence[Path], asked: Topics, setup: Setup | None = None) -> Topics:
    """
    The topics that a calibration of bags reads: images and what goes with them, or observations.

    A topic that was not asked for is the only one of its type.  Recorded observations are taken
    where they were asked for, or where there are no images.

    Raises
    ------
    BagError
        When a topic is not there, or there are several of its type.
    """
    there = reader.topics(paths)
    types = {topic.type_name for topic in there}
    image_types = [t for t in (IMAGE_TYPE, COMPRESSED_TYPE) if t in types]
    only_recorded = not image_types and OBSERVATIONS_TYPE in types
    if asked.observations or (only_recorded and not asked.image):
        kind = OBSERVATIONS_TYPE
        return Topics(observations=_choose(paths, kind, asked.observations, 'observations'))
    image_type = next(iter(image_types), IMAGE_TYPE)
    for kind in image_types:
        if any(t.type_name == kind and t.name == f'/{asked.image.lstrip("/")}' for t in there):
            image_type = kind
    image = _choose(paths, image_type, asked.image, 'image')
    attitude = _choose(paths, ATTITUDE_TYPE, asked.attitude, 'attitude')
    velocity, temperature = asked.velocity, asked.temperature
    if velocity or VELOCITY_TYPE in types:
        velocity = _choose(paths, VELOCITY_TYPE, velocity, 'velocity')
    options = setup.calibration if setup else None
    used = options and (options.focal_temperature_order or options.alignment_temperature)
    thermometers = sum(topic.type_name == TEMPERATURE_TYPE for topic in there)
    # A spacecraft has many: which one is the camera's matters only where it is made use of.
    if temperature or thermometers == 1 or (thermometers and used):
        temperature = _choose(paths, TEMPERATURE_TYPE, temperature, 'temperature')
    return Topics(image, attitude, velocity, temperature)


def _choose(paths: Sequence[Path], type_name: str, asked: str, what: str) -> str:
    try:
        return reader.choose_topic(paths, type_name, asked)
    except BagError as error:
        raise BagError(f'{error}; --{what}-topic names it') from error


def read(
    paths: Sequence[Path], topics: Topics, setup: Setup, on_image: OnImage | None = None
) -> Iterator[StarObservations]:
    """Observations of bags, measured in images that ``on_image`` is shown, or as recorded."""
    if topics.observations:
        return reader.read_observations(paths, topics.observations)
    return observe.observe_bag(
        paths, topics.image, topics.attitude, setup, topics.velocity, topics.temperature, on_image
    )


def count(paths: Sequence[Path], topics: Topics) -> int:
    """How many observations `read` gives."""
    wanted = topics.observations or topics.image
    return sum(topic.count for topic in reader.topics(paths) if topic.name == wanted)
