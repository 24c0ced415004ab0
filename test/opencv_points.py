# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Undistorted points by OpenCV, to its last digit."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)


def undistorted(camera: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Points (n, 2) of the ideal image plane; ``camera`` is fx skew fy cx cy k1 k2 k3 p1 p2."""
    fx, skew, fy, cx, cy, k1, k2, k3, p1, p2 = camera
    assert skew == 0  # OpenCV has none
    K, D = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, p1, p2, k3])
    if hasattr(cv2, 'undistortPointsIter'):
        found = cv2.undistortPointsIter(pixels[:, None], K, D, np.eye(3), np.eye(3), _CRITERIA)
    else:  # from OpenCV 5 on, whose stubs those of 4 are not
        undistort: Any = cv2.undistortPoints
        found = undistort(pixels[:, None], K, D, criteria=_CRITERIA)
    return np.asarray(found, np.float64).reshape(-1, 2)
