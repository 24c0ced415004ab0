"""
Whether the rows of a frame belong together, judged by the stars measured in it.

A line lost on the way moves all rows below it by whole pixels.  The stars there still stand in
their windows and look sound; but they jump against those above, where whatever is not known of
camera and attitude changes smoothly over the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyvander2d

from starcal_ros.arrays import Floats
from starcal_ros.robust_statistics import median, RAYLEIGH_TO_SIGMA

_STARS_OF_DEGREE = {5: 60, 3: 20}  # least number that carries a smooth part of so many powers
_EACH_SIDE = 8  # stars that a jump must be seen by
_BRIGHTEST = 150  # stars that tell it; more would take longer and say little more
_CUTS = 48  # rows that are tried; a star or two on the wrong side of one hides no jump
_AGREE = 0.7  # of the stars on a side: a few wrong ones of it are no jump of all
_LEAST_PX = 0.5  # rows and columns are lost in wholes
# Rise of chi^2 without the jump.  Of 290 sound frames none came to 10 once its wrong stars had
# lost their weight; normal noise comes to 40 at one of the cuts once in 10^7.
_LEAST_RISE = 40.0
_FLOOR_PX = 0.05  # what the places of stars may be wrong by besides their noise


@dataclass(frozen=True)
class Tear:
    """The first row, about, that does not belong to those above; how far (2,) it is off, px."""

    row: int
    off_px: Floats


def find_tear(
    predicted_px: Floats, measured_px: Floats, sigma_px: Floats, shape: tuple[int, int]
) -> Tear | None:
    """
    Where the stars of a frame of (height, width) jump against their predictions; None: nowhere.

    ``predicted_px``, ``measured_px`` (n, 2) of the good stars, ``sigma_px`` (n,) their noise per
    axis.  The differences are fitted by a polynomial in u and v and a step at each of some rows,
    robustly.  A prior that is wrong by a smooth function of any size makes no tear.
    """
    # A jump between two sides takes one of them off by half of it.
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
    told = (count >= _EACH_SIDE) & (count <= n - _EACH_SIDE)
    if not told.any():
        return None
    rows, steps = rows[told], below[:, told].astype(np.float64)
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
    side = steps[:, k] == (2.0 * steps[:, k].mean() < 1.0)  # the one of fewer stars
    if np.hypot(*off_px[k]) < _LEAST_PX or agree[side].mean() < _AGREE:
        return None
    return Tear(round(float(rows[k])), off_px[k])
