# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Medians and the standard deviations of normal noise that correspond to them.

`numpy.median` takes twenty times as long for the hundred numbers of one image: it checks for NaN
and averages the two middle values of an even count.  These functions take the upper one.
"""

from __future__ import annotations

import numpy as np

from starcal_ros.arrays import AnyArray, Floats

MAD_TO_SIGMA = 1.4826  # median absolute deviation of a normal distribution
RAYLEIGH_TO_SIGMA = 1.0 / 1.1774  # median length of a vector of two normal components


def median(values: AnyArray) -> float:
    """Median of at least one value; the upper middle value of an even count."""
    flat = values.ravel()
    middle = flat.size // 2
    return float(np.partition(flat, middle)[middle])


def medians(values: AnyArray) -> Floats:
    """Medians (k,) of the columns of (n, k)."""
    middle = len(values) // 2
    return np.asarray(np.partition(values, middle, axis=0)[middle], np.float64)


def centre_and_scatter(values: Floats) -> tuple[Floats, Floats]:
    """Median (k,) and 1-sigma scatter (k,) of the columns of (n, k), from absolute deviations."""
    centre = medians(values)
    return centre, MAD_TO_SIGMA * medians(np.abs(values - centre))
