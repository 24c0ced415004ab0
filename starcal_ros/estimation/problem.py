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

Where terms of temperature are estimated (`thermal`), parameters and A are those of the image, and
the derivatives by what is shared follow by the chain rule, one small matrix for each image.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.camera import parameter_names
from starcal_ros.detector_field import DetectorField
from starcal_ros.estimation.levenberg_marquardt import (
    inverse,
    levenberg_marquardt,
    NormalEquations,
    Solution,
)
from starcal_ros.estimation.linear_terms import (
    Border,
    bordered,
    LinearTerms,
    scalar_terms,
    Scalars,
    Score,
    score,
)
from starcal_ros.estimation.normal_equations import Measurements, normal_blocks, RESIDUAL, ROTATION
from starcal_ros.estimation.residual_field import FieldPrior
from starcal_ros.estimation.temperature import parameters_at, parameters_chain, turns, turns_chain

METHODS = ('hierarchical', 'per_image', 'single')


@dataclass(frozen=True)
class State:
    """Where the search stands: camera parameters, alignment and the rotation of every image."""

    parameters: Floats  # (p,)
    camera_from_star_tracker: Rotation
    camera_from_icrf: Rotation  # (m,)
    focal: Floats = field(default_factory=lambda: np.empty(0))  # (q,) terms of temperature
    rate: Floats = field(default_factory=lambda: np.empty(0))  # (3,) of the alignment, or (0,)
    modes: Floats = field(default_factory=lambda: np.empty(0))  # (r,) amplitudes of the field


@dataclass(frozen=True)
class Problem:
    """
    What one search is given, for m images.

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
    field_prior : FieldPrior or None
        Of the field that is estimated beside the lens model; None: none is.
    """

    method: str
    model: str
    free: NDArray[np.int64]
    prior_parameters: Floats
    prior_sigma: Floats
    star_tracker_from_icrf: Rotation
    star_tracker_sigma_rad: Floats
    above_reference_k: Floats = field(default_factory=lambda: np.empty(0))
    field_prior: FieldPrior | None = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the p camera parameters."""
        return parameter_names(self.model)

    @property
    def camera_count(self) -> int:
        """Number p of the camera parameters."""
        return len(self.prior_parameters)


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
    information: Floats | None = None  # of the modes of the field: the same at every state

    def evaluate(state: State) -> NormalEquations:
        nonlocal information
        cost, blocks = image_blocks(problem, state, measurements, loss_scale)
        if not np.isfinite(cost):
            return NormalEquations(cost, *(np.empty(0) for _ in range(5)))
        terms = field_terms(problem, state, measurements, information)
        information = terms.information if terms else None
        return assemble(problem, state, cost, blocks, terms)

    def move(state: State, shared: Floats, blocks: Floats) -> State:
        return _move(problem, state, shared, blocks)

    return levenberg_marquardt(start, evaluate, move)


def image_parameters(problem: Problem, state: State) -> Floats:
    """Camera parameters: (p,) of all images, or (m, p) where temperature changes them."""
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
    """Cost and the matrices of `normal_equations.normal_blocks` at a state."""
    return normal_blocks(
        measurements,
        problem.model,
        image_parameters(problem, state),
        state.camera_from_icrf.as_matrix(),
        loss_scale,
        image_field(problem, state),
    )


def image_field(problem: Problem, state: State) -> DetectorField | None:
    """Field at a state; None where none is estimated."""
    return problem.field_prior.field(state.modes) if problem.field_prior else None


def scalar_terms_at(
    problem: Problem,
    state: State,
    measurements: Measurements,
    scalars: Scalars,
    information: Floats | None = None,
) -> LinearTerms:
    """Sums of the terms of functions of the pixel at a state."""
    return scalar_terms(
        measurements,
        problem.model,
        image_parameters(problem, state),
        state.camera_from_icrf.as_matrix(),
        scalars,
        image_field(problem, state),
        information,
    )


def field_terms(
    problem: Problem,
    state: State,
    measurements: Measurements,
    information: Floats | None = None,
) -> LinearTerms | None:
    """
    Sums of the modes of the field; None where none is estimated.

    ``information`` is that of an earlier call with the same measurements.
    """
    prior = problem.field_prior
    if prior is None:
        return None
    if information is None:
        terms = scalar_terms_at(problem, state, measurements, prior.polynomials)
        return terms.in_modes(prior.modes)
    unused = np.empty((0, 0))
    terms = scalar_terms_at(problem, state, measurements, prior.polynomials, unused)
    return LinearTerms(information, prior.modes.T @ terms.cross)


def by_shared(problem: Problem, state: State, blocks: Floats) -> Floats:
    """
    Matrices (m, p + q + 4, p + q + 4) by camera parameters, focal terms, angles and residual.

    From those by the parameters of the image; the same where no focal term is estimated.
    """
    if len(state.focal) == 0:
        return blocks
    E = _focal_chain(problem, state, len(blocks))
    return np.asarray(E.transpose(0, 2, 1) @ blocks @ E)


def _focal_chain(problem: Problem, state: State, m: int) -> Floats:
    """Derivatives (m, p + 4, p + q + 4) of the columns of an image by those of `by_shared`."""
    p, q = problem.camera_count, len(state.focal)
    E = np.zeros((m, p + 4, p + 4 + q))
    E[:, :p, : p + q] = parameters_chain(state.parameters, state.focal, problem.above_reference_k)
    E[:, p:, p + q :] = np.eye(4)
    return E


def assemble(
    problem: Problem,
    state: State,
    cost: float,
    blocks: Floats,
    terms: LinearTerms | None = None,
) -> NormalEquations:
    """
    Normal equations of a method from the cost and the matrices of the images.

    Shared unknowns: the free camera parameters, the focal terms, then the alignment angles where
    the method has one alignment, and their rate, and the modes of the field, whose ``terms`` are
    those of `field_terms`; a block is the rotation of an image.
    """
    normal = _with_all_parameters(problem, state, cost, blocks)
    keep = _estimated(problem, normal)
    normal = NormalEquations(
        normal.cost,
        normal.A[np.ix_(keep, keep)],
        normal.a[keep],
        normal.B[:, :, keep],
        normal.C,
        normal.c,
    )
    if terms is None:
        return normal
    return bordered(
        dataclasses.replace(normal, cost=normal.cost + 0.5 * float(state.modes @ state.modes)),
        _with_mode_prior(border_of(problem, state, terms), state),
    )


def _estimated(problem: Problem, normal: NormalEquations) -> NDArray[np.int64]:
    """Which shared unknowns of `_with_all_parameters` are estimated."""
    return np.concatenate([problem.free, np.arange(problem.camera_count, len(normal.a))])


def _with_mode_prior(border: Border, state: State) -> Border:
    """The border of modes that have a unit normal prior each."""
    return dataclasses.replace(
        border,
        information=border.information + np.eye(len(state.modes)),
        gradient=border.gradient - state.modes,
    )


def border_of(
    problem: Problem, state: State, terms: LinearTerms, every_parameter: bool = False
) -> Border:
    """
    Linear terms as a border of the normal equations of `assemble` without a field.

    With ``every_parameter``, of those in which all camera parameters are unknowns.
    """
    cross = terms.cross
    m, q, _ = cross.shape
    if len(state.focal):
        cross = cross @ _focal_chain(problem, state, m)
    k = problem.camera_count + len(state.focal)
    camera = cross[:, :, :k].sum(axis=0)
    rotation = cross[:, :, k : k + 3]
    if problem.method == 'single':
        aligned = np.einsum('mqi,mij->qj', rotation, _turn_chain(problem, state))
        blocks: Floats = np.zeros((0, 3, q))
    else:
        count = 0 if problem.method == 'per_image' else 3 + len(state.rate)
        aligned = np.zeros((q, count))
        blocks = rotation.transpose(0, 2, 1)
    if not every_parameter:
        free = np.concatenate([problem.free, np.arange(problem.camera_count, k)])
        camera = camera[:, free]
    return Border(
        terms.information,
        cross[:, :, -1].sum(axis=0),
        np.concatenate([camera, aligned], axis=1),
        blocks,
    )


def score_of(
    problem: Problem,
    state: State,
    blocks: Floats,
    field: LinearTerms | None,
    tested: LinearTerms,
    between: Floats | None = None,
) -> Score:
    """
    Score of linear terms at a state, all that is estimated free to answer.

    ``field`` are the `field_terms`, with ``between`` (q, r) the information that the tested terms
    share with the modes.
    """
    normal = assemble(problem, state, 0.0, blocks, field)
    border = border_of(problem, state, tested)
    if field is not None:
        assert between is not None
        border = dataclasses.replace(
            border, shared=np.concatenate([border.shared, between], axis=1)
        )
    return score(normal, border)


def _with_all_parameters(
    problem: Problem, state: State, cost: float, blocks: Floats
) -> NormalEquations:
    """Normal equations as if all camera parameters were free; priors on those that are."""
    has_alignment = problem.method != 'per_image'
    k = problem.camera_count + len(state.focal)
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
    of_camera = np.arange(problem.camera_count)
    off = np.zeros(len(of_camera))
    off[problem.free] = ((problem.prior_parameters - state.parameters) / problem.prior_sigma)[
        problem.free
    ]
    weight = np.zeros(len(of_camera))
    weight[problem.free] = 1.0 / problem.prior_sigma[problem.free] ** 2
    cost += 0.5 * float(off @ off)
    A[of_camera, of_camera] += weight
    a[of_camera] += off / problem.prior_sigma
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
    k = problem.camera_count + len(state.focal)
    E = np.zeros((len(blocks), k + 4, k + 7))
    E[:, :k, :k], E[:, -1, -1] = np.eye(k), 1.0
    E[:, k:-1, k:-1] = _turn_chain(problem, state)
    return np.asarray(E.transpose(0, 2, 1) @ blocks @ E)


def reduced_information(
    problem: Problem, state: State, blocks: Floats, terms: LinearTerms | None = None
) -> Floats:
    """
    Information (s, s) on all camera parameters, and the other unknowns that are shared.

    Those are focal terms, alignment with its rate where the method has one, and the modes of the
    field, whose ``terms`` are those of `field_terms`; the rotations of the images are eliminated.
    """
    camera = np.arange(problem.camera_count)
    of_prior = np.zeros(len(camera))
    of_prior[problem.free] = 1.0 / problem.prior_sigma[problem.free] ** 2
    total = information_of_images(problem, state, blocks).sum(axis=0)
    total[camera, camera] += of_prior
    if terms is None:
        return np.asarray(total)
    border = _with_mode_prior(border_of(problem, state, terms, every_parameter=True), state)
    shared, information = border.shared, border.information
    if len(border.blocks):
        normal = _with_all_parameters(problem, state, 0.0, blocks)
        X = border.blocks.reshape(-1, len(information))
        C_inverse = inverse(normal.C)
        shared = shared - X.T @ (C_inverse @ normal.B).reshape(len(X), -1)
        information = information - X.T @ (C_inverse @ border.blocks).reshape(X.shape)
    return np.block([[total, shared.T], [shared, information]])


def information_of_images(problem: Problem, state: State, blocks: Floats) -> Floats:
    """Information (m, s, s) of each image, without the prior: see `reduced_information`."""
    k = problem.camera_count + len(state.focal)
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
    r = len(state.modes)
    last = len(shared) - r
    focal, turned = state.focal + shared[f : f + q], shared[f + q : last]
    modes = state.modes + shared[last:]
    alignment, rotations = state.camera_from_star_tracker, state.camera_from_icrf
    if problem.method == 'per_image':
        rotations = Rotation.from_rotvec(-blocks) * rotations
        return State(parameters, alignment, rotations, focal, state.rate, modes)
    turn = Rotation.from_rotvec(-turned[:3])
    rate = state.rate + turned[3:]
    moved = State(parameters, turn * alignment, rotations, focal, rate, modes)
    if problem.method == 'hierarchical':
        rotations = Rotation.from_rotvec(-blocks) * rotations
    elif len(rate):
        rotations = image_alignment(problem, moved) * problem.star_tracker_from_icrf
    else:
        rotations = turn * rotations
    return replace(moved, camera_from_icrf=rotations)
