# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Likelihood of smooth fields beside a lens model, from the residuals of the stars.

With F the information on the coefficients c of the field and g its gradient, all other unknowns
eliminated, and ``c ~ N(0, s^2 W)``, the likelihood ratio against s = 0 is
``2 log L = sum z_i^2 s^2 L_i / (1 + s^2 L_i) - log(1 + s^2 L_i)`` over the eigenvalues L_i of
``W^(1/2) F W^(1/2)``; z_i is the gradient along them in sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from starcal_ros.arrays import Floats
from starcal_ros.camera import (
    CameraModel,
    line_of_sight,
    pixel_grid,
    project_jacobians,
)
from starcal_ros.detector_field import basis
from starcal_ros.least_squares.linear_terms import Scalars, Score
from starcal_ros.model_errors import field_kernel
from starcal_ros.model_errors.field_kernel import Wave, Waves

AMPLITUDES_PX = np.geomspace(1e-3, 10.0, 41)
_GRID = 41  # pixels a side at which the lens model's own displacements are taken
# Of the detector, with a line of sight: a circular image fills 0.4 of a wide one; a lens model
# that stars in one spot determine folds back around them.
_LEAST_SEEN = 0.25
_LEAST_INFORMATION = 1e-12  # of the largest, under which a combination is not seen


def polynomials(width: int, height: int, degree: int) -> Scalars:
    """Return the polynomials of a detector as functions of the pixel."""
    return lambda pixels: basis(pixels.T, width, height, degree).T


def sees_detector(camera: CameraModel) -> bool:
    """Whether the lens model has lines of sight for enough of the detector to hold a field."""
    seen = np.isfinite(line_of_sight(camera, pixel_grid(camera, _GRID, _GRID))[:, 0])
    return bool(seen.mean() >= _LEAST_SEEN)


def spanned_by_lens(camera: CameraModel, free: NDArray[np.int64], degree: int) -> Floats:
    """
    Return an orthonormal basis (2 t, r) of what the lens model and a rotation explain.

    ``free`` are the camera parameters that are estimated.
    """
    pixels = pixel_grid(camera, _GRID, _GRID)
    directions = line_of_sight(camera, pixels)
    seen = np.isfinite(directions[:, 0])
    _, J_parameters, J_rotation = project_jacobians(camera, directions[seen])
    J = np.concatenate([J_parameters[..., free], J_rotation], axis=-1)
    phi = basis(pixels[seen], camera.width, camera.height, degree)
    J = J / np.linalg.norm(J, axis=(0, 1))
    found = np.linalg.lstsq(phi, J.transpose(0, 2, 1).reshape(len(phi), -1), rcond=None)[0]
    found = found.reshape(phi.shape[1], J.shape[2], 2).transpose(2, 0, 1).reshape(-1, J.shape[2])
    left, singular, _ = np.linalg.svd(found, full_matrices=False)
    spanned: Floats = left[:, singular > 1e-6 * singular[0]]
    return spanned


@dataclass(frozen=True)
class ComponentLikelihood:
    """
    Likelihood of the covariance of one component of a field, everything else at its prior.

    With ``F = R R'`` the information on the coefficients of the component and ``g = R h`` its
    gradient, ``2 log L = h' (I - (I + s^2 R' W R)^-1) h - log |I + s^2 R' W R|``:
    no root of W is needed.

    Attributes
    ----------
    root : (t, f)
        s R.
    along : (f,)
        h.
    rest : float
        Twice the log of the likelihood ratio of everything else.
    """

    root: Floats
    along: Floats
    rest: float

    def ratio(self, covariance: Floats) -> float:
        """Twice the log of the likelihood ratio, to no field, of a covariance W (t, t)."""
        spread = self.root.T @ covariance @ self.root
        factor = cho_factor(spread + np.eye(len(spread)), lower=True)
        left = float(self.along @ cho_solve(factor, self.along))
        return self.rest + float(self.along @ self.along) - left - _log_determinant(factor[0])


def _log_determinant(lower: Floats) -> float:
    """Logarithm of the determinant of a matrix from its Cholesky factor."""
    return 2.0 * float(np.log(np.diagonal(lower)).sum())


@dataclass(frozen=True)
class FieldLikelihood:
    """Score of the polynomials of a detector, less what the lens model explains."""

    camera: CameraModel
    degree: int
    span: Floats
    information: Floats
    gradient: Floats
    patterns: Floats

    def root(self, length: float, waves: Waves) -> Floats:
        """Root of the prior covariance of an amplitude of 1 px."""
        size = self.camera.width, self.camera.height
        u, v = (field_kernel.root(*size, self.degree, length, wave) for wave in waves)
        zero = np.zeros((len(u), v.shape[1])), np.zeros((len(v), u.shape[1]))
        return np.concatenate([np.block([[u, zero[0]], [zero[1], v]]), self.patterns], axis=1)

    def best_amplitude(self, length: float, waves: Waves) -> tuple[float, float]:
        """Twice the log of the largest likelihood ratio, and the amplitude in px."""
        ratio = self.ratios(self.root(length, waves), AMPLITUDES_PX)
        k = int(ratio.argmax())
        return float(ratio[k]), float(AMPLITUDES_PX[k])

    def ratios(self, root: Floats, amplitudes_px: NDArray[np.floating]) -> Floats:
        """Twice the log of the likelihood ratios (k,) of amplitudes, to no field."""
        eigenvalues, vectors = np.linalg.eigh(root.T @ self.information @ root)
        eigenvalues = np.maximum(eigenvalues, 0.0)
        along = vectors.T @ (root.T @ self.gradient)
        s2 = amplitudes_px[:, None] ** 2
        shrunk = 1.0 + s2 * eigenvalues
        return np.asarray((along**2 * s2 / shrunk - np.log(shrunk)).sum(axis=1))

    def radial_score(self) -> float:
        """Gradient along the radial pattern, in sigma; 0 where the stars say nothing about it."""
        radial = self.patterns[:, 0]
        information = float(radial @ self.information @ radial)
        return float(radial @ self.gradient) / np.sqrt(information) if information > 0 else 0.0

    def of_component(
        self, component: int, length: float, other: Wave | None, amplitude_px: float
    ) -> ComponentLikelihood:
        """
        Return the likelihood of the prior of one component, 0 for u, at an amplitude.

        The other component, whose wave is ``other``, and the patterns have their prior.
        """
        t = len(self.gradient) // 2
        own, beside = (slice(t), slice(t, None)) if component == 0 else (slice(t, None), slice(t))
        known = field_kernel.root(
            self.camera.width, self.camera.height, self.degree, length, other
        )
        held = np.zeros((2 * t, known.shape[1] + self.patterns.shape[1]))
        held[beside, : known.shape[1]] = known
        held[:, known.shape[1] :] = self.patterns
        held *= amplitude_px
        shown = held.T @ self.information
        factor = cho_factor(shown @ held + np.eye(held.shape[1]), lower=True)
        moved = held.T @ self.gradient
        back = cho_solve(factor, np.column_stack([shown[:, own], moved]))
        information = self.information[own, own] - shown[:, own].T @ back[:, :t]
        gradient = self.gradient[own] - shown[:, own].T @ back[:, t]
        values, vectors = np.linalg.eigh(information)
        shows = values > _LEAST_INFORMATION * values[-1]
        root = vectors[:, shows] * np.sqrt(values[shows])
        along = (gradient @ vectors[:, shows]) / np.sqrt(values[shows])
        rest = float(moved @ back[:, t]) - _log_determinant(factor[0])
        return ComponentLikelihood(amplitude_px * root, along, rest)

    def posterior_mean(self, length: float, waves: Waves, amplitude_px: float) -> Floats:
        """Coefficients (2 t,) of the field of largest posterior probability."""
        modes = amplitude_px * self.root(length, waves)
        held = modes.T @ self.information @ modes + np.eye(modes.shape[1])
        return np.asarray(modes @ np.linalg.solve(held, modes.T @ self.gradient))


def field_likelihood(
    score: Score, camera: CameraModel, free: NDArray[np.int64], degree: int
) -> FieldLikelihood:
    """
    Return the likelihood of fields beside a lens model.

    Parameters
    ----------
    score : Score
        Of the terms of `polynomials` of that degree, at a field of zero.
    camera : CameraModel
    free : (f,) int
        Camera parameters that are estimated.
    degree : int
    """
    span = spanned_by_lens(camera, free, degree)
    return FieldLikelihood(
        camera,
        degree,
        span,
        _projected(_projected(score.information, span).T, span),
        score.gradient - span @ (span.T @ score.gradient),
        _patterns(camera.width, camera.height, degree, span),
    )


def _projected(matrix: Floats, span: Floats) -> Floats:
    """Return the matrix less what its columns have of a span."""
    return np.asarray(matrix - span @ (span.T @ matrix))


def _patterns(width: int, height: int, degree: int, span: Floats) -> Floats:
    """
    Coefficients (2 t, 7) of the terms that lens models have next, less what the lens model spans.

    Radial of 8th order, thin prism of 2nd and 4th order, tilt; each with a mean square of 1.
    """
    patterns = _projected(_pattern_coefficients(width, height, degree), span)
    return np.asarray(patterns / np.linalg.norm(patterns, axis=0))


@functools.lru_cache(maxsize=8)
def _pattern_coefficients(width: int, height: int, degree: int) -> Floats:
    """Coefficients (2 t, 7) of the patterns as they are."""
    u, v = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    pixels = np.stack([u.ravel(), v.ravel()], axis=-1)
    half = np.array([width - 1, height - 1]) / 2.0
    xy = (pixels - half) / float(np.hypot(*half))
    x, y = xy.T
    r2 = x * x + y * y
    zero = np.zeros_like(x)
    moved = [
        (x * r2**4, y * r2**4),
        *((power, zero) for power in (r2, r2**2)),
        *((zero, power) for power in (r2, r2**2)),
        (x * x, x * y),
        (x * y, y * y),
    ]
    phi = basis(pixels, width, height, degree)
    both = np.concatenate([np.stack(axis, axis=-1) for axis in zip(*moved, strict=True)], axis=1)
    along_u, along_v = np.split(np.linalg.lstsq(phi, both, rcond=None)[0], 2, axis=1)
    coefficients = np.concatenate([along_u, along_v])
    coefficients.setflags(write=False)
    return np.asarray(coefficients)
