# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The polynomial correction: recovery of a known one, and number of terms by star count."""

from __future__ import annotations

import numpy as np
import pytest

from starcal_ros.identification.prediction import fit_warp, warp_powers

HALF_PX = 320.0


def bent(xy_px: np.ndarray) -> np.ndarray:
    """Shift and barrel distortion up to 3 px."""
    uv = (xy_px - HALF_PX) / HALF_PX
    return np.asarray([0.5, -0.25] + uv * (uv**2).sum(axis=1, keepdims=True))


def test_a_polynomial_is_found_among_outliers() -> None:
    rng = np.random.default_rng(2)
    predicted_px = rng.uniform(0, 2 * HALF_PX, (200, 2))
    noise_px = rng.normal(0, 0.1, (200, 2))
    noise_px[::10] = rng.uniform(-8, 8, (20, 2))
    at_px = rng.uniform(50, 2 * HALF_PX - 50, (100, 2))
    measured_px = predicted_px + bent(predicted_px) + noise_px
    correction, scatter_px = fit_warp(predicted_px, measured_px, np.full(200, 0.1), at_px, HALF_PX)
    # 21 terms from 180 stars of 0.1 px: 0.035 px at a typical place, four of those.
    assert np.abs(correction - bent(at_px)).max() < 0.14
    # The sigma per axis, to 10 % from 200 stars; the outliers lift it by as much at most.
    assert 0.08 < scatter_px < 0.12


@pytest.mark.parametrize(('stars', 'terms'), [(4, 1), (12, 3), (36, 10), (150, 21)])
def test_few_stars_carry_few_terms(stars: int, terms: int) -> None:
    assert len(warp_powers(stars)) == terms
    assert len(warp_powers(stars - 1)) < terms or stars == 4
