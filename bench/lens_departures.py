# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Displacements of the stars on the detector that no lens model describes.

Each function returns a `Lens`: given a random generator, it draws phases and places and returns
the displacement in pixels (n, 2) as a function of points (n, 2) in half widths from the centre.
"""

from __future__ import annotations

from collections.abc import Callable
import math

import numpy as np
from numpy.random import Generator

from starcal_ros.arrays import Floats

Field = Callable[[Floats], Floats]
Lens = Callable[[Generator], Field]

_HALF_WIDTH_PX = 648.0
_HALF_HEIGHT = 1024 / 1296  # half widths
_CORNER = math.hypot(1.0, _HALF_HEIGHT)


def unit(vector: Floats) -> Floats:
    """Return vectors (..., d) scaled to unit length."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def no_departure(rng: Generator) -> Field:
    """Lens that the model describes."""
    return np.zeros_like


def ripple(size_px: float, rad_per_half_width: float) -> Lens:
    """Lens with a product of waves along both axes, each component with its own phases."""

    def draw(rng: Generator) -> Field:
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, 2))
        return lambda x: np.asarray(
            size_px * np.sin(rad_per_half_width * x[:, None, :] + phase).prod(axis=2)
        )

    return draw


def rings(size_px: float, rad_per_half_width: float) -> Lens:
    """Detector with rings about a point, as of the growth of its crystal."""

    def draw(rng: Generator) -> Field:
        centre, phase = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.0, 2.0 * np.pi)

        def field(x: Floats) -> Floats:
            radius = np.linalg.norm(x - centre, axis=1, keepdims=True)
            wave = np.sin(rad_per_half_width * radius + phase)
            return np.asarray(size_px * wave * (x - centre) / np.maximum(radius, 1e-9))

        return field

    return draw


def rows(size_px: float, period_px: float) -> Lens:
    """Detector whose rows are displaced along the columns by a wave."""

    def draw(rng: Generator) -> Field:
        phase = rng.uniform(0.0, 2.0 * np.pi)
        wave = 2.0 * np.pi * _HALF_WIDTH_PX / period_px
        return lambda x: np.stack(
            [np.zeros(len(x)), size_px * np.sin(wave * x[:, 1] + phase)], axis=-1
        )

    return draw


def stitch(size_px: float, period_px: float) -> Lens:
    """Detector of blocks: steps of either sign along each axis at the borders."""

    def draw(rng: Generator) -> Field:
        offset_px = size_px * np.cumsum(rng.choice([-1.0, 1.0], (16, 2)), axis=0)
        offset_px -= offset_px[:5].mean(axis=0)

        def field(x: Floats) -> Floats:
            block = np.floor((x + np.array([1.0, _HALF_HEIGHT])) * _HALF_WIDTH_PX / period_px)
            block = np.clip(block, 0, 15).astype(int)
            return np.stack([offset_px[block[:, 0], 0], offset_px[block[:, 1], 1]], axis=-1)

        return field

    return draw


def kink(size_px: float, start: float = 0.9) -> Lens:
    """Lens with a radial displacement that begins at a radius and is size_px at the corners."""

    def field(x: Floats) -> Floats:
        radius = np.linalg.norm(x, axis=1, keepdims=True)
        beyond = np.maximum(radius - start, 0.0) / (_CORNER - start)
        return np.asarray(size_px * beyond * x / np.maximum(radius, start))

    return lambda rng: field


def corner_bump(size_px: float, width: float = 0.1) -> Lens:
    """Lens with a Gaussian displacement about a point near one of the corners."""

    def draw(rng: Generator) -> Field:
        centre = rng.choice([-1.0, 1.0], 2) * [0.85, 0.65]
        way = unit(rng.normal(size=2))
        return lambda x: np.asarray(
            size_px
            * np.exp(-((x - centre) ** 2).sum(axis=1, keepdims=True) / (2 * width**2))
            * way
        )

    return draw


def tilt(size_px: float) -> Lens:
    """Detector that is tilted: keystone of size_px at the corner that it leans to."""

    def draw(rng: Generator) -> Field:
        way = unit(rng.normal(size=2))
        return lambda x: np.asarray(size_px * (x @ way)[:, None] * x / _CORNER**2)

    return draw


def radial8(size_px: float) -> Lens:
    """Lens with a further radial term, ``r^8``, of size_px at the corners."""
    return lambda rng: (
        lambda x: np.asarray(
            size_px * x / _CORNER * (np.linalg.norm(x, axis=1, keepdims=True) / _CORNER) ** 8
        )
    )
