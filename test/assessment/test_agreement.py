# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Differences of calibrations: p-values of pure noise, and changes midway."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.assessment.agreement import chi_squared, compare_halves, difference, movement
from starcal_ros.camera import project
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.records import CameraGeometry, Ensemble
from starcal_ros.studies.trials import (
    calibration_options,
    draw_star_field,
    observe,
    StarField,
)

ESTIMATED = estimated_parameters(CalibrationOptions(), 'plumb_bob')
OPTIONS = calibration_options('hierarchical', 20.0)


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
    assert np.mean([one.total.rms_sigma**2 for one in found]) == pytest.approx(1.0, abs=0.1)


def test_what_is_not_estimated_is_not_compared() -> None:
    geometry = drawn(0).truth
    held = difference(geometry, np.zeros((13, 13)), geometry, np.zeros((13, 13)), ())
    for found in (held.camera, held.total):
        assert (found.degrees_of_freedom, found.p_value, found.rms_sigma) == (0, 1.0, 0.0)


def test_chi_squared_leaves_out_what_has_no_variance_or_is_singular() -> None:
    """Rows without a variance do not count; of two copies of one number, one does."""
    copies = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0] * 4, [0.0] * 3 + [4e10]])
    found = chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies)
    assert found.degrees_of_freedom == 2
    assert found.value == pytest.approx(2.0**2 + 3.0**2, rel=1e-12)
    copies[3, 3] = np.nan
    assert chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies).degrees_of_freedom == 1


def seen_from_the_middle(field: StarField, truth: CameraGeometry) -> StarField:
    """The later half of the images is taken with another camera on another mounting."""
    half = len(field.pixel_px) // 2
    icrf_from_star_tracker = field.camera_from_icrf.inv() * (
        Rotation.from_quat(field.truth.star_tracker_from_camera_xyzw).inv()
    )
    camera_from_icrf = (
        icrf_from_star_tracker * Rotation.from_quat(truth.star_tracker_from_camera_xyzw)
    ).inv()
    pixels = field.pixel_px.copy()
    for k in range(half, len(pixels)):
        directions = camera_from_icrf[k].apply(field.direction_icrf[k])
        pixels[k] = project(truth.camera, directions)
    return dataclasses.replace(field, pixel_px=pixels)


def test_halves_of_one_camera_differ_by_noise() -> None:
    p_values = []
    for trial in range(30):
        found = compare_halves(observe(drawn(trial), 20.0), drawn(trial).prior, OPTIONS)
        assert not found.note
        p_values += [found.p_value, found.shape_p_value]
    # Of sixty p-values the least is under 1e-4 once in 170 such tests; the seed is fixed.
    assert min(p_values) > 1e-4
    assert 0.3 < np.median(p_values) < 0.7


def test_a_change_midway_shows() -> None:
    """A focal length in the shape, a mounting in the rotation alone, each as large as it is."""
    field = drawn(1)
    camera = field.truth.camera
    fx, skew, fy = camera.intrinsics[:3] * 1.002
    zoomed = dataclasses.replace(field.truth, camera=camera.replace(fx=fx, skew=skew, fy=fy))
    found = compare_halves(
        observe(seen_from_the_middle(field, zoomed), 20.0), field.prior, OPTIONS
    )
    assert found.shape_p_value < 1e-9
    # 0.2 % at the corner, 1650 px from the centre; halves know it to 0.1 px.
    assert found.shape_px == pytest.approx(movement(field.truth, zoomed)[1].max(), abs=0.4)

    turn = Rotation.from_rotvec([1e-3, 0.0, 0.0])
    mounting = Rotation.from_quat(field.truth.star_tracker_from_camera_xyzw) * turn
    turned = dataclasses.replace(field.truth, star_tracker_from_camera_xyzw=mounting.as_quat())
    found = compare_halves(
        observe(seen_from_the_middle(field, turned), 20.0), field.prior, OPTIONS
    )
    assert found.p_value < 1e-9 < 1e-4 < found.shape_p_value
    # 20 arcsec, 1e-4 rad, for each image: four of these in each half know it to 7e-5.
    assert found.rotation_arcsec * ARCSECOND_RAD == pytest.approx(1e-3, abs=3e-4)


def test_halves_that_cannot_be_compared_give_the_reason() -> None:
    field = drawn(2)
    ensemble = observe(field, 20.0)
    five = compare_halves(Ensemble(ensemble.images[:5]), field.prior, OPTIONS)
    assert five.note == '5 images, 6 make two halves' and np.isnan(five.p_value)
    warm = dataclasses.replace(OPTIONS, focal_temperature_order=1)
    found = compare_halves(ensemble, field.prior, warm)
    assert found.note == 'the halves have different temperatures'
    few = Ensemble(tuple(image.select(np.arange(60) < 20) for image in ensemble.images))
    note = compare_halves(few, field.prior, OPTIONS).note
    assert note.startswith('a half alone cannot be solved: ')
