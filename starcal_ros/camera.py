"""
The camera: an ideal image plane, a lens model, skew; its inverse and derivatives.

The parameters are one vector, in this order everywhere::

    fx skew fy cx cy  then the coefficients of the lens model (`lens.COEFFICIENTS`)

With (x', y') the distorted point of the image plane (`lens.distort`)::

    u = fx x' + skew y' + cx
    v = fy y' + cy

For ``plumb_bob`` that is Eqs. 1, 6 and 7: k1 k2 k3 p1 p2 follow the intrinsics (paper: dx alpha
dy up vp, k1 k2 k3 p1 p2); note that ROS orders D as k1 k2 p1 p2 k3.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from starcal_ros.arrays import Floats
from starcal_ros.detector_field import DetectorField
from starcal_ros.lens import (
    coefficient_jacobian,
    COEFFICIENTS,
    directions_of,
    distort,
    distort_jacobian,
    fold_radius2,
    ideal_by_rotation,
    ideal_points,
)

INTRINSIC_NAMES = ('fx', 'skew', 'fy', 'cx', 'cy')


def parameter_names(model: str) -> tuple[str, ...]:
    """Names of the parameters of a lens model, in order."""
    return INTRINSIC_NAMES + COEFFICIENTS[model]


def model_of(names: tuple[str, ...]) -> str:
    """
    Lens model whose parameters have these names, in this order.

    Raises
    ------
    ValueError
        When no model has them.
    """
    for model in COEFFICIENTS:
        if names == parameter_names(model):
            return model
    raise ValueError(f'{", ".join(names) or "none"} are not the parameters of a lens model')


PARAMETER_NAMES = parameter_names('plumb_bob')
# Those of `tilted` are those of all.
ALL_PARAMETER_NAMES = parameter_names('tilted')
"""Every name that a parameter of any lens model has."""

_INVERSE_STEPS = (
    50  # Newton squares the error at each step: 6 do in the field, the rest is for far corners
)
_HELD_PX = 1e-2  # what a fit pays for a coefficient of a rational polynomial that moves by one
# A field changes by under 0.1 px from pixel to pixel: each step takes off nine tenths and more.
_FIELD_STEPS = 12
_INVERSE_TOLERANCE = 1e-14  # of the ideal image plane: 4e-11 px at a focal length of 4000 px


@dataclass(frozen=True)
class CameraModel:
    """
    A camera: image size in pixels, parameters and lens model.

    ``parameters`` is (p,) in the order of `parameter_names`; ``model`` a key of
    `lens.COEFFICIENTS`; ``field`` what the detector shows beyond the lens model.

    Raises
    ------
    ValueError
        For an unknown model, when the parameters are not p finite numbers, or when a focal length
        is not positive.
    """

    width: int
    height: int
    parameters: Floats
    model: str = 'plumb_bob'
    field: DetectorField | None = None

    def __post_init__(self) -> None:
        """Freeze a float copy of the parameters."""
        if self.model not in COEFFICIENTS:
            raise ValueError(f'lens model: {self.model!r} is not one of {", ".join(COEFFICIENTS)}')
        parameters = np.array(self.parameters, np.float64)
        count = len(self.parameter_names)
        if parameters.shape != (count,) or not np.isfinite(parameters).all():
            raise ValueError(
                f'parameters: {self.parameters!r} is not {count} finite numbers ({self.model})'
            )
        if self.width < 1 or self.height < 1:
            raise ValueError(f'image size: {self.width} x {self.height} is not an image')
        if parameters[0] <= 0 or parameters[2] <= 0:
            raise ValueError(f'fx, fy: {parameters[0]}, {parameters[2]} are not positive')
        parameters.setflags(write=False)
        object.__setattr__(self, 'parameters', parameters)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of `parameters`, in order."""
        return parameter_names(self.model)

    @property
    def intrinsics(self) -> Floats:
        """(5,): fx, skew, fy, cx, cy."""
        return self.parameters[:5]

    @property
    def distortion(self) -> Floats:
        """Coefficients (c,) of the lens model, in the order of `lens.COEFFICIENTS`."""
        return self.parameters[5:]

    @property
    def matrix(self) -> Floats:
        """The (3, 3) camera matrix K with skew (Eq. 7)."""
        fx, skew, fy, cx, cy = self.intrinsics
        return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def replace(self, **parameters: float) -> CameraModel:
        """Return the camera with some named parameters changed; ValueError for other names."""
        changed = self.parameters.copy()
        for name, value in parameters.items():
            changed[self.parameter_names.index(name)] = value
        return dataclasses.replace(self, parameters=changed)


def distortion_px(camera: CameraModel, pixels: Floats) -> Floats:
    """
    How far (n, 2) the distortion moves what an ideal lens would show at pixels (n, 2).

    The ideal lens is the pinhole, for ``equidistant`` that of equal pixels per angle.
    """
    fx, skew, fy, cx, cy = camera.intrinsics
    y = (pixels[:, 1] - cy) / fy
    x = (pixels[:, 0] - cx - skew * y) / fx
    xd, yd = distort(camera.model, np.stack([x, y], axis=-1), camera.distortion).T
    return np.stack([fx * xd + skew * yd + cx, fy * yd + cy], axis=-1) - pixels


def project_parameters(model: str, parameters: Floats, directions_camera: Floats) -> Floats:
    """
    Pixels (..., 2) of directions (..., 3) in the camera frame, any length (Eqs. 1, 6, 7).

    Parameters (p,) of the lens model, or (p, n) for n directions.  NaN where a perspective model
    is given a direction at or behind the plane of the lens (Z <= 0).  Complex parameters or
    directions pass through, for complex-step derivatives.
    """
    distorted = distort(model, ideal_points(model, directions_camera), parameters[5:])
    fx, skew, fy, cx, cy = parameters[:5]
    u = fx * distorted[..., 0] + skew * distorted[..., 1] + cx
    v = fy * distorted[..., 1] + cy
    return np.stack([u, v], axis=-1)


def project(camera: CameraModel, directions_camera: Floats) -> Floats:
    """
    Pixels (..., 2) of directions (..., 3) in the camera frame; NaN where there is none.

    The field of the camera is a function of the pixel that comes out, so it is iterated.
    """
    directions = np.asarray(directions_camera, np.float64)
    ideal = project_parameters(camera.model, camera.parameters, directions)
    if camera.field is None:
        return ideal
    pixels = ideal
    for _ in range(_FIELD_STEPS):
        pixels = ideal + camera.field.displacement_px(pixels)
    return pixels


def project_jacobians(
    camera: CameraModel, directions_camera: Floats
) -> tuple[Floats, Floats, Floats]:
    """
    Pixels of the lens model, without the field, and their derivatives.

    By the camera parameters and by a small rotation.

    Parameters
    ----------
    directions_camera : (..., 3)
        Directions in the camera frame; Z > 0 for a perspective model.

    Returns
    -------
    pixels : (..., 2)
    J_parameters : (..., 2, p)
        By the camera parameters (Eqs. 29, 30, 32, 33).
    J_rotation : (..., 2, 3)
        By the passive small rotation ``dtheta`` of the camera frame, rad (Eqs. 31, 34-37).
    """
    xy = _image_plane(camera.model, directions_camera)
    fx, skew, fy, cx, cy = camera.intrinsics
    distorted = distort(camera.model, xy, camera.distortion)
    xd, yd = distorted[..., 0], distorted[..., 1]
    pixels = np.stack([fx * xd + skew * yd + cx, fy * yd + cy], axis=-1)

    J_parameters = np.zeros((*xd.shape, 2, len(camera.parameters)))
    J_parameters[..., 0, 0] = xd
    J_parameters[..., 0, 1] = yd
    J_parameters[..., 0, 3] = 1.0
    J_parameters[..., 1, 2] = yd
    J_parameters[..., 1, 4] = 1.0
    columns = coefficient_jacobian(camera.model, xy, camera.distortion)
    for k, (column_x, column_y) in enumerate(zip(*columns, strict=True), start=5):
        J_parameters[..., 0, k] = fx * column_x + skew * column_y
        J_parameters[..., 1, k] = fy * column_y

    return pixels, J_parameters, _rotation_jacobian(camera, xy)


def rotation_jacobian(camera: CameraModel, directions_camera: Floats) -> Floats:
    """
    Derivatives (..., 2, 3) of pixels by a small rotation, as of `project_jacobians`.

    Directions (..., 3) in the camera frame; Z > 0 for a perspective model.
    """
    return _rotation_jacobian(camera, _image_plane(camera.model, directions_camera))


def _image_plane(model: str, directions_camera: Floats) -> Floats:
    """Ideal points (..., 2) of directions (..., 3)."""
    e = np.asarray(directions_camera, np.float64)
    if model == 'equidistant':
        return ideal_points(model, e)
    z_inverse = 1.0 / e[..., 2]
    return np.asarray(e[..., :2] * z_inverse[..., None])


def _rotation_jacobian(camera: CameraModel, xy: Floats) -> Floats:
    """Derivative (..., 2, 3) of pixels by a small rotation, at ideal points (..., 2)."""
    fx, skew, fy, _, _ = camera.intrinsics
    J_xy = distort_jacobian(camera.model, xy, camera.distortion)
    J_u = fx * J_xy[..., 0, :] + skew * J_xy[..., 1, :]
    J_v = fy * J_xy[..., 1, :]
    x_theta, y_theta = ideal_by_rotation(camera.model, xy)
    J = np.empty((*xy.shape[:-1], 2, 3))
    J[..., 0, :] = J_u[..., 0, None] * x_theta + J_u[..., 1, None] * y_theta
    J[..., 1, :] = J_v[..., 0, None] * x_theta + J_v[..., 1, None] * y_theta
    return J


def line_of_sight(camera: CameraModel, pixels: Floats) -> Floats:
    """
    Unit directions (..., 3) in the camera frame of pixels (..., 2): the inverse of `project`.

    Newton iteration on the distortion with its analytic Jacobian.  NaN where it does not converge
    to the branch that holds the optical axis: there the model folds over and has no inverse.
    """
    model, distortion = camera.model, camera.distortion
    fold2 = fold_radius2(model, distortion)
    pixels = np.asarray(pixels, np.float64)
    if camera.field is not None:
        pixels = pixels - camera.field.displacement_px(pixels)
    fx, skew, fy, cx, cy = camera.intrinsics
    yd = (pixels[..., 1] - cy) / fy
    xd = (pixels[..., 0] - cx - skew * yd) / fx
    target = np.stack([xd, yd], axis=-1)
    # Newton squares no error beyond a fold or a pole; a start and steps inside stay inside.
    guarded = model != 'plumb_bob'
    xy = _inside(0.0 * target, target, fold2) if guarded else target.copy()
    error = np.full(target.shape, np.inf)
    for _ in range(_INVERSE_STEPS):
        error = distort(model, xy, distortion) - target
        if np.abs(error).max(initial=0.0) < _INVERSE_TOLERANCE:
            break
        J = distort_jacobian(model, xy, distortion)
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
        moved = xy - np.nan_to_num(step)
        xy = _inside(xy, moved, fold2) if guarded else moved
    J = distort_jacobian(model, xy, distortion)
    determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
    # Past its summit the distorted radius falls: what lies there is another branch.
    r2 = xy[..., 0] ** 2 + xy[..., 1] ** 2
    found = np.abs(error).max(axis=-1) <= 1e-12 * (1 + np.abs(target).max(axis=-1))
    xy[~found | (determinant <= 0) | (r2 > fold2)] = np.nan
    return directions_of(model, xy)


def _inside(before: Floats, after: Floats, fold2: float) -> Floats:
    """Points (..., 2) after a step; of one that leads beyond the fold, halfway there by radius."""
    radius = np.hypot(after[..., 0], after[..., 1])
    beyond = radius**2 >= fold2
    if not beyond.any():
        return np.array(after)
    halfway = 0.5 * (np.hypot(before[..., 0], before[..., 1])[beyond] + np.sqrt(fold2))
    after = after.copy()
    after[beyond] *= (halfway / radius[beyond])[:, None]
    return np.asarray(after)


def pixel_grid(camera: CameraModel, columns: int, rows: int) -> Floats:
    """Pixels (rows * columns, 2) of a regular grid from corner to corner of the detector."""
    u, v = np.meshgrid(
        np.linspace(0, camera.width - 1, columns), np.linspace(0, camera.height - 1, rows)
    )
    return np.stack([u.ravel(), v.ravel()], axis=-1)


def field_radius_rad(camera: CameraModel, margin_px: float = 0.0) -> float:
    """
    Greatest angle from the optical axis to the edge of the detector widened by a margin, rad.

    Of the model and of the lens without its distortion: the latter stands in where the model
    has no inverse, and both hold for whatever the distortion turns out to be.
    """
    w, h, m = camera.width - 1, camera.height - 1, margin_px
    edge = np.concatenate(
        [
            [[u, v] for u in np.linspace(-m, w + m, 9) for v in (-m, h + m)],
            [[u, v] for v in np.linspace(-m, h + m, 9) for u in (-m, w + m)],
        ]
    )
    undistorted = np.r_[camera.intrinsics, np.zeros(len(camera.distortion))]
    pinhole = dataclasses.replace(camera, parameters=undistorted)
    z = np.r_[line_of_sight(camera, edge)[:, 2], line_of_sight(pinhole, edge)[:, 2]]
    return float(np.arccos(np.nanmin(z)))


def ros_fit(camera: CameraModel) -> tuple[CameraModel, float]:
    """
    Best camera without skew and field, for readers of ``camera_info``, and its cost.

    ROS consumers ignore K[0,1], but their OpenCV has every lens model here.  Skew is a shear; half
    of it is a rotation that only the alignment could carry, so some error stays.  Least squares
    over a 25 x 25 grid of the detector.

    Returns
    -------
    camera : CameraModel
        Of the same lens model, with skew exactly 0.
    worst_px : float
        Largest pixel error over the grid.
    """
    if camera.intrinsics[1] == 0.0 and camera.field is None:
        return camera, 0.0
    free = [k for k, name in enumerate(camera.parameter_names) if name != 'skew']
    return _fit(dataclasses.replace(camera.replace(skew=0.0), field=None), free, camera)


def convert(camera: CameraModel, model: str) -> tuple[CameraModel, float]:
    """
    Best camera of a lens model for the lines of sight of another camera, and its cost.

    Least squares over a 25 x 25 grid of the detector, from the coefficients that both models have.

    Returns
    -------
    camera : CameraModel
    worst_px : float
        Largest pixel error over the grid; infinite where the model cannot see all of it.

    Raises
    ------
    ValueError
        For an unknown model.
    """
    if model == camera.model and camera.field is None:
        return camera, 0.0
    if model not in COEFFICIENTS:
        raise ValueError(f'lens model: {model!r} is not one of {", ".join(COEFFICIENTS)}')
    names = parameter_names(model)
    known = dict(zip(camera.parameter_names, camera.parameters, strict=True))
    same_plane = 'equidistant' not in (model, camera.model)
    start = np.array([known.get(name, 0.0) for name in names])
    if not same_plane:
        start[5:] = 0.0
    started = CameraModel(camera.width, camera.height, start, model)
    if same_plane and known.keys() <= set(names) and camera.field is None:
        return started, 0.0  # a special case of the larger model
    return _fit(started, list(range(len(names))), camera)


def nearest_camera(
    camera: CameraModel, model: str, zero: tuple[str, ...]
) -> tuple[CameraModel, float]:
    """
    Best camera of a lens model with some parameters held at zero, without field, and its cost.

    For formats that lack these parameters.  Least squares as of `convert`.

    Returns
    -------
    camera : CameraModel
    worst_px : float
        Largest pixel error over the grid; infinite where the model cannot see all of it.

    Raises
    ------
    ValueError
        For an unknown model, or a name that is no parameter of it.
    """
    start = camera if model == camera.model else convert(camera, model)[0]
    start = dataclasses.replace(start.replace(**dict.fromkeys(zero, 0.0)), field=None)
    unchanged = camera.field is None and model == camera.model
    if unchanged and np.array_equal(start.parameters, camera.parameters):
        return start, 0.0
    free = [k for k, name in enumerate(start.parameter_names) if name not in zero]
    return _fit(start, free, camera)


def _fit(start: CameraModel, free: list[int], camera: CameraModel) -> tuple[CameraModel, float]:
    """Camera fitted to the pixels of the lines of sight of another, and its worst error, px."""
    target = pixel_grid(camera, 25, 25)
    directions = line_of_sight(camera, target)
    exists = np.isfinite(directions[:, 0])
    target, directions = target[exists], directions[exists]
    seen = np.isfinite(project(start, directions)).all(axis=1)

    def moved(x: Floats) -> CameraModel:
        parameters = start.parameters.copy()
        parameters[free] = x
        return dataclasses.replace(start, parameters=parameters)

    # The numerator and the denominator of a rational polynomial trade: unheld, they run away
    # together to coefficients of 10^4 for a gain of 1e-3 px.
    held_px = np.diag(np.where(np.arange(len(start.parameters)) < 5, 0.0, _HELD_PX))[free][:, free]
    if start.model in ('plumb_bob', 'equidistant'):
        held_px = held_px[:0]

    def residual(x: Floats) -> Floats:
        off = project(moved(x), directions[seen]) - target[seen]
        return np.concatenate([off.ravel(), held_px @ (x - start.parameters[free])])

    def jacobian(x: Floats) -> Floats:
        J = project_jacobians(moved(x), directions[seen])[1]
        return np.concatenate([J[..., free].reshape(-1, len(free)), held_px])

    # MINPACK scales the parameters by their columns and bounds the step.
    found = least_squares(
        residual,
        start.parameters[free],
        jacobian,
        method='lm',
        x_scale='jac',
        ftol=1e-9 if len(held_px) else 1e-15,
        xtol=1e-15,
        gtol=1e-15,
        max_nfev=200,
    )
    fitted = moved(found.x)
    error = np.linalg.norm(project(fitted, directions) - target, axis=-1)
    return fitted, float(np.where(np.isnan(error), np.inf, error).max(initial=0.0))
