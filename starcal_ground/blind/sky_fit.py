# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Fit of a camera and its rotation to candidate stars, and the p-value of the match.

Rotation, focal length, principal point and one term of radial distortion are fitted, each within
the range of its prior.  The p-value is an upper bound of the expected number of false matches in a
search through all rotations, focal lengths, principal points and distortions: the number of
positions in that space that differ by the radius of matching, times the probability that as many
of the brightest predictions fall near a source by chance.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import betainc

from starcal_ros.arrays import Floats, Indices
from starcal_ros.camera import CameraModel, line_of_sight, project, rotation_jacobian
from starcal_ros.camera.lens import ideal_points
from starcal_ros.sky.catalog import StarCatalog

_CROWDED = 0.15  # largest probability that a source lies by chance within the radius of matching
_TELLING = 0.08  # largest such probability at which matches decide about a candidate
_MOST_STARS = 200
_JUDGED_PX = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.5)  # radii of matching for the p-value
_DEPTHS = (6, 8, 11, 15, 20, 30, 50, 80, 130, 200)  # numbers of brightest predictions for it
_LOOKS = 10.0  # number of independent tests among these depths, which share most stars
_ORDERED = 30  # brightest matches whose order is judged: more would not change a verdict
_LATER = np.triu(np.ones((_ORDERED, _ORDERED), bool), 1)
_WIDEST_RAD = math.radians(80.0)  # largest half diagonal: sources are matched in a tangent plane
_ALONE = 10.0  # radius about a star for the local density of sources, in radii of matching


@dataclass(frozen=True)
class Ranges:
    """
    Half ranges of a prior camera.

    ``focal`` of the logarithm of the focal length, ``centre`` of the principal point in widths,
    ``distortion`` of that in the corners over the radius.  ``closing_in`` are the radii of
    matching of a fit, in half diagonals.
    """

    focal: float
    centre: float
    distortion: float
    closing_in: tuple[float, ...]


STATED = Ranges(0.25, 0.05, 0.03, (0.05, 0.04, 0.03, 0.022, 0.015, 0.01, 0.007, 0.005))
FOUND = Ranges(0.02, 0.01, 0.005, (0.01, 0.005))  # once another image gave the camera


@dataclass(frozen=True)
class SourceImage:
    """Sources (n, 2), brightest first, of an image with a prior camera and its ranges."""

    xy_px: Floats
    camera: CameraModel
    ranges: Ranges = STATED

    @functools.cached_property
    def half_diagonal_px(self) -> float:
        """Half of the diagonal, px."""
        return 0.5 * math.hypot(self.camera.width, self.camera.height)

    @functools.cached_property
    def half_diagonal_rad(self) -> float:
        """Mean angle of the corners from the axis of the prior camera."""
        x, y = self.camera.width - 0.5, self.camera.height - 0.5
        corners = np.array([[-0.5, -0.5], [x, -0.5], [-0.5, y], [x, y]])
        cosine = line_of_sight(self.camera, corners)[:, 2]
        # A corner that a strong distortion folds over has no line of sight.
        seen = cosine[np.isfinite(cosine)]
        return min(float(np.arccos(seen).mean()), _WIDEST_RAD) if len(seen) else _WIDEST_RAD

    @functools.cached_property
    def area_px2(self) -> float:
        """Area of the image, px^2."""
        return float(self.camera.width * self.camera.height)

    @functools.cached_property
    def tree(self) -> cKDTree:
        """Search tree of the sources."""
        return cKDTree(self.xy_px)


@dataclass(frozen=True)
class SkyFit:
    """Camera, rotation, and catalog rows (n,) of the brightest stars that may be in the image."""

    camera_from_icrf: Rotation
    camera: CameraModel
    stars: Indices


def refined(
    image: SourceImage, catalog: StarCatalog, start: SkyFit, pairs: Indices
) -> SkyFit | None:
    """
    Fit from a start with decreasing radius of matching; None once it looks like chance.

    ``pairs`` (k, 2), rows of the catalog and of the sources, belong to the start.
    """
    fit, prior = start, image.camera
    half_px = image.half_diagonal_px
    fit = _step(image, catalog, fit, pairs, 0.02 * half_px)
    for part in image.ranges.closing_in:
        radius_px = max(part * half_px, 2.0)
        sources = int(_CROWDED * image.area_px2 / (math.pi * radius_px**2)) + 6
        stars, xy_px = predicted(catalog, fit, 2 * min(sources, len(image.xy_px)))
        rank, source, _ = mutual(image, xy_px, radius_px, sources)
        if _like_chance(image, rank, radius_px, sources):
            return None
        pairs = np.stack([stars[rank], source], axis=-1)
        fit = _step(image, catalog, fit, pairs, radius_px / 3)
        fx = float(fit.camera.parameters[0])
        if abs(math.log(fx / float(prior.parameters[0]))) > 1.3 * image.ranges.focal:
            return None
    for _ in range(2):
        stars, xy_px = predicted(catalog, fit, _MOST_STARS)
        rank, source, _ = mutual(image, xy_px, 4.5, _MOST_STARS)
        if len(rank) < 5:
            return None
        fit = _step(image, catalog, fit, np.stack([stars[rank], source], axis=-1), 1.0)
    return fit


def _like_chance(image: SourceImage, rank: Indices, radius_px: float, sources: int) -> bool:
    """
    True if chance explains that the predictions ``rank`` (k,) have a source nearby.

    Judged only at radii at which few random places are near a source: at larger ones, sources
    without a star (such as the structure of a corona) hide the others.  Accepted fits of six stars
    among twelve false sources stayed below the limit by a factor of two.
    """
    if len(rank) < 5:
        return True
    one = _evenly(image, radius_px, sources)
    if one > _TELLING:
        return False
    hits, depth = np.arange(5, len(rank) + 1), rank[4:] + 1
    tail = betainc(hits, depth - hits + 1, one)
    limit = betainc(5, 12 - 5 + 1, _evenly(image, radius_px, 18))  # P(Binomial(12, q) >= 5)
    return float(tail.min()) > float(limit)


def _evenly(image: SourceImage, radius_px: float, sources: int) -> float:
    """Probability that one of a number of evenly spread sources lies within a radius."""
    return min(1.0, min(sources, len(image.xy_px)) * math.pi * radius_px**2 / image.area_px2)


def predicted(catalog: StarCatalog, fit: SkyFit, most: int) -> tuple[Indices, Floats]:
    """Catalog rows (n,) of the brightest stars in the image, and their pixels (n, 2)."""
    # Most often the brightest stars suffice: a third of a disc is in the image.
    for stars in (fit.stars[: 4 * most], fit.stars):
        u, v = _pixels(fit, catalog.direction_icrs[stars]).T
        inside = (u > -0.5) & (u < fit.camera.width - 0.5)
        inside &= (v > -0.5) & (v < fit.camera.height - 0.5)
        rank = np.flatnonzero(inside)[:most]
        if len(rank) == most or len(stars) == len(fit.stars):
            break
    return stars[rank], np.stack([u[rank], v[rank]], axis=-1)


def _pixels(fit: SkyFit, directions_icrs: Floats) -> Floats:
    """Pixels (n, 2) of directions (n, 3); NaN behind a perspective lens."""
    return project(fit.camera, directions_icrs @ fit.camera_from_icrf.as_matrix().T)


def mutual(
    image: SourceImage, xy_px: Floats, radius_px: float, most_sources: int
) -> tuple[Indices, Indices, Floats]:
    """Rows of the mutually nearest predictions (n, 2) and sources, and their distances, px."""
    return _nearest(_apart(image, xy_px, radius_px), len(xy_px), most_sources)


Apart = tuple[Indices, Indices, Floats]
"""Rows of predictions and of sources, and their distances, px."""


def _apart(image: SourceImage, xy_px: Floats, radius_px: float) -> Apart:
    """All predictions (n, 2) and sources within a radius, in the order of the predictions."""
    pairs = cKDTree(xy_px).sparse_distance_matrix(image.tree, radius_px, output_type='ndarray')
    pairs = pairs[np.argsort(pairs['i'], kind='stable')]
    return pairs['i'], pairs['j'], pairs['v']


def _nearest(apart: Apart, most: int, most_sources: int) -> Apart:
    """Those of the first predictions and sources that are mutually nearest."""
    rank, source, apart_px = apart
    among = (rank < most) & (source < most_sources)
    rank, source, apart_px = rank[among], source[among], apart_px[among]
    of_rank, of_source = np.full((2, max(most, most_sources)), np.inf)
    np.minimum.at(of_rank, rank, apart_px)
    np.minimum.at(of_source, source, apart_px)
    good = np.flatnonzero((apart_px == of_rank[rank]) & (apart_px == of_source[source]))
    # Catalogs of double stars list several at one place: the brightest is kept.
    good = np.sort(good[np.unique(source[good], return_index=True)[1]])
    return rank[good], source[good], apart_px[good]


def _step(
    image: SourceImage, catalog: StarCatalog, fit: SkyFit, pairs: Indices, scale_px: float
) -> SkyFit:
    """One robust Gauss-Newton step; ``scale_px`` is the expected residual of a pair."""
    directions = catalog.direction_icrs[pairs[:, 0]]
    N, b, _ = star_equations(
        fit.camera, fit.camera_from_icrf, directions, image.xy_px[pairs[:, 1]], scale_px
    )
    N_prior, b_prior = prior_equations(fit.camera, image.camera, image.ranges)
    N[range(3, 7), range(3, 7)] += N_prior
    b[3:] += b_prior
    N[range(7), range(7)] *= 1.0 + 1e-12
    step = np.linalg.solve(N, b).astype(np.float64)
    camera = moved(fit.camera, image.camera, step[3:], image.ranges.centre * image.camera.width)
    return SkyFit(Rotation.from_rotvec(-step[:3]) * fit.camera_from_icrf, camera, fit.stars)


def star_equations(
    camera: CameraModel,
    camera_from_icrf: Rotation,
    directions_icrs: Floats,
    xy_px: Floats,
    scale_px: float,
) -> tuple[Floats, Floats, Floats]:
    """
    Normal matrix (7, 7) and right side (7,) of stars (n, 3) measured at (n, 2), residuals (2, n).

    By the rotation, the logarithm of the focal length, the principal point, px, and ``k1`` as
    displacement in the corner over the radius there.  Residuals far over ``scale_px`` count less.
    """
    half_px = 0.5 * math.hypot(camera.width, camera.height)
    fx, skew, fy, cx, cy = camera.intrinsics.tolist()
    directions = directions_icrs @ camera_from_icrf.as_matrix().T
    ideal = ideal_points(camera.model, directions)
    xd, yd = camera.lens.distort(ideal, camera.distortion).T
    x_by_k1, y_by_k1 = (fx / half_px) ** 2 * (
        camera.lens.by_coefficients(ideal, camera.distortion)[:, 0]
    )
    J = np.zeros((2, len(ideal), 7))
    J[:, :, :3] = rotation_jacobian(camera, directions).transpose(1, 0, 2)
    J[0, :, 3], J[1, :, 3] = fx * xd, fy * yd
    J[0, :, 4] = J[1, :, 5] = 1.0
    J[0, :, 6], J[1, :, 6] = fx * x_by_k1 + skew * y_by_k1, fy * y_by_k1
    residual_px = xy_px.T - [fx * xd + skew * yd + cx, fy * yd + cy]
    weight = 1.0 / (scale_px**2 + (residual_px**2).sum(axis=0) / 4)
    weighted = (J * weight[:, None]).reshape(-1, 7).T
    return weighted @ J.reshape(-1, 7), weighted @ residual_px.reshape(-1), residual_px


def prior_equations(
    camera: CameraModel, prior: CameraModel, ranges: Ranges
) -> tuple[Floats, Floats]:
    """Diagonal (4,) and right side (4,) of a prior camera for the last unknowns of a star."""
    half_px = 0.5 * math.hypot(camera.width, camera.height)
    (fx, _, _, cx, cy, k1), before = camera.parameters[:6].tolist(), prior.parameters[:6].tolist()
    part = (k1 - before[5]) * (half_px / fx) ** 2
    off = [math.log(before[0] / fx), before[3] - cx, before[4] - cy, -part]
    centre_px = ranges.centre * prior.width
    held = (1.7 / np.array([ranges.focal, centre_px, centre_px, ranges.distortion])) ** 2
    return held, held * off


def moved(camera: CameraModel, prior: CameraModel, step: Floats, centre_px: float) -> CameraModel:
    """A camera after a step (4,) of at most 22 %, ``centre_px`` and 5 % of the radius."""
    half_px = 0.5 * math.hypot(camera.width, camera.height)
    growth = math.exp(_within(float(step[0]), 0.2))
    changed = camera.parameters.copy()
    before = float(prior.parameters[5])
    part = (float(changed[5]) - before) * (half_px / float(changed[0])) ** 2
    changed[[0, 2]] *= growth
    changed[3] += _within(float(step[1]), centre_px)
    changed[4] += _within(float(step[2]), centre_px)
    part += _within(float(step[3]), 0.05)
    changed[5] = before + part * (float(changed[0]) / half_px) ** 2
    return dataclasses.replace(camera, parameters=changed)


def _within(value: float, limit: float) -> float:
    """Value clipped to a limit on both sides."""
    return min(max(value, -limit), limit)


def log10_p_value(image: SourceImage, catalog: StarCatalog, fit: SkyFit) -> tuple[float, float]:
    """
    Decadic logarithm of the expected number of false matches this good, and its radius, px.

    Infinite with fewer than five stars near their predictions.
    """
    _, xy_px = predicted(catalog, fit, _MOST_STARS)
    radii_px = np.array(_JUDGED_PX)
    apart = _apart(image, xy_px, _ALONE * _JUDGED_PX[-1])
    # Probability that another source lies within a radius, from the density about each star.
    near = [np.bincount(apart[0][apart[2] < _ALONE * r], minlength=len(xy_px)) for r in _JUDGED_PX]
    crowded = np.minimum((np.maximum(near, 1) - 1) / _ALONE**2, 1.0)
    close = apart[2] < _JUDGED_PX[-1]
    apart = apart[0][close], apart[1][close], apart[2][close]
    positions = np.array([_log10_positions(image, radius_px) for radius_px in _JUDGED_PX])
    best, best_radius_px = math.inf, _JUDGED_PX[-1]
    for n in [n for n in _DEPTHS if n < len(xy_px)] + [len(xy_px)]:
        sources = min(len(image.xy_px), 4 * n)
        _, source, apart_px = _nearest(apart, n, sources)
        hits = np.count_nonzero(apart_px < radii_px[:, None], axis=1)
        enough = np.flatnonzero(hits >= 5)
        if not len(enough):
            continue
        hits = hits[enough]
        _, first, same = np.unique(hits, return_index=True, return_inverse=True)
        order = [_chance_of_order(source[apart_px < radii_px[enough[k]]]) for k in first]
        # The mean over the stars; those among many sources have their local density.
        evenly = np.array([_evenly(image, radius_px, sources) for radius_px in radii_px[enough]])
        q = np.maximum(crowded[enough, :n], evenly[:, None]).mean(axis=1)
        tail = betainc(hits, n - hits + 1, q)  # P(Binomial(n, q) >= hits)
        chance = np.maximum(_LOOKS * tail * np.array(order)[same], 1e-300)
        log10_p = np.log10(chance) + positions[enough]
        k = int(np.argmin(log10_p))
        if log10_p[k] < best:
            best, best_radius_px = float(log10_p[k]), _JUDGED_PX[enough[k]]
    return best, best_radius_px


def _chance_of_order(source: Indices) -> float:
    """
    Probability that matched sources are by chance as well sorted by brightness as these (k,).

    Sources are numbered by brightness and given in the order of their stars, brightest first.  The
    measure is the number of pairs in wrong order, for which all permutations are equally likely by
    chance (Kendall 1938, Biometrika 30, 81).
    """
    brightest = source[:_ORDERED]
    k = len(brightest)
    wrong = (brightest[:, None] > brightest) & _LATER[:k, :k]
    return float(_orderings(k)[np.count_nonzero(wrong)])


@functools.lru_cache(maxsize=_ORDERED)
def _orderings(count: int) -> Floats:
    """Probability that a permutation of ``count`` has at most 0, 1, ... pairs in wrong order."""
    share: Floats = np.ones(1)
    for k in range(2, count + 1):
        # The last of k is in the wrong order to none, one, ... or all of the others.
        share = np.convolve(share, np.full(k, 1.0 / k))
    return np.minimum(np.cumsum(share), 1.0)


def _log10_positions(image: SourceImage, radius_px: float) -> float:
    """Decadic logarithm of the number of fits that differ by the radius of matching."""
    half_px, f_px = image.half_diagonal_px, float(image.camera.parameters[0])
    tilts_and_roll = 8 * math.pi**2 * f_px**2 * half_px / radius_px**3
    # Those of a stated camera for a found one too: it may be of a false match.
    focal = 2 * STATED.focal * half_px / radius_px
    distortion = 2 * STATED.distortion * half_px / radius_px
    # A shift of the principal point equals a rotation to first order; the rest is the second
    # order of the projection and of the distortion.
    shape = (half_px / f_px) ** 2 + 3 * STATED.distortion
    centre = 2 * STATED.centre * image.camera.width * shape / radius_px
    return math.log10(
        max(tilts_and_roll, 1.0) * max(focal, 1.0) * max(distortion, 1.0) * max(centre, 1.0) ** 2
    )
