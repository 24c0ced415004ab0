# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observations of the images of bags; the nodes, which read none, do without."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from starcal_ros.formats.bag.frames import Frame, read_frames
from starcal_ros.formats.bag.reader import Topics
from starcal_ros.pipeline.observe import observe_next, Track
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Image, StarObservations

Wanted = Callable[[int], bool]
OnImage = Callable[[Image, StarObservations, CameraGeometry], None]


def observe_bag(
    paths: Sequence[Path],
    topics: Topics,
    setup: Setup,
    on_image: OnImage | None = None,
    wanted: Wanted | None = None,
) -> Iterator[StarObservations]:
    """
    Observations of every image of a bag, in bag order, with few images in memory at a time.

    ``on_image`` is called with each decoded image, its observations and the geometry that
    predicted its stars.  Images whose stamp is not ``wanted`` are skipped.  Raises BagError when
    the bag cannot be read or a topic is not in it.
    """
    track = Track(setup.prior)
    for frame in _frames(paths, topics, setup):
        if isinstance(frame, StarObservations):
            yield frame
        elif wanted is None or wanted(frame.image.time_ns):
            predicted_with = track.geometry
            observations, track = _of_frame(frame, setup, track)
            if on_image is not None:
                on_image(frame.image, observations, predicted_with)
            yield observations


def measured_again(
    paths: Sequence[Path],
    topics: Topics,
    setup: Setup,
    geometry: CameraGeometry,
    observations: Sequence[StarObservations],
) -> list[StarObservations]:
    """
    Observations of bags; images refused as ``no_match`` are measured again with a calibration.

    An image without a match in the second attempt keeps its first refusal.
    """
    wanted = {record.time_ns for record in observations if record.refusal == 'no_match'}
    if not wanted or not topics.image:
        return list(observations)
    again: dict[int, StarObservations] = {}
    for frame in _frames(paths, topics, setup):
        if isinstance(frame, Frame) and frame.image.time_ns in wanted - again.keys():
            record, _ = _of_frame(frame, setup, Track(geometry))
            if not record.refusal:
                again[record.time_ns] = record
    return [
        again.get(record.time_ns, record) if record.refusal == 'no_match' else record
        for record in observations
    ]


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
