# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The three methods of calibration as least-squares problems (Eqs. 10-19, 25).

- ``per_image`` (the paper's Method 1): every image has its own rotation.
- ``single`` (Method 2): one rotation for all images, the star tracker taken as perfect.
- ``hierarchical`` (beyond the paper): one common alignment, and for each image an attitude error
  of the star tracker's covariance.  The other two are its limits.

With R_k = camera_from_icrf of image k, the attitude error of the star tracker in it is
``eta_k = -Log(A' R_k T_k')``, a small rotation in the star tracker frame, where A =
camera_from_star_tracker and T_k = star_tracker_from_icrf as measured.

With terms of temperature (`estimation.temperature`), parameters and A are those of the image; the
derivatives by the shared unknowns follow by the chain rule, with one small matrix for each image.

Several star trackers have different axes.  T_k is then that of the tracker that gave the attitude.
Its alignment is A of the first tracker, turned by its mounting M (first from this one) and by the
small rotation h of the camera frame by which the mounting is wrong: ``exp(-[h x]) A M``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.camera import parameter_names
from starcal_ros.estimation.star_equations import Measurements, normal_blocks
from starcal_ros.estimation.temperature import parameters_at, turns

METHODS = ('hierarchical', 'per_image', 'single')


@dataclass(frozen=True)
class State:
    """Point of the search: camera parameters, alignment and the rotation of every image."""

    parameters: Floats  # (p,)
    camera_from_star_tracker: Rotation
    camera_from_icrf: Rotation  # (m,)
    focal: Floats = field(default_factory=lambda: np.empty(0))  # (q,) terms of temperature
    rate: Floats = field(default_factory=lambda: np.empty(0))  # (3,) of the alignment, or (0,)
    # (3 s,) h of the further star trackers, rad
    mountings: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class Problem:
    """
    Inputs of one search, for m images.

    Attributes
    ----------
    method : str
    model : str
        Lens model, of `lens.COEFFICIENTS`; it has p camera parameters.
    free : (f,) int
        Camera parameters that are estimated, ascending.
    prior_parameters, prior_sigma : (p,)
        Gaussian prior of the camera parameters; infinite sigma: none.
    star_tracker_from_icrf : Rotation (m,)
        As measured.
    star_tracker_sigma_rad : (m, 3)
        1-sigma of each attitude about the star tracker's axes; infinite: not to be trusted.
    above_reference_k : (m,)
        Temperature of each image less the reference; (0,) where no term is estimated.
    star_tracker : (m,) int
        Which star tracker gave the attitude of each image: 0 is the first.
    first_from_star_tracker : Rotation (m,) or None
        Its mounting as assumed; None where there is one star tracker only.
    mounting_sigma_rad : float
        1-sigma of each angle of the mountings as assumed.
    """

    method: str
    model: str
    free: NDArray[np.int64]
    prior_parameters: Floats
    prior_sigma: Floats
    star_tracker_from_icrf: Rotation
    star_tracker_sigma_rad: Floats
    above_reference_k: Floats = field(default_factory=lambda: np.empty(0))
    star_tracker: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    first_from_star_tracker: Rotation | None = None
    mounting_sigma_rad: float = np.inf

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the p camera parameters."""
        return parameter_names(self.model)

    @property
    def camera_count(self) -> int:
        """Number p of the camera parameters."""
        return len(self.prior_parameters)


def image_parameters(problem: Problem, state: State) -> Floats:
    """Camera parameters: (p,) of all images, or (m, p) where they differ."""
    if len(state.focal) == 0:
        return state.parameters
    return parameters_at(state.parameters, state.focal, problem.above_reference_k)


def image_alignment(problem: Problem, state: State) -> Rotation:
    """camera_from_star_tracker: of all images, or (m,) where they differ."""
    alignment = state.camera_from_star_tracker
    if len(state.rate):
        alignment = turns(state.rate, problem.above_reference_k) * alignment
    if problem.first_from_star_tracker is None:
        return alignment
    mounted: Rotation = mounting_turns(problem, state) * alignment
    return mounted * problem.first_from_star_tracker


def mounting_turns(problem: Problem, state: State) -> Rotation:
    """Rotations (m,) of the camera frame by which the mountings of the images are wrong."""
    return Rotation.from_rotvec(-mounting_errors_rad(problem, state))


def mounting_errors_rad(problem: Problem, state: State) -> Floats:
    """Errors (m, 3) of the mounting of the star tracker of each image, rad; 0 of the first."""
    errors = np.concatenate([np.zeros((1, 3)), state.mountings.reshape(-1, 3)])
    return np.asarray(errors[problem.star_tracker])


def image_blocks(
    problem: Problem, state: State, measurements: Measurements, loss_scale: float = np.inf
) -> tuple[float, Floats]:
    """Cost and the matrices of `star_equations.normal_blocks` at a state."""
    return normal_blocks(
        measurements,
        problem.model,
        image_parameters(problem, state),
        state.camera_from_icrf.as_matrix(),
        loss_scale,
    )


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
