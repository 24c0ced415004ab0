# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Cameras that are turned against their mounting, by how much two are, and their lenses."""

import dataclasses

from scipy.spatial.transform import Rotation

from starcal_ros.records import CameraGeometry

#           k1   k2    k3    p1     p2     k4    k5   k6
RATIONAL = [0.1, 0.05, 0.01, 1e-3, -7e-4, 0.35, 0.1, 0.02]
PRISM = [2e-3, -1e-3, -1.5e-3, 5e-4]
COEFFICIENTS = {
    'plumb_bob': [-0.2, 0.08, -0.01, 1e-3, -7e-4],
    'rational_polynomial': RATIONAL,
    'thin_prism': [*RATIONAL, *PRISM],
    'tilted': [*RATIONAL, *PRISM, 0.02, -0.03],
    'equidistant': [-0.02, 0.01, -0.004, 5e-4],
}


def turned(geometry: CameraGeometry, turn: Rotation) -> CameraGeometry:
    """The geometry with the camera turned about its own axes."""
    mounting = geometry.star_tracker_from_camera * turn
    return dataclasses.replace(geometry, star_tracker_from_camera_xyzw=mounting.as_quat())


def turn_between(one: CameraGeometry, other: CameraGeometry) -> Rotation:
    """Rotation of the camera, about its own axes, from one geometry to another."""
    return one.star_tracker_from_camera.inv() * other.star_tracker_from_camera
