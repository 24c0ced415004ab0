# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Every camera model: derivatives, inverse, fold, fits; the field of a detector."""

import dataclasses
from typing import Any

from geometries import PRISM, RATIONAL  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ground.simulation.scenario import scenario
from starcal_ros.camera import (
    ALL_PARAMETER_NAMES,
    CameraModel,
    field_radius_rad,
    line_of_sight,
    PARAMETER_NAMES,
    parameter_names,
    pixel_grid,
    project,
    project_jacobians,
    project_parameters,
)
from starcal_ros.camera.detector_field import (
    basis,
    basis_and_products,
    COSINE_DOMAIN,
    cosine_terms,
    DetectorField,
    term_count,
)
from starcal_ros.camera.lens import fold_radius2, LENSES
from starcal_ros.camera.projection import convert

#                     fx     skew     fy     cx     cy     k1     k2     k3    p1     p2
CAMERAS = {
    'paper': CameraModel(
        2592, 2048, np.array([7291, 1.5, 7286, 1290, 1030, -0.045, 0.08, 0.02, 4e-4, -3e-4])
    ),
    'barrel': CameraModel(
        640, 480, np.array([420, -0.8, 415, 322, 236, -0.28, 0.07, -0.004, 1e-3, -7e-4])
    ),
    'pincushion': CameraModel(
        1024, 1024, np.array([900, 3.0, 905, 500, 520, 0.25, 0.1, 0.05, -2e-3, 1e-3])
    ),
    'pinhole': CameraModel(1000, 800, np.array([5000, 0, 5000, 499.5, 399.5, 0, 0, 0, 0, 0])),
    'rational': CameraModel(
        640, 480, np.array([420, -0.8, 415, 322, 236, *RATIONAL]), 'rational_polynomial'
    ),
    # Large terms that nearly cancel, as calibrations of 90 degree lenses with OpenCV have them.
    'rational wide': CameraModel(
        1280,
        720,
        np.array([640, 0.4, 641, 639, 362, 9.2, 5.1, 0.19, 2e-5, -1e-4, 9.6, 8.1, 1.1]),
        'rational_polynomial',
    ),
    'thin prism': CameraModel(
        640, 480, np.array([420, 1.2, 418, 318, 243, *RATIONAL, *PRISM]), 'thin_prism'
    ),
    'tilted': CameraModel(
        640, 480, np.array([420, 1.2, 418, 318, 243, *RATIONAL, *PRISM, 0.05, -0.03]), 'tilted'
    ),
    'fisheye': CameraModel(
        1000, 1000, np.array([330, 0.7, 331, 501, 497, -0.02, 0.01, -0.004, 5e-4]), 'equidistant'
    ),
    # 291 degrees from corner to corner.
    'fisheye behind': CameraModel(
        640, 480, np.array([160, -0.8, 155, 322, 236, -0.02, 0.01, -0.004, 5e-4]), 'equidistant'
    ),
}
PAPER = CAMERAS['paper'].parameters
each_camera = pytest.mark.parametrize('camera', CAMERAS.values(), ids=CAMERAS.keys())


def wide_grid(camera: CameraModel) -> np.ndarray:
    """Pixels (n, 2) over the detector and a fifth of it beyond each side."""
    # The sphere ends close to the corners of one.
    beyond = 0.0 if camera is CAMERAS['fisheye behind'] else 0.2
    grid = pixel_grid(camera, 29, 23)
    centre = 0.5 * np.array([camera.width - 1, camera.height - 1])
    return centre + (1 + 2 * beyond) * (grid - centre)


@each_camera
def test_derivatives_by_the_parameters_and_by_a_passive_rotation(camera: CameraModel) -> None:
    e = line_of_sight(camera, pixel_grid(camera, 9, 7))
    pixels, J, J_rotation = project_jacobians(camera, e)
    # The same sum in another order: 1e-12 px is five roundings of 2592 px.
    np.testing.assert_allclose(pixels, project(camera, e), rtol=0, atol=3e-12)
    for k, name in enumerate(camera.parameter_names):
        complex_step = camera.parameters.astype(complex)
        complex_step[k] += 1e-30j
        exact = project_parameters(camera.model, complex_step, e).imag / 1e-30
        # A complex step has no truncation error and no cancellation: rounding alone.
        atol = 1e-10 * np.abs(J[..., k]).max()
        np.testing.assert_allclose(J[..., k], exact, rtol=0, atol=atol, err_msg=name)
    assert_derivatives_by_a_rotation(camera, e, J_rotation)


def assert_derivatives_by_a_rotation(camera: CameraModel, e: np.ndarray, J: np.ndarray) -> None:
    for axis in range(3):
        # exp(-[theta x]) e to first order: e - theta x e = e + e x theta (Eqs. 11, 35).
        complex_step = e + 1e-30j * np.cross(e, np.eye(3)[axis])
        exact = project_parameters(camera.model, camera.parameters, complex_step).imag / 1e-30
        np.testing.assert_allclose(J[..., axis], exact, rtol=0, atol=1e-10 * np.abs(J).max())


@each_camera
def test_a_pixel_comes_back_from_its_line_of_sight(camera: CameraModel) -> None:
    pixels = wide_grid(camera)
    e = line_of_sight(camera, pixels)
    assert np.isfinite(e).all()
    # The inverse stops at 1e-14 of the image plane: 7e-11 px at the longest focal length here.
    np.testing.assert_allclose(project(camera, e), pixels, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(e, axis=1), 1.0, rtol=0, atol=5e-16)


@each_camera
def test_one_and_many_alike(camera: CameraModel) -> None:
    pixels = pixel_grid(camera, 4, 3)
    e = line_of_sight(camera, pixels)
    many = project_jacobians(camera, e)
    for k in range(len(pixels)):
        # The iteration goes on until the last of many is there: 1e-14 of the image plane.
        np.testing.assert_allclose(line_of_sight(camera, pixels[k]), e[k], rtol=0, atol=2e-14)
        assert project(camera, e[k]).shape == (2,)
        # Arrays may round as vectors of the processor do, single numbers not: two roundings.
        for one, all_ in zip(project_jacobians(camera, e[k]), many, strict=True):
            np.testing.assert_allclose(one, all_[k], rtol=1e-15, atol=4e-16 * np.abs(all_).max())
        np.testing.assert_allclose(project(camera, e[k]), many[0][k], rtol=1e-15, atol=5e-13)
    stacked = line_of_sight(camera, pixels.reshape(3, 4, 2))
    np.testing.assert_array_equal(stacked, e.reshape(3, 4, 3))
    assert line_of_sight(camera, np.empty((0, 2))).shape == (0, 3)
    assert project(camera, np.empty((0, 3))).shape == (0, 2)


@each_camera
def test_the_length_of_a_direction_does_not_matter(camera: CameraModel) -> None:
    e = line_of_sight(camera, pixel_grid(camera, 5, 5))
    # Powers of two scale exactly.
    np.testing.assert_array_equal(project(camera, 4096.0 * e), project(camera, e))
    np.testing.assert_array_equal(project(camera, e / 4096.0), project(camera, e))


def test_behind_the_camera_is_nan() -> None:
    e = np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.1, 0.2, 1.0]])
    for pixels in (project(CAMERAS['paper'], e), [project(CAMERAS['paper'], one) for one in e]):
        assert np.isnan(pixels[:2]).all() and np.isfinite(pixels[2]).all()


def test_a_fisheye_sees_behind_itself_but_not_along_its_axis() -> None:
    camera = CAMERAS['fisheye behind']
    theta = np.radians([0.0, 1e-7, 1.0, 89.0, 90.0, 91.0, 120.0, 150.0])
    e = np.stack([np.sin(theta), np.zeros(8), np.cos(theta)], axis=-1)
    k1, k2, k3, k4 = camera.distortion
    t2 = theta**2
    along = theta * (1 + k1 * t2 + k2 * t2**2 + k3 * t2**3 + k4 * t2**4)
    fx, _, _, cx, cy = camera.intrinsics
    expected = np.stack([cx + fx * along, np.full(8, cy)], axis=-1)
    np.testing.assert_allclose(project(camera, e), expected, rtol=0, atol=1e-11)
    assert np.isnan(project(camera, np.array([0.0, 0.0, -1.0]))).all()


def test_the_rotation_of_a_fisheye_is_smooth_through_the_axis() -> None:
    # From the series to the closed form at 0.2 rad, and on the axis itself.
    camera = CAMERAS['fisheye']
    theta = np.r_[0.0, 1e-12, 1e-5, 0.1, 0.2 - 1e-9, 0.2 + 1e-9, 0.3, 1.0]
    e = np.stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)], axis=-1)
    _, _, J = project_jacobians(camera, e)
    assert_derivatives_by_a_rotation(camera, e[1:], J[1:])
    fx, skew, fy, _, _ = camera.intrinsics
    np.testing.assert_allclose(J[0], [[skew, -fx, 0], [fy, 0, 0]], rtol=0, atol=1e-12)


def test_a_nan_pixel_spoils_no_other() -> None:
    camera = CAMERAS['barrel']
    pixels = pixel_grid(camera, 5, 5)
    clean = line_of_sight(camera, pixels)
    pixels[7] = np.nan
    e = line_of_sight(camera, pixels)
    assert np.isnan(e[7]).all()
    others = np.arange(25) != 7
    np.testing.assert_allclose(e[others], clean[others], rtol=0, atol=2e-14)


def square(model: str, **distortion: float) -> CameraModel:
    intrinsics = [500.0, 0.0, 500.0, 500.0, 500.0]
    parameters = np.r_[intrinsics, np.zeros(len(LENSES[model].coefficients))]
    return CameraModel(1000, 1000, parameters, model).replace(**distortion)


EQUIDISTANT = square('equidistant', k1=-0.1)


@pytest.mark.parametrize(
    ('camera', 'summit', 'fold_rad'),
    [
        # r (1 + k1 r^2) rises to 2/3 sqrt(1 / (-3 k1)) and falls from there on.
        *(
            (square('plumb_bob', k1=k1), 2 / 3 / np.sqrt(-3 * k1), np.arctan((-3 * k1) ** -0.5))
            for k1 in (-0.2, -0.5)
        ),
        # r (1 - 0.6 r^2 + 0.15 r^4) rises to 0.5515 at r = 0.934, falls to r = 1.236, rises again:
        # beyond 0.5515 only the outer branch is left, where no lens is like its polynomial.
        (square('plumb_bob', k1=-0.6, k2=0.15), 0.5515, np.arctan(0.935)),
        # theta (1 - theta^2 / 10) rises to 2/3 sqrt(10/3) and falls from there on.
        (EQUIDISTANT, 2 / 3 * np.sqrt(10 / 3), np.sqrt(10 / 3)),
        (EQUIDISTANT.replace(k1=0.0), np.pi, np.pi),  # without a fold the sphere ends it
        # r / (1 + r^2) rises to 1/2 at r = 1.
        (square('rational_polynomial', k4=1.0), 0.5, np.arctan(1.0)),
    ],
    ids=['slight', 'strong', 'outer branch', 'fisheye', 'sphere', 'rational'],
)
def test_beyond_the_fold_there_is_no_line_of_sight(camera, summit, fold_rad) -> None:
    radius = summit * np.array([0.2, 0.9, 0.999, 1.001, 1.1, 1.5, 2.0, 10.0])
    e = line_of_sight(camera, np.stack([500 + 500 * radius, np.full(8, 500.0)], axis=-1))
    assert np.isfinite(e[:3]).all() and np.isnan(e[3:]).all()
    assert (np.arccos(e[:3, 2]) < fold_rad).all()  # on the side of the axis


def test_up_to_the_pole_of_a_rational_polynomial_the_whole_plane_is_seen() -> None:
    # r / (1 - r^2 / 2) grows to infinity at r = sqrt(2): any pixel has a line of sight within.
    camera = square('rational_polynomial', k4=-0.5)
    pixels = np.array([[500.0 + 500.0 * radius, 500.0] for radius in (0.5, 2.0, 10.0, 100.0)])
    e = line_of_sight(camera, pixels)
    x = e[:, 0] / e[:, 2]
    assert (np.diff(x) > 0).all() and x[-1] < np.sqrt(2)
    np.testing.assert_allclose(project(camera, e), pixels, rtol=1e-10)


def test_a_tilted_detector_is_not_seen_from_behind() -> None:
    camera = square('tilted', tau_y=0.5)
    # w = sin(tau) x + cos(tau) ends at x = -1 / tan(tau).
    x = -1 / np.tan(0.5) + np.array([-0.1, 0.1])
    pixels = project(camera, np.stack([x, [0.0, 0.0], [1.0, 1.0]], axis=-1))
    assert np.isnan(pixels[0]).all() and np.isfinite(pixels[1]).all()


@each_camera
def test_a_camera_becomes_one_of_a_larger_model(camera: CameraModel) -> None:
    e = line_of_sight(camera, pixel_grid(camera, 9, 7))
    for model, row in LENSES.items():
        larger = set(camera.parameter_names[5:]) <= set(row.coefficients)
        if 'equidistant' in (model, camera.model) or not larger:
            continue
        converted, worst_px = convert(camera, model)
        assert converted.model == model and worst_px == 0.0
        # The same polynomial: roundings of pixels up to 2592.
        np.testing.assert_allclose(project(converted, e), project(camera, e), rtol=0, atol=3e-12)


@pytest.mark.parametrize(
    ('name', 'model', 'most_px'),
    [
        ('paper', 'equidistant', 0.8),  # decentring, which it has not: 4e-4 r^2 at the corner
        ('rational', 'plumb_bob', 0.5),
        ('rational wide', 'plumb_bob', 20.0),
        ('rational wide', 'equidistant', 1.0),
        ('tilted', 'thin_prism', 10.0),
        ('fisheye behind', 'equidistant', 0.0),
    ],
)
def test_a_camera_becomes_the_best_of_another_model(name: str, model: str, most_px: float) -> None:
    camera = CAMERAS[name]
    converted, worst_px = convert(camera, model)
    assert converted.model == model and worst_px <= most_px
    pixels = pixel_grid(camera, 25, 25)
    error = np.linalg.norm(project(converted, line_of_sight(camera, pixels)) - pixels, axis=1)
    assert error.max() == pytest.approx(worst_px, abs=1e-9)


def test_what_a_pinhole_cannot_see_costs_everything() -> None:
    assert convert(CAMERAS['fisheye behind'], 'plumb_bob')[1] == np.inf
    with pytest.raises(ValueError, match="lens model: 'pinhole' is not one of plumb_bob"):
        convert(CAMERAS['paper'], 'pinhole')


def test_the_last_model_has_all_parameters() -> None:
    for model in LENSES:
        assert set(parameter_names(model)) <= set(ALL_PARAMETER_NAMES)


def test_field_radius() -> None:
    camera = CAMERAS['pinhole']
    # The corner is half the size from the axis at the centre; a pinhole has no more to it.
    corner = np.hypot(499.5, 399.5)
    assert field_radius_rad(camera) == pytest.approx(np.arctan(corner / 5000), abs=1e-12)
    margin = np.hypot(599.5, 499.5)
    assert field_radius_rad(camera, 100.0) == pytest.approx(np.arctan(margin / 5000), abs=1e-12)
    assert np.isfinite(field_radius_rad(square('plumb_bob', k1=-0.6)))


@each_camera
def test_no_pixel_lies_outside_the_field_radius(camera: CameraModel) -> None:
    angle = np.arccos(line_of_sight(camera, pixel_grid(camera, 40, 40))[:, 2])
    assert angle.max() <= field_radius_rad(camera) + 1e-12
    # The pinhole without distortion counts too: a strong pincushion takes 12 % off its angle.
    assert field_radius_rad(camera) < 1.15 * angle.max()


@pytest.mark.parametrize('skew', [0.5, 2.0, -4.0])
def test_the_fit_without_skew_costs_no_more_than_the_shear_itself(skew: float) -> None:
    camera = CAMERAS['paper'].replace(skew=skew)
    fitted, worst_px = camera.ros_fit
    assert fitted.parameters[1] == 0.0
    without, none_px = fitted.ros_fit  # nothing is left to fit
    assert without.parameters.tobytes() == fitted.parameters.tobytes() and none_px == 0.0
    # Dropped, skew leaves skew y', at most |skew| times half the height over the focal length.
    bound_px = abs(skew) * 1024 / 7286
    assert 0.05 * bound_px < worst_px <= 1.05 * bound_px
    pixels = pixel_grid(camera, 25, 25)
    error = project(fitted, line_of_sight(camera, pixels)) - pixels
    assert np.linalg.norm(error, axis=1).max() == pytest.approx(worst_px, abs=1e-9)


def test_the_fit_without_skew_is_a_least_squares_minimum() -> None:
    camera = CAMERAS['pincushion']
    fitted, _ = camera.ros_fit
    pixels = pixel_grid(camera, 25, 25)
    e = line_of_sight(camera, pixels)
    base = ((project(fitted, e) - pixels) ** 2).sum()
    for k, name in enumerate(PARAMETER_NAMES):
        if name == 'skew':
            continue
        _, J, _ = project_jacobians(fitted, e)
        h = 1e-3 / np.abs(J[..., k]).max()  # 1e-3 px at the edge
        for step in (h, -h):
            moved = fitted.replace(**{name: fitted.parameters[k] + step})
            assert ((project(moved, e) - pixels) ** 2).sum() > base, name


@pytest.mark.parametrize(
    ('change', 'says'),
    [
        ({'parameters': np.array([0.0, *PAPER[1:]])}, 'fx, fy'),
        ({'parameters': np.array([*PAPER[:2], -1.0, *PAPER[3:]])}, 'fx, fy'),
        ({'parameters': np.array([*PAPER[:5], np.nan, *PAPER[6:]])}, '10 finite numbers'),
        ({'parameters': np.array([*PAPER[:3], np.inf, *PAPER[4:]])}, '10 finite numbers'),
        ({'parameters': PAPER[:9]}, '10 finite numbers'),
        ({'model': 'equidistant'}, '9 finite numbers'),
        ({'model': 'brown'}, "lens model: 'brown' is not one of"),
        ({'width': 0}, 'image size: 0 x 2048'),
    ],
)
def test_impossible_cameras_are_refused(change: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        dataclasses.replace(CAMERAS['paper'], **change)


def test_parameters_cannot_be_changed_from_outside() -> None:
    mine = CAMERAS['paper'].parameters.copy()
    camera = CameraModel(10, 10, mine)
    mine[0] = 1.0
    assert camera.parameters[0] == 7291
    with pytest.raises(ValueError, match='read-only'):
        camera.parameters[0] = 1.0


def test_the_matrix_is_the_pinhole_part() -> None:
    camera = CAMERAS['pinhole'].replace(skew=7.0)
    e = np.array([[0.03, -0.02, 1.0], [-0.01, 0.05, 1.0]])
    homogeneous = e @ camera.camera_matrix.T
    expected = homogeneous[:, :2] / homogeneous[:, 2:]
    np.testing.assert_allclose(project(camera, e), expected, rtol=0, atol=1e-12)


def test_a_coefficient_next_to_zero_folds_nothing() -> None:
    """As a first coefficient of the polynomial it would overflow as a divisor."""
    assert fold_radius2('plumb_bob', np.array([0.0, 0.0, 2.2e-313, 0.0, 0.0])) == np.inf


WIDTH, HEIGHT = 1296, 1024


def test_cosines_are_orthonormal_over_a_domain_a_third_longer() -> None:
    count = 60
    places = COSINE_DOMAIN * ((np.arange(count) + 0.5) / count - 0.5) + 0.5
    u, v = np.meshgrid(places * WIDTH - 0.5, places * HEIGHT - 0.5)
    phi = basis(np.stack([u.ravel(), v.ravel()], -1), WIDTH, HEIGHT, 3)
    # The midpoint rule is exact for cosines: rounding is left.
    np.testing.assert_allclose(phi.T @ phi / count**2, np.eye(phi.shape[1]), atol=1e-12)


def test_an_octave_of_cosines_ends_at_half_its_longest_wave() -> None:
    terms, octave = cosine_terms(WIDTH, HEIGHT, 3)
    length_px = 2.0 * COSINE_DOMAIN / np.hypot(terms[:, 0] / WIDTH, terms[:, 1] / HEIGHT)
    for k in range(3):
        assert length_px[octave == k].min() >= 0.5**k * WIDTH * (1 - 1e-12)
    for k in (1, 2):
        assert length_px[octave == k].max() < 0.5 ** (k - 1) * WIDTH


@pytest.mark.parametrize(('width', 'height', 'octaves'), [(640, 512, 3), (300, 900, 2), (8, 8, 1)])
def test_products_of_the_cosines_are_those_of_their_values(width, height, octaves) -> None:
    """Sums and differences of angles give the weighted Gram matrix to rounding."""
    generator = np.random.default_rng(3)
    pixels = generator.uniform(-0.5, [width - 0.5, height - 0.5], (500, 2))
    weights = generator.normal(1.0, 1.0, (3, 500))
    phi = basis(pixels, width, height, octaves)
    values, products = basis_and_products(pixels, weights, width, height, octaves)
    np.testing.assert_array_equal(values, phi.T)
    for row, found in zip(weights, products, strict=True):
        np.testing.assert_allclose(found, (phi.T * row) @ phi, rtol=0, atol=1e-10)


@pytest.mark.parametrize('size_px', [1e-4, 1e-2, 0.2])
def test_a_camera_with_a_field_projects_what_it_sees(size_px: float) -> None:
    given = scenario('small', 1).truth.camera
    rng = np.random.default_rng(2)
    coefficients = size_px * rng.normal(size=(2, term_count(WIDTH, HEIGHT, 2)))
    field = DetectorField(WIDTH, HEIGHT, 2, coefficients)
    camera = dataclasses.replace(given, field=field)
    pixels = pixel_grid(camera, 9, 7)
    # Twelve steps of a contraction by 0.05 and less leave under 1e-9 px.
    back_px = project(camera, line_of_sight(camera, pixels))
    np.testing.assert_allclose(back_px, pixels, rtol=0, atol=1e-9)
