# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Errors of a star tracker: noise of each image, slow errors that images share, angular rates.

The attitude errors that the stars of m images show are the alignment, noise of sigma n and a slow
error of sigma s with the correlation K between images, in time, in attitude or half in each.  The
restricted likelihood of n and s is evaluated on a grid for each K with the alignment eliminated,
and results are averaged over the posterior.  A slow error that lasts longer than the campaign
shows in no scatter: it stays in the sigma of the alignment at the size of its prior.

The rate of an image is measured by a star tracker with noise, or not at all.  Its error times the
time of read-out turns the camera from the first row to the last: three unknowns of each image.
The time is an unknown too: its root mean square replaces it, from its prior and then from the
posterior of the round before.  An offset of the stamps times the error of a rate is a hundredth of
the noise of the star tracker that gave the rate, which is estimated anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
import math

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation
from scipy.special import stdtr

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.estimation.amplitudes import interval_factor, LogPrior
from starcal_ros.estimation.limits import FEWEST, MOST_CORRELATED
from starcal_ros.estimation.problem import canonical_xyzw, Problem, State
from starcal_ros.records import StarObservations, StarTrackerAlignment

_SPANS = (0.3, 1.0, 3.0, 10.0)  # correlation times, in spans of the campaign
_ANGLES_DEG = (10.0, 30.0, 60.0)  # correlation angles: a field of view to a large part of the sky
_LOG_SLOW = np.linspace(-4.5, 4.0, 18)  # ln s, in its prior centre
_LOG_NOISE = np.linspace(-2.1, 2.8, 15)  # ln n, in the stated sigma; more where errors are larger
_BEYOND = 1.0  # the grid ends a factor of e above the RMS of the errors at least
STATED_NOISE = LogPrior(0.0, 0.5)  # noise in the stated sigma: data sheets are right to 1.6
_SLOW_SIGMA = 1.25  # prior 1-sigma of ln s; at 0.8 n6_walk is 1.56 sigma off (docs/experiments.md)
STATED_SLOW = LogPrior(0.0, 0.3)  # slow error in the stated one: within 35 %
_MOST_MEMBERS = 4  # members of a group that give its mean correlation, spread over its time


@dataclass(frozen=True)
class Correlations:
    """
    Correlations K (g, g) that slow errors of groups of images may have: in time, attitude, both.

    ``group`` (m,) as for `TrackerErrors`; ``axes`` has the eigenvalues (g,) and the eigenvectors
    (g, g) of each K; ``weight`` (k,) is the prior probability of each.
    """

    group: Indices
    names: tuple[str, ...]
    kernels: Floats  # (k, g, g)
    weight: Floats
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
    sigma_rad : float
        Their stated sigma.
    images : (m,) int
    correlations : Correlations or None
        None where the star tracker is taken as exact.
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
    sigma_rad: float = 1.0
    images: Indices = field(default_factory=lambda: np.empty(0, np.int64))
    correlations: Correlations | None = None


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
    The stated sigma is a prior of the noise: log-normal, with the tails of wrong data sheets.  A
    guess has the prior of any amplitude about it.
    """
    (m, count), group = error.shape, correlations.group
    size = np.bincount(group)
    slow_prior = STATED_SLOW if stated_slow else LogPrior(0.0, _SLOW_SIGMA)
    of_stars = float(np.median(variance))
    log_noise, centre, noise_prior = _noise_grid(error, is_stated)
    if stated_slow:
        centre = np.zeros(len(centre))
    centre = centre + math.log(stated_slow or usual_slow)
    slow2, noise2 = np.exp(2.0 * (centre + _LOG_SLOW[:, None])), np.exp(2.0 * log_noise)
    prior = noise_prior + slow_prior.log_density(_LOG_SLOW[:, None])
    of_group = np.stack([np.bincount(group, one) for one in error.T], axis=1) / size[:, None]
    within = float(((error - of_group[group]) ** 2).sum())
    found, mean_information = [], []
    for K, axes in zip(correlations.kernels, correlations.axes, strict=True):
        likelihood, information = _restricted(*axes, of_group, slow2, noise2, of_stars, m / len(K))
        # Within a group there is noise, and the slow error that its members do not share.
        if m > len(K):
            apart = m / (m - len(K)) * (1.0 - float(size @ np.diag(K)) / m)
            alone = slow2 * max(apart, 0.0) + noise2 + of_stars
            likelihood = likelihood - 0.5 * (count * (m - len(K)) * np.log(alone) + within / alone)
        found.append(likelihood)
        mean_information.append(information)
    log_likelihood = np.array(found)
    by_prior = log_likelihood + prior + np.log(correlations.weight)[:, None, None]
    weight = np.exp(by_prior - by_prior.max())
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
    ratio = float(log_likelihood.max() - log_likelihood[:, 0].max())
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

    A stated sigma has a normal prior with the tails of wrong data sheets, which are as no sigma at
    all: there the slow error is as large as the noise, not as the stated noise.
    """
    step = _LOG_NOISE[1] - _LOG_NOISE[0]
    log_rms = 0.5 * math.log(max(float((error**2).mean()), 1e-300))
    more = max(math.ceil((log_rms + _BEYOND - _LOG_NOISE[-1]) / step), 0)
    log_noise: Floats = np.append(_LOG_NOISE, _LOG_NOISE[-1] + step * np.arange(1, more + 1))
    if not is_stated:
        return log_noise, log_noise, LogPrior(0.0).log_density(log_noise)
    right = STATED_NOISE.log_density(log_noise)
    prior = np.logaddexp(right, STATED_NOISE.log_density_if_wrong(log_noise))
    return log_noise, np.where(STATED_NOISE.is_wrong(log_noise), log_noise, 0.0), prior


def expected_slow_of_mean(correlations: Correlations, stated_slow: float, noise: float) -> float:
    """
    Return the 1-sigma that the slow error is expected to give the mean of images.

    It uses the prior means of s and K, since there is no scatter before a solve.
    """
    log_sigma = STATED_SLOW.sigma if stated_slow else _SLOW_SIGMA
    size = np.bincount(correlations.group) / len(correlations.group)
    shared = float(correlations.weight @ (size @ correlations.kernels @ size))
    return (stated_slow or noise) * math.exp(0.5 * log_sigma**2) * math.sqrt(shared)


def groups_of(time_ns: Indices) -> Indices:
    """Return the group (m,) of each image: neighbours in time, of the same size but the last."""
    m = len(time_ns)
    group = np.empty(m, np.int64)
    group[np.argsort(time_ns, kind='stable')] = np.arange(m) // -(-m // MOST_CORRELATED)
    return group if m > MOST_CORRELATED else np.arange(m)


def correlations_of(time_ns: Indices, camera_from_icrf: Rotation) -> Correlations:
    """
    Return the correlations of slow errors of images at these stamps (m,) and attitudes.

    An error changes in time, over the sky, or is the sum of one of each: where one of two shows in
    a scatter, the other one may hide in the mean.  All sums together are as likely as any one
    error alone.

    Images are joined in at most `MOST_CORRELATED` groups of neighbours in time.
    """
    group = groups_of(time_ns)
    size = np.bincount(group)
    members = np.minimum(size, _MOST_MEMBERS)
    first = np.cumsum(members) - members
    # Those of a group in equal steps of time order: neighbours are more alike than the others.
    order = np.lexsort((time_ns, group))
    place = np.arange(len(order)) - np.repeat(np.cumsum(size) - size, size)
    share, of_size = np.repeat(members, size), np.repeat(size, size)
    some = order[(place * share) // of_size > ((place - 1) * share) // of_size]

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
    # Squared chords: a Gaussian of the angle itself is no covariance on a sphere.
    chord2 = 2.0 - 2.0 * boresight @ boresight.T
    in_time = {
        f'over {share * span_s:.3g} s': of_groups(np.exp(-apart_s / (share * span_s)))
        for share in _SPANS
    }
    in_attitude = {
        f'over {one:g} deg': of_groups(np.exp(-0.5 * chord2 / math.radians(one) ** 2))
        for one in _ANGLES_DEG
    }
    in_both = {
        f'{time} and {angle}': 0.5 * (in_time[time] + in_attitude[angle])
        for time, angle in product(in_time, in_attitude)
    }
    kernels = in_time | in_attitude | in_both
    axes = tuple(eigh(K, check_finite=False) for K in kernels.values())
    weight = np.repeat([1.0, 1.0 / len(in_both)], [len(kernels) - len(in_both), len(in_both)])
    weight /= weight.sum()
    return Correlations(group, tuple(kernels), np.array(list(kernels.values())), weight, axes)


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


_UNKNOWN_RATE_RAD_S = 6.4e-4  # per axis: a low orbit, 1.1e-3, about an unknown axis
# Images so near in time show how fast a camera turns: a tenth of a low orbit, in which it neither
# comes round nor often turns away and back.
_NEAR_S = 600.0
_LEAST_RAD2_S2 = 1e-18  # variance of a rate: a milliarcsecond in five seconds
_TRACY_WIDOM_99 = 2.0234  # 99 % quantile of the Tracy-Widom law of order 1


@dataclass(frozen=True)
class Rates:
    """
    Rates of images, and the time of read-out by which their errors turn the camera.

    The error of the rate of image k is ``root[k] z`` with z of unit variance.

    Attributes
    ----------
    rad_s : (m, 3)
        NaN where no image has one: the errors are then those of one rate of all images.
    root_rad_s : (m, 3, 3)
    readout_s : float
        Root mean square of the time of read-out.
    """

    rad_s: Floats
    root_rad_s: Floats
    readout_s: float = 0.0

    def turned(self, camera_from_star_tracker: Rotation, readout_s: float) -> Rates:
        """Return rates in the star tracker frame in that of the camera."""
        matrix = camera_from_star_tracker.as_matrix()
        return Rates(self.rad_s @ matrix.T, matrix @ self.root_rad_s, readout_s)


def measured_rates(images: Sequence[StarObservations]) -> Rates:
    """
    Return the rates of images in the frame of the star tracker, with their errors.

    Rates that differ by their errors would seem to show that there is no time of read-out, since
    the stars do not differ with them (errors in variables).  So a rate moves to the mean of all by
    the share of its error in their scatter; an image without a rate has the mean.  The errors of
    the images are not lowered for it: together they are the error of the mean.

    The scatter of the rates replaces a sigma that is not stated, since a data sheet that is too
    good would leave errors that seem to be differences; for less than three rates it is the turn
    of a low orbit.  Where no image has a rate, the camera is assumed to turn about as fast as it
    does from image to image, at most as in a low orbit.
    """
    m = len(images)
    rate = np.array([image.star_tracker_rate_rad_s for image in images])
    sigma = np.array([image.star_tracker_rate_sigma_rad_s for image in images])
    known = np.isfinite(rate).all(axis=1)
    if not known.any():
        return Rates(rate, np.tile(_rate_between_rad_s(images) * np.eye(3), (m, 1, 1)))
    several = np.count_nonzero(known) > 1
    scatter = np.cov(rate[known].T) if several else np.zeros((3, 3))
    unstated = np.full(3, _UNKNOWN_RATE_RAD_S)
    if np.count_nonzero(known) >= FEWEST:
        unstated = np.sqrt(np.diag(scatter))
    own = np.where(sigma > 0, sigma, unstated)[:, :, None] ** 2 * np.eye(3)
    # Errors alone scatter so along their best direction; only the rest is a difference of rates.
    errors = own[known].mean(axis=0) + _LEAST_RAD2_S2 * np.eye(3)
    values, vectors = eigh(scatter, errors)
    columns = errors @ vectors
    differing = (values - largest_scatter(np.count_nonzero(known) - 1)).clip(0.0)
    without_errors = (columns * differing) @ columns.T
    own[~known] = without_errors + _UNKNOWN_RATE_RAD_S**2 * np.eye(3)
    weight = known / (np.trace(without_errors) + np.einsum('mii->m', own) + _LEAST_RAD2_S2)
    mean = (weight @ np.where(known[:, None], rate, 0.0)) / weight.sum()
    off = np.where(known[:, None], rate - mean, 0.0)
    total = without_errors + own + _LEAST_RAD2_S2 * np.eye(3)
    shrunk = np.linalg.solve(total, off[:, :, None])[:, :, 0] @ without_errors
    root = np.asarray(np.linalg.cholesky(own + _LEAST_RAD2_S2 * np.eye(3)))
    return Rates(mean + shrunk, root)


def largest_scatter(freedom: int) -> float:
    """
    Return the variance of errors of unit variance in three axes, along the axis of the largest.

    The 99 % quantile for a covariance of so many degrees of freedom: the Tracy-Widom law of the
    largest eigenvalue of a Wishart matrix with the centring of Ma (Bernoulli 18, 2012), which is
    right to a tenth of the chance.
    """
    samples, axes = math.sqrt(max(freedom, 1) - 0.5), math.sqrt(3.0 - 0.5)
    edge = samples + axes
    width = edge * (1.0 / samples + 1.0 / axes) ** (1.0 / 3.0)
    return float((edge**2 + _TRACY_WIDOM_99 * width) / max(freedom, 1))


def _rate_between_rad_s(images: Sequence[StarObservations]) -> float:
    """Return the middle rate at which images follow each other, at most that of an orbit."""
    ordered = sorted(images, key=lambda image: image.time_ns)
    attitudes = Rotation.from_quat([image.icrf_from_star_tracker_xyzw for image in ordered])
    apart_s = np.diff([image.time_ns for image in ordered]) / NANOSECONDS_PER_SECOND
    near = (apart_s > 0) & (apart_s < _NEAR_S)
    rates = (attitudes[:-1].inv() * attitudes[1:]).magnitude()[near] / apart_s[near]
    return min(float(np.median(rates)), _UNKNOWN_RATE_RAD_S) if near.any() else _UNKNOWN_RATE_RAD_S


@dataclass(frozen=True)
class AttitudeErrors:
    """
    Errors of the star trackers as the stars show them, and their variances.

    ``error_rad`` (m, 3): small passive rotations from the reported to the true attitudes.
    """

    error_rad: Floats
    covariance_rad2: Floats
    seen: Mask
    misfit: Mask
    trackers: tuple[TrackerErrors, ...]  # one for each tracker and each stated sigma


def star_tracker_alignments(
    names: tuple[str, ...],
    problem: Problem,
    state: State,
    covariance: Floats,
    attitudes: AttitudeErrors,
    time_ns: Indices,
    sigma_rad: Floats,
) -> tuple[StarTrackerAlignment, ...]:
    """
    Return the alignments to the star trackers of an ensemble; none where there is one only.

    Parameters
    ----------
    names : tuple of str
        From `star_tracker_names`.
    covariance : (3 + 3 s, 3 + 3 s)
        Covariance of the alignment and of the mountings of the s further star trackers.
    attitudes : AttitudeErrors
        Errors in images at ``time_ns`` (m,), about the axes of the star tracker of each.
    sigma_rad : (3,)
        Noise of a star tracker.
    """
    if problem.first_from_star_tracker is None:
        return ()
    mountings = np.concatenate([np.zeros(3), state.mountings]).reshape(-1, 3)
    A = state.camera_from_star_tracker
    found = []
    for k, name in enumerate(names):
        here = problem.star_tracker == k
        assumed = problem.first_from_star_tracker[here][0] if k else Rotation.identity()
        alignment = Rotation.from_rotvec(-mountings[k]) * A * assumed
        to_mounting = np.eye(3, len(covariance), 3 * k) * bool(k)
        to_angles = np.eye(3, len(covariance)) + to_mounting
        of_mounting = to_mounting @ covariance @ to_mounting.T
        rate, total, p_value = _drift(time_ns, attitudes, sigma_rad, here)
        found.append(
            StarTrackerAlignment(
                frame=name,
                images=int(here.sum()),
                star_tracker_from_camera_xyzw=canonical_xyzw(alignment.inv()),
                alignment_covariance_rad2=to_angles @ covariance @ to_angles.T,
                first_from_star_tracker_xyzw=canonical_xyzw(A.inv() * alignment),
                mounting_covariance_rad2=of_mounting,
                drift_arcsec_per_hour=tuple(float(one) for one in rate),
                drift_arcsec=total,
                drift_p_value=p_value,
            )
        )
    return tuple(found)


def _drift(
    time_ns: Indices, attitudes: AttitudeErrors, sigma_rad: Floats, here: Mask
) -> tuple[Floats, float, float]:
    """
    Slope (3,) of the reported attitudes from the true ones, arcsec/h; its length; p-value of none.

    By the scatter about the slope: a drift raises the sigma of the star tracker that is estimated.
    """
    unknown = np.full(3, np.nan), math.nan, math.nan
    used = here & attitudes.seen & ~attitudes.misfit
    freedom = np.count_nonzero(used) - 2  # beside a mean and a slope
    if freedom < 1:
        return unknown
    time_ns, error_rad = time_ns[used], -attitudes.error_rad[used]
    hours = (time_ns - time_ns[0]) / (3600 * NANOSECONDS_PER_SECOND)
    variance_rad2 = np.einsum('mii->mi', attitudes.covariance_rad2)[used]
    weight = 1.0 / (variance_rad2 + sigma_rad**2)
    middle = (weight * hours[:, None]).sum(axis=0) / weight.sum(axis=0)
    from_middle = hours[:, None] - middle
    information = (weight * from_middle**2).sum(axis=0)
    if not (information > 0).all():
        return unknown
    slope = (weight * from_middle * error_rad).sum(axis=0) / information
    mean_rad = (weight * error_rad).sum(axis=0) / weight.sum(axis=0)
    scatter = (weight * (error_rad - mean_rad - from_middle * slope) ** 2).sum(axis=0) / freedom
    t = slope * np.sqrt(information / np.maximum(scatter, 1e-300))
    p_value = min(1.0, 3.0 * 2.0 * float(stdtr(freedom, -np.abs(t)).min()))  # any axis
    rate = slope / ARCSECOND_RAD
    return rate, float(np.linalg.norm(rate) * np.ptp(hours)), p_value
