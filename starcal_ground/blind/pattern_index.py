# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Index of patterns of four catalog stars by their shape, which is free of scale and rotation.

The shape of a pattern follows Lang et al. 2010, AJ 139, 1782, section 2.1: the two stars farthest
apart, A and B, span a frame, and the positions of the other two, C and D, in it are four numbers.
The fifth number is the distance of A and B, which a camera measures as accurately as its focal
length.  The frame is that of the chords: with unit vectors and M the middle of A and B, C has the
coordinates ``(C - M) . (B - A) / |B - A|^2`` and ``A . (B x C) / |B - A|^2``.  They follow from
the distances of pairs and the volumes of triples, which the patterns of a disc share.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import functools
import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.spatial import cKDTree
from scipy.special import comb

from starcal_ros.arrays import Floats, Indices, Singles
from starcal_ros.sky.catalog import direction_tree, StarCatalog

PATTERN = np.dtype([
    ('places', np.complex64, 2), ('size', np.float32), ('order', np.uint8, 4), ('group', np.int64)
])  # fmt: skip
"""
A pattern of a group of stars, of 32 bytes, since NumPy copies other numbers at half the speed.

``places`` of C and D; ``size`` natural logarithm of the distance of A and B, rad; ``order`` rows
in the group of A, B, C and D: the mean of C and D is nearer to A along A to B, and so is C of the
two; ``group`` number of the group.
"""
Patterns = NDArray[Any]
_Vectors = NDArray[np.floating[Any]]
_STEP = math.sqrt(2.0)
_STANDARD_DEG = 1.6  # radius of the discs of scale 0
_SMALLEST, _LARGEST = -10, 9  # scales: discs of 0.05 to 36 degrees of radius
# Distance of disc centres in disc radii: adjacent discs share two thirds of their area.
_SPACING = 0.7
# Stars per disc from scale 0 on, 7 below: at most about a million patterns.
_STARS = (7, 8, 9, 10, 11, 12, 13, 14, 14, 14)
# Discs of a deep catalog of the whole sky have fewer stars, so that an index takes 0.1 GB.  Of 56
# simulated frames of 0.6 and 1.2 degrees and a sky of 1.6 million stars, 55 were identified with 5
# in a disc and 56 with 7, which took six times as long.
_MOST_PATTERNS, _FEWEST_STARS = 3_000_000, 5
_DEPTH = 3.0  # stars indexed over the number needed for a sky of even density
# A, B, C, D as they are, then with C and D, A and B, and both exchanged.
_ORDERS = np.array([[0, 1, 2, 3], [0, 1, 3, 2], [1, 0, 2, 3], [1, 0, 3, 2]])
_AT_ONCE = 20_000  # patterns of discs, whose arrays fit into a cache
_DISCS_AT_ONCE = 50_000  # whose pairs with stars take 10 MB
_MANY = 2000  # discs, from which a walk through two trees is faster than one search for each
_CELL = 0.04  # about twice the tolerance: two cells along each place, and a table of a few MB
# A and B are the farthest apart, and C is nearer to A: C and D lie in a lens of this corner.
_LOW = (-0.5, -0.88, -0.5, -0.88)
_CELLS = (14, 45, 26, 45)


@dataclass(frozen=True)
class PatternIndex:
    """
    Patterns within discs of one size wherever the catalog has stars enough.

    ``radius_rad`` of the discs; ``members`` (d, k) rows of the catalog of the brightest stars of
    each disc; ``grid`` has the patterns, whose groups are the discs.
    """

    radius_rad: float
    members: NDArray[np.int32]
    grid: PatternGrid

    def stars(self, rows: Indices) -> Indices:
        """Rows (n, 4) of the catalog of A to D of patterns (n,) of the grid."""
        patterns = self.grid.patterns[rows]
        return np.asarray(self.members[patterns['group'][:, None], patterns['order']], np.int64)


def scales_for(half_diagonal_rad: float) -> list[int]:
    """Numbers of the scales whose discs are half to a whole field wide, largest first."""
    scales = range(_LARGEST, _SMALLEST - 1, -1)
    fitting = [k for k in scales if 0.48 <= _radius_rad(k) / half_diagonal_rad < 0.97]
    return fitting or [_SMALLEST if half_diagonal_rad < _radius_rad(0) else _LARGEST]


def _radius_rad(scale: int) -> float:
    """Radius of the discs of a scale."""
    return math.radians(_STANDARD_DEG * _STEP**scale)


@functools.lru_cache(maxsize=10)
def pattern_index(catalog: StarCatalog, scale: int) -> PatternIndex:
    """
    Index of the patterns of the brightest stars of each disc of a scale.

    It takes up to half a second, or some seconds for millions of stars, and is kept in memory.
    The catalog is sorted by magnitude.
    """
    radius_rad = _radius_rad(scale)
    of_disc = _STARS[max(scale, 0)]
    sky_by_disc = 2.0 / (1.0 - math.cos(radius_rad))
    stars = catalog.direction_icrs[: int(_DEPTH * of_disc * sky_by_disc)]
    if scale >= 0:
        centres = sphere_points(int(4 * math.pi / (_SPACING * radius_rad) ** 2))
    else:
        centres = _occupied(stars, _SPACING * radius_rad)
    tree = tree_of_brightest(catalog, len(stars))
    some_discs = np.array_split(centres, len(centres) // _DISCS_AT_ONCE + 1)
    brightest = [brightest_within(tree, some, radius_rad, of_disc) for some in some_discs]
    members = np.concatenate(brightest, dtype=np.int32)
    held = np.count_nonzero(members >= 0, axis=1)
    while of_disc > _FEWEST_STARS and comb(held.clip(max=of_disc), 4).sum() > _MOST_PATTERNS:
        of_disc -= 1
    members = members[:, :of_disc]
    parts = _patterns_by_disc(stars.T.astype(np.float32), members)
    return PatternIndex(radius_rad, members, pattern_grid(parts))


def _patterns_by_disc(stars: Singles, members: NDArray[np.int32]) -> Iterator[Patterns]:
    """Patterns of stars (3, s) in discs of members (d, k), those of some discs at a time."""
    held = np.count_nonzero(members >= 0, axis=1)
    # Outside the region of a deep table nearly all discs are without a pattern.
    for count in range(4, members.shape[1] + 1):
        discs = np.flatnonzero(held == count)
        for part in np.array_split(discs, len(discs) * math.comb(count, 4) // _AT_ONCE + 1):
            yield patterns_of(stars.take(members[part, :count].T, axis=1), part)


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


@functools.lru_cache
def _rows_of(count: int) -> tuple[Indices, Indices, Indices, Indices, NDArray[np.uint8]]:
    """
    Rows of the pairs and patterns of a number of stars.

    The stars (2, p) of each pair; the pair (k, k) of two stars; the other stars (p, k - 2) of each
    pair; columns (2, m) in these of C and D; stars (p, m, 4, 4) in each order of `_ORDERS`.
    """
    a, b = np.array(list(itertools.combinations(range(count), 2))).T
    pair = np.zeros((count, count), np.int64)
    pair[a, b] = pair[b, a] = np.arange(len(a))
    stars = np.arange(count)
    other = np.nonzero((stars != a[:, None]) & (stars != b[:, None]))[1].reshape(len(a), -1)
    c, d = np.array(list(itertools.combinations(range(count - 2), 2))).T
    four = np.broadcast_arrays(a[:, None], b[:, None], other[:, c], other[:, d])
    orders = np.stack(four, axis=-1).astype(np.uint8)[..., _ORDERS]
    return np.stack([a, b]), pair, other, np.stack([c, d]), orders


def patterns_of(stars: _Vectors, groups: Indices) -> Patterns:
    """Patterns of all four of the k stars (3, k, g), unit vectors, of groups numbered (g,)."""
    (a, b), pair_of, other, (c, d), orders = _rows_of(stars.shape[1])
    ab = stars[:, b] - stars[:, a]
    square = np.maximum(_dot(ab, ab), 1e-30)
    normal = np.cross(stars[:, a], ab, axis=0)
    # Over the pairs A and B, the other stars and the groups.
    longest2 = square[:, None]
    from_a2, from_b2 = square[pair_of[a[:, None], other]], square[pair_of[b[:, None], other]]
    place = np.empty(from_a2.shape, np.complex64)
    place.real = (from_a2 - from_b2) * (0.5 / longest2)
    place.imag = _dot(normal[:, :, None], stars[:, other]) / longest2
    within = np.maximum(from_a2, from_b2) <= longest2
    apart2 = square[pair_of[other[:, c], other[:, d]]]
    is_pattern = within[:, c] & within[:, d] & (apart2 <= longest2)
    kind, group = np.divmod(np.flatnonzero(is_pattern), len(groups))
    pair, of_pair = np.divmod(kind, len(c))
    place_c, place_d = (
        place.ravel().take((pair * other.shape[1] + column.take(of_pair)) * len(groups) + group)
        for column in (c, d)
    )
    # The exchange of A and B turns the frame about its middle by half a revolution.
    turned = place_c.real + place_d.real > 0.0
    sign = np.where(turned, np.float32(-1.0), np.float32(1.0))
    place_c, place_d = sign * place_c, sign * place_d
    later = place_c.real > place_d.real
    patterns = np.empty(len(kind), PATTERN)
    patterns['places'][:, 0] = np.where(later, place_d, place_c)
    patterns['places'][:, 1] = np.where(later, place_c, place_d)
    patterns['size'] = 0.5 * np.log(square).ravel().take(pair * len(groups) + group)
    patterns['order'] = orders.reshape(-1, 4).take(4 * kind + 2 * turned + later, axis=0)
    patterns['group'] = groups.take(group)
    return patterns


def _dot(a: _Vectors, b: _Vectors) -> _Vectors:
    """Products (...) of vectors (3, ...)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def equivalent(patterns: Patterns, tolerance: float) -> Patterns:
    """
    The patterns (n,) in each order in which the catalog may have them: (m,).

    An error of a place up to the tolerance may move a pattern across the border between two of
    the four orders.
    """
    c, d = patterns['places'].T
    every = np.tile(patterns, 4)
    every['places'] = np.hstack([[c, d], [d, c], [-c, -d], [-d, -c]]).T
    every['order'] = np.concatenate([patterns['order'][:, order] for order in _ORDERS])
    along_c, along_d = every['places'].real.T
    near = (along_c <= along_d + 2 * tolerance) & (along_c + along_d <= 2 * tolerance)
    return np.asarray(every[near])


def sphere_points(count: int) -> Floats:
    """Unit vectors (count, 3) at even distances over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    longitude = k * math.pi * (3.0 - math.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(longitude), r * np.sin(longitude), z], axis=-1)


def tree_of_brightest(catalog: StarCatalog, count: int) -> cKDTree:
    """Search tree of the brightest stars of a catalog."""
    if count >= len(catalog.id):
        return catalog.tree
    return direction_tree(catalog.direction_icrs[:count])


def brightest_within(stars: cKDTree, centres: Floats, radius_rad: float, count: int) -> Indices:
    """Rows (p, count) of the brightest of sorted stars about centres (p, 3); -1: none."""
    chord = 2 * math.sin(radius_rad / 2)
    if len(centres) > _MANY:
        tree = direction_tree(centres)
        near = tree.sparse_distance_matrix(stars, chord, output_type='coo_matrix').tocsr()
        first, star = near.indptr, near.indices
    else:
        inside = stars.query_ball_point(centres, chord, return_sorted=True)
        first = np.cumsum([0, *(len(rows) for rows in inside)])
        star = np.fromiter(itertools.chain.from_iterable(inside), np.int64)
    of_centre = np.repeat(np.arange(len(centres)), np.diff(first))
    rank = np.arange(len(star)) - first[of_centre]
    rows = np.full((len(centres), count), -1, np.int64)
    few = rank < count
    rows[of_centre[few], rank[few]] = star[few]
    return rows


@dataclass(frozen=True)
class PatternGrid:
    """
    Patterns (q,) sorted by the cell of their places.

    ``first`` (m + 1,): row of the first pattern of each of the m cells, the last coordinate
    counting fastest.
    """

    patterns: Patterns
    first: NDArray[np.int32]


def pattern_grid(parts: Iterable[Patterns]) -> PatternGrid:
    """Patterns (q,), given in parts, in the order of a grid."""
    every, cells = [], []
    for patterns in parts:
        cell: NDArray[np.int32] = np.zeros(len(patterns), np.int32)
        for place, low, side in zip(_coordinates(patterns).T, _LOW, _CELLS, strict=True):
            cell = cell * np.int32(side) + ((place - low) / _CELL).astype(np.int32)
        every.append(patterns)
        cells.append(cell)
    cell = np.concatenate(cells)
    # The rows of a sparse matrix are sorted by counting.
    of_cell = (np.ones(len(cell), np.int8), (cell, np.arange(len(cell), dtype=np.int32)))
    by_cell = coo_array(of_cell, shape=(math.prod(_CELLS), max(len(cell), 1))).tocsr()
    place = np.empty_like(by_cell.indices)
    place[by_cell.indices] = np.arange(len(cell), dtype=np.int32)
    patterns, end = np.empty(len(cell), PATTERN), len(cell)
    while every:  # each part is freed once it is placed
        part = every.pop()
        patterns[place[end - len(part) : end]] = part
        end -= len(part)
    return PatternGrid(patterns, by_cell.indptr)


def _coordinates(patterns: Patterns) -> Singles:
    """Coordinates (n, 4) of C and D."""
    return np.asarray(patterns['places'].view(np.float32))


def equal_patterns(
    grid: PatternGrid, patterns: Patterns, place_tolerance: float, size_tolerance: float
) -> tuple[Indices, Indices]:
    """Pairs of rows, of given patterns (n,) and of those of a grid, equal within tolerances."""
    places = _coordinates(patterns).astype(np.float64)
    lowest = np.floor((places - place_tolerance - _LOW) / _CELL).astype(np.int64)
    highest = np.floor((places + place_tolerance - _LOW) / _CELL).astype(np.int64)
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
    given, kept = patterns[query], grid.patterns[row]
    equal = np.abs(kept['size'] - given['size']) <= size_tolerance
    for off in np.abs(_coordinates(kept) - _coordinates(given)).T:
        equal &= off <= place_tolerance
    return query[equal], row[equal]


def _rows_between(query: Indices, begin: NDArray[np.int32], end: NDArray[np.int32]) -> Indices:
    """Each query (n,) with each of its rows from begin to end (n,): (2, m)."""
    count = (end - begin).astype(np.int64)
    before = np.cumsum(count) - count
    row = np.arange(int(count.sum())) + np.repeat(begin - before, count)
    return np.stack([np.repeat(query, count), row])
