# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observations of an image to a message and back."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from starcal_ros.messages.codec import message_fields, record_fields
from starcal_ros.messages.fields import counts_of_reasons, flat_array
from starcal_ros.messages.types import Make, Message, OBSERVATIONS_TYPE
from starcal_ros.records import StarObservations

# Fields of the record whose names in the message are another.
_NAMES = {
    'icrf_from_star_tracker_xyzw': 'attitude',
    'refused_catalog_id': 'refused_star_id',
    'refused_px': 'refused_star_px',
    'refused_reason': 'refused_star_reason',
}
# The message has kept the two arrays of version 0.1 for this mapping.
_COUNTS = ('refused_stars',)


def observations_to_message(record: StarObservations, frame_id: str, make: Make) -> Message:
    """Return a starcal/StarObservations; ``frame_id`` is the camera's."""
    return make(
        OBSERVATIONS_TYPE,
        **message_fields(record, make, frame_id, _NAMES, leave_out=_COUNTS),
        refused_star_reasons=list(record.refused_stars),
        refused_star_counts=flat_array(list(record.refused_stars.values()), np.uint32),
    )


def observations_from_message(message: Message) -> StarObservations:
    """
    Observations of a starcal/StarObservations.

    Recordings of version 0.1 are read: an attitude gap of -1 is NaN, and missing fields have their
    defaults.

    Raises
    ------
    ValueError
        When the arrays of the message do not fit each other or hold values that no star can have.
    """
    record = StarObservations(
        refused_stars=counts_of_reasons(message.refused_star_reasons, message.refused_star_counts),
        **record_fields(StarObservations, message, _NAMES, leave_out=_COUNTS),
    )
    if record.attitude_gap_s < 0:
        record = dataclasses.replace(record, attitude_gap_s=math.nan)
    uu, uv, vv = record.covariance_px2.T
    if not ((uu > 0) & (uu * vv > uv * uv)).all():
        raise ValueError('covariance_px2: not positive definite')
    reasons = len(record.refused_stars)
    if (record.refused_reason >= reasons).any():
        raise ValueError(
            f'refused_star_reason: {int(record.refused_reason.max())} is none of {reasons} reasons'
        )
    return record
