# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Records of the field over the detector in addition to the lens model, and of its covariance.

Files and messages hold the covariance of lines of sight as a factor and a remainder.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.camera.detector_field import DetectorField, term_count
from starcal_ros.record_fields import Finite, Record, Shape, Within

_DIGITS = 9  # parameters and field cancel to a thousandth and less in the factor
# Steps of a coefficient's own 1-sigma: the sigma of any line of sight holds to 6e-4.
_STEPS = 5000
# Smallest eigenvalue of a scaled covariance, over the largest, that is more than rounding: at
# 1e-12 the sigma of lines of sight of a rational polynomial was up to 9 % too small.
NO_VARIANCE = 1e-15


@dataclass(frozen=True, eq=False, repr=False)
class MapCovariance(Record):
    """
    Covariance of all that moves a line of sight.

    ``matrix`` is (k, k), of the numbers of `Derivatives.of_shape`; ``unresolved_px`` the
    1-sigma per axis of an independent displacement of each pixel, by structure of the detector
    finer than the field.

    >>> import starcal_ros
    >>> calibration = starcal_ros.read_calibration('out')
    >>> camera_and_alignment = calibration.map_covariance.matrix[:13, :13]
    >>> bool(abs(camera_and_alignment / calibration.covariance - 1).max() < 1e-3)
    True
    """

    matrix: Floats
    unresolved_px: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class ResidualField(Record):
    """
    Field over the detector in addition to the lens model.

    With coefficients of zero none was found; its covariance is that of the fields that the stars
    do not rule out.  ``covariance`` is ``F F'``, plus ``R R'`` in the rows of the coefficients,
    where F is the factor and R the lower triangle with the rows ``remainder_unit_px * remainder``.
    Every sigma of a line of sight holds to 1e-3.

    Raises ValueError when remainder and units do not fit.

    Attributes
    ----------
    octaves : int
        Of its cosines; `detector_field.basis` has them.
    coefficients : (2, t)
        px, for u and for v; a star that the lens model places at u is measured at u + f(u).
    unresolved_px : float
        1-sigma per axis of structure finer than the field.
    covariance_factor : (p + 2 t, r)
        F, of the parameters of the calibration and the coefficients of u, then of v.
    remainder_unit_px : (2 t,)
    remainder : (t (2 t + 1),) int16
        Rows of the triangle, one after the other: the coefficients, the parameters known.

    Examples
    --------
    >>> import starcal_ros
    >>> field = starcal_ros.read_calibration('out').field
    >>> terms = field.coefficients.shape[1]
    >>> field.covariance.shape == (13 + 2 * terms, 13 + 2 * terms)
    True
    """

    octaves: Annotated[int, Within(1, 8)]
    coefficients: Annotated[Floats, Finite(), Shape((2, 'terms'))]
    unresolved_px: Annotated[float, Finite()]
    covariance_factor: Annotated[Floats, Finite(), Shape(('factor_rows', 'factor_cols'))]
    remainder_unit_px: Annotated[Floats, Finite(), Shape(('c',))]
    remainder: Annotated[NDArray[np.int16], Shape(('n',))]

    def __post_init__(self) -> None:
        """Check the size of the remainder."""
        count, all_of_them = len(self.remainder_unit_px), self.coefficients.size
        in_triangle = count * (count + 1) // 2
        if len(self.remainder) != in_triangle:
            raise ValueError(f'remainder: {len(self.remainder)} numbers, not {in_triangle}')
        if count not in (0, all_of_them) or count > len(self.covariance_factor):
            raise ValueError(f'remainder_unit_px: {count} numbers, not {all_of_them}')

    @property
    def rows(self) -> int:
        """Number of rows of the covariance."""
        return len(self.covariance_factor)

    @functools.cached_property
    def covariance(self) -> Floats:
        """(p + 2 t, p + 2 t): of the parameters of the calibration and the coefficients."""
        F = self.covariance_factor
        covariance: Floats = F @ F.T
        count = len(self.remainder_unit_px)
        triangle = np.zeros((count, count))
        triangle[np.tril_indices(count)] = self.remainder
        triangle *= self.remainder_unit_px[:, None]
        first = len(F) - count
        covariance[first:, first:] += triangle @ triangle.T
        return covariance

    def on(self, width: int, height: int) -> DetectorField:
        """Return the field on a detector; raises ValueError for a wrong number of terms."""
        given = self.coefficients.shape[1]
        expected = term_count(width, height, self.octaves)
        if given != expected:
            raise ValueError(f'field.coefficients: {given} for an axis, not {expected}')
        return DetectorField(width, height, self.octaves, self.coefficients)


def factored_field(of: DetectorField, covariance: MapCovariance) -> ResidualField:
    """
    Return the record of a field with the covariance of lines of sight as factor and remainder.

    The factor has the parameters exactly, and the field as it follows them.  The remainder, that
    of the field with the parameters known, displaces pixels with little cancellation: steps of
    a `_STEPS`-th of the sigma of each coefficient are enough.
    """
    count, matrix = of.coefficients.size, covariance.matrix
    p = len(matrix) - count
    known = np.sqrt(np.diag(matrix)[:p])
    scale = np.where(known > 0, known, 1.0)
    values, vectors = np.linalg.eigh(matrix[:p, :p] / np.outer(scale, scale))
    used = values > NO_VARIANCE * values.max()
    vectors, root = vectors[:, used], np.sqrt(values[used])
    factor = np.concatenate(
        [known[:, None] * vectors * root, matrix[p:, :p] / scale @ vectors / root]
    )
    factor = _to_digits(factor, _DIGITS)
    remaining = matrix[p:, p:] - factor[p:] @ factor[p:].T
    unit_px = _to_digits(np.sqrt(np.diag(remaining).clip(0.0)) / _STEPS, 4)
    steps = np.where(unit_px > 0, unit_px, np.inf)
    values, vectors = np.linalg.eigh(remaining / np.outer(steps, steps))
    # The triangle of the QR decomposition of a root exists for deficient rank too.
    _, upper = np.linalg.qr((vectors * np.sqrt(values.clip(0.0))).T)
    return ResidualField(
        octaves=of.octaves,
        coefficients=of.coefficients,
        unresolved_px=covariance.unresolved_px,
        covariance_factor=factor,
        remainder_unit_px=unit_px,
        remainder=np.rint(upper.T[np.tril_indices(count)]).astype(np.int16),
    )


def _to_digits(values: Floats, digits: int) -> Floats:
    """Return numbers rounded to so many significant digits: texts of them are as short."""
    rounded = [float(f'{value:.{digits - 1}e}') for value in values.ravel().tolist()]
    return np.array(rounded, np.float64).reshape(values.shape)
