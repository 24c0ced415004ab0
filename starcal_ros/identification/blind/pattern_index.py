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
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Indices, Singles
from starcal_ros.sky.catalog import direction_tree, StarCatalog

_Array = TypeVar('_Array', Floats, Singles)
_STEP = math.sqrt(2.0)
_STANDARD_DEG = 1.6  # radius of the discs of scale 0
_SMALLEST, _LARGEST = -10, 9  # scales: discs of 0.05 to 36 degrees of radius
# Distance of disc centres in disc radii: adjacent discs share two thirds of their area.
_SPACING = 0.7
# Stars per disc from scale 0 on, 7 below: at most about a million patterns.
_STARS = (7, 8, 9, 10, 11, 12, 13, 14, 14, 14)
_DEPTH = 3.0  # stars indexed over the number needed for a sky of even density
_AB = tuple(itertools.combinations(range(4), 2))
_CD = tuple(itertools.combinations(range(4), 2))[::-1]
# Orders of A, B, C, D: for each pair A and B as numbered, with C and D, then A and B, exchanged.
_ORDERS = np.array(
    [
        (*ab[::turn], *cd[::swap])
        for ab, cd in zip(_AB, _CD, strict=True)
        for turn in (1, -1)
        for swap in (1, -1)
    ]
)
_AT_ONCE = 600  # discs, whose arrays fit into a cache
_MANY = 2000  # discs, from which a walk through two trees is faster than one search for each
_CELL = 0.04  # about twice the tolerance: two cells along each place, and a table of a few MB
# A and B are the farthest apart, and C is nearer to A: C and D lie in a lens of this corner.
_LOW = (0.0, -0.88, 0.0, -0.88)
_CELLS = (14, 45, 26, 45)


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

    It takes half a second and is kept in memory.  The catalog is sorted by magnitude.
    """
    radius_rad = _radius_rad(scale)
    of_disc = _STARS[max(scale, 0)]
    sky_by_disc = 2.0 / (1.0 - math.cos(radius_rad))
    stars = catalog.direction_icrs[: int(_DEPTH * of_disc * sky_by_disc)]
    if scale >= 0:
        centres = sphere_points(int(4 * math.pi / (_SPACING * radius_rad) ** 2))
    else:
        centres = _occupied(stars, _SPACING * radius_rad)
    members = brightest_within(direction_tree(stars), centres, radius_rad, of_disc)
    held = np.count_nonzero(members >= 0, axis=1)
    xyz = stars.T.astype(np.float32)
    # Outside the region of a deep table nearly all discs are without a pattern.
    parts = [
        _patterns(xyz, part)
        for count in range(4, of_disc + 1)
        for part in _in_parts(members[held == count, :count])
    ]
    quads, shape = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return PatternIndex(radius_rad, quads, shape_grid(shape))


def _in_parts(members: Indices) -> list[Indices]:
    """Members (d, k) of discs in parts whose arrays fit into a cache."""
    return np.array_split(members, len(members) // _AT_ONCE + 1)


def _patterns(xyz: Singles, members: Indices) -> tuple[Indices, Singles]:
    """Patterns (n, 4), A to D, of stars (3, s) in discs of members (d, k), and their shapes."""
    rows = members.T.astype(np.int32)
    chosen = np.array(list(itertools.combinations(range(len(rows)), 4))).T
    order, shape = shapes(xyz.take(rows, axis=1)[:, chosen].reshape(3, 4, -1).T)
    return np.take_along_axis(rows[chosen].reshape(4, -1).T, order, axis=1), shape


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


def shapes(directions: _Array) -> tuple[Indices, _Array]:
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
    # One row an axis and a star: the rows of all catalog patterns take a third of a second.
    xyz = directions.T
    middle = xyz.sum(axis=1)
    middle /= np.sqrt(_dot(middle, middle))
    points = xyz / _dot(xyz, middle[:, None])  # in the tangent plane at the middle
    longest = np.zeros(len(directions), np.int64)
    length2 = np.zeros(len(directions), directions.dtype)
    for k, (i, j) in enumerate(_AB):
        apart = points[:, i] - points[:, j]
        apart2 = _dot(apart, apart)
        longest[apart2 > length2] = k
        np.maximum(length2, apart2, out=length2)
    at = _ORDERS[::4].T.take(longest, axis=1) * len(directions) + np.arange(len(directions))
    a, b, c, d = points.reshape(3, -1).take(at, axis=1).transpose(1, 0, 2)
    b, c, d = b - a, c - a, d - a
    across = np.cross(middle, b, axis=0)
    with np.errstate(invalid='ignore', divide='ignore'):
        places = np.stack([_dot(star, axis) / length2 for star in (c, d) for axis in (b, across)])
    swap = places[0] + places[2] > 1.0
    places = np.where(swap, np.array([[1], [0], [1], [0]], np.int8) - places, places)
    later = places[0] > places[2]
    places = np.where(later, places[[2, 3, 0, 1]], places)
    size = 0.5 * np.log(np.maximum(length2, 1e-30))
    return _ORDERS.take(4 * longest + 2 * swap + later, axis=0), np.vstack([places, size]).T


def _dot(a: _Array, b: _Array) -> _Array:
    """Sum of products over the first of three axes."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def equivalent(order: Indices, shape: Floats, tolerance: float) -> tuple[Indices, Floats]:
    """
    The patterns (n, 4), (n, 5) in each order in which the catalog may have them: (m, 4), (m, 5).

    An error of a place up to the tolerance may move a pattern across the border between two of
    the four orders.
    """
    c = shape[:, 0] + 1j * shape[:, 1]
    d = shape[:, 2] + 1j * shape[:, 3]
    places = ((c, d), (d, c), (1.0 - c, 1.0 - d), (1.0 - d, 1.0 - c))
    all_orders = np.concatenate([order[:, k] for k in _ORDERS[:4]])
    found = np.concatenate(
        [np.stack([p.real, p.imag, q.real, q.imag, shape[:, 4]], axis=-1) for p, q in places]
    )
    c_real, d_real = found[:, 0], found[:, 2]
    near = (c_real <= d_real + 2 * tolerance) & (c_real + d_real <= 1.0 + 2 * tolerance)
    return all_orders[near], found[near]


def sphere_points(count: int) -> Floats:
    """Unit vectors (count, 3) at even distances over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    longitude = k * math.pi * (3.0 - math.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(longitude), r * np.sin(longitude), z], axis=-1)


def brightest_within(stars: cKDTree, centres: Floats, radius_rad: float, count: int) -> Indices:
    """Rows (p, count) of the brightest of sorted stars about centres (p, 3); -1: none."""
    chord = 2 * math.sin(radius_rad / 2)
    if len(centres) > _MANY:
        pairs = direction_tree(centres).sparse_distance_matrix(stars, chord, output_type='ndarray')
        of_centre, star = np.divmod(np.sort(pairs['i'] * stars.n + pairs['j']), stars.n)
    else:
        inside = stars.query_ball_point(centres, chord, return_sorted=True)
        of_centre = np.repeat(np.arange(len(inside)), [len(rows) for rows in inside])
        star = np.fromiter(itertools.chain.from_iterable(inside), np.int64)
    first = np.searchsorted(of_centre, np.arange(len(centres)))
    rank = np.arange(len(star)) - first[of_centre]
    rows = np.full((len(centres), count), -1, np.int64)
    few = rank < count
    rows[of_centre[few], rank[few]] = star[few]
    return rows


@dataclass(frozen=True)
class ShapeGrid:
    """
    Shapes (q, 5) sorted by cell.

    ``rows`` (q,) of the shapes as given; ``first`` (m + 1,): row of the first shape of each of
    the m cells, the last place counting fastest.
    """

    rows: NDArray[np.int32]
    shape: Singles
    first: NDArray[np.int32]


def shape_grid(shape: Floats | Singles) -> ShapeGrid:
    """Shapes (q, 5) in the order of a grid."""
    cell = np.zeros(len(shape), np.int32)
    for place, low, cells in zip(shape.T, _LOW, _CELLS, strict=False):
        cell = cell * np.int32(cells) + ((place - low) / _CELL).astype(np.int32)
    # The rows of a sparse matrix are sorted by counting.
    of_cell = (np.ones(len(cell), np.int8), (cell, np.arange(len(cell), dtype=np.int32)))
    by_cell = coo_array(of_cell, shape=(math.prod(_CELLS), max(len(cell), 1))).tocsr()
    return ShapeGrid(by_cell.indices, shape.take(by_cell.indices, axis=0), by_cell.indptr)


def equal_shapes(
    grid: ShapeGrid, shape: Floats, place_tolerance: float, size_tolerance: float
) -> tuple[Indices, Indices]:
    """Pairs of rows, of given shapes (n, 5) and of those of a grid, equal within tolerances."""
    lowest = np.floor((shape[:, :4] - place_tolerance - _LOW) / _CELL).astype(np.int64)
    highest = np.floor((shape[:, :4] + place_tolerance - _LOW) / _CELL).astype(np.int64)
    lowest, highest = np.maximum(lowest, 0), np.minimum(highest, np.array(_CELLS) - 1)
    within = np.flatnonzero((lowest <= highest).all(axis=1))
    lowest, highest = lowest[within], highest[within]
    # One row an axis: comparisons of long rows are faster than those of short ones.
    span = np.ascontiguousarray((highest - lowest).T)
    lowest_cell = np.ravel_multi_index(tuple(lowest.T), _CELLS)
    pairs = []
    for step in itertools.product(*(range(int(k) + 1) for k in span[:3].max(axis=1, initial=0))):
        there = np.flatnonzero((span[0] >= step[0]) & (span[1] >= step[1]) & (span[2] >= step[2]))
        start = lowest_cell[there] + int(np.ravel_multi_index((*step, 0), _CELLS))
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
