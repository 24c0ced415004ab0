"""The camera model: derivatives, inverse, fold of the distortion, fit without skew."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.camera import (
    CameraModel,
    distort,
    distort_jacobian,
    field_radius_rad,
    line_of_sight,
    PARAMETER_NAMES,
    pixel_grid,
    project,
    project_jacobians,
    project_parameters,
    zero_skew_fit,
)

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
}
each_camera = pytest.mark.parametrize('camera', CAMERAS.values(), ids=CAMERAS.keys())


def wide_grid(camera: CameraModel, beyond: float = 0.2) -> np.ndarray:
    """Pixels (n, 2) over the detector widened by a fraction of it on each side."""
    grid = pixel_grid(camera, 29, 23)
    centre = 0.5 * np.array([camera.width - 1, camera.height - 1])
    return centre + (1 + 2 * beyond) * (grid - centre)


@each_camera
def test_derivatives_by_the_parameters(camera: CameraModel) -> None:
    e = line_of_sight(camera, pixel_grid(camera, 9, 7))
    pixels, J, _ = project_jacobians(camera, e)
    # The same sum in another order: 1e-12 px is five roundings of 2592 px.
    np.testing.assert_allclose(pixels, project(camera, e), rtol=0, atol=3e-12)
    for k, name in enumerate(PARAMETER_NAMES):
        value = camera.parameters[k]
        size = np.abs(J[..., k]).max()
        complex_step = camera.parameters.astype(complex)
        complex_step[k] += 1e-30j
        exact = project_parameters(complex_step, e).imag / 1e-30
        # A complex step has no truncation error and no cancellation: rounding alone.
        np.testing.assert_allclose(J[..., k], exact, rtol=0, atol=1e-10 * size, err_msg=name)
        h = 1e-3 * max(abs(value), 0.1)
        ahead, behind = (camera.replace(**{name: value + d}) for d in (h, -h))
        central = (project(ahead, e) - project(behind, e)) / (2 * h)
        # Pixels are linear in each parameter alone: only rounding, 1e-12 px over the step.
        np.testing.assert_allclose(J[..., k], central, rtol=0, atol=3e-12 / h + 1e-9 * size)


@each_camera
def test_derivatives_by_a_passive_rotation(camera: CameraModel) -> None:
    e = line_of_sight(camera, pixel_grid(camera, 9, 7))
    _, _, J = project_jacobians(camera, e)
    for axis in range(3):
        theta = np.zeros(3)
        theta[axis] = 1.0
        # exp(-[theta x]) e to first order: e - theta x e = e + e x theta (Eqs. 11, 35).
        complex_step = e + 1e-30j * np.cross(e, theta)
        exact = project_parameters(camera.parameters, complex_step).imag / 1e-30
        size = np.abs(J).max()
        np.testing.assert_allclose(J[..., axis], exact, rtol=0, atol=1e-10 * size)
        h = 1e-4
        ahead, behind = (Rotation.from_rotvec(-d * theta).apply(e) for d in (h, -h))
        central = (project(camera, ahead) - project(camera, behind)) / (2 * h)
        # The third derivative is a few times the first: h^2 of it is left out.
        np.testing.assert_allclose(J[..., axis], central, rtol=0, atol=10 * h**2 * size)


@each_camera
def test_derivative_of_the_distortion(camera: CameraModel) -> None:
    xy = line_of_sight(camera, pixel_grid(camera, 9, 7))
    xy = xy[:, :2] / xy[:, 2:]
    J = distort_jacobian(xy, camera.distortion)
    for axis in range(2):
        step = xy.astype(complex)
        step[:, axis] += 1e-30j
        exact = distort(step, camera.distortion).imag / 1e-30
        np.testing.assert_allclose(J[..., axis], exact, rtol=0, atol=1e-12)


@each_camera
def test_a_pixel_comes_back_from_its_line_of_sight(camera: CameraModel) -> None:
    pixels = wide_grid(camera)
    e = line_of_sight(camera, pixels)
    assert np.isfinite(e).all()
    # The inverse stops at 1e-14 of the image plane: 7e-11 px at the longest focal length here.
    np.testing.assert_allclose(project(camera, e), pixels, rtol=0, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(e, axis=1), 1.0, rtol=0, atol=4e-16)


@each_camera
def test_a_direction_comes_back_from_its_pixel(camera: CameraModel) -> None:
    # Directions that no inverse has made: over the cone in which the detector lies.
    rng = np.random.default_rng(1)
    radius = np.tan(field_radius_rad(camera)) * np.sqrt(rng.uniform(size=300))
    angle = rng.uniform(0, 2 * np.pi, 300)
    e = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.ones(300)], axis=-1)
    e /= np.linalg.norm(e, axis=1)[:, None]
    back = line_of_sight(camera, project(camera, e))
    # 1e-14 of the image plane, a few times more where a barrel shrinks it.
    np.testing.assert_allclose(back, e, rtol=0, atol=1e-13)


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


def test_the_length_of_a_direction_does_not_matter() -> None:
    camera = CAMERAS['barrel']
    e = line_of_sight(camera, pixel_grid(camera, 5, 5))
    # Powers of two scale exactly.
    np.testing.assert_array_equal(project(camera, 4096.0 * e), project(camera, e))
    np.testing.assert_array_equal(project(camera, e / 4096.0), project(camera, e))


def test_behind_the_camera_is_nan() -> None:
    e = np.array([[0.1, 0.2, -1.0], [0.1, 0.2, 0.0], [0.1, 0.2, 1.0]])
    pixels = project(CAMERAS['paper'], e)
    assert np.isnan(pixels[:2]).all() and np.isfinite(pixels[2]).all()
    assert np.isnan(project(CAMERAS['paper'], e[0])).all()


def test_a_nan_pixel_spoils_no_other() -> None:
    camera = CAMERAS['barrel']
    pixels = pixel_grid(camera, 5, 5)
    clean = line_of_sight(camera, pixels)
    pixels[7] = np.nan
    e = line_of_sight(camera, pixels)
    assert np.isnan(e[7]).all()
    others = np.arange(25) != 7
    np.testing.assert_allclose(e[others], clean[others], rtol=0, atol=2e-14)


def folding(k1: float, k2: float = 0.0, k3: float = 0.0) -> CameraModel:
    return CameraModel(1000, 1000, np.array([500, 0, 500, 500, 500, k1, k2, k3, 0, 0]))


@pytest.mark.parametrize('k1', [-0.2, -0.5])
def test_beyond_the_fold_there_is_no_line_of_sight(k1: float) -> None:
    # r (1 + k1 r^2) rises to 2/3 sqrt(1 / (-3 k1)) and falls from there on.
    camera = folding(k1)
    summit = 2 / 3 / np.sqrt(-3 * k1)
    radius = summit * np.array([0.2, 0.9, 0.999, 1.001, 1.1, 2.0, 10.0])
    e = line_of_sight(camera, np.stack([500 + 500 * radius, np.full(7, 500.0)], axis=-1))
    assert np.isfinite(e[:3]).all()
    assert np.isnan(e[3:]).all()
    x = e[:3, 0] / e[:3, 2]
    assert (x < 1 / np.sqrt(-3 * k1)).all()  # on the side of the axis


def test_a_pixel_past_the_summit_takes_no_outer_branch() -> None:
    # r (1 - 0.6 r^2 + 0.15 r^4) rises to 0.5515 at r = 0.934, falls to r = 1.236, rises again:
    # beyond 0.5515 only the outer branch is left, where no lens is like its polynomial.
    camera = folding(-0.6, 0.15)
    radius = np.array([0.3, 0.54, 0.551, 0.553, 0.6, 0.8])
    e = line_of_sight(camera, np.stack([500 + 500 * radius, np.full(6, 500.0)], axis=-1))
    assert (e[:3, 0] / e[:3, 2] < 0.935).all()
    assert np.isnan(e[3:]).all()


def test_field_radius() -> None:
    camera = CAMERAS['pinhole']
    # The corner is half the size from the axis at the centre; a pinhole has no more to it.
    corner = np.hypot(499.5, 399.5)
    assert field_radius_rad(camera) == pytest.approx(np.arctan(corner / 5000), abs=1e-12)
    margin = np.hypot(599.5, 499.5)
    assert field_radius_rad(camera, 100.0) == pytest.approx(np.arctan(margin / 5000), abs=1e-12)


@each_camera
def test_no_pixel_lies_outside_the_field_radius(camera: CameraModel) -> None:
    angle = np.arccos(line_of_sight(camera, pixel_grid(camera, 40, 40))[:, 2])
    assert angle.max() <= field_radius_rad(camera) + 1e-12
    # The pinhole without distortion counts too: a strong pincushion takes 12 % off its angle.
    assert field_radius_rad(camera) < 1.15 * angle.max()


def test_field_radius_of_a_camera_that_folds_over_is_finite() -> None:
    assert np.isfinite(field_radius_rad(folding(-0.6)))


def test_without_skew_nothing_is_fitted() -> None:
    camera = CAMERAS['pinhole']
    fitted, worst_px = zero_skew_fit(camera)
    assert fitted is camera and worst_px == 0.0


@pytest.mark.parametrize('skew', [0.5, 2.0, -4.0])
def test_the_fit_without_skew_costs_no_more_than_the_shear_itself(skew: float) -> None:
    camera = CAMERAS['paper'].replace(skew=skew)
    fitted, worst_px = zero_skew_fit(camera)
    assert fitted.parameters[1] == 0.0
    # Dropped, skew leaves skew y', at most |skew| times half the height over the focal length.
    bound_px = abs(skew) * 1024 / 7286
    assert 0.05 * bound_px < worst_px <= 1.05 * bound_px
    pixels = pixel_grid(camera, 25, 25)
    error = project(fitted, line_of_sight(camera, pixels)) - pixels
    assert np.linalg.norm(error, axis=1).max() == pytest.approx(worst_px, abs=1e-9)


def test_the_fit_without_skew_is_a_least_squares_minimum() -> None:
    camera = CAMERAS['pincushion']
    fitted, _ = zero_skew_fit(camera)
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
        ({'fx': 0.0}, 'fx, fy'),
        ({'fy': -1.0}, 'fx, fy'),
        ({'k1': np.nan}, 'ten finite numbers'),
        ({'cx': np.inf}, 'ten finite numbers'),
    ],
)
def test_impossible_parameters_are_refused(change: dict[str, float], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        CAMERAS['paper'].replace(**change)


def test_impossible_sizes_are_refused() -> None:
    parameters = CAMERAS['paper'].parameters
    with pytest.raises(ValueError, match='ten finite numbers'):
        CameraModel(10, 10, parameters[:9])
    with pytest.raises(ValueError, match='image size: 0 x 10'):
        CameraModel(0, 10, parameters)


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
    homogeneous = e @ camera.matrix.T
    expected = homogeneous[:, :2] / homogeneous[:, 2:]
    np.testing.assert_allclose(project(camera, e), expected, rtol=0, atol=1e-12)
