# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Errors that observations share: unbiased variances, integrals, and sums by brute force."""

import math

import numpy as np
from numpy.random import Generator
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from starcal_ros.arrays import Floats, Indices
from starcal_ros.estimation.amplitudes import LARGEST_FIELD_PX, log_amplitudes
from starcal_ros.estimation.shared_errors import (
    chain_means,
    observation_groups,
    pair_moment,
    pairs_of,
    pixel_variance_px2,
    shared_errors,
    SharedError,
    star_shares_px2,
)

WIDTH = 1200


def test_a_pair_moment_is_the_weighted_mean_of_the_products_of_pairs() -> None:
    rng = np.random.default_rng(2)
    group, weight = rng.integers(0, 6, 30), rng.uniform(0.05, 0.5, 30) ** -2.0
    star = rng.integers(0, 4, 30)
    residual = rng.normal(size=(30, 2))
    for of_star in (None, star):
        apart = ~np.eye(30, dtype=bool) if of_star is None else star[:, None] != star
        both = np.outer(weight, weight) * (apart & (group[:, None] == group))
        products, pairs = (both * (residual @ residual.T)).sum() / 2.0, both.sum()
        of_one_star = None if of_star is None else pairs_of(group, of_star)
        estimate, sigma = pair_moment(residual, weight, group, of_one_star)
        assert estimate == pytest.approx(products / pairs, rel=1e-10)
        assert sigma == pytest.approx(pairs**-0.5, rel=1e-10)


def test_observations_without_a_partner_show_nothing() -> None:
    rng = np.random.default_rng(3)
    residual, weight = rng.normal(size=(40, 2)), rng.uniform(1.0, 900.0, 40)
    assert pair_moment(residual, weight, np.arange(40)) == (0.0, math.inf)
    group = np.repeat(np.arange(8), 5)
    assert pair_moment(residual, weight, group, group) == (0.0, math.inf)


# Weights of an amplitude that follows no other, N(ln 1e-5, 4), on the grid of logarithms.
LOG_PX = log_amplitudes(LARGEST_FIELD_PX)
ALONE = np.exp(-0.5 * ((LOG_PX - math.log(1e-5)) / 4.0) ** 2)


@pytest.mark.parametrize(
    ('estimate', 'sigma'),
    [(0.0, 1e-4), (-1e-4, 1e-4), (4e-4, 1e-4), (0.01, 1e-4), (0.0, math.inf)],
)
def test_a_posterior_mean_is_the_integral_over_the_prior(estimate: float, sigma: float) -> None:
    def density(log_px: float) -> float:
        likelihood = -0.5 * ((estimate - math.exp(2 * log_px)) / sigma) ** 2
        return math.exp(likelihood - 0.5 * ((log_px - math.log(1e-5)) / 4.0) ** 2)

    low, high = math.log(1e-9), math.log(0.5)
    at = math.log(max(estimate, 1e-8)) / 2.0
    options = {'points': (at - 0.1, at, at + 0.1), 'limit': 400, 'epsabs': 0.0}
    above = quad(lambda s: math.exp(2 * s) * density(s), low, high, **options)[0]
    below = quad(density, low, high, **options)[0]
    # Steps of the grid are 17 % of a variance; half of one at most.
    assert chain_means(ALONE, [(estimate, sigma)]) == pytest.approx([above / below], rel=0.08)


FEW_PAIRS = [(1e-4, 3e-4), (2e-4, 3e-4), (0.0, 3e-4)]


@pytest.mark.parametrize(
    ('moments', 'excess', 'near', 'least'),
    [
        ([(4e-4, 1e-4), (0.0, 1e-4), (3e-5, 4e-5)], (0.0, math.inf), 1e-9, 2.8e-4),
        (FEW_PAIRS, (0.0, math.inf), 1e-9, 1e-6),
        # The excess is noise or one octave: of two that share it 0.25 of a variance are missing,
        # and a small one beside a large one has 0.4 too much.
        (FEW_PAIRS, (8e-4, 4e-4), 0.3, 5e-5),
        (FEW_PAIRS, (0.0, 2e-4), 1e-9, 1e-6),
        ([(4e-3, 1e-3), (0.0, 1e-3), (0.0, 1e-3)], (1e-3, 5e-4), 0.5, 5e-4),
        ([(0.04, 1e-3), (0.0, 1e-3), (0.0, 1e-3)], (1e-3, 1e-5), 0.5, 0.03),
    ],
)
def test_a_chain_of_octaves_is_the_sum_over_all_amplitudes(moments, excess, near, least) -> None:
    last = np.log([1e-3, 1e-2]), np.array([0.3, 0.7])
    # Each octave is e^-0.7 of the one before, within e, and one in twenty is as any amplitude.

    def following(log_px: Floats) -> Floats:
        steps = np.exp(-0.5 * (LOG_PX[None, :] - log_px[:, None] + 0.7) ** 2)
        return np.asarray(
            0.95 * steps / steps.sum(axis=1, keepdims=True) + 0.05 * ALONE / ALONE.sum()
        )

    steps, first = following(LOG_PX), last[1] @ following(last[0])
    found = chain_means(first, moments, excess)
    x = np.exp(2 * LOG_PX)
    by = [np.exp(-0.5 * ((e - x) / s) ** 2) for e, s in moments]
    terms = first * by[0], steps * by[1], steps * by[2]
    joint = np.einsum('a,ab,bc->abc', *terms)
    if math.isfinite(excess[1]):
        # Noise that each centroid has alone is as any amplitude.
        log_noise = np.linspace(math.log(1e-9), math.log(0.5), 4000)
        prior = norm.pdf(log_noise, math.log(1e-5), 4.0)
        total = np.linspace(0.0, 5e-3, 800)
        off = (excess[0] - total[:, None] - np.exp(2 * log_noise)) / excess[1]
        likelihood = np.maximum.accumulate(np.exp(-0.5 * off**2) @ prior)
        joint *= np.interp(x[:, None, None] + x[:, None] + x, total, likelihood)
    for k, one in enumerate(found):
        marginal = joint.sum(axis=tuple({0, 1, 2} - {k}))
        assert one == pytest.approx(marginal @ x / marginal.sum(), rel=near)
    assert found[0] > least and found[1] < found[0]


def errors_of(
    residual: Floats,
    variance: Floats,
    pixels: Floats,
    star: Indices,
    last: tuple[Floats, Floats],
    from_sky: Floats | None = None,
) -> tuple[SharedError, ...]:
    """Errors that all observations (n,) share; images are not rolled unless that is given."""
    n = len(residual)
    kinds = observation_groups(pixels, star, WIDTH)
    rolled = np.tile(np.eye(2), (n, 1, 1)) if from_sky is None else from_sky
    unknown = 0.0, math.inf  # excess of the variance of the centroids
    return shared_errors(residual, variance, np.ones(n, bool), kinds, rolled, last, unknown)


def campaign(
    rng: Generator, place_px: float = 0.0, cells_px: float = 0.0
) -> tuple[SharedError, ...]:
    """Errors of 60 stars in 30 rolled images, with star places and finest cells planted."""
    m, n, noise_px = 30, 60, 0.1
    star = np.tile(np.arange(n), m)
    pixels = rng.uniform(0.0, WIDTH - 1.0, (m * n, 2))
    angle = np.repeat(rng.uniform(0.0, 2.0 * np.pi, m), n)
    from_sky = Rotation.from_euler('z', angle[:, None]).as_matrix()[:, :2, :2]
    place = place_px * rng.normal(size=(n, 2))
    residual = noise_px * rng.normal(size=(m * n, 2))
    residual += np.einsum('nij,nj->ni', from_sky, place[star])
    size = WIDTH / 16 / 6
    cell = ((pixels + 0.5) / size).astype(int)
    residual += (cells_px * rng.normal(size=(100, 100, 2)))[cell[:, 0], cell[:, 1]]
    last = np.log([1e-5, 1e-4, 1e-3, 1e-2]), np.full(4, 0.25)
    return errors_of(residual, np.full(m * n, noise_px**2), pixels, star, last, from_sky)


def test_the_errors_have_their_names_and_groups() -> None:
    rng = np.random.default_rng(4)
    found = campaign(rng)
    octaves = [f'field at 1/{part} of the width' for part in (4, 8, 16)]
    assert [e.name for e in found] == ['star places', *octaves]
    assert [e.of_star for e in found] == [True] + [False] * 3
    assert pixel_variance_px2(found) == pytest.approx(sum(e.variance_px2 for e in found[1:]))
    assert not found[0].matters and star_shares_px2(found) == (0.0, 0.0)
    found = campaign(rng, place_px=0.05)
    share_px2, beyond_px2 = star_shares_px2(found)
    assert np.array_equal(share_px2, found[0].share_px2)
    assert np.array_equal(beyond_px2, found[0].beyond_px2)


def test_each_error_has_its_likelihood_ratio_and_its_effect() -> None:
    rng = np.random.default_rng(8)
    n = 300
    pixels = rng.uniform(0.0, 1199.0, (n, 2))
    star, variance = rng.integers(0, 60, n), rng.uniform(0.1, 0.4, n) ** 2
    residual = rng.normal(size=(n, 2)) * np.sqrt(variance)[:, None]
    last = np.log([1e-4, 1e-2]), np.array([0.5, 0.5])
    found = errors_of(residual, variance, pixels, star, last)
    ratios = []
    of_star = found[0]
    # Cells are compared by the weights of stars of several sightings.
    working = variance + np.bincount(star)[star] * of_star.share_px2
    working -= of_star.share_px2 - of_star.beyond_px2
    for error in found:
        weight = 1.0 / (variance if error.of_star else working)
        if not error.of_star:
            moment = pair_moment(residual, weight, error.group, pairs_of(error.group, star))
            ratios.append(moment[0] / moment[1])
            expected = max(ratios[-1], 0.0) ** 2
            assert error.likelihood_ratio == pytest.approx(expected, rel=1e-9)
        # Groups weigh as much as their observations; the noise of the mean of one is 1 / W.
        common = np.bincount(error.group, weight * np.sqrt(error.share_px2))
        expected = float((common**2).sum() / weight.sum())
        assert error.effect == pytest.approx(expected, rel=1e-9)
        assert error.matters is (expected > (0.02 if error.of_star else 0.01))
    assert min(ratios) < 0.0 < max(ratios) < 3.0


@pytest.mark.parametrize(
    ('planted', 'name'),
    [
        ({'place_px': 0.05}, 'star places'),
        ({'cells_px': 0.15}, 'field at 1/16 of the width'),
    ],
)
def test_a_planted_error_is_found_with_its_size(planted: dict[str, float], name: str) -> None:
    (size_px,) = planted.values()
    variances = []
    for seed in range(10):
        found = {e.name: e for e in campaign(np.random.default_rng(seed), **planted)}
        assert found[name].likelihood_ratio > 9.0
        variances.append(found[name].variance_px2)
        if name != 'star places':
            assert found['star places'].variance_px2 < 0.1 * size_px**2
    # 120 groups' components leave 13 % of a variance, 4 % of ten campaigns' mean.  The chain
    # of the octaves expects less of the finest.
    tolerance = 0.15 if name != 'field at 1/16 of the width' else 0.3
    assert np.mean(variances) == pytest.approx(size_px**2, rel=tolerance)


def stare(
    seed: int, place_px: float = 0.0, rho: float = 0.0, blend: float = 0.0
) -> tuple[tuple[SharedError, ...], Floats, Floats]:
    """
    Errors found in 25 images of the same 100 stars, which drift along the rows.

    With sigmas (n,) of the centroids, 0.03 to 0.3 px, and the displacement of each star (100, 2):
    of its place, of ``rho`` of its variance, and of ``blend`` sigma for each tenth star.
    """
    rng = np.random.default_rng(seed)
    m, n = 25, 100
    star = np.tile(np.arange(n), m)
    sigma: Floats = np.asarray(np.geomspace(0.03, 0.3, n), np.float64)
    start, drift = rng.uniform(0.0, 1000.0, (n, 2)), np.repeat(np.arange(m), n)
    pixels = start[star] + np.stack([7.0 * drift, np.zeros(m * n)], 1)
    moved = (place_px + math.sqrt(rho) * sigma)[:, None] * rng.normal(size=(n, 2))
    moved[::10] += blend * sigma[::10, None] * [0.6, 0.8]
    noise = math.sqrt(1.0 - rho) * sigma[star, None] * rng.normal(size=(m * n, 2))
    variance = sigma[star] ** 2 * (1.0 + 0.05 * blend**2) + place_px**2
    last = np.log([1e-5, 1e-3]), np.full(2, 0.5)
    return errors_of(moved[star] + noise, variance, pixels, star, last), sigma[star], moved


@pytest.mark.parametrize(
    ('place_px', 'rho'), [(0.0, 0.0), (0.03, 0.0), (0.0, 0.25), (0.1, 0.0), (0.0, 0.8)]
)
def test_what_a_star_shares_is_of_one_size_or_grows_with_its_faintness(place_px, rho) -> None:
    shares = []
    for seed in range(12):
        found, sigma, _ = stare(seed, place_px, rho)
        shares.append(found[0].share_px2 - found[0].beyond_px2)
    variance = sigma[:100] ** 2 + place_px**2
    planted = (place_px**2 + rho * sigma[:100] ** 2) / variance
    share = np.mean(shares, axis=0)[:100] / variance
    # 30 stars of a class in 12 campaigns leave 6 % of their variance.
    for part in (slice(0, 30), slice(35, 65), slice(70, 100)):
        assert share[part].mean() == pytest.approx(planted[part].mean(), rel=0.2, abs=0.002)


@pytest.mark.parametrize('of_star', [True, False])
def test_what_stars_of_one_field_share_may_be_structure_of_the_detector(of_star: bool) -> None:
    """Neighbours, 140 pairs in coarse cells, tell stars from waves; finer ones are of one star."""
    m, n, size_px, variances = 25, 400, 0.07, []
    star = np.tile(np.arange(n), m)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        pixels = rng.uniform(0.0, 1199.0, (n, 2))[star] + 5.0 * rng.normal(size=(m * n, 2))
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, 2))
        wave = np.sin(2.0 * np.pi / 270.0 * pixels[:, None, :] + phase).prod(axis=2)
        moved = rng.normal(size=(n, 2))[star] if of_star else 2.0 * wave
        residual = size_px * moved + 0.2 * rng.normal(size=(m * n, 2))
        last = np.log([1e-6, 1e-5, 1e-4]), np.full(3, 1.0 / 3.0)
        found = errors_of(residual, np.full(m * n, 0.2**2 + size_px**2), pixels, star, last)
        assert found[0].variance_px2 == pytest.approx(size_px**2, rel=0.4)
        variances.append(pixel_variance_px2(found))
    share = float(np.mean(variances)) / size_px**2
    assert share < 0.02 if of_star else 0.5 < share < 1.5


def test_a_blended_star_has_a_share_of_its_own_and_leaves_that_of_the_others() -> None:
    for seed in range(5):
        found, sigma, moved = stare(seed, rho=0.1, blend=3.0)
        share = np.sqrt(found[0].share_px2[:100]) / sigma[:100]
        blended = np.arange(100) % 10 == 0
        # Planted are 0.32 and 2.1; without factors all would have 0.74.
        assert 0.25 < np.median(share[~blended]) < 0.65
        assert 1.3 < np.median(share[blended]) < 3.0
        weights = found[0].share_px2[:100] / sigma[:100] ** 2
        assert np.corrcoef(weights, (moved**2).sum(axis=1) / sigma[:100] ** 2)[0, 1] > 0.9


def test_two_stars_in_the_same_cell_again_and_again_are_one_pair() -> None:
    """Stars that drift side by side share no error of the detector with each other."""
    errors = [error for k in range(20) for error in stare(k, rho=0.25)[0]]
    ratios = np.array([error.likelihood_ratio for error in errors if not error.of_star])
    # 1 %, one-sided, and one by chance.
    assert len(ratios) == 60 and np.count_nonzero(ratios > 5.41) <= 2 and ratios.max() < 16.0
