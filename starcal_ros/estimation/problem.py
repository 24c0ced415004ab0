"""
The three methods of calibration as least-squares problems (Eqs. 10-19, 25).

- ``per_image`` (the paper's Method 1): every image has its own rotation.
- ``single`` (Method 2): one rotation for all images, the star tracker taken as perfect.
- ``hierarchical`` (beyond the paper): one common alignment, and for each image an attitude error
  of the star tracker's covariance.  The other two are its limits.

With R_k = camera_from_icrf of image k, the attitude error of the star tracker in it is
``eta_k = -Log(A' R_k T_k')``, a small rotation in the star tracker frame, where A =
camera_from_star_tracker and T_k = star_tracker_from_icrf as measured.

Where terms of temperature are estimated (`thermal`), parameters and A are those of the image, and
the derivatives by what is shared follow by the chain rule, one small matrix for each image.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.estimation.levenberg_marquardt import (
    levenberg_marquardt,
    NormalEquations,
    Solution,
)
from starcal_ros.estimation.normal_equations import Measurements, normal_blocks, RESIDUAL, ROTATION
from starcal_ros.estimation.temperature import parameters_at, parameters_chain, turns, turns_chain

METHODS = ('hierarchical', 'per_image', 'single')


@dataclass(frozen=True)
class State:
    """Where the search stands: camera parameters, alignment and the rotation of every image."""

    parameters: Floats  # (10,)
    camera_from_star_tracker: Rotation
    camera_from_icrf: Rotation  # (m,)
    focal: Floats = field(default_factory=lambda: np.empty(0))  # (q,) terms of temperature
    rate: Floats = field(default_factory=lambda: np.empty(0))  # (3,) of the alignment, or (0,)


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
    above_reference_k : (m,)
        Temperature of each image less the reference; (0,) where no term is estimated.
    """

    method: str
    free: NDArray[np.int64]
    prior_parameters: Floats
    prior_sigma: Floats
    star_tracker_from_icrf: Rotation
    star_tracker_sigma_rad: Floats
    above_reference_k: Floats = field(default_factory=lambda: np.empty(0))


def minimise(
    problem: Problem, start: State, measurements: Measurements, loss_scale: float = np.inf
) -> Solution[State]:
    """
    The state of least cost, by Levenberg-Marquardt.

    ``loss_scale`` is that of `normal_equations.normal_blocks`: infinite is least squares.

    Raises
    ------
    NotObservable
        When the stars do not determine all unknowns.
    """

    def evaluate(state: State) -> NormalEquations:
        cost, blocks = image_blocks(problem, state, measurements, loss_scale)
        return assemble(problem, state, cost, blocks)

    def move(state: State, shared: Floats, blocks: Floats) -> State:
        return _move(problem, state, shared, blocks)

    return levenberg_marquardt(start, evaluate, move)


def image_parameters(problem: Problem, state: State) -> Floats:
    """Camera parameters: (10,) of all images, or (m, 10) where temperature changes them."""
    if len(state.focal) == 0:
        return state.parameters
    return parameters_at(state.parameters, state.focal, problem.above_reference_k)


def image_alignment(problem: Problem, state: State) -> Rotation:
    """camera_from_star_tracker: of all images, or (m,) where temperature turns it."""
    if len(state.rate) == 0:
        return state.camera_from_star_tracker
    return turns(state.rate, problem.above_reference_k) * state.camera_from_star_tracker


def image_blocks(
    problem: Problem, state: State, measurements: Measurements, loss_scale: float = np.inf
) -> tuple[float, Floats]:
    """Cost and the (m, 14, 14) matrices of `normal_equations.normal_blocks` at a state."""
    return normal_blocks(
        measurements,
        image_parameters(problem, state),
        state.camera_from_icrf.as_matrix(),
        loss_scale,
    )


def by_shared(problem: Problem, state: State, blocks: Floats) -> Floats:
    """
    Matrices (m, 14 + q, 14 + q) by the camera parameters and q focal terms, angles and residual.

    From those by the parameters of the image; the same where no focal term is estimated.
    """
    q = len(state.focal)
    if q == 0:
        return blocks
    E = np.zeros((len(blocks), 14, 14 + q))
    E[:, :10, : 10 + q] = parameters_chain(
        state.parameters, state.focal, problem.above_reference_k
    )
    E[:, 10:, 10 + q :] = np.eye(4)
    return np.asarray(E.transpose(0, 2, 1) @ blocks @ E)


def assemble(problem: Problem, state: State, cost: float, blocks: Floats) -> NormalEquations:
    """
    Normal equations of a method from the cost and the (m, 14, 14) matrices of the images.

    Shared unknowns: the free camera parameters, the focal terms, then the alignment angles where
    the method has one alignment, and their rate; a block is the rotation of an image.
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
    k = 10 + len(state.focal)
    p = k + (3 + len(state.rate) if has_alignment else 0)
    A, a = np.zeros((p, p)), np.zeros(p)
    B: Floats = np.zeros((0, 3, p))
    C: Floats = np.zeros((0, 3, 3))
    c: Floats = np.zeros((0, 3))
    blocks = by_shared(problem, state, blocks)
    camera, rotation = slice(0, k), slice(k, k + 3)
    if problem.method == 'single':
        total = _by_alignment(problem, state, blocks).sum(axis=0)
        A[...], a[...] = total[:p, :p], total[:p, -1]
    else:
        total = blocks.sum(axis=0)
        A[camera, camera], a[camera] = total[camera, camera], total[camera, -1]
        B = np.zeros((len(blocks), 3, p))
        B[:, :, camera] = blocks[:, rotation, camera]
        C, c = blocks[:, rotation, rotation], blocks[:, rotation, -1]
    if problem.method == 'hierarchical':
        residual, J = _whitened_attitude_errors(problem, state)
        information = J.transpose(0, 2, 1) @ J
        gradient = np.einsum('mji,mj->mi', J, residual)
        cost += 0.5 * float((residual**2).sum())
        turn = _turn_chain(problem, state)
        to_shared = information @ turn
        A[k:, k:] += (turn.transpose(0, 2, 1) @ to_shared).sum(axis=0)
        a[k:] += np.einsum('mji,mj->mi', turn, gradient).sum(axis=0)
        B[:, :, k:] = -to_shared
        C, c = C + information, c - gradient
    C = _pulled(C)
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


def _pulled(C: Floats) -> Floats:
    """The blocks (m, 3, 3) of the rotations; one on which nothing pulls keeps its rotation."""
    return np.where(C.any(axis=(1, 2), keepdims=True), C, np.eye(3))


def _turn_chain(problem: Problem, state: State) -> Floats:
    """How alignment angles and rate turn the camera of each image: (m, 3, 3) or (m, 3, 6)."""
    if len(state.rate):
        return turns_chain(state.rate, problem.above_reference_k)
    return np.tile(np.eye(3), (len(state.camera_from_icrf), 1, 1))


def _by_alignment(problem: Problem, state: State, blocks: Floats) -> Floats:
    """Matrices of `by_shared` with alignment angles and rate in place of the image's rotation."""
    if len(state.rate) == 0:
        return blocks
    k = 10 + len(state.focal)
    E = np.zeros((len(blocks), k + 4, k + 7))
    E[:, :k, :k], E[:, -1, -1] = np.eye(k), 1.0
    E[:, k:-1, k:-1] = _turn_chain(problem, state)
    return np.asarray(E.transpose(0, 2, 1) @ blocks @ E)


def reduced_information(problem: Problem, state: State, blocks: Floats) -> Floats:
    """
    Information (p, p) on all ten camera parameters, and the other unknowns that are shared.

    Those are focal terms, and alignment with its rate where the method has one; the rotations of
    the images are eliminated.
    """
    of_prior = np.zeros(10)
    of_prior[problem.free] = 1.0 / problem.prior_sigma[problem.free] ** 2
    total = information_of_images(problem, state, blocks).sum(axis=0)
    total[np.arange(10), np.arange(10)] += of_prior
    return np.asarray(total)


def information_of_images(problem: Problem, state: State, blocks: Floats) -> Floats:
    """Information (m, p, p) of each image, without the prior: see `reduced_information`."""
    k = 10 + len(state.focal)
    blocks = by_shared(problem, state, blocks)
    if problem.method == 'single':
        p = k + 3 + len(state.rate)
        return _by_alignment(problem, state, blocks)[:, :p, :p]
    camera, rotation = slice(0, k), slice(k, k + 3)
    A, B = blocks[:, camera, camera], blocks[:, rotation, camera]
    C = blocks[:, rotation, rotation]
    if problem.method == 'hierarchical':
        _, J = _whitened_attitude_errors(problem, state)
        tracker = J.transpose(0, 2, 1) @ J
        turn = _turn_chain(problem, state)
        p = k + turn.shape[2]
        stars, A = A, np.zeros((len(blocks), p, p))
        A[:, camera, camera] = stars
        A[:, k:, k:] = turn.transpose(0, 2, 1) @ tracker @ turn
        B = np.concatenate([B, -tracker @ turn], axis=2)
        C = C + tracker
    return np.asarray(A - B.transpose(0, 2, 1) @ np.linalg.solve(_pulled(C), B))


def _whitened_attitude_errors(problem: Problem, state: State) -> tuple[Floats, Floats]:
    """
    Star tracker errors (m, 3) in sigma, and their derivative (m, 3, 3) by the images' rotations.

    The derivative by the alignment at the temperature of the image is the negative of it.
    """
    eta = attitude_errors(problem, state, state.camera_from_icrf)
    # d Log: the inverse Jacobian of SO(3) to first order, exact to eta^2 / 12 (1e-9 at 20 arcsec).
    half = 0.5 * _cross_matrix(eta)
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
    camera_from_star_tracker = image_alignment(problem, state).as_matrix()
    star_tracker_from_camera = np.swapaxes(camera_from_star_tracker, -1, -2)
    covariance = star_tracker_from_camera @ inverse @ camera_from_star_tracker
    return np.where(seen[:, None], eta, 0.0), covariance, seen


def _cross_matrix(v: Floats) -> Floats:
    """Matrices (m, 3, 3) with ``_cross_matrix(v) @ w = v x w``."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _move(problem: Problem, state: State, shared: Floats, blocks: Floats) -> State:
    """Take a step: parameters add, rotations turn (Eq. 11)."""
    f, q = len(problem.free), len(state.focal)
    parameters = state.parameters.copy()
    parameters[problem.free] += shared[:f]
    focal, turned = state.focal + shared[f : f + q], shared[f + q :]
    alignment, rotations = state.camera_from_star_tracker, state.camera_from_icrf
    if problem.method == 'per_image':
        rotations = Rotation.from_rotvec(-blocks) * rotations
        return State(parameters, alignment, rotations, focal, state.rate)
    turn = Rotation.from_rotvec(-turned[:3])
    rate = state.rate + turned[3:]
    moved = State(parameters, turn * alignment, rotations, focal, rate)
    if problem.method == 'hierarchical':
        rotations = Rotation.from_rotvec(-blocks) * rotations
    elif len(rate):
        rotations = image_alignment(problem, moved) * problem.star_tracker_from_icrf
    else:
        rotations = turn * rotations
    return replace(moved, camera_from_icrf=rotations)
