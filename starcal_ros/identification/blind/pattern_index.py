# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Index of patterns of four catalog stars by their shape, which is free of scale and rotation.

The shape of a pattern is that of Lang et al. 2010, AJ 139, 1782, section 2.1: in the tangent plane
at its middle, the two stars farthest apart, A and B, span a frame with A at 0 and B at 1 + i; the
positions of the other two, C and D, in it are four numbers.  The fifth number is the distance of A
and B, which a camera measures as accurately as its focal length.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Indices, Singles
from starcal_ros.sky.catalog import StarCatalog

_STEP = math.sqrt(2.0)
_STANDARD_DEG = 1.6  # radius of the discs of scale 0
_SMALLEST, _LARGEST = -10, 9  # scales: discs of 0.05 to 36 degrees of radius
# Distance of disc centres in disc radii: adjacent discs share two thirds of their area.
_SPACING = 0.7
# Stars per disc from scale 0 on, 7 below: at most about a million patterns.
_STARS = (7, 8, 9, 10, 11, 12, 13, 14, 14, 14)
_DEPTH = 3.0  # stars indexed over the number needed for a sky of even density
# Orders of A, B, C, D in which noise may show a canonical pattern.
_ORDERS = np.array([[0, 1, 2, 3], [0, 1, 3, 2], [1, 0, 2, 3], [1, 0, 3, 2]])
_PAIRS = np.array(list(itertools.combinations(range(4), 2)))
_OTHERS = np.array([[k for k in range(4) if k not in pair] for pair in _PAIRS])
_AT_ONCE = 30_000  # patterns
_CELL = 0.04  # about twice the tolerance: two cells along each place, and a table of a few MB


@dataclass(frozen=True)
class PatternIndex:
    """
    Patterns within discs of one size wherever the catalog has stars enough.

    ``quads`` (q, 4) rows of the catalog in the order A, B, C, D, sorted as ``grid`` has their
    shapes (`shapes`); ``radius_rad`` radius of the discs.
    """

    radius_rad: float
    quads: Indices
    grid: ShapeGrid


def scales_for(half_diagonal_rad: float) -> list[int]:
    """Numbers of the scales whose discs are half to a whole field wide, smallest first."""
    scales = range(_SMALLEST, _LARGEST + 1)
    fitting = [k for k in scales if 0.48 <= _radius_rad(k) / half_diagonal_rad < 0.97]
    return fitting or [_SMALLEST if half_diagonal_rad < _radius_rad(0) else _LARGEST]


def _radius_rad(scale: int) -> float:
    """Radius of the discs of a scale."""
    return math.radians(_STANDARD_DEG * _STEP**scale)


@functools.lru_cache(maxsize=10)
def pattern_index(catalog: StarCatalog, scale: int) -> PatternIndex:
    """
    Index of the patterns of the brightest stars of each disc of a scale.

    It takes about a second and is kept in memory.  The catalog is sorted by magnitude.
    """
    radius_rad = _radius_rad(scale)
    of_disc = _STARS[max(scale, 0)]
    sky_by_disc = 2.0 / (1.0 - math.cos(radius_rad))
    stars = catalog.direction_icrs[: int(_DEPTH * of_disc * sky_by_disc)]
    if scale >= 0:
        centres = sphere_points(int(4 * math.pi / (_SPACING * radius_rad) ** 2))
    else:
        centres = _occupied(stars, _SPACING * radius_rad)
    tree = cKDTree(stars)
    # Outside the region of a deep table nearly all discs are without a pattern.
    chord = 2 * math.sin(radius_rad / 2)
    held = tree.query_ball_point(centres, chord, return_length=True)
    members = brightest_within(tree, centres[held >= 4], radius_rad, of_disc)
    chosen = np.array(list(itertools.combinations(range(of_disc), 4)))
    # Rows ascend within a disc, and -1 fills up one with fewer stars.
    quads: Indices = members[:, chosen].reshape(-1, 4)
    quads = quads[quads[:, 3] >= 0]
    first, second = quads[:, 0] << 32 | quads[:, 1], quads[:, 2] << 32 | quads[:, 3]
    by_pattern = np.lexsort([second, first])
    first, second = first[by_pattern], second[by_pattern]
    differs = (np.diff(first, prepend=-1) != 0) | (np.diff(second, prepend=-1) != 0)
    quads = quads[by_pattern[differs]]
    order, shape = _in_parts(stars, quads)
    rows, grid = shape_grid(shape)
    return PatternIndex(radius_rad, np.take_along_axis(quads, order, axis=1)[rows], grid)


def _in_parts(stars: Floats, quads: Indices) -> tuple[Indices, Floats]:
    """`shapes` of rows (n, 4) of stars; the arrays of all at once would not fit into a cache."""
    parts = np.array_split(quads, len(quads) // _AT_ONCE + 1)
    orders, found = zip(*(shapes(stars[part]) for part in parts), strict=True)
    return np.concatenate(orders), np.concatenate(found)


def _occupied(stars: Floats, side_rad: float) -> Floats:
    """Middles (p, 3) of the cells of about this side that hold some of the stars (n, 3)."""
    band = np.floor(np.arcsin(np.clip(stars[:, 2], -1.0, 1.0)) / side_rad)
    around = np.maximum(np.floor(2 * math.pi * np.cos((band + 0.5) * side_rad) / side_rad), 1.0)
    turn = np.arctan2(stars[:, 1], stars[:, 0]) / (2 * math.pi) % 1.0
    cell = band.astype(np.int64) << 32 | np.floor(turn * around).astype(np.int64)
    _, first = np.unique(cell, return_index=True)
    dec = (band[first] + 0.5) * side_rad
    ra = (np.floor(turn * around)[first] + 0.5) / around[first] * (2 * math.pi)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)


def shapes(directions: Floats) -> tuple[Indices, Floats]:
    """
    Shapes of patterns of four directions (n, 4, 3).

    Returns
    -------
    order : (n, 4)
        Indices of A, B, C and D: the mean of C and D along A to B is below one half, and C is
        nearer to A along it.
    shape : (n, 5)
        Positions of C and D in the frame of A and B, and the natural logarithm of the distance of
        A and B, rad.
    """
    points = _tangent_points(directions)
    length2 = np.abs(points[:, _PAIRS[:, 0]] - points[:, _PAIRS[:, 1]]) ** 2
    longest = length2.argmax(axis=1)
    order = np.concatenate([_PAIRS[longest], _OTHERS[longest]], axis=1)
    a, b, c, d = np.take_along_axis(points, order, axis=1).T
    with np.errstate(invalid='ignore', divide='ignore'):
        c, d = (c - a) / (b - a), (d - a) / (b - a)
    swap = c.real + d.real > 1.0
    order[swap] = order[swap][:, [1, 0, 2, 3]]
    c, d = np.where(swap, 1.0 - c, c), np.where(swap, 1.0 - d, d)
    later = c.real > d.real
    order[later] = order[later][:, [0, 1, 3, 2]]
    c, d = np.where(later, d, c), np.where(later, c, d)
    size = 0.5 * np.log(np.maximum(length2[np.arange(len(longest)), longest], 1e-30))
    return order, np.stack([c.real, c.imag, d.real, d.imag, size], axis=-1)


def equivalent(order: Indices, shape: Floats, tolerance: float) -> tuple[Indices, Floats]:
    """
    The patterns (n, 4), (n, 5) in each order in which the catalog may have them: (m, 4), (m, 5).

    An error of a place up to the tolerance may move a pattern across the border between two of
    the four orders.
    """
    c = shape[:, 0] + 1j * shape[:, 1]
    d = shape[:, 2] + 1j * shape[:, 3]
    places = ((c, d), (d, c), (1.0 - c, 1.0 - d), (1.0 - d, 1.0 - c))
    all_orders = np.concatenate([order[:, k] for k in _ORDERS])
    found = np.concatenate(
        [np.stack([p.real, p.imag, q.real, q.imag, shape[:, 4]], axis=-1) for p, q in places]
    )
    c_real, d_real = found[:, 0], found[:, 2]
    near = (c_real <= d_real + 2 * tolerance) & (c_real + d_real <= 1.0 + 2 * tolerance)
    return all_orders[near], found[near]


def _tangent_points(directions: Floats) -> NDArray[np.complex128]:
    """Complex positions (n, 4) in the tangent plane at the mean of four directions (n, 4, 3)."""
    middle = directions.mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # Any two perpendicular axes: a shape does not depend on their rotation.
    least = np.abs(middle).argmin(axis=1)
    x = np.cross(middle, np.eye(3)[least])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(middle, x)
    along = np.einsum('nki,ni->nk', directions, middle)
    real = np.einsum('nki,ni->nk', directions, x) / along
    imaginary = np.einsum('nki,ni->nk', directions, y) / along
    return np.asarray(real + 1j * imaginary)


def sphere_points(count: int) -> Floats:
    """Unit vectors (count, 3) at even distances over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    longitude = k * math.pi * (3.0 - math.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(longitude), r * np.sin(longitude), z], axis=-1)


def brightest_within(stars: cKDTree, centres: Floats, radius_rad: float, count: int) -> Indices:
    """Rows (p, count) of the brightest of sorted stars about centres (p, 3); -1: none."""
    found = stars.query_ball_point(centres, 2 * math.sin(radius_rad / 2), return_sorted=True)
    rows = np.full((len(centres), count), -1, np.int64)
    for k, inside in enumerate(found):
        few = inside[:count]
        rows[k, : len(few)] = few
    return rows


@dataclass(frozen=True)
class ShapeGrid:
    """
    Shapes (q, 5) sorted by cell.

    ``low`` (4,) and ``cells`` (4,): corner and number of the cells along each place; ``first``
    (m + 1,): row of the first shape of each of the m cells, the last place counting fastest.
    """

    shape: Singles
    low: Floats
    cells: Indices
    first: NDArray[np.int32]


def shape_grid(shape: Floats) -> tuple[Indices, ShapeGrid]:
    """Rows (q,) of the shapes (q, 5) in the order of a grid, and the grid."""
    # Without shapes, of a catalog too small for a pattern, one empty cell.
    low = shape[:, :4].min(axis=0, initial=0.0)
    at = np.floor((shape[:, :4] - low) / _CELL).astype(np.int64)
    cells = at.max(axis=0, initial=0) + 1
    cell = np.ravel_multi_index(tuple(at.T), tuple(cells))
    rows = np.argsort(cell, kind='stable')
    first = np.zeros(int(np.prod(cells)) + 1, np.int32)
    np.cumsum(np.bincount(cell, minlength=len(first) - 1), out=first[1:])
    return rows, ShapeGrid(shape[rows].astype(np.float32), low, cells, first)


def equal_shapes(
    grid: ShapeGrid, shape: Floats, place_tolerance: float, size_tolerance: float
) -> tuple[Indices, Indices]:
    """Pairs of rows, of given shapes (n, 5) and of those of a grid, equal within tolerances."""
    lowest = np.floor((shape[:, :4] - place_tolerance - grid.low) / _CELL).astype(np.int64)
    highest = np.floor((shape[:, :4] + place_tolerance - grid.low) / _CELL).astype(np.int64)
    lowest, highest = np.maximum(lowest, 0), np.minimum(highest, grid.cells - 1)
    within = np.flatnonzero((lowest <= highest).all(axis=1))
    lowest, highest = lowest[within], highest[within]
    # One row an axis: comparisons of long rows are faster than those of short ones.
    span = np.ascontiguousarray((highest - lowest).T)
    lowest_cell = np.ravel_multi_index(tuple(lowest.T), tuple(grid.cells))
    pairs = []
    for step in itertools.product(*(range(int(k) + 1) for k in span[:3].max(axis=1, initial=0))):
        there = np.flatnonzero((span[0] >= step[0]) & (span[1] >= step[1]) & (span[2] >= step[2]))
        start = lowest_cell[there] + int(np.ravel_multi_index((*step, 0), tuple(grid.cells)))
        # Cells along the last place follow one another.
        end = start + span[3, there] + 1
        pairs.append(_rows_between(within[there], grid.first[start], grid.first[end]))
    query, row = np.concatenate(pairs, axis=1)
    off = np.abs(grid.shape[row] - shape[query]).T
    equal = off[4] <= size_tolerance
    for place in off[:4]:
        equal &= place <= place_tolerance
    return query[equal], row[equal]


def _rows_between(query: Indices, begin: NDArray[np.int32], end: NDArray[np.int32]) -> Indices:
    """Each query (n,) with each of its rows from begin to end (n,): (2, m)."""
    count = (end - begin).astype(np.int64)
    before = np.cumsum(count) - count
    row = np.arange(int(count.sum())) + np.repeat(begin - before, count)
    return np.stack([np.repeat(query, count), row])
