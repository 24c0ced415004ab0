# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The diagnosis of bags, and the prior alignment that their images show where none is given."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
import math
from pathlib import Path
import re

import erfa
import numpy as np

from starcal_ground.bags import reader
from starcal_ground.bags import topics as bag_topics
from starcal_ground.bags.frames import read_frames, read_telemetry
from starcal_ground.bags.topics import Topics
from starcal_ground.blind.images import LOOKED_AT
from starcal_ground.diagnosis.attitude_readings import wire_attitudes, WireAttitudes
from starcal_ground.diagnosis.diagnose import diagnose, Diagnosis, found_alignment
from starcal_ground.products import refused_stars
from starcal_ros.assessment.remedies import REMEDIES
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.errors import BagError, ImageRefused
from starcal_ros.pipeline.observe import check_order
from starcal_ros.pipeline.setup import aligned, Setup
from starcal_ros.records import Image, IMAGE_REFUSALS, refused_image, StarObservations, StarRefusal
from starcal_ros.sky.attitude import AttitudeOptions
from starcal_ros.sky.catalog import sky_circle

_PLACES = 8  # in the sky that a sentence lists
_CIRCLE = re.compile(r'RA (\S+), Dec (\S+), radius (\S+) deg')  # text made by `sky_circle`
_ONE_QUERY_DEG = 5.0  # radius of the sky of all images that one table can have
_MEASURED = 10  # images, of which one is to be used before others are measured
_STAR_REMEDIES = {
    StarRefusal.FAINT.label: 'expose for longer',
    StarRefusal.SATURATED.label: 'expose for a shorter time',
    StarRefusal.HOT_PIXEL.label: 'check bad_pixel_map and dark_frame',
    StarRefusal.NOT_DETECTED.label: 'check for clouds and dew, or lower magnitude_limit',
}
UNREADABLE = frozenset(['bad_encoding', 'bad_layout', 'bad_stamp', 'bad_attitude'])
"""Refusals after which the sky of an image cannot be held against the set-up."""


@dataclass(frozen=True)
class Refused:
    """
    Images refused for one reason: their count, its meaning, and the first of them.

    ``stars`` are the reasons for which their stars were left out, the most frequent first.
    """

    reason: str
    count: int
    meaning: str
    first_ns: int
    detail: str
    stars: Mapping[str, int] = field(default_factory=dict)


def diagnose_bags(
    paths: Sequence[Path], requested: Topics, setup: Setup, refused: Sequence[Refused] = ()
) -> Diagnosis:
    """
    Why the images of bags cannot be used: by their refusals, by their stamps, by their stars.

    ``none`` where attitudes, alignment and camera fit.  ``refused`` are the images that a
    measurement with the setup has refused, if there was one.  Raises BagError when a bag cannot be
    read, or holds no images with attitudes.
    """
    topics = bag_topics.choose_topics(paths, requested, setup)
    if topics.observations:
        raise BagError(f'{paths[0]}: no images to look at, only observations')
    channel = setup.frames.image_channel
    first = tuple(islice(placed(paths, topics, setup.attitude, channel), LOOKED_AT))
    unread = of_refusals(refusals(first), len(first))
    if unread is not None and unread.cause in UNREADABLE and unread.found == len(first):
        return unread
    if not topics.attitude:
        raise BagError(f'{paths[0]}: no attitudes of the first star tracker, only of others')
    telemetry = read_telemetry(paths, Topics(attitude=topics.attitude), setup.attitude)
    attitudes = wire_attitudes(telemetry.attitudes, setup.attitude.attitude_direction)
    spans = _without_common_time(first, attitudes)
    shift_ns = spans[1][0] - spans[0][0] if spans else 0
    images = _images(paths, topics.image, setup, shift_ns)
    most = refused[0].reason if refused else ''
    shift_s = shift_ns / NANOSECONDS_PER_SECOND
    diagnosis = diagnose(images, attitudes, setup, shift_s, most)
    if spans:
        return diagnosis if diagnosis.cause == 'clock' else of_two_clocks(*spans)
    if diagnosis.cause not in ('unknown', 'no_stars'):
        return diagnosis
    count = sum(group.count for group in refused)
    by_itself = [group for group in refused if group.reason not in ('no_match', 'no_stars')]
    return of_refusals(by_itself, count) or diagnosis


def aligned_by_stars(
    paths: Sequence[Path], requested: Topics, setup: Setup
) -> tuple[Setup, Diagnosis]:
    """
    A setup with the alignment that at least three images show, or as it is, and their diagnosis.

    Raises BagError when a bag cannot be read.
    """
    diagnosis = diagnose_bags(paths, requested, setup)
    values, _ = found_alignment(diagnosis)
    return (setup if values is None else aligned(setup, np.array(values))), diagnosis


def _without_common_time(
    images: Sequence[StarObservations], attitudes: WireAttitudes
) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """First and last stamp of images and of attitudes, ns; None if the two spans overlap."""
    if not images or not len(attitudes.time_ns):
        return None
    stamps = [image.time_ns for image in images]
    spans = ((min(stamps), max(stamps)), (int(attitudes.time_ns[0]), int(attitudes.time_ns[-1])))
    apart = spans[0][1] < spans[1][0] or spans[1][1] < spans[0][0]
    return spans if apart else None


def _images(paths: Sequence[Path], topic: str, setup: Setup, shift_ns: int = 0) -> Iterator[Image]:
    offset_s, channel = setup.attitude.stamp_offset_s, setup.frames.image_channel
    for image in reader.read_images(paths, topic, offset_s, channel=channel):
        if isinstance(image, Image):
            yield Image(image.time_ns + shift_ns, image.pixels)


def of_most(refused: Sequence[Refused], images: int) -> Sequence[Refused]:
    """The refusals if they are of most images, else none: a few may be refused for themselves."""
    return refused if 2 * sum(group.count for group in refused) > images else ()


def of_refusals(refused: Sequence[Refused], images: int) -> Diagnosis | None:
    """The most frequent refusal of some images as their cause; None if none is refused."""
    if not refused:
        return None
    most = refused[0]
    count = 'All' if most.count == images else f'{most.count} of'
    # A detail that has a remedy of its own knows better.
    remedy = '' if ': set ' in most.detail else REMEDIES.get(most.reason)
    detail = most.detail or most.meaning
    if most.reason == 'too_few_stars' and most.stars:
        listed = ', '.join(f'{name} {number}' for name, number in most.stars.items())
        detail = f'{detail}; left out: {listed}'
        remedy = _STAR_REMEDIES.get(next(iter(most.stars)), remedy)
    return Diagnosis(
        most.reason,
        most.count,
        f'{count} {images} images are refused as {most.reason}: {detail}.',
        (f'{most.reason}: {most.meaning}',) if most.meaning else (),
        (f'# {remedy}',) if remedy else (),
    )


def of_two_clocks(images_ns: tuple[int, int], attitudes_ns: tuple[int, int]) -> Diagnosis:
    """The cause where the stamps of images and of attitudes, first and last, do not overlap."""
    spans = [
        ' to '.join(utc_text(time_ns) for time_ns in span) for span in (images_ns, attitudes_ns)
    ]
    shift_s = (attitudes_ns[0] - images_ns[0]) / NANOSECONDS_PER_SECOND
    return Diagnosis(
        'clock',
        None,
        f'The images are of {spans[0]}, the attitudes of {spans[1]}: they have two clocks, or are'
        ' of different times.',
        (f'the attitudes begin {shift_s:+.1f} s after the images',),
        ('# give both on one clock, or the difference of the clocks in stamp_offset_s',),
    )


def placed(
    paths: Sequence[Path], topics: Topics, options: AttitudeOptions, channel: str = ''
) -> Iterator[StarObservations]:
    """Images without their stars, refused for bad encoding, order or attitude."""
    latest_ns = None
    for frame in read_frames(
        paths, Topics(topics.image, topics.attitude), options, channel=channel
    ):
        if isinstance(frame, StarObservations):
            yield frame
            continue
        image = frame.image
        bag_topics.warn_of_clock(image.time_ns)
        height, width = image.pixels.shape
        try:
            check_order(image, latest_ns)
            gap_s = math.nan
            if topics.attitude:
                before, after = frame.attitudes.around(image.time_ns, options.max_attitude_gap_s)
                gap_s = (after.time_ns - before.time_ns) / NANOSECONDS_PER_SECOND
        except ImageRefused as refused:
            yield refused_image(image.time_ns, width, height, refused.reason, refused.detail)
            continue
        latest_ns = image.time_ns
        yield StarObservations.of_image(image.time_ns, (width, height), attitude_gap_s=gap_s)


def refusals(records: Iterable[StarObservations]) -> tuple[Refused, ...]:
    """Refused images by their reason, the most frequent first."""
    groups: dict[str, list[StarObservations]] = {}
    for observations in records:
        if observations.refusal:
            groups.setdefault(observations.refusal, []).append(observations)
    return tuple(
        Refused(
            reason,
            len(group),
            IMAGE_REFUSALS.get(reason, ''),
            group[0].time_ns,
            _detail(group),
            refused_stars(group),
        )
        for reason, group in sorted(groups.items(), key=lambda item: -len(item[1]))
    )


def _detail(group: Sequence[StarObservations]) -> str:
    """Detail of the first image of a refusal, or the sky that a catalog has to cover for all."""
    details = list(dict.fromkeys(image.detail for image in group))
    places = np.array([match.groups() for text in details if (match := _CIRCLE.search(text))])
    if group[0].refusal != 'not_in_catalog' or len(places) < 2:
        return details[0]
    ra_deg, dec_deg, radius_deg = places.astype(np.float64).T
    direction = erfa.s2c(np.radians(ra_deg), np.radians(dec_deg))
    together = sky_circle(direction, math.radians(radius_deg.max()))
    if float(together.split()[-2]) < _ONE_QUERY_DEG:
        return _CIRCLE.sub(f'{together}, of {len(group)} images', details[0])
    others = [f'RA {ra}, Dec {dec}' for ra, dec, _ in places[1:_PLACES]]
    more = f', and {len(places) - _PLACES} more' if len(places) > _PLACES else ''
    return f'{details[0]}; others at {"; ".join(others)}{more}'
