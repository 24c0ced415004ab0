# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rotations of images applied to stars: their directions, their fit, and axes of the sky."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import CameraModel, line_of_sight, rotation_jacobian
from starcal_ros.estimation.limits import FEWEST
from starcal_ros.estimation.problem import State
from starcal_ros.estimation.star_equations import StarTable


def turned(rotations: Floats, image: NDArray[np.int64], vectors: Floats) -> Floats:
    """Return vectors (n, 3) turned by the rotations (m, 3, 3) of their images (n,)."""
    # To take along an axis, and to sum along the stars, is a fifth of the time of other ways.
    of_star = np.take(rotations.transpose(1, 2, 0), image, axis=2)
    return np.asarray(np.einsum('ijn,jn->in', of_star, np.ascontiguousarray(vectors.T)).T)


def fitted_rotations(
    predicted: Rotation, table: StarTable, camera: CameraModel
) -> tuple[Rotation, Mask]:
    """
    Return the rotations (m,) that fit the stars better, and which are those of the stars.

    Each image alone: Wahba's problem by singular values (Markley 1988).
    """
    seen = line_of_sight(camera, table.measured_px)
    real = np.isfinite(seen).all(axis=1)
    seen, e, image = seen[real], table.direction_icrf[real], table.image[real]
    m = table.image_count
    products = [np.bincount(image, a * b, minlength=m) for a in seen.T for b in e.T]
    u, _, vt = np.linalg.svd(np.stack(products, axis=1).reshape(m, 3, 3))
    fitted, before = u @ vt, predicted.as_matrix()
    # A mirrored image has an improper one: the search finds its negative focal length.
    good = (np.linalg.det(fitted) > 0) & (np.bincount(image, minlength=m) >= FEWEST)
    count = np.bincount(image, minlength=m)
    middle = np.cumsum(count) - count + count // 2
    # Medians: lengths, at most 2, are sorted within their images by one key.
    off, off_before = (
        np.append(np.sort(image + 0.25 * length), np.inf)[middle]
        for length in (
            np.linalg.norm(seen - turned(one, image, e), axis=1) for one in (fitted, before)
        )
    )
    good &= off < off_before
    return Rotation.from_matrix(np.where(good[:, None, None], fitted, before)), good


def sky_rotations(state: State, table: StarTable, camera: CameraModel) -> Floats:
    """
    Rotations (n, 2, 2) of displacements fixed to a star into pixel axes.

    The rotation part of the derivative of the pixel by the place of the star.
    """
    e = table.direction_icrf
    along: Floats = np.asarray(np.cross(e, [0.1, 0.2, 0.97]))
    along /= np.linalg.norm(along, axis=1)[:, None]
    rotations = state.camera_from_icrf.as_matrix()
    in_camera = turned(rotations, table.image, e)
    J = rotation_jacobian(
        dataclasses.replace(camera, parameters=state.parameters, field=None), in_camera
    )
    columns = [
        np.einsum('nab,nb->na', J, np.cross(turned(rotations, table.image, axis), in_camera))
        for axis in (along, np.asarray(np.cross(e, along)))
    ]
    M = np.stack(columns, axis=2)
    # A mirrored pair of axes is the same for all stars: the sky's second axis is turned over.
    M[..., 1] *= np.sign(M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0])[:, None]
    angle = np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1])
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)
