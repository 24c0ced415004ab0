# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Errors of a star tracker: noise of each image, and slow errors that images share.

The attitude errors that the stars of m images show are the alignment, noise of sigma n and a slow
error of sigma s with the correlation K between images, in time or in attitude.  The restricted
likelihood of n and s is evaluated on a grid for each K with the alignment eliminated, and results
are averaged over the posterior.  A slow error that lasts longer than the campaign shows in no
scatter: it stays in the sigma of the alignment at the size of its prior.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.estimation.amplitudes import interval_factor

_SPANS = (0.3, 1.0, 3.0, 10.0)  # correlation times, in spans of the campaign
_ANGLES_DEG = (10.0, 30.0, 60.0)  # correlation angles: a field of view to a large part of the sky
_LOG_SLOW = np.linspace(-4.5, 4.0, 18)  # ln s, in its prior centre
_LOG_NOISE = np.linspace(-2.1, 2.8, 15)  # ln n, in the stated sigma
_NOISE_SIGMA = 0.5  # of ln n: data sheets are right to a factor of 1.6
_UNSTATED_SIGMA = 3.0  # of ln n where no sigma is stated
_WRONG_SHEETS = 0.02  # of data sheets: four times too small and more, as if none were stated
_LEAST_WRONG = 4  # place in the grid of the least noise of these, from its sheet's
_BEYOND = 1.0  # of the grid over the RMS of the errors, in logarithms
_SLOW_SIGMA = 1.25  # of ln s about the stated noise
_STATED_SLOW_SIGMA = 0.3  # of ln s about star_tracker_slow_arcsec
# Groups of a correlation: neighbours in time are joined to at most so many, 1/100 of a campaign
# against correlation times of a third of it and more.  The time of an estimate stays linear.
_MOST_GROUPS = 100
_MOST_MEMBERS = 4  # of a group, of which the mean correlation is taken


@dataclass(frozen=True)
class Correlations:
    """
    Correlations K (g, g) that slow errors of groups of images may have, in time and in attitude.

    ``group`` (m,) as for `TrackerErrors`; ``axes`` has the eigenvalues (g,) and the eigenvectors
    (g, g) of each K.
    """

    group: Indices
    names: tuple[str, ...]
    kernels: Floats  # (k, g, g)
    axes: tuple[tuple[Floats, Floats], ...]


@dataclass(frozen=True)
class TrackerErrors:
    """
    Posterior of the errors of one star tracker over m images, about axes of one stated sigma.

    Attributes
    ----------
    noise, slow : float
        Root of the posterior mean of n^2 and of s^2, in stated sigmas.
    covariance : (g, g)
        Posterior mean of ``n^2 1 + s^2 K`` in stated sigmas, for each axis, K that of groups.
    group : (m,) int
        Group of each image: the image itself up to a number of images, then neighbours in time.
    working : float
        Sigma of independent errors that determine the alignment as well.
    likelihood_ratio : float
        Twice the log likelihood against no slow error.
    correlation : str
        The most likely K.
    independent : float
        Part of the diagonal of ``covariance`` that images do not share.
    axes : tuple of int
        Those of the star tracker.
    """

    noise: float
    slow: float
    covariance: Floats
    group: Indices
    working: float
    likelihood_ratio: float
    correlation: str
    independent: float
    axes: tuple[int, ...] = (0, 1, 2)


def tracker_errors(
    error: Floats,
    variance: Floats,
    correlations: Correlations,
    is_stated: bool,
    stated_slow: float,
    usual_slow: float = 1.0,
) -> TrackerErrors:
    """
    Return the posterior of the errors of a star tracker.

    Parameters
    ----------
    error, variance : (m, a)
        As the stars show them about axes of one sigma, in that sigma, and their variances by the
        centroids.
    is_stated : bool
        False where the stated sigma is a guess.
    stated_slow : float
        Slow error by the data sheet, in stated sigmas; 0: not stated.
    usual_slow : float
        Slow error that is not stated, in noise.

    Notes
    -----
    The stated sigma is a prior of the noise: log-normal, with a tail of wrong data sheets.
    """
    (m, count), group = error.shape, correlations.group
    size = np.bincount(group)
    slow_sigma = _STATED_SLOW_SIGMA if stated_slow else _SLOW_SIGMA
    of_stars = float(np.median(variance))
    log_noise, centre, noise_prior = _noise_grid(error, is_stated)
    if stated_slow:
        centre = np.zeros(len(centre))
    centre = centre + math.log(stated_slow or usual_slow)
    slow2, noise2 = np.exp(2.0 * (centre + _LOG_SLOW[:, None])), np.exp(2.0 * log_noise)
    prior = noise_prior - 0.5 * (_LOG_SLOW[:, None] / slow_sigma) ** 2
    of_group = np.stack([np.bincount(group, one) for one in error.T], axis=1) / size[:, None]
    within = float(((error - of_group[group]) ** 2).sum())
    log_weight, mean_information = [], []
    plain = -math.inf
    for K, axes in zip(correlations.kernels, correlations.axes, strict=True):
        likelihood, information = _restricted(*axes, of_group, slow2, noise2, of_stars, m / len(K))
        # Within a group there is noise, and the slow error that its members do not share.
        if m > len(K):
            apart = m / (m - len(K)) * (1.0 - float(size @ np.diag(K)) / m)
            alone = slow2 * max(apart, 0.0) + noise2 + of_stars
            likelihood = likelihood - 0.5 * (count * (m - len(K)) * np.log(alone) + within / alone)
        log_weight.append(likelihood + prior)
        mean_information.append(information)
        plain = max(plain, float(likelihood[0].max()))
    weight = np.exp(np.array(log_weight) - np.max(log_weight))
    weight /= weight.sum()
    noise = float(weight.sum(axis=(0, 1)) @ noise2)
    of_mean = interval_factor(np.array(mean_information).ravel() ** -0.5, weight.ravel())
    per_kernel = (weight * slow2).sum(axis=(1, 2))
    shared = np.einsum('k,kij->ij', per_kernel, correlations.kernels)
    covariance = noise * np.eye(len(size)) + shared
    # Long tails of s: the covariance of the mean is that of its interval.
    mean_variance = noise / m + float(size @ shared @ size) / m**2
    shrunk = min(of_mean**2 / mean_variance, 1.0)
    covariance *= shrunk
    best = int(np.argmax(weight.sum(axis=(1, 2))))
    ratio = max(float(one.max()) for one in (w - prior for w in log_weight)) - plain
    return TrackerErrors(
        noise=math.sqrt(noise),
        slow=math.sqrt(float(per_kernel.sum())),
        covariance=covariance,
        group=group,
        working=math.sqrt(m) * of_mean,
        likelihood_ratio=2.0 * ratio,
        correlation=correlations.names[best],
        independent=shrunk * noise,
    )


def _noise_grid(error: Floats, is_stated: bool) -> tuple[Floats, Floats, Floats]:
    """
    Return a grid (n,) of ln n for errors (m, 3), the centres of ln s there, and its log prior.

    First data sheets that are right, then those that are wrong, as far as the errors may ask for:
    of these the slow error is as large as the noise, not as the stated one.
    """
    sigma = _NOISE_SIGMA if is_stated else _UNSTATED_SIGMA
    step = _LOG_NOISE[1] - _LOG_NOISE[0]
    log_rms = 0.5 * math.log(max(float((error**2).mean()), 1e-300))
    top = max(float(_LOG_NOISE[-1]), log_rms + _BEYOND)
    wrong = step * np.arange(_LEAST_WRONG, math.ceil(top / step) + 1)
    odds = math.log(_WRONG_SHEETS / (1.0 - _WRONG_SHEETS) * sigma / _UNSTATED_SIGMA)
    log_prior = [-0.5 * (_LOG_NOISE / sigma) ** 2, odds - 0.5 * (wrong / _UNSTATED_SIGMA) ** 2]
    return (
        np.concatenate([_LOG_NOISE, wrong]),
        np.concatenate([np.zeros(len(_LOG_NOISE)) if is_stated else _LOG_NOISE, wrong]),
        np.concatenate(log_prior),
    )


def expected_slow_of_mean(correlations: Correlations, stated_slow: float, noise: float) -> float:
    """
    Return the 1-sigma that the slow error is expected to give the mean of images.

    Of its prior, the mean of s and of K: before a solve no scatter has been seen.
    """
    log_sigma = _STATED_SLOW_SIGMA if stated_slow else _SLOW_SIGMA
    size = np.bincount(correlations.group) / len(correlations.group)
    shared = float((size @ correlations.kernels @ size).mean())
    return (stated_slow or noise) * math.exp(0.5 * log_sigma**2) * math.sqrt(shared)


def groups_of(time_ns: Indices) -> Indices:
    """Return the group (m,) of each image: neighbours in time, of the same size but the last."""
    m = len(time_ns)
    group = np.empty(m, np.int64)
    group[np.argsort(time_ns, kind='stable')] = np.arange(m) // -(-m // _MOST_GROUPS)
    return group if m > _MOST_GROUPS else np.arange(m)


def correlations_of(time_ns: Indices, camera_from_icrf: Rotation) -> Correlations:
    """Return the correlations of slow errors of images at these stamps (m,) and attitudes."""
    group = groups_of(time_ns)
    size = np.bincount(group)
    order = np.argsort(group, kind='stable')
    some = order[np.arange(len(order)) - np.repeat(np.cumsum(size) - size, size) < _MOST_MEMBERS]
    members = np.minimum(size, _MOST_MEMBERS)
    first = np.cumsum(members) - members

    def of_groups(K: Floats) -> Floats:
        """Return the mean correlation of the members of groups."""
        if len(size) == len(time_ns):
            return K
        pairs = np.add.reduceat(np.add.reduceat(K, first, axis=0), first, axis=1)
        found = pairs / np.outer(members, members)
        apart = (np.diag(pairs) - members) / np.maximum(members * (members - 1), 1)
        np.fill_diagonal(found, (1.0 + (size - 1) * apart) / size)
        return np.asarray(found)

    time_s = (time_ns - time_ns[0]) / NANOSECONDS_PER_SECOND
    span_s = max(float(np.ptp(time_s)), 1e-9)
    apart_s = np.abs(np.subtract.outer(time_s[some], time_s[some]))
    boresight = camera_from_icrf.as_matrix()[some, 2]
    angle_deg = np.degrees(np.arccos(np.clip(boresight @ boresight.T, -1.0, 1.0)))
    names = [f'over {share * span_s:.3g} s' for share in _SPANS]
    kernels = [of_groups(np.exp(-apart_s / (share * span_s))) for share in _SPANS]
    names += [f'over {one:g} deg' for one in _ANGLES_DEG]
    kernels += [of_groups(np.exp(-0.5 * (angle_deg / one) ** 2)) for one in _ANGLES_DEG]
    axes = tuple(eigh(K, check_finite=False) for K in kernels)
    return Correlations(group, tuple(names), np.array(kernels), axes)


def _restricted(
    values: Floats,
    vectors: Floats,
    error: Floats,
    slow2: Floats,
    noise2: Floats,
    of_stars: float,
    members: float,
) -> tuple[Floats, Floats]:
    """
    Return restricted log likelihood and information on the mean, (slow, noise), on a grid.

    The likelihood is that of errors as the stars show them, the information that of the star
    tracker alone: the noise of the stars is in their own equations.  In the axes of K, with
    ``values`` (g,) and ``vectors`` (g, g), every covariance of the grid is diagonal.
    """
    ones = vectors.sum(axis=0)
    along = vectors.T @ error
    alone = slow2[..., None] * np.maximum(values, 0.0) + noise2[:, None] / members
    total = alone + of_stars / members
    log_det = np.log(total).sum(axis=2)
    inverse = np.reciprocal(total, out=total)
    information = inverse @ ones**2
    mean = inverse @ (ones[:, None] * along) / information[..., None]
    squared = inverse @ (along**2).sum(axis=1) - information * (mean**2).sum(axis=2)
    log_det += np.log(information)
    return -0.5 * (error.shape[1] * log_det + squared), (1.0 / alone) @ ones**2
