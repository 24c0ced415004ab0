# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A camera that changes from image to image: tested, and carried in the covariance.

Focal length that breathes, two lenses that alternate, air that flattens the sky: the affine
shape of each image, its own rotation free, scatters by more than its stars explain.  Three modes
of shape (scale, stretch, shear) get a variance each by the method of moments (DerSimonian & Laird
1986), and the calibration, a weighted mean over the images, the covariance that follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.estimation.levenberg_marquardt import inverse
from starcal_ros.estimation.normal_equations import CAMERA, RESIDUAL, ROTATION

_P_VALUE = 1e-3  # below which the variances are carried
_FEWEST_IMAGES = 4
_MODES = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T  # of fx, skew, fy


@dataclass(frozen=True)
class ImageVariation:
    """
    How much the shape of the images varies beyond their noise.

    ``sigma_px`` is the 1-sigma displacement of a star in a corner of the detector, ``chi2`` the
    scatter of the shapes in the metric of their noise with its degrees of freedom;
    ``information`` (p, p) is the variance that it adds to the gradient of the cost by the camera
    parameters.
    """

    sigma_px: float
    chi2: float
    degrees_of_freedom: int
    information: Floats

    @property
    def p_value(self) -> float:
        """Probability of as much scatter without a change; 1 where it was not tested."""
        n = self.degrees_of_freedom
        return float(chdtrc(n, self.chi2)) if n else 1.0


def image_variation(blocks: Floats, focal_px: float, radius_px: float) -> ImageVariation:
    """
    Return the variation of the images of `normal_equations.normal_blocks` at a minimum.

    ``radius_px`` is from the middle of the detector to its corner.
    """
    A, a = blocks[:, CAMERA, CAMERA], blocks[:, CAMERA, RESIDUAL]
    B, C, c = blocks[:, ROTATION, CAMERA], blocks[:, ROTATION, ROTATION], blocks[:, ROTATION, -1]
    p = A.shape[1]
    none = ImageVariation(0.0, 0.0, 0, np.zeros((p, p)))
    scale = np.einsum('mii->mi', C)
    seen = (scale > 0).all(axis=1)
    seen[seen] = (
        np.linalg.eigvalsh(C[seen] / np.sqrt(scale[seen][:, :, None] * scale[seen][:, None, :]))[
            :, 0
        ]
        > 1e-9
    )
    if np.count_nonzero(seen) < _FEWEST_IMAGES:
        return none
    A, a, B, C, c = A[seen], a[seen], B[seen], C[seen], c[seen]
    back = inverse(C) @ B
    H = A - B.transpose(0, 2, 1) @ back
    g = a - np.einsum('mip,mi->mp', back, c)
    D = np.zeros((p, 3))
    D[:3] = _MODES
    h, s = D.T @ H @ D, g @ D
    scaled = np.einsum('mii->mi', h)
    if not (scaled > 0).all():
        return none
    mean = np.linalg.solve(h.sum(axis=0), s.sum(axis=0))
    off = s - h @ mean
    q = float((off * np.linalg.solve(h, off[..., None])[..., 0]).sum())
    degrees_of_freedom = 3 * (len(h) - 1)
    if chdtrc(degrees_of_freedom, q) > _P_VALUE:
        return ImageVariation(0.0, q, degrees_of_freedom, none.information)
    weight = scaled
    each = off / weight
    centre = (weight * each).sum(axis=0) / weight.sum(axis=0)
    excess = (weight * (each - centre) ** 2).sum(axis=0) - (len(h) - 1)
    spread = weight.sum(axis=0) - (weight**2).sum(axis=0) / weight.sum(axis=0)
    variance = np.maximum(excess / spread, 0.0)
    by_mode = H @ D
    information = np.einsum('mpk,k,mqk->pq', by_mode, variance, by_mode)
    sigma_px = float(np.sqrt(variance.sum())) * radius_px / focal_px
    return ImageVariation(sigma_px, q, degrees_of_freedom, information)
