# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Detection of lost image lines from the measured stars.

A line lost in transmission shifts all rows below it by whole pixels.  The stars below still lie in
their windows, but their residuals jump against those above, whereas errors of camera and attitude
vary smoothly over the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyvander2d

from starcal_ros.arrays import Floats
from starcal_ros.robust_statistics import median, RAYLEIGH_TO_SIGMA

_STARS_OF_DEGREE = {5: 60, 3: 20}  # polynomial degree: fewest stars
_EACH_SIDE = 8  # fewest stars on each side of a jump
_BRIGHTEST = 150  # stars used; more take longer and add little
_CUTS = 48  # rows tested; one or two stars on the wrong side do not hide a jump
_AGREE = 0.7  # share of the stars of a side that must follow the jump
_LEAST_PX = 0.5  # whole rows or columns are lost
# Rise of chi^2 without the jump.  290 intact frames stayed below 10 after outliers had lost their
# weight; normal noise reaches 40 at one of the cuts once in 10^7.
_LEAST_RISE = 40.0
_FLOOR_PX = 0.05  # systematic error of star positions, per axis


@dataclass(frozen=True)
class LineLoss:
    """Approximate first row after lost lines, and the offset (2,) of the rows below, px."""

    row: int
    off_px: Floats


def find_line_loss(
    predicted_px: Floats, measured_px: Floats, sigma_px: Floats, shape: tuple[int, int]
) -> LineLoss | None:
    """
    Row at which the residuals of an image (height, width) jump; None without a jump.

    ``predicted_px``, ``measured_px`` (n, 2) of the good stars, ``sigma_px`` (n,) noise per axis.
    For each tested row, a robust fit of the residuals with a polynomial in u and v and a step.  A
    smooth error of the prior, even a large one, is not a jump.
    """
    # The smooth part can take up half of a jump.
    away_px = np.hypot(*(measured_px - predicted_px).T) - 2.0 * sigma_px
    if np.count_nonzero(away_px > 0.5 * _LEAST_PX) < _EACH_SIDE // 2:
        return None
    if len(predicted_px) > _BRIGHTEST:
        best = np.argpartition(sigma_px, _BRIGHTEST)[:_BRIGHTEST]
        predicted_px, measured_px, sigma_px = predicted_px[best], measured_px[best], sigma_px[best]
    n = len(predicted_px)
    degree = next((power for power, least in _STARS_OF_DEGREE.items() if n >= least), None)
    if degree is None:
        return None
    height, width = shape
    rows = np.linspace(0.0, height, _CUTS + 2)[1:-1]
    below = predicted_px[:, 1, None] > rows
    count = below.sum(axis=0)
    usable = (count >= _EACH_SIDE) & (count <= n - _EACH_SIDE)
    if not usable.any():
        return None
    rows, steps = rows[usable], below[:, usable].astype(np.float64)
    u, v = ((predicted_px - np.array([width, height]) / 2.0) / (max(width, height) / 2.0)).T
    smooth = polyvander2d(u, v, [degree, degree])
    powers = np.arange(degree + 1)
    smooth = smooth[:, np.add.outer(powers, powers).ravel() <= degree]
    root = 1.0 / np.hypot(sigma_px, _FLOOR_PX)
    weight = root
    for power in (0.5, 1.0, 1.0, 1.0):
        Q, _ = np.linalg.qr(smooth * weight[:, None])
        left = (measured_px - predicted_px) * weight[:, None]
        left = left - Q @ (Q.T @ left)
        jump = steps * weight[:, None]
        jump = jump - Q @ (Q.T @ jump)
        size2 = (jump**2).sum(axis=0)
        off_px = (jump.T @ left) / np.maximum(size2, 1e-9)[:, None]
        rise = size2 * (off_px**2).sum(axis=1)
        k = int(rise.argmax())
        if rise[k] < _LEAST_RISE:
            return None
        off_sigma = np.hypot(*(left - jump[:, [k]] * off_px[k]).T) * root / weight
        scatter = max(1.0, median(off_sigma) * RAYLEIGH_TO_SIGMA)
        weight = root / scatter / (1.0 + (off_sigma / (3.0 * scatter)) ** 2) ** power
    agree = off_sigma < 4.0 * scatter
    side = steps[:, k] == (2.0 * steps[:, k].mean() < 1.0)  # the side with fewer stars
    if np.hypot(*off_px[k]) < _LEAST_PX or agree[side].mean() < _AGREE:
        return None
    return LineLoss(round(float(rows[k])), off_px[k])
