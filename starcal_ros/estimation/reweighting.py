# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Weights from the residuals: the variance of the centroids, and what does not fit the others.

A residual is smaller than its error, because the unknowns follow it: of two axes an observation of
leverage h keeps ``2 - h`` degrees of freedom.  A bright star holds the rotation of its image and
keeps fewer than a faint one, so each observation has its own.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation.shared_errors import Groups
from starcal_ros.estimation.star_equations import squared_sigmas, StarTable

_CLIP_SIGMA = 4.5  # length of a normal residual: one in 25,000 is longer
_SCALE_LIMITS = (0.05, 400.0)  # data without noise, and centroids whose covariance means nothing
_ALIKE = 1e-9  # relative determinant below which all variances are equal but for rounding
_ROUNDS = 12
_SETTLED = 1e-3
_NODES = 5  # of the function of brightness, at quantiles
_BINS = 500  # of magnitudes, over which the function is constant to a hundredth
_STARS_PER_NODE = 40
_NODE_SIGMA = 0.5  # of the logarithm of the factor at a node, before the data
_LEAST_FREEDOM = 0.1  # of two axes: one star of few in an image


@dataclass(frozen=True)
class CentroidVariance:
    """
    Correction of the centroid covariances C: ``f(magnitude) (scale C + floor_px2 I)``.

    The floor covers errors that a centroid fit cannot see: the real shape of the PSF, the air.
    The scale corrects a wrong detector gain.  The factor f covers errors that come with
    brightness, as of saturated cores: linear between ``class_magnitude`` (k,), ascending, with
    the values ``class_factor`` (k,), and constant outside; 1 where both are empty.
    """

    scale: float
    floor_px2: float
    class_magnitude: tuple[float, ...] = ()
    class_factor: tuple[float, ...] = ()

    def of(self, covariance_px2: Floats, magnitude: NDArray[np.floating]) -> Floats:
        """Corrected covariances (n, 3) uu, uv, vv of stars of magnitudes (n,)."""
        corrected = self.scale * covariance_px2 + self.floor_px2 * np.array([1.0, 0.0, 1.0])
        return corrected * self.factor(magnitude)[:, None]

    def factor(self, magnitude: NDArray[np.floating]) -> Floats:
        """Factors (n,) on the variance of stars of magnitudes (n,)."""
        if not self.class_magnitude:
            return np.ones(len(magnitude))
        return np.asarray(np.interp(magnitude, self.class_magnitude, self.class_factor))


def estimate_variance(
    residual_px: Floats,
    covariance_px2: Floats,
    magnitude: NDArray[np.floating],
    used: Mask,
    freedom: Floats,
) -> CentroidVariance:
    """
    Scale, floor and factor by brightness that make the covariances those of the residuals.

    Parameters
    ----------
    residual_px, covariance_px2, magnitude, used : (n, 2), (n, 3), (n,), (n,) bool
        The observations that the fit used, with their covariances as measured.
    freedom : (n,)
        Degrees of freedom that the fit leaves each of them, of two.

    Notes
    -----
    Scale and floor are found by scoring: weighted least squares of the squared residuals on the
    measured variance and one, with the variance of a square as weight.  Residuals beyond 4.5
    sigma are left out.
    """
    own = 0.5 * (covariance_px2[used, 0] + covariance_px2[used, 2])
    squared = (residual_px[used] ** 2).sum(axis=1) / np.maximum(freedom[used], _LEAST_FREEDOM)
    # The median of a squared length of two normal axes is ln 2 of its mean.
    scale, floor_px2 = max(float(np.median(squared / own)) / math.log(2.0), 1e-12), 0.0
    for _ in range(_ROUNDS):
        before = scale, floor_px2
        expected = scale * own + floor_px2
        near = squared < 0.5 * _CLIP_SIGMA**2 * expected
        scale, floor_px2 = _line(own[near], squared[near], expected[near])
        if np.allclose(before, (scale, floor_px2), rtol=_SETTLED, atol=1e-12):
            break
    ratio = squared / (scale * own + floor_px2)
    nodes, factors = _brightness(ratio, np.asarray(magnitude, np.float64)[used])
    return CentroidVariance(scale, floor_px2, nodes, factors)


def _line(own: Floats, squared: Floats, expected: Floats) -> tuple[float, float]:
    """Return scale and floor of ``squared = scale own + floor``, neither negative."""
    weight = 1.0 / (expected * expected)
    weighted = weight * own
    by_own, both, by_one = float(weighted @ own), float(weighted.sum()), float(weight.sum())
    right_own, right_one = float(weighted @ squared), float(weight @ squared)
    determinant = by_own * by_one - both**2
    scale, floor_px2 = right_own / by_own, 0.0
    if determinant > _ALIKE * by_own * by_one:
        scale = (by_one * right_own - both * right_one) / determinant
        floor_px2 = (by_own * right_one - both * right_own) / determinant
    if floor_px2 < 0:
        scale, floor_px2 = right_own / by_own, 0.0
    if not _SCALE_LIMITS[0] <= scale <= _SCALE_LIMITS[1]:
        scale = float(np.clip(scale, *_SCALE_LIMITS))
        floor_px2 = max((right_one - scale * both) / by_one, 0.0)
    return scale, floor_px2


def _brightness(ratio: Floats, magnitude: Floats) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """
    Return magnitudes and factors of a smooth function of brightness.

    Scoring of the exponential likelihood of ``ratio`` (n,), squared residuals over variance, with
    a normal prior of the logarithms: few stars, or none that differ, give factors near 1.
    """
    count = min(_NODES, len(ratio) // _STARS_PER_NODE)
    if count < 2:
        return (), ()
    nodes = np.unique(np.quantile(magnitude, np.linspace(0.0, 1.0, count)))
    if len(nodes) < 2:
        return (), ()
    near = ratio < 0.5 * _CLIP_SIGMA**2
    place = np.rint((magnitude[near] - nodes[0]) / np.ptp(nodes) * _BINS).astype(np.int64)
    stars, summed = np.bincount(place), np.bincount(place, ratio[near])
    bins = nodes[0] + np.ptp(nodes) / _BINS * np.arange(len(stars))
    basis = np.stack([np.interp(bins, nodes, row) for row in np.eye(len(nodes))], axis=1)
    log_factor = np.zeros(len(nodes))
    prior = np.eye(len(nodes)) / _NODE_SIGMA**2
    for _ in range(_ROUNDS):
        scaled = summed * np.exp(-basis @ log_factor)
        gradient = basis.T @ (scaled - stars) - prior @ log_factor
        # Observed in place of expected information: monotone for a convex cost.
        step = np.linalg.solve(
            (basis * np.maximum(scaled, stars)[:, None]).T @ basis + prior, gradient
        )
        log_factor += step
        if np.abs(step).max() < _SETTLED:
            break
    return tuple(nodes.tolist()), tuple(np.exp(log_factor).tolist())


FEWEST_STARS = 3  # of an image: its rotation fits any one star, and two as good as any
_FEWEST_SIGHTINGS = 3  # of a star, from which it can be told from its images
_STAR_CHANCE = 1e-7  # that a good star is dropped for the sum of its residuals
_FEWEST_ATTITUDES = 3  # whose scatter shows that one of them does not fit
_MISFIT_SIGMA = 6.0  # of an attitude: one in 10^8 is farther off, and a jump is far larger
_MOST_OF_A_LINE = 200  # attitudes: their 20,000 pairs give a slope to a hundredth of a sigma
_MEDIAN_OF_SQUARE = 0.4549  # median of chi^2 with one degree of freedom


def fitting_stars(
    residual_px: Floats,
    covariance_px2: Floats,
    place_px2: float,
    table: StarTable,
    cells: Groups,
    outlier_sigma: float,
) -> Mask:
    """
    Return (n,) which observations are used.

    Not an outlier, unless other stars at this place of the detector show the same, which is then
    the lens; not of a star that is one in most of its images, or whose residuals together are too
    large (a wrong catalog place, a planet); and in an image that has enough of the others.

    Parameters
    ----------
    residual_px, covariance_px2 : (n, 2), (n, 3)
    place_px2 : float
        Variance per axis of the places of stars, which all images of a star share.
    cells : Groups
        Parts of the detector.
    """
    length2 = squared_sigmas(residual_px, covariance_px2)
    beside2 = _squared_beside(residual_px, covariance_px2, length2, cells, outlier_sigma)
    length2 = np.minimum(length2, beside2)
    fits = length2 < outlier_sigma**2
    star = table.star
    sightings = np.bincount(star)
    misses = np.bincount(star, ~fits)
    # The variance of the place is in every observation, but it is one error.
    own = 0.5 * (covariance_px2[:, 0] + covariance_px2[:, 2])
    share = np.minimum(place_px2 / own, 1.0)
    largest = np.bincount(star, share) / sightings * (sightings - 1) + 1.0
    summed = np.bincount(star, np.where(fits, length2, 0.0))
    bad = (2 * misses > sightings) | (summed > chdtri(2 * sightings, _STAR_CHANCE) * largest)
    fits &= ~(bad & (sightings >= _FEWEST_SIGHTINGS))[star]
    left = np.bincount(table.image[fits], minlength=table.image_count)
    return np.asarray(fits & (left[table.image] >= FEWEST_STARS))


def _squared_beside(
    residual_px: Floats, covariance_px2: Floats, length2: Floats, cells: Groups, limit: float
) -> Floats:
    """
    Squared sigmas (n,) from what other stars in the same cell of the detector show together.

    Their mean with their residuals cut at the limit, and with the observation itself as a zero:
    a lone neighbour, or a wrong one among several, moves it little.
    """
    weight = 2.0 / (covariance_px2[:, 0] + covariance_px2[:, 2])
    cut = np.minimum(1.0, limit / np.sqrt(np.maximum(length2, 1e-30)))
    total = np.bincount(cells.group, weight)[cells.group]
    shared = np.empty_like(residual_px)
    for axis in (0, 1):
        each = weight * cut * residual_px[:, axis]
        shared[:, axis] = np.bincount(cells.group, each)[cells.group] / total
        if cells.of_one_star is not None:
            shared[:, axis] -= np.bincount(cells.of_one_star, each)[cells.of_one_star] / total
    return squared_sigmas(residual_px - shared, covariance_px2)


def dropped_stars(table: StarTable, kept: Mask) -> NDArray[np.int64]:
    """Return catalog stars seen often enough to be told apart and left out of all images."""
    catalog_id, star = np.unique(table.catalog_id, return_inverse=True)
    sightings, uses = np.bincount(star), np.bincount(star, kept)
    return np.asarray(catalog_id[(sightings >= _FEWEST_SIGHTINGS) & (uses == 0)])


def misfit_images(
    error: Floats, variance: Floats, seen: Mask, star_tracker: Indices, time_ns: Indices
) -> Mask:
    """
    Return (m,) the images whose attitude does not fit the others of its star tracker.

    Parameters
    ----------
    error, variance : (m, 3)
        Attitude errors as the stars show them, in the stated sigma of each axis, and their
        variances by the centroids.
    seen : (m,) bool
        Images with stars enough.

    Notes
    -----
    Beyond 6 sigma about an axis, both of the stated sigma and of the scatter of the images about a
    line in time (Theil 1950): a star tracker that drifts has no misfits.  With more misfits than a
    third there is no majority that they could fail to fit.
    """
    misfit: Mask = np.zeros(len(seen), bool)
    for k in np.unique(star_tracker[seen]):
        here = seen & (star_tracker == k)
        if np.count_nonzero(here) < _FEWEST_ATTITUDES:
            continue
        left = error[here] - _line_in_time(time_ns[here], error[here])
        spread2 = np.median(left**2, axis=0) / _MEDIAN_OF_SQUARE
        # The spread of a dozen images may be small by half: the stated sigma bounds it too.
        usual = np.maximum(np.maximum(spread2, 1.0), variance[here])
        found = (left**2 > _MISFIT_SIGMA**2 * usual).any(axis=1)
        if 3 * np.count_nonzero(found) <= np.count_nonzero(here):
            misfit[here] = found
    return misfit


def _line_in_time(time_ns: Indices, error: Floats) -> Floats:
    """Return robust lines (k, 3) through errors (k, 3): median of slopes, median of the rest."""
    time = (time_ns - time_ns.mean()) / max(float(np.ptp(time_ns)), 1.0)
    some = np.arange(0, len(time), -(-len(time) // _MOST_OF_A_LINE))
    one, other = (some[k] for k in np.triu_indices(len(some), 1))
    apart = time[other] - time[one]
    # Neighbours in time have slopes of noise alone.
    far = np.abs(apart) > 0.25
    slope = np.zeros(3)
    if len(time) > 2 * _FEWEST_ATTITUDES and far.any():
        slope = np.median((error[other] - error[one])[far] / apart[far, None], axis=0)
    line = time[:, None] * slope
    return np.asarray(line + np.median(error - line, axis=0))
