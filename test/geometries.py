# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Cameras that are turned against their mounting, and by how much two are."""

from __future__ import annotations

import dataclasses

from scipy.spatial.transform import Rotation

from starcal_ros.records import CameraGeometry


def turned(geometry: CameraGeometry, turn: Rotation) -> CameraGeometry:
    """The geometry with the camera turned about its own axes."""
    mounting = geometry.star_tracker_from_camera * turn
    return dataclasses.replace(geometry, star_tracker_from_camera_xyzw=mounting.as_quat())


def turn_between(one: CameraGeometry, other: CameraGeometry) -> Rotation:
    """Rotation of the camera, about its own axes, from one geometry to another."""
    return one.star_tracker_from_camera.inv() * other.star_tracker_from_camera
