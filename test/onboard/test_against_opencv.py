# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Every camera model against OpenCV, which has no skew; skew against the paper's formula."""

import cv2
import numpy as np
import pytest

from starcal_ros.camera import CameraModel, project, project_jacobians
from starcal_ros.camera.lens import LENSES, ros_distortion


def directions(seed: int) -> np.ndarray:
    """Unit directions (200, 3) in the camera frame over a square about the axis."""
    xy = np.random.default_rng(seed).uniform(-0.9, 0.9, (200, 2))
    e = np.concatenate([xy, np.ones((200, 1))], axis=1)
    return np.asarray(e / np.linalg.norm(e, axis=1)[:, None])


# k1 k2 k3 p1 p2 k4 k5 k6, s1 to s4 and the two angles of the tilt.
LARGEST = np.r_[0.2, 0.05, 0.01, 2e-3, 2e-3, 0.2, 0.05, 0.01, np.full(4, 2e-3), 0.1, 0.1]


def random_lens(model: str, seed: int) -> CameraModel:
    rng = np.random.default_rng(seed)
    count = len(LENSES[model].coefficients)
    scale = np.array([0.05, 0.02, 5e-3, 1e-3]) if model == 'equidistant' else LARGEST[:count]
    intrinsics = [1500.0, 0.0, 1500 * (1 + 0.001 * rng.normal()), *rng.normal([1295, 1023], 15)]
    return CameraModel(2592, 2048, np.r_[intrinsics, scale * rng.uniform(-1, 1, count)], model)


def opencv_of(camera: CameraModel, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) of directions, and OpenCV's derivatives (n, 2, ...)."""
    still = np.zeros(3)
    _, D = ros_distortion(camera.model, camera.distortion)
    if camera.model == 'equidistant':
        points = (e / e[:, 2:])[:, None]
        pixels, J = cv2.fisheye.projectPoints(points, still, still, camera.camera_matrix, D)
    else:
        pixels, J = cv2.projectPoints(e, still, still, camera.camera_matrix, D)
    return pixels.reshape(-1, 2), J.reshape(len(e), 2, -1)


@pytest.mark.parametrize('skew', [-3.0, 2.5])
def test_skew_adds_its_share_of_the_distorted_row(skew: float) -> None:
    # Eq. 7: u has skew y' more, and y' is what OpenCV makes of fy = 1 and cy = 0.
    camera, e = random_lens('plumb_bob', 3), directions(3)
    plain, _ = opencv_of(camera, e)
    unit, _ = opencv_of(camera.replace(fx=1, fy=1, cx=0, cy=0), e)
    expected = plain + np.stack([skew * unit[:, 1], np.zeros(len(e))], axis=-1)
    np.testing.assert_allclose(project(camera.replace(skew=skew), e), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize('model', [lens.name for lens in LENSES.values() if lens.opencv])
@pytest.mark.parametrize('seed', range(3))
def test_pixels_and_derivatives_of_every_model(model: str, seed: int) -> None:
    camera, e = random_lens(model, seed), directions(seed)
    expected, J = opencv_of(camera, e)
    # The same functions in another order of operations: roundings of numbers up to 3000 px.
    np.testing.assert_allclose(project(camera, e), expected, rtol=0, atol=1e-9)
    _, J_parameters, J_rotation = project_jacobians(camera, e)
    # Columns of ours without skew; of theirs, by the order of `ros_distortion`.
    ours = np.delete(J_parameters, 1, axis=-1)
    _, order = ros_distortion(model, np.arange(len(camera.distortion), dtype=np.float64))
    if model == 'equidistant':  # fx fy, cx cy, k1 to k4, rotation 3, translation 3, skew
        intrinsics, coefficients, rotation = J[..., :4], J[..., 4:8], J[..., 8:11]
    else:  # rotation 3, translation 3, fx fy cx cy, coefficients
        intrinsics, coefficients, rotation = J[..., 6:10], J[..., 10:], J[..., :3]
    theirs = np.concatenate(
        [intrinsics, coefficients[..., np.argsort(order.astype(int))]], axis=-1
    )
    size = np.abs(ours).max(axis=(0, 1))
    # Both are analytic: roundings alone.
    np.testing.assert_allclose(ours / size, theirs / size, rtol=0, atol=1e-11)
    # OpenCV turns the star, we turn the frame: the other sign at zero rotation.
    np.testing.assert_allclose(J_rotation, -rotation, rtol=0, atol=1e-11 * 1500)
