"""
Patterns of four catalog stars, found again by their shape whatever their scale and rotation.

The shape of a pattern is that of Lang et al. 2010, AJ 139, 1782, section 2.1: in the tangent plane
at its middle, the two stars farthest apart, A and B, span a frame with A at 0 and B at 1 + i; the
places of the other two, C and D, in it are four numbers.  The distance of A and B is a fifth,
which a camera with a roughly known focal length measures roughly.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import itertools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcal_ros.sky.catalog import StarCatalog

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

_SMALLEST_DEG = 1.6
_STEP = math.sqrt(2.0)
_SCALES = 10  # discs of 1.6 to 36 degrees of radius
_SPACING = 0.7  # of disc centres, in their radius: two thirds of a disc is shared with the next
_STARS = (7, 8, 9, 10, 11, 12, 13, 14, 14, 14)  # of a disc: about a million patterns at most
_DEPTH = 3.0  # stars over the sky, in those that the discs would need if all were equally rich
# Of A and B, C and D in each order: what a canonical pattern may have been seen as.
_ORDERS = np.array([[0, 1, 2, 3], [0, 1, 3, 2], [1, 0, 2, 3], [1, 0, 3, 2]])
_PAIRS = np.array(list(itertools.combinations(range(4), 2)))
_OTHERS = np.array([[k for k in range(4) if k not in pair] for pair in _PAIRS])


@dataclass(frozen=True)
class PatternIndex:
    """
    Patterns within discs of one size all over the sky.

    ``quads`` (q, 4) rows of the catalog, in the order A, B, C, D; ``tree`` holds their shapes
    (q, 5), the size weighted as `shapes` is told; ``radius_rad`` of the discs.
    """

    radius_rad: float
    quads: Rows
    shape: NDArray[np.float32]


def scales_for(half_diagonal_rad: float) -> list[int]:
    """Numbers of the scales whose discs are half to a whole field large, the smaller first."""
    fitting = [
        k
        for k in range(_SCALES)
        if 0.48 <= math.radians(_SMALLEST_DEG * _STEP**k) / half_diagonal_rad < 0.97
    ]
    return fitting or [0 if half_diagonal_rad < math.radians(_SMALLEST_DEG) else _SCALES - 1]


@functools.lru_cache(maxsize=_SCALES)
def pattern_index(catalog: StarCatalog, scale: int) -> PatternIndex:
    """
    All patterns of the brightest stars of each disc of a scale; about a second, then kept.

    The catalog is sorted by magnitude.
    """
    radius_rad = math.radians(_SMALLEST_DEG * _STEP**scale)
    of_disc = _STARS[scale]
    sky_by_disc = 2.0 / (1.0 - math.cos(radius_rad))
    stars = catalog.direction_icrs[: int(_DEPTH * of_disc * sky_by_disc)]
    centres = sphere_points(int(4 * math.pi / (_SPACING * radius_rad) ** 2))
    members = brightest_within(stars, centres, radius_rad, of_disc)
    chosen = np.array(list(itertools.combinations(range(of_disc), 4)))
    quads = np.sort(members[:, chosen].reshape(-1, 4), axis=1)
    quads = quads[quads[:, 0] >= 0]  # -1 fills up a disc with fewer stars
    key = np.unique(((quads[:, 0] << 16 | quads[:, 1]) << 16 | quads[:, 2]) << 16 | quads[:, 3])
    quads = np.stack([key >> 48, key >> 32 & 0xFFFF, key >> 16 & 0xFFFF, key & 0xFFFF], axis=-1)
    order, shape = shapes(stars[quads])
    return PatternIndex(
        radius_rad, np.take_along_axis(quads, order, axis=1), shape.astype(np.float32)
    )


def shapes(directions: Floats) -> tuple[Rows, Floats]:
    """
    Shapes of patterns of four directions (n, 4, 3).

    Returns
    -------
    order : (n, 4)
        Which of the four are A, B, C and D: A and B so that C and D have a mean place below one
        half along A to B, C the one nearer to A along it.
    shape : (n, 5)
        Places of C and D in the frame of A and B, and the natural logarithm of their distance,
        rad.
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


def equivalent(order: Rows, shape: Floats) -> tuple[Rows, Floats]:
    """
    Each pattern (n, 4), (n, 5) in its four possible orders: (4 n, 4), (4 n, 5).

    Noise may have put a pattern on the other side of a border between them.
    """
    c = shape[:, 0] + 1j * shape[:, 1]
    d = shape[:, 2] + 1j * shape[:, 3]
    places = ((c, d), (d, c), (1.0 - c, 1.0 - d), (1.0 - d, 1.0 - c))
    all_shapes = [
        np.stack([p.real, p.imag, q.real, q.imag, shape[:, 4]], axis=-1) for p, q in places
    ]
    return np.concatenate([order[:, k] for k in _ORDERS]), np.concatenate(all_shapes)


def _tangent_points(directions: Floats) -> NDArray[np.complex128]:
    """Complex places (n, 4) in the tangent plane at the mean of four directions (n, 4, 3)."""
    middle = directions.mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # Any two axes across will do: a shape does not hang on their rotation.
    least = np.abs(middle).argmin(axis=1)
    x = np.cross(middle, np.eye(3)[least])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(middle, x)
    along = np.einsum('nki,ni->nk', directions, middle)
    real = np.einsum('nki,ni->nk', directions, x) / along
    imaginary = np.einsum('nki,ni->nk', directions, y) / along
    return np.asarray(real + 1j * imaginary)


def sphere_points(count: int) -> Floats:
    """Unit vectors (count, 3) spread evenly over the sphere: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    longitude = k * math.pi * (3.0 - math.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(longitude), r * np.sin(longitude), z], axis=-1)


def brightest_within(stars: Floats, centres: Floats, radius_rad: float, count: int) -> Rows:
    """Rows (p, count) of the brightest of stars (n, 3), sorted, about centres (p, 3); -1: none."""
    tree = cKDTree(stars)
    found = tree.query_ball_point(centres, 2 * math.sin(radius_rad / 2), return_sorted=True)
    rows = np.full((len(centres), count), -1, np.int64)
    for k, inside in enumerate(found):
        few = inside[:count]
        rows[k, : len(few)] = few
    return rows
