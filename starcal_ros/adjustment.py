"""
The three methods of calibration as least-squares problems (Eqs. 10-19, 25).

- ``per_image`` (the paper's Method 1): every image has its own rotation.
- ``single`` (Method 2): one rotation for all images, the star tracker taken as perfect.
- ``hierarchical`` (beyond the paper): one common alignment, and for each image an attitude error
  of the star tracker's covariance.  The other two are its limits.

With R_k = camera_from_icrf of image k, the attitude error of the star tracker in it is
``eta_k = -Log(A' R_k T_k')``, a small rotation in the star tracker frame, where A =
camera_from_star_tracker and T_k = star_tracker_from_icrf as measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.least_squares import levenberg_marquardt, NormalEquations, Solution
from starcal_ros.measurement import CAMERA, Measurements, normal_blocks, RESIDUAL, ROTATION

Floats = NDArray[np.float64]

METHODS = ('hierarchical', 'per_image', 'single')


@dataclass(frozen=True)
class State:
    """Where the search stands: camera parameters, alignment and the rotation of every image."""

    parameters: Floats  # (10,)
    camera_from_star_tracker: Rotation
    camera_from_icrf: Rotation  # (m,)


@dataclass(frozen=True)
class Problem:
    """
    What one search is given, for m images.

    Attributes
    ----------
    method : str
    free : (f,) int
        Camera parameters that are estimated, ascending.
    prior_parameters, prior_sigma : (10,)
        Gaussian prior of the camera parameters; infinite sigma: none.
    star_tracker_from_icrf : Rotation (m,)
        As measured.
    star_tracker_sigma_rad : (m, 3)
        1-sigma of each attitude about the star tracker's axes; infinite: not to be trusted.
    """

    method: str
    free: NDArray[np.int64]
    prior_parameters: Floats
    prior_sigma: Floats
    star_tracker_from_icrf: Rotation
    star_tracker_sigma_rad: Floats


def minimise(
    problem: Problem, start: State, measurements: Measurements, loss_scale: float = np.inf
) -> Solution[State]:
    """
    The state of least cost, by Levenberg-Marquardt.

    ``loss_scale`` is that of `measurement.normal_blocks`: infinite is least squares.

    Raises
    ------
    NotObservable
        When the stars do not determine all unknowns.
    """

    def evaluate(state: State) -> NormalEquations:
        cost, blocks = normal_blocks(
            measurements, state.parameters, state.camera_from_icrf.as_matrix(), loss_scale
        )
        return assemble(problem, state, cost, blocks)

    def move(state: State, shared: Floats, blocks: Floats) -> State:
        return _move(problem, state, shared, blocks)

    return levenberg_marquardt(start, evaluate, move)


def assemble(problem: Problem, state: State, cost: float, blocks: Floats) -> NormalEquations:
    """
    Normal equations of a method from the cost and the (m, 14, 14) matrices of the images.

    Shared unknowns: the free camera parameters, then the alignment angles where the method has
    one alignment; a block is the rotation of an image.
    """
    normal = _with_all_parameters(problem, state, cost, blocks)
    f = len(normal.a) - 10
    keep = np.concatenate([problem.free, np.arange(10, 10 + f)])
    return NormalEquations(
        normal.cost,
        normal.A[np.ix_(keep, keep)],
        normal.a[keep],
        normal.B[:, :, keep],
        normal.C,
        normal.c,
    )


def _with_all_parameters(
    problem: Problem, state: State, cost: float, blocks: Floats
) -> NormalEquations:
    """Normal equations as if all ten camera parameters were free; priors on those that are."""
    has_alignment = problem.method != 'per_image'
    p = 13 if has_alignment else 10
    A, a = np.zeros((p, p)), np.zeros(p)
    B: Floats = np.zeros((0, 3, p))
    C: Floats = np.zeros((0, 3, 3))
    c: Floats = np.zeros((0, 3))
    total = blocks.sum(axis=0)
    if problem.method == 'single':
        A[...], a[...] = total[:13, :13], total[:13, RESIDUAL]
    else:
        A[:10, :10], a[:10] = total[CAMERA, CAMERA], total[CAMERA, RESIDUAL]
        B = np.zeros((len(blocks), 3, p))
        B[:, :, :10] = blocks[:, ROTATION, CAMERA]
        C, c = blocks[:, ROTATION, ROTATION], blocks[:, ROTATION, RESIDUAL]
    if problem.method == 'hierarchical':
        residual, J = _whitened_attitude_errors(problem, state)
        information = J.transpose(0, 2, 1) @ J
        gradient = np.einsum('mji,mj->mi', J, residual)
        cost += 0.5 * float((residual**2).sum())
        A[10:, 10:] += information.sum(axis=0)
        a[10:] += gradient.sum(axis=0)
        B[:, :, 10:] = -information
        C, c = C + information, c - gradient
    # An image on which nothing pulls keeps its rotation.
    pulled = np.asarray(C.any(axis=(1, 2)))
    C = np.where(pulled[:, None, None], C, np.eye(3))
    off = np.zeros(10)
    off[problem.free] = ((problem.prior_parameters - state.parameters) / problem.prior_sigma)[
        problem.free
    ]
    weight = np.zeros(10)
    weight[problem.free] = 1.0 / problem.prior_sigma[problem.free] ** 2
    cost += 0.5 * float(off @ off)
    A[np.arange(10), np.arange(10)] += weight
    a[:10] += off / problem.prior_sigma
    return NormalEquations(cost, A, a, B, C, c)


def reduced_information(problem: Problem, state: State, blocks: Floats) -> Floats:
    """
    Information (p, p) on all ten camera parameters, and the alignment where the method has one.

    The rotations of the images are eliminated.
    """
    normal = _with_all_parameters(problem, state, 0.0, blocks)
    if len(normal.C) == 0:
        return normal.A
    return np.asarray(
        normal.A - np.einsum('mqi,mqj->ij', normal.B, np.linalg.solve(normal.C, normal.B))
    )


def _whitened_attitude_errors(problem: Problem, state: State) -> tuple[Floats, Floats]:
    """
    Star tracker errors (m, 3) in sigma, and their derivative (m, 3, 3) by the images' rotations.

    The derivative by the common alignment is the negative of it.
    """
    eta = attitude_errors(problem, state, state.camera_from_icrf)
    # d Log: the inverse Jacobian of SO(3) to first order, exact to eta^2 / 12 (1e-9 at 20 arcsec).
    half = 0.5 * _cross_matrix(eta)
    J = (np.eye(3) + half) @ state.camera_from_star_tracker.inv().as_matrix()
    sigma = problem.star_tracker_sigma_rad
    return eta / sigma, J / sigma[:, :, None]


def attitude_errors(problem: Problem, state: State, camera_from_icrf: Rotation) -> Floats:
    """Star tracker errors (m, 3), rad in its frame, when these are the rotations of the images."""
    return -np.asarray(
        (
            state.camera_from_star_tracker.inv()
            * camera_from_icrf
            * problem.star_tracker_from_icrf.inv()
        ).as_rotvec()
    )


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
    C = blocks[:, ROTATION, ROTATION]
    diagonal = np.einsum('mii->mi', C)
    seen = (diagonal > 0).all(axis=1)
    scale = np.where(seen[:, None], 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    scaled = C * scale[:, :, None] * scale[:, None, :]
    seen &= np.linalg.eigvalsh(np.where(seen[:, None, None], scaled, np.eye(3)))[:, 0] > 1e-9
    inverse = np.zeros_like(C)
    inverse[seen] = np.linalg.inv(scaled[seen])
    inverse *= scale[:, :, None] * scale[:, None, :]
    # Where the star tracker holds the rotation off the stars' minimum, one step leads there.
    step = np.einsum('mij,mj->mi', inverse, blocks[:, ROTATION, RESIDUAL])
    eta = attitude_errors(problem, state, Rotation.from_rotvec(-step) * state.camera_from_icrf)
    camera_from_star_tracker = state.camera_from_star_tracker.as_matrix()
    covariance = camera_from_star_tracker.T @ inverse @ camera_from_star_tracker
    return np.where(seen[:, None], eta, 0.0), covariance, seen


def _cross_matrix(v: Floats) -> Floats:
    """Matrices (m, 3, 3) with ``_cross_matrix(v) @ w = v x w``."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _move(problem: Problem, state: State, shared: Floats, blocks: Floats) -> State:
    """Take a step: parameters add, rotations turn (Eq. 11)."""
    f = len(problem.free)
    parameters = state.parameters.copy()
    parameters[problem.free] += shared[:f]
    alignment, rotations = state.camera_from_star_tracker, state.camera_from_icrf
    if problem.method == 'per_image':
        return State(parameters, alignment, Rotation.from_rotvec(-blocks) * rotations)
    turn = Rotation.from_rotvec(-shared[f:])
    if problem.method == 'single':
        return State(parameters, turn * alignment, turn * rotations)
    return State(parameters, turn * alignment, Rotation.from_rotvec(-blocks) * rotations)
