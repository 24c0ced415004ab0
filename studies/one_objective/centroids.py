# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The errors of centroids: one likelihood of all their variances, and its posterior means.

The error of observation i is the sum of independent ones.  With C the variance as measured::

    noise            u C - r C, by a factor u that corrects the detector gain
    floor            w^2, of each observation: the shape of the PSF, the air
    place            p^2, which all sightings of a star share
    blend            r C, which sightings of a star share in proportion to their noise
    structure        q^2, which observations at one place of the detector share

so that the variance of each is ``d = f (u C + t)`` with ``t = w^2 + p^2 + q^2`` and a factor f
linear in magnitude, ``ln f = s m``, and pairs of observations have the products::

    of one star      p^2 + r sqrt(C_i C_j) + k q^2, k the correlation of structure at their places
    in one cell      q^2, of different stars

The likelihood of squares is that of restricted likelihood: with the leverage h of an observation
the derivative of the whole marginal likelihood by ``ln d`` is ``h/2 - 1 + |r|^2 / 2 d`` exactly.
That of products is normal, with the variance that they have without a common error.  Both are
sums over the observations; the posterior is then a grid in three of the logarithms.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.special import logsumexp

from starcal_ros.arrays import Floats, Indices
from starcal_ros.estimation.amplitudes import LOG_CENTRE, LOG_SIGMA, OCTAVE_SIGMA, OCTAVE_STEP
from starcal_ros.estimation.shared_errors import Groups

# Priors of logarithms: mean and 1-sigma.
SCALE = 0.0, 1.0  # detectors whose gain is stated wrong
SLOPE = 0.0, 0.3  # cores and wings of bright stars, per standard deviation of magnitudes
FLOOR = math.log(2e-3), 2.0  # px: the shape of the PSF is fitted to some thousandths of a pixel
SHARED = LOG_CENTRE, LOG_SIGMA  # px: catalogs and blends, from nothing to a tenth of a pixel
ONE_LENGTH = 0.05  # chance that structure has one length only, and does not continue the field
LARGEST_PX = 0.5
LEAST = math.log(1e-5)  # px: no effect
# Grids of logarithms: the likelihood is smooth in them, and the last pass is a tenth of a step.
_NODES, _PASSES = 14, 3
_TOTALS = 40
_BIN = 0.2  # of ln C and of standardised magnitudes: a variance within a bin differs by 10 %
_STEPS = 8  # Newton steps for scale and slope; they settle in five
_EDGE = 7.0  # log weight below the maximum at which a grid ends


@dataclass(frozen=True)
class Residuals:
    """
    Residuals of n observations, by a posterior of the unknowns.

    Attributes
    ----------
    residual_px, on_sky_px : (n, 2)
        In pixel axes, and turned so that a displacement fixed to the star keeps its direction.
    own_px2 : (n,)
        Variance per axis as measured.
    working_px2 : (n,)
        Variance whose inverse weighs products of pairs.
    magnitude : (n,)
        Standardised.
    part : (n,)
        Probability that it is no outlier.
    freedom : (n,)
        Degrees of freedom that the fit leaves, of two.
    stars, cells : Groups
    """

    residual_px: Floats
    on_sky_px: Floats
    own_px2: Floats
    working_px2: Floats
    magnitude: Floats
    part: Floats
    freedom: Floats
    stars: Groups
    cells: Groups


@dataclass(frozen=True)
class CentroidErrors:
    """
    Posterior means of the variances.

    ``scale`` u, ``total_px2`` t, ``slope`` s, ``place_px2`` p^2, ``blend`` r,
    ``structure_px2`` q^2.
    """

    scale: float
    total_px2: float
    slope: float
    place_px2: float
    blend: float
    structure_px2: float

    def variance_px2(self, own_px2: Floats, magnitude: Floats) -> Floats:
        """Variance (n,) per axis of observations."""
        factor = np.exp(self.slope * magnitude)
        return np.asarray(factor * (self.scale * own_px2 + self.total_px2))

    def share_px2(self, own_px2: Floats) -> Floats:
        """Variance (n,) per axis that sightings of a star share."""
        return np.asarray(self.place_px2 + self.blend * own_px2)


def halfway(one: CentroidErrors, other: CentroidErrors) -> CentroidErrors:
    """Return the errors in the middle between two."""
    pairs = zip(dataclasses.astuple(one), dataclasses.astuple(other), strict=True)
    return CentroidErrors(*(0.5 * (a + b) for a, b in pairs))


def centroid_errors(data: Residuals, last_octave: tuple[Floats, Floats] | None) -> CentroidErrors:
    """
    Return the posterior means of the variances.

    ``last_octave``: logarithms of the finest amplitude of the field, with weights; None before it
    is known.  Structure continues the field to shorter waves.
    """
    total = _Totals(data)
    usual_px2 = float(np.median(data.own_px2[data.part > 0.5]))
    of_star, of_cell = _star_pairs(data, usual_px2), _cell_pairs(data)
    structure_prior = _continued(last_octave)
    # Logarithms of place, blend (of a usual star) and structure, px; a blend is part of the noise.
    largest_blend = min(0.5 * math.log(usual_px2 * total.at(0.0)[0]), math.log(LARGEST_PX))
    largest = math.log(LARGEST_PX)
    bounds = [(LEAST, largest), (LEAST, largest_blend), (LEAST, largest)]
    for _ in range(_PASSES):
        axes = [_evenly(*bound, _NODES) for bound in bounds]
        logs = np.stack([one.ravel() for one in np.meshgrid(*axes, indexing='ij')])
        shares = np.exp(2.0 * logs)
        log_weight = total.log_weight(shares[0] + shares[2]) + structure_prior(logs[2])
        log_weight += of_star.log_likelihood(shares) + of_cell.log_likelihood(shares[2:])
        log_weight -= 0.5 * (((logs[:2] - SHARED[0]) / SHARED[1]) ** 2).sum(axis=0)
        weight = np.exp(log_weight - log_weight.max())
        bounds = [_likely(axes[k], weight.reshape(3 * (_NODES,)), k) for k in range(3)]
    weight /= weight.sum()
    total_px2 = float(weight @ total.mean_px2(shares[0] + shares[2]))
    place_px2, blend_px2, structure_px2 = (shares @ weight).tolist()
    scale, slope = total.at(total_px2)
    return CentroidErrors(scale, total_px2, slope, place_px2, blend_px2 / usual_px2, structure_px2)


def _evenly(first: float, last: float, count: int) -> Floats:
    """Return equidistant numbers (count,)."""
    return np.asarray(np.linspace(first, last, count), np.float64)


def _likely(axis: Floats, weight: Floats, k: int) -> tuple[float, float]:
    """Return the interval of an axis outside of which no weight matters."""
    marginal = weight.max(axis=tuple({*range(weight.ndim)} - {k}))
    some = np.flatnonzero(marginal > math.exp(-_EDGE) * marginal.max())
    first, last = max(some[0] - 1, 0), min(some[-1] + 1, len(axis) - 1)
    return float(axis[first]), float(axis[last])


def _continued(last_octave: tuple[Floats, Floats] | None) -> Callable[[Floats], Floats]:
    """Return the log prior of the logarithm of structure as a function."""

    def alone(log_px: Floats) -> Floats:
        return -0.5 * ((log_px - SHARED[0]) / SHARED[1]) ** 2 - math.log(SHARED[1])

    if last_octave is None:
        return alone
    log_px, weight = last_octave
    some = weight > 1e-6 * weight.max()
    next_px, log_share = log_px[some] + OCTAVE_STEP, np.log(weight[some] / weight.sum())

    def prior(at: Floats) -> Floats:
        flat, where = np.unique(at, return_inverse=True)
        off = (flat[:, None] - next_px) / OCTAVE_SIGMA
        chain = logsumexp(log_share - 0.5 * off**2, axis=1) - math.log(OCTAVE_SIGMA)
        value = np.logaddexp(
            chain + math.log(1.0 - ONE_LENGTH), alone(flat) + math.log(ONE_LENGTH)
        )
        return np.asarray(value[where].reshape(at.shape))

    return prior


class _Totals:
    """Likelihood of squares as a function of the variance t that all observations have alike."""

    def __init__(self, data: Residuals) -> None:
        own, magnitude = np.log(data.own_px2), data.magnitude
        key = np.rint(own / _BIN).astype(np.int64) * 1000 + np.rint(magnitude / 0.5).astype(int)
        _, bins = np.unique(key, return_inverse=True)
        used = np.maximum(data.part - 1.0 + 0.5 * data.freedom, 0.01 * data.part)
        self.count = np.bincount(bins, used)
        self.squares = 0.5 * np.bincount(bins, data.part * (data.residual_px**2).sum(axis=1))
        members = np.bincount(bins)
        self.own = np.exp(np.bincount(bins, own) / members)
        self.magnitude = np.bincount(bins, magnitude) / members
        coarse = _evenly(2.0 * LEAST, 2.0 * math.log(LARGEST_PX), _TOTALS)
        profile = self._profile(np.exp(coarse))
        first, last = _likely(coarse, np.exp(profile[0] - profile[0].max()), 0)
        fine = _evenly(first, last, _TOTALS + 1)
        log_total, order = np.unique(np.concatenate([coarse, fine]), return_index=True)
        profile = np.concatenate([profile, self._profile(np.exp(fine))], axis=1)[:, order]
        self.log_total, (self.value, self.log_scale, self.slope) = log_total, profile
        self.log_floor, self.mean_total = self._without_floor()

    def _profile(self, total_px2: Floats) -> Floats:
        """Return log likelihood, log scale and slope (3, k) at the best scale and slope."""
        start = max(float(self.squares.sum() / (self.count @ self.own)), 1e-6)
        x = np.stack([np.full(len(total_px2), math.log(start)), np.zeros(len(total_px2))])
        prior = np.array([SCALE, SLOPE]).T
        for step in range(_STEPS + 1):
            noise = np.exp(x[0])[:, None] * self.own
            d = np.exp(x[1][:, None] * self.magnitude) * (noise + total_px2[:, None])
            share, ratio = noise / (noise + total_px2[:, None]), self.squares / d
            if step == _STEPS:
                break
            off = ratio - self.count  # derivative by ln d
            off_prior = (x - prior[0][:, None]) / prior[1][:, None] ** 2
            slope = np.stack([(share * off).sum(axis=1), off @ self.magnitude]) - off_prior
            # The larger of observed and expected information: steps never overshoot.
            size = np.maximum(ratio, self.count)
            by = np.stack([share, np.broadcast_to(self.magnitude, share.shape)])
            information = np.einsum('akb,kb,ckb->kac', by, size, by)
            information += np.diag(prior[1] ** -2.0)
            step_x = np.linalg.solve(information, slope.T[:, :, None])[:, :, 0].T
            x = x + np.clip(step_x, -2.0, 2.0)
        value = -(self.count * np.log(d) + ratio).sum(axis=1)
        value -= 0.5 * (((x - prior[0][:, None]) / prior[1][:, None]) ** 2).sum(axis=0)
        return np.stack([value, *x])

    def _without_floor(self) -> tuple[Floats, Floats]:
        """Return log weight and mean of t, the floor integrated over, by the rest of t."""
        rest = np.exp(self.log_total)[:, None]
        # Floors that give the totals of the table, where the likelihood may be narrow, and others.
        left = np.maximum(rest.T - rest, np.exp(2.0 * LEAST))
        others = _evenly(2.0 * LEAST, 2.0 * math.log(LARGEST_PX), _TOTALS)
        others = np.broadcast_to(others, (len(rest), _TOTALS))
        log_floor = np.sort(np.concatenate([0.5 * np.log(left), 0.5 * others], axis=1), axis=1)
        total = rest + np.exp(2.0 * log_floor)
        value = np.interp(np.log(total), self.log_total, self.value, right=-1e300)
        value -= 0.5 * ((log_floor - FLOOR[0]) / FLOOR[1]) ** 2
        most = value.max(axis=1, keepdims=True)
        weight = np.exp(value - most) * np.gradient(log_floor, axis=1)
        summed = weight.sum(axis=1)
        return most[:, 0] + np.log(summed), (weight * total).sum(axis=1) / summed

    def log_weight(self, common_px2: Floats) -> Floats:
        """Return the log likelihood (k,) with the floor integrated over."""
        log = np.log(common_px2)
        return np.asarray(np.interp(log, self.log_total, self.log_floor, right=-np.inf))

    def mean_px2(self, common_px2: Floats) -> Floats:
        """Return the mean (k,) of t."""
        return np.asarray(np.interp(np.log(common_px2), self.log_total, self.mean_total))

    def at(self, total_px2: float) -> tuple[float, float]:
        """Return scale and slope."""
        log = math.log(max(total_px2, math.exp(self.log_total[0])))
        scale, slope = (
            np.interp(log, self.log_total, row) for row in (self.log_scale, self.slope)
        )
        return math.exp(scale), float(slope)


@dataclass(frozen=True)
class _Pairs:
    """Normal likelihood of variances x (q,): ``b' x - x' A x / 2``."""

    A: Floats
    b: Floats

    def log_likelihood(self, x: Floats) -> Floats:
        """Return the log likelihood (k,) of variances (q, k)."""
        return np.asarray(self.b @ x - 0.5 * np.einsum('ik,ij,jk->k', x, self.A, x))


def _sum_of_pairs(value: Floats, group: Indices) -> float:
    """Return the sum of the products of all pairs of values (n,) in a group, in both orders."""
    return float((np.bincount(group, value) ** 2).sum() - (value**2).sum())


def _star_pairs(data: Residuals, usual_px2: float) -> _Pairs:
    """Return the likelihood of place, blend over that of a usual star, and structure."""
    weight = data.part / data.working_px2
    together = np.broadcast_to(data.stars.together, len(weight))
    kinds = [np.ones(len(weight)), data.own_px2 / usual_px2, together]
    group, q = data.stars.group, range(3)
    A = [[_sum_of_pairs(weight * np.sqrt(kinds[i] * kinds[j]), group) for j in q] for i in q]
    b = [
        0.5 * sum(_sum_of_pairs(weight * np.sqrt(kind) * e, group) for e in data.on_sky_px.T)
        for kind in kinds
    ]
    return _Pairs(np.array(A), np.array(b))


def _cell_pairs(data: Residuals) -> _Pairs:
    """Return the likelihood of structure, by different stars in a cell."""
    weight = data.part / data.working_px2

    def apart(value: Floats) -> float:
        assert data.cells.of_one_star is not None
        own = _sum_of_pairs(value, data.cells.of_one_star)
        return _sum_of_pairs(value, data.cells.group) - own

    b = 0.5 * sum(apart(weight * e) for e in data.residual_px.T)
    return _Pairs(np.array([[max(apart(weight), 0.0)]]), np.array([b]))
