# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Variance components: the sigmas of centroids and star tracker, estimated from the residuals.

The reported covariance holds only if the variances behind it are those of the residuals.  So the
variance of the centroids and that of the star tracker are estimated again after the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import chdtr, chdtri

from starcal_ros.arrays import Floats, Mask

_STARS_PER_GROUP = 40  # mean squared residual known to 16 %, sigma to 8 %
_MOST_GROUPS = 12
_CLIP_SIGMA = 4.5  # length of a normal residual: one in 25,000 is longer
_CLASS_P_VALUE = 0.1  # of classes that differ where none do: then a factor each costs nothing
_FACTOR_LIMITS = (0.1, 100.0)
_SETTLED = 1e-3  # relative change of a round; the largest group has its variance to 1 %
_FEWEST_IMAGES = 3  # whose scatter can contradict a sigma, or one of them the others
_MISFIT_SIGMA = 6.0  # of an attitude: one in 10^8 is farther off, and a jump is far larger
_GIVEN_P_VALUE = 0.01  # of contradicting a sigma that is right
_MEDIAN_OF_SQUARE = 0.4549  # median of chi^2 with one degree of freedom


@dataclass(frozen=True)
class CentroidVariance:
    """
    Correction of the centroid covariances C: ``f(magnitude) (scale C + floor_px2 I)``.

    The floor covers errors that a centroid fit cannot see: the real shape of the PSF, the catalog,
    the air.  The scale corrects a wrong detector gain, or faint stars that scatter by more than
    their bound.  The factor f covers errors that come with brightness: saturated cores and wings,
    or noise that is not normal.  It is linear between ``class_magnitude`` (k,), ascending, with
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

    def is_close_to(self, other: CentroidVariance) -> bool:
        """Whether scale and floor agree to 1 % and factors to 2 %: no estimate moves with that."""
        nodes = np.array([*self.class_magnitude, *other.class_magnitude])
        return (
            math.isclose(self.scale, other.scale, rel_tol=0.01)
            and math.isclose(self.floor_px2, other.floor_px2, rel_tol=0.01, abs_tol=1e-8)
            and np.allclose(self.factor(nodes), other.factor(nodes), rtol=0.02)
        )


def estimate_variance(
    residual_px: Floats,
    covariance_px2: Floats,
    magnitude: NDArray[np.floating],
    used: Mask,
    free_share: float,
) -> CentroidVariance:
    """
    Scale, floor and factor by magnitude that make the centroid covariances those of the residuals.

    Parameters
    ----------
    residual_px, covariance_px2, magnitude, used : (n, 2), (n, 3), (n,), (n,) bool
        The stars that the fit used, with their covariances as measured.
    free_share : float
        Degrees of freedom left by the fit, as a share of the number of residuals.

    Notes
    -----
    The stars are ranked by their own variance and cut into groups.  The mean squared residual of
    a group, clipped at 4.5 sigma, is its variance; scale and floor are the non-negative line
    through the groups.  The mean and not the median, because stars with long tails move the
    estimate by their mean square.  Then the stars are ranked by magnitude.  Where the classes
    differ from that line (p-value 10 %) each gets a factor.  With fewer stars than two classes
    need there is one class.
    """
    own = 0.5 * (covariance_px2[used, 0] + covariance_px2[used, 2])
    squared = (residual_px[used] ** 2).sum(axis=1) / (2.0 * free_share)
    groups = int(np.clip(len(own) // _STARS_PER_GROUP, 1, _MOST_GROUPS))
    parts = np.array_split(np.argsort(own, kind='stable'), groups)
    scale, floor_px2 = _line(own, squared, parts)
    expected = np.maximum(scale * own + floor_px2, 1e-12)
    nodes, factors = _class_factors(squared / expected, np.asarray(magnitude)[used])
    return CentroidVariance(scale, floor_px2, nodes, factors)


def _line(own: Floats, squared: Floats, parts: list[NDArray[np.intp]]) -> tuple[float, float]:
    """Scale and floor of the variances: groups of stars (n,) of like variance ``own``."""
    mean_own = np.array([own[part].mean() for part in parts])
    where = _rows(parts)

    def found(scale: float, floor_px2: float) -> Floats:
        # Within a group variances differ: the ratio to their model is what has one mean.
        model = np.maximum(scale * own + floor_px2, 1e-12)
        mean_model = np.maximum(scale * mean_own + floor_px2, 1e-12)
        return np.asarray(_clipped(_in_rows(squared / model, where))[0] * mean_model)

    if len(parts) < 3 or mean_own[-1] < 2.0 * mean_own[0]:
        # Scale and floor cannot be separated: a floor when there is an excess, else a scale.
        variance = found(1.0, 0.0)
        excess = float((variance - mean_own).mean())
        if excess >= 0.0:
            return 1.0, excess
        return float(np.clip((variance / mean_own).mean(), 0.1, 1.0)), 0.0
    scale, floor_px2 = 1.0, 0.0
    for _ in range(8):
        weight = 1.0 / np.maximum(scale * mean_own + floor_px2, 1e-12)
        A = np.stack([mean_own, np.ones(len(parts))], axis=-1) * weight[:, None]
        before = scale, floor_px2
        (scale, floor_px2), _ = nnls(A, found(scale, floor_px2) * weight)
        scale = max(float(scale), 0.1)
        if np.allclose((scale, floor_px2), before, rtol=_SETTLED, atol=0.0):
            break
    return scale, float(floor_px2)


def _class_factors(
    ratio: Floats, magnitude: NDArray[np.floating]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """
    Magnitudes and variance factors of classes of stars; both empty where the classes agree.

    ``ratio`` (n,) are the squared residuals per axis over their expected variance.
    """
    parts = _magnitude_classes(magnitude)
    if len(parts) < 2 or _clipped(ratio[None])[0] < _FACTOR_LIMITS[0]:
        return (), ()  # few stars, or residuals without noise whose scale is at its limit
    nodes = np.array([magnitude[part].mean() for part in parts])
    if not (np.diff(nodes) > 0.0).all():
        return (), ()  # too many stars of one magnitude
    where = _rows(parts)
    mean, scatter = _clipped(_in_rows(ratio, where))
    # Normal noise has a variance of 1 for the mean square of two axes; tails have more.
    variance = np.maximum(1.0, scatter) / [len(part) for part in parts]
    if ((mean - 1.0) ** 2 / variance).sum() < chdtri(len(parts), _CLASS_P_VALUE):
        return (), ()
    factors = np.clip(mean, *_FACTOR_LIMITS)
    # Linear between the nodes, the mean of a class is not its node: repeated until it is.
    for _ in range(8):
        before, left = factors, ratio / np.interp(magnitude, nodes, factors)
        factors = np.clip(factors * _clipped(_in_rows(left, where))[0], *_FACTOR_LIMITS)
        if np.allclose(factors, before, rtol=_SETTLED, atol=0.0):
            break
    return tuple(nodes.tolist()), tuple(factors.tolist())


def _magnitude_classes(magnitude: NDArray[np.floating]) -> list[NDArray[np.intp]]:
    """Stars (n,) by brightness: classes that grow towards the middle, of 40 stars at the ends."""
    order = np.argsort(magnitude, kind='stable')
    for classes in range(_MOST_GROUPS, 1, -1):
        share = 0.5 * (1.0 - np.cos(np.linspace(0.0, math.pi, classes + 1)))
        if share[1] * len(order) >= _STARS_PER_GROUP:
            return np.split(order, np.rint(share[1:-1] * len(order)).astype(int))
    return [order]


def _rows(parts: list[NDArray[np.intp]]) -> NDArray[np.intp]:
    """Indices of the stars of each group as a row (groups, largest), -1 beyond its end."""
    rows = np.full((len(parts), max(map(len, parts))), -1)
    for row, part in zip(rows, parts, strict=True):
        row[: len(part)] = part
    return rows


def _in_rows(ratio: Floats, where: NDArray[np.intp]) -> Floats:
    """Values (n,) of the stars of each row, infinite beyond its end."""
    return np.asarray(np.where(where < 0, np.inf, ratio[where]))


def _clipped(ratio: Floats) -> tuple[Floats, Floats]:
    """
    Mean and variance (groups,) of rows of squared residuals over variance, within a clip.

    The clip starts at the median; the rows (groups, largest) may end with infinities.
    """
    ordered = np.sort(ratio, axis=1)
    size = np.isfinite(ordered).sum(axis=1)
    group = np.arange(len(ordered))
    finite = np.where(np.isfinite(ordered), ordered, 0.0)
    sums, squares = np.cumsum(finite, axis=1), np.cumsum(finite**2, axis=1)
    median = 0.5 * (ordered[group, (size - 1) // 2] + ordered[group, size // 2])
    # Two axes: the squared length is exponential, of median ln 2 per unit of mean.
    mean = median / math.log(2.0)
    count = np.full(len(ordered), -1)
    for _ in range(6):
        inside = (ordered <= (0.5 * _CLIP_SIGMA**2 * mean)[:, None]).sum(axis=1)
        if (inside == count).all():
            break
        # Not empty: the limit is fourteen times the median, or ten times a mean.
        count = inside
        mean = sums[group, count - 1] / count
    return mean, np.maximum(squares[group, count - 1] / count - mean**2, 0.0)


def estimate_star_tracker_sigma(
    eta_rad: Floats,
    covariance_rad2: Floats,
    seen: Mask,
    given_rad: Floats,
    star_tracker: NDArray[np.int64],
    fitted: int,
    is_given: bool,
) -> tuple[Floats, Mask]:
    """
    1-sigma of the star tracker about its axes, and the attitudes that do not fit.

    Parameters
    ----------
    eta_rad, covariance_rad2, seen : (m, 3), (m, 3, 3), (m,)
        Attitude errors from the stars alone (`image_unknowns.attitudes_of_stars_alone`).
    given_rad : (3,)
        Assumed 1-sigma; returned unchanged where fewer than three images have enough stars.
    star_tracker : (m,) int
        Which one gave each attitude: each has a mean of its own, all one sigma.
    fitted : int
        Numbers fitted to the attitudes of each axis: the mean, and a slope where there is one.
    is_given : bool
        False where the assumed sigma is a guess, which the scatter replaces in any case.

    Returns
    -------
    sigma_rad : (3,)
    misfit : (m,) bool
        Beyond 6 sigma about any axis, both of the assumed sigma and of the scatter of the images.

    Notes
    -----
    The assumed sigma stays unless the scatter of the images contradicts it (p-value 1 %): a dozen
    images give a sigma to 20 % only.  Else it is the scatter less the variance from the stars.
    Where nothing is left of that, the star tracker is better than the stars can show, and the
    result is an upper limit: the largest sigma that their scatter could hide.
    """
    own = np.einsum('mii->mi', covariance_rad2)
    if np.count_nonzero(seen) < _FEWEST_IMAGES + fitted - 1:
        return given_rad, np.zeros_like(seen)
    centred = eta_rad.copy()
    for k in np.unique(star_tracker[seen]):
        here = star_tracker == k
        centred[here] -= np.median(eta_rad[seen & here], axis=0)
    spread2 = np.median(centred[seen] ** 2, axis=0) / _MEDIAN_OF_SQUARE
    # The spread of a dozen images may be small by half: the assumed sigma bounds it too.
    usual = np.maximum(np.maximum(spread2, given_rad**2), own)
    misfit = seen & (centred**2 > _MISFIT_SIGMA**2 * usual).any(axis=1)
    if 3 * np.count_nonzero(misfit) > np.count_nonzero(seen):
        # No majority for the others to misfit: all scatter by more than was assumed.
        misfit = np.zeros_like(seen)
    good = seen & ~misfit
    count = int(np.count_nonzero(good))
    stars = own[good].mean(axis=0)
    freedom = count - fitted
    summed = np.zeros(3)
    for k in np.unique(star_tracker[good]):
        of_one = eta_rad[good & (star_tracker == k)]
        summed += ((of_one - of_one.mean(axis=0)) ** 2).sum(axis=0)
    found = summed / freedom
    p_value = chdtr(freedom, freedom * found / (given_rad**2 + stars))
    as_given = (p_value > _GIVEN_P_VALUE / 2) & (p_value < 1 - _GIVEN_P_VALUE / 2) & is_given
    hidden = stars * math.sqrt(2.0 / count)
    sigma2 = np.where(found - stars > hidden, found - stars, np.minimum(hidden, given_rad**2))
    return np.sqrt(np.where(as_given, given_rad**2, sigma2)), misfit
