# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images refused for want of a match, measured again with the calibration of the others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from starcal_ros.bag.frames import FrameTopics, read_frames
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.topics import Topics
from starcal_ros.records import CameraGeometry, StarObservations


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
    named = FrameTopics(
        topics.image,
        topics.attitude,
        topics.velocity,
        topics.temperature,
        topics.more_attitudes,
    )
    camera = setup.prior.camera
    again: dict[int, StarObservations] = {}
    size, channel = (camera.width, camera.height), setup.frames.image_channel
    for frame in read_frames(paths, named, setup.attitude, size=size, channel=channel):
        if isinstance(frame, StarObservations) or frame.image.time_ns not in wanted - again.keys():
            continue
        record, _ = observe.observe_next(
            frame.image,
            frame.attitudes,
            setup,
            observe.Track(geometry),
            frame.velocity_m_s,
            frame.temperature_degc,
            frame.more_attitudes,
        )
        if not record.refusal:
            again[frame.image.time_ns] = record
    return [
        again.get(record.time_ns, record) if record.refusal == 'no_match' else record
        for record in observations
    ]
