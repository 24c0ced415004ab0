# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star-tracker errors in time: white ones cost nothing, wandering ones widen the sigma."""

from __future__ import annotations

import numpy as np
import pytest

from starcal_ros.arrays import Floats
from starcal_ros.model_errors.attitude_correlation import attitude_correlation

MINUTE_NS = 60_000_000_000
SIGMA_RAD = 1e-4


def white(rng: np.random.Generator, m: int) -> Floats:
    return SIGMA_RAD * rng.normal(size=(m, 3))


def wandering(rng: np.random.Generator, m: int, images: float) -> Floats:
    """An Ornstein-Uhlenbeck process of three times that sigma, and white noise."""
    keep = np.exp(-1.0 / images)
    error = 3.0 * SIGMA_RAD * rng.normal(size=(m, 3))
    for k in range(1, m):
        error[k] = keep * error[k - 1] + np.sqrt(1.0 - keep**2) * error[k]
    return error + white(rng, m)


def test_white_errors_are_seldom_taken_for_wandering_ones() -> None:
    rng = np.random.default_rng(1)
    time_ns, noise = np.arange(40) * MINUTE_NS, np.full((40, 3), 1e-12)
    detected = [
        attitude_correlation(time_ns, white(rng, 40), noise, suspect=False).detected
        for _ in range(100)
    ]
    assert sum(detected) <= 16  # 8 of 100 by draws; twice that has a probability of 0.4 %


@pytest.mark.parametrize('m', [40, 120])
def test_the_sigma_of_the_mean_holds(m: int) -> None:
    """The mean of wandering errors over its sigma, RMS over 40 ensembles and three axes."""
    rng = np.random.default_rng(m)
    time_ns, noise = np.arange(m) * MINUTE_NS, np.full((m, 3), 1e-12)
    squares = []
    for _ in range(40):
        error = wandering(rng, m, 10.0)
        found = attitude_correlation(time_ns, error, noise, suspect=False)
        assert found.detected
        variance = error.var(axis=0, ddof=1) / m + found.added_variance_rad2
        squares.append(error.mean(axis=0) ** 2 / variance)
    assert 0.6 < np.sqrt(np.mean(squares)) < 1.5  # 120 numbers: 7 %, and the times are not known


def test_a_short_ensemble_that_scatters_too_much_is_not_trusted() -> None:
    rng = np.random.default_rng(4)
    time_ns, noise = np.arange(14) * MINUTE_NS, np.full((14, 3), 1e-12)
    error = white(rng, 14)
    assert not attitude_correlation(time_ns, error, noise, suspect=False).detected
    assert (
        attitude_correlation(time_ns, error, noise, suspect=True).independent_images < 10
    ).all()


def test_a_known_sigma_bounds_what_the_mean_can_be_off() -> None:
    """A mean is off by no more than a star tracker is, however slowly it wanders."""
    rng = np.random.default_rng(4)
    time_ns, noise = np.arange(14) * MINUTE_NS, np.full((14, 3), 1e-12)
    error = white(rng, 14)
    free, bounded = (
        attitude_correlation(time_ns, error, noise, True, largest_rad)
        for largest_rad in (np.full(3, np.inf), np.full(3, SIGMA_RAD))
    )
    assert (free.added_variance_rad2 > bounded.added_variance_rad2).all()
    assert (np.sqrt(bounded.added_variance_rad2) < SIGMA_RAD).all()


def test_few_images_show_nothing() -> None:
    found = attitude_correlation(
        np.arange(5) * MINUTE_NS, np.zeros((5, 3)), np.full((5, 3), 1e-12), suspect=True
    )
    assert not found.detected and (found.added_variance_rad2 == 0).all()
