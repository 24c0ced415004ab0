# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Amplitudes of the priors of the field and of the shapes of the images, by restricted likelihood.

An amplitude is the 1-sigma of a group of unknowns: of an octave of the field, or of the scale, the
stretch, the shear or the decentring of the images.  With all other unknowns eliminated, the
information S and the gradient h of a group have the restricted log likelihood (Patterson &
Thompson 1971; Harville 1977; for fields Rasmussen & Williams 2006, ch. 5)::

    log L = -1/2 log |1 + s S s| + 1/2 (s h)' (1 + s S s)^-1 (s h)

where s is the diagonal matrix of the prior sigmas.  It is formed from sums: no pass over the stars
is needed.  Each amplitude has a weak prior on its logarithm.  Results are averaged over a common
factor of the amplitudes, so that an amplitude that few images determine gives wide tails, and zero
is never a decision.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
import functools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri
from scipy.optimize import brentq
from scipy.special import erf, expit

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.limits import (
    LEAST_GAIN,
    MOST_CORRELATED,
    MOST_ROUNDS,
    ROUNDING,
    ROWS_AT_ONCE,
)

# An octave of the field is smaller than the one before, within a factor of e.
OCTAVE_STEP, OCTAVE_SIGMA = -0.7, 1.0
# Beyond it field and camera are collinear, and the likelihood is rounding.
LARGEST_FIELD_PX = 0.5
LARGEST_SHAPE_PX = 30.0  # change of a camera from image to image
_WRONG_SHEETS = 0.02  # prior probability that a data sheet states no more than none does
LEAST_PX = 1e-9  # amplitude without any effect: no star is measured to a nanopixel
# Where searches start: at the centre of the prior, since the gradient vanishes near zero, and in
# steps of half a decade, the width of a maximum, from where stars begin to show an amplitude.
# There may be several maxima.
STARTS_PX = (1e-5, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1, 1.0)
# Common factors of the amplitudes over which results are averaged, in logarithms: from one without
# an effect to one that few images still allow.  Many images leave the factor 1 alone.
_SHIFTS: Floats = np.asarray(np.linspace(-8.0, 6.0, 43), np.float64)


@dataclass(frozen=True)
class LogPrior:
    """
    Normal prior of the logarithm of an amplitude: its centre and its 1-sigma.

    The default is the prior of an amplitude in px that nothing states: a lens or a detector
    departs from its model by a micropixel as likely as by a tenth of a pixel.  A narrower prior,
    or one that is centred where departures matter, costs a sound camera up to 30 % of its sigma.
    """

    centre: float = math.log(1e-5)
    sigma: float = 4.0

    def log_density(self, log_amplitude: NDArray[np.floating]) -> Floats:
        """Return the log density (...) at logarithms (...), up to a constant."""
        return np.asarray(-0.5 * ((log_amplitude - self.centre) / self.sigma) ** 2)

    def log_density_if_wrong(self, log_amplitude: NDArray[np.floating]) -> Floats:
        """Return the same if the centre is of a wrong data sheet, which states nothing."""
        unstated = LogPrior(self.centre)
        odds = _WRONG_SHEETS / (1.0 - _WRONG_SHEETS)
        scale = math.log(odds * self.sigma / unstated.sigma)
        return np.asarray(unstated.log_density(log_amplitude) + scale)

    def is_wrong(self, log_amplitude: NDArray[np.floating]) -> Mask:
        """True where an amplitude is likelier by a wrong data sheet."""
        right = self.log_density(log_amplitude)
        return np.asarray(self.log_density_if_wrong(log_amplitude) > right)


def log_amplitudes(largest_px: float) -> Floats:
    """
    Return logarithms (g,) over which the posterior of one amplitude is summed.

    From one without an effect to the largest, in steps of 17 % of a variance.
    """
    steps = round(math.log(largest_px / LEAST_PX) / math.log(1.17**0.5))
    logs = np.linspace(math.log(LEAST_PX), math.log(largest_px), steps + 1)
    return np.asarray(logs, np.float64)


@dataclass(frozen=True)
class Amplitudes:
    """
    Amplitudes at the maximum of their posterior.

    ``log_px`` (g,); ``likelihood_ratio``: twice the log likelihood against none of them; ``other``
    (g,): a lower maximum that the search has found too.
    """

    log_px: Floats
    likelihood_ratio: float
    other: Floats | None = None


@dataclass(frozen=True)
class Averaged:
    """
    Unknowns averaged over a common factor of their amplitudes.

    ``mean`` (q,), ``covariance`` (q, q); ``log_px`` (s,) of the last group with ``weight`` (s,):
    the posterior of its amplitude; ``term``: the amplitude of the likely term at the best factor.
    """

    mean: Floats
    covariance: Floats
    log_px: Floats
    weight: Floats
    term: Amplitudes
    log_evidence: float


def octave_prior(count: int, first: LogPrior = LogPrior()) -> tuple[Floats, Floats]:
    """Mean (count,) and precision (count, count) of the logarithms of octaves in a chain."""
    mean: Floats = first.centre + OCTAVE_STEP * np.arange(count, dtype=np.float64)
    precision = np.zeros((count, count))
    precision[0, 0] = first.sigma**-2
    for k in range(1, count):
        precision[k - 1 : k + 1, k - 1 : k + 1] += np.array([[1, -1], [-1, 1]]) / OCTAVE_SIGMA**2
    return mean, precision


def field_amplitudes(
    information: Floats,
    gradient: Floats,
    octave: Indices,
    near: Amplitudes | None = None,
    first: LogPrior = LogPrior(),
) -> Amplitudes:
    """
    Amplitudes of the octaves of a field by Fisher scoring.

    Parameters
    ----------
    information, gradient : (q, q), (q,)
        On the coefficients, scaled to a prior of 1 px for each octave, all else eliminated.
    octave : (q,)
    near : Amplitudes, optional
        Amplitudes of the round before: the search starts there and from its other maximum.
    first : LogPrior
        Prior of the first octave.
    """
    count = int(octave.max()) + 1
    mean, precision = octave_prior(count, first)
    # The gradient vanishes near zero: a small amplitude and a large one.
    starts_px = STARTS_PX[0], STARTS_PX[3]
    starts = [math.log(one) - 0.3 * np.arange(count, dtype=np.float64) for one in starts_px]
    if near is not None:
        starts = [near.log_px, starts[-1] if near.other is None else near.other]
    member = np.equal.outer(np.arange(count), octave).astype(float)
    cap = math.log(LARGEST_FIELD_PX)

    def evaluate(log_px: Floats) -> tuple[float, Floats, Floats]:
        s = np.exp(log_px)[octave]
        # All others together change the likelihood by less than what ends the search.
        shown = np.flatnonzero(s**2 * np.diag(information) > LEAST_GAIN / len(s))
        s, own = s[shown], member[:, shown]
        scaled = information[np.ix_(shown, shown)] * np.outer(s, s)
        scaled[np.abs(scaled) < ROUNDING] = 0.0  # products of tiny numbers take tenfold time
        scaled[np.diag_indices(len(s))] += 1.0
        lower, inverse = _cholesky_and_inverse(scaled)
        mode = inverse @ (s * gradient[shown])
        resolved = np.eye(len(s)) - inverse
        off = log_px - mean
        value = -np.log(np.diag(lower)).sum() + 0.5 * mode @ (s * gradient[shown])
        slope = own @ (mode**2 - np.diag(resolved)) - precision @ off
        fisher = 2.0 * own @ (resolved * resolved.T) @ own.T + precision
        return float(value - 0.5 * off @ precision @ off), slope, fisher

    maxima: list[tuple[float, Floats]] = []
    for log_px in starts:
        value, slope, fisher = evaluate(log_px)
        for _ in range(MOST_ROUNDS):
            step = np.linalg.solve(fisher, slope)
            # A step changes an amplitude by e^2 at most, and shrinks until the posterior rises.
            step *= 2.0 / max(2.0, float(np.abs(step).max()))
            before = value
            for share in (1.0, 0.4, 0.16, 0.06):
                trial = np.minimum(log_px + share * step, cap)
                found = evaluate(trial)
                if found[0] > value - 1e-9:
                    log_px, (value, slope, fisher) = trial, found
                    break
            if abs(value - before) < LEAST_GAIN:
                break
        maxima.append((value, log_px))
    (value, best), (_, other) = sorted(maxima, key=lambda one: one[0], reverse=True)
    ratio = value + 0.5 * (best - mean) @ precision @ (best - mean)
    # The octaves of one maximum differ by less than the prior lets them.
    is_lower = bool(np.abs(best - other).max() > OCTAVE_SIGMA)
    return Amplitudes(best, 2.0 * float(ratio), other if is_lower else None)


def _cholesky_and_inverse(matrix: Floats) -> tuple[Floats, Floats]:
    """Return the lower factor and the inverse of a positive definite matrix."""
    if len(matrix) == 0:  # no data show the field
        return matrix, matrix
    lower, failed = dpotrf(matrix, lower=True, clean=True)
    if failed:
        raise np.linalg.LinAlgError('the information on the field is not positive definite')
    below, _ = dpotri(lower, lower=True)
    inverse = below + below.T
    inverse[np.diag_indices(len(inverse))] *= 0.5
    return lower, inverse


def averaged_field(
    information: Floats,
    gradient: Floats,
    octave: Indices,
    amplitudes: Amplitudes,
    term: Floats,
    first: LogPrior = LogPrior(),
) -> Averaged:
    """
    Return the coefficients averaged over a common factor of the amplitudes of the octaves.

    ``term`` (q,) are the coefficients of a departure that is likely, at 1 px.  It is averaged over
    an amplitude of its own; those of the octaves are found without it, since another
    departure may look like it.
    """
    mean, precision = octave_prior(len(amplitudes.log_px), first)
    s = np.exp(amplitudes.log_px)[octave]
    values, vectors = np.linalg.eigh(information * np.outer(s, s))
    values = np.maximum(values, 0.0)
    along = vectors.T @ (s * gradient)
    room = math.log(LARGEST_FIELD_PX) - amplitudes.log_px.max()
    shift = _SHIFTS[room + 1e-9 >= _SHIFTS]
    factor = np.exp(2.0 * shift)[:, None]
    held = 1.0 + values * factor
    variance = factor / held
    off = (amplitudes.log_px - mean)[None] + shift[:, None]
    log_weight = -0.5 * np.log(held).sum(axis=1) + 0.5 * (variance * along**2).sum(axis=1)
    log_weight -= 0.5 * np.einsum('sa,ab,sb->s', off, precision, off)
    # The term, with the coefficients eliminated at each factor, and its amplitudes.
    shown = information @ term
    with_term = vectors.T @ (s * shown)
    own = np.maximum(term @ shown - variance @ with_term**2, 0.0)[:, None]
    pull = (term @ gradient - variance @ (with_term * along))[:, None]
    log_term = log_amplitudes(LARGEST_FIELD_PX)
    prior = np.exp(2.0 * log_term)
    of_term = prior / (1.0 + prior * own)
    log_share = 0.5 * (of_term * pull**2 - np.log1p(prior * own))
    log_share += LogPrior().log_density(log_term)
    share = np.exp(log_share - log_share.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    value = (share * of_term * pull).sum(axis=1)
    spread = (share * (of_term + (of_term * pull) ** 2)).sum(axis=1) - value**2
    back = s[:, None] * vectors
    means = back @ (variance * (along - value[:, None] * with_term)).T + np.outer(term, value)
    centre = means @ weight
    apart = (means - centre[:, None]) * np.sqrt(weight)
    by_term = term[:, None] - back @ (variance * with_term).T
    by_term *= np.sqrt(weight * np.maximum(spread, 0.0))
    best = int(np.argmax(weight))
    return Averaged(
        centre,
        (back * (weight @ variance)) @ back.T + apart @ apart.T + by_term @ by_term.T,
        amplitudes.log_px[-1] + shift,
        weight,
        _of_one(float(own[best, 0]), float(pull[best, 0])),
        float(np.logaddexp.reduce(log_weight + np.logaddexp.reduce(log_share, axis=1))),
    )


def _of_one(information: float, gradient: float) -> Amplitudes:
    """Return the amplitude at the maximum of the likelihood of one coefficient."""
    excess = gradient**2 / information - 1.0 if information > 0 else 0.0
    if excess <= 0:
        return Amplitudes(np.array([math.log(LEAST_PX)]), 0.0)
    log_px = 0.5 * math.log(excess / information)
    return Amplitudes(np.array([log_px]), excess - math.log1p(excess))


@dataclass(frozen=True)
class ShapeSums:
    """
    Sums of each image for its shape, its rotation eliminated.

    ``information`` (m, s, s), ``gradient`` (m, s), ``cross`` (m, s, P) with the shared unknowns;
    ``shared_information`` (P, P) with their priors and ``shared_gradient`` (P,); ``time_s`` (m,)
    of the images, or (0,).
    """

    information: Floats
    gradient: Floats
    cross: Floats
    shared_information: Floats
    shared_gradient: Floats
    time_s: Floats = field(default_factory=lambda: np.empty(0))


# Correlation of the shapes of images one step apart: a lens warms or cools within ten images, or
# within a quarter of an orbit about the Earth if that is shorter.
_PER_STEP = 0.9
_STEP_S = 100.0  # time in which heat loses a tenth


@dataclass(frozen=True)
class Shapes:
    """
    Amplitudes of the shapes of the images.

    ``sigma_px`` (s,): those that represent the posterior (`interval_factor`); ``amplitudes`` has
    its maximum; ``sums`` are those of several images.
    """

    sigma_px: Floats
    amplitudes: Amplitudes
    sums: ShapeSums | None

    @functools.cached_property
    def common_px2(self) -> Floats:
        """Variance (s,) that all images share if the shapes are correlated in time."""
        if self.sums is None:
            return np.zeros(len(self.sigma_px))
        return _common_part(self.sums, self.sigma_px)


def shapes(sums: ShapeSums, near: Amplitudes | None = None) -> Shapes:
    """Return the amplitudes of the shapes; ``near``: those of the round before."""
    likelihood = _shape_likelihood(sums)
    m, count = sums.gradient.shape
    best, value = _climb(likelihood, count, ROWS_AT_ONCE // max(m, 1), near)
    none = np.full(len(best), math.log(LEAST_PX))
    by_prior = (LogPrior().log_density(best) - LogPrior().log_density(none)).sum()
    ratio = 2.0 * (value - float(likelihood(none[None])[0])) - 2.0 * float(by_prior)
    shift = _SHIFTS[math.log(LARGEST_SHAPE_PX) - best.max() >= _SHIFTS]
    log_weight = likelihood(best + shift[:, None])
    if not np.isfinite(log_weight.max()):
        raise NotObservable('the unknowns cannot be separated from the shapes of the images')
    weight = np.exp(log_weight - log_weight.max())
    sigma_px = np.exp(best) * interval_factor(np.exp(shift), weight)
    return Shapes(sigma_px, Amplitudes(best, ratio), sums)


def interval_factor(sigma: Floats, weight: Floats) -> float:
    """
    Return half of the 95.4 % interval of normal errors whose sigma (s,) has weights (s,).

    Errors of an uncertain sigma have long tails, as Student's t has: few images determine no
    variance.  A normal error of this sigma has the same 2-sigma interval.
    """
    shown = weight > ROUNDING * weight.max()
    sigma, weight = sigma[shown], weight[shown]

    def beyond(log_half: float) -> float:
        inside = weight @ erf(math.sqrt(2.0) * math.exp(log_half) / sigma) / weight.sum()
        return float(inside) - math.erf(math.sqrt(2.0))

    low, high = math.log(sigma.min()) - 1.0, math.log(sigma.max()) + 1.0
    return math.exp(brentq(beyond, low, high))


def _shape_likelihood(sums: ShapeSums) -> Callable[[Floats], Floats]:
    """Return the restricted log likelihoods (k,) as a function of log amplitudes (k, s)."""
    m, n, P = sums.cross.shape
    # Shared unknowns and gradient side by side: the same products eliminate both.
    right = np.concatenate([sums.cross, sums.gradient[:, :, None]], axis=2)
    flat = right.reshape(n * m, P + 1).T.copy()
    whole = np.zeros((P + 1, P + 1))
    whole[:P, :P], whole[:P, P] = sums.shared_information, sums.shared_gradient
    total = np.einsum('mii->i', sums.information)

    def likelihood(log_px: Floats) -> Floats:
        k, s = len(log_px), np.exp(log_px)
        shown = np.flatnonzero(s**2 @ total > LEAST_GAIN)
        if k > 1 and len(shown) * m > ROWS_AT_ONCE:
            return np.concatenate([likelihood(log_px[: k // 2]), likelihood(log_px[k // 2 :])])
        left, log_det = np.tile(whole, (k, 1, 1)), np.zeros(k)
        size2 = (s[shown, :, None] * s[shown, None, :])[:, None]
        covariance, log_det[shown] = _inverse(np.eye(n) + sums.information * size2)
        covariance *= size2
        left[shown] -= flat @ (covariance @ right).reshape(len(shown), n * m, P + 1)
        try:
            lower = np.linalg.cholesky(left[:, :P, :P])
        except np.linalg.LinAlgError:
            if k == 1:
                return np.array([-np.inf])
            return np.concatenate([likelihood(one[None]) for one in log_px])
        shared = np.linalg.solve(lower, left[:, :P, P:])[..., 0]
        log_det += 2.0 * np.log(np.einsum('kii->ki', lower)).sum(axis=1)
        prior = LogPrior().log_density(log_px).sum(axis=1)
        return np.asarray(0.5 * ((shared**2).sum(axis=1) - left[:, P, P] - log_det) + prior)

    return likelihood


def _inverse(matrices: Floats) -> tuple[Floats, Floats]:
    """
    Return the inverses of matrices (..., m, n, n), and the sums (...) of m log |M|.

    The matrices are symmetric and positive definite.  By sweeps over their elements (Goodnight
    1979), all matrices at once: a tenth of the time of `numpy.linalg.inv`.
    """
    n = matrices.shape[-1]
    part = {(i, j): matrices[..., i, j].copy() for i in range(n) for j in range(i, n)}
    determinant: Floats = np.ones(matrices.shape[:-2])
    for k in range(n):
        determinant *= part[k, k]
        pivot = 1.0 / part[k, k]
        row = [part[min(i, k), max(i, k)] for i in range(n)]
        scaled = [one * pivot for one in row]
        for (i, j), one in part.items():
            if k not in (i, j):
                one -= scaled[i] * row[j]
        part |= {(min(i, k), max(i, k)): scaled[i] for i in range(n)} | {(k, k): -pivot}
    found = np.empty_like(matrices)
    for (i, j), one in part.items():
        np.negative(one, out=found[..., i, j])
        found[..., j, i] = found[..., i, j]
    return found, np.log(determinant).sum(axis=-1)


def _climb(
    likelihood: Callable[[Floats], Floats], count: int, at_once: int, near: Amplitudes | None
) -> tuple[Floats, float]:
    """
    Return the log amplitudes (count,) of the largest posterior, and its logarithm.

    One amplitude at a time: to each of several values, then by shrinking steps; the trials of the
    next amplitudes are made with it, as far as ``at_once`` allows.  The posterior is flat where an
    amplitude has no effect, so that steps alone do not leave zero.
    """
    coarse = np.log(STARTS_PX if near is None else STARTS_PX[1:6])
    starts = np.tile(coarse[:, None], (1, count)) if near is None else near.log_px[None]
    values = likelihood(starts)
    best, value = starts[np.argmax(values)], float(values.max())
    for step in (0.0, 1.0, 0.3, 0.1):
        k = settled = 0  # the next amplitude, and how many before it did not improve
        while settled < count:
            ahead = max(at_once // len(coarse), 1)
            at = np.arange(k, k + min(ahead, count - settled)) % count
            there = np.tile(coarse, (len(at), 1))
            if step:
                there = best[at, None] + step * np.array([-1.0, 1.0])
            trials = np.tile(best, (*there.shape, 1))
            trials[np.arange(len(at)), :, at] = there
            values = likelihood(trials.reshape(-1, count)).reshape(there.shape)
            values[(there <= math.log(LEAST_PX)) | (there >= math.log(LARGEST_SHAPE_PX))] = -np.inf
            better = np.flatnonzero(values.max(axis=1) > value + LEAST_GAIN)
            k, settled = k + len(at), settled + len(at)
            if len(better):
                first = better[0]
                at_best = values[first].argmax()
                best, value = trials[first, at_best], float(values[first, at_best])
                k, settled = int(at[first]) + 1, 0
    return best, value


def _shared_mean(sums: ShapeSums, sigma_px: Floats) -> Floats:
    """Return the shared unknowns (P,) at amplitudes (s,) of the shapes."""
    P = len(sums.shared_gradient)
    right = np.concatenate([sums.cross, sums.gradient[:, :, None]], axis=2)
    flat = right.reshape(-1, P + 1)
    covariance, _ = _inverse(np.diag(sigma_px**-2.0) + sums.information)
    hidden = flat[:, :P].T @ (covariance @ right).reshape(-1, P + 1)
    return np.linalg.solve(
        sums.shared_information - hidden[:, :P], sums.shared_gradient - hidden[:, P]
    )


def _common_part(sums: ShapeSums, sigma_px: Floats) -> Floats:
    """
    Return the variance (s,) that all images share: that of the camera, which shows in no image.

    With a correlation, images of a campaign share the part c of the variance, the mean
    correlation, and differ by 1 - c.  That correlation and none are equally likely before the
    data: they are averaged over by their evidence, the amplitude integrated over and the mean of
    the images eliminated.
    """
    information = np.einsum('mii->mi', sums.information)
    place, time_s = np.arange(len(information)), sums.time_s
    if len(time_s):
        place[np.argsort(time_s, kind='stable')] = place.copy()
    used = np.flatnonzero((information > 0).all(axis=1))
    if len(used) < 2:
        return np.zeros(len(sigma_px))
    # Some of very many, over the whole campaign, stand for all.
    used = used[np.argsort(place[used])]
    used = used[np.linspace(0, len(used) - 1, min(len(used), MOST_CORRELATED)).astype(np.int64)]
    left = sums.gradient[used] - sums.cross[used] @ _shared_mean(sums, sigma_px)
    root = np.sqrt(information[used])
    steps = np.abs(np.subtract.outer(place[used], place[used])).astype(np.float64)
    if len(time_s):
        apart_s = np.abs(np.subtract.outer(time_s[used], time_s[used]))
        steps = np.maximum(steps, apart_s / _STEP_S)
    K = _PER_STEP**steps
    ratio = (K.sum() - len(K)) / (len(K) ** 2 - K.sum())
    # The shapes, one after the other, in units of their noise.
    values, vectors = np.linalg.eigh(K * root.T[:, :, None] * root.T[:, None, :])
    along = left / root
    of_ones = np.einsum('ms,sma->sa', root, vectors)
    correlated = _evidence(values, of_ones, np.einsum('ms,sma->sa', along, vectors))
    alone = _evidence(information[used].T, root.T, along.T)
    return np.asarray(ratio * expit(correlated - alone) * sigma_px**2)


def _evidence(values: Floats, ones: Floats, along: Floats) -> Floats:
    """
    Return the log evidence (s,) of shapes along the axes of their covariance, mean eliminated.

    Along each axis (s, m): variance at an amplitude of 1 px, component of a common shape, and of
    the shapes.
    """
    log_px = log_amplitudes(LARGEST_SHAPE_PX)
    size2 = np.exp(2.0 * log_px)[:, None]
    inverse = 1.0 / (1.0 + size2 * np.maximum(values, 0.0)[:, None, :])
    of_ones, mean, squared = (
        (inverse @ one[:, :, None])[:, :, 0] for one in (ones**2, ones * along, along**2)
    )
    log_det = np.log(of_ones) - np.log(inverse).sum(axis=2)
    prior = LogPrior().log_density(log_px)
    posterior = prior - 0.5 * (log_det + squared - mean**2 / of_ones)
    return np.asarray(np.logaddexp.reduce(posterior, axis=1))
