# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observations of an image to a message and back."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from starcal_ros.camera import MAX_SIDE_PX
from starcal_ros.messages.codec import message_fields, record_fields
from starcal_ros.messages.fields import (
    counts_of_reasons,
    flat_array,
    nearest_stamp_ns,
    stamp_ns,
)
from starcal_ros.messages.types import Make, Message, OBSERVATIONS_TYPE
from starcal_ros.records import IMAGE_REFUSALS, refused_image, StarObservations

# Fields of the record whose names in the message are another.
_NAMES = {
    'icrf_from_star_tracker_xyzw': 'attitude',
    'first_from_star_tracker_xyzw': 'first_from_star_tracker',
    'refused_catalog_id': 'refused_star_id',
    'refused_px': 'refused_star_px',
    'refused_reason': 'refused_star_reason',
}
_UNIT_TOLERANCE = 1e-3  # of an attitude: single precision and rounding leave less
_DIRECTION_TOLERANCE = 1e-6  # of the length of a direction, in double precision
_SIGMA_PX = (1e-5, 1e3)  # of a measured star, smallest and largest
_DEGC = (-273.15, 1000.0)
_LONGEST_DETAIL = 500  # characters
_LONGEST_NAME = 100
_MOST_REASONS = 50
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
    _check_image(record)
    _check_stars(record)
    return dataclasses.replace(record, detail=record.detail[:_LONGEST_DETAIL])


def checked_observations(message: Message) -> StarObservations:
    """
    Observations of a starcal/StarObservations, refused where they hold impossible values.

    The refusal is ``bad_observations``, with the field and its value.

    Raises
    ------
    AttributeError
        When the message lacks fields.
    """
    try:
        return observations_from_message(message)
    except ValueError as error:
        return refused_image(
            nearest_stamp_ns(stamp_ns(message.header.stamp)),
            min(int(message.width), MAX_SIDE_PX),
            min(int(message.height), MAX_SIDE_PX),
            'bad_observations',
            ' '.join(str(error).split())[:_LONGEST_DETAIL],
        )


def _check_image(record: StarObservations) -> None:
    """Raise ValueError for values that no image has."""
    if record.refusal and record.refusal not in IMAGE_REFUSALS:
        raise ValueError(f'refusal: {record.refusal[:_LONGEST_NAME]!r} is no known reason')
    if max(record.width, record.height) > MAX_SIDE_PX:
        raise ValueError(f'width, height: {record.width} x {record.height} px is no image')
    for field, quaternion in (
        ('attitude', record.icrf_from_star_tracker_xyzw),
        ('first_from_star_tracker', record.first_from_star_tracker_xyzw),
    ):
        with np.errstate(over='ignore'):
            norm = float(np.linalg.norm(quaternion))
        if not abs(norm - 1.0) <= _UNIT_TOLERANCE:
            raise ValueError(f'{field}: a quaternion of length {norm:.6g}')
    low, high = _DEGC
    if not (math.isnan(record.temperature_degc) or low <= record.temperature_degc <= high):
        raise ValueError(f'temperature_degc: {record.temperature_degc:.6g} is no temperature')
    if record.velocity_sigma_m_s < 0:
        raise ValueError(f'velocity_sigma_m_s: {record.velocity_sigma_m_s:.6g} is no sigma')
    for name in (
        'attitude_gap_s',
        'background_dn',
        'noise_dn',
        'psf_sigma_px',
        'star_tracker_rate_rad_s',
        'velocity_sigma_m_s',
    ):
        if np.isinf(getattr(record, name)).any():
            raise ValueError(f'{name}: not finite')
    names = [record.catalog_digest, record.star_tracker, *record.refused_stars]
    if len(names) > _MOST_REASONS or max(map(len, names)) > _LONGEST_NAME:
        raise ValueError('refused_star_reasons, catalog_digest, star_tracker: longer than any')
    reasons = len(record.refused_stars)
    if (record.refused_reason >= reasons).any():
        raise ValueError(
            f'refused_star_reason: {int(record.refused_reason.max())} is none of {reasons} reasons'
        )


def _check_stars(record: StarObservations) -> None:
    """Raise ValueError for values that no star has."""
    with np.errstate(over='ignore'):
        length = np.linalg.norm(record.direction_icrf, axis=1)
    if (np.abs(length - 1.0) > _DIRECTION_TOLERANCE).any():
        raise ValueError(f'direction_icrf: lengths of {length.min():.6g} to {length.max():.6g}')
    # The first pixel reaches from -0.5 to 0.5.
    inside = (record.measured_px >= -1.0) & (record.measured_px <= (record.width, record.height))
    if not inside.all():
        u, v = record.measured_px[~inside.all(axis=1)][0]
        raise ValueError(f'measured_px: ({u:.6g}, {v:.6g}) is outside of the image')
    uu, uv, vv = record.covariance_px2.T
    low, high = np.square(_SIGMA_PX)
    with np.errstate(over='ignore'):
        definite = (uu > 0) & (uu * vv > uv * uv)
    if not definite.all():
        raise ValueError('covariance_px2: not positive definite')
    if not ((np.minimum(uu, vv) >= low) & (np.maximum(uu, vv) <= high)).all():
        raise ValueError(f'covariance_px2: a variance is not within {low:g} to {high:g}')
    for name in ('magnitude', 'flux_dn', 'snr'):
        if np.isinf(getattr(record, name)).any():
            raise ValueError(f'{name}: not finite')
