"""
The camera: pinhole with skew and Brown distortion (Eqs. 1, 6, 7), its inverse and derivatives.

Parameters are one vector of ten, in this order everywhere::

    fx skew fy cx cy  k1 k2 k3 p1 p2        (paper: dx alpha dy up vp, k1 k2 k3 p1 p2)

With x = X/Z, y = Y/Z, r2 = x^2 + y^2 and g = 1 + k1 r2 + k2 r2^2 + k3 r2^3::

    x' = g x + 2 p1 x y + p2 (r2 + 2 x^2)        u = fx x' + skew y' + cx
    y' = g y + p1 (r2 + 2 y^2) + 2 p2 x y        v = fy y' + cy

This is ROS ``plumb_bob`` with a skew term; note that ROS orders D as k1 k2 p1 p2 k3.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from starcal_ros.arrays import Floats

INTRINSIC_NAMES = ('fx', 'skew', 'fy', 'cx', 'cy')
DISTORTION_NAMES = ('k1', 'k2', 'k3', 'p1', 'p2')
PARAMETER_NAMES = INTRINSIC_NAMES + DISTORTION_NAMES

_INVERSE_STEPS = (
    50  # Newton squares the error at each step: 6 do in the field, the rest is for far corners
)
_INVERSE_TOLERANCE = 1e-14  # of the ideal image plane: 4e-11 px at a focal length of 4000 px


@dataclass(frozen=True)
class CameraModel:
    """
    A camera: image size in pixels and the ten parameters, (10,) in `PARAMETER_NAMES` order.

    Raises
    ------
    ValueError
        When the parameters are not ten finite numbers or a focal length is not positive.
    """

    width: int
    height: int
    parameters: Floats
    model: str = 'plumb_bob'

    def __post_init__(self) -> None:
        """Freeze a float copy of the parameters."""
        parameters = np.array(self.parameters, np.float64)
        if parameters.shape != (10,) or not np.isfinite(parameters).all():
            raise ValueError(f'parameters: {self.parameters!r} is not ten finite numbers')
        if self.width < 1 or self.height < 1:
            raise ValueError(f'image size: {self.width} x {self.height} is not an image')
        if parameters[0] <= 0 or parameters[2] <= 0:
            raise ValueError(f'fx, fy: {parameters[0]}, {parameters[2]} are not positive')
        parameters.setflags(write=False)
        object.__setattr__(self, 'parameters', parameters)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of `parameters`, in order."""
        return PARAMETER_NAMES

    @property
    def intrinsics(self) -> Floats:
        """(5,): fx, skew, fy, cx, cy."""
        return self.parameters[:5]

    @property
    def distortion(self) -> Floats:
        """(5,): k1, k2, k3, p1, p2."""
        return self.parameters[5:]

    @property
    def matrix(self) -> Floats:
        """The (3, 3) camera matrix K with skew (Eq. 7)."""
        fx, skew, fy, cx, cy = self.intrinsics
        return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def replace(self, **parameters: float) -> CameraModel:
        """Return the camera with some named parameters changed."""
        changed = self.parameters.copy()
        for name, value in parameters.items():
            changed[PARAMETER_NAMES.index(name)] = value
        return dataclasses.replace(self, parameters=changed)


def distort(xy: Floats, distortion: Floats) -> Floats:
    """Distorted image-plane points (..., 2) of ideal ones (..., 2) (Eq. 6)."""
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, k3, p1, p2 = distortion
    r2 = x * x + y * y
    g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def distortion_px(camera: CameraModel, pixels: Floats) -> Floats:
    """How far (n, 2) the distortion moves what an ideal lens would show at pixels (n, 2)."""
    fx, skew, fy, cx, cy = camera.intrinsics
    y = (pixels[:, 1] - cy) / fy
    x = (pixels[:, 0] - cx - skew * y) / fx
    xd, yd = distort(np.stack([x, y], axis=-1), camera.distortion).T
    return np.stack([fx * xd + skew * yd + cx, fy * yd + cy], axis=-1) - pixels


def distort_jacobian(xy: Floats, distortion: Floats) -> Floats:
    """Derivative (..., 2, 2) of `distort` by its ideal points (Eqs. 36, 37)."""
    x, y = xy[..., 0], xy[..., 1]
    k1, k2, k3, p1, p2 = distortion
    r2 = x * x + y * y
    g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    g_r2 = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    cross = 2 * x * y * g_r2 + 2 * p1 * x + 2 * p2 * y
    J = np.empty((*np.broadcast(x, y).shape, 2, 2), dtype=np.result_type(xy, distortion))
    J[..., 0, 0] = g + 2 * x * x * g_r2 + 2 * p1 * y + 6 * p2 * x
    J[..., 0, 1] = cross
    J[..., 1, 0] = cross
    J[..., 1, 1] = g + 2 * y * y * g_r2 + 6 * p1 * y + 2 * p2 * x
    return J


def project_parameters(parameters: Floats, directions_camera: Floats) -> Floats:
    """
    Pixels (..., 2) of directions (..., 3) in the camera frame, any length (Eqs. 1, 6, 7).

    NaN for directions at or behind the plane of the lens (Z <= 0).  Complex parameters or
    directions pass through, for complex-step derivatives.
    """
    z = directions_camera[..., 2]
    z = np.where(z.real > 0, z, np.nan)
    xy = directions_camera[..., :2] / z[..., None]
    distorted = distort(xy, parameters[5:])
    fx, skew, fy, cx, cy = parameters[:5]
    u = fx * distorted[..., 0] + skew * distorted[..., 1] + cx
    v = fy * distorted[..., 1] + cy
    return np.stack([u, v], axis=-1)


def project(camera: CameraModel, directions_camera: Floats) -> Floats:
    """Pixels (..., 2) of directions (..., 3) in the camera frame; NaN behind the camera."""
    return project_parameters(camera.parameters, np.asarray(directions_camera, np.float64))


def project_jacobians(
    camera: CameraModel, directions_camera: Floats
) -> tuple[Floats, Floats, Floats]:
    """
    Pixels and their derivatives by camera parameters and by a small rotation.

    Parameters
    ----------
    directions_camera : (..., 3)
        Directions in the camera frame, Z > 0.

    Returns
    -------
    pixels : (..., 2)
    J_parameters : (..., 2, 10)
        By the ten camera parameters (Eqs. 29, 30, 32, 33).
    J_rotation : (..., 2, 3)
        By the passive small rotation ``dtheta`` of the camera frame, rad (Eqs. 31, 34-37).
    """
    xy = _image_plane(directions_camera)
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    fx, skew, fy, cx, cy = camera.intrinsics
    distorted = distort(xy, camera.distortion)
    xd, yd = distorted[..., 0], distorted[..., 1]
    pixels = np.stack([fx * xd + skew * yd + cx, fy * yd + cy], axis=-1)

    J_parameters = np.zeros((*x.shape, 2, 10))
    J_parameters[..., 0, 0] = xd
    J_parameters[..., 0, 1] = yd
    J_parameters[..., 0, 3] = 1.0
    J_parameters[..., 1, 2] = yd
    J_parameters[..., 1, 4] = 1.0
    columns_x = (x * r2, x * r2**2, x * r2**3, 2 * x * y, r2 + 2 * x * x)
    columns_y = (y * r2, y * r2**2, y * r2**3, r2 + 2 * y * y, 2 * x * y)
    for k, (column_x, column_y) in enumerate(zip(columns_x, columns_y, strict=True), start=5):
        J_parameters[..., 0, k] = fx * column_x + skew * column_y
        J_parameters[..., 1, k] = fy * column_y

    return pixels, J_parameters, _rotation_jacobian(camera, xy)


def rotation_jacobian(camera: CameraModel, directions_camera: Floats) -> Floats:
    """
    Derivatives (..., 2, 3) of pixels by a small rotation, as of `project_jacobians`.

    Directions (..., 3) in the camera frame, Z > 0.
    """
    return _rotation_jacobian(camera, _image_plane(directions_camera))


def _image_plane(directions_camera: Floats) -> Floats:
    """Ideal points (..., 2) of directions (..., 3)."""
    e = np.asarray(directions_camera, np.float64)
    z_inverse = 1.0 / e[..., 2]
    return np.asarray(e[..., :2] * z_inverse[..., None])


def _rotation_jacobian(camera: CameraModel, xy: Floats) -> Floats:
    """Derivative (..., 2, 3) of pixels by a small rotation, at ideal points (..., 2)."""
    x, y = xy[..., 0], xy[..., 1]
    fx, skew, fy, _, _ = camera.intrinsics
    J_xy = distort_jacobian(xy, camera.distortion)
    J_u = fx * J_xy[..., 0, :] + skew * J_xy[..., 1, :]
    J_v = fy * J_xy[..., 1, :]
    # d(x, y)/d(dtheta) = d(x, y)/de [e x] depends on x and y alone (Eqs. 34, 35).
    theta = np.empty((2, *x.shape, 3))
    theta[0, ..., 0] = x * y
    theta[0, ..., 1] = -1.0 - x * x
    theta[0, ..., 2] = y
    theta[1, ..., 0] = 1.0 + y * y
    theta[1, ..., 1] = -theta[0, ..., 0]
    theta[1, ..., 2] = -x
    x_theta, y_theta = theta
    J = np.empty((*x.shape, 2, 3))
    J[..., 0, :] = J_u[..., 0, None] * x_theta + J_u[..., 1, None] * y_theta
    J[..., 1, :] = J_v[..., 0, None] * x_theta + J_v[..., 1, None] * y_theta
    return J


def line_of_sight(camera: CameraModel, pixels: Floats) -> Floats:
    """
    Unit directions (..., 3) in the camera frame of pixels (..., 2): the inverse of `project`.

    Newton iteration on the distortion with its analytic Jacobian.  NaN where it does not converge
    to the branch that holds the optical axis: there the model folds over and has no inverse.
    """
    pixels = np.asarray(pixels, np.float64)
    fx, skew, fy, cx, cy = camera.intrinsics
    yd = (pixels[..., 1] - cy) / fy
    xd = (pixels[..., 0] - cx - skew * yd) / fx
    target = np.stack([xd, yd], axis=-1)
    xy = target.copy()
    error = np.full(target.shape, np.inf)
    for _ in range(_INVERSE_STEPS):
        error = distort(xy, camera.distortion) - target
        if np.abs(error).max(initial=0.0) < _INVERSE_TOLERANCE:
            break
        J = distort_jacobian(xy, camera.distortion)
        a, b, c, d = J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]
        with np.errstate(all='ignore'):
            determinant = a * d - b * c
            step = np.stack(
                [
                    (d * error[..., 0] - b * error[..., 1]) / determinant,
                    (a * error[..., 1] - c * error[..., 0]) / determinant,
                ],
                axis=-1,
            )
            # A step longer than the radius itself has left the branch: halve its way out.
            reach = 0.5 + np.hypot(xy[..., 0], xy[..., 1])
            length = np.hypot(step[..., 0], step[..., 1])
            step *= np.minimum(1.0, reach / np.maximum(length, 1e-300))[..., None]
        xy = xy - np.nan_to_num(step)
    J = distort_jacobian(xy, camera.distortion)
    determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
    # Past its summit the distorted radius falls: what lies there is another branch.
    k1, k2, k3 = camera.distortion[:3]
    turns = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    summits = turns.real[(np.abs(turns.imag) < 1e-9) & (turns.real > 0)]
    r2 = xy[..., 0] ** 2 + xy[..., 1] ** 2
    lost = np.abs(error).max(axis=-1) > 1e-12 * (1 + np.abs(target).max(axis=-1))
    wrong = lost | (determinant <= 0) | (r2 > summits.min(initial=np.inf))
    xy[wrong] = np.nan
    directions = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))


def pixel_grid(camera: CameraModel, columns: int, rows: int) -> Floats:
    """Pixels (rows * columns, 2) of a regular grid from corner to corner of the detector."""
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)
    )
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def field_radius_rad(camera: CameraModel, margin_px: float = 0.0) -> float:
    """
    Greatest angle from the optical axis to the edge of the detector widened by a margin, rad.

    Of the model and of the pinhole without its distortion: the latter stands in where the model
    has no inverse, and both hold for whatever the distortion turns out to be.
    """
    w, h, m = camera.width - 1, camera.height - 1, margin_px
    edge = np.concatenate(
        [
            [[u, v] for u in np.linspace(-m, w + m, 9) for v in (-m, h + m)],
            [[u, v] for v in np.linspace(-m, h + m, 9) for u in (-m, w + m)],
        ]
    )
    pinhole = dataclasses.replace(camera, parameters=np.r_[camera.intrinsics, np.zeros(5)])
    z = np.r_[line_of_sight(camera, edge)[:, 2], line_of_sight(pinhole, edge)[:, 2]]
    return float(np.arccos(np.nanmin(z)))


def zero_skew_fit(camera: CameraModel) -> tuple[CameraModel, float]:
    """
    Best camera without skew, for readers of ``camera_info``, and what it costs.

    ROS consumers ignore K[0,1].  Skew is a shear; half of it is a rotation that only the alignment
    could carry, so some error stays.  Least squares over a 25 x 25 grid of the detector.

    Returns
    -------
    camera : CameraModel
        With skew exactly 0.
    worst_px : float
        Largest pixel error over the grid.
    """
    if camera.intrinsics[1] == 0.0:
        return camera, 0.0
    free = [0, 2, 3, 4, 5, 6, 7, 8, 9]
    target = pixel_grid(camera, 25, 25)
    directions = line_of_sight(camera, target)
    valid = np.isfinite(directions[:, 0])
    target, directions = target[valid], directions[valid]
    fitted = camera.replace(skew=0.0)
    # The principal point enters linearly, the rest nearly so: Gauss-Newton settles in a few steps.
    for _ in range(10):
        pixels, J, _ = project_jacobians(fitted, directions)
        J = J[..., free].reshape(-1, len(free))
        scale = np.linalg.norm(J, axis=0)
        step = np.linalg.lstsq(J / scale, (target - pixels).ravel(), rcond=1e-12)[0] / scale
        parameters = fitted.parameters.copy()
        parameters[free] += step
        fitted = dataclasses.replace(fitted, parameters=parameters)
    worst = np.linalg.norm(project(fitted, directions) - target, axis=-1).max()
    return fitted, float(worst)
