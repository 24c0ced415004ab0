# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Lines of sight of pixels with their sigmas: the whole camera as a table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid, project_jacobians
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.detector_field import basis

_CHUNK = 4096  # pixels at a time: the derivatives by a field of 300 terms take 30 MB
_GRID = 25  # pixels a side over which the common rotation is taken


@dataclass(frozen=True)
class LineOfSightTable:
    """
    Lines of sight of n pixels.

    Attributes
    ----------
    pixels : (n, 2)
        (u, v).
    direction_camera : (n, 3)
        Unit vectors in the camera frame; NaN where the camera has none.
    shape_sigma_arcsec : (n,)
        1-sigma of the direction, the rotation common to the detector removed: the root of the
        trace of its covariance.
    sigma_arcsec : (n,)
        1-sigma in the star tracker frame, camera and alignment together.
    """

    pixels: Floats
    direction_camera: Floats
    shape_sigma_arcsec: Floats
    sigma_arcsec: Floats

    def columns(self) -> dict[str, Floats]:
        """Columns (n,) by name, as in files and messages."""
        values = (*self.pixels.T, *self.direction_camera.T)
        return dict(
            zip(COLUMNS, (*values, self.shape_sigma_arcsec, self.sigma_arcsec), strict=True)
        )


COLUMNS = ('u_px', 'v_px', 'x', 'y', 'z', 'shape_sigma_arcsec', 'sigma_arcsec')
"""Pixel, unit vector in the camera frame, and 1-sigma of the direction: see `LineOfSightTable`."""


def line_of_sight_table(
    camera: CameraModel, covariance: Floats, pixels: Floats
) -> LineOfSightTable:
    """
    Return the lines of sight of pixels (n, 2).

    ``covariance`` is that of `line_of_sight_jacobian`'s numbers.
    """
    parts = [pixels[k : k + _CHUNK] for k in range(0, len(pixels), _CHUNK)]
    found = [_table(camera, covariance, part) for part in parts]
    return LineOfSightTable(
        pixels, *(np.concatenate(column) for column in zip(*found, strict=True))
    )


def _table(
    camera: CameraModel, covariance: Floats, pixels: Floats
) -> tuple[Floats, Floats, Floats]:
    directions, J = line_of_sight_jacobian(camera, pixels)
    shape = np.sqrt(_trace(_shape_jacobian(camera, directions, J), covariance))
    return directions, shape / ARCSECOND_RAD, np.sqrt(_trace(J, covariance)) / ARCSECOND_RAD


def pixels_every(camera: CameraModel, step_px: float) -> Floats:
    """Pixels (n, 2) at every step along both axes from pixel (0, 0), u fastest."""
    u, v = np.meshgrid(
        np.arange(0.0, camera.width - 0.5, step_px), np.arange(0.0, camera.height - 0.5, step_px)
    )
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def shape_sigma_rad(camera: CameraModel, covariance: Floats, pixels: Floats) -> Floats:
    """1-sigma (n,) of the directions of pixels (n, 2), the common rotation removed, rad."""
    directions, J = line_of_sight_jacobian(camera, pixels)
    return np.asarray(np.sqrt(_trace(_shape_jacobian(camera, directions, J), covariance)))


def line_of_sight_sigma_rad(camera: CameraModel, covariance: Floats, pixels: Floats) -> Floats:
    """1-sigma (n,) of the directions of pixels (n, 2) in the star tracker frame, rad."""
    _, J = line_of_sight_jacobian(camera, pixels)
    return np.asarray(np.sqrt(_trace(J, covariance)))


def line_of_sight_jacobian(camera: CameraModel, pixels: Floats) -> tuple[Floats, Floats]:
    """
    Lines of sight (n, 3) of pixels (n, 2) and their derivatives (n, 3, p + 3 + 2 t).

    By the p camera parameters, the alignment angles and the t coefficients of the field of the
    camera for u, then for v, in the camera frame.  For a fixed pixel: a direction moves so as to
    undo what the parameter does to its image.
    """
    directions = line_of_sight(camera, pixels)
    _, J_parameters, J_rotation = project_jacobians(camera, directions)
    J_pixel = J_parameters
    if camera.field is not None:
        phi = basis(pixels, camera.width, camera.height, camera.field.degree)
        n, t = phi.shape
        J_field = np.zeros((n, 2, 2 * t))
        J_field[:, 0, :t], J_field[:, 1, t:] = phi, phi
        J_pixel = np.concatenate([J_parameters, J_field], axis=-1)
    # A rotation about the line of sight itself moves nothing: the pseudo-inverse leaves it out.
    angles = np.linalg.pinv(np.nan_to_num(J_rotation)) @ np.nan_to_num(J_pixel)
    p = J_parameters.shape[-1]
    alignment = np.broadcast_to(np.eye(3), (len(angles), 3, 3))
    angles = np.concatenate([angles[..., :p], alignment, angles[..., p:]], axis=-1)
    moved = np.cross(directions[:, None, :], np.swapaxes(angles, 1, 2))
    return directions, -np.swapaxes(moved, 1, 2)


def _shape_jacobian(camera: CameraModel, directions: Floats, J: Floats) -> Floats:
    """
    The derivatives without the alignment, and without the rotation common to the detector.

    That rotation belongs to the alignment: it is the least-squares one over a grid of pixels.
    """
    p = len(camera.parameters)
    grid = pixel_grid(camera, _GRID, _GRID)
    at_grid, J_grid = line_of_sight_jacobian(camera, grid)
    seen = np.isfinite(at_grid[:, 0])
    J = J.copy()
    J[:, :, p : p + 3] = 0.0
    J_grid[:, :, p : p + 3] = 0.0
    to_rotation = np.linalg.pinv(_rotations(at_grid[seen]).reshape(-1, 3))
    common = to_rotation @ J_grid[seen].reshape(-1, J.shape[-1])
    return np.asarray(J - _rotations(directions) @ common)


def _rotations(directions: Floats) -> Floats:
    """Movement (n, 3, 3) of directions (n, 3) by small rotations about the three axes."""
    return np.stack([np.cross(axis, directions) for axis in np.eye(3)], axis=-1)


def _trace(J: Floats, covariance: Floats) -> Floats:
    """Traces (n,) of ``J covariance J'``."""
    return np.asarray(np.maximum(np.einsum('nij,nij->n', J @ covariance, J), 0.0))
