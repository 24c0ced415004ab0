# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Numbers behind the figures of residuals."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from starcal_ground.products import read_residuals, RESIDUALS_FILE
from starcal_ground.report import figures


def test_means_in_bins_and_their_errors() -> None:
    x = np.repeat([0.5, 1.5, 2.5], [100, 9, 25])
    y = np.concatenate([np.tile([1.0, 3.0], 50), np.ones(9), np.full(25, -2.0)])
    centre, mean, error = figures._in_bins(x, y, np.arange(4, dtype=np.float64))
    assert centre.tolist() == [0.5, 2.5]  # nine values are too few
    assert mean.tolist() == [2.0, -2.0]
    assert error.tolist() == pytest.approx([0.1, 0.0])


def test_the_three_axes_of_a_star_tracker_share_the_axis_of_time(tiny_products) -> None:
    given = read_residuals(tiny_products / RESIDUALS_FILE)
    spread = np.random.default_rng(1).normal(size=given.attitude_error_arcsec.shape)
    found = dataclasses.replace(given, attitude_error_arcsec=spread * (2.0, 9.0, 90.0))
    chart = figures.alignment_in_time(found, (1.0, 10.0, 100.0))
    assert chart is not None
    axes = re.findall(r'<path d="M([\d.]+),[\d.]+V[\d.]+H([\d.]+)"', chart.svg.body)
    assert len(axes) == 3 and len(set(axes)) == 1
