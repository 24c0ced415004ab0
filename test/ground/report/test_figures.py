# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Numbers behind the figures of residuals."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from starcal_ground.report import figures
from starcal_ros.assessment.predictions import Residuals
from starcal_ros.camera import CameraModel

CAMERA = CameraModel(640, 512, np.array([1800.0, 0, 1800, 319.5, 255.5, 0, 0, 0, 0, 0]))
STARS, IMAGES, SIGMA_PX = 20_000, 10, 0.1


def noise(seed: int) -> Residuals:
    """Independent residuals of 0.1 px on stars anywhere."""
    rng = np.random.default_rng(seed)
    return Residuals(
        image_time_ns=np.arange(IMAGES) * 10**9,
        image_misfit=np.zeros(IMAGES, bool),
        attitude_error_arcsec=np.zeros((IMAGES, 3)),
        attitude_sigma_arcsec=np.ones((IMAGES, 3)),
        image=np.sort(rng.integers(0, IMAGES, STARS)),
        catalog_id=np.arange(STARS),
        magnitude=rng.uniform(3, 8, STARS),
        colour_bp_rp=rng.uniform(0, 2, STARS),
        measured_px=rng.uniform([-0.5, -0.5], [639.5, 511.5], (STARS, 2)),
        residual_px=rng.normal(0, SIGMA_PX, (STARS, 2)),
        covariance_px2=np.tile([SIGMA_PX**2, 0.0, SIGMA_PX**2], (STARS, 1)),
        used=np.ones(STARS, bool),
    )


def test_means_in_bins_and_their_errors() -> None:
    x = np.repeat([0.5, 1.5, 2.5], [100, 9, 25])
    y = np.concatenate([np.tile([1.0, 3.0], 50), np.ones(9), np.full(25, -2.0)])
    centre, mean, error = figures._in_bins(x, y, np.arange(4, dtype=np.float64))
    assert centre.tolist() == [0.5, 2.5]  # nine values are too few
    assert mean.tolist() == [2.0, -2.0]
    assert error.tolist() == pytest.approx([0.1, 0.0])


def test_the_three_axes_of_a_star_tracker_share_the_axis_of_time() -> None:
    error = np.random.default_rng(1).normal(size=(IMAGES, 3)) * (2.0, 9.0, 90.0)
    found = dataclasses.replace(noise(0), attitude_error_arcsec=error)
    chart = figures.alignment_in_time(found, (1.0, 10.0, 100.0))
    assert chart is not None
    axes = re.findall(r'<path d="M([\d.]+),[\d.]+V[\d.]+H([\d.]+)"', chart.svg.body)
    assert len(axes) == 3 and len(set(axes)) == 1
