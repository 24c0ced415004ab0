# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Differences of calibrations, in pixels and in the sigmas that they report."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.assessment.agreement import chi_squared, difference
from starcal_ros.estimation.calibration_options import CalibrationOptions, estimated_parameters
from starcal_ros.records import CameraGeometry
from starcal_ros.studies.trials import draw_star_field, StarField

ESTIMATED = estimated_parameters(CalibrationOptions(), 'plumb_bob')


def drawn(trial: int, images: int = 8) -> StarField:
    return draw_star_field(np.random.default_rng([41, trial]), images, 60)


def test_differences_of_random_calibrations_are_chi2() -> None:
    """Two draws from one covariance: the mean of chi^2 is its freedom, of camera and of all."""
    truth = drawn(0).truth
    random = np.random.default_rng(3)
    sigma = np.r_[0.5, 0.1, 0.5, 0.0, 0.0, 1e-4, 1e-3, 1e-2, 1e-5, 1e-5, [2e-5] * 3]
    mixed = np.eye(13) + 0.3 * random.normal(size=(13, 13))
    factor = sigma[:, None] * mixed
    covariance = factor @ factor.T

    def draw() -> CameraGeometry:
        errors = factor @ random.normal(size=13)
        camera = dataclasses.replace(
            truth.camera, parameters=truth.camera.parameters + errors[:10]
        )
        turn = Rotation.from_quat(truth.star_tracker_from_camera_xyzw)
        turn = turn * Rotation.from_rotvec(errors[10:])
        return CameraGeometry(camera, turn.as_quat())

    found = [difference(draw(), covariance, draw(), covariance, ESTIMATED) for _ in range(400)]
    assert {(one.camera.degrees_of_freedom, one.total.degrees_of_freedom) for one in found} == {
        (8, 11)
    }
    # 400 draws know the mean of chi^2 with f degrees to sqrt(2 f / 400): four of these.
    for values, freedom in (
        ([one.camera.value for one in found], 8),
        ([one.total.value for one in found], 11),
    ):
        assert abs(np.mean(values) - freedom) < 4 * np.sqrt(2 * freedom / 400)
    assert np.median([one.total.p_value for one in found]) == pytest.approx(0.5, abs=0.1)


def test_what_is_not_estimated_is_not_compared() -> None:
    geometry = drawn(0).truth
    held = difference(geometry, np.zeros((13, 13)), geometry, np.zeros((13, 13)), ())
    for found in (held.camera, held.total):
        assert (found.degrees_of_freedom, found.p_value) == (0, 1.0)


def test_chi_squared_leaves_out_what_has_no_variance_or_is_singular() -> None:
    """Rows without a variance do not count; of two copies of one number, one does."""
    copies = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0] * 4, [0.0] * 3 + [4e10]])
    found = chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies)
    assert found.degrees_of_freedom == 2
    assert found.value == pytest.approx(2.0**2 + 3.0**2, rel=1e-12)
    copies[3, 3] = np.nan
    assert chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies).degrees_of_freedom == 1
