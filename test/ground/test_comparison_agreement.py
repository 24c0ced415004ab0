# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Differences of calibrations, in pixels and in the sigmas that they report."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.comparison import alignment_difference_rad, chi_squared
from starcal_ros.camera import CameraModel
from starcal_ros.records import CameraGeometry


def test_chi_squared_of_draws_has_the_rank_as_its_mean() -> None:
    """Two draws from one covariance, with two numbers that are held."""
    random = np.random.default_rng(3)
    sigma = np.r_[0.5, 0.1, 0.5, 0.0, 0.0, 1e-4, 1e-3, 1e-2, 1e-5, 1e-5, [2e-5] * 3]
    factor = sigma[:, None] * (np.eye(13) + 0.3 * random.normal(size=(13, 13)))
    covariance = 2.0 * factor @ factor.T
    draws = random.normal(size=(400, 2, 13)) @ factor.T
    found = [chi_squared(after - before, covariance) for before, after in draws]
    assert {one.degrees_of_freedom for one in found} == {11}
    # 400 draws know the mean of chi^2 with f degrees to sqrt(2 f / 400): four of these.
    assert abs(np.mean([one.value for one in found]) - 11) < 4 * np.sqrt(2 * 11 / 400)
    assert np.median([one.p_value for one in found]) == pytest.approx(0.5, abs=0.1)


def test_what_is_not_estimated_is_not_compared() -> None:
    found = chi_squared(np.ones(13), np.zeros((13, 13)))
    assert (found.degrees_of_freedom, found.p_value) == (0, 1.0)


def test_an_alignment_differs_by_the_passive_rotation_of_the_camera() -> None:
    camera = CameraModel(640, 512, np.array([1800.0, 0.0, 1800.0, 320.0, 255.0, *[0.0] * 5]))
    before = Rotation.from_euler('zyx', [-91.0, -28.0, 3.0], degrees=True)
    turn = [2e-5, -1e-5, 4e-5]
    after = before * Rotation.from_rotvec(turn)
    b, a = (CameraGeometry(camera, one.as_quat()) for one in (before, after))
    np.testing.assert_allclose(alignment_difference_rad(a, b), turn, atol=1e-14)


def test_chi_squared_leaves_out_what_has_no_variance_or_is_singular() -> None:
    """Rows without a variance do not count; of two copies of one number, one does."""
    copies = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0] * 4, [0.0] * 3 + [4e10]])
    found = chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies)
    assert found.degrees_of_freedom == 2
    assert found.value == pytest.approx(2.0**2 + 3.0**2, rel=1e-12)
    copies[3, 3] = np.nan
    assert chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies).degrees_of_freedom == 1
