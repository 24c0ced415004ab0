# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A camera that changes from image to image: its test, and the variances of its shape.

Focal length that breathes, two lenses that alternate, air that flattens the sky: the affine
shapes of the images, their rotations free, scatter by more than their stars explain.  Then each
image gets three unknowns of its own (scale, stretch and shear: changes of fx, skew and fy), with a
Gaussian prior about the camera that all images share.  The variances of the prior are found by the
method of moments (DerSimonian & Laird 1986).

The covariance of the camera carries the whole variance, not that of the mean of the images: a
calibration is used for one image, and the camera of one image differs from the mean by as much as
they scatter.  So does the mean itself from the true camera where all images err to one side, as by
refraction, which flattens every image and some more than others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.least_squares.levenberg_marquardt import inverse
from starcal_ros.least_squares.normal_equations import CAMERA, RESIDUAL, ROTATION

_P_VALUE = 1e-2  # below which the images differ; a sound camera loses little if they do not
_FEWEST_IMAGES = 4
_MODES = np.array([[1.0, 0.0, 1.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]]).T  # of fx, skew, fy
_LEAST_SIGMA_PX = 1e-4  # of focal length: 1e-5 px in a corner, and no division by zero


@dataclass(frozen=True)
class ImageVariation:
    """
    How much the shape of the images varies beyond their noise.

    ``chi2`` is the scatter of the shapes in the metric of their noise with its degrees of freedom;
    ``amplitude_sigma_px`` the 1-sigma of scale, stretch and shear as changes of the focal length,
    px; (0,) where the images do not differ.
    """

    chi2: float = 0.0
    degrees_of_freedom: int = 0
    amplitude_sigma_px: tuple[float, ...] = ()

    @property
    def p_value(self) -> float:
        """Probability of as much scatter without a change; 1 where it was not tested."""
        n = self.degrees_of_freedom
        return float(chdtrc(n, self.chi2)) if n else 1.0

    def corner_sigma_px(self, focal_px: float, radius_px: float) -> float:
        """1-sigma displacement of a star in a corner ``radius_px`` from the middle."""
        return float(np.linalg.norm(self.amplitude_sigma_px)) * radius_px / focal_px

    def covariance_of_one_image(self, parameter_count: int) -> Floats:
        """Covariance (p, p) of the camera of one image about the mean, on the parameters."""
        if not self.amplitude_sigma_px:
            return np.zeros((parameter_count, parameter_count))
        _, stretch_px, shear_px = self.amplitude_sigma_px
        # Air changes the scale by as much as it stretches.
        variance = np.square([max(self.amplitude_sigma_px), stretch_px, shear_px])
        modes = shape_modes(parameter_count)
        return np.asarray((modes * variance) @ modes.T)

    def is_close_to(self, other: ImageVariation) -> bool:
        """Whether the sigmas agree to 5 %, or to 1e-3 px: no estimate moves with that."""
        one, two = np.array(self.amplitude_sigma_px), np.array(other.amplitude_sigma_px)
        return len(one) == len(two) and bool(np.allclose(one, two, rtol=0.05, atol=1e-3))


def shape_modes(parameter_count: int) -> Floats:
    """Changes (p, 3) of the camera parameters by scale, stretch and shear of an image."""
    modes = np.zeros((parameter_count, 3))
    modes[:3] = _MODES
    return modes


def image_variation(blocks: Floats, shapes: Floats) -> ImageVariation:
    """
    Return the variation of the images of `normal_equations.normal_blocks` at a minimum.

    ``shapes`` are the amplitudes (m, 3) that the images have there; empty: zero.
    """
    A, a = blocks[:, CAMERA, CAMERA], blocks[:, CAMERA, RESIDUAL]
    B, C, c = blocks[:, ROTATION, CAMERA], blocks[:, ROTATION, ROTATION], blocks[:, ROTATION, -1]
    scale = np.einsum('mii->mi', C)
    seen = (scale > 0).all(axis=1)
    seen[seen] = (
        np.linalg.eigvalsh(C[seen] / np.sqrt(scale[seen][:, :, None] * scale[seen][:, None, :]))[
            :, 0
        ]
        > 1e-9
    )
    if np.count_nonzero(seen) < _FEWEST_IMAGES:
        return ImageVariation()
    A, a, B, C, c = A[seen], a[seen], B[seen], C[seen], c[seen]
    back = inverse(C) @ B
    D = shape_modes(A.shape[1])
    h = D.T @ (A - B.transpose(0, 2, 1) @ back) @ D
    s = (a - np.einsum('mip,mi->mp', back, c)) @ D
    if shapes.size:
        s = s + np.einsum('mij,mj->mi', h, shapes[seen])
    if not (np.einsum('mii->mi', h) > 0).all():
        return ImageVariation()
    mean = np.linalg.solve(h.sum(axis=0), s.sum(axis=0))
    off = s - h @ mean
    chi2 = float((off * np.linalg.solve(h, off[..., None])[..., 0]).sum())
    freedom = 3 * (len(h) - 1)
    if chdtrc(freedom, chi2) > _P_VALUE:
        return ImageVariation(chi2, freedom)
    # Each image by itself: in an image of few stars a change of scale looks like one of stretch.
    back = inverse(h)
    each = np.einsum('mij,mj->mi', back, off)
    weight = 1.0 / np.einsum('mii->mi', back)
    centre = (weight * each).sum(axis=0) / weight.sum(axis=0)
    excess = (weight * (each - centre) ** 2).sum(axis=0) - (len(h) - 1)
    spread = weight.sum(axis=0) - (weight**2).sum(axis=0) / weight.sum(axis=0)
    sigma_px = np.sqrt(np.maximum(excess / spread, _LEAST_SIGMA_PX**2))
    return ImageVariation(chi2, freedom, tuple(sigma_px.tolist()))
