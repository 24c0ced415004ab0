# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Displacements of the stars on the detector that no lens model describes.

Each function draws phases and places from a random generator and returns the displacement in
pixels (n, 2) of points ``x`` (n, 2) in half widths from the centre.  A generator in the same state
gives the same lens.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.random import Generator

from starcal_ros.arrays import Floats
from starcal_ros.simulation.departures import unit

_HALF_WIDTH_PX = 648.0
_HALF_HEIGHT = 1024 / 1296  # half widths
_CORNER = math.hypot(1.0, _HALF_HEIGHT)


def ripple(size_px: float, rad_per_half_width: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a product of waves along both axes, each component with its own phases."""
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 2))
    return np.asarray(size_px * np.sin(rad_per_half_width * x[:, None, :] + phase).prod(axis=2))


def rings(size_px: float, rad_per_half_width: float, rng: Generator, x: Floats) -> Floats:
    """Detector with rings about a point, as of the growth of its crystal."""
    centre, phase = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.0, 2.0 * np.pi)
    radius = np.linalg.norm(x - centre, axis=1, keepdims=True)
    wave = np.sin(rad_per_half_width * radius + phase)
    return np.asarray(size_px * wave * (x - centre) / np.maximum(radius, 1e-9))


def rows(size_px: float, period_px: float, rng: Generator, x: Floats) -> Floats:
    """Detector whose rows are displaced along the columns by a wave."""
    phase = rng.uniform(0.0, 2.0 * np.pi)
    wave = 2.0 * np.pi * _HALF_WIDTH_PX / period_px
    return np.asarray(np.array([0.0, size_px]) * np.sin(wave * x[:, [1]] + phase))


def stitch(size_px: float, period_px: float, rng: Generator, x: Floats) -> Floats:
    """Detector of blocks: steps of either sign along each axis at the borders."""
    offset_px = size_px * np.cumsum(rng.choice([-1.0, 1.0], (16, 2)), axis=0)
    offset_px -= offset_px[:5].mean(axis=0)
    block = np.floor((x + np.array([1.0, _HALF_HEIGHT])) * _HALF_WIDTH_PX / period_px)
    block = np.clip(block, 0, 15).astype(int)
    return np.stack([offset_px[block[:, 0], 0], offset_px[block[:, 1], 1]], axis=-1)


def kink(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a radial displacement that begins at a radius and is size_px at the corners."""
    radius, start = np.linalg.norm(x, axis=1, keepdims=True), 0.9
    beyond = np.maximum(radius - start, 0.0) / (_CORNER - start)
    return np.asarray(size_px * beyond * x / np.maximum(radius, start))


def corner_bump(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a Gaussian displacement about a point near one of the corners."""
    centre, width = rng.choice([-1.0, 1.0], 2) * [0.85, 0.65], 0.1
    distance2 = ((x - centre) ** 2).sum(axis=1, keepdims=True)
    return np.asarray(size_px * np.exp(-distance2 / (2 * width**2)) * unit(rng.normal(size=2)))


def tilt(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Detector that is tilted: keystone of size_px at the corner that it leans to."""
    return keystone(size_px, unit(rng.normal(size=2)), x / _CORNER)


def radial8(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a further radial term, ``r^8``, of size_px at the corners."""
    return eighth_order(size_px, x / _CORNER)


def keystone(size_px: float, way: Floats, from_centre: Floats) -> Floats:
    """Displacement by a tilt of points (n, 2), in units of the distance to a corner."""
    return np.asarray(size_px * (from_centre @ way)[:, None] * from_centre)


def eighth_order(size_px: float, from_centre: Floats) -> Floats:
    """Displacement along the radius of points (n, 2), in the same units."""
    return np.asarray(size_px * from_centre * (from_centre**2).sum(axis=1, keepdims=True) ** 4)
