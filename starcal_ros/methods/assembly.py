# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Normal equations of each method, from the matrices of the images (Eqs. 16-19)."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.least_squares.levenberg_marquardt import inverse, NormalEquations
from starcal_ros.least_squares.linear_terms import Border, bordered, LinearTerms, Score, score
from starcal_ros.methods.attitude_errors import cross_matrix, whitened_attitude_errors
from starcal_ros.methods.problem import mounting_errors_rad, mounting_turns, Problem, State
from starcal_ros.model_errors.temperature import parameters_chain, turns_chain


def by_shared(problem: Problem, state: State, blocks: Floats) -> Floats:
    """
    Matrices (m, p + q + 4 + h, p + q + 4 + h) of the images by all that they depend on.

    Rows and columns: camera parameters, focal terms, angles, shapes and residual; from those by
    the parameters of the image, which they are where there are neither focal terms nor shapes.
    """
    if not (len(state.focal) or state.shapes.size):
        return blocks
    E = image_chain(problem, state, len(blocks))
    return np.asarray(E.transpose(0, 2, 1) @ blocks @ E)


def image_chain(problem: Problem, state: State, m: int) -> Floats:
    """Derivatives (m, p + 4, p + q + 4 + h) of the columns of an image by those of `by_shared`."""
    p, q, h = problem.camera_count, len(state.focal), state.shapes.shape[1]
    E = np.zeros((m, p + 4, p + q + 4 + h))
    E[:, :p, : p + q] = (
        parameters_chain(state.parameters, state.focal, problem.above_reference_k)
        if q
        else np.eye(p)
    )
    E[:, p:-1, p + q : p + q + 3] = np.eye(3)
    E[:, :p, p + q + 3 : -1] = problem.shape_modes if h else 0.0
    E[:, -1, -1] = 1.0
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
    those of `field_terms`; a block is the rotation of an image and its shape.
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
    if len(state.focal) or state.shapes.size:
        cross = cross @ image_chain(problem, state, m)
    k = problem.camera_count + len(state.focal)
    camera = cross[:, :, :k].sum(axis=0)
    own = cross[:, :, k:-1]
    if problem.method == 'single':
        aligned = np.einsum('mqi,mij->qj', own, _turn_chain(problem, state))
        blocks: Floats = np.zeros((0, 3, q))
    else:
        count = 0 if problem.method == 'per_image' else state.alignment_count
        aligned = np.zeros((q, count))
        blocks = own.transpose(0, 2, 1)
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
    p = k + (state.alignment_count if has_alignment else 0)
    A, a = np.zeros((p, p)), np.zeros(p)
    B: Floats = np.zeros((0, 3, p))
    C: Floats = np.zeros((0, 3, 3))
    c: Floats = np.zeros((0, 3))
    blocks = by_shared(problem, state, blocks)
    camera, own = slice(0, k), slice(k, -1)
    if problem.method == 'single':
        total = _by_alignment(problem, state, blocks).sum(axis=0)
        A[...], a[...] = total[:p, :p], total[:p, -1]
    else:
        total = blocks.sum(axis=0)
        A[camera, camera], a[camera] = total[camera, camera], total[camera, -1]
        B = np.zeros((len(blocks), blocks.shape[1] - k - 1, p))
        B[:, :, camera] = blocks[:, own, camera]
        C, c = blocks[:, own, own], blocks[:, own, -1]
    if state.shapes.size:
        off_shape = state.shapes / problem.shape_sigma_px
        cost += 0.5 * float((off_shape**2).sum())
        C = with_shape_prior(problem, C)
        c = np.concatenate([c[:, :3], c[:, 3:] - off_shape / problem.shape_sigma_px], axis=1)
    if problem.method == 'hierarchical':
        residual, J = whitened_attitude_errors(problem, state)
        information = J.transpose(0, 2, 1) @ J
        gradient = np.einsum('mji,mj->mi', J, residual)
        cost += 0.5 * float((residual**2).sum())
        turn = _turn_chain(problem, state)
        to_shared = information @ turn
        A[k:, k:] += (turn.transpose(0, 2, 1) @ to_shared).sum(axis=0)
        a[k:] += np.einsum('mji,mj->mi', turn, gradient).sum(axis=0)
        B[:, :3, k:] = -to_shared
        C, c = C.copy(), c.copy()
        C[:, :3, :3] += information
        c[:, :3] -= gradient
    C = pulled(C)
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
    if has_alignment and len(state.mountings):
        of_mounting = state.mountings / problem.mounting_sigma_rad
        cost += 0.5 * float(of_mounting @ of_mounting)
        of_mountings = np.arange(p - len(of_mounting), p)
        A[of_mountings, of_mountings] += 1.0 / problem.mounting_sigma_rad**2
        a[of_mountings] -= of_mounting / problem.mounting_sigma_rad
    return NormalEquations(cost, A, a, B, C, c)


def with_shape_prior(problem: Problem, C: Floats) -> Floats:
    """The blocks (m, 3 + h, 3 + h) of rotations and shapes with the prior of the shapes."""
    weight = np.concatenate([np.zeros(3), 1.0 / problem.shape_sigma_px**2])
    return np.asarray(C + np.diag(weight))


def pulled(C: Floats) -> Floats:
    """The blocks (m, 3 + h, 3 + h); a rotation on which nothing pulls stays."""
    still = ~C[:, :3, :3].any(axis=(1, 2), keepdims=True)
    hold = np.zeros(C.shape[1:])
    hold[:3, :3] = np.eye(3)
    return np.where(still, C + hold, C)


def _turn_chain(problem: Problem, state: State) -> Floats:
    """How alignment angles, rate and mountings turn the camera of each image: (m, 3, a)."""
    m = len(state.camera_from_icrf)
    chain: Floats = np.tile(np.eye(3), (m, 1, 1))
    if len(state.rate):
        chain = turns_chain(state.rate, problem.above_reference_k)
    if problem.first_from_star_tracker is None:
        return chain
    # d exp(-[h x]) to first order in h, as `turns_chain`.
    own = np.eye(3) - 0.5 * cross_matrix(mounting_errors_rad(problem, state))
    of_mountings = np.zeros((m, 3, len(state.mountings)))
    for k in range(len(state.mountings) // 3):
        here = problem.star_tracker == k + 1
        of_mountings[here, :, 3 * k : 3 * k + 3] = own[here]
    turned = mounting_turns(problem, state).as_matrix() @ chain
    return np.concatenate([turned, of_mountings], axis=-1)


def _by_alignment(problem: Problem, state: State, blocks: Floats) -> Floats:
    """Matrices of `by_shared` with what turns all images in place of the image's rotation."""
    if state.alignment_count == 3:
        return blocks
    k = problem.camera_count + len(state.focal)
    E = np.zeros((len(blocks), k + 4, k + 1 + state.alignment_count))
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
    if problem.method != 'per_image' and len(state.mountings):
        mountings = np.arange(len(total) - len(state.mountings), len(total))
        total[mountings, mountings] += 1.0 / problem.mounting_sigma_rad**2
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
        p = k + state.alignment_count
        return _by_alignment(problem, state, blocks)[:, :p, :p]
    camera, own = slice(0, k), slice(k, -1)
    A, B, C = blocks[:, camera, camera], blocks[:, own, camera], blocks[:, own, own]
    if state.shapes.size:
        C = with_shape_prior(problem, C)
    if problem.method == 'hierarchical':
        _, J = whitened_attitude_errors(problem, state)
        tracker = J.transpose(0, 2, 1) @ J
        turn = _turn_chain(problem, state)
        p = k + turn.shape[2]
        stars, A = A, np.zeros((len(blocks), p, p))
        A[:, camera, camera] = stars
        A[:, k:, k:] = turn.transpose(0, 2, 1) @ tracker @ turn
        of_alignment = np.zeros((*B.shape[:2], turn.shape[2]))
        of_alignment[:, :3] = -tracker @ turn
        B = np.concatenate([B, of_alignment], axis=2)
        C = C.copy()
        C[:, :3, :3] += tracker
    return np.asarray(A - B.transpose(0, 2, 1) @ np.linalg.solve(pulled(C), B))
