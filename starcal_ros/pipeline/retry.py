# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images refused for want of a match, measured again with the calibration of the others."""

from __future__ import annotations

from collections.abc import Sequence
import math
import operator
from pathlib import Path

from starcal_ros.bag import reader
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.topics import Topics
from starcal_ros.records import CameraGeometry, Image, StarObservations


def measured_again(
    paths: Sequence[Path],
    topics: Topics,
    setup: Setup,
    geometry: CameraGeometry,
    observations: Sequence[StarObservations],
) -> list[StarObservations]:
    """
    Observations of bags, those refused with ``no_match`` measured again with a calibration.

    An image that still matches nothing keeps its first refusal.
    """
    wanted = {record.time_ns for record in observations if record.refusal == 'no_match'}
    if not wanted or not topics.image:
        return list(observations)
    attitudes = reader.read_attitudes(paths, topics.attitude, setup.attitude)
    by_time = operator.itemgetter(0)
    velocities = (
        sorted(reader.read_velocities(paths, topics.velocity), key=by_time)
        if topics.velocity
        else []
    )
    temperatures = (
        sorted(reader.read_temperatures(paths, topics.temperature), key=by_time)
        if topics.temperature
        else []
    )
    again: dict[int, StarObservations] = {}
    for image in reader.read_images(paths, topics.image, setup.attitude.stamp_offset_s):
        if isinstance(image, Image) and image.time_ns in wanted and image.time_ns not in again:
            record, _ = observe.observe_next(
                image,
                attitudes,
                setup,
                observe.Track(geometry),
                observe.latest_at(velocities, image.time_ns, None),
                observe.latest_at(temperatures, image.time_ns, math.nan),
            )
            if not record.refusal:
                again[image.time_ns] = record
    return [
        again.get(record.time_ns, record) if record.refusal == 'no_match' else record
        for record in observations
    ]
