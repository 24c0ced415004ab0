# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Rotations of an image that patterns of its brightest sources suggest, most likely first.

Patterns of four sources are looked up among those of the catalog (`pattern_index`).  Each match
gives a rotation and a focal length, and the bright stars predicted with them are compared with
the sources.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import itertools
import math

import numpy as np
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.identification.blind.pattern_index import (
    brightest_within,
    equal_shapes,
    equivalent,
    pattern_index,
    shapes,
    sphere_points,
)
from starcal_ros.identification.blind.sky_fit import SourceImage
from starcal_ros.sky.catalog import direction_tree, StarCatalog

_KEPT = 32  # number of best candidates of a look-up
_CANDIDATES = 20_000  # tested candidates of a lookup, drawn at random from more
_TESTED = 16  # brightest predictions used to test a candidate
_TABLED = 5000  # most points whose stars are kept in memory: for discs of 9 degrees and more
_NARROW_RAD = math.radians(1.0)  # smaller discs are searched about each candidate itself
_CHUNK = 5000  # candidates tested at once: 30 MB
_MAP_SIDE = 128  # cells of the map of the sources along each side
_NEAR, _FAR = 0.006, 0.02  # 1-sigma of the predictions of a candidate, in half diagonals
_SHOWN = 0.6  # expected share of the bright stars that a true candidate shows
_KNOWN = 0.05  # half range of the focal length from which a field is searched with one
_LEAST_GAIN = 0.8  # smallest gain, over that of the four stars of a pattern alone
_CERTAIN_GAIN = 1.5  # such a gain that few false candidates reach and most true ones do


@dataclass(frozen=True)
class Candidates:
    """
    Patterns of an image that match patterns of the catalog, most likely first.

    ``stars`` and ``sources`` (n, 4) rows of the catalog and of the sources; ``rotation``
    (n, 3, 3) from the catalog to the camera; ``focal_scale`` (n,) focal length over that of the
    prior; ``gain`` (n,) log-likelihood ratio of the sources to that by chance, ``own_gain`` that
    of the four stars of a pattern alone.
    """

    stars: Indices
    sources: Indices
    rotation: Floats
    focal_scale: Floats
    gain: Floats
    own_gain: float

    def in_two(self) -> tuple[Candidates, Candidates]:
        """Candidates that are almost certain, and the others."""
        count = int(np.count_nonzero(self.gain > _CERTAIN_GAIN * self.own_gain))
        return self.rows(slice(count)), self.rows(slice(count, None))

    def rows(self, rows: slice | Indices) -> Candidates:
        """Some of the candidates."""
        return Candidates(
            self.stars[rows],
            self.sources[rows],
            self.rotation[rows],
            self.focal_scale[rows],
            self.gain[rows],
            self.own_gain,
        )


@dataclass(frozen=True)
class View:
    """An image with the focal length of its prior camera scaled."""

    image: SourceImage
    focal_scale: float

    @functools.cached_property
    def directions(self) -> Floats:
        """Lines of sight (n, 3) of the sources."""
        fx, fy = self.focal_scale * self.image.camera.parameters[[0, 2]]
        camera: CameraModel = self.image.camera.replace(fx=float(fx), fy=float(fy))
        return line_of_sight(camera, self.image.xy_px)

    @functools.cached_property
    def plane(self) -> Floats:
        """Tangents (n, 2) of the lines of sight."""
        return np.asarray(self.directions[:, :2] / self.directions[:, 2:])

    @functools.cached_property
    def gain_map(self) -> tuple[Floats, Floats, float]:
        """`_gain_map` of the sources."""
        plane = self.plane[np.isfinite(self.plane[:, 0])]
        return _gain_map(plane, math.tan(self.image.half_diagonal_rad))

    def patterns(self, before: int, sources: int) -> tuple[Indices, Floats]:
        """Patterns (n, 4) of the ``sources`` brightest, one after row ``before``; `shapes`."""
        usable = np.flatnonzero(np.isfinite(self.directions[:sources, 0]))
        every = list(itertools.combinations(usable.tolist(), 4))
        chosen: Indices = np.array(every, np.int64).reshape(-1, 4)
        chosen = chosen[chosen[:, 3] >= before]
        order, shape = shapes(self.directions[chosen])
        return np.take_along_axis(chosen, order, axis=1), shape


def focal_scales(image: SourceImage) -> tuple[float, ...]:
    """Focal lengths to try, over the prior; in a narrow field shapes do not depend on it."""
    if image.half_diagonal_rad < math.radians(12.0) or image.ranges.focal < _KNOWN:
        return (1.0,)
    if image.half_diagonal_rad < math.radians(24.0):
        return (1.0, 0.86, 1.16)
    return (1.0, 0.91, 1.1, 0.83, 1.2)


def _tolerances(image: SourceImage) -> tuple[float, float]:
    """Largest error of the shape of a pattern, and of the logarithm of its size."""
    size = {1: image.ranges.focal + 0.05, 3: 0.16, 5: 0.13}[len(focal_scales(image))]
    return 0.012 + 0.04 * image.half_diagonal_rad, size


def look_up(
    view: View, catalog: StarCatalog, scale: int, patterns: tuple[Indices, Floats]
) -> Candidates:
    """The most likely candidates from `View.patterns` and the index of one scale."""
    index = pattern_index(catalog, scale)
    place_tolerance, size_tolerance = _tolerances(view.image)
    sources, shape = patterns
    fits = shape[:, 4] < math.log(2 * index.radius_rad) + size_tolerance
    sources, shape = equivalent(sources[fits], shape[fits], place_tolerance)
    query, quad = equal_shapes(index.grid, shape, place_tolerance, size_tolerance)
    if len(quad) > _CANDIDATES:
        few = np.random.default_rng(0).choice(len(quad), _CANDIDATES, replace=False)
        quad, query = quad[few], query[few]
    growth = np.exp(shape[query, 4] - index.grid.shape[quad, 4])
    stars, sources = index.quads[index.grid.rows[quad]].astype(np.int64), sources[query]
    rotation = _rotations(catalog.direction_icrs[stars], view.plane[sources], growth)
    gain, own = _gains(view, catalog, growth, rotation) if len(growth) else (growth, 0.0)
    every = Candidates(stars, sources, rotation, view.focal_scale * growth, gain, own)
    best = np.argsort(-gain, kind='stable')[: 4 * _KEPT]
    # Discs share stars, so that the index has some patterns twice and more.
    _, first = np.unique(np.hstack([stars, sources])[best], axis=0, return_index=True)
    best = best[np.sort(first)][:_KEPT]
    return every.rows(best[gain[best] > _LEAST_GAIN * own])


def _rotations(stars: Floats, plane: Floats, growth: Floats) -> Floats:
    """Rotations (n, 3, 3) from directions of stars (n, 4, 3) to tangents (n, 4, 2) over growth."""
    seen = np.empty((len(growth), 4, 3))
    seen[..., :2] = plane / growth[:, None, None]
    seen[..., 2] = 1.0
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    return np.asarray(np.matmul(_triads(seen).transpose(0, 2, 1), _triads(stars)))


def _triads(directions: Floats) -> Floats:
    """Axes (n, 3, 3), in rows, of four directions (n, 4, 3): their middle, and A towards B."""
    middle = directions.sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # C and D enter through the middle.
    towards = directions[:, 1] - directions[:, 0]
    side = np.cross(middle, towards)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    return np.stack([middle, np.cross(side, middle), side], axis=1)


def _gains(
    view: View, catalog: StarCatalog, growth: Floats, rotation: Floats
) -> tuple[Floats, float]:
    """``gain`` (n,) and ``own_gain`` of rotations (n, 3, 3) with focal lengths ``growth`` (n,)."""
    half = math.tan(view.image.half_diagonal_rad)
    gain_map, low, cell = view.gain_map
    (rows, columns), flat = gain_map.shape, gain_map.ravel()
    gains = np.empty(len(rotation))
    for first in range(0, len(rotation), _CHUNK):
        part = slice(first, first + _CHUNK)
        stars = _bright_about(catalog, rotation[part, 2], 1.1 * math.atan(half), 3 * _TESTED)
        place = np.matmul(catalog.direction_icrs[stars], rotation[part].transpose(0, 2, 1))
        ahead = (stars >= 0) & (place[..., 2] > 0.1)
        scale = growth[part, None] / np.where(ahead, place[..., 2], 1.0) / cell
        column, row = (np.floor(place[..., k] * scale - low[k] / cell) for k in (0, 1))
        inside = ahead & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        at = np.where(inside, row * columns + column, 0.0).astype(np.int64)
        inside &= np.cumsum(inside, axis=1, dtype=np.int32) <= _TESTED
        value = flat[at]
        # An image of few stars shows only the brightest: take the best depth.
        gains[part] = np.cumsum(value * inside, axis=1).max(axis=1)
    return gains, 4.0 * float(gain_map.max())


def _gain_map(plane: Floats, half: float) -> tuple[Floats, Floats, float]:
    """Log-likelihood ratio of a star predicted in each cell of the image plane."""
    low, high = plane.min(axis=0), plane.max(axis=0)
    cell = float((high - low).max()) / _MAP_SIDE
    shape = np.ceil((high - low) / cell).astype(np.int64) + 1
    u, v = np.meshgrid(*(low[k] + cell * (np.arange(shape[k]) + 0.5) for k in (0, 1)))
    apart, _ = cKDTree(plane).query(np.stack([u.ravel(), v.ravel()], axis=-1))
    area = float(np.prod(high - low)) / len(plane)
    density = sum(
        0.5 * np.exp(-0.5 * (apart / (s * half)) ** 2) / (2 * math.pi * (s * half) ** 2)
        for s in (_NEAR, _FAR)
    )
    gain = np.log((1.0 - _SHOWN) + _SHOWN * area * density)
    return gain.reshape(u.shape), low, cell


@functools.lru_cache(maxsize=8)
def _bright_stars(catalog: StarCatalog, radius_deg: int) -> tuple[cKDTree, cKDTree]:
    """Search trees of points all over the sky and of the stars that discs of a radius need."""
    radius_rad = math.radians(radius_deg)
    points = sphere_points(int(4 * math.pi / (0.3 * radius_rad) ** 2))
    # The emptiest discs hold half of the mean number, which is still most of the stars tested.
    enough = int(5 * _TESTED * 2.0 / (1.0 - math.cos(radius_rad)))
    stars = catalog.direction_icrs[:enough]
    return direction_tree(points), direction_tree(stars)


def _bright_about(catalog: StarCatalog, axes: Floats, radius_rad: float, count: int) -> Indices:
    """Rows (n, count) of the brightest stars within about a radius of axes (n, 3); -1 if fewer."""
    if radius_rad < _NARROW_RAD:  # few candidates: their patterns hold the sizes of others
        return brightest_within(catalog.tree, axes, radius_rad, count)
    points, stars = _bright_stars(catalog, max(1, math.ceil(math.degrees(radius_rad))))
    point = points.query(axes)[1]
    if points.n <= _TABLED:
        return np.asarray(_bright_everywhere(catalog, radius_rad, count)[point])
    point, place = np.unique(point, return_inverse=True)
    found = brightest_within(stars, points.data[point], _widened(radius_rad), count)
    return np.asarray(found[place.ravel()])


@functools.lru_cache(maxsize=8)
def _bright_everywhere(catalog: StarCatalog, radius_rad: float, count: int) -> Indices:
    """Rows (p, count) of `_bright_about` for all points of `_bright_stars`."""
    points, stars = _bright_stars(catalog, max(1, math.ceil(math.degrees(radius_rad))))
    return brightest_within(stars, points.data, _widened(radius_rad), count)


def _widened(radius_rad: float) -> float:
    """Radius about the nearest point that holds the disc about an axis."""
    return min(1.25 * radius_rad, math.pi)
