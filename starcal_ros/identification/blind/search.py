# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Identification of the stars of one image without attitude or alignment.

Patterns of four of the brightest sources are looked up among those of the catalog
(`pattern_index`).  Each match gives a rotation and a focal length, and the bright stars predicted
with them are compared with the sources.  The best candidates are refined; the first one with a
significant p-value is accepted (`sky_fit`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import functools
import itertools
import math
import time

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.identification.blind.pattern_index import (
    brightest_within,
    equal_shapes,
    equivalent,
    pattern_index,
    scales_for,
    shapes,
    sphere_points,
)
from starcal_ros.identification.blind.sky_fit import (
    FOCAL_RANGE,
    log10_p_value,
    match,
    predicted,
    refined,
    SkyFit,
    SourceImage,
)
from starcal_ros.sky.catalog import StarCatalog

MAX_LOG10_P_VALUE = -3.0  # a bound, some orders of magnitude above the rate of false matches
ROUNDS = ((0, 12), (12, 18), (18, 24))
"""
(first, last) of each round: patterns of the ``last`` brightest sources, with at least one source
after the ``first`` brightest.
"""
_REFINED = 32  # number of best candidates of a lookup that are refined
_GUESSED = 0.2  # largest shift of a guess, half diagonals
_ALIKE = 0.03  # largest shift of one star to the next, half diagonals
_OF_A_GUESS = 40  # brightest stars and sources compared with a guess
_CANDIDATES = 20_000  # tested candidates of a lookup, drawn at random from more
_TESTED = 16  # brightest predictions used to test a candidate
_TABLED = 5000  # most points whose stars are kept in memory: for discs of 9 degrees and more
_CHUNK = 5000  # candidates tested at once: 30 MB
_MAP_SIDE = 128  # cells of the map of the sources along each side
_NEAR, _FAR = 0.006, 0.02  # 1-sigma of the predictions of a candidate, in half diagonals
_SHOWN = 0.6  # expected share of the bright stars that a true candidate shows
_LEAST_GAIN = 0.8  # smallest gain, over that of the four stars of a pattern alone


@dataclass(frozen=True)
class SkyMatch:
    """
    Identified stars of an image.

    Attributes
    ----------
    camera_from_icrf : Rotation
        From catalog directions (ICRS, epoch of the catalog) to camera axes; no aberration applied.
    camera : CameraModel
        The prior with focal length, principal point and ``k1`` fitted to these stars.
    catalog_index : (n,)
        Rows of the catalog.
    xy_px : (n, 2)
        Pixels of those stars, as given.
    mirrored : bool
        The image is a mirror image; rotation and camera are for the image mirrored left to right.
    log10_p_value : float
        Decadic logarithm of the expected number of false matches this good.
    residual_px : float
        Root mean square of the residuals, per axis.
    """

    camera_from_icrf: Rotation
    camera: CameraModel
    catalog_index: Indices
    xy_px: Floats
    mirrored: bool
    log10_p_value: float
    residual_px: float


@dataclass(frozen=True)
class NotFound:
    """Reason why no stars were identified, and the log10 p-value of the best fit, if any."""

    reason: str
    log10_p_value: float = math.inf


@dataclass(frozen=True)
class _Candidates:
    """
    Patterns of the image that match patterns of the catalog.

    ``stars`` and ``sources`` (n, 4); ``growth`` (n,): focal length over that of the search.
    """

    stars: Indices
    sources: Indices
    growth: Floats


def find_sky(
    xy_px: Floats,
    camera: CameraModel,
    catalog: StarCatalog,
    try_mirrored: bool = False,
    rounds: Sequence[tuple[int, int]] = ROUNDS,
    deadline_s: float = math.inf,
) -> SkyMatch | NotFound:
    """
    Identified stars among sources (n, 2), brightest first, or the reason why there are none.

    ``camera`` is the prior: focal length within 25 %, principal point within 5 % of the width,
    distortion within 3 % of the radius.  The catalog is sorted by magnitude.  With
    ``try_mirrored`` the mirror image is searched too.  ``rounds`` is a part of `ROUNDS`; the
    search ends when the processor time of the thread reaches ``deadline_s``.
    """
    if len(xy_px) < 5:
        return NotFound(f'{len(xy_px)} star-like sources, at least 5 are needed')
    images = [SourceImage(xy_px, camera)]
    if try_mirrored:
        images.append(SourceImage(mirror(xy_px, camera.width), mirrored_camera(camera)))
    least = math.inf
    for before, sources in rounds:
        if len(xy_px) <= before:
            break
        ways = itertools.product(_focal_scales(images[0].half_diagonal_rad), enumerate(images))
        for focal_scale, (mirrored, image) in ways:
            for scale in scales_for(image.half_diagonal_rad / focal_scale):
                for fit in _fits(image, catalog, scale, focal_scale, before, sources):
                    log10_p, radius_px = log10_p_value(image, catalog, fit)
                    log10_p += math.log10(len(images))
                    least = min(least, log10_p)
                    if log10_p < MAX_LOG10_P_VALUE:
                        return _result(image, catalog, fit, radius_px, log10_p, bool(mirrored))
                if time.thread_time() > deadline_s:
                    return NotFound('the search has reached its time limit', least)
    return NotFound('no pattern of the sources matches the catalog beyond chance', least)


def confirm_sky(
    xy_px: Floats,
    camera: CameraModel,
    catalog: StarCatalog,
    camera_from_icrf: Rotation,
    mirrored: bool = False,
) -> SkyMatch | NotFound:
    """Identified stars, as from `find_sky`, given a rotation known to 10 % of the field."""
    image = SourceImage(xy_px, camera)
    if mirrored:
        image = SourceImage(mirror(xy_px, camera.width), mirrored_camera(camera))
    stars = _stars_about(image, catalog, camera_from_icrf.as_matrix()[2])
    start = SkyFit(camera_from_icrf, image.camera, stars)
    pairs = _shifted_alike(image, catalog, start)
    fit = refined(image, catalog, start, pairs) if len(pairs) >= 5 else None
    if fit is None:
        return NotFound('the stars are not where they were expected')
    log10_p, radius_px = log10_p_value(image, catalog, fit)
    if log10_p >= MAX_LOG10_P_VALUE:
        return NotFound('the stars are not where they were expected', log10_p)
    return _result(image, catalog, fit, radius_px, log10_p, mirrored)


def _shifted_alike(image: SourceImage, catalog: StarCatalog, start: SkyFit) -> Indices:
    """Pairs (k, 2) of catalog row and source whose shifts are the most alike."""
    stars, xy_px = predicted(catalog, start, _OF_A_GUESS)
    shift = (image.xy_px[None, :_OF_A_GUESS] - xy_px[:, None]) / image.half_diagonal_px
    rank, source = np.nonzero(np.hypot(shift[..., 0], shift[..., 1]) < _GUESSED)
    if len(rank) == 0:
        return np.empty((0, 2), np.int64)
    tree = cKDTree(shift[rank, source])
    alike = tree.query_ball_point(tree.data, _ALIKE)
    chosen = np.array(max(alike, key=len))
    return np.stack([stars[rank[chosen]], source[chosen]], axis=-1)


def mirror(xy_px: Floats, width: int) -> Floats:
    """Pixels (n, 2) of an image mirrored left to right."""
    return np.stack([width - 1 - xy_px[:, 0], xy_px[:, 1]], axis=-1)


def mirrored_camera(camera: CameraModel) -> CameraModel:
    """Camera of the image mirrored left to right."""
    skew, cx = float(camera.parameters[1]), float(camera.parameters[3])
    turned = camera.replace(cx=camera.width - 1 - cx, skew=-skew)
    if 'p2' not in camera.parameter_names:
        return turned
    return turned.replace(p2=-float(camera.parameters[9]))


def _focal_scales(half_diagonal_rad: float) -> tuple[float, ...]:
    """Focal lengths to try, over the prior; in a narrow field shapes do not depend on it."""
    if half_diagonal_rad < math.radians(12.0):
        return (1.0,)
    if half_diagonal_rad < math.radians(24.0):
        return (1.0, 0.86, 1.16)
    return (1.0, 0.91, 1.1, 0.83, 1.2)


def _tolerances(half_diagonal_rad: float) -> tuple[float, float]:
    """Largest error of the shape of a pattern, and of the logarithm of its size."""
    size = {1: FOCAL_RANGE + 0.05, 3: 0.16, 5: 0.13}[len(_focal_scales(half_diagonal_rad))]
    return 0.012 + 0.04 * half_diagonal_rad, size


def _fits(
    image: SourceImage,
    catalog: StarCatalog,
    scale: int,
    focal_scale: float,
    before: int,
    sources: int,
) -> Iterator[SkyFit]:
    """Refined fits from patterns of the brightest sources, most likely first."""
    fx, fy = focal_scale * image.camera.parameters[[0, 2]]
    camera = image.camera.replace(fx=float(fx), fy=float(fy))
    directions = line_of_sight(camera, image.xy_px)
    candidates = _look_up(image, catalog, scale, directions[:sources], before)
    if len(candidates.growth) == 0:
        return
    plane = directions[:, :2] / directions[:, 2:]
    rotation = _rotations(catalog, candidates, plane)
    gain, own = _gains(image, catalog, candidates, plane, rotation)
    best = np.argsort(-gain, kind='stable')[:_REFINED]
    for k in best[gain[best] > _LEAST_GAIN * own]:
        growth = float(candidates.growth[k])
        start = SkyFit(
            Rotation.from_matrix(rotation[k]),
            camera.replace(fx=growth * float(fx), fy=growth * float(fy)),
            _stars_about(image, catalog, rotation[k, 2]),
        )
        pairs = np.stack([candidates.stars[k], candidates.sources[k]], axis=-1)
        fit = refined(image, catalog, start, pairs)
        if fit is not None:
            yield fit


def _look_up(
    image: SourceImage, catalog: StarCatalog, scale: int, directions: Floats, before: int
) -> _Candidates:
    """Matches of patterns of directions (n, 3) with at least one from row ``before`` on."""
    index = pattern_index(catalog, scale)
    usable = np.flatnonzero(np.isfinite(directions[:, 0]))
    every = list(itertools.combinations(usable.tolist(), 4))
    chosen: Indices = np.array(every, np.int64).reshape(-1, 4)
    chosen = chosen[chosen[:, 3] >= before]
    place_tolerance, size_tolerance = _tolerances(image.half_diagonal_rad)
    order, shape = shapes(directions[chosen])
    sources = np.take_along_axis(chosen, order, axis=1)
    fits = shape[:, 4] < math.log(2 * index.radius_rad) + size_tolerance
    sources, shape = equivalent(sources[fits], shape[fits], place_tolerance)
    query, quad = equal_shapes(index.grid, shape, place_tolerance, size_tolerance)
    if len(quad) > _CANDIDATES:
        few = np.random.default_rng(0).choice(len(quad), _CANDIDATES, replace=False)
        quad, query = quad[few], query[few]
    growth = np.exp(shape[query, 4] - index.grid.shape[quad, 4])
    return _Candidates(index.quads[quad], sources[query], growth)


def _rotations(catalog: StarCatalog, candidates: _Candidates, plane: Floats) -> Floats:
    """Rotations (n, 3, 3) of candidates from the catalog to the camera."""
    seen = np.empty((len(candidates.growth), 4, 3))
    seen[..., :2] = plane[candidates.sources] / candidates.growth[:, None, None]
    seen[..., 2] = 1.0
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    stars = catalog.direction_icrs[candidates.stars]
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
    image: SourceImage,
    catalog: StarCatalog,
    candidates: _Candidates,
    plane: Floats,
    rotation: Floats,
) -> tuple[Floats, float]:
    """
    Log-likelihood ratio (n,) of the sources with a candidate to that by chance.

    Also the ratio that the four stars of a pattern give alone.
    """
    half = math.tan(image.half_diagonal_rad)
    finite = plane[np.isfinite(plane[:, 0])]
    gain_map, low, cell = _gain_map(finite, half)
    (rows, columns), flat = gain_map.shape, gain_map.ravel()
    gains = np.empty(len(rotation))
    for first in range(0, len(rotation), _CHUNK):
        part = slice(first, first + _CHUNK)
        stars = _bright_about(catalog, rotation[part, 2], 1.1 * math.atan(half), 3 * _TESTED)
        place = np.matmul(catalog.direction_icrs[stars], rotation[part].transpose(0, 2, 1))
        ahead = (stars >= 0) & (place[..., 2] > 0.1)
        scale = candidates.growth[part, None] / np.where(ahead, place[..., 2], 1.0) / cell
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
    return cKDTree(points), cKDTree(catalog.direction_icrs[:enough])


def _bright_about(catalog: StarCatalog, axes: Floats, radius_rad: float, count: int) -> Indices:
    """Rows (n, count) of the brightest stars within about a radius of axes (n, 3); -1 if fewer."""
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


def _stars_about(image: SourceImage, catalog: StarCatalog, axis: Floats) -> Indices:
    """Rows of the stars that may be in the image with this axis, at least three per source."""
    radius_rad = 1.25 * image.half_diagonal_rad * (1 + FOCAL_RANGE)
    near = np.flatnonzero(catalog.direction_icrs @ axis > math.cos(min(radius_rad, 1.4)))
    area = 1.0 / (1.0 - math.cos(min(radius_rad, 1.4))) * (1.0 - math.cos(image.half_diagonal_rad))
    return near[: int(max(60, 3 * len(image.xy_px)) / area)]


def _result(
    image: SourceImage,
    catalog: StarCatalog,
    fit: SkyFit,
    radius_px: float,
    log10_p: float,
    mirrored: bool,
) -> SkyMatch:
    """Result of a fit with all sources that match it."""
    # Stars fainter than the sources would match only false ones.
    deepest = 2 * len(image.xy_px)
    pairs = match(image, catalog, fit, max(radius_px, 1.5), deepest, 10_000)
    xy_px = image.xy_px[pairs[:, 1]]
    order = np.argsort(pairs[:, 0])
    stars, placed = predicted(catalog, fit, deepest)
    residual = xy_px[order] - placed[np.searchsorted(stars, pairs[order, 0])]
    return SkyMatch(
        camera_from_icrf=fit.camera_from_icrf,
        camera=fit.camera,
        catalog_index=pairs[order, 0],
        xy_px=(mirror(xy_px, image.camera.width) if mirrored else xy_px)[order],
        mirrored=mirrored,
        log10_p_value=log10_p,
        residual_px=float(np.sqrt((residual**2).mean())),
    )
