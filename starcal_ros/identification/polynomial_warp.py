# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Smooth polynomial correction from predicted to measured pixels."""

from __future__ import annotations

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.robust_statistics import median, medians, RAYLEIGH_TO_SIGMA


def warp_powers(n: int) -> list[tuple[int, int]]:
    """Exponents (i, j) of u^i v^j in the correction for n stars."""
    degree = 5 if n >= 150 else 3 if n >= 36 else 1 if n >= 12 else 0
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]


def fit_warp(
    predicted_px: Floats, measured_px: Floats, sigma_px: Floats, at_px: Floats, half_px: float
) -> tuple[Floats, float]:
    """
    Smooth correction (k, 2) at ``at_px`` from predicted to measured pixels, and robust scatter.

    Robust fit of a polynomial in u and v, whose degree of 0 to 5 depends on the number of stars.
    It absorbs a distortion that the prior lacks, serves the search only and enters no observation.
    """
    n = len(predicted_px)
    powers = warp_powers(n)

    def basis(xy: Floats) -> Floats:
        u, v = ((xy - half_px) / half_px).T
        u_power, v_power = [np.ones_like(u)], [np.ones_like(v)]
        for _ in range(max(i for i, _ in powers)):
            u_power.append(u_power[-1] * u)
            v_power.append(v_power[-1] * v)
        return np.stack([u_power[i] * v_power[j] for i, j in powers])

    A = basis(predicted_px)
    residual = measured_px - predicted_px
    coefficients = medians(residual)[None] * (np.arange(len(powers)) == 0)[:, None]
    scatter = 1.0
    for _ in range(8):
        left = residual - A.T @ coefficients
        size = np.hypot(left[:, 0], left[:, 1])
        before = scatter
        scatter = max(median(size) * RAYLEIGH_TO_SIGMA, 0.01)
        spread2 = sigma_px**2 + scatter**2
        weight = 1.0 / spread2 / (1.0 + size**2 / (9.0 * spread2)) ** 2
        weighted = A * weight
        normal = weighted @ A.T
        # Powers up to 5 on -1 to 1 keep ten digits of the normal matrix; the damping bounds the
        # correction in corners without stars.
        normal.flat[:: len(normal) + 1] *= 1.0 + 1e-9
        coefficients = np.linalg.solve(normal, weighted @ residual)
        if abs(scatter - before) < 0.03 * scatter:
            break
    at = A if at_px is predicted_px else basis(at_px)
    return at.T @ coefficients, scatter
