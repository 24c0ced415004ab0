# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observations of an image to a message and back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from starcal_ros.errors import ImageRefused
from starcal_ros.formats.messages.image_messages import refused_from_message
from starcal_ros.formats.messages.message_codec import message_fields, plain_message
from starcal_ros.formats.messages.message_fields import (
    flat_array,
    Make,
    Message,
    OBSERVATIONS_TYPE,
)
from starcal_ros.record_fields import plain_record, read_record
from starcal_ros.records import StarObservations

_VARIANCE_PX2 = (1e-10, 1e6)  # of a measured star, smallest and largest
_LONGEST_DETAIL = 500  # characters
_EXACT_VELOCITY = -1.0  # in messages: 0 is that of a sender that leaves it out


def observations_to_message(record: StarObservations, frame_id: str, make: Make) -> Message:
    """Return a starcal/StarObservations; ``frame_id`` is the camera's."""
    values = plain_record(record)
    # The message has kept the two arrays of version 0.1 for this mapping.
    refused = values.pop('refused_stars')
    if values['velocity_sigma_m_s'] == 0:
        values['velocity_sigma_m_s'] = _EXACT_VELOCITY
    return make(
        OBSERVATIONS_TYPE,
        **message_fields(StarObservations, values, make, frame_id),
        refused_star_reasons=list(refused),
        refused_star_counts=flat_array(list(refused.values()), np.uint32),
    )


def observations_from_message(message: Message) -> StarObservations:
    """
    Observations of a starcal/StarObservations.

    Recordings of version 0.1 are read: an attitude gap of -1 is NaN, and missing fields have their
    defaults.  So have those that a sender leaves at ROS's zeros.

    Raises ValueError when the arrays of the message do not fit each other or hold values that no
    star can have.
    """
    values = plain_message(StarObservations, message)
    reasons, counts = message.refused_star_reasons, message.refused_star_counts
    if len(reasons) != len(counts):
        raise ValueError(f'refused_star_reasons: {len(reasons)} reasons but {len(counts)} counts')
    values['refused_stars'] = dict(zip(reasons, counts, strict=True))
    values['detail'] = values['detail'][:_LONGEST_DETAIL]
    if values['attitude_gap_s'] < 0:
        values['attitude_gap_s'] = math.nan
    _forget_zeros(values)
    record = read_record(StarObservations, values)
    _check_stars(record)
    return record


def _forget_zeros(values: dict[str, Any]) -> None:
    """Replace zeros that no sender means, as ROS fills them in, by numbers that are not known."""
    nowhere = np.full(3, math.nan)
    if not np.any(values['first_from_star_tracker']):
        del values['first_from_star_tracker']
    sigma = values.get('star_tracker_rate_sigma_rad_s', nowhere)
    values['star_tracker_rate_sigma_rad_s'] = np.where(sigma == 0, math.nan, sigma)
    is_stated = bool((sigma > 0).any())
    if not is_stated and not np.any(values.get('star_tracker_rate_rad_s', nowhere)):
        values['star_tracker_rate_rad_s'] = nowhere
    if not np.any(values.get('zenith_icrf', nowhere)):
        values['zenith_icrf'] = nowhere
    stated = {0.0: math.nan, _EXACT_VELOCITY: 0.0}
    velocity = values.get('velocity_sigma_m_s', math.nan)
    values['velocity_sigma_m_s'] = stated.get(velocity, velocity)


def checked_observations(message: Message) -> StarObservations:
    """
    Observations of a starcal/StarObservations, refused where they hold impossible values.

    The refusal is ``bad_observations``, with the field and its value.

    Raises AttributeError when the message lacks fields.
    """
    try:
        return observations_from_message(message)
    except ValueError as error:
        detail = ' '.join(str(error).split())[:_LONGEST_DETAIL]
        return refused_from_message(message, 0.0, ImageRefused('bad_observations', detail))


def _check_stars(record: StarObservations) -> None:
    """Raise ValueError for values of one field that those of another exclude."""
    reasons = len(record.refused_stars)
    if (record.refused_reason >= reasons).any():
        raise ValueError(
            f'refused_star_reason: {int(record.refused_reason.max())} is not one of {reasons}'
            ' reasons'
        )
    # The first pixel reaches from -0.5 to 0.5.
    inside = (record.measured_px >= -1.0) & (record.measured_px <= (record.width, record.height))
    if not inside.all():
        u, v = record.measured_px[~inside.all(axis=1)][0]
        raise ValueError(f'measured_px: ({u:.6g}, {v:.6g}) is outside of the image')
    uu, uv, vv = record.covariance_px2.T
    low, high = _VARIANCE_PX2
    with np.errstate(over='ignore'):
        definite = (uu > 0) & (uu * vv > uv * uv)
    if not definite.all():
        raise ValueError('covariance_px2: not positive definite')
    if not ((np.minimum(uu, vv) >= low) & (np.maximum(uu, vv) <= high)).all():
        raise ValueError(f'covariance_px2: a variance is not within {low:g} to {high:g}')
