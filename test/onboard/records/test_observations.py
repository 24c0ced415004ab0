# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Codes of star refusals and their names; covariance of a field as factor and remainder."""

import dataclasses

import numpy as np
import pytest

from starcal_ros.assessment.lookup import Derivatives, line_of_sight_table
from starcal_ros.camera import CameraModel, pixel_grid
from starcal_ros.camera.detector_field import DetectorField, term_count
from starcal_ros.records import factored_field, MapCovariance, STAR_REFUSALS, StarRefusal


def test_codes_fit_their_arrays_and_names_ascend_with_them() -> None:
    """Zero is a star that is used, so that an array of zeros refuses none."""
    assert not StarRefusal.NONE.value and StarRefusal.NONE.label not in STAR_REFUSALS
    np.testing.assert_array_equal(np.array(list(StarRefusal), np.uint8), list(StarRefusal))
    # Messages list the names in order of the codes: as sorted, which is how 0.1 wrote them.
    assert list(STAR_REFUSALS) == sorted(STAR_REFUSALS)


OCTAVES = 3
TERMS = term_count(1296, 1024, OCTAVES)
LENS = CameraModel(1296, 1024, np.array([3641.5, -0.7, 3642.3, 647.5, 511.5, -0.05, 0.1, 0, 0, 0]))
FIELD = DetectorField(1296, 1024, OCTAVES, np.zeros((2, TERMS)))
CAMERA = dataclasses.replace(LENS, field=FIELD)
SIGMA = np.r_[0.3, 0.1, 0.3, 0.5, 0.5, 1e-3, 1e-2, 1e-1, 1e-4, 1e-4, np.full(3, 2e-5)]


def covariance(stars: int, held: bool = False) -> MapCovariance:
    """Of a calibration whose parameters and field cancel in what the stars have seen."""
    sigma = np.r_[300.0 * SIGMA, np.full(2 * TERMS, 0.05)]  # without stars
    if held:
        sigma[7] = 0.0
    pixels = np.random.default_rng(stars).uniform(size=(stars, 2)) * [1296, 1024] - 0.5
    J = Derivatives.at(CAMERA, pixels).J.reshape(-1, len(sigma))
    root = J * sigma * LENS.parameters[0] / 0.1  # stars of 0.1 px
    inverse = np.linalg.inv(root.T @ root + np.eye(len(sigma)))
    return MapCovariance(inverse * sigma * sigma[:, None], 0.002)


@pytest.mark.parametrize('stars', [3, 50, 2000])
@pytest.mark.parametrize('held', [False, True], ids=['free', 'held'])
def test_every_sigma_of_a_line_of_sight_holds_to_a_thousandth(stars: int, held: bool) -> None:
    given = covariance(stars, held)
    record = factored_field(FIELD, given)
    pixels, again = (
        pixel_grid(CAMERA, 61, 47),
        MapCovariance(record.covariance, record.unresolved_px),
    )
    expected, found = (line_of_sight_table(CAMERA, one, pixels) for one in (given, again))
    for name in ('sigma_arcsec', 'shape_sigma_arcsec'):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3)
    # Exactly zero where held.
    expected_px2, found_px2 = np.diag(given.matrix)[:13], np.diag(record.covariance)[:13]
    np.testing.assert_allclose(found_px2, expected_px2, rtol=1e-7)
    assert np.linalg.eigvalsh(record.covariance).min() > -1e-9 * np.trace(record.covariance)


def test_a_direction_of_little_variance_is_kept() -> None:
    """Parameters of a rational lens are nearly collinear, and the field cancels the rest."""
    assert CAMERA.field is not None
    p, scale = len(SIGMA), np.r_[SIGMA, np.full(2 * TERMS, 0.05)]
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(p, p)))[0]
    root = np.zeros((len(scale), p))
    root[:p] = turn * np.r_[np.ones(p - 1), 5e-7]
    root[p:, -1] = 1.0
    matrix = root @ root.T * np.outer(scale, scale)
    record = factored_field(CAMERA.field, MapCovariance(matrix))
    along = np.r_[turn[:, -1] / SIGMA / -5e-7, np.zeros(2 * TERMS)]
    along[p] = 1.0 / 0.05
    # Both cancel; nine digits of the factor leave 1e-5.
    assert along @ record.covariance @ along < 1e-3


def test_the_record_is_a_quarter_of_the_square() -> None:
    record = factored_field(FIELD, covariance(300))
    numbers = (record.covariance_factor, record.remainder_unit_px, record.remainder)
    assert sum(one.nbytes for one in numbers) < 0.25 * record.covariance.nbytes


def test_a_field_without_variance_has_none() -> None:
    matrix = np.zeros((13 + 2 * TERMS,) * 2)
    matrix[:13, :13] = np.diag(SIGMA**2)
    record = factored_field(FIELD, MapCovariance(matrix))
    np.testing.assert_allclose(record.covariance, matrix, rtol=1e-8, atol=1e-30)
