# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Variance of centroids from the residuals of a round of the estimate."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Mask
from starcal_ros.estimation.limits import MOST_ROUNDS, ROUNDING, STEP_SIGMA

_SCALE_LIMITS = (0.05, 400.0)  # data without noise, and centroids whose covariance means nothing
# Nodes of the factor as a function of magnitude, at quantiles.  Without that function, halves of
# two real sets differ by 1.19 and 1.92 of their sigma, with it by 1.01 and 1.75.
_NODES = 5
_BINS = 500  # bins of magnitude, in which that function is constant to a hundredth
_NODE_SIGMA = 0.5  # prior 1-sigma of a log factor: cores and wings of bright stars
_LEAST_FREEDOM = 0.1  # floor of the freedom of two axes: one star of few keeps none


@dataclass(frozen=True)
class CentroidVariance:
    """
    Correction of the centroid covariances C: ``f(magnitude) (scale C + floor_px2 I)``.

    The floor covers errors that a centroid fit cannot see: the real shape of the PSF, the air.
    The scale corrects a wrong detector gain.  The factor f covers errors that come with
    brightness, as of saturated cores: linear between ``class_magnitude`` (k,), ascending, with the
    values ``class_factor`` (k,), and constant outside; 1 where both are empty.

    ``floor_sigma_px2``: 1-sigma of the floor, with the scale unknown.
    """

    scale: float
    floor_px2: float
    class_magnitude: tuple[float, ...] = ()
    class_factor: tuple[float, ...] = ()
    floor_sigma_px2: float = math.inf

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
    outlier_sigma: float,
) -> CentroidVariance:
    """
    Scale, floor and factor by brightness that make the covariances those of the residuals.

    Parameters
    ----------
    residual_px, covariance_px2, magnitude, used : (n, 2), (n, 3), (n,), (n,) bool
        The observations that the fit used, with their covariances as measured.
    freedom : (n,)
        Degrees of freedom that the fit leaves each of them, of two.
    outlier_sigma : float
        Length of a residual beyond which it is an outlier.

    Notes
    -----
    Scale and floor maximise the restricted likelihood of the residuals, whose gradient is the sum
    of ``freedom / 2 (square / freedom - variance) / variance^2`` times the derivatives of the
    variance: weighted least squares of squares over freedom on the measured variance and one, the
    weights renewed, with less of a square near that of an outlier (`_part`).
    """
    own = 0.5 * (covariance_px2[used, 0] + covariance_px2[used, 2])
    left = np.maximum(freedom[used], _LEAST_FREEDOM)
    squared = (residual_px[used] ** 2).sum(axis=1) / left
    # The median of a squared length of two normal axes is ln 2 of its mean.
    scale, floor_px2 = max(float(np.median(squared / own)) / math.log(2.0), 1e-12), 0.0
    for _ in range(MOST_ROUNDS):
        expected = scale * own + floor_px2
        weight = 0.5 * left * _part(squared / expected, outlier_sigma) / expected**2
        scale, floor_px2, floor_sigma_px2 = _line(own, squared, weight)
        step = scale * own + floor_px2 - expected
        if weight @ step**2 < STEP_SIGMA**2:
            break
    ratio = squared / (scale * own + floor_px2)
    counted = 0.5 * left * _part(ratio, outlier_sigma)
    nodes, factors = _brightness(ratio, counted, np.asarray(magnitude, np.float64)[used])
    return CentroidVariance(scale, floor_px2, nodes, factors, floor_sigma_px2)


def _part(ratio: Floats, outlier_sigma: float) -> Floats:
    """
    Return the part of squared residuals over variance (n,) that counts.

    Half at the limit of outliers, 4.5 sigma, all to 4.1 and none from 4.9.
    One at an edge would count and not count in turns, and the estimate with it.
    """
    return np.asarray(np.clip(3.5 - 3.0 * ratio / (0.5 * outlier_sigma**2), 0.0, 1.0))


def _line(own: Floats, squared: Floats, weight: Floats) -> tuple[float, float, float]:
    """
    Return scale and floor of ``squared = scale own + floor``, not negative, and the floor's sigma.

    The weights are inverse variances.
    """
    weighted = weight * own
    by_own, both, by_one = float(weighted @ own), float(weighted.sum()), float(weight.sum())
    right_own, right_one = float(weighted @ squared), float(weight @ squared)
    determinant = by_own * by_one - both**2
    scale, floor_px2 = right_own / by_own, 0.0
    sigma_px2 = math.inf
    if determinant > ROUNDING * by_own * by_one:  # not all variances are equal
        scale = (by_one * right_own - both * right_one) / determinant
        floor_px2 = (by_own * right_one - both * right_own) / determinant
        sigma_px2 = math.sqrt(by_own / determinant)
    if floor_px2 < 0:
        scale, floor_px2 = right_own / by_own, 0.0
    if not _SCALE_LIMITS[0] <= scale <= _SCALE_LIMITS[1]:
        scale = float(np.clip(scale, *_SCALE_LIMITS))
        floor_px2 = max((right_one - scale * both) / by_one, 0.0)
    return scale, floor_px2, sigma_px2


def _brightness(
    ratio: Floats, counted: Floats, magnitude: Floats
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """
    Return magnitudes and factors of a smooth function of brightness.

    Scoring of the exponential likelihood of ``ratio`` (n,), squared residuals over variance, of
    which each counts as ``counted`` (n,) stars, with a normal prior of the logarithms: few stars,
    or none that differ, give factors near 1.
    """
    nodes = np.unique(np.quantile(magnitude, np.linspace(0.0, 1.0, _NODES)))
    if len(nodes) < 2:
        return (), ()
    place = np.rint((magnitude - nodes[0]) / np.ptp(nodes) * _BINS).astype(np.int64)
    stars, summed = (np.bincount(place, counted * one) for one in (1.0, ratio))
    bins = nodes[0] + np.ptp(nodes) / _BINS * np.arange(len(stars))
    basis = np.stack([np.interp(bins, nodes, row) for row in np.eye(len(nodes))], axis=1)
    log_factor = np.zeros(len(nodes))
    prior = np.eye(len(nodes)) / _NODE_SIGMA**2
    for _ in range(MOST_ROUNDS):
        scaled = summed * np.exp(-basis @ log_factor)
        gradient = basis.T @ (scaled - stars) - prior @ log_factor
        # Observed in place of expected information: monotone for a convex cost.
        step = np.linalg.solve(
            (basis * np.maximum(scaled, stars)[:, None]).T @ basis + prior, gradient
        )
        log_factor = np.clip(log_factor + step, *np.log(_SCALE_LIMITS))
        if gradient @ step < STEP_SIGMA**2:
            break
    return tuple(nodes.tolist()), tuple(np.exp(log_factor).tolist())
