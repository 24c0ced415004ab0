# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Steps and drifts: found where they are, at their size, and not in noise."""

from __future__ import annotations

import numpy as np
import pytest

from starcal_ground.mission.trend.series import Trend, trend_of
from starcal_ros.constants import SECONDS_PER_YEAR

N = 60
YEARS = np.arange(N) / 12
TIME_S = YEARS * SECONDS_PER_YEAR
SEASONS = 20 + 8 * np.sin(2 * np.pi * (np.arange(N) + 1.5) / 12)
SIGMA = 0.1


def measured(seed: int, truth: np.ndarray) -> Trend:
    noise = np.random.default_rng(seed).normal(0, SIGMA, N)
    return trend_of(TIME_S, truth + noise, np.full(N, SIGMA), SEASONS)


def by_kind(found: Trend) -> dict[str, float]:
    return {term.kind: term.size for term in found.terms}


@pytest.mark.slow
def test_noise_has_no_trend_but_rarely() -> None:
    # p-values of 1e-3 for each of three kinds of term: 0.6 findings in 200 series.
    findings = sum(len(measured(seed, np.zeros(N)).terms) for seed in range(200))
    assert findings <= 4


@pytest.mark.parametrize('after', [1, 10, 30, 57])
def test_a_step_is_found_at_its_place_and_size(after: int) -> None:
    found = measured(3, 1.0 * (np.arange(N) > after))
    (term,) = found.terms
    assert (term.kind, term.after) == ('step', after)
    assert abs(term.size - 1.0) < 4 * term.sigma
    # Two measurements alone on one side determine it to sigma / sqrt(2).
    assert term.sigma == pytest.approx(
        SIGMA * np.sqrt(1 / (after + 1) + 1 / (N - after - 1)), rel=0.3
    )
    assert 0.7 < found.scatter < 1.3


def test_a_drift_and_a_season_are_told_apart() -> None:
    found = measured(5, 0.2 * YEARS + 0.05 * (SEASONS - 20))
    assert {term.kind for term in found.terms} == {'drift', 'temperature'}
    size = by_kind(found)
    assert size['drift'] == pytest.approx(0.2, abs=0.04)  # 4 sigma: 0.1 / (sqrt(60) * 1.44)
    assert size['temperature'] == pytest.approx(0.05, abs=0.01)


def test_steps_are_found_beside_a_drift_and_a_season() -> None:
    month = np.arange(N)
    truth = 0.3 * YEARS + 0.05 * (SEASONS - 20) + 1.5 * (month > 19) - 2.0 * (month > 40)
    found = measured(7, truth)
    steps = {term.after: term.size for term in found.terms if term.kind == 'step'}
    assert set(steps) == {19, 40}
    assert steps[19] == pytest.approx(1.5, abs=0.25) and steps[40] == pytest.approx(-2.0, abs=0.25)
    assert np.abs(found.fit - truth).max() < 0.25


def test_sigmas_that_are_too_small_do_not_make_steps() -> None:
    noise = np.random.default_rng(2).normal(0, 1.0, N)
    found = trend_of(TIME_S, noise, np.full(N, 0.05), SEASONS)
    assert found.terms == () and found.scatter == pytest.approx(20, rel=0.3)


def test_a_single_outlier_is_no_step() -> None:
    truth = np.zeros(N)
    truth[25] = 1.0
    assert measured(4, truth).terms == ()


def test_a_short_series_is_not_tested() -> None:
    found = trend_of(TIME_S[:5], np.array([0, 0, 0, 9, 9.0]), np.full(5, 0.1), SEASONS[:5])
    assert found.terms == () and np.isnan(found.scatter)


def test_unknown_temperatures_are_no_regressor() -> None:
    value = 0.05 * (SEASONS - 20)
    found = trend_of(TIME_S, value, np.full(N, 5.0), np.full(N, np.nan))
    assert all(term.kind != 'temperature' for term in found.terms)
