# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The cause that the refusals of images name by themselves, without a search of the sky."""

from __future__ import annotations

from collections.abc import Sequence

from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.diagnosis.diagnose import Diagnosis
from starcal_ros.pipeline.inspect import Refused

UNREADABLE = frozenset(['bad_encoding', 'bad_layout', 'bad_stamp', 'bad_attitude'])
"""Refusals after which the sky of an image cannot be held against the set-up."""
_REMEDIES = {
    'bad_encoding': 'record images of one channel, 8 or 16 bit, raw or as PNG',
    'bad_layout': 'correct width, height, step and data where the message is made',
    'bad_stamp': 'stamp the images in UTC since 1970, and check stamp_offset_s',
    'bad_attitude': 'send unit quaternions, and none while the star tracker has no lock',
    'no_attitude': 'record attitudes from before the first image to after the last',
    'attitude_gap': (
        'record attitudes more often, or raise max_attitude_gap_s if the vehicle turns evenly'
    ),
    'frozen_attitude': 'record the attitudes that the star tracker measures',
    'out_of_order': 'use one topic for each camera',
    'overexposed': 'expose for a shorter time',
    'blank': 'check that the camera is read out',
    'frozen': 'check that the camera is read out',
    'incomplete': 'if rows of the detector are dead, raise max_lost_fraction; else mend the link',
    'glare': 'keep Sun, Moon and Earth out of the field, or raise max_gradient',
    'too_few_stars': 'expose for longer, or raise magnitude_limit; check bad_pixel_map',
}


def of_refusals(refused: Sequence[Refused], images: int) -> Diagnosis | None:
    """The most frequent refusal of some images as their cause; None if none is refused."""
    if not refused:
        return None
    most = refused[0]
    count = 'All' if most.count == images else f'{most.count} of'
    remedy = _REMEDIES.get(most.reason)
    return Diagnosis(
        most.reason,
        most.count,
        f'{count} {images} images are refused as {most.reason}: {most.detail or most.meaning}.',
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
