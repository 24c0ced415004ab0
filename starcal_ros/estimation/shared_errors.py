# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Errors that stars of different images share: places of stars, and patterns of the detector.

The observations of a group share one random displacement: those of a catalog star its error of
place, those of a cell of the detector the structure of the lens and the sensor that is finer than
the field.  Such errors need no coefficients.  Their variance is the mean
product of residuals of different members of a group::

    s^2 = [sum_g |sum w r|^2 - sum_i |w r|^2] / [2 (sum_g (sum w)^2 - sum_i w^2)],

with the posterior mean of s^2 under the prior of amplitudes in place of an estimate.  A linear
estimator with weights W has the exact covariance ``S^-1 (X' W V W X) S^-1`` under errors of
covariance V (consider analysis, Schmidt 1966); groups are the off-diagonal part of V.

Sightings i and j of a star share the variance ``c^2 + rho sigma_i sigma_j``: the error of its
catalog place, and displacements of its centroids in proportion to their own sigma, by stars below
the limit of the catalog, the phase of the pixel and its colour.  A few blended stars have most
of it: each star has a factor on its variance, as the errors of Student's t have (Lange, Little &
Taylor 1989).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import functools
from itertools import pairwise
import math

import numpy as np
from scipy.sparse import csr_array

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation.amplitudes import (
    LARGEST_FIELD_PX,
    log_amplitudes,
    LogPrior,
    OCTAVE_SIGMA,
    OCTAVE_STEP,
)
from starcal_ros.estimation.limits import MOST_ROUNDS, NEGLIGIBLE, ROUNDING
from starcal_ros.estimation.unknowns import FIELD_OCTAVES

# An octave is seen in cells of a sixth of its longest wave, over which it keeps nine tenths of its
# correlation.
_CELLS_PER_WAVE = 6.0
_OF_ONE_LENGTH = 0.05  # chance that an octave leaves the chain: a ripple has one length only
_TAIL = 2.0  # degrees of freedom of the errors of stars
_LOG_GRID = log_amplitudes(LARGEST_FIELD_PX)
_PRIOR: Floats = np.exp(LogPrior().log_density(_LOG_GRID))


@dataclass(frozen=True)
class SharedError:
    """
    One kind of groups and the error that its members share.

    Attributes
    ----------
    name : str
    group : (n,) int
        Number of the group of each observation.
    share_px2 : (n,)
        Variance per axis that each observation shares, posterior mean.
    likelihood_ratio : float
        Twice the log likelihood of the best variance against none.
    of_star : bool
        Displacements keep their direction on the sky, not on the detector; they move no pixel.
    effect : float
        Variance of the mean of a group by the shared error, over that by noise.
    beyond_px2 : (n,) or float
        Part of ``share_px2`` by which a star differs from others of its brightness.
    """

    name: str
    group: Indices
    share_px2: Floats
    likelihood_ratio: float
    of_star: bool
    effect: float
    beyond_px2: Floats | float = 0.0

    @property
    def variance_px2(self) -> float:
        """Mean variance per axis that an observation shares."""
        return float(self.share_px2.mean())

    @property
    def matters(self) -> bool:
        """
        True if the precision of an estimate changes by the error.

        In thousands of images, places of stars that are seen a hundred times add 1 % to a
        variance, and take a third of the time.
        """
        return self.effect > NEGLIGIBLE


@dataclass(frozen=True)
class Groups:
    """
    One kind of groups of n observations.

    ``group`` (n,): the number of the group of each; ``of_one_star`` (n,): a number for the members
    of a group that show one star, whose common error belongs to the star; None if all do.
    ``together`` (n,): correlation of the first of the fine octaves between sightings of the star.
    """

    name: str
    group: Indices
    of_one_star: Indices | None
    together: Floats | float = 0.0


def observation_groups(pixels: Floats, star: Indices, width: int) -> tuple[Groups, ...]:
    """
    Return the groups of observations at pixels (n, 2) of stars (n,) on a detector of a width, px.

    The stars, and the cells of the octaves of waves that are too short for the field.
    """
    found = [Groups('star places', star, None, _together(pixels, star, width))]
    for wave_px in _fine_waves_px(width):
        cells = _cells(pixels, wave_px / _CELLS_PER_WAVE)
        name = f'field at 1/{round(width / wave_px)} of the width'
        found.append(Groups(name, cells, pairs_of(cells, star)))
    return tuple(found)


def _fine_waves_px(width: int) -> list[float]:
    """Return the longest waves of the octaves below those of the field, as many as it has."""
    shortest_px = width / 2 ** (FIELD_OCTAVES - 1)
    return [shortest_px / 2**k for k in range(FIELD_OCTAVES)]


def coarsest_cell_px(width: int) -> float:
    """Return the side of the largest cells: over it, no wave of the field changes much."""
    return _fine_waves_px(width)[0] / _CELLS_PER_WAVE


def _together(pixels: Floats, star: Indices, width: int) -> Floats:
    """Return `Groups.together` (n,), as of a wave: by the scatter of a star over the detector."""
    sightings = np.bincount(star)[star]
    off = [pixel - np.bincount(star, pixel)[star] / sightings for pixel in pixels.T]
    spread_px2 = np.bincount(star, off[0] ** 2 + off[1] ** 2)[star] / sightings
    usual_px = _fine_waves_px(width)[0] / (2.0 * math.pi * math.sqrt(2.0))
    return np.asarray(np.exp(-spread_px2 / usual_px**2))


def pairs_of(group: Indices, star: Indices) -> Indices:
    """Return a number (n,) for each pair of group and star."""
    key = group.astype(np.int64) * (int(star.max(initial=0)) + 1) + star
    return np.asarray(np.unique(key, return_inverse=True)[1], np.int64)


def shared_errors(
    residual_px: Floats,
    variance_px2: Floats,
    used: Mask,
    groups: Sequence[Groups],
    from_sky: Floats,
    last_octave: tuple[Floats, Floats],
    floor_px2: tuple[float, float],
) -> tuple[SharedError, ...]:
    """
    Return the errors that observations share.

    Parameters
    ----------
    residual_px : (n, 2)
    variance_px2 : (n,)
        Variance of each residual per axis.
    used : (n,) bool
    groups : sequence of Groups
        From `observation_groups`.
    from_sky : (n, 2, 2)
        Rotation of a displacement fixed to the star into pixel axes.
    last_octave : (s,), (s,)
        Posterior of the logarithm of the finest amplitude of the field, with weights.
    floor_px2 : (estimate, 1-sigma)
        Variance per axis that all centroids have beyond their own.
    """
    star = groups[0].group
    sightings = np.maximum(np.bincount(star, used)[star], 1.0)
    on_sky = np.einsum('nba,nb->na', from_sky, residual_px)
    usual_px2: Floats = np.zeros(len(star))
    for _ in range(2):  # all sightings of a star weigh less, the more they share
        working = np.where(used, 1.0 / (variance_px2 + (sightings - 1.0) * usual_px2), 0.0)
        place_px2, rho, of_stars, of_places = _of_stars(on_sky, working, variance_px2, star)
        usual_px2 = np.minimum(place_px2 + rho * variance_px2, variance_px2)
    weight = np.where(used, 1.0 / variance_px2, 0.0)
    share_px2 = usual_px2 * _factors(on_sky, weight, usual_px2, star)
    found = [_error(groups[0], weight, share_px2, of_stars, share_px2 - usual_px2)]
    # Two stars that are in the same cell again and again are one pair.
    variance_px2 = variance_px2 + sightings * share_px2 - usual_px2
    weight = np.where(used, 1.0 / variance_px2, 0.0)
    moments = [
        pair_moment(residual_px, weight, kind.group, kind.of_one_star) for kind in groups[1:]
    ]
    # The error of a star that stays at one place may come from the star or from the detector.
    together = max(_pairs(working * np.sqrt(groups[0].together), star), 0.0)
    share = together / max(_pairs(working, star), together, 1e-300)
    first = last_octave[1] @ _next_octave(last_octave[0]) * _beside_stars(of_places, share)
    # The errors of stars are a part of the floor too.
    excess_px2 = max(floor_px2[0] - float(usual_px2[used].mean()), 0.0)
    variances = chain_means(first, _increments(moments), (excess_px2, floor_px2[1]))
    for kind, moment, variance in zip(groups[1:], moments, variances, strict=True):
        ratio = max(moment[0] / moment[1], 0.0) ** 2
        found.append(_error(kind, weight, np.full(len(weight), variance), ratio, 0.0))
    return tuple(found)


def _error(
    kind: Groups, weight: Floats, share_px2: Floats, ratio: float, beyond_px2: Floats | float
) -> SharedError:
    """Return an error of groups with its effect, by the weights (n,)."""
    common = np.bincount(kind.group, weight * np.sqrt(share_px2))
    effect = float((common**2).sum() / weight.sum())
    group = np.where(weight > 0, kind.group, -1)
    of_star = kind.of_one_star is None
    return SharedError(kind.name, group, share_px2, ratio, of_star, effect, beyond_px2)


def _of_stars(
    on_sky: Floats, weight: Floats, variance_px2: Floats, star: Indices
) -> tuple[float, float, float, Floats]:
    """
    Return ``c^2``, px^2, rho, twice their log likelihood ratio, and the likelihood (g,) of c.

    ``c^2`` and rho of the sightings of stars are posterior means: products of pairs of residuals
    on the sky are fitted by 1 and by the product of their sigmas over that of a usual star.
    """
    usual_px2 = float(np.median(variance_px2[weight > 0]))
    root = weight * np.sqrt(variance_px2 / usual_px2)
    constant, both, relative = (
        _pairs(one, star) for one in (weight, root, weight * variance_px2 / usual_px2)
    )
    by_constant, by_relative = (
        0.5 * (_pairs(one * on_sky[:, 0], star) + _pairs(one * on_sky[:, 1], star))
        for one in (weight, root)
    )
    log_likelihood = np.zeros((len(_LOG_GRID), len(_LOG_GRID)))
    x = np.exp(2.0 * _LOG_GRID)
    if constant > ROUNDING * float((weight**2).sum()):
        log_likelihood -= both * np.outer(x, x)
        log_likelihood += (by_constant * x - 0.5 * constant * x**2)[:, None]
        log_likelihood += by_relative * x - 0.5 * relative * x**2
    log_likelihood[:, x > usual_px2] = -np.inf  # sightings share no more than their variance
    most = float(log_likelihood.max())
    likely = np.exp(log_likelihood - most) * _PRIOR
    of_places = likely.sum(axis=1)
    likely = likely * _PRIOR[:, None] / (_PRIOR @ of_places)
    return (
        float(likely.sum(axis=1) @ x),
        float(likely.sum(axis=0) @ x) / usual_px2,
        max(2.0 * most, 0.0),
        of_places,
    )


def _beside_stars(of_places: Floats, share: float) -> Floats:
    """
    Return the likelihood (g,) of structure s of the detector, by that of c (g,).

    Sightings of a star share ``c^2 + share s^2``, with the correlation of the structure.
    """
    x = np.exp(2.0 * _LOG_GRID)
    likelihood = np.interp(0.5 * np.log(x[:, None] + share * x), _LOG_GRID, of_places)
    return np.asarray(_PRIOR @ likelihood / (_PRIOR @ of_places))


def _pairs(value: Floats, group: Indices) -> float:
    """Return the sum of the products of all pairs of values (n,) in a group, in both orders."""
    return float((np.bincount(group, value) ** 2).sum() - (value**2).sum())


def _factors(on_sky: Floats, weight: Floats, share_px2: Floats, star: Indices) -> Floats:
    """
    Return factors (n,) on the variances that sightings of a star share, 1 in the mean.

    By expectation and maximisation from the mean residuals of stars; 1 for a star of one sighting,
    where noise and shared error are the same.
    """
    count = int(star.max(initial=0)) + 1
    total, squares = np.bincount(star, weight, count), np.bincount(star, weight**2, count)
    factor = np.ones(count)
    several = np.flatnonzero(total**2 - squares > ROUNDING * total**2)
    if len(several) == 0:
        return factor[star]
    total, squares = total[several], squares[several]
    s, u, v = (
        np.bincount(star, weight * value, count)[several] / total
        for value in (share_px2, *on_sky.T)
    )
    squared, pairs = u**2 + v**2, (total**2 - squares) * s
    # The variance of a residual has the shared part in it.
    e = np.maximum(1.0 / total - s * squares / total**2, ROUNDING / total)
    own = np.ones(len(s))
    for _ in range(MOST_ROUNDS):
        before, gain = own, own * s / (own * s + e)
        own = (_TAIL + (squared * gain + 2.0 * e) * gain / s) / (_TAIL + 2.0)
        own *= pairs.sum() / (pairs @ own)
        if np.abs(own / before - 1.0).max() < NEGLIGIBLE:
            break
    factor[several] = own
    return np.asarray(factor[star])


def _cells(pixels: Floats, size_px: float) -> Indices:
    """Return the number (n,) of the square cell of a size of each pixel (n, 2)."""
    index = np.floor((pixels + 0.5) / size_px).astype(np.int64)
    index -= index.min(axis=0, initial=0)
    return np.asarray(index[:, 0] * (int(index[:, 1].max(initial=0)) + 1) + index[:, 1])


def pair_moment(
    residual_px: Floats, weight: Floats, group: Indices, of_one_star: Indices | None = None
) -> tuple[float, float]:
    """
    Return the mean product of residuals of members of a group per axis, and its 1-sigma, px^2.

    Members with the same number in ``of_one_star`` are not multiplied.
    """

    def apart(value: Floats) -> float:
        own = 0.0 if of_one_star is None else _pairs(value, of_one_star)
        return _pairs(value, group) - own

    pairs = apart(weight)
    if pairs <= ROUNDING * float((weight**2).sum()):
        return 0.0, math.inf
    products = sum(apart(weight * v) for v in residual_px.T)
    return products / (2.0 * pairs), 1.0 / math.sqrt(pairs)


def _increments(moments: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """
    Return the excess of the moments of cells over those of coarser ones before, with 1-sigma.

    Neighbours in a small cell are neighbours in the large one, and share its structure too.
    """
    found = [moments[0]]
    for (before, before_sigma), (after, sigma) in pairwise(moments):
        is_known = math.isfinite(sigma)
        own_sigma = math.sqrt(max(sigma**2 - before_sigma**2, 0.0)) if is_known else sigma
        found.append((after - before if is_known else 0.0, max(own_sigma, ROUNDING * sigma)))
    return found


def _next_octave(log_px: Floats) -> Floats:
    """Weights (s, g) on the grid of an octave that follows one of logarithms (s,)."""
    off = _LOG_GRID[None, :] - log_px[:, None] - OCTAVE_STEP
    kernel = np.exp(-0.5 * (off / OCTAVE_SIGMA) ** 2)
    kernel /= kernel.sum(axis=1, keepdims=True).clip(1e-300)
    return np.asarray((1.0 - _OF_ONE_LENGTH) * kernel + _OF_ONE_LENGTH * _PRIOR / _PRIOR.sum())


@functools.cache
def _transition() -> Floats:
    """Weights (g, g) of an octave after one at each place of the grid."""
    return _next_octave(_LOG_GRID)


def chain_means(
    first: Floats,
    moments: Sequence[tuple[float, float]],
    excess_px2: tuple[float, float] = (0.0, math.inf),
) -> list[float]:
    """
    Return the posterior mean variance, px^2, of errors in a chain, the first with its prior.

    Each is tied to the one before as the octaves of the field are; sums over a grid of the
    logarithms, forward and backward.

    Parameters
    ----------
    first : (g,)
        Prior weights of the first on the grid.
    moments : sequence of (estimate, 1-sigma), px^2
        From `pair_moment`.
    excess_px2 : (estimate, 1-sigma)
        Of the variance of centroids, not negative: noise, or these errors.
    """
    transition, x = _transition(), np.exp(2.0 * _LOG_GRID)
    off = [-0.5 * ((estimate - x) / sigma) ** 2 for estimate, sigma in moments]
    by_pairs = [np.exp(one - one.max()) for one in off]
    # Where one error is large, the likelihood of the sum is that of each, less that of none large.
    by_excess = _beside_noise(*excess_px2)
    by_excess -= (1.0 - 1.0 / len(moments)) * by_excess[0]
    total, means = 0.0, np.zeros(len(moments))
    for large in range(len(moments)):
        likelihoods = [one * by_excess if k == large else one for k, one in enumerate(by_pairs)]
        before = [first]
        for one in likelihoods[:-1]:
            before.append((before[-1] * one) @ transition)
        after = np.ones(len(x))
        for k in reversed(range(len(moments))):
            weight = before[k] * likelihoods[k] * after
            means[k] += float(weight @ x)
            after = transition @ (likelihoods[k] * after)
        total += float(weight.sum())  # the same at each error
    return [float(one) for one in means / total]


def _beside_noise(excess_px2: float, sigma_px2: float) -> Floats:
    """
    Return the likelihood (g,) of an error by an excess of the variance of centroids.

    The excess is the error and noise that each centroid has alone, which has the same prior: where
    no two stars are near each other, nothing else tells one from the other.  It bounds no error,
    as the scale of the variance takes a part of it: the likelihood does not fall.
    """
    if not math.isfinite(sigma_px2):
        return np.ones(len(_LOG_GRID))
    log_noise = log_amplitudes(max(LARGEST_FIELD_PX, 2.0 * math.sqrt(excess_px2)))
    # The grids are no finer than this.
    sigma_px2 = math.hypot(sigma_px2, 2.0 * (_LOG_GRID[1] - _LOG_GRID[0]) * excess_px2)
    off = (excess_px2 - np.add.outer(np.exp(2.0 * _LOG_GRID), np.exp(2.0 * log_noise))) / sigma_px2
    likelihood = np.exp(-0.5 * off**2) @ np.exp(LogPrior().log_density(log_noise))
    return np.asarray(np.maximum.accumulate(likelihood))


def pixel_variance_px2(errors: Sequence[SharedError]) -> float:
    """Variance per axis of the structure that is finer than the field, of any pixel."""
    return sum(error.variance_px2 for error in errors if not error.of_star)


def star_shares_px2(errors: Sequence[SharedError]) -> tuple[Floats | float, Floats | float]:
    """
    Variance (n,) per axis that sightings of a star share, and the part (n,) of that one star.

    That part is the difference from other stars of its brightness.  Both are 0 where they change
    no precision.
    """
    shares = [(one.share_px2, one.beyond_px2) for one in errors if one.of_star and one.matters]
    return shares[0] if shares else (0.0, 0.0)


def group_sums(
    errors: Sequence[SharedError],
    variance_px2: Floats,
    inflation_px2: Floats,
    from_sky: Floats,
    parts: Iterable[tuple[Indices, Floats]],
    columns: int,
) -> tuple[dict[str, Floats], Floats]:
    """
    Return sums of weighted derivatives over groups, (r, r): of each error by its name, and alone.

    They are ``sum_g |sum_i s_i Y_i|^2`` of each error that matters, and ``sum_i s_i^2 |Y_i|^2`` of
    all with the inflation of the weights: the difference is the part of V beyond the working one.
    A group of one observation has only noise.  Observations whose variance is below the sum of
    s^2, such as bright stars, share no more than it.

    Parameters
    ----------
    parts : iterable of (rows, Y)
        Some observations (k,) with their derivatives (2, k, r).
    columns : int
        Number r of the derivatives.
    """
    shared_px2, sums = [], []
    errors = [error for error in errors if error.matters]
    for error in errors:
        members = np.bincount(error.group + 1)
        members[0] = 0  # not used
        shared_px2.append(error.share_px2 * (members[error.group + 1] > 1))
        sums.append(np.zeros((2 * len(members) - 2, columns)))
    total = np.sum(shared_px2, axis=0) if errors else np.zeros(len(variance_px2))
    share = np.minimum(variance_px2 / np.maximum(total, 1e-300), 1.0)
    own_px2, own = share * total + inflation_px2, np.zeros((columns, columns))
    if not own_px2.any():  # the errors are those of the working weights
        return {}, own
    for rows, Y in parts:
        k = len(rows)
        # The factors of u and v of the members of a group on each of its two axes.
        axis, of = np.array([0, 1])[:, None, None], np.array([0, 1])[:, None]
        column = np.broadcast_to(of * k + np.arange(k), (2, 2, k)).ravel()
        for error, error_px2, summed in zip(errors, shared_px2, sums, strict=True):
            part = np.sqrt(share[rows] * error_px2[rows])
            turned = from_sky[rows].T if error.of_star else np.eye(2)[:, :, None]
            row = np.broadcast_to(2 * error.group[rows] + axis, (2, 2, k)).ravel()
            member = ((part * turned).ravel(), (row, column))
            summed += csr_array(member, shape=(len(summed), 2 * k)) @ Y.reshape(2 * k, -1)
        for values in Y * np.sqrt(own_px2[rows])[:, None]:
            own += values.T @ values
    return {error.name: summed.T @ summed for error, summed in zip(errors, sums, strict=True)}, own
