# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The camera: an ideal image plane, a lens model, skew; inverse, derivatives and conversion.

The parameters are one vector, in this order everywhere::

    fx skew fy cx cy  then the coefficients of the lens model (`lens.LENSES`)

With (x', y') the distorted point of the image plane (`lens.LensModel`)::

    u = fx x' + skew y' + cx
    v = fy y' + cy

For ``plumb_bob`` that is Eqs. 1, 6 and 7: k1 k2 k3 p1 p2 follow the intrinsics (paper: dx alpha
dy up vp, k1 k2 k3 p1 p2); note that ROS orders D as k1 k2 p1 p2 k3.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera.detector_field import DetectorField
import starcal_ros.camera.lens as lens  # its package imports this module
from starcal_ros.record_fields import Record

MAX_SIDE_PX = 65536
_MAX_FOCAL_PX = 1e8  # 0.002 arcsec per pixel
_MIN_FOCAL_OF_SIDE = 0.15  # shortest perspective lens: 147 degrees along the longer side
_MAX_COEFFICIENT = 1e15
_SEEN = 0.5  # smallest part of the detector with lines of sight

INTRINSIC_NAMES = ('fx', 'skew', 'fy', 'cx', 'cy')


def parameter_names(model: str) -> tuple[str, ...]:
    """Names of the parameters of a lens model, in order."""
    return INTRINSIC_NAMES + lens.LENSES[model].coefficients


PARAMETER_NAMES = parameter_names('plumb_bob')
ALL_PARAMETER_NAMES = parameter_names('tilted')
"""Names of the parameters of all lens models; `tilted` has them all."""

_INVERSE_STEPS = 50  # Newton iterations: 6 suffice in the field, far corners need more
# A field changes by less than 0.1 px per pixel, that of a good camera by 0.0001 px, so that each
# step reduces the error at least tenfold.
_FIELD_STEPS = 12
_FIELD_TOLERANCE_PX = 1e-11  # a smaller step is the rounding of a pixel coordinate
_SHORT = 0.3  # a step that stays on the branch, on the ideal image plane
_INVERSE_TOLERANCE = 1e-14  # on the ideal image plane: 4e-11 px at a focal length of 4000 px
# Penalty of a fit for each unit by which a coefficient of a rational polynomial changes.
_HELD_PX = 1e-2
_EXACT_PX = 1e-9  # beyond the rounding of a projection and its inverse


@dataclasses.dataclass(frozen=True, eq=False)
class CameraModel(Record):
    """
    A camera: image size in pixels, parameters and lens model.

    ``parameters`` is (p,) in the order of `parameter_names`; ``model`` a key of
    `lens.LENSES`; ``field`` a displacement that the lens model does not describe.  Raises
    ValueError for an unknown model, for parameters that are not p finite numbers, and for a focal
    length that is not positive.

    >>> import starcal_ros
    >>> camera = starcal_ros.CameraModel(1024, 768, [2000, 0, 2000, 511.5, 383.5, 0, 0, 0, 0, 0])
    >>> camera.parameter_names
    ('fx', 'skew', 'fy', 'cx', 'cy', 'k1', 'k2', 'k3', 'p1', 'p2')
    >>> camera.replace(k1=-0.1).distortion.tolist()
    [-0.1, 0.0, 0.0, 0.0, 0.0]
    >>> camera.camera_matrix[0].tolist(), camera.opencv_coefficients.shape
    ([2000.0, 0.0, 511.5], (5,))
    """

    width: int
    height: int
    parameters: Floats
    model: str = 'plumb_bob'
    field: DetectorField | None = None

    def __post_init__(self) -> None:
        """Freeze a float copy of the parameters."""
        lens.lens_named(self.model)
        parameters = np.array(self.parameters, np.float64)
        count = len(self.parameter_names)
        if parameters.shape != (count,) or not np.isfinite(parameters).all():
            raise ValueError(
                f'parameters: {self.parameters!r} is not {count} finite numbers ({self.model})'
            )
        if self.width < 1 or self.height < 1:
            raise ValueError(f'image size: {self.width} x {self.height} is not an image')
        if max(self.width, self.height) > MAX_SIDE_PX:
            raise ValueError(f'image size: {self.width} x {self.height} is over {MAX_SIDE_PX} px')
        if parameters[0] <= 0 or parameters[2] <= 0:
            raise ValueError(f'fx, fy: {parameters[0]}, {parameters[2]} are not positive')
        parameters.setflags(write=False)
        object.__setattr__(self, 'parameters', parameters)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of `parameters`, in order."""
        return parameter_names(self.model)

    @property
    def lens(self) -> lens.LensModel:
        """Row of the lens model in `lens.LENSES`."""
        return lens.LENSES[self.model]

    def has_lens(self, model: str) -> bool:
        """Return True if a lens model is that of this camera: its parameters mean the same."""
        return self.model == model

    @property
    def intrinsics(self) -> Floats:
        """(5,): fx, skew, fy, cx, cy."""
        return self.parameters[:5]

    @property
    def distortion(self) -> Floats:
        """Coefficients (c,) of the lens model, in the order of `lens.LENSES`."""
        return self.parameters[5:]

    @property
    def moving_field(self) -> DetectorField | None:
        """The field if it moves pixels, else None: a field of zeros only carries a covariance."""
        moves = self.field is not None and self.field.coefficients.any()
        return self.field if moves else None

    @property
    def camera_matrix(self) -> Floats:
        """The (3, 3) camera matrix K with skew (Eq. 7)."""
        fx, skew, fy, cx, cy = self.intrinsics
        return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @functools.cached_property
    def _field_radii_rad(self) -> dict[float, float]:
        """Found by `field_radius_rad`, by the margin in px: each image asks for the same one."""
        return {}

    @functools.cached_property
    def ros_fit(self) -> tuple[CameraModel, float]:
        """
        Best camera without skew and field, for readers of ``camera_info``, its worst error, px.

        They ignore the skew K[0,1], but their OpenCV has every lens model here.  Half of a skew is
        a rotation, which only the alignment could take up, so some error stays.
        """
        return convert(self, self.model, ('skew',))

    @property
    def opencv_coefficients(self) -> Floats:
        """Distortion (c,) in OpenCV's order: for cv2, or cv2.fisheye if ``equidistant``."""
        return lens.ros_distortion(self.model, self.distortion)[1]

    def on_detector(self, pixels: Floats) -> Mask:
        """Mask (...) of the pixels (..., 2) within the outer edges of the outermost pixels."""
        u, v = pixels[..., 0], pixels[..., 1]
        # Pixel centres are integers: the edge is half a pixel beyond the outermost ones.
        along_u = (u >= -0.5) & (u <= self.width - 0.5)
        return np.asarray(along_u & (v >= -0.5) & (v <= self.height - 0.5))

    def replace(self, **parameters: float) -> CameraModel:
        """Return the camera with some named parameters changed; ValueError for other names."""
        changed = self.parameters.copy()
        for name, value in parameters.items():
            changed[self.parameter_names.index(name)] = value
        return dataclasses.replace(self, parameters=changed)


def check_plausible(camera: CameraModel) -> None:
    """
    Check a camera from a file or a message: a real one is far inside these limits.

    Raises ValueError naming the parameter, its value and the likely cause.
    """
    width, height = camera.width, camera.height
    fx, skew, fy, cx, cy = camera.intrinsics.tolist()
    side_px = max(width, height)
    if camera.lens.is_angular:
        least_px = float(np.hypot(width, height)) / (2 * np.pi)
    else:
        least_px = _MIN_FOCAL_OF_SIDE * side_px
    for name, focal_px in (('fx', fx), ('fy', fy)):
        if focal_px < least_px:
            raise ValueError(
                f'{name}: {focal_px:.6g} px is under {least_px:.4g} px, the shortest focal length'
                f' for an image of {width} x {height}; is it in mm? divide by the pixel size in mm'
            )
        if focal_px > _MAX_FOCAL_PX:
            raise ValueError(f'{name}: {focal_px:.6g} px is over {_MAX_FOCAL_PX:.6g} px')
    if not 0.1 <= fx / fy <= 10.0:
        raise ValueError(f'fx, fy: {fx:.6g}, {fy:.6g} px differ by more than a factor of ten')
    if abs(skew) > 0.1 * fx:
        raise ValueError(f'skew: {skew:.6g} px is over a tenth of fx')
    for name, centre_px, size in (('cx', cx, width), ('cy', cy, height)):
        if not -size <= centre_px <= 2 * size:
            raise ValueError(f'{name}: {centre_px:.6g} px is far outside of the {size} px')
    coefficients = camera.distortion
    if (np.abs(coefficients) > _MAX_COEFFICIENT).any() or _part_seen(camera) < _SEEN:
        raise ValueError(
            f'distortion: {", ".join(f"{value:.4g}" for value in coefficients)}: the lens model'
            ' has no line of sight over most of the detector; check the coefficients'
        )


def _part_seen(camera: CameraModel) -> float:
    """Fraction of pixels with a line of sight that distortion moves by less than an image."""
    grid = pixel_grid(camera, 9, 9)
    with np.errstate(all='ignore'):
        try:
            direction = line_of_sight(camera, grid)
            moved_px = np.abs(distortion_px(camera, grid)).max(axis=1)
        except (ArithmeticError, np.linalg.LinAlgError):
            return 0.0
    near = moved_px <= max(camera.width, camera.height)
    return float((np.isfinite(direction).all(axis=1) & near).mean())


def distortion_px(camera: CameraModel, pixels: Floats) -> Floats:
    """
    Displacement (n, 2) of stars from pixels (n, 2), where a lens without distortion has them.

    The ideal lens is a pinhole; for ``equidistant`` the radius is proportional to the angle.
    """
    distorted = camera.lens.distort(_plane_points(camera, pixels), camera.distortion)
    return _pixels(camera.intrinsics, distorted) - pixels


def _pixels(intrinsics: Floats, distorted: Floats) -> Floats:
    """Pixels (..., 2) of distorted points (..., 2) of the image plane."""
    fx, skew, fy, cx, cy = intrinsics
    xd, yd = distorted[..., 0], distorted[..., 1]
    return lens.points_of(fx * xd + skew * yd + cx, fy * yd + cy)


def _plane_points(camera: CameraModel, pixels: Floats) -> Floats:
    """Distorted points (..., 2) of the image plane of pixels (..., 2): inverse of `_pixels`."""
    fx, skew, fy, cx, cy = camera.intrinsics
    yd = (pixels[..., 1] - cy) / fy
    return lens.points_of((pixels[..., 0] - cx - skew * yd) / fx, yd)


def project_parameters(model: str, parameters: Floats, directions_camera: Floats) -> Floats:
    """
    Pixels (..., 2) of directions (..., 3) in the camera frame, any length (Eqs. 1, 6, 7).

    Parameters (p,) of the lens model, or (p, n) for n directions.  NaN where a perspective model
    is given a direction at or behind the plane of the lens (Z <= 0).  Complex parameters or
    directions pass through, for complex-step derivatives.
    """
    ideal = lens.ideal_points(model, directions_camera)
    return _pixels(parameters[:5], lens.LENSES[model].distort(ideal, parameters[5:]))


def project(camera: CameraModel, directions_camera: Floats) -> Floats:
    """
    Pixels (..., 2) of directions (..., 3) in the camera frame; NaN where there is none.

    The field is a function of the resulting pixel, so the projection is iterated.

    >>> import starcal_ros
    >>> camera = starcal_ros.CameraModel(1024, 768, [2000, 0, 2000, 511.5, 383.5, 0, 0, 0, 0, 0])
    >>> starcal_ros.project(camera, [[0, 0, 1], [0.1, 0, 1], [0, 0, -1]]).tolist()
    [[511.5, 383.5], [711.5, 383.5], [nan, nan]]
    """
    directions = np.asarray(directions_camera, np.float64)
    ideal = project_parameters(camera.model, camera.parameters, directions)
    field = camera.moving_field
    if field is None:
        return ideal
    pixels = ideal
    for _ in range(_FIELD_STEPS):
        before, pixels = pixels, ideal + field.displacement_px(pixels)
        if not (np.abs(pixels - before) > _FIELD_TOLERANCE_PX).any():  # nor where there is none
            break
    return pixels


def project_jacobians(
    camera: CameraModel, directions_camera: Floats
) -> tuple[Floats, Floats, Floats]:
    """
    Pixels of the lens model and their derivatives by its parameters and by a small rotation.

    The field is left out: it changes a derivative by less than a tenth.

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
    xy = lens.ideal_points(camera.model, np.asarray(directions_camera, np.float64))
    fx, skew, fy, _, _ = camera.intrinsics
    distorted = camera.lens.distort(xy, camera.distortion)
    xd, yd = distorted[..., 0], distorted[..., 1]

    J_parameters = np.zeros((*xd.shape, 2, len(camera.parameters)))
    J_parameters[..., 0, 0] = xd
    J_parameters[..., 0, 1] = yd
    J_parameters[..., 0, 3] = 1.0
    J_parameters[..., 1, 2] = yd
    J_parameters[..., 1, 4] = 1.0
    columns = camera.lens.by_coefficients(xy, camera.distortion)
    for k, (column_x, column_y) in enumerate(zip(*columns, strict=True), start=5):
        J_parameters[..., 0, k] = fx * column_x + skew * column_y
        J_parameters[..., 1, k] = fy * column_y

    pixels = _pixels(camera.intrinsics, distorted)
    return pixels, J_parameters, rotation_jacobian(camera, directions_camera)


def rotation_jacobian(camera: CameraModel, directions_camera: Floats) -> Floats:
    """
    Derivatives (..., 2, 3) of pixels by a small rotation, as of `project_jacobians`.

    Directions (..., 3) in the camera frame; Z > 0 for a perspective model.
    """
    xy = lens.ideal_points(camera.model, np.asarray(directions_camera, np.float64))
    fx, skew, fy, _, _ = camera.intrinsics
    J_xy = camera.lens.by_ideal(xy, camera.distortion)
    J_u = fx * J_xy[..., 0, :] + skew * J_xy[..., 1, :]
    J_v = fy * J_xy[..., 1, :]
    x_theta, y_theta = lens.ideal_by_rotation(camera.model, xy)
    J = np.empty((*xy.shape[:-1], 2, 3))
    J[..., 0, :] = J_u[..., 0, None] * x_theta + J_u[..., 1, None] * y_theta
    J[..., 1, :] = J_v[..., 0, None] * x_theta + J_v[..., 1, None] * y_theta
    return J


def line_of_sight(camera: CameraModel, pixels: Floats) -> Floats:
    """
    Unit directions (..., 3) in the camera frame of pixels (..., 2): the inverse of `project`.

    Newton iteration on the distortion with its analytic Jacobian.  NaN beyond the fold of the
    model, where it has no inverse on the branch of the optical axis.
    """
    distortion = camera.distortion
    fold2 = lens.fold_radius2(camera.model, distortion)
    pixels = np.asarray(pixels, np.float64)
    if (field := camera.moving_field) is not None:
        pixels = pixels - field.displacement_px(pixels)
    target = _plane_points(camera, pixels)
    # Newton's method does not return from beyond a fold or a pole: start and steps stay inside.
    xy = _inside(0.0 * target, target, fold2)
    error = np.full(target.shape, np.inf)
    for _ in range(_INVERSE_STEPS):
        error = camera.lens.distort(xy, distortion) - target
        if np.abs(error).max(initial=0.0) < _INVERSE_TOLERANCE:
            break
        J = camera.lens.by_ideal(xy, distortion)
        with np.errstate(all='ignore'):
            by_y, by_x = error[..., 1], error[..., 0]
            step = lens.points_of(
                J[..., 1, 1] * by_x - J[..., 0, 1] * by_y,
                J[..., 0, 0] * by_y - J[..., 1, 0] * by_x,
            )
            step /= _determinant(J)[..., None]
            if not np.abs(step).max(initial=0.0) < _SHORT:
                # A step much longer than the radius has left the branch of the axis.
                reach = 0.5 + np.hypot(xy[..., 0], xy[..., 1])
                length = np.hypot(step[..., 0], step[..., 1])
                step *= np.minimum(1.0, reach / np.maximum(length, 1e-300))[..., None]
                step[np.isnan(step)] = 0.0
        xy = _inside(xy, xy - step, fold2)
    converged = np.abs(error).max(axis=-1) <= 1e-12 * (1 + np.abs(target).max(axis=-1))
    xy[~(converged & _before_fold(camera, xy))] = np.nan
    return lens.directions_of(camera.model, xy)


def before_fold(camera: CameraModel, directions_camera: Floats) -> Mask:
    """Mask (...) of directions (..., 3) in the camera frame that `line_of_sight` has."""
    return _before_fold(camera, lens.ideal_points(camera.model, directions_camera))


def _before_fold(camera: CameraModel, xy: Floats) -> Mask:
    """
    Mask (...) of ideal points (..., 2) on the branch of the optical axis.

    Beyond the fold the distorted radius decreases: points there belong to another branch.
    """
    fold2 = lens.fold_radius2(camera.model, camera.distortion)
    determinant = _determinant(camera.lens.by_ideal(xy, camera.distortion))
    return np.asarray((determinant > 0.0) & (xy[..., 0] ** 2 + xy[..., 1] ** 2 <= fold2))


def _determinant(J: Floats) -> Floats:
    """Determinants (...) of matrices (..., 2, 2)."""
    return np.asarray(J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0])


def _inside(before: Floats, after: Floats, fold2: float) -> Floats:
    """Points (..., 2) after a step; a step beyond the fold stops halfway to it in radius."""
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
    Largest angle between the optical axis and the edge of the detector plus a margin, rad.

    It is the larger of the angles with and without distortion: a prior distortion may have no line
    of sight at the edge, and the estimated one may lie between the two.
    """
    if margin_px in camera._field_radii_rad:
        return camera._field_radii_rad[margin_px]
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
    radius_rad = float(np.arccos(np.nanmin(z)))
    return camera._field_radii_rad.setdefault(margin_px, radius_rad)


def convert(
    camera: CameraModel, model: str, zero: tuple[str, ...] = ()
) -> tuple[CameraModel, float]:
    """
    Best camera of a lens model for the lines of sight of another camera, and its worst error.

    It has no field, and the parameters of the names ``zero`` are zero, for formats without them.
    Least squares over a 25 x 25 grid of the detector, starting with the coefficients that both
    models have.  Raises ValueError for an unknown model.

    Returns
    -------
    camera : CameraModel
    worst_px : float
        Largest pixel error over the grid; infinite where the model cannot see all of it, or no
        camera of the model is found.
    """
    is_angular = lens.lens_named(model).is_angular
    names = parameter_names(model)
    same_plane = camera.has_lens(model) or not (is_angular or camera.lens.is_angular)
    shared = camera.parameter_names if same_plane else INTRINSIC_NAMES
    known = dict(zip(shared, camera.parameters, strict=False))
    values = [0.0 if name in zero else known.get(name, 0.0) for name in names]
    started = CameraModel(camera.width, camera.height, np.array(values), model)
    return _fit(started, [k for k, name in enumerate(names) if name not in zero], camera)


def _fit(start: CameraModel, free: list[int], camera: CameraModel) -> tuple[CameraModel, float]:
    """Camera fitted to the pixels of the lines of sight of another, and its worst error, px."""
    target = pixel_grid(camera, 25, 25)
    directions = line_of_sight(camera, target)
    exists = np.isfinite(directions[:, 0])
    target, directions = target[exists], directions[exists]

    def error_px(fitted: CameraModel) -> Floats:
        error = np.linalg.norm(project(fitted, directions) - target, axis=-1)
        return np.where(np.isnan(error), np.inf, error)

    start_error_px = error_px(start)
    # The same lens, or a special case of a larger model.
    if (start_error_px < _EXACT_PX).all():
        return start, 0.0
    visible = np.isfinite(start_error_px)

    def moved(x: Floats) -> CameraModel:
        parameters = start.parameters.copy()
        parameters[free] = x
        return dataclasses.replace(start, parameters=parameters)

    # Numerator and denominator of a rational polynomial can grow together: without a penalty
    # the coefficients reach 10^4 for a gain of 1e-3 px.
    held_px = np.diag(np.where(np.arange(len(start.parameters)) < 5, 0.0, _HELD_PX))[free][:, free]
    if not start.lens.is_redundant:
        held_px = held_px[:0]

    def residual(x: Floats) -> Floats:
        off = project(moved(x), directions[visible]) - target[visible]
        return np.concatenate([off.ravel(), held_px @ (x - start.parameters[free])])

    def jacobian(x: Floats) -> Floats:
        J = project_jacobians(moved(x), directions[visible])[1]
        return np.concatenate([J[..., free].reshape(-1, len(free)), held_px])

    # MINPACK scales the parameters by their columns and bounds the step.
    from scipy.optimize import least_squares  # a third of the start of a short command

    try:
        solution = least_squares(
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
        fitted = moved(solution.x)
    except ValueError:  # a step to a camera that cannot be, or to no number
        return start, math.inf
    return fitted, float(error_px(fitted).max(initial=0.0))
