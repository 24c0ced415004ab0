# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Smooth vector fields over a detector: displacements that no lens model describes.

A field is a sum of products of Legendre polynomials of both pixel coordinates up to a total
degree, one sum for each pixel axis.  The products are normalised to a mean square of 1 over the
detector, so a coefficient is the RMS displacement of its term in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats


def degrees(total: int) -> NDArray[np.int64]:
    """Return the degrees (t, 2) in u and v of all products up to a total degree, ascending."""
    return np.array([(d - j, j) for d in range(total + 1) for j in range(d + 1)], np.int64)


def basis(pixels: Floats, width: int, height: int, total_degree: int) -> Floats:
    """Return the products (n, t) of `degrees` at pixels (n, 2)."""
    along_u, along_v = _along_axes(np.asarray(pixels, np.float64), width, height, total_degree)
    of_u, of_v = degrees(total_degree).T
    return np.asarray((along_u[of_u] * along_v[of_v]).T)


def _along_axes(pixels: Floats, width: int, height: int, degree: int) -> tuple[Floats, Floats]:
    """Return the polynomials (degree + 1, n) of u and of v at pixels (n, 2)."""
    return (
        legendre((2.0 * pixels[:, 0] + 1.0) / width - 1.0, degree),
        legendre((2.0 * pixels[:, 1] + 1.0) / height - 1.0, degree),
    )


def legendre(x: Floats, degree: int) -> Floats:
    """Return the Legendre polynomials (degree + 1, n) with mean square 1 over [-1, 1]."""
    values = np.empty((degree + 1, len(x)))
    values[0] = 1.0
    if degree > 0:
        values[1] = x
    for n in range(1, degree):  # Bonnet's recursion
        values[n + 1] = ((2 * n + 1) * x * values[n] - n * values[n - 1]) / (n + 1)
    return np.asarray(values * np.sqrt(2.0 * np.arange(degree + 1) + 1.0)[:, None])


@dataclass(frozen=True)
class DetectorField:
    """
    A displacement of every pixel: a star that the lens model places at u is measured at u + f(u).

    ``coefficients`` is (2, t): px, of `degrees` of ``degree``, for u and for v.  The field is a
    function of the measured pixel.
    """

    width: int
    height: int
    degree: int
    coefficients: Floats

    def displacement_px(self, pixels: Floats) -> Floats:
        """Return the displacement (..., 2) at measured pixels (..., 2)."""
        pixels = np.asarray(pixels, np.float64)
        # Beyond the detector polynomials grow without limit; the field at its border stands there.
        inside = np.clip(pixels.reshape(-1, 2), -0.5, [self.width - 0.5, self.height - 0.5])
        along_u, along_v = _along_axes(inside, self.width, self.height, self.degree)
        of_u, of_v = degrees(self.degree).T
        # Summed over v first: the products of both, six times as many numbers, are never formed.
        table = np.zeros((2, self.degree + 1, self.degree + 1))
        table[:, of_u, of_v] = self.coefficients
        sums = [((of_axis @ along_v) * along_u).sum(axis=0) for of_axis in table]
        return np.stack(sums, axis=-1).reshape(pixels.shape)


def in_degree(field: DetectorField, degree: int) -> Floats:
    """Return the coefficients (2 t,), for u then for v, of a field in another degree."""
    count = len(degrees(degree))
    coefficients = np.zeros((2, count))
    shared = min(count, field.coefficients.shape[1])
    coefficients[:, :shared] = field.coefficients[:, :shared]
    return coefficients.ravel()
