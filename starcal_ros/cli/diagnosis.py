"""`starcal diagnose`: the images and attitudes of bags, and why they do not go together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.bag import reader
from starcal_ros.errors import BagError, ImageRefused
from starcal_ros.messages.telemetry import attitude_from_message
from starcal_ros.pipeline import topics as bag_topics
from starcal_ros.pipeline.attitude_reading import SetUp, WireAttitudes
from starcal_ros.pipeline.diagnose import diagnose, Diagnosis
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.topics import Topics
from starcal_ros.records import Image

_NORM_TOLERANCE = 1e-3


def of_bags(paths: Sequence[Path], asked: Topics, setup: Setup) -> Diagnosis:
    """
    Why the first images of bags match nothing.

    Raises
    ------
    BagError
        When a bag cannot be read, or holds no images with attitudes.
    """
    topics = bag_topics.choose_topics(paths, asked, setup)
    if topics.observations:
        raise BagError(f'{paths[0]}: no images to look at, only observations')
    attitudes = _attitudes(paths, topics.attitude)
    return diagnose(_images(paths, topics.image, setup), attitudes, _set_up(setup), setup.catalog)


def content(found: Diagnosis) -> dict[str, object]:
    """A diagnosis as a JSON object."""
    return {
        'cause': found.cause,
        'found': found.found,
        'sentence': found.sentence,
        'evidence': list(found.evidence),
        'mend': list(found.mend),
    }


def text(found: Diagnosis) -> str:
    """A diagnosis in words."""
    lines = [found.sentence, '', 'how it is known:', *(f'  {line}' for line in found.evidence)]
    if found.mend:
        lines += ['', 'in the parameter file:', *(f'  {line}' for line in found.mend)]
    return '\n'.join(lines)


def in_a_sentence(paths: Sequence[Path], asked: Topics, setup: Setup) -> str:
    """The diagnosis of bags as the end of a complaint; empty where it finds nothing wrong."""
    try:
        found = of_bags(paths, asked, setup)
    except BagError:
        return ''
    if found.cause == 'none':
        return ''
    lines = '; '.join(line for line in found.mend if not line.startswith('#'))
    return f'{found.sentence}{f" Set {lines}." if lines else ""} (starcal diagnose says more)'


def _images(paths: Sequence[Path], topic: str, setup: Setup) -> Iterator[Image]:
    offset_s, channel = setup.attitude.stamp_offset_s, setup.frames.image_channel
    for image in reader.read_images(paths, topic, offset_s, channel=channel):
        if isinstance(image, Image):
            yield image


def _attitudes(paths: Sequence[Path], topic: str) -> WireAttitudes:
    """Every attitude that is a rotation, in time order, its numbers as they were sent."""
    stamps: list[int] = []
    numbers = []
    for raw in reader.read_raw(paths, [topic]):
        try:
            time_ns, quaternion = attitude_from_message(reader.decode(raw))
        except (BagError, ImageRefused):
            continue
        norm = float(np.linalg.norm(quaternion))
        if math.isfinite(norm) and abs(norm - 1.0) <= _NORM_TOLERANCE:
            stamps.append(time_ns)
            numbers.append(quaternion / norm)
    stamps_ns, first = np.unique(np.array(stamps, np.int64), return_index=True)
    return WireAttitudes(stamps_ns, np.array(numbers, np.float64).reshape(-1, 4)[first])


def _set_up(setup: Setup) -> SetUp:
    return SetUp(
        camera=setup.prior.camera,
        star_tracker_from_camera=Rotation.from_quat(setup.prior.star_tracker_from_camera_xyzw),
        attitude_direction=setup.attitude.attitude_direction,
        stamp_offset_s=setup.attitude.stamp_offset_s,
        max_attitude_gap_s=setup.attitude.max_attitude_gap_s,
        acquisition_rad=math.radians(setup.identification.acquisition_radius_deg),
        acquisition_roll_rad=math.radians(setup.identification.acquisition_roll_deg),
    )
