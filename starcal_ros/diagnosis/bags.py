# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The diagnosis of bags, and the prior alignment that their images show where none is given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
from itertools import islice
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.bag import reader
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.diagnosis.attitude_reading import SetUp, WireAttitudes
from starcal_ros.diagnosis.diagnose import diagnose, Diagnosis
from starcal_ros.diagnosis.identified import LOOKED_AT
from starcal_ros.diagnosis.refusals import of_refusals, of_two_clocks, UNREADABLE
from starcal_ros.errors import BagError, ImageRefused, OptionError
from starcal_ros.messages.telemetry import attitude_from_message
from starcal_ros.pipeline import topics as bag_topics
from starcal_ros.pipeline.inspect import placed, refusals, Refused
from starcal_ros.pipeline.setup import aligned, Setup
from starcal_ros.pipeline.topics import Topics
from starcal_ros.records import Image, StarObservations

_NORM_TOLERANCE = 1e-3
IMAGES_OF_AN_ALIGNMENT = 3
_MEASURED = 10  # images, for the reason of their refusal


def diagnose_bags(
    paths: Sequence[Path], asked: Topics, setup: Setup, refused: Sequence[Refused] = ()
) -> Diagnosis:
    """
    Why the images of bags cannot be used: by their refusals, by their stamps, by their stars.

    ``refused`` are the images of a calibration in which all were refused; without them the first
    images are measured where the sky does not name the cause.

    Raises
    ------
    BagError
        When a bag cannot be read, or holds no images with attitudes.
    """
    topics = bag_topics.choose_topics(paths, asked, setup)
    if topics.observations:
        raise BagError(f'{paths[0]}: no images to look at, only observations')
    channel = setup.frames.image_channel
    first = tuple(islice(placed(paths, topics, setup.attitude, channel), LOOKED_AT))
    unread = of_refusals(refusals(first), len(first))
    if unread is not None and unread.cause in UNREADABLE and unread.found == len(first):
        return unread
    if not topics.attitude:
        raise BagError(f'{paths[0]}: no attitudes of the first star tracker, only of others')
    attitudes = _attitudes(paths, topics.attitude)
    spans = _without_common_time(first, attitudes)
    shift_ns = spans[1][0] - spans[0][0] if spans else 0
    given = dataclasses.replace(set_up(setup), shift_s=shift_ns / NANOSECONDS_PER_SECOND)
    images = _images(paths, topics.image, setup, shift_ns)
    found = diagnose(images, attitudes, given, setup.catalog)
    if spans:
        return found if found.cause == 'clock' else of_two_clocks(*spans)
    if found.cause not in ('none', 'unknown', 'no_stars'):
        return found
    if not refused and setup.is_aligned:
        measured = tuple(islice(bag_topics.read(paths, topics, setup), _MEASURED))
        refused = refusals(measured) if all(one.refusal for one in measured) else ()
    count = sum(group.count for group in refused)
    by_itself = [one for one in refused if one.reason not in ('no_match', 'no_stars')]
    return of_refusals(by_itself, count) or found


def aligned_by_bags(paths: Sequence[Path], asked: Topics, setup: Setup) -> tuple[Setup, str]:
    """
    A setup with the alignment that the images show where none is given, and a sentence on it.

    Recorded observations need none: their stars are identified.

    Raises
    ------
    BagError
        When a bag cannot be read.
    OptionError
        When fewer than three images agree.
    """
    if setup.is_aligned or bag_topics.choose_topics(paths, asked, setup).observations:
        return setup, ''
    values, sentence = found_alignment(diagnose_bags(paths, asked, setup))
    if values is None:
        raise OptionError(f'prior_alignment: not given, and not found: {sentence}')
    return aligned(setup, np.array(values)), sentence


def found_alignment(found: Diagnosis) -> tuple[list[float] | None, str]:
    """The alignment of a diagnosis without a prior one, or None, with a sentence on it."""
    if found.cause != 'prior_alignment' or not isinstance(found.found, list):
        return None, found.in_a_sentence()
    if found.images < IMAGES_OF_AN_ALIGNMENT:
        return None, (f'{found.images} images agree, {IMAGES_OF_AN_ALIGNMENT} are needed.')
    return found.found, (
        f'prior_alignment is not given: found {found.found} from {found.images} images that agree.'
    )


def _without_common_time(
    images: Sequence[StarObservations], attitudes: WireAttitudes
) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """First and last stamp of images and of attitudes, ns; None if the two spans overlap."""
    if not images or not len(attitudes.time_ns):
        return None
    stamps = [image.time_ns for image in images]
    spans = (
        (min(stamps), max(stamps)),
        (int(attitudes.time_ns[0]), int(attitudes.time_ns[-1])),
    )
    apart = spans[0][1] < spans[1][0] or spans[1][1] < spans[0][0]
    return spans if apart else None


def _images(paths: Sequence[Path], topic: str, setup: Setup, shift_ns: int = 0) -> Iterator[Image]:
    offset_s, channel = setup.attitude.stamp_offset_s, setup.frames.image_channel
    for image in reader.read_images(paths, topic, offset_s, channel=channel):
        if isinstance(image, Image):
            yield Image(image.time_ns + shift_ns, image.pixels)


def _attitudes(paths: Sequence[Path], topic: str) -> WireAttitudes:
    """Every attitude of bags that is a rotation, in time order."""
    stamps: list[int] = []
    numbers = []
    for raw in reader.read_raw(paths, [topic]):
        try:
            time_ns, quaternion = attitude_from_message(reader.decode(raw))
        except (BagError, ImageRefused):
            continue
        stamps.append(time_ns)
        numbers.append(quaternion)
    return wire_attitudes(stamps, numbers)


def wire_attitudes(stamps_ns: Sequence[int], quaternions: Sequence[Floats]) -> WireAttitudes:
    """Attitudes that are rotations, in time order, their numbers as they were sent."""
    numbers = np.array(quaternions, np.float64).reshape(-1, 4)
    norm = np.linalg.norm(numbers, axis=1)
    good = np.abs(norm - 1.0) <= _NORM_TOLERANCE  # false for NaN
    times = np.array(stamps_ns, np.int64)[good]
    times, first = np.unique(times, return_index=True)
    return WireAttitudes(times, (numbers[good] / norm[good, None])[first])


def set_up(setup: Setup) -> SetUp:
    """The part of a setup that is held against the images."""
    prior = setup.prior
    return SetUp(
        camera=prior.camera,
        star_tracker_from_camera=Rotation.from_quat(prior.star_tracker_from_camera_xyzw)
        if setup.is_aligned
        else None,
        attitude_direction=setup.attitude.attitude_direction,
        stamp_offset_s=setup.attitude.stamp_offset_s,
        max_attitude_gap_s=setup.attitude.max_attitude_gap_s,
        acquisition_rad=math.radians(setup.identification.acquisition_radius_deg),
        acquisition_roll_rad=math.radians(setup.identification.acquisition_roll_deg),
    )
