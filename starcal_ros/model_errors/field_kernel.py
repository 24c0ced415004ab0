# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Prior covariance of a smooth field over a detector, in the polynomials of `detector_field`.

Each component of the field is a Gaussian process with a squared-exponential kernel of length l, a
part of it shorter (Rasmussen & Williams 2006, ch. 4 and 5).  A component may have a dominant wave:
98 % of its kernel are then the product of one with a long envelope and ``cos(k_u du) cos(k_v dv)``
(a spectral mixture, Wilson & Adams 2013).
"""

from __future__ import annotations

from dataclasses import dataclass
import functools

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.detector_field import degrees, legendre

TEST_DEGREE = 10
_MAX_DEGREE = 18
# Polynomials of degree 4.2 / length hold all but 1e-4 of the variance of a kernel.
_DEGREE_TIMES_LENGTH = 4.2
_BEYOND_WAVE = 9.0  # degrees beyond the wave number that hold all but 1e-4 of a wave
# Lens errors grow towards the corners: a part of the variance has half and a third of the length,
# as a rational-quadratic kernel has.  Without it the corners of an 8th-order term of 3 px were 2.6
# sigma off.
_SCALES = ((1.0, 0.9), (0.5, 0.09), (0.33, 0.01))
_SHARE_OF_WAVE = 0.98  # of the variance of a component that has a wave
_LEAST_SHARE = 1e-8  # of the variance of a field, under which a mode is left out


@dataclass(frozen=True)
class Wave:
    """Wave numbers along u and v, rad per half length of the longer side, and envelope length."""

    along_u: float
    along_v: float
    envelope: float


Waves = tuple[Wave | None, Wave | None]
"""Dominant wave of the u and of the v component."""
NO_WAVES: Waves = (None, None)


def degree_for(length: float, waves: Waves) -> int:
    """Return the degree of the polynomials that hold a field of this length and these waves."""
    needed = _DEGREE_TIMES_LENGTH / (_SCALES[-1][0] * length)
    for wave in waves:
        if wave is not None:
            needed = max(needed, wave.along_u + _BEYOND_WAVE, wave.along_v + _BEYOND_WAVE)
    return min(_MAX_DEGREE, max(TEST_DEGREE, int(np.ceil(needed))))


def covariance(
    width: int, height: int, degree: int, length: float, wave: Wave | None = None
) -> Floats:
    """
    Return the covariance (t, t) of the coefficients of one component of unit amplitude.

    ``length`` is that of the kernel, in half lengths of the longer side of the detector.
    """
    smooth = _smooth(width, height, degree, length)
    if wave is None:
        return smooth
    u = _along(width / max(width, height), degree, wave.envelope, wave.along_u)
    v = _along(height / max(width, height), degree, wave.envelope, wave.along_v)
    return _SHARE_OF_WAVE * _both(u, v, degree) + (1.0 - _SHARE_OF_WAVE) * smooth


@functools.lru_cache(maxsize=32)
def root(width: int, height: int, degree: int, length: float, wave: Wave | None = None) -> Floats:
    """Return L (t, r) with ``L L' = W``, the result of `covariance`."""
    values, vectors = np.linalg.eigh(covariance(width, height, degree, length, wave))
    large = values > _LEAST_SHARE * values.sum()
    found = vectors[:, large] * np.sqrt(values[large])
    found.setflags(write=False)
    return np.asarray(found)


@functools.lru_cache(maxsize=32)
def _smooth(width: int, height: int, degree: int, length: float) -> Floats:
    """Return the covariance (t, t) without a wave."""
    longer = max(width, height)
    summed = sum(
        share
        * _both(
            _along(width / longer, degree, part * length),
            _along(height / longer, degree, part * length),
            degree,
        )
        for part, share in _SCALES
    )
    found: Floats = np.asarray(summed)
    found.setflags(write=False)
    return found


def _along(side: float, degree: int, length: float, wave_number: float = 0.0) -> Floats:
    """Return the covariance (degree + 1, degree + 1) along an axis, ``side`` of the longer one."""
    nodes, weighted = _quadrature(degree)
    apart = (nodes[:, None] - nodes[None, :]) * side
    kernel = np.exp(-0.5 * (apart / length) ** 2) * np.cos(wave_number * apart)
    return np.asarray(weighted @ kernel @ weighted.T)


def _both(u: Floats, v: Floats, degree: int) -> Floats:
    """Return the covariance (t, t) of the products from those along the axes."""
    of_u, of_v = degrees(degree).T
    return np.asarray(u[np.ix_(of_u, of_u)] * v[np.ix_(of_v, of_v)])


@functools.cache
def _quadrature(degree: int) -> tuple[Floats, Floats]:
    """Nodes (64,) of Gauss and Legendre, and the polynomials (degree + 1, 64) times weights."""
    nodes, weights = np.polynomial.legendre.leggauss(64)
    return nodes, legendre(nodes, degree) * (0.5 * weights)
