# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Two calibrations against each other: known differences, OpenCV's lines of sight, chance."""

from collections.abc import Callable
import dataclasses
import json
from pathlib import Path
import shutil
from typing import Any

import cv2
from geometries import turned  # type: ignore[import-not-found]
from mission_files import TINY  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from starcal_tool import assert_refused, Starcal  # type: ignore[import-not-found]

from starcal_ground import comparison
from starcal_ground.comparison import chi_squared, compare
from starcal_ground.written_files import write_calibration
from starcal_ros.assessment.lookup import GRID, line_of_sight_table
from starcal_ros.camera import CameraModel, PARAMETER_NAMES, pixel_grid
from starcal_ros.camera.projection import convert
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ProductError
from starcal_ros.records import Calibration, TemperatureTerms

Compared = Callable[..., tuple[str, dict[str, Any]]]


def moved(
    calibration: Calibration, turned_rad: tuple[float, ...] = (0.0, 0.0, 0.0), **by: float
) -> Calibration:
    """A calibration with some parameters changed, and the camera frame turned."""
    geometry, camera = calibration.geometry, calibration.geometry.camera
    parameters = camera.parameters.copy()
    for name, change in by.items():
        parameters[PARAMETER_NAMES.index(name)] += change
    camera = CameraModel(camera.width, camera.height, parameters)
    geometry = turned(
        dataclasses.replace(geometry, camera=camera), Rotation.from_rotvec(turned_rad)
    )
    return dataclasses.replace(calibration, geometry=geometry)


@pytest.fixture
def compared(tmp_path: Path, starcal: Starcal) -> Compared:

    def run(*calibrations: Calibration) -> tuple[str, dict[str, Any]]:
        files = [tmp_path / f'{name}.json' for name in 'ab']
        for path, calibration in zip(files, calibrations, strict=True):
            write_calibration(calibration, path)
        return starcal('compare', *files).out, json.loads(starcal('compare', *files, '--json').out)

    return run


def test_nothing_differs_from_itself(tiny) -> None:
    found = compare(tiny, tiny)
    assert not found.difference.any()
    assert found.total.value == 0 and found.total.p_value == 1
    # Rounding of unit vectors, 1e-16, times a focal length of 1800 px.
    assert found.before.length_px.max() < 1e-11
    assert found.after.length_px.max() < 1e-11


def undistorted(camera: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Points (n, 2) of the ideal image plane by OpenCV, to its last digit; it has no skew."""
    fx, skew, fy, cx, cy, k1, k2, k3, p1, p2 = camera
    assert skew == 0
    K, D = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, p1, p2, k3])
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    if hasattr(cv2, 'undistortPointsIter'):
        found = cv2.undistortPointsIter(pixels[:, None], K, D, np.eye(3), np.eye(3), criteria)
    else:  # from OpenCV 5 on, whose stubs those of 4 are not
        undistort: Any = cv2.undistortPoints
        found = undistort(pixels[:, None], K, D, criteria=criteria)
    return np.asarray(found, np.float64).reshape(-1, 2)


def opencv_sight(calibration: Calibration) -> np.ndarray:
    """Lines of sight of the grid in the star tracker frame by OpenCV."""
    camera = calibration.geometry.camera
    xy = undistorted(camera.parameters, pixel_grid(camera, GRID, GRID))
    directions = np.c_[xy, np.ones(len(xy))]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(
        Rotation.from_quat(calibration.geometry.star_tracker_from_camera_xyzw).apply(directions)
    )


def test_the_map_is_what_opencv_says(tiny) -> None:
    a = moved(tiny, skew=-tiny.geometry.camera.parameters[1])
    b = moved(a, (2e-5, -1e-5, 4e-5), fx=1.0, cy=-0.5, k1=0.01, p2=1e-4)
    expected_px = np.linalg.norm(opencv_sight(b) - opencv_sight(a), axis=1) * float(
        a.geometry.camera.parameters[0]
    )
    found = compare(a, b)
    # The field that both have moves the places at which they differ, by some 1e-4 px, over which
    # the difference changes by 1.3e-6 px.
    np.testing.assert_allclose(found.before.length_px.ravel(), expected_px, atol=3e-6)
    names = [*PARAMETER_NAMES]
    assert found.difference[names.index('fx')] == pytest.approx(1.0)
    np.testing.assert_allclose(found.difference[10:], [2e-5, -1e-5, 4e-5], atol=1e-15)


def test_a_turn_is_taken_off(tiny) -> None:
    found = compare(tiny, moved(tiny, (100 * ARCSECOND_RAD, 0.0, 0.0)))
    assert found.rotation_rad == pytest.approx(100 * ARCSECOND_RAD)
    middle = GRID // 2
    # A pixel at the axis moves by 100 arcsec of 1/fx: a lens of 1801 px.
    expected_px = 100 * ARCSECOND_RAD * tiny.geometry.camera.parameters[0]
    assert found.before.length_px[middle, middle] == pytest.approx(expected_px, rel=1e-3)
    assert found.after.length_px.max() < 1e-9


def test_sigmas_of_the_maps_are_those_of_the_table(tiny) -> None:
    """Angles over angles, also where B has another focal length."""
    lens = dataclasses.replace(tiny.geometry.camera, field=None)
    geometry = dataclasses.replace(tiny.geometry, camera=lens)
    bare = dataclasses.replace(tiny, field=None, geometry=geometry)
    certain = dataclasses.replace(bare, covariance=np.zeros((13, 13)))
    longer = moved(bare, (2e-5, 0.0, 0.0), fx=90.0, fy=90.0)
    found = compare(certain, longer)
    camera = longer.geometry.camera
    table = line_of_sight_table(camera, longer.map_covariance, pixel_grid(camera, GRID, GRID))
    focal_px = certain.geometry.camera.parameters[0]
    for part, sigma_arcsec in (
        (found.before, table.sigma_arcsec),
        (found.after, table.shape_sigma_arcsec),
    ):
        length_rad = part.length_px.ravel() / focal_px
        expected = length_rad / (sigma_arcsec * ARCSECOND_RAD)
        np.testing.assert_allclose(part.sigmas.ravel(), expected, rtol=1e-9)
    made = comparison.content(found)
    expected_arcsec = found.difference[-3:] / ARCSECOND_RAD
    assert made['alignment_arcsec'] == pytest.approx(expected_arcsec, rel=1e-12)


def test_notes_say_what_weakens_the_sigmas(tiny) -> None:
    terms = TemperatureTerms(20.0, (), (), (), ())
    at_20, at_25 = (
        dataclasses.replace(tiny, temperature=dataclasses.replace(terms, reference_degc=degc))
        for degc in (20.0, 25.0)
    )
    for a, b, noted in ((tiny, at_20, True), (at_20, at_20, False), (at_20, at_25, True)):
        notes = compare(a, b).notes
        assert any('different temperatures' in note for note in notes) is noted
    refused = dataclasses.replace(
        tiny, accepted=False, reasons=('too bad',), parent_frame='other', provenance={}
    )
    notes = compare(tiny, refused).notes
    assert any('refused B: too bad' in note for note in notes)
    assert any('other' in note for note in notes)


def test_what_was_held_has_no_sigma(tiny) -> None:
    covariance = tiny.covariance.copy()
    cx = PARAMETER_NAMES.index('cx')
    covariance[cx] = covariance[:, cx] = 0.0
    held = dataclasses.replace(tiny, covariance=covariance)
    found = compare(held, moved(held, cx=1.0))
    assert np.isnan(found.sigmas[cx])
    assert any('held in both' in note and 'cx' in note for note in found.notes)
    bare = dataclasses.replace(tiny.geometry.camera, field=None)
    geometry = dataclasses.replace(tiny.geometry, camera=bare)
    exact = dataclasses.replace(tiny, covariance=np.zeros((13, 13)), field=None, geometry=geometry)
    nothing = compare(exact, exact)
    assert nothing.total.degrees_of_freedom == 0
    assert np.isnan(nothing.before.sigmas).all()
    made = json.dumps(comparison.content(nothing), allow_nan=False)
    assert json.loads(made)['chi2'] is None


@pytest.mark.parametrize(
    ('stamps_ns', 'later_ns', 'noted'),
    [
        ([], 0, 'are of the same time'),
        ([], 37 * 10**9, ''),
        ([[0, 1, 2], [1, 2, 3]], 0, 'share 2 images'),
        ([[0, 2], [1, 3]], 0, ''),
    ],
)
def test_common_images_are_noted_whatever_the_prior(tiny, stamps_ns, later_ns, noted) -> None:
    times = {name: getattr(tiny, name) + later_ns for name in ('first_image_ns', 'time_ns')}
    other = dataclasses.replace(tiny, provenance={}, **times)
    notes = compare(tiny, other, [np.array(one) for one in stamps_ns]).notes
    assert [f'A and B {noted}' in note for note in notes] == [True] * bool(noted)


def test_cameras_alone_are_compared_without_an_alignment(tiny, compared) -> None:
    """Their alignment is of the prior camera: 82 arcsec of sigma, and no fit of any size."""
    alone = dataclasses.replace(tiny, parent_frame='')
    other = dataclasses.replace(moved(tiny, (1e-2, 0.0, 0.0), fx=0.01), parent_frame='')
    found = compare(alone, other)
    assert found.total.degrees_of_freedom == 10 and found.total.p_value > 0.99
    said, content = compared(alone, other)
    assert 'alignment x' not in said and 'as calibrated' not in said
    assert 'the cameras alone are compared' in said and '10 degrees of freedom' in said
    assert content['alignment_arcsec'] is content['lines_of_sight'] is None


def test_cameras_of_other_sizes_are_refused(tiny) -> None:
    camera = tiny.geometry.camera
    bigger = dataclasses.replace(
        tiny.geometry, camera=CameraModel(camera.width + 1, camera.height, camera.parameters)
    )
    with pytest.raises(ProductError, match='640 x 512.*641 x 512'):
        compare(tiny, dataclasses.replace(tiny, geometry=bigger))


@pytest.mark.parametrize('model', ['rational_polynomial', 'equidistant'])
def test_two_lens_models_are_compared_by_their_lines_of_sight(tiny, model, compared) -> None:
    camera, worst_px = convert(tiny.geometry.camera, model)
    count = len(camera.parameters) + 3
    geometry = dataclasses.replace(tiny.geometry, camera=camera)
    none = np.zeros((count, count))
    other = dataclasses.replace(tiny, geometry=geometry, covariance=none, field=None)
    found = compare(tiny, other)
    # The conversion states its error in pixels; the angle of one is at most that of the centre.
    assert found.before.length_px.max() <= 1.01 * worst_px + 1e-9
    assert np.isfinite(found.after.sigmas).all() and found.total.degrees_of_freedom == 0
    said, content = compared(tiny, other)
    assert f'lens model plumb_bob, B {model}' in said and 'parameter  ' not in said
    assert 'common rotation' in said and 'sigma' in said
    assert content['parameter_names'] == content['difference'] == []


def test_the_tool_compares(tiny, compared, tiny_products, starcal) -> None:
    assert 'share 10 images' in starcal('compare', tiny_products, tiny_products).out
    out, made = compared(tiny, moved(tiny, fx=0.5))
    (row,) = (line.split() for line in out.splitlines() if line.startswith('fx '))
    sigma = np.sqrt(2) * tiny.sigma[0]
    assert row[3:] == ['+0.500', f'{sigma:.2g}', f'{0.5 / sigma:+.1f}']
    assert made['difference'][0] == pytest.approx(0.5)
    # The outermost column lies 319.5 px from cx: half a pixel of focal length moves it by this.
    assert made['lines_of_sight']['worst_px'] == pytest.approx(0.5 * 319.5 / 1801, rel=0.1)


def test_the_truth_of_a_simulated_bag_has_no_sigma(tiny, tmp_path, starcal) -> None:
    write_calibration(tiny, tmp_path / 'calibration.json')
    truth = tmp_path / 'truth.json'
    shutil.copy(TINY / 'truth.json', truth)
    made = json.loads(starcal('compare', tmp_path, truth, '--json').out)
    true = json.loads(truth.read_text())
    assert made['sigma'] == pytest.approx(tiny.sigma.tolist())
    assert made['b'] == [*true['k_true'], *true['d_true']] and made['p_value'] > 1e-3
    assert made['notes'] == []
    truth.write_text(json.dumps({**true, 'A_true': 1}))
    assert_refused(starcal('compare', tmp_path, truth), 'not the truth of a simulated bag')


def test_chi_squared_leaves_out_what_has_no_variance_or_is_singular() -> None:
    """Rows without a variance do not count; of two copies of one number, one does."""
    copies = np.array([[1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [0.0] * 4, [0.0] * 3 + [4e10]])
    found = chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies)
    assert found.degrees_of_freedom == 2
    assert found.value == pytest.approx(2.0**2 + 3.0**2, rel=1e-12)
    assert found.p_value == pytest.approx(np.exp(-0.5 * found.value), rel=1e-9)  # of two degrees
    copies[3, 3] = np.nan
    assert chi_squared(np.array([2.0, 2.0, 7.0, 6e5]), copies).degrees_of_freedom == 1
