# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Normal equations of the whole list of unknowns at a state, image by image.

One pass over the stars gives the sums of each image: products of the derivatives by the camera
parameters, by the turns (velocity of the observer and others), by the rotation of the image, and
of the residual; and their products with the functions of the field.  Everything that follows
(amplitudes, solution, covariance, predictions) is linear algebra on these sums.

With x the shared unknowns and y_k the rotation and the shape of image k, the equations are an
arrow: ``N = [A, B_k'; B_k, C_k]``, right-hand side ``[a; c_k]``.  The images are eliminated:
``S = A - sum B_k' C_k^-1 B_k``.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from dataclasses import dataclass

import numpy as np

from starcal_ros.arrays import Floats, Indices
from starcal_ros.estimation.levenberg_marquardt import (
    eliminated,
    Equations,
    NormalEquations,
    NotObservable,
)
from starcal_ros.estimation.problem import (
    image_parameters,
    Problem,
    State,
    whitened_attitude_errors,
)
from starcal_ros.estimation.star_equations import (
    Chunk,
    Measurements,
    normal_blocks,
    whitened_chunks,
)
from starcal_ros.estimation.unknowns import IMAGE_ROTATION, Layout


@dataclass(frozen=True)
class Linearisation:
    """
    The list of unknowns of a problem at a state, and the stars that are used.

    ``measurements`` have the working weights; ``predicted_px`` (n, 2) are the places of all
    observations without their noise, where the functions of the field are taken: at the measured
    places they would correlate with the residuals, by more than the stars show of a field that is
    nearly a change of the camera.
    """

    problem: Problem
    state: State
    layout: Layout
    measurements: Measurements
    predicted_px: Floats


@dataclass(frozen=True)
class StarSums:
    """
    Sums over the stars of m images.

    ``blocks`` (m, d, d) has the columns of `chain`: the unknowns that stars see, the field aside,
    and the residual; ``field_information`` (2 t, 2 t) and ``field_cross`` (m, 2 t, d) have the
    functions of the field for u, then for v.
    """

    blocks: Floats
    field_information: Floats
    field_cross: Floats


def stars_alone(
    problem: Problem,
    state: State,
    layout: Layout,
    measurements: Measurements,
    loss_scale: float = np.inf,
) -> tuple[float, StarSums]:
    """Cost of the stars and the sums of a list without turns and field, as of `normal_blocks`."""
    own, rotations = image_parameters(problem, state), state.camera_from_icrf.as_matrix()
    cost, blocks = normal_blocks(measurements, problem.model, own, rotations, loss_scale)
    none: Floats = np.empty((0, 0))
    cross: Floats = np.empty((len(blocks), 0, blocks.shape[2]))
    return cost, _chained(blocks, none, cross, problem, layout)


def _chained(
    blocks: Floats, field: Floats, cross: Floats, problem: Problem, layout: Layout
) -> StarSums:
    """Return the sums by the unknowns from those by the columns of `star_columns`."""
    E = chain(problem, layout, len(blocks))
    if E.shape[1] == E.shape[2] and (np.eye(E.shape[1]) == E).all():
        return StarSums(blocks, field, cross)
    return StarSums(E.transpose(0, 2, 1) @ blocks @ E, field, cross @ E)


def star_columns(linear: Linearisation) -> Iterator[tuple[Chunk, Floats]]:
    """
    Yield each chunk with its whitened columns (2, c, m n), which the next one overwrites.

    They are the camera parameters, the turns (velocity of the observer and others, then those of
    an image), the rotation of the image, and the residual: that of the camera parameters and the
    rotations of the state.

    Raises
    ------
    NotObservable
        If the camera model has no image of a star.
    """
    problem, state = linear.problem, linear.state
    p = problem.camera_count
    own = image_parameters(problem, state)
    rotations = state.camera_from_icrf.as_matrix()
    turning = [entry for entry in linear.layout.entries if entry.turn is not None]
    turning.sort(key=lambda entry: entry.of_image)
    given = linear.measurements, problem.model, own, rotations, sum(map(len, turning))
    for chunk, J in whitened_chunks(*given):
        if J is None:
            raise NotObservable('a star has no image')
        if turning:
            e = (rotations[chunk.image] @ chunk.direction_icrf).transpose(1, 0, 2).reshape(3, -1)
            image = np.repeat(chunk.image, chunk.direction_icrf.shape[2])
            predicted_px, at = _predicted_px(chunk, J[:, -2]), p
            for entry in turning:
                turns = entry.turns(predicted_px, e, image, chunk.row)
                here = J[:, at : at + len(entry)]
                np.einsum('rbn,bqn->rqn', J[:, -5:-2], turns, out=here)
                at += len(entry)
        yield chunk, J[:, :-1]


def star_rows(
    linear: Linearisation, part: Indices, mean: Floats
) -> Iterator[tuple[Chunk, Floats, Floats, Floats]]:
    """
    Yield each chunk with its whitened derivatives and residuals, u before v.

    Derivatives (m, 2 n, d) by a part (d,) of the shared unknowns, in ascending order, and (m, 2 n,
    b) by those of each image, and the residuals (m, 2 n) that the mean (P,) of all shared ones
    leaves.  The layout has a field.
    """
    layout = linear.layout
    E = chain(linear.problem, layout, linear.measurements.image_count).transpose(0, 2, 1)
    at, field = seen_by_stars(layout), layout.field_at
    functions = layout.field.functions
    assert functions is not None
    (seen, to), (of_u, to_u), (of_v, to_v) = (
        (places := np.flatnonzero(np.isin(of, part)), np.searchsorted(part, of[places]))
        for of in (at, *np.split(field, 2))
    )
    for chunk, Z in star_columns(linear):
        m, _, n = chunk.direction_icrf.shape
        by_image = Z.reshape(2, -1, m, n).transpose(2, 1, 0, 3).reshape(m, -1, 2 * n)
        rows = E[chunk.image] @ by_image
        phi = functions(linear.predicted_px[chunk.row].T)
        u, v = (mean[field].reshape(2, -1) @ phi).reshape(2, m, n)
        wuu, wuv, wvv = (w.reshape(m, n) for w in chunk.whitener)
        residual = rows[:, -1] - mean[at] @ rows[:, : len(at)]
        residual -= np.concatenate([wuu * u + wuv * v, wvv * v], axis=1)
        # Stars are the last axis: reading and writing along it takes a third of the time.
        shared = np.zeros((m, len(part), 2 * n))
        shared[:, to] = rows[:, seen]
        phi = phi.reshape(-1, m, n)
        shared[:, to_u, :n] = (phi[of_u] * wuu).transpose(1, 0, 2)
        shared[:, to_v, :n] = (phi[of_v] * wuv).transpose(1, 0, 2)
        shared[:, to_v, n:] = (phi[of_v] * wvv).transpose(1, 0, 2)
        yield (
            chunk,
            shared.transpose(0, 2, 1),
            rows[:, len(at) : -1].transpose(0, 2, 1),
            residual,
        )


def weighted_rows_by(
    linear: Linearisation, root: Floats, of_images: Floats
) -> Iterator[tuple[Chunk, Floats]]:
    """
    Yield each chunk with its weighted derivatives (2, m n, r) by the columns of a root (P, r).

    The weights are inverse covariances.  The unknowns of the images follow the root by (m, b, r).
    The functions of the field are not weighted one by one, half of the products are saved.
    """
    layout = linear.layout
    E, at = chain(linear.problem, layout, linear.measurements.image_count), seen_by_stars(layout)
    by_root = E[:, :, : len(at)] @ root[at] + E[:, :, len(at) : -1] @ of_images
    functions, r = layout.field.functions, root.shape[1]
    assert functions is not None
    of_field = np.concatenate(np.split(root[layout.field_at], 2), axis=1)
    for chunk, Z in star_columns(linear):
        m, _, n = chunk.direction_icrf.shape
        wuu, wuv, wvv = chunk.whitener
        Z[1] *= wvv
        Z[1] += wuv * Z[0]
        Z[0] *= wuu
        columns = Z.reshape(2, -1, m, n).transpose(0, 2, 3, 1)
        rows = (columns @ by_root[chunk.image]).reshape(2, m * n, r)
        moved = functions(linear.predicted_px[chunk.row].T).T @ of_field
        rows[0] += (wuu * wuu)[:, None] * moved[:, :r]
        rows[1] += (wuv * wuv + wvv * wvv)[:, None] * moved[:, r:]
        if wuv.any():
            rows[0] += (wuu * wuv)[:, None] * moved[:, r:]
            rows[1] += (wuu * wuv)[:, None] * moved[:, :r]
        yield chunk, rows


def _predicted_px(chunk: Chunk, residual: Floats) -> Floats:
    """
    Return the predicted pixels (2, m n) of a chunk from its whitened residuals (2, m n).

    Derivatives at measured pixels would correlate with the noise of the residuals: a time of
    read-out that only its small curvature shows was off by 1.6 of its sigma.
    """
    wuu, wuv, wvv = (np.where(chunk.whitener[0] > 0, w, 1.0) for w in chunk.whitener)
    v = residual[1] / wvv
    return np.asarray(chunk.measured_px - np.stack([(residual[0] - wuv * v) / wuu, v]))


def star_sums(linear: Linearisation) -> StarSums:
    """Return the sums over the stars at a state."""
    layout, measurements = linear.layout, linear.measurements
    field = next((entry for entry in layout.entries if entry.functions is not None), None)
    t = len(field) // 2 if field is not None else 0
    blocks: Floats = np.empty((0, 0, 0))
    cross = blocks
    uu, uv, vv = np.zeros((3, t, t))
    for chunk, Z in star_columns(linear):
        c = Z.shape[1]
        m, _, n = chunk.direction_icrf.shape
        if not blocks.size:
            blocks = np.zeros((measurements.image_count, c, c))
            cross = np.zeros((measurements.image_count, 2 * t, c))
        by_image = Z.reshape(2, c, m, n).transpose(0, 2, 1, 3)
        blocks[chunk.image] = (by_image @ by_image.transpose(0, 1, 3, 2)).sum(axis=0)
        if field is None:
            continue
        assert field.products is not None
        wuu, wuv, wvv = chunk.whitener
        weights = [wuu * wuu, wvv * wvv + wuv * wuv, wuu * wuv][: 3 if wuv.any() else 2]
        phi, products = field.products(linear.predicted_px[chunk.row].T, np.stack(weights))
        for total, part in zip((uu, vv, uv), products, strict=False):
            total += part
        # Both axes at once: the functions are read once.
        columns = np.concatenate([wuu * Z[0], wuv * Z[0] + wvv * Z[1]])
        by_image = columns.reshape(2 * c, m, n).transpose(1, 0, 2)
        both = by_image @ phi.reshape(t, m, n).transpose(1, 2, 0)
        cross[chunk.image] = both.reshape(m, 2, c, t).transpose(0, 1, 3, 2).reshape(m, 2 * t, c)
    information = np.block([[uu, uv], [uv.T, vv]])
    return _chained(blocks, information, cross, linear.problem, layout)


def arrow(sums: StarSums, problem: Problem, state: State, layout: Layout) -> NormalEquations:
    """
    Return the normal equations without priors, with the cost of the star trackers alone.

    The rotation of an image has the prior that its star tracker predicts.
    """
    at = seen_by_stars(layout)
    blocks, cross = sums.blocks, sums.field_cross
    m, P = len(blocks), layout.count
    stars, own, _ = chain_columns(layout)
    total, of_field = blocks.sum(axis=0), cross.sum(axis=0)
    A, a = np.zeros((P, P)), np.zeros(P)
    A[np.ix_(at, at)], a[at] = total[stars, stars], total[stars, -1]
    C, c = blocks[:, own, own].copy(), blocks[:, own, -1].copy()
    B: Floats = np.zeros((m, C.shape[1], P))
    B[:, :, at] = blocks[:, own, stars]
    field = layout.field_at
    if len(field):
        A[np.ix_(field, field)] = sums.field_information
        A[np.ix_(field, at)] = of_field[:, stars]
        A[np.ix_(at, field)] = A[np.ix_(field, at)].T
        a[field] = of_field[:, -1]
        B[:, :, field] = cross[:, :, own].transpose(0, 2, 1)
    whitened, J = whitened_attitude_errors(problem, state)
    turning, turns = tracker_turns(layout)
    information = J.transpose(0, 2, 1) @ J
    gradient = np.einsum('mji,mj->mi', J, whitened)
    to_shared = information @ turns
    A[np.ix_(turning, turning)] += np.tensordot(turns, to_shared, axes=((0, 1), (0, 1)))
    a[turning] += np.tensordot(turns, gradient, axes=((0, 1), (0, 1)))
    B[:, IMAGE_ROTATION, turning] -= to_shared
    C[:, IMAGE_ROTATION, IMAGE_ROTATION] += information
    c[:, IMAGE_ROTATION] -= gradient
    # A rotation on which nothing pulls stays.
    still = ~C[:, IMAGE_ROTATION, IMAGE_ROTATION].any(axis=(1, 2))
    C[still, IMAGE_ROTATION, IMAGE_ROTATION] += np.eye(3)
    return NormalEquations(0.5 * float((whitened**2).sum()), A, a, B, C, c)


def equations(sums: StarSums, linear: Linearisation, shape_sigma_px: Floats | float) -> Equations:
    """Return the normal equations of a linearisation, the images eliminated."""
    normal = arrow(sums, linear.problem, linear.state, linear.layout)
    return without_images(normal, linear.layout, shape_sigma_px)


def without_images(
    normal: NormalEquations, layout: Layout, shape_sigma_px: Floats | float
) -> Equations:
    """
    Return an arrow with the images eliminated, by the priors of their unknowns.

    ``shape_sigma_px`` (s,) is that of their shapes.
    """
    C = normal.C + np.diag(layout.image_precision(shape_sigma_px))
    return eliminated(dataclasses.replace(normal, C=C))


def information_of_images(
    sums: StarSums, problem: Problem, state: State, layout: Layout
) -> Floats:
    """
    Return the information (m, P, P) of each image on the shared unknowns, without their priors.

    The list has neither field nor shapes; the rotation of the image is eliminated.
    """
    normal, at = arrow(sums, problem, state, layout), seen_by_stars(layout)
    stars, *_ = chain_columns(layout)
    A = np.zeros((len(sums.blocks), layout.count, layout.count))
    A[:, at[:, None], at] = sums.blocks[:, stars, stars]
    turning, turns = tracker_turns(layout)
    by_tracker = whitened_attitude_errors(problem, state)[1] @ turns
    A[:, turning[:, None], turning] += by_tracker.transpose(0, 2, 1) @ by_tracker
    return np.asarray(A - normal.B.transpose(0, 2, 1) @ np.linalg.solve(normal.C, normal.B))


def seen_by_stars(layout: Layout) -> Indices:
    """Return the places of the shared unknowns that stars see, the field aside; as `chain`."""
    seen = [e.name for e in layout.shared if e.camera is not None or e.turn is not None]
    return layout.of(seen)


def chain(problem: Problem, layout: Layout, m: int) -> Floats:
    """
    Return the derivatives (m, c, d) of the columns of `star_columns` by the unknowns.

    In the order: shared ones by camera, by turn; the rotation of the image, its other unknowns;
    residual.
    """
    by_camera = [entry for entry in layout.shared if entry.camera is not None]
    by_turn = [entry for entry in layout.shared if entry.turn is not None]
    of_image = layout.of_image
    p = problem.camera_count
    turns = sum(map(len, by_turn))
    first = sum(map(len, by_camera))
    own = sum(map(len, of_image))
    own_turns = sum(len(entry) for entry in of_image if entry.turn is not None)
    E = np.zeros((m, p + turns + own_turns + 4, first + turns + 3 + own + 1))
    at = 0
    for entry in by_camera:
        E[:, :p, at : at + len(entry)] = entry.camera
        at += len(entry)
    E[:, p : p + turns, at : at + turns] = np.eye(turns)
    at, row = at + turns, p + turns
    E[:, -4:-1, at : at + 3] = np.eye(3)
    at += 3
    for entry in of_image:
        here = slice(at, at + len(entry))
        if entry.camera is not None:
            E[:, :p, here] = entry.camera
        else:
            E[:, row : row + len(entry), here] = np.eye(len(entry))
            row += len(entry)
        at += len(entry)
    E[:, -1, -1] = 1.0
    return E


def chain_columns(layout: Layout) -> tuple[slice, slice, slice]:
    """Return the columns of `chain` of shared unknowns, of those of an image, of its rotation."""
    first = len(seen_by_stars(layout))
    rotation = slice(first + IMAGE_ROTATION.start, first + IMAGE_ROTATION.stop)
    return slice(0, first), slice(first, -1), rotation


def tracker_turns(layout: Layout) -> tuple[Indices, Floats]:
    """
    Return how shared unknowns turn the camera that the star trackers predict.

    The places (q,) of those that do, and the rotations (m, 3, q) by them.
    """
    turning = [entry for entry in layout.shared if entry.tracker is not None]
    by = [entry.tracker for entry in turning if entry.tracker is not None]
    return layout.of([entry.name for entry in turning]), np.concatenate(by, axis=2)
