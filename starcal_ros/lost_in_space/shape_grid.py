# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Search of the shapes of an index that equal given ones within tolerances.

The four places of a shape are sorted into cells.  A box of four tolerances covers few cells with
few shapes each, and all boxes are searched at once: for a million shapes ten times faster than
with a tree.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Indices

_CELL = 0.04  # about twice the tolerance: two cells along each place, and a table of a few MB


@dataclass(frozen=True)
class ShapeGrid:
    """
    Shapes (q, 5) sorted by cell.

    ``low`` (4,) and ``cells`` (4,): corner and number of the cells along each place; ``first``
    (m + 1,): row of the first shape of each of the m cells, the last place counting fastest.
    """

    shape: NDArray[np.float32]
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


def _rows_between(
    query: Indices, begin: NDArray[np.int32], end: NDArray[np.int32]
) -> NDArray[np.int64]:
    """Each query (n,) with each of its rows from begin to end (n,): (2, m)."""
    count = (end - begin).astype(np.int64)
    before = np.cumsum(count) - count
    row = np.arange(int(count.sum())) + np.repeat(begin - before, count)
    return np.stack([np.repeat(query, count), row])
