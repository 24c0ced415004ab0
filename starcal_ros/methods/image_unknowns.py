# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rotations and shapes of the images as the stars alone show them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.least_squares.normal_equations import RESIDUAL, ROTATION
from starcal_ros.methods.assembly import by_shared, pulled, with_shape_prior
from starcal_ros.methods.attitude_errors import attitude_errors
from starcal_ros.methods.problem import image_alignment, Problem, State


def attitudes_of_stars_alone(
    problem: Problem, state: State, blocks: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """
    Star tracker errors as the stars alone show them.

    Returns
    -------
    eta_rad : (m, 3)
        In the star tracker frame.
    covariance_rad2 : (m, 3, 3)
        From the stars of the image, the camera taken as known.
    seen : (m,) bool
        Whether the image has stars enough; the rows of the others are zero.
    """
    C, c = _rotations_of_stars(problem, state, blocks)
    diagonal = np.einsum('mii->mi', C)
    seen = (diagonal > 0).all(axis=1)
    scale = np.where(seen[:, None], 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    scaled = C * scale[:, :, None] * scale[:, None, :]
    seen &= np.linalg.eigvalsh(np.where(seen[:, None, None], scaled, np.eye(3)))[:, 0] > 1e-9
    inverse = np.zeros_like(C)
    inverse[seen] = np.linalg.inv(scaled[seen])
    inverse *= scale[:, :, None] * scale[:, None, :]
    # Where the star tracker holds the rotation off the stars' minimum, one step leads there.
    step = np.einsum('mij,mj->mi', inverse, c)
    eta = attitude_errors(problem, state, Rotation.from_rotvec(-step) * state.camera_from_icrf)
    camera_from_star_tracker = image_alignment(problem, state).as_matrix()
    star_tracker_from_camera = np.swapaxes(camera_from_star_tracker, -1, -2)
    covariance = star_tracker_from_camera @ inverse @ camera_from_star_tracker
    return np.where(seen[:, None], eta, 0.0), covariance, seen


def shape_unknowns(problem: Problem, state: State, blocks: Floats) -> float:
    """Number of unknowns that the shapes of the images are, less what their prior holds."""
    if not state.shapes.size:
        return 0.0
    k = problem.camera_count + len(state.focal)
    own = pulled(by_shared(problem, state, blocks)[:, k:-1, k:-1])
    C, B = own[:, :3, :3], own[:, :3, 3:]
    shown = own[:, 3:, 3:] - B.transpose(0, 2, 1) @ np.linalg.pinv(C, hermitian=True) @ B
    held = np.diag(1.0 / problem.shape_sigma_px**2)
    return float(np.trace(np.linalg.solve(shown + held, shown), axis1=1, axis2=2).sum())


def _rotations_of_stars(problem: Problem, state: State, blocks: Floats) -> tuple[Floats, Floats]:
    """Information (m, 3, 3) and gradient (m, 3) of the rotations, the shapes eliminated."""
    if not state.shapes.size:
        return blocks[:, ROTATION, ROTATION], blocks[:, ROTATION, RESIDUAL]
    k = problem.camera_count + len(state.focal)
    own = by_shared(problem, state, blocks)[:, k:, k:]
    C, c = with_shape_prior(problem, own[:, :-1, :-1]), own[:, :-1, -1].copy()
    c[:, 3:] -= state.shapes / problem.shape_sigma_px**2
    back = C[:, :3, 3:] @ np.linalg.inv(C[:, 3:, 3:])
    return C[:, :3, :3] - back @ C[:, 3:, :3], c[:, :3] - np.einsum('mij,mj->mi', back, c[:, 3:])
