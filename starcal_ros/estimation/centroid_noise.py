# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Variance of the centroids, estimated again from the residuals.

A residual is smaller than its error, because the unknowns follow it: of two axes an observation of
leverage h keeps ``2 - h`` degrees of freedom.  A bright star holds the rotation of its image and
keeps fewer than a faint one, so each observation has its own.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Mask

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
