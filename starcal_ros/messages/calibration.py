# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A calibration to a message and back, and to the standard messages for a camera."""

from __future__ import annotations

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.camera_conversion import ros_fit
from starcal_ros.lens import ros_distortion
from starcal_ros.messages.codec import message_fields, record_fields
from starcal_ros.messages.fields import (
    make_header,
    quaternion_from_message,
    quaternion_to_message,
    vector_to_message,
)
from starcal_ros.messages.types import (
    ALIGNMENT_TYPE,
    CALIBRATION_TYPE,
    CAMERA_INFO_TYPE,
    Make,
    Message,
)
from starcal_ros.records import ALIGNMENT_NAMES, Calibration, CameraGeometry, check_calibration

# Fields of the record that the message holds as ``camera`` and ``alignment``.
_NESTED = ('geometry', 'parent_frame', 'child_frame')
_OF_CALIBRATION = ('field',)  # of a camera: the calibration holds it with its covariance


def calibration_to_message(calibration: Calibration, make: Make) -> Message:
    """Return a starcal/Calibration with every number of the record."""
    geometry = calibration.geometry
    return make(
        CALIBRATION_TYPE,
        **message_fields(calibration, make, calibration.child_frame, leave_out=_NESTED),
        camera=make(
            'starcal/msg/CameraModel',
            parameter_names=list(geometry.camera.parameter_names),
            **message_fields(geometry.camera, make, leave_out=_OF_CALIBRATION),
        ),
        alignment=make(
            'starcal/msg/Alignment',
            parent_frame=calibration.parent_frame,
            child_frame=calibration.child_frame,
            rotation=quaternion_to_message(geometry.star_tracker_from_camera_xyzw, make),
        ),
        parameter_names=list(calibration.parameter_names),
    )


def calibration_from_message(message: Message) -> Calibration:
    """
    Calibration of a starcal/Calibration.

    Raises
    ------
    ValueError
        When the message does not hold a camera (an empty one does not), or its fields do not fit
        each other.
    """
    camera = CameraModel(**record_fields(CameraModel, message.camera, leave_out=_OF_CALIBRATION))
    for field, found, expected in (
        ('camera.parameter_names', message.camera.parameter_names, camera.parameter_names),
        ('parameter_names', message.parameter_names, camera.parameter_names + ALIGNMENT_NAMES),
    ):
        if tuple(found) != expected:
            raise ValueError(f'{field}: {", ".join(found) or "none"}, not {", ".join(expected)}')
    rotation = quaternion_from_message(message.alignment.rotation)
    calibration = Calibration(
        geometry=CameraGeometry(camera, rotation),
        parent_frame=str(message.alignment.parent_frame),
        child_frame=str(message.alignment.child_frame),
        **record_fields(Calibration, message, leave_out=_NESTED),
    )
    check_calibration(calibration)
    return calibration


def camera_info_to_message(calibration: Calibration, make: Make) -> Message:
    """
    Return a sensor_msgs/CameraInfo: the best camera without skew.

    CameraInfo cannot carry skew: its readers ignore K[0,1].
    """
    camera, _ = ros_fit(calibration.geometry.camera)
    fx, _, fy, cx, cy = camera.intrinsics
    distortion_model, D = ros_distortion(camera.model, camera.distortion)
    return make(
        CAMERA_INFO_TYPE,
        header=make_header(calibration.time_ns, calibration.child_frame, make),
        height=camera.height,
        width=camera.width,
        distortion_model=distortion_model,
        d=D,
        k=np.array([fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]),
        r=np.eye(3).ravel(),
        p=np.array([fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]),
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


def mountings_to_messages(calibration: Calibration, make: Make) -> list[Message]:
    """geometry_msgs/TransformStamped of each further star tracker in the frame of the first."""
    return [
        _in_star_tracker(calibration, one.frame, one.first_from_star_tracker_xyzw, make)
        for one in calibration.star_trackers[1:]
    ]


def alignment_to_message(calibration: Calibration, make: Make) -> Message:
    """Return a geometry_msgs/TransformStamped: the camera frame in the star tracker frame."""
    rotation_xyzw = calibration.geometry.star_tracker_from_camera_xyzw
    return _in_star_tracker(calibration, calibration.child_frame, rotation_xyzw, make)


def _in_star_tracker(
    calibration: Calibration, frame: str, rotation_xyzw: Floats, make: Make
) -> Message:
    """A frame of that orientation in the frame of the (first) star tracker."""
    return make(
        ALIGNMENT_TYPE,
        header=make_header(calibration.time_ns, calibration.parent_frame, make),
        child_frame_id=frame,
        transform=make(
            'geometry_msgs/msg/Transform',
            translation=vector_to_message(np.zeros(3), make),
            rotation=quaternion_to_message(rotation_xyzw, make),
        ),
    )
