# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Lines of sight by pixel: against the camera, against differences, and in every format."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.cli.commands.lookup import write_lookup_table
from starcal_ros.assessment.lookup import Derivatives, line_of_sight_table
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid
from starcal_ros.camera.detector_field import DetectorField, term_count
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.records import MapCovariance

COLUMNS = ('u_px', 'v_px', 'x', 'y', 'z', 'shape_sigma_arcsec', 'sigma_arcsec')
LENS = CameraModel(640, 512, np.array([1800, 0.2, 1801, 320, 255, -0.045, 0.08, 0.1, 4e-4, -3e-4]))
OCTAVES = 2
TERMS = term_count(640, 512, OCTAVES)
FIELD = DetectorField(
    640, 512, OCTAVES, np.random.default_rng(1).normal(scale=0.3, size=(2, TERMS))
)
WITH_FIELD = CameraModel(640, 512, LENS.parameters, field=FIELD)
CAMERAS = pytest.mark.parametrize('camera', [LENS, WITH_FIELD], ids=['lens', 'field'])
# fx to p2, the alignment (rad), and coefficients of a field (px): 1-sigma of a usual calibration.
SIGMA = np.r_[0.3, 0.1, 0.3, 0.5, 0.5, 1e-3, 1e-2, 1e-1, 1e-4, 1e-4, np.full(3, 2e-5)]
# Of differences over a hundredth of a 1-sigma from both sides: their cubes and rounding are 1e-8.
RTOL = 1e-6
PIXELS = np.array([[0.0, 0.0], [319.5, 255.5], [639.0, 511.0], [100.0, 400.0], [600.25, 17.5]])


def covariance_of(camera: CameraModel) -> np.ndarray:
    """A covariance with correlations of every sign."""
    sigma = SIGMA if camera.field is None else np.r_[SIGMA, np.full(2 * TERMS, 0.02)]
    mixed = np.random.default_rng(2).normal(size=(len(sigma), len(sigma)))
    correlated = mixed @ mixed.T
    scale = sigma / np.sqrt(np.diag(correlated))
    return np.asarray(correlated * np.outer(scale, scale))


def differences(camera: CameraModel, pixels: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Movement (n, 3) of the directions of pixels by a change, from both of its sides."""
    p, field, ends = len(camera.parameters), camera.field, []
    for step in (0.01 * change, -0.01 * change):
        if field is not None:
            coefficients = field.coefficients + step[p + 3 :].reshape(2, -1)
            camera = dataclasses.replace(
                camera, field=dataclasses.replace(field, coefficients=coefficients)
            )
        other = dataclasses.replace(camera, parameters=camera.parameters + step[:p])
        # camera_from_star_tracker <- exp(-[dtheta x]) camera_from_star_tracker (Eq. 11).
        rotation = Rotation.from_rotvec(step[p : p + 3])
        ends.append(rotation.apply(line_of_sight(other, pixels)))
    return np.asarray((ends[0] - ends[1]) / 0.02)


@CAMERAS
def test_derivatives_are_the_limits_of_differences(camera: CameraModel) -> None:
    J = Derivatives.at(camera, PIXELS).J
    sigma = np.sqrt(np.diag(covariance_of(camera)))
    assert J.shape == (len(PIXELS), 3, len(sigma))
    for k, change in enumerate(np.diag(sigma)):
        expected = differences(camera, PIXELS, change)
        np.testing.assert_allclose(
            J[:, :, k] * sigma[k], expected, atol=1e-12 + RTOL * np.abs(expected).max()
        )


@CAMERAS
def test_directions_are_those_of_the_camera_and_sigmas_those_of_differences(camera) -> None:
    """Sum of the squared movements by independent changes; common rotation by least squares."""
    covariance = covariance_of(camera)
    table = line_of_sight_table(camera, MapCovariance(covariance), PIXELS)
    p = len(camera.parameters)
    both = pixel_grid(camera, 25, 25)
    at_grid, at_pixels = line_of_sight(camera, both), line_of_sight(camera, PIXELS)
    np.testing.assert_array_equal(table.pixels, PIXELS)
    np.testing.assert_array_equal(table.direction_camera, at_pixels)
    whole, shape = np.zeros(len(PIXELS)), np.zeros(len(PIXELS))
    small = 1e-4  # of a 1-sigma: its rotation is linear in it
    # Columns of a square root of the covariance move the camera independently of each other.
    for change in np.linalg.cholesky(covariance).T:
        whole += (differences(camera, PIXELS, change) ** 2).sum(axis=1)
        change = change.copy()
        change[p : p + 3] = 0.0
        of_grid = differences(camera, both, change)
        turn, _ = Rotation.align_vectors(at_grid + small * of_grid, at_grid)
        common = (turn.apply(at_pixels) - at_pixels) / small
        left = differences(camera, PIXELS, change) - common
        shape += (left**2).sum(axis=1)
    np.testing.assert_allclose(table.sigma_arcsec, np.sqrt(whole) / ARCSECOND_RAD, rtol=RTOL)
    np.testing.assert_allclose(table.shape_sigma_arcsec, np.sqrt(shape) / ARCSECOND_RAD, rtol=1e-5)


@CAMERAS
def test_structure_finer_than_the_field_moves_each_pixel_by_itself(camera: CameraModel) -> None:
    nothing = np.zeros_like(covariance_of(camera))
    table = line_of_sight_table(camera, MapCovariance(nothing, 0.3), PIXELS)
    square = np.zeros(len(PIXELS))
    for step in np.eye(2):
        ends = [line_of_sight(camera, PIXELS + sign * 0.01 * step) for sign in (1.0, -1.0)]
        square += (((ends[0] - ends[1]) / 0.02) ** 2).sum(axis=1)
    expected = 0.3 * np.sqrt(square) / ARCSECOND_RAD
    # Of a field that is steep, the derivative is that without the field: to its slope.
    rtol = 1e-6 if camera.field is None else 0.02
    for found in (table.sigma_arcsec, table.shape_sigma_arcsec):
        np.testing.assert_allclose(found, expected, rtol=rtol)
    both = line_of_sight_table(camera, MapCovariance(covariance_of(camera), 0.3), PIXELS)
    alone = line_of_sight_table(camera, MapCovariance(covariance_of(camera)), PIXELS)
    np.testing.assert_allclose(both.sigma_arcsec, np.hypot(alone.sigma_arcsec, table.sigma_arcsec))


def test_many_pixels_are_as_each_alone() -> None:
    covariance = covariance_of(LENS)
    pixels = pixel_grid(LENS, 80, 64)
    assert len(pixels) > 4096  # more than are taken at a time
    table = line_of_sight_table(LENS, MapCovariance(covariance), pixels)
    for k in (0, 4095, 4096, len(pixels) - 1):
        alone = line_of_sight_table(LENS, MapCovariance(covariance), pixels[k : k + 1])
        for name in ('direction_camera', 'sigma_arcsec', 'shape_sigma_arcsec'):
            # Sums in another order.
            one, other = getattr(table, name)[k], getattr(alone, name)[0]
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-14, err_msg=name)


def test_a_pixel_without_a_line_of_sight_is_nan() -> None:
    folded = LENS.replace(k1=-12.0, k2=0.0, k3=0.0)
    table = line_of_sight_table(folded, MapCovariance(covariance_of(LENS)), PIXELS)
    folds = np.isnan(line_of_sight(folded, PIXELS)).any(axis=1)
    assert folds.any() and not folds.all()
    for values in (table.direction_camera[:, 0], table.sigma_arcsec, table.shape_sigma_arcsec):
        np.testing.assert_array_equal(np.isnan(values), folds)


@pytest.mark.parametrize('name', ['a.csv', 'a.npz'])
def test_a_file_comes_back_to_the_last_bit(tmp_path: Path, name: str) -> None:
    """The columns are those of the interface document, as the test of the command shows."""
    path, covariance = tmp_path / name, MapCovariance(covariance_of(LENS))
    table = line_of_sight_table(LENS, covariance, pixel_grid(LENS, 4, 3))
    write_lookup_table(table, path)
    is_text = name.endswith('.csv')
    back = np.genfromtxt(path, delimiter=',', names=True) if is_text else np.load(path)
    of_places = *table.pixels.T, *table.direction_camera.T
    expected = *of_places, table.shape_sigma_arcsec, table.sigma_arcsec
    np.testing.assert_array_equal([back[column] for column in COLUMNS], expected)
