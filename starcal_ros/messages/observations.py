"""Star observations of an image to a message and back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from starcal_ros.messages.fields import (
    counts_of_reasons,
    flat_array,
    make_header,
    quaternion_from_message,
    quaternion_to_message,
    shaped_array,
    stamp_ns,
)
from starcal_ros.messages.types import Make, Message, OBSERVATIONS_TYPE
from starcal_ros.records import StarObservations


def observations_to_message(record: StarObservations, frame_id: str, make: Make) -> Message:
    """Return a starcal/StarObservations; ``frame_id`` is the camera's."""
    return make(
        OBSERVATIONS_TYPE,
        header=make_header(record.time_ns, frame_id, make),
        width=record.width,
        height=record.height,
        refusal=record.refusal,
        detail=record.detail,
        attitude=quaternion_to_message(record.icrf_from_star_tracker_xyzw, make),
        attitude_gap_s=float(record.attitude_gap_s),
        temperature_degc=float(record.temperature_degc),
        catalog_id=flat_array(record.catalog_id, np.int64),
        direction_icrf=flat_array(record.direction_icrf, np.float64),
        magnitude=flat_array(record.magnitude, np.float32),
        measured_px=flat_array(record.measured_px, np.float64),
        covariance_px2=flat_array(record.covariance_px2, np.float64),
        flux_dn=flat_array(record.flux_dn, np.float32),
        snr=flat_array(record.snr, np.float32),
        refused_star_reasons=list(record.refused_stars),
        refused_star_counts=flat_array(list(record.refused_stars.values()), np.uint32),
        refused_star_id=flat_array(record.refused_catalog_id, np.int64),
        refused_star_px=flat_array(record.refused_px, np.float32),
        refused_star_reason=flat_array(record.refused_reason, np.uint8),
        background_dn=float(record.background_dn),
        noise_dn=float(record.noise_dn),
        psf_sigma_px=float(record.psf_sigma_px),
        catalog_digest=record.catalog_digest,
    )


def observations_from_message(message: Message) -> StarObservations:
    """
    Observations of a starcal/StarObservations.

    Raises
    ------
    ValueError
        When the arrays of the message do not fit each other or hold what no star has.
    """
    catalog_id = np.array(message.catalog_id, np.int64)
    n = len(catalog_id)
    record = StarObservations(
        time_ns=stamp_ns(message.header.stamp),
        width=int(message.width),
        height=int(message.height),
        refusal=str(message.refusal),
        detail=str(message.detail),
        icrf_from_star_tracker_xyzw=quaternion_from_message(message.attitude),
        attitude_gap_s=float(message.attitude_gap_s),
        catalog_id=catalog_id,
        direction_icrf=shaped_array('direction_icrf', message.direction_icrf, (n, 3)),
        magnitude=shaped_array('magnitude', message.magnitude, (n,)).astype(np.float32),
        measured_px=shaped_array('measured_px', message.measured_px, (n, 2)),
        covariance_px2=shaped_array('covariance_px2', message.covariance_px2, (n, 3)),
        flux_dn=shaped_array('flux_dn', message.flux_dn, (n,)).astype(np.float32),
        snr=shaped_array('snr', message.snr, (n,)).astype(np.float32),
        refused_stars=counts_of_reasons(message.refused_star_reasons, message.refused_star_counts),
        background_dn=float(message.background_dn),
        noise_dn=float(message.noise_dn),
        psf_sigma_px=float(message.psf_sigma_px),
        catalog_digest=str(message.catalog_digest),
        # Recordings of before the field was there have none.
        temperature_degc=float(getattr(message, 'temperature_degc', math.nan)),
        **_refused_stars(message),
    )
    for name in (
        'direction_icrf',
        'measured_px',
        'covariance_px2',
        'icrf_from_star_tracker_xyzw',
        'refused_px',
    ):
        if not np.isfinite(getattr(record, name)).all():
            raise ValueError(f'{name}: not finite')
    uu, uv, vv = record.covariance_px2.T
    if not ((uu > 0) & (uu * vv > uv * uv)).all():
        raise ValueError('covariance_px2: not positive definite')
    return record


def _refused_stars(message: Message) -> dict[str, Any]:
    """Fields of the record about single refused stars."""
    # Recordings of before the fields were there have none.
    catalog_id = np.array(getattr(message, 'refused_star_id', ()), np.int64)
    m = len(catalog_id)
    reason = shaped_array('refused_star_reason', getattr(message, 'refused_star_reason', ()), (m,))
    if (reason >= len(message.refused_star_reasons)).any():
        raise ValueError(
            f'refused_star_reason: {int(reason.max())} is none of '
            f'{len(message.refused_star_reasons)} reasons'
        )
    places = shaped_array('refused_star_px', getattr(message, 'refused_star_px', ()), (m, 2))
    return {
        'refused_catalog_id': catalog_id,
        'refused_px': places.astype(np.float32),
        'refused_reason': reason.astype(np.uint8),
    }
