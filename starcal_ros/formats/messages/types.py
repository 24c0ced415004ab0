# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Names of the message types, and a type for messages made by rclpy or rosbags."""

from __future__ import annotations

from typing import Any, Protocol

IMAGE_TYPE = 'sensor_msgs/msg/Image'
COMPRESSED_TYPE = 'sensor_msgs/msg/CompressedImage'
ATTITUDE_TYPE = 'geometry_msgs/msg/QuaternionStamped'
VELOCITY_TYPE = 'geometry_msgs/msg/TwistStamped'
TEMPERATURE_TYPE = 'sensor_msgs/msg/Temperature'
CAMERA_INFO_TYPE = 'sensor_msgs/msg/CameraInfo'
ALIGNMENT_TYPE = 'geometry_msgs/msg/TransformStamped'
POSE_TYPE = 'geometry_msgs/msg/PoseStamped'
IMU_TYPE = 'sensor_msgs/msg/Imu'
OBSERVATIONS_TYPE = 'starcal/msg/StarObservations'
CALIBRATION_TYPE = 'starcal/msg/Calibration'
STATUS_TYPE = 'starcal/msg/EnsembleStatus'

ATTITUDE_TYPES = {
    'quaternion': ATTITUDE_TYPE,
    'pose': POSE_TYPE,
    'transform': ALIGNMENT_TYPE,
    'imu': IMU_TYPE,
}
"""Values of the option `attitude_message`, and the type of message of each."""

Message = Any  # a message class of rclpy or of rosbags: they share field names and nothing else


class Make(Protocol):
    """Builds a message of a type, ``'pkg/msg/Name'``, from its fields."""

    def __call__(self, type_name: str, /, **fields: object) -> Message:
        """Return the message."""
