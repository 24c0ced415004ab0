# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Errors of a star tracker: dense restricted likelihoods, and the mean's sigma in simulations."""

import math

import numpy as np
from numpy.random import Generator
import pytest
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from starcal_ros.arrays import Floats
from starcal_ros.estimation import tracker_errors as module
from starcal_ros.estimation.amplitudes import interval_factor
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.tracker_errors import (
    correlations_of,
    largest_scatter,
    tracker_errors,
    TrackerErrors,
)
from studies.worlds import simulate, World

CADENCE_NS = 60 * 10**9


def found_of(
    error: Floats,
    variance: float = 1e-4,
    *,
    is_stated: bool = True,
    stated_slow: float = 0.0,
) -> TrackerErrors:
    """Posterior of errors (m, 3)."""
    shared = correlations_in(len(error))
    return tracker_errors(error, np.full_like(error, variance), shared, is_stated, stated_slow)


def far_apart(m: int) -> Rotation:
    return Rotation.random(m, random_state=np.random.default_rng(77))


def correlations_in(m: int) -> module.Correlations:
    """Correlations of an image a minute, with attitudes far apart."""
    return correlations_of(10**18 + CADENCE_NS * np.arange(m), far_apart(m))


def walk(rng: Generator, m: int, time: float, size: float) -> Floats:
    """Stationary Ornstein-Uhlenbeck walks (m, 3); ``time`` in images."""
    rho = math.exp(-1.0 / time)
    steps = rng.normal(size=(m, 3))
    for k in range(1, m):
        steps[k] = rho * steps[k - 1] + math.sqrt(1.0 - rho**2) * steps[k]
    return np.asarray(size * steps)


def test_correlations_are_in_time_and_in_the_distance_of_the_boresights() -> None:
    attitudes = Rotation.from_euler('xz', [[0, 0], [10, 40], [30, 80], [180, 0]], degrees=True)
    time_ns = np.array([0, 10, 40, 100], np.int64) * 10**9
    found = correlations_of(time_ns, attitudes)
    kernels = found.kernels
    times = ['over 30 s', 'over 100 s', 'over 300 s', 'over 1e+03 s']
    angles = ['over 10 deg', 'over 30 deg', 'over 60 deg']
    both = [f'{time} and {angle}' for time in times for angle in angles]
    assert list(found.names) == times + angles + both
    assert found.weight.sum() == pytest.approx(1.0)
    assert found.weight[:7] == pytest.approx(found.weight[7:].sum())
    apart = np.abs(np.subtract.outer([0, 10, 40, 100], [0, 10, 40, 100]))
    for share, K in zip((0.3, 1.0, 3.0, 10.0), kernels[:4], strict=True):
        assert pytest.approx(np.exp(-apart / (100.0 * share))) == K
    halves = [0.5 * (in_time + in_angle) for in_time in kernels[:4] for in_angle in kernels[4:7]]
    assert pytest.approx(np.array(halves)) == kernels[7:]
    for width, K in zip((10.0, 30.0, 60.0), kernels[4:7], strict=True):
        assert np.diag(K) == pytest.approx(1.0)
        chords = 2.0 * np.sin(0.5 * np.radians([10.0, 30.0, 180.0])) / math.radians(width)
        assert K[0, 1:] == pytest.approx(np.exp(-0.5 * chords**2))
    # All over the sky too it is a covariance; with angles for chords one eigenvalue was -0.008.
    sky = Rotation.random(60, random_state=np.random.default_rng(1))
    for K in correlations_of(time_ns[0] + np.arange(60), sky).kernels[4:]:
        assert np.linalg.eigvalsh(K).min() > -1e-12


def brute(error: Floats, variance: float, is_stated: bool, stated_slow: float) -> TrackerErrors:
    """Posterior by dense matrices: covariance, sigma of the mean and sizes, no interval."""
    m, correlations = len(error), correlations_in(len(error))
    rms = math.sqrt((error**2).mean())
    b = -2.1 + 0.35 * np.arange(15 + max(math.ceil((math.log(rms) - 1.8) / 0.35), 0))
    # One of fifty data sheets states no more than none.
    by_sheet, by_none = (
        norm.logpdf(b, 0.0, size) + math.log(share) for size, share in ((0.5, 0.98), (4.0, 0.02))
    )
    log_sheet = np.logaddexp(by_sheet, by_none) if is_stated else by_none
    # Where none is stated, the slow error is as large as the noise.
    centre = np.where(is_stated & (by_sheet > by_none), 0.0, b)
    a = np.linspace(-4.5, 4.0, 18)[:, None]
    slow2 = ((stated_slow or np.exp(centre)) * np.exp(a) * np.ones_like(b)) ** 2
    noise2 = np.exp(2.0 * b)
    # Kernels, sizes of the slow error, sizes of the noise.
    V = slow2[..., None, None] * correlations.kernels[:, None, None]
    V = V + noise2[:, None, None] * np.eye(m)
    contrasts = null_space(np.ones((1, m)))
    within, shown = contrasts.T @ (V + variance * np.eye(m)) @ contrasts, contrasts.T @ error
    squares = (shown * np.linalg.solve(within, shown)).sum(axis=(-2, -1))
    log_likelihood = -0.5 * (squares + 3.0 * np.linalg.slogdet(within)[1])
    log_slow = -0.5 * (a / (0.3 if stated_slow else 1.25)) ** 2
    log = log_likelihood + log_slow + log_sheet + np.log(correlations.weight)[:, None, None]
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    covariance = np.einsum('kab,kabij->ij', weight, V)
    half = interval_factor(np.linalg.inv(V).sum(axis=(-2, -1)).ravel() ** -0.5, weight.ravel())
    shrunk = min(half**2 * m**2 / covariance.sum(), 1.0)
    noise = float((weight * noise2).sum())
    return TrackerErrors(
        math.sqrt(noise),
        math.sqrt((weight * slow2).sum()),
        shrunk * covariance,
        np.arange(m),
        math.sqrt(m) * half,
        2.0 * (log_likelihood.max() - log_likelihood[:, 0].max()),
        correlations.names[int(np.argmax(weight.sum(axis=(1, 2))))],
        shrunk * noise,
    )


@pytest.mark.parametrize(
    ('seed', 'size', 'is_stated', 'stated_slow'),
    [(1, 1.0, True, 0.0), (2, 1.0, False, 0.0), (2, 1.0, True, 2.0), (3, 150.0, True, 0.0)],
)
def test_the_posterior_is_the_dense_average_over_the_grid(
    seed: int, size: float, is_stated: bool, stated_slow: float
) -> None:
    rng = np.random.default_rng(seed)
    error = size * rng.normal(size=(6, 3)) + walk(rng, 6, 10.0, 2.0 * (seed - 1))
    found = found_of(error, 0.04, is_stated=is_stated, stated_slow=stated_slow)
    expected = brute(error, 0.04, is_stated, stated_slow)
    for name in ('noise', 'slow', 'working', 'covariance', 'independent'):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-9), name
    assert found.likelihood_ratio == pytest.approx(expected.likelihood_ratio, abs=1e-8)
    assert found.correlation == expected.correlation


@pytest.mark.parametrize(
    ('noise', 'slow', 'time', 'low', 'high'),
    [
        (1.0, 0.0, 1.0, 0.2, 1.1),
        (2.0, 0.0, 1.0, 0.2, 1.1),
        (1.0, 3.0, 8.0, 0.3, 1.15),
        (0.5, 2.0, 40.0, 0.3, 1.3),
    ],
)
def test_the_sigma_of_the_mean_covers_white_noise_and_walks(noise, slow, time, low, high) -> None:
    # A slow error as large as the noise stays until the images say otherwise: for white noise the
    # sigma is three times too large.
    rng = np.random.default_rng(3)
    m, over = 24, []
    for _ in range(60):
        error = noise * rng.normal(size=(m, 3)) + walk(rng, m, time, slow)
        found = found_of(error)
        over.append(error.mean(axis=0) * math.sqrt(m) / found.working)
        # The covariance of all images has the mean's at most.
        assert found.covariance.sum() / m <= found.working**2 * (1.0 + 1e-9)
    rms = math.sqrt(np.mean(np.square(over)))
    assert low < rms < high


def test_of_two_slow_errors_one_does_not_hide_the_other() -> None:
    # One changes over the sky, which shows, and one in half of the campaign, which may hide.
    rng = np.random.default_rng(5)
    m, over = 60, []
    axes = far_apart(m).as_matrix()[:, 2]
    over_sky = np.linalg.cholesky(np.exp((axes @ axes.T - 1.0) / 0.5**2) + 1e-9 * np.eye(m))
    for _ in range(60):
        slow = over_sky @ rng.normal(size=(m, 3)) + walk(rng, m, 30.0, 0.8)
        error = rng.normal(size=(m, 3)) + slow
        over.append(error.mean(axis=0) * math.sqrt(m) / found_of(error).working)
    assert 0.3 < math.sqrt(np.mean(np.square(over))) < 1.15
    assert np.abs(over).max() < 3.0  # 2.6; with one slow error 4.2, and 1.27 rms


def test_times_may_be_equal() -> None:
    error = np.random.default_rng(8).normal(size=(5, 3))
    attitudes = Rotation.random(5, random_state=np.random.default_rng(1))
    correlations = correlations_of(np.full(5, 10**18), attitudes)
    found = tracker_errors(error, np.full((5, 3), 1e-4), correlations, True, 0.0)
    assert np.isfinite(found.covariance).all() and found.working > 0.3


def test_groups_of_neighbours_give_the_posterior_of_all_images() -> None:
    # A slow walk: 100 images by themselves, and with one more in 51 groups of two.
    rng = np.random.default_rng(4)
    error = rng.normal(size=(101, 3)) + walk(rng, 101, 50.0, 2.0)
    whole, found = found_of(error[:100]), found_of(error)
    assert found.covariance.shape == (51, 51) and whole.covariance.shape == (100, 100)
    assert np.array_equal(found.group, np.arange(101) // 2)
    assert found.noise == pytest.approx(whole.noise, rel=0.02)
    assert found.slow == pytest.approx(whole.slow, rel=0.05)
    assert found.working == pytest.approx(whole.working, rel=0.05)
    assert found.likelihood_ratio == pytest.approx(whole.likelihood_ratio, rel=0.1)


def test_groups_are_neighbours_in_time_in_any_order_of_the_images() -> None:
    time_ns = np.random.default_rng(5).permutation(403)
    group = module.groups_of(time_ns)
    assert np.array_equal(group, time_ns // 5)
    assert np.array_equal(module.groups_of(time_ns[:100]), np.arange(100))
    attitudes = Rotation.random(403, random_state=np.random.default_rng(6))
    order = np.argsort(time_ns)
    found, sorted_ = (
        correlations_of(one, of_one).kernels
        for one, of_one in ((time_ns, attitudes), (time_ns[order], attitudes[order]))
    )
    np.testing.assert_allclose(found, sorted_, rtol=0, atol=1e-12)  # roundings of sums
    # A group of five has the correlation of four over its whole time.
    step = 1.0 / (0.3 * 402)
    apart = np.abs(np.subtract.outer([0, 2, 3, 4], [0, 2, 3, 4]))
    pairs = np.exp(-step * apart)[~np.eye(4, dtype=bool)]
    assert found[0, 0, 0] == pytest.approx((1.0 + 4.0 * pairs.mean()) / 5.0, abs=1e-4)


@pytest.mark.parametrize('stated_arcsec', [0.0, 5.0])
def test_a_slow_error_is_as_large_about_an_axis_of_more_noise(stated_arcsec: float) -> None:
    """Noise about the boresight is that of few photons, and says nothing of slow errors."""
    made = simulate(World(12), 1)
    sigma_arcsec = np.array([20.0, 20.0, 160.0])
    options = CalibrationOptions(
        star_tracker_sigma_arcsec=tuple(sigma_arcsec), star_tracker_slow_arcsec=stated_arcsec
    )
    found = estimate_calibration(made.ensemble, made.scenario.prior, options)
    assert [tracker.axes for tracker in found.attitudes.trackers] == [(0, 1), (2,)]
    across, about = (
        tracker.slow * sigma_arcsec[tracker.axes[0]] for tracker in found.attitudes.trackers
    )
    assert 0.4 < about / across < 2.5
    if stated_arcsec:
        assert across == pytest.approx(stated_arcsec, rel=0.3)


@pytest.mark.parametrize('freedom', [1, 3, 17, 100])
def test_errors_alone_scatter_beyond_the_largest_of_three_axes_once_in_a_hundred(freedom) -> None:
    rng = np.random.default_rng(freedom)
    errors = rng.normal(size=(10_000, freedom, 3))
    largest = np.linalg.eigvalsh(errors.transpose(0, 2, 1) @ errors / freedom)[:, -1]
    # 100 campaigns of 10,000 leave 10 % of their number; the law is right to as much.
    chance = np.mean(largest > largest_scatter(freedom))
    assert chance == pytest.approx(0.01, rel=0.4)
