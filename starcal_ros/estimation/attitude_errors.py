# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star-tracker errors of the images, and their derivatives."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.estimation.problem import image_alignment, Problem, State


def whitened_attitude_errors(problem: Problem, state: State) -> tuple[Floats, Floats]:
    """
    Star tracker errors (m, 3) in sigma, and their derivative (m, 3, 3) by the images' rotations.

    The derivative by the alignment at the temperature of the image is the negative of it.
    """
    eta = attitude_errors(problem, state, state.camera_from_icrf)
    # d Log: the inverse Jacobian of SO(3) to first order, exact to eta^2 / 12 (1e-9 at 20 arcsec).
    half = 0.5 * cross_matrix(eta)
    J = (np.eye(3) + half) @ image_alignment(problem, state).inv().as_matrix()
    sigma = problem.star_tracker_sigma_rad
    return eta / sigma, J / sigma[:, :, None]


def attitude_errors(problem: Problem, state: State, camera_from_icrf: Rotation) -> Floats:
    """Star tracker errors (m, 3), rad in its frame, when these are the rotations of the images."""
    return -np.asarray(
        (
            image_alignment(problem, state).inv()
            * camera_from_icrf
            * problem.star_tracker_from_icrf.inv()
        ).as_rotvec()
    )


def cross_matrix(v: Floats) -> Floats:
    """Matrices (m, 3, 3) with ``cross_matrix(v) @ w = v x w``."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turn_derivatives(turns: Floats) -> Floats:
    """
    Matrices (m, 3, 3) D with ``exp(-[(h + d) x]) = exp(-[D d x]) exp(-[h x])`` for turns h (m, 3).

    The left Jacobian of SO(3), to first order in d.
    """
    angle = np.linalg.norm(turns, axis=1)[:, None, None]
    H = cross_matrix(turns)
    with np.errstate(divide='ignore', invalid='ignore'):
        second = np.where(angle > 1e-4, (1.0 - np.sinc(angle / np.pi)) / angle**2, 1.0 / 6.0)
    first = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) - first * H + second * (H @ H))
