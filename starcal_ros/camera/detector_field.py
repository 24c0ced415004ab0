# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Smooth vector fields over a detector: displacements that no lens model describes.

A field is a sum of functions of the pixel, one sum for each pixel axis.  The functions are
products of cosines over a domain a third longer than the detector, ordered by wavelength.  An
octave has wavelengths from its longest to half of that; the first also has everything longer than
the detector.  A field is as rough at the border as in the middle.

All functions have a mean square near 1, so a coefficient is about the RMS displacement of its
term in pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import math

import numpy as np

from starcal_ros.arrays import Floats, Indices, Integers
from starcal_ros.record_fields import Record

# Domain of the cosines in detector sides: a field need not be flat at the border.
COSINE_DOMAIN = 1.35


@functools.lru_cache(maxsize=16)
def cosine_terms(width: int, height: int, octaves: int) -> tuple[Integers, Indices]:
    """Half waves (t, 2) of the cosines along u and v, and the octave (t,) of each, ascending."""
    most = math.ceil(COSINE_DOMAIN * 2.0**octaves * max(1.0, height / width)) + 1
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(most), np.arange(most), indexing='ij'))
    # Wave number over that of one wave along the width.
    number = 0.5 / COSINE_DOMAIN * np.hypot(i, j * width / height)
    octave = np.maximum(np.ceil(np.log2(np.maximum(number, 1e-9))), 0.0).astype(np.int64)
    used = np.flatnonzero((octave < octaves) & (i + j > 0))
    order = used[np.lexsort((number[used], octave[used]))]
    terms = np.stack([i[order], j[order]], axis=1)
    octave_of_term = octave[order]
    terms.setflags(write=False)
    octave_of_term.setflags(write=False)
    return terms, octave_of_term


def basis(pixels: Floats, width: int, height: int, octaves: int) -> Floats:
    """Return the functions (n, t) of a field at pixels (n, 2)."""
    pixels = np.asarray(pixels, np.float64)
    terms, _ = cosine_terms(width, height, octaves)
    return _values(_waves(pixels, (width, height), terms.max(axis=0)), terms).T


def _values(along: list[Floats], terms: Integers) -> Floats:
    """Return the functions (t, n) of their waves; the lower ones of these are scaled in place."""
    most = terms.max(axis=0) + 1
    for waves, count in zip(along, most, strict=True):
        waves[1:count] *= math.sqrt(2.0)
    values = np.empty((len(terms), along[0].shape[1]))
    for (i, j), row in zip(terms.tolist(), values, strict=True):
        np.multiply(along[0][i], along[1][j], out=row)
    return values


def basis_and_products(
    pixels: Floats, weights: Floats, width: int, height: int, octaves: int
) -> tuple[Floats, Floats]:
    """
    Return `basis` at pixels (n, 2) as phi (t, n), and ``phi diag(w) phi'`` (k, t, t).

    For each row w of the weights (k, n).  A product of cosines is half of those of the sum and the
    difference of their angles, so that few sums over the pixels give all: a twelfth of the time.
    """
    terms, _ = cosine_terms(width, height, octaves)
    along = _waves(pixels, (width, height), 2 * terms.max(axis=0))
    first, second, places, size = _pairs(width, height, octaves)
    products = np.empty((len(weights), len(terms), len(terms)))
    for row, product in zip(weights, products, strict=True):
        table = ((along[0] * row) @ along[1].T).ravel()
        values = size * sum(table.take(place) for place in places)
        product[first, second] = product[second, first] = values
    return _values(along, terms), products


@functools.lru_cache(maxsize=16)
def _pairs(width: int, height: int, octaves: int) -> tuple[Indices, Indices, Indices, Floats]:
    """
    Pairs of functions (p,), (p,), and the size (p,) of their products.

    Also the places (4, p) of the sums and differences of their half waves in a table of twice the
    most half waves along u and v.
    """
    terms, _ = cosine_terms(width, height, octaves)
    first, second = np.tril_indices(len(terms))
    (i, j), most = terms.T, 2 * int(terms[:, 1].max()) + 1
    by_u = i[first] + i[second], np.abs(i[first] - i[second])
    by_v = j[first] + j[second], np.abs(j[first] - j[second])
    places = np.stack([u * most + v for u in by_u for v in by_v])
    return first, second, places, 0.25 * (_sizes(terms)[first] * _sizes(terms)[second])


def _waves(pixels: Floats, sizes: tuple[int, int], most: Indices) -> list[Floats]:
    """Return the cosines (k, n) of 0 to at least ``most`` (2,) half waves along u and along v."""
    along: list[Floats] = []
    for axis, size in enumerate(sizes):
        x = ((pixels[:, axis] + 0.5) / size - 0.5) / COSINE_DOMAIN + 0.5
        waves = np.empty((max(int(most[axis]) + 1, 2), len(x)))
        waves[0] = 1.0
        np.cos(np.pi * x, out=waves[1])
        twice = 2.0 * waves[1]
        for k in range(2, len(waves)):  # Chebyshev's recursion: a tenth of the time of cosines
            np.multiply(twice, waves[k - 1], out=waves[k])
            waves[k] -= waves[k - 2]
        along.append(waves)
    return along


def _sizes(terms: Integers) -> Floats:
    """Return the largest values (t,) of the functions."""
    return np.asarray(np.where(terms > 0, math.sqrt(2.0), 1.0).prod(axis=1))


def term_count(width: int, height: int, octaves: int) -> int:
    """Return the number of functions of `basis`."""
    return len(cosine_terms(width, height, octaves)[0])


@dataclass(frozen=True, eq=False, repr=False)
class DetectorField(Record):
    """
    A displacement of every pixel: a star that the lens model places at u is measured at u + f(u).

    ``coefficients`` is (2, t): px, of the functions of `basis` to ``octaves``, for u and for v.
    The field is a function of the measured pixel.

    >>> import numpy as np
    >>> octaves, shift = 1, np.zeros((2, term_count(1024, 768, 1)))
    >>> shift[0, 0] = 0.1  # px, half a wave along u
    >>> field = DetectorField(1024, 768, octaves, shift)
    >>> field.displacement_px([[0, 0], [1023, 0]]).round(2).tolist()
    [[0.13, 0.0], [-0.13, 0.0]]
    """

    width: int
    height: int
    octaves: int
    coefficients: Floats

    def displacement_px(self, pixels: Floats) -> Floats:
        """Return the displacement (..., 2) at measured pixels (..., 2)."""
        pixels = np.asarray(pixels, np.float64)
        # Beyond the detector the stars show nothing: the value at its border is used.
        inside = np.clip(pixels.reshape(-1, 2), -0.5, [self.width - 0.5, self.height - 0.5])
        parts = [self._at(inside[k : k + _CHUNK]) for k in range(0, max(len(inside), 1), _CHUNK)]
        return np.concatenate(parts).reshape(pixels.shape)

    def _at(self, pixels: Floats) -> Floats:
        """Return the displacement (n, 2), summed along v before u: a third of the time."""
        terms = self.orders
        along_u, along_v = _waves(pixels, (self.width, self.height), terms.max(axis=0))
        table = np.zeros((2, len(along_u), len(along_v)))
        table[:, terms[:, 0], terms[:, 1]] = self.coefficients * _sizes(terms)
        return np.asarray((table @ along_v * along_u).sum(axis=1).T)

    @property
    def orders(self) -> Integers:
        """Half waves (t, 2) of the functions along u and v."""
        return cosine_terms(self.width, self.height, self.octaves)[0]

    def basis(self, pixels: Floats) -> Floats:
        """Return the functions (n, t) of the field at pixels (n, 2)."""
        return basis(pixels, self.width, self.height, self.octaves)


_CHUNK = 8192  # pixels at a time: their functions are a hundred times as many numbers
