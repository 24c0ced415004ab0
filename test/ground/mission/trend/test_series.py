# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Series, activations and changes of calibrations whose differences are known."""

from export_calibrations import calibration  # type: ignore[import-not-found]
import numpy as np
import pytest
from trend_rows import DAY_NS, made  # type: ignore[import-not-found]

from starcal_ground.mission.trend.series import (
    activations,
    change,
    distinct,
    groups,
    pairs,
    series_of,
    Trend,
    trend_of,
)
from starcal_ground.mission.trend.trend_table import FAILED, Row
from starcal_ros.constants import ARCSECOND_RAD, SECONDS_PER_YEAR


def test_boresight_and_alignment_turn_as_the_camera_does() -> None:
    rows = [made(1), made(2, (10.0, -20.0, 30.0))]
    found = {series.name: series.value for series in series_of(rows)}
    for axis, expected in zip('xyz', (10.0, -20.0, 30.0), strict=True):
        np.testing.assert_allclose(found[f'alignment_{axis}'], [0, expected], atol=1e-6)
    # The middle is 0.06 degrees off the axis: a roll of 30 arcsec moves it by 0.03.
    np.testing.assert_allclose(found['boresight about x'], [0, 10.0], atol=0.05)
    np.testing.assert_allclose(found['boresight about y'], [0, -20.0], atol=0.05)


def test_a_change_is_the_rotation_in_pixels() -> None:
    rows = [made(1, active_since_ns=1 * DAY_NS), made(2, (10.0, 0, 0)), made(3, (0, 0, 0))]
    active = activations(rows)
    assert active == [(DAY_NS, 0)] and pairs(rows, active) == [(1, 0), (2, 0)]
    first, second = (change(rows, *pair) for pair in pairs(rows, active))
    pixels = 10 * ARCSECOND_RAD * calibration().geometry.camera.parameters[0]
    assert first.px == pytest.approx(pixels, rel=0.05)  # less far off the axis
    # Each angle of both calibrations has a 1-sigma of 1e-4 rad, the parameters much less.
    assert first.sigmas == pytest.approx(10 * ARCSECOND_RAD / 2e-4, rel=0.1)
    assert (second.row, second.against) == (2, 0) and second.px < 1e-6


def test_activations_are_those_recorded_or_each_accepted_one() -> None:
    rows = [made(1), made(2, accepted=False, reasons=('bad',)), made(3)]
    assert [k for _, k in activations(rows)] == [0, 2]
    assert pairs(rows, activations(rows)) == [(1, 0), (2, 0)]
    assert activations(rows[1:2]) == [] and pairs(rows[1:2], []) == []
    # One that was activated twice counts once in a series.
    rows = [made(1, active_since_ns=5), made(2, active_since_ns=8), made(1, active_since_ns=9)]
    assert [row.stamp for row in distinct(rows)] == ['1', '2']
    assert activations(rows) == [(5, 0), (8, 1), (9, 2)]
    # Cameras are apart, and failures are none.
    rows = [made(1), made(2, child_frame='other'), made(3), Row('x', 'x', FAILED, error='bad')]
    assert [len(group) for group in groups(rows).values()] == [2, 1]


N = 60
YEARS = np.arange(N) / 12
TIME_S = YEARS * SECONDS_PER_YEAR
SEASONS = 20 + 8 * np.sin(2 * np.pi * (np.arange(N) + 1.5) / 12)
SIGMA = 0.1


def measured(seed: int, truth: np.ndarray) -> Trend:
    noise = np.random.default_rng(seed).normal(0, SIGMA, N)
    return trend_of(TIME_S, truth + noise, np.full(N, SIGMA), SEASONS)


@pytest.mark.slow
def test_noise_has_no_trend_but_rarely() -> None:
    # p-values of 1e-3 for each of three kinds of term: 0.6 findings in 200 series.
    findings = sum(len(measured(seed, np.zeros(N)).terms) for seed in range(200))
    assert findings <= 4


@pytest.mark.parametrize('after', [1, 10, 30, 57])
def test_a_step_is_found_at_its_place_and_size(after) -> None:
    found = measured(3, 1.0 * (np.arange(N) > after))
    (term,) = found.terms
    assert (term.kind, term.after) == ('step', after)
    assert abs(term.size - 1.0) < 4 * term.sigma
    # Two measurements alone on one side determine it to sigma / sqrt(2).
    assert term.sigma == pytest.approx(
        SIGMA * np.sqrt(1 / (after + 1) + 1 / (N - after - 1)), rel=0.3
    )
    assert 0.7 < found.scatter < 1.3


def test_a_drift_a_season_and_steps_are_told_apart() -> None:
    month = np.arange(N)
    truth = 0.3 * YEARS + 0.05 * (SEASONS - 20) + 1.5 * (month > 19) - 2.0 * (month > 40)
    found = measured(7, truth)
    terms = {term.after if term.kind == 'step' else term.kind: term for term in found.terms}
    expected: dict[int | str, float] = {19: 1.5, 40: -2.0, 'drift': 0.3, 'temperature': 0.05}
    assert terms.keys() == expected.keys()
    for name, size in expected.items():
        assert abs(terms[name].size - size) < 4 * terms[name].sigma < 0.25
    assert np.abs(found.fit - truth).max() < 0.25


def test_a_drift_of_many_sigmas_is_found_in_few_calibrations() -> None:
    """Seven in three years: the scatter of five residuals alone is no measure of the sigmas."""
    years = np.arange(7) / 2
    value = np.array([0.0, 12.0, 16.0, 31.0, 43.0, 55.0, 57.0])
    found = trend_of(years * SECONDS_PER_YEAR, value, np.full(7, 10.0), np.full(7, np.nan))
    (term,) = found.terms
    # 57 in three years, of a known sigma of 10 over a spread of 2.6 years: 5.3 sigma.
    assert term.kind == 'drift' and term.size == pytest.approx(20.4, abs=0.5)
    assert term.sigma == pytest.approx(3.8, abs=0.1)


def test_an_outlier_a_short_series_and_unknown_temperatures_are_no_finding() -> None:
    truth = np.zeros(N)
    truth[25] = 1.0
    assert measured(4, truth).terms == ()
    noise = np.random.default_rng(2).normal(0, 1.0, N)  # of sigmas that are too small
    found = trend_of(TIME_S, noise, np.full(N, 0.05), SEASONS)
    assert found.terms == () and found.scatter == pytest.approx(20, rel=0.3)
    found = trend_of(TIME_S[:5], np.array([0, 0, 0, 9, 9.0]), np.full(5, 0.1), SEASONS[:5])
    assert found.terms == () and np.isnan(found.scatter)
    value = 0.05 * (SEASONS - 20)
    found = trend_of(TIME_S, value, np.full(N, 5.0), np.full(N, np.nan))
    assert all(term.kind != 'temperature' for term in found.terms)
