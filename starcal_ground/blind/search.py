# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Identification of the stars of one image without attitude or alignment.

Patterns of four of the brightest sources are looked up among those of the catalog
(`pattern_index`).  Each match is a candidate, with a rotation and a focal length; the bright stars
predicted with them are compared with the sources.  The best candidates are refined, those that are
almost certain before all others; the first one with a significant p-value is accepted (`sky_fit`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import dataclasses
from dataclasses import dataclass
import functools
import itertools
import math
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ground.blind import pattern_index, sky_fit
from starcal_ground.blind.pattern_index import PATTERN, Patterns, patterns_of
from starcal_ground.blind.sky_fit import FOUND, Ranges, SkyFit, SourceImage, STATED
from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.sky.catalog import direction_tree, StarCatalog

MAX_LOG10_P_VALUE = -3.0  # a bound, some orders of magnitude above the rate of false matches
ROUNDS = ((0, 12), (12, 18), (18, 24))
"""
(first, last) of each round: patterns of the ``last`` brightest sources, with at least one source
after the ``first`` brightest.
"""
_GUESSED = 0.2  # largest shift of a guess, half diagonals
_ALIKE = 0.03  # largest shift of one star to the next, half diagonals
_OF_A_GUESS = 40  # brightest stars and sources compared with a guess
_FEWEST_SOURCES = 5
_AGAIN_PX = 3.0  # radius of matching with a better camera
_KEPT = 32  # number of best candidates of a look-up
_CANDIDATES = 20_000  # tested candidates of a lookup, drawn at random from more
_TESTED = 16  # brightest predictions used to test a candidate
_TABLED_RAD = math.radians(9.0)  # smaller discs are searched about each candidate itself
_CHUNK = 5000  # candidates tested at once: 30 MB
_MAP_SIDE = 128  # cells of the map of the sources along each side
_NEAR, _FAR = 0.006, 0.02  # 1-sigma of the predictions of a candidate, in half diagonals
_SHOWN = 0.6  # expected share of the bright stars that a true candidate shows
_A_LOOK_UP = 2  # candidates refined that cost as much as a look-up
_KNOWN = 0.05  # half range of the focal length from which a field is searched with one
_LEAST_GAIN = 0.8  # smallest gain, over that of the four stars of a pattern alone
_CERTAIN_GAIN = 1.5  # such a gain that few false candidates reach and most true ones do
# Parameters that displace to the right what they displaced to the left in a mirrored image.
_ODD = ('skew', 'p2', 's1', 's2', 'tau_y')


@dataclass
class Effort:
    """
    The cost that searches may still have, in candidates refined: they end alike on any machine.

    A thousand take 4 to 8 s of processor time, with the indices that are made first.
    """

    left: float

    @property
    def is_spent(self) -> bool:
        """True if a search must end."""
        return self.left <= 0


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

    @property
    def camera_px(self) -> Floats:
        """Pixels (n, 2) in the image that ``camera`` is of: mirrored where that is."""
        return mirror(self.xy_px, self.camera.width) if self.mirrored else self.xy_px


def find_in_any(
    rankings: Sequence[Floats],
    cameras: Sequence[CameraModel],
    catalog: StarCatalog,
    mirrored: Sequence[bool] = (False,),
    rounds: Sequence[tuple[int, int]] = ROUNDS,
    effort: Effort | None = None,
    ranges: Ranges = STATED,
) -> tuple[SkyMatch | None, int]:
    """
    Identified stars of an image and the row of their selection; None if there are none.

    ``rankings`` are selections (n, 2) of its sources, brightest first.  ``cameras`` are priors,
    one of them within ``ranges``: by default focal length within 25 %, principal point within 5 %
    of the width, distortion within 3 % of the radius.  The catalog is sorted by magnitude.
    ``mirrored`` are the ways that each is tried, ``rounds`` a part of `ROUNDS`.  The search takes
    from ``effort`` and ends when that is spent.
    """
    effort = effort or Effort(math.inf)
    views = [
        [
            _View(_image(xy_px, camera, turned, ranges), turned, k)
            for k, xy_px in enumerate(rankings)
            if len(xy_px) >= _FEWEST_SOURCES
            for turned in mirrored
        ]
        for camera in cameras
    ]
    for before, sources in rounds:
        chosen = [[view for view in group if len(view.image.xy_px) > before] for group in views]
        for view, candidates in _candidates(chosen, catalog, before, sources):
            effort.left -= _A_LOOK_UP + len(candidates)
            for fit in _fits(view.image, catalog, candidates):
                log10_p, radius_px = sky_fit.log10_p_value(view.image, catalog, fit)
                log10_p += math.log10(len(mirrored))
                if log10_p < MAX_LOG10_P_VALUE:
                    result = _result(view.image, catalog, fit, radius_px, log10_p, view.mirrored)
                    return result, view.ranking
            if effort.is_spent:
                return None, 0
    return None, 0


def _image(xy_px: Floats, camera: CameraModel, mirrored: bool, ranges: Ranges) -> SourceImage:
    """Sources (n, 2) with a prior camera, or those of the mirror image."""
    if not mirrored:
        return SourceImage(xy_px, camera, ranges)
    return SourceImage(mirror(xy_px, camera.width), mirrored_camera(camera), ranges)


def _candidates(
    groups: Sequence[Sequence[_View]], catalog: StarCatalog, before: int, sources: int
) -> Iterator[tuple[_View, list[_Candidate]]]:
    """
    Candidates of all look-ups: first the almost certain ones of each, then the others.

    Each group has the views of one camera, whose focal length itself is tried before others.  To
    refine a false candidate costs half as much as a look-up, and there may be 32 of them; of a
    camera that is known there are few, and they cost less than the index of another scale.
    """
    others = []
    scales = [[(views, k) for k in _focal_scales(views[0].image)] for views in groups if views]
    for views, focal_scale in filter(None, itertools.chain(*itertools.zip_longest(*scales))):
        scaled = [dataclasses.replace(view, focal_scale=focal_scale) for view in views]
        patterns = [view.patterns(before, sources) for view in scaled]
        for scale in pattern_index.scales_for(views[0].image.half_diagonal_rad / focal_scale):
            for view, of_view in zip(scaled, patterns, strict=True):
                certain, other = _look_up(view, catalog, scale, of_view)
                yield view, certain
                others.append((view, other))
            if views[0].image.ranges.focal < _KNOWN:
                yield from others
                others = []
    yield from others


def confirm_sky(
    xy_px: Floats,
    camera: CameraModel,
    catalog: StarCatalog,
    camera_from_icrf: Rotation,
    mirrored: bool = False,
    ranges: Ranges = STATED,
) -> SkyMatch | None:
    """Identified stars among sources (n, 2), given a rotation known to 10 % of the field."""
    image = _image(xy_px, camera, mirrored, ranges)
    stars = _stars_about(image, catalog, camera_from_icrf.as_matrix()[2])
    start = SkyFit(camera_from_icrf, image.camera, stars)
    pairs = _shifted_alike(image, catalog, start)
    fit = sky_fit.refined(image, catalog, start, pairs) if len(pairs) >= 5 else None
    if fit is None:
        return None
    log10_p, radius_px = sky_fit.log10_p_value(image, catalog, fit)
    is_match = log10_p < MAX_LOG10_P_VALUE
    return _result(image, catalog, fit, radius_px, log10_p, mirrored) if is_match else None


def matched_again(
    sky: SkyMatch, xy_px: Floats, catalog: StarCatalog, camera: CameraModel, rotation: Rotation
) -> SkyMatch:
    """A match with all its stars among sources (n, 2) by a better camera and rotation."""
    turned_px = mirror(xy_px, camera.width) if sky.mirrored else xy_px
    image = SourceImage(turned_px, camera, FOUND)
    fit = SkyFit(rotation, camera, _stars_about(image, catalog, rotation.as_matrix()[2]))
    return _result(image, catalog, fit, _AGAIN_PX, sky.log10_p_value, sky.mirrored)


def _shifted_alike(image: SourceImage, catalog: StarCatalog, start: SkyFit) -> Indices:
    """Pairs (k, 2) of catalog row and source whose shifts are the most alike."""
    stars, xy_px = sky_fit.predicted(catalog, start, _OF_A_GUESS)
    shift = (image.xy_px[None, :_OF_A_GUESS] - xy_px[:, None]) / image.half_diagonal_px
    rank, source = np.nonzero(np.hypot(shift[..., 0], shift[..., 1]) < _GUESSED)
    if len(rank) == 0:
        return np.empty((0, 2), np.int64)
    tree = cKDTree(shift[rank, source])
    fullest = tree.query_ball_point(tree.data, _ALIKE, return_length=True).argmax()
    chosen = np.array(tree.query_ball_point(tree.data[fullest], _ALIKE))
    return np.stack([stars[rank[chosen]], source[chosen]], axis=-1)


def mirror(xy_px: Floats, width: int) -> Floats:
    """Pixels (n, 2) of an image mirrored left to right."""
    return np.stack([width - 1 - xy_px[:, 0], xy_px[:, 1]], axis=-1)


def mirrored_camera(camera: CameraModel) -> CameraModel:
    """Camera of the image mirrored left to right."""
    values = dict(zip(camera.parameter_names, camera.parameters.tolist(), strict=True))
    odd = {name: -value for name, value in values.items() if name in _ODD}
    return camera.replace(cx=camera.width - 1 - values['cx'], **odd)


def _fits(
    image: SourceImage, catalog: StarCatalog, candidates: Sequence[_Candidate]
) -> Iterator[SkyFit]:
    """Refined fits of candidates in their order."""
    fx, fy = image.camera.parameters[[0, 2]].tolist()
    for stars, sources, rotation, scale in candidates:
        start = SkyFit(
            Rotation.from_matrix(rotation),
            image.camera.replace(fx=scale * fx, fy=scale * fy),
            _stars_about(image, catalog, rotation[2]),
        )
        fit = sky_fit.refined(image, catalog, start, np.stack([stars, sources], axis=-1))
        if fit is not None:
            yield fit


def _stars_about(image: SourceImage, catalog: StarCatalog, axis: Floats) -> Indices:
    """Rows of the stars that may be in the image with this axis, at least three per source."""
    radius_rad = 1.25 * image.half_diagonal_rad * (1 + image.ranges.focal)
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
    stars, placed_px = sky_fit.predicted(catalog, fit, deepest)
    rank, source, apart_px = sky_fit.mutual(image, placed_px, max(radius_px, 1.5), 10_000)
    xy_px = image.xy_px[source]
    return SkyMatch(
        camera_from_icrf=fit.camera_from_icrf,
        camera=fit.camera,
        catalog_index=stars[rank],
        xy_px=mirror(xy_px, image.camera.width) if mirrored else xy_px,
        mirrored=mirrored,
        log10_p_value=log10_p,
        residual_px=float(np.sqrt(0.5 * (apart_px**2).mean())),
    )


def forget_indices() -> None:
    """Free the indices of all catalogs: 0.3 GB for one of millions of stars."""
    for kept in (pattern_index.pattern_index, _bright_stars, _bright_everywhere):
        kept.cache_clear()


class _Candidate(NamedTuple):
    """
    A pattern of an image that matches one of the catalog.

    ``stars`` and ``sources`` (4,) rows of the catalog and of the sources; ``rotation`` (3, 3) from
    the catalog to the camera; ``focal_scale`` focal length over that of the prior.
    """

    stars: Indices
    sources: Indices
    rotation: Floats
    focal_scale: float


@dataclass(frozen=True)
class _View:
    """
    A selection of the sources of an image, as given or mirrored left to right.

    The focal length of its prior camera is scaled.
    """

    image: SourceImage
    mirrored: bool
    ranking: int
    focal_scale: float = 1.0

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

    def patterns(self, before: int, sources: int) -> Patterns:
        """Patterns of the ``sources`` brightest, by their rows, one after row ``before``."""
        usable = np.flatnonzero(np.isfinite(self.directions[:sources, 0]))
        if len(usable) < 4:
            return np.empty(0, PATTERN)
        patterns = patterns_of(self.directions[usable].T[..., None], np.zeros(1, np.int64))
        patterns['order'] = usable[patterns['order']]
        return patterns[(patterns['order'] >= before).any(axis=1)]


def _focal_scales(image: SourceImage) -> tuple[float, ...]:
    """Focal lengths to try, over the prior; in a narrow field shapes do not depend on it."""
    if image.half_diagonal_rad < math.radians(12.0) or image.ranges.focal < _KNOWN:
        return (1.0,)
    if image.half_diagonal_rad < math.radians(24.0):
        return (1.0, 0.86, 1.16)
    return (1.0, 0.91, 1.1, 0.83, 1.2)


def _tolerances(image: SourceImage) -> tuple[float, float]:
    """Largest error of the shape of a pattern, and of the logarithm of its size."""
    size = {1: image.ranges.focal + 0.05, 3: 0.16, 5: 0.13}[len(_focal_scales(image))]
    return 0.012 + 0.04 * image.half_diagonal_rad, size


def _look_up(
    view: _View, catalog: StarCatalog, scale: int, patterns: Patterns
) -> tuple[list[_Candidate], list[_Candidate]]:
    """
    Candidates from `_View.patterns` and the index of one scale, the most likely first.

    Those that are almost certain, and the others.
    """
    index = pattern_index.pattern_index(catalog, scale)
    place_tolerance, size_tolerance = _tolerances(view.image)
    fits = patterns['size'] < math.log(2 * index.radius_rad) + size_tolerance
    patterns = pattern_index.equivalent(patterns[fits], place_tolerance)
    query, row = pattern_index.equal_patterns(
        index.grid, patterns, place_tolerance, size_tolerance
    )
    if len(row) > _CANDIDATES:
        few = np.random.default_rng(0).choice(len(row), _CANDIDATES, replace=False)
        row, query = row[few], query[few]
    growth = np.exp(
        np.subtract(patterns['size'][query], index.grid.patterns['size'][row], dtype=float)
    )
    stars, sources = index.stars(row), patterns['order'][query].astype(np.int64)
    rotation = _rotations(catalog.direction_icrs[stars], view.plane[sources], growth)
    # Log-likelihood ratios of the sources to those by chance, and of the stars of a pattern alone.
    gain, own = _gains(view, catalog, growth, rotation) if len(growth) else (growth, 0.0)
    best = np.argsort(-gain, kind='stable')[: 4 * _KEPT]
    # Discs share stars, so that the index has some patterns twice and more.
    _, first = np.unique(np.hstack([stars, sources])[best], axis=0, return_index=True)
    best = best[np.sort(first)][:_KEPT]
    best = best[gain[best] > _LEAST_GAIN * own]
    candidates = [
        _Candidate(stars[k], sources[k], rotation[k], view.focal_scale * float(growth[k]))
        for k in best
    ]
    count = np.count_nonzero(gain[best] > _CERTAIN_GAIN * own)
    return candidates[:count], candidates[count:]


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
    view: _View, catalog: StarCatalog, growth: Floats, rotation: Floats
) -> tuple[Floats, float]:
    """Gains (n,) of rotations (n, 3, 3) with focal lengths ``growth`` (n,), and of four stars."""
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


def _bright_about(catalog: StarCatalog, axes: Floats, radius_rad: float, count: int) -> Indices:
    """Rows (n, count) of the brightest stars within about a radius of axes (n, 3); -1 if fewer."""
    if radius_rad < _TABLED_RAD:
        stars = _bright_stars(catalog, _rounded_up(radius_rad))
        return pattern_index.brightest_within(stars, axes, radius_rad, count)
    points, rows = _bright_everywhere(catalog, radius_rad, count)
    return np.asarray(rows[points.query(axes)[1]])


def _rounded_up(radius_rad: float) -> float:
    """The next power of the root of two, so that discs of nearly one size have one search tree."""
    return float(2.0 ** (math.ceil(2.0 * math.log2(radius_rad)) / 2.0))


@functools.lru_cache(maxsize=8)
def _bright_stars(catalog: StarCatalog, radius_rad: float) -> cKDTree:
    """Search tree of the stars that discs of a radius need."""
    # The emptiest discs hold half of the mean number, which is still most of the stars tested.
    sky_by_disc = 2.0 / (1.0 - math.cos(min(radius_rad, math.pi)))
    return pattern_index.tree_of_brightest(catalog, int(5 * _TESTED * sky_by_disc))


@functools.lru_cache(maxsize=8)
def _bright_everywhere(
    catalog: StarCatalog, radius_rad: float, count: int
) -> tuple[cKDTree, Indices]:
    """Search tree of points all over the sky, and rows (p, count) of `_bright_about` for them."""
    points = pattern_index.sphere_points(int(4 * math.pi / (0.3 * radius_rad) ** 2))
    stars = _bright_stars(catalog, _rounded_up(radius_rad))
    # It holds the disc about each axis that is nearest to the point.
    wider_rad = min(1.25 * radius_rad, math.pi)
    return direction_tree(points), pattern_index.brightest_within(stars, points, wider_rad, count)
