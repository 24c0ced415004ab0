# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Weights from residuals: planted centroid variances, leverage, and residuals of no star."""

from typing import Any

from four_images import CAMERA, IMAGES, usual  # type: ignore[import-not-found]
import numpy as np
from numpy.random import Generator
import pytest
from scipy.optimize import minimize

from starcal_ros.arrays import Floats
from starcal_ros.estimation.centroid_variance import (
    _brightness,
    CentroidVariance,
    estimate_variance,
)
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.estimation.posterior import Weighting
from starcal_ros.estimation.shared_errors import observation_groups
from starcal_ros.estimation.tracker_errors import Rates
from starcal_ros.estimation.unknowns import Assumptions
from starcal_ros.estimation.weights import axes_by_sigma, Data, judge
from starcal_ros.records import CameraGeometry

N = 6000


def centroids(rng: Generator, n: int = N) -> tuple[Floats, Floats]:
    """Return covariances (n, 3) as measured and magnitudes (n,)."""
    magnitude = rng.uniform(1.0, 8.0, n)
    sigma_px = 0.01 * 10 ** (0.2 * (magnitude - 1.0))
    ratio = rng.uniform(0.8, 1.25, n)
    covariance = np.stack([sigma_px**2 * ratio, 0.0 * ratio, sigma_px**2 / ratio], axis=1)
    return covariance, magnitude


def residuals(rng: Generator, covariance_px2: Floats) -> Floats:
    noise = rng.normal(size=(len(covariance_px2), 2))
    return np.asarray(noise * np.sqrt(covariance_px2[:, [0, 2]]))


def estimated(
    residual: Floats, covariance: Floats, magnitude: Any, used: Any = True, freedom: Any = 2.0
) -> CentroidVariance:
    n = len(residual)
    magnitudes, are_used = np.broadcast_to(magnitude, n), np.broadcast_to(used, n)
    freedoms = np.broadcast_to(freedom, n)
    return estimate_variance(residual, covariance, magnitudes, are_used, freedoms, 4.5)


@pytest.mark.parametrize(
    ('scale', 'floor_px'), [(1.0, 0.0), (1.0, 0.05), (4.0, 0.02), (0.25, 0.0), (0.25, 0.1)]
)
def test_a_planted_scale_and_floor_are_recovered(scale: float, floor_px: float) -> None:
    rng = np.random.default_rng(1)
    covariance, magnitude = centroids(rng)
    true = scale * covariance + floor_px**2 * np.array([1.0, 0.0, 1.0])
    found = estimated(residuals(rng, true), covariance, magnitude)
    # 6000 stars of two axes leave 1.3 % of a variance, and the clip takes 0.04 % off.
    of_star = found.of(covariance, magnitude)[:, [0, 2]] / true[:, [0, 2]]
    assert np.median(of_star) == pytest.approx(1.0, abs=0.05)
    assert np.abs(np.log(of_star)).max() < 0.3
    if floor_px:
        assert found.floor_px2 == pytest.approx(floor_px**2, rel=0.15)
    else:
        assert found.floor_px2 < 0.05 * scale * np.median(covariance[:, 0])
    assert found.scale == pytest.approx(scale, rel=0.12)


def test_a_planted_function_of_brightness_is_recovered() -> None:
    rng = np.random.default_rng(2)
    covariance, magnitude = centroids(rng)
    factor = np.interp(magnitude, [1.0, 4.0, 8.0], [6.0, 1.0, 1.0])
    found = estimated(residuals(rng, covariance * factor[:, None]), covariance, magnitude)
    assert len(found.class_magnitude) == 5
    assert found.class_magnitude[0] == magnitude.min()
    assert found.class_magnitude[2] == pytest.approx(np.median(magnitude))
    assert list(found.class_magnitude) == sorted(found.class_magnitude)
    of_star = found.of(covariance, magnitude)[:, 0] / (covariance[:, 0] * factor)
    for low, high in ((1.0, 2.0), (2.0, 3.0), (4.5, 8.0)):
        here = (magnitude >= low) & (magnitude < high)
        assert np.mean(of_star[here]) == pytest.approx(1.0, abs=0.15)
    assert found.factor(np.array([-5.0, 20.0])) == pytest.approx(
        [found.class_factor[0], found.class_factor[-1]]
    )


def test_few_stars_show_little_of_a_function_of_brightness() -> None:
    rng = np.random.default_rng(4)
    covariance, magnitude = centroids(rng, 80)
    alike = estimated(residuals(rng, covariance), covariance, 5.0)
    assert alike.class_magnitude == () == alike.class_factor
    assert alike.factor(np.array([1.0, 9.0])).tolist() == [1.0, 1.0]
    # The prior of a factor of e^0.5 holds what few stars do not show.
    few = estimated(residuals(rng, covariance)[:10], covariance[:10], magnitude[:10])
    assert np.log(few.class_factor) == pytest.approx(0.0, abs=0.5)
    one = estimated(residuals(rng, 9.0 * covariance), covariance, magnitude)
    assert one.scale == pytest.approx(9.0, rel=0.35)
    assert np.log(one.class_factor) == pytest.approx(0.0, abs=0.5)


def test_only_stars_that_are_used_count_and_outliers_do_not() -> None:
    rng = np.random.default_rng(5)
    covariance, magnitude = centroids(rng)
    residual = residuals(rng, covariance)
    plain = estimated(residual, covariance, magnitude)
    wrong = residual.copy()
    wrong[::50] = 30.0 * np.sqrt(covariance[::50, :1])
    assert estimated(wrong, covariance, magnitude).scale == pytest.approx(plain.scale, rel=0.05)
    used = np.arange(N) % 3 > 0
    residual[~used] *= 3.0  # within the clip
    found = estimated(residual, covariance, magnitude, used)
    assert found.scale == pytest.approx(1.0, abs=0.1)
    assert estimated(residual, covariance, magnitude).scale > 1.3


def test_the_clip_is_at_four_and_a_half_sigma_and_makes_no_step() -> None:
    n = 1000
    covariance = np.tile([1.0, 0.0, 1.0], (n, 1))
    residual = np.random.default_rng(6).normal(size=(n, 2))
    without = estimated(residual[3:], covariance[3:], 5.0)
    scales = []
    for length in np.linspace(4.0, 5.6, 33):
        residual[:3] = [length, 0.0]
        scales.append(estimated(residual, covariance, 5.0).scale / without.scale)
    # With an edge the three stars were worth 3 % at once, and an estimate went to and fro.
    assert np.abs(np.diff(scales)).max() < 0.006
    assert np.argmax(scales) in (1, 2, 3, 4) and max(scales) > 1.02
    assert scales[-1] == pytest.approx(1.0, abs=0.002)


def test_a_star_without_freedom_does_not_count_without_limit() -> None:
    rng = np.random.default_rng(8)
    covariance, magnitude = centroids(rng, 400)
    residual = residuals(rng, covariance)
    residual[:20] = 0.0
    freedom = np.where(np.arange(400) < 20, 0.0, 2.0)
    found = estimated(residual, covariance, magnitude, freedom=freedom)
    assert found.scale == pytest.approx(1.0, abs=0.25)


def test_a_covariance_that_means_nothing_reaches_the_limits_and_a_floor() -> None:
    covariance, magnitude = centroids(np.random.default_rng(9), 500)
    found = estimated(np.full((500, 2), 1e-9), covariance, magnitude)
    assert (found.scale, found.floor_px2) == (0.05, 0.0)
    rng = np.random.default_rng(10)
    n = 2000
    covariance = np.tile([1e-8, 0.0, 1e-8], (n, 1)) * rng.uniform(0.5, 2.0, (n, 1))
    found = estimated(rng.normal(size=(n, 2)) * 0.1, covariance, 5.0)
    assert found.scale <= 400.0
    assert found.of(covariance, np.full(n, 5.0))[:, 0].mean() == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize('bright_px', [0.005, 0.03])
def test_scale_and_floor_maximise_the_restricted_likelihood(bright_px: float) -> None:
    """A bright star holds the shift of its image: counted as any other, it takes scale with it."""
    rng = np.random.default_rng(15)
    images, stars, floor_px = 100, 6, 0.02
    own = np.tile([bright_px, *np.geomspace(0.05, 0.2, stars - 1)], images) ** 2
    covariance = np.stack([own, 0.0 * own, own], axis=1)
    error = residuals(rng, covariance + floor_px**2 * np.array([1.0, 0.0, 1.0]))

    def fitted(variance: Floats) -> tuple[Floats, Floats]:
        """Residuals (n, 2) of the shifts, and the freedom (n,) that is left."""
        weight = (1.0 / variance).reshape(images, stars)
        share = weight / weight.sum(axis=1, keepdims=True)
        shift = np.einsum('ms,msa->ma', share, error.reshape(images, stars, 2))
        return error - np.repeat(shift, stars, axis=0), 2.0 * (1.0 - share.ravel())

    def cost(log: Floats) -> float:
        variance = np.exp(log[0]) * own + np.exp(log[1])
        weight = (1.0 / variance).reshape(images, stars)
        squared = (fitted(variance)[0] ** 2).sum(axis=1) / variance
        return float(np.log(variance).sum() + np.log(weight.sum(axis=1)).sum() + squared.sum() / 2)

    best = np.exp(minimize(cost, np.log([1.0, floor_px**2]), method='Nelder-Mead').x)
    variance = own + 0.05**2
    for _ in range(40):
        residual, freedom = fitted(variance)
        assert ((residual**2).sum(axis=1) < 4.0**2 * variance).all()  # inside the clip
        found = estimated(residual, covariance, 5.0, freedom=freedom)
        variance = found.scale * own + found.floor_px2
    # Rounds stop at a step of a twentieth of a sigma.
    assert (found.scale, found.floor_px2) == pytest.approx(tuple(best), rel=5e-3)


def test_outliers_are_no_function_of_brightness() -> None:
    rng = np.random.default_rng(12)
    covariance, magnitude = centroids(rng)
    residual = residuals(rng, covariance)
    bright = np.flatnonzero(magnitude < 2.0)[::12]
    residual[bright] = 5.0 * np.sqrt(covariance[bright][:, [0]]) * [0.6, 0.8]
    found = estimated(residual, covariance, magnitude)
    # A twelfth of the bright stars at 5 sigma would be a factor of two.
    assert found.class_factor[0] == pytest.approx(1.0, abs=0.15)


def test_the_function_of_brightness_is_the_mode_of_its_posterior() -> None:
    rng = np.random.default_rng(13)
    magnitude = np.sort(rng.uniform(1.0, 8.0, 120))
    ratio = 1.5 * rng.chisquare(2, 120) / 2.0
    ratio = np.minimum(ratio, 10.0)  # inside the clip
    nodes, factors = _brightness(ratio, np.ones(120), magnitude)

    def cost(log_factor: Floats) -> float:
        log = np.interp(magnitude, nodes, log_factor)
        # Squares of two axes are exponential; half a logarithm is the sigma of the prior.
        return float((log + ratio * np.exp(-log)).sum() + 0.5 * (log_factor**2).sum() / 0.5**2)

    expected = minimize(cost, np.zeros(len(nodes)), method='BFGS', options={'gtol': 1e-8}).x
    assert len(nodes) == 5
    # Rounds stop at a step of a twentieth of a sigma, and each takes most of what is left.
    assert np.log(factors) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(
    ('off_px', 'words'), [(np.nan, 'no star has an image'), (1e3, 'three stars that fit')]
)
def test_residuals_that_no_star_is_left_of_say_so(off_px: float, words: str) -> None:
    table = usual()[0].table
    n = len(table)
    data = Data(
        table,
        np.arange(IMAGES),
        np.ones(3),
        CameraGeometry(CAMERA, np.array([0.0, 0.0, 0.0, 1.0])),
        CalibrationOptions(variance_components=False),
        Rates(np.zeros((IMAGES, 3)), np.zeros((IMAGES, 3, 3))),
        Assumptions(0.0, (0.0, 0.0), 0.0),
        observation_groups(table.measured_px, table.star, CAMERA.width),
    )
    from_sky = np.tile(np.eye(2), (n, 1, 1))
    variance = CentroidVariance(1.0, 0.0)
    before = Weighting(table, from_sky, variance, (), np.ones(n, bool), None)
    off = off_px * np.random.default_rng(1).normal(size=(n, 2))
    with pytest.raises(NotObservable, match=words):
        judge(data, off, np.full(n, 2.0), before, None)


def test_axes_of_one_stated_sigma_are_taken_together() -> None:
    assert axes_by_sigma(np.array([5.0, 20.0, 5.0])) == [(5.0, (0, 2)), (20.0, (1,))]
