# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star observations, calibration and ensemble status to messages and back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Annotated, Any

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.camera.lens import ros_distortion
from starcal_ros.errors import ImageRefused
from starcal_ros.formats.messages import message_codec as codec
from starcal_ros.formats.messages.sensor_messages import refused_from_message
from starcal_ros.record_fields import Named, plain_record, Quaternion, read_record
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    Calibration,
    CameraGeometry,
    check_calibration,
    EnsembleStatus,
    StarObservations,
)
from starcal_ros.untrusted import shown

_VARIANCE_PX2 = (1e-10, 1e6)  # smallest and largest that a measured star has
_LONGEST_DETAIL = 500  # characters
_EXACT_VELOCITY = -1.0  # in messages: 0 is that of a sender that leaves it out
_REFUSED_ROWS = ('refused_star_id', 'refused_star_px', 'refused_star_reason')
# No software on board reads them: they are in calibration.json alone.
_NOT_SENT = ('model_checks', 'statements')


def observations_to_message(
    record: StarObservations, frame_id: str, make: codec.Make
) -> codec.Message:
    """Return a starcal/StarObservations; ``frame_id`` is the camera's."""
    values = plain_record(record)
    refused = values.pop('refused_stars')
    if values['velocity_sigma_m_s'] == 0:
        values['velocity_sigma_m_s'] = _EXACT_VELOCITY
    return make(
        codec.OBSERVATIONS_TYPE,
        **codec.message_fields(StarObservations, values, make, frame_id),
        refused_star_reasons=list(refused),
        refused_star_counts=codec.flat_array(list(refused.values()), np.uint32),
    )


def observations_from_message(message: codec.Message) -> StarObservations:
    """
    Observations of a starcal/StarObservations.

    Fields that a sender leaves at ROS's zeros have their defaults, as have those that the message
    of a recording lacks.  Arrays that explain each other have theirs if one of them is left out.

    Raises ValueError when the arrays of the message do not fit each other or hold values that no
    star can have.
    """
    values = codec.plain_message(StarObservations, message)
    names = ('refused_star_reasons', 'refused_star_counts')
    reasons, counts = (getattr(message, name, ()) for name in names)
    if len(reasons) and len(counts) and len(reasons) != len(counts):
        raise ValueError(f'refused_star_reasons: {len(reasons)} reasons but {len(counts)} counts')
    values['refused_stars'] = dict(zip(reasons, counts, strict=False))
    if not values['refused_stars'] or not values.keys() >= {*_REFUSED_ROWS}:
        values = {name: value for name, value in values.items() if name not in _REFUSED_ROWS}
    values['detail'] = values.get('detail', '')[:_LONGEST_DETAIL]
    _forget_zeros(values)
    record = read_record(StarObservations, values)
    _check_stars(record)
    return record


def _forget_zeros(values: dict[str, Any]) -> None:
    """Replace zeros that no sender means, as ROS fills them in, by numbers that are not known."""
    nowhere = np.full(3, math.nan)
    if not np.any(values.get('first_from_star_tracker', 0)):
        values.pop('first_from_star_tracker', None)
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


def checked_observations(message: codec.Message, camera_frame: str = '') -> StarObservations:
    """
    Observations of a starcal/StarObservations, refused if impossible or of another camera.

    The refusal is ``bad_observations``, with the field and its value.
    """
    try:
        frame = message.header.frame_id
        if camera_frame and frame not in ('', camera_frame):
            raise ValueError(
                f'header.frame_id: {shown(frame)} is not {camera_frame}, camera_frame'
            )
        return observations_from_message(message)
    except ValueError as error:
        detail = ' '.join(str(error).split())[:_LONGEST_DETAIL]
        return refused_from_message(message, 0.0, ImageRefused('bad_observations', detail))


def _check_stars(record: StarObservations) -> None:
    """Raise ValueError for values of one field that those of another exclude."""
    if not (len(record) or record.refusal):
        raise ValueError('refusal: empty, but the image has no stars')
    stars, times = np.unique(record.catalog_id, return_counts=True)
    if (times > 1).any():
        raise ValueError(f'catalog_id: {int(stars[times.argmax()])} is given twice')
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


@dataclass(frozen=True)
class Alignment:
    """The message of the alignment."""

    parent_frame: str
    child_frame: str
    star_tracker_from_camera_xyzw: Annotated[Quaternion, Named('rotation')]


def calibration_to_message(calibration: Calibration, make: codec.Make) -> codec.Message:
    """Return a starcal/Calibration: the record without the parts that nobody on board reads."""
    values = {k: v for k, v in plain_record(calibration).items() if k not in _NOT_SENT}
    geometry = values.pop('geometry')
    frames = values.pop('parent_frame'), values.pop('child_frame')
    camera = calibration.geometry.camera
    del geometry['camera']['field']  # the calibration holds it with its covariance
    return make(
        codec.CALIBRATION_TYPE,
        **codec.message_fields(Calibration, values, make, calibration.child_frame),
        camera=make(
            'starcal/msg/CameraModel',
            parameter_names=list(camera.parameter_names),
            **codec.message_fields(CameraModel, geometry['camera'], make),
        ),
        alignment=codec.record_to_message(
            Alignment(*frames, geometry['star_tracker_from_camera_xyzw']), make
        ),
        parameter_names=list(calibration.parameter_names),
    )


def calibration_from_message(message: codec.Message) -> Calibration:
    """
    Calibration of a starcal/Calibration.

    Raises ValueError when the message does not hold a camera (an empty one does not), or its
    fields do not fit each other.
    """
    camera = codec.record_from_message(CameraModel, message.camera, 'camera')
    for field, names, expected in (
        ('camera.parameter_names', message.camera.parameter_names, camera.parameter_names),
        ('parameter_names', message.parameter_names, camera.parameter_names + ALIGNMENT_NAMES),
    ):
        if tuple(names) != expected:
            raise ValueError(f'{field}: {", ".join(names) or "none"}, not {", ".join(expected)}')
    alignment = codec.record_from_message(Alignment, message.alignment, 'alignment')
    nested = {
        'geometry': CameraGeometry(camera, alignment.star_tracker_from_camera_xyzw),
        'parent_frame': alignment.parent_frame,
        'child_frame': alignment.child_frame,
    }
    values = codec.plain_message(Calibration, message)
    calibration = read_record(Calibration, {**values, **nested})
    check_calibration(calibration)
    return calibration


def none_active_to_messages(
    prior: CameraModel, frames: tuple[str, str], reasons: Sequence[str], make: codec.Make
) -> tuple[codec.Message, codec.Message, codec.Message]:
    """
    The messages that withdraw a calibration: starcal/Calibration, CameraInfo, TransformStamped.

    The first has ``reasons`` and no camera, the second K of zeros, ROS's word for a camera that is
    not calibrated, the third a rotation of zeros. ``frames`` are star tracker and camera.
    """
    header = codec.make_header(0, frames[1], make)
    return (
        make(codec.CALIBRATION_TYPE, header=header, reasons=list(reasons)),
        make(codec.CAMERA_INFO_TYPE, header=header, height=prior.height, width=prior.width),
        _transform(0, frames, np.zeros(4), make),
    )


def why_none_is_active(message: codec.Message) -> str:
    """The reasons of a message that no calibration is active, in one line; empty without any."""
    return '; '.join(message.reasons)[:_LONGEST_DETAIL]


def active_from_message(message: codec.Message) -> Calibration | None:
    """The calibration of a message on ``calibration``; None where it says that none is active."""
    is_none = message.number == 0 and message.camera.width == 0
    return None if is_none else calibration_from_message(message)


def camera_info_fields(camera: CameraModel) -> dict[str, Any]:
    """Size, lens and matrices of a CameraInfo: the best camera without skew."""
    camera, _ = camera.ros_fit
    fx, _, fy, cx, cy = camera.intrinsics
    distortion_model, D = ros_distortion(camera.model, camera.distortion)
    return {
        'height': camera.height,
        'width': camera.width,
        'distortion_model': distortion_model,
        'd': D,
        'k': np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        'r': np.eye(3).ravel(),
        'p': np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
    }


def camera_info_to_message(calibration: Calibration, make: codec.Make) -> codec.Message:
    """Return a sensor_msgs/CameraInfo: the best camera without skew, which readers ignore."""
    return make(
        codec.CAMERA_INFO_TYPE,
        header=codec.make_header(calibration.time_ns, calibration.child_frame, make),
        **camera_info_fields(calibration.geometry.camera),
        binning_x=0,
        binning_y=0,
        roi=make(
            'sensor_msgs/msg/RegionOfInterest',
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )


def mountings_to_messages(calibration: Calibration, make: codec.Make) -> list[codec.Message]:
    """geometry_msgs/TransformStamped of each further star tracker in the frame of the first."""
    time_ns, parent_frame = calibration.time_ns, calibration.parent_frame
    return [
        _transform(time_ns, (parent_frame, one.frame), one.first_from_star_tracker_xyzw, make)
        for one in calibration.star_trackers[1:]
    ]


def alignment_to_message(calibration: Calibration, make: codec.Make) -> codec.Message:
    """Return a geometry_msgs/TransformStamped: the camera frame in the star tracker frame."""
    frames = calibration.parent_frame, calibration.child_frame
    rotation_xyzw = calibration.geometry.star_tracker_from_camera_xyzw
    return _transform(calibration.time_ns, frames, rotation_xyzw, make)


def _transform(
    time_ns: int, frames: tuple[str, str], rotation_xyzw: Floats, make: codec.Make
) -> codec.Message:
    """The orientation of the second of two frames in the first, which have one origin."""
    return make(
        codec.ALIGNMENT_TYPE,
        header=codec.make_header(time_ns, frames[0], make),
        child_frame_id=frames[1],
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=codec.vector_to_message(np.zeros(3), make),
            rotation=codec.quaternion_to_message(rotation_xyzw, make),
        ),
    )


def status_to_message(status: EnsembleStatus, frame_id: str, make: codec.Make) -> codec.Message:
    """Return a starcal/EnsembleStatus; ``frame_id`` is the camera's."""
    values = plain_record(status)
    return make(codec.STATUS_TYPE, **codec.message_fields(EnsembleStatus, values, make, frame_id))
