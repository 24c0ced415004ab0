# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Difference of two calibrations: over the detector, and in the sigmas that they report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.records import CameraGeometry

_SINGULAR = 1e-12  # smaller eigenvalues of a correlation matrix are rounding errors


@dataclass(frozen=True)
class ChiSquared:
    """A squared Mahalanobis distance and its degrees of freedom; both 0 if nothing is compared."""

    value: float
    degrees_of_freedom: int

    @property
    def p_value(self) -> float:
        """Probability that noise alone gives as large a value; 1 without degrees of freedom."""
        n = self.degrees_of_freedom
        return float(chdtrc(n, self.value)) if n else 1.0


def chi_squared(difference: Floats, covariance: Floats) -> ChiSquared:
    """
    Squared length of a difference (k,) in the metric of its covariance (k, k) (Mahalanobis).

    Rows without a finite, positive variance are left out; directions in which the covariance is
    singular do not count as degrees of freedom.
    """
    known = np.isfinite(covariance).all(axis=1) & (np.diag(covariance) > 0)
    if not known.any():
        return ChiSquared(0.0, 0)
    difference, covariance = difference[known], covariance[np.ix_(known, known)]
    # Scaled to a unit diagonal first: fx and k3 differ by many powers of ten.
    sigma = np.sqrt(np.diag(covariance))
    scaled, correlation = difference / sigma, covariance / np.outer(sigma, sigma)
    inverse = np.linalg.pinv(correlation, rcond=_SINGULAR, hermitian=True)
    rank = int(np.linalg.matrix_rank(correlation, tol=_SINGULAR, hermitian=True))
    return ChiSquared(float(scaled @ inverse @ scaled), rank)


def lines_of_sight(geometry: CameraGeometry, columns: int, rows: int) -> Floats:
    """
    Unit directions of a grid of pixels in the star tracker frame, (columns * rows, 3), by rows.

    NaN where a pixel has no line of sight.
    """
    in_camera = line_of_sight(geometry.camera, pixel_grid(geometry.camera, columns, rows))
    return np.asarray(geometry.star_tracker_from_camera.apply(in_camera))


def movement(
    before: CameraGeometry, after: CameraGeometry, columns: int = 15, rows: int = 12
) -> tuple[float, Floats]:
    """
    Movement of the lines of sight of the pixels of a camera in the star tracker frame.

    Returns
    -------
    rotation_rad : float
        The rotation common to all pixels.
    left_px : (columns * rows,)
        The remaining movement at a grid of pixels, in pixels at the centre.  Both results are
        infinite if a pixel no longer has a line of sight.
    """
    old, new = (lines_of_sight(geometry, columns, rows) for geometry in (before, after))
    if not (np.isfinite(old).all() and np.isfinite(new).all()):
        return np.inf, np.full(len(old), np.inf)
    rotation, _ = Rotation.align_vectors(new, old)
    left_rad = np.linalg.norm(new - rotation.apply(old), axis=1)
    return float(rotation.magnitude()), left_rad * after.camera.parameters[0]


def parameter_difference(a: CameraGeometry, b: CameraGeometry) -> Floats:
    """Parameters of a less those of b, (p,): camera, then `alignment_difference_rad`."""
    of_camera = a.camera.parameters - b.camera.parameters
    return np.concatenate([of_camera, alignment_difference_rad(a, b)])


def alignment_difference_rad(a: CameraGeometry, b: CameraGeometry) -> Floats:
    """The passive small rotation (3,) of the camera frame that takes alignment b to a."""
    # a_from_b = exp(-[dtheta x]), so b_from_a has dtheta as its rotation vector.
    b_from_a = b.star_tracker_from_camera.inv() * a.star_tracker_from_camera
    return np.asarray(b_from_a.as_rotvec())
