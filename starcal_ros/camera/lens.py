# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Lens models: from the ideal image plane to the distorted one, and the derivatives.

A direction (X, Y, Z) in the camera frame meets the ideal plane of its model at

- perspective models: ``(x, y) = (X/Z, Y/Z)``, Z > 0;
- ``equidistant``: ``(x, y) = theta (cos phi, sin phi)``, theta the angle from the optical axis,
  phi the azimuth; 0 <= theta < 180 degrees.

With r2 = x^2 + y^2 the distorted point of the OpenCV models is::

    g  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)
    xd = g x + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r2^2
    yd = g y + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r2^2

``plumb_bob`` has k1 k2 k3 p1 p2; ``rational_polynomial`` adds k4 k5 k6, ``thin_prism`` s1 to s4,
``tilted`` the angles tau_x, tau_y (rad) of the detector, with c and s their cosine and sine::

    w  = s_y xd - c_y s_x yd + c_y c_x
    x' = c_x xd / w          y' = (c_y yd - s_x s_y xd) / w

``equidistant`` (Kannala and Brandt 2006; OpenCV ``cv::fisheye``)::

    (x', y') = (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) (x, y)

Sources: OpenCV 4 documentation, "Camera Calibration and 3D Reconstruction" and its ``fisheye``;
ROS ``sensor_msgs/distortion_models.hpp``.  Coefficients are (c,) in the order of their names,
or (c, n) for n points.  Complex numbers pass through, for complex-step derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import functools

import numpy as np

from starcal_ros.arrays import Floats


@dataclass(frozen=True)
class LensModel:
    """
    A row of `LENSES`: what the rest of the package asks a lens model.

    Attributes
    ----------
    coefficients : tuple of str
        Names, in order; the functions take the numbers as (c,), or (c, n) for n points.
    distort : callable
        Distorted points (..., 2) of ideal points (..., 2) and coefficients (Eq. 6 for
        ``plumb_bob``); NaN where ``tilted`` would look at the detector from behind.
    by_ideal, by_coefficients : callable
        Derivatives (..., 2, 2) of `distort` by the ideal points (Eqs. 36, 37), and (2, c, ...) by
        the c coefficients, of the same arguments.
    fold_radius2 : callable
        As the function of this module, of each coefficient as a number.
    is_angular : bool
        The ideal plane has the angle from the optical axis in place of its tangent.
    is_redundant : bool
        Coefficients of the numerator and the denominator can grow together without an effect.
    ros, ros_order : str, tuple of int
        ``distortion_model`` of a ``CameraInfo``, and the place of each number of its D.
    ros_aliases : tuple of str
        Other names of it in camera files.
    fewest : int
        Least number of coefficients in a camera file, without the last ones, which are zero.
    opencv : str
        Its namespace in OpenCV: ``pinhole`` (none) or ``fisheye``; empty: no such model.
    mrcal, giant : str
        Name of the model in mrcal, and class in GIANT; empty: it has none.
    equations : tuple of str
        From x, y and r2 to x', y', for the comments of files.
    """

    name: str
    coefficients: tuple[str, ...]
    distort: Callable[[Floats, Floats], Floats]
    by_ideal: Callable[[Floats, Floats], Floats]
    by_coefficients: Callable[[Floats, Floats], Floats]
    fold_radius2: Callable[..., float]
    ros: str
    ros_order: tuple[int, ...]
    equations: tuple[str, ...]
    is_angular: bool = False
    is_redundant: bool = False
    opencv: str = ''
    mrcal: str = ''
    giant: str = ''
    ros_aliases: tuple[str, ...] = ()
    fewest: int | None = None


def lens_named(name: str) -> LensModel:
    """Row of `LENSES`; raises ValueError for a name that it does not have."""
    try:
        return LENSES[name]
    except KeyError:
        known = ', '.join(LENSES)
        raise ValueError(f'lens model: {name!r} is not one of {known}') from None


# Below this angle 1 - t / tan(t) loses digits; the terms left out of the series are under 1e-14.
_SERIES_RAD = 0.2
_NO_ROOT = 1e-100  # reciprocal of a squared radius beyond any detector


def ideal_points(model: str, directions_camera: Floats) -> Floats:
    """
    Points (..., 2) where camera-frame directions (..., 3) of any length meet the ideal plane.

    NaN where the model has none: Z <= 0 of a perspective model, the backward axis of an angular
    one.
    """
    z = directions_camera[..., 2]
    if not LENSES[model].is_angular:
        z = np.where(z.real > 0, z, np.nan)
        return np.asarray(directions_camera[..., :2] / z[..., None])
    x, y = directions_camera[..., 0], directions_camera[..., 1]
    rho = np.sqrt(x * x + y * y)
    length = np.sqrt(x * x + y * y + z * z)
    forward = z.real > 0
    on_axis = rho == 0
    with np.errstate(all='ignore'):
        # Tangent of half the angle, in the form without cancellation.
        half = np.where(forward, rho / (length + z), (length - z) / rho)
        scale = np.where(on_axis, 1.0 / z, 2.0 * np.arctan(half) / rho)
    scale = np.where(on_axis & ~forward, np.nan, scale)
    return np.asarray(directions_camera[..., :2] * scale[..., None])


def directions_of(model: str, ideal: Floats) -> Floats:
    """Unit directions (..., 3) in the camera frame of ideal points (..., 2)."""
    if not LENSES[model].is_angular:
        directions = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)
        return np.asarray(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
    theta = np.hypot(ideal[..., 0], ideal[..., 1])
    sine = np.sinc(theta / np.pi)
    return np.concatenate([ideal * sine[..., None], np.cos(theta)[..., None]], axis=-1)


def ideal_by_rotation(model: str, ideal: Floats) -> Floats:
    """
    Derivatives (2, ..., 3) of ideal points (..., 2) by a passive small rotation, rad.

    The first axis is x, then y; the last the three angles (Eqs. 34, 35 if perspective).
    """
    x, y = ideal[..., 0], ideal[..., 1]
    theta = np.empty((2, 3, *x.shape)).transpose(0, *range(2, x.ndim + 2), 1)
    if LENSES[model].is_angular:
        m = _bend(x * x + y * y)
        theta[0, ..., 0] = m * x * y
        theta[0, ..., 1] = m * y * y - 1.0
        theta[1, ..., 0] = 1.0 - m * x * x
    else:
        theta[0, ..., 0] = x * y
        theta[0, ..., 1] = -1.0 - x * x
        theta[1, ..., 0] = 1.0 + y * y
    theta[0, ..., 2] = y
    theta[1, ..., 1] = -theta[0, ..., 0]
    theta[1, ..., 2] = -x
    return theta


def _bend(r2: Floats) -> Floats:
    """``(1 - theta / tan(theta)) / theta^2`` of squared angles: 1/3 on the axis."""
    near = r2 < _SERIES_RAD**2
    far2 = np.where(near, 1.0, r2)
    far = np.sqrt(far2)
    # Bernoulli numbers: B_2n 2^2n / (2n)! with alternating sign.
    series = 1 / 3 + r2 * (
        1 / 45 + r2 * (2 / 945 + r2 * (1 / 4725 + r2 * (2 / 93555 + r2 * 1382 / 638512875)))
    )
    return np.where(near, series, (1.0 - far / np.tan(far)) / far2)


def fold_radius2(model: str, coefficients: Floats) -> float:
    """
    Squared radius of the ideal plane from which the radial distortion has no inverse.

    There the distorted radius stops growing, or a rational polynomial has its pole; infinite
    where it grows without end.  180 degrees at most for an angular model.
    """
    return LENSES[model].fold_radius2(*coefficients.tolist())


def points_of(x: Floats, y: Floats) -> Floats:
    """Points (..., 2) stored as all x, then all y: arithmetic on them takes half the time."""
    both = np.stack([x, y])
    return both.transpose(*range(1, both.ndim), 0)


@dataclass(frozen=True)
class _OpenCv:
    """A perspective model of OpenCV: radial and decentring terms, and the parts that it adds."""

    count: int  # coefficients
    has_denominator: bool
    has_prism: bool
    has_tilt: bool

    def distort(self, ideal: Floats, coefficients: Floats) -> Floats:
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        g, _, _ = self._radial(r2, coefficients)
        p1, p2 = coefficients[3:5]
        g = g + 2 * (p1 * y + p2 * x)  # the terms of p1 and p2 share this factor of x and y
        xd, yd = g * x + p2 * r2, g * y + p1 * r2
        if self.has_prism:
            s1, s2, s3, s4 = coefficients[8:12]
            xd, yd = xd + r2 * (s1 + r2 * s2), yd + r2 * (s3 + r2 * s4)
        if self.has_tilt:
            xd, yd, _ = _tilt(xd, yd, *coefficients[12:])
        return points_of(xd, yd)

    def _radial(self, r2: Floats, coefficients: Floats) -> tuple[Floats, Floats, Floats | float]:
        """Factor g of the radial distortion, its derivative by r2, and the denominator of g."""
        k1, k2, k3 = coefficients[:3]
        g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        g_r2 = k1 + r2 * (2 * k2 + r2 * 3 * k3)
        if not self.has_denominator:
            return g, g_r2, 1.0
        k4, k5, k6 = coefficients[5:8]
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        g = g / denominator
        return g, (g_r2 - g * (k4 + r2 * (2 * k5 + r2 * 3 * k6))) / denominator, denominator

    def by_ideal(self, ideal: Floats, coefficients: Floats) -> Floats:
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        g, g_r2, _ = self._radial(r2, coefficients)
        p1, p2 = coefficients[3:5]
        J = _radial_jacobian(x, y, g + 2 * (p1 * y + p2 * x), g_r2, p1, p2)
        if self.has_prism:
            s1, s2, s3, s4 = coefficients[8:12]
            J[..., 0, :] += 2 * (s1 + 2 * s2 * r2)[..., None] * ideal
            J[..., 1, :] += 2 * (s3 + 2 * s4 * r2)[..., None] * ideal
        if self.has_tilt:
            xd, yd = np.moveaxis(LENSES['thin_prism'].distort(ideal, coefficients[:12]), -1, 0)
            J = _tilt_jacobian(xd, yd, *coefficients[12:]) @ J
        return J

    def by_coefficients(self, ideal: Floats, coefficients: Floats) -> Floats:
        x, y = ideal[..., 0], ideal[..., 1]
        r2 = x * x + y * y
        J = np.zeros((2, self.count, *x.shape))
        _by_powers(J[:, :3], x, y, r2)
        J[0, 3] = J[1, 4] = 2 * x * y
        J[0, 4], J[1, 3] = r2 + 2 * x * x, r2 + 2 * y * y
        if self.has_denominator:
            g, _, denominator = self._radial(r2, coefficients)
            J[:, :3] /= denominator
            J[:, 5:8] = -g * J[:, :3]
        if self.has_prism:
            J[0, 8] = J[1, 10] = r2
            J[0, 9] = J[1, 11] = r2 * r2
        if self.has_tilt:
            _by_tilt(J, ideal, coefficients)
        return J

    @functools.lru_cache(maxsize=64)  # noqa: B019  a few records, which live as long as the module
    def fold_radius2(self, *coefficients: float) -> float:
        k1, k2, k3 = coefficients[:3]
        if not self.has_denominator:
            return _least_positive_root([7 * k3, 5 * k2, 3 * k1, 1.0])
        numerator = np.poly1d([k3, k2, k1, 1.0])
        denominator = np.poly1d([*coefficients[7:4:-1], 1.0])
        growth = numerator * denominator + np.poly1d([2.0, 0.0]) * (
            numerator.deriv() * denominator - numerator * denominator.deriv()
        )
        return min(_least_positive_root(growth.coeffs), _least_positive_root(denominator.coeffs))


class _Equidistant:
    """The polynomial of the angle of Kannala and Brandt."""

    @staticmethod
    def distort(ideal: Floats, coefficients: Floats) -> Floats:
        x, y = ideal[..., 0], ideal[..., 1]
        k1, k2, k3, k4 = coefficients
        r2 = x * x + y * y
        g = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        return points_of(g * x, g * y)

    @staticmethod
    def by_ideal(ideal: Floats, coefficients: Floats) -> Floats:
        x, y = ideal[..., 0], ideal[..., 1]
        k1, k2, k3, k4 = coefficients
        r2 = x * x + y * y
        g = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        return _radial_jacobian(x, y, g, k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)))

    @staticmethod
    def by_coefficients(ideal: Floats, coefficients: Floats) -> Floats:
        del coefficients
        x, y = ideal[..., 0], ideal[..., 1]
        J = np.zeros((2, 4, *x.shape))
        _by_powers(J, x, y, x * x + y * y)
        return J

    @staticmethod
    @functools.lru_cache(maxsize=64)
    def fold_radius2(k1: float, k2: float, k3: float, k4: float) -> float:
        # The odd polynomial's derivative by the radius.
        return min(_least_positive_root([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0]), np.pi**2)


def _radial_jacobian(
    x: Floats, y: Floats, g: Floats, g_r2: Floats, p1: float = 0.0, p2: float = 0.0
) -> Floats:
    """Derivatives (..., 2, 2) of radial and decentring terms by x and y, g with the latter."""
    by_x, by_y = 2 * g_r2 * x, 2 * g_r2 * y
    J = np.empty((2, 2, *x.shape), g.dtype).transpose(*range(2, x.ndim + 2), 0, 1)
    J[..., 0, 0], J[..., 1, 1] = g + x * (by_x + 4 * p2), g + y * (by_y + 4 * p1)
    J[..., 0, 1] = J[..., 1, 0] = x * (by_y + 2 * p1) + 2 * p2 * y
    return J


def _by_powers(J: Floats, x: Floats, y: Floats, r2: Floats) -> None:
    """Derivatives (2, k, ...) by the coefficients of r2, r2^2 and so on, into J."""
    J[0, 0], J[1, 0] = x * r2, y * r2
    for k in range(1, J.shape[1]):
        np.multiply(J[:, k - 1], r2, out=J[:, k])


def _by_tilt(J: Floats, ideal: Floats, coefficients: Floats) -> None:
    """Derivatives (2, 14, ...) by the angles of the detector into J, the others through them."""
    tau_x, tau_y = coefficients[12:]
    xd, yd = np.moveaxis(LENSES['thin_prism'].distort(ideal, coefficients[:12]), -1, 0)
    J[:, :12] = np.einsum('...ij,jk...->ik...', _tilt_jacobian(xd, yd, tau_x, tau_y), J[:, :12])
    sx, cx, sy, cy = np.sin(tau_x), np.cos(tau_x), np.sin(tau_y), np.cos(tau_y)
    xt, yt, w = _tilt(xd, yd, tau_x, tau_y)
    w_by_x = -cy * (cx * yd + sx)
    w_by_y = cy * xd + sy * (sx * yd - cx)
    J[0, 12] = (-sx * xd - xt * w_by_x) / w
    J[1, 12] = (-cx * sy * xd - yt * w_by_x) / w
    J[0, 13] = -xt * w_by_y / w
    J[1, 13] = (-sy * yd - sx * cy * xd - yt * w_by_y) / w


def _tilt(x: Floats, y: Floats, tau_x: Floats, tau_y: Floats) -> tuple[Floats, Floats, Floats]:
    """Points on the tilted detector, and the divisor w; NaN where w <= 0."""
    sx, cx, sy, cy = np.sin(tau_x), np.cos(tau_x), np.sin(tau_y), np.cos(tau_y)
    w = sy * x - cy * sx * y + cy * cx
    w = np.where(w.real > 0, w, np.nan)
    return cx * x / w, (cy * y - sx * sy * x) / w, w


def _tilt_jacobian(x: Floats, y: Floats, tau_x: Floats, tau_y: Floats) -> Floats:
    """Derivatives (..., 2, 2) of the points of `_tilt` by x and y."""
    sx, cx, sy, cy = np.sin(tau_x), np.cos(tau_x), np.sin(tau_y), np.cos(tau_y)
    xt, yt, w = _tilt(x, y, tau_x, tau_y)
    rows = [
        [cx - xt * sy, xt * cy * sx],
        [-sx * sy - yt * sy, cy + yt * cy * sx],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2) / w[..., None, None]


def _least_positive_root(polynomial: object) -> float:
    """Least positive root of a polynomial with the constant 1, highest power first."""
    # The reciprocals of the roots are sought: a first coefficient of 1e-313 overflows as divisor.
    reciprocals = np.roots(np.asarray(polynomial, np.float64)[::-1])
    roots = 1.0 / reciprocals[np.abs(reciprocals) > _NO_ROOT]
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


_BROWN = ('k1', 'k2', 'k3', 'p1', 'p2')
_OPENCV_COEFFICIENTS = (*_BROWN, 'k4', 'k5', 'k6', 's1', 's2', 's3', 's4', 'tau_x', 'tau_y')


def _of_opencv(name: str, count: int) -> LensModel:
    """Row of the perspective model of OpenCV with the first coefficients of its list."""
    is_rational, has_tilt = count >= 8, count >= 14
    parts = _OpenCv(count, is_rational, has_prism=count >= 12, has_tilt=has_tilt)
    return LensModel(
        name,
        _OPENCV_COEFFICIENTS[:count],
        parts.distort,
        parts.by_ideal,
        parts.by_coefficients,
        parts.fold_radius2,
        'rational_polynomial' if is_rational else 'plumb_bob',
        (0, 1, 3, 4, 2, *range(5, count)),  # ROS has k3 after p1 and p2
        _RATIONAL_EQUATIONS if is_rational else _BROWN_EQUATIONS,
        is_redundant=is_rational,
        opencv='pinhole',
        mrcal='' if has_tilt else f'LENSMODEL_OPENCV{count}',
        giant='' if has_tilt else 'OpenCVModel',
        ros_aliases=('thin_prism', 'thin_prism_fraunhofer') if is_rational else (),
        fewest=None if is_rational else 4,  # ROS 1 wrote no k3
    )


_BROWN_EQUATIONS = (
    'g  = 1 + k1 r2 + k2 r2^2 + k3 r2^3',
    "x' = g x + 2 p1 x y + p2 (r2 + 2 x^2)",
    "y' = g y + p1 (r2 + 2 y^2) + 2 p2 x y",
)
_RATIONAL_EQUATIONS = (
    'g  = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)',
    "x' = g x + 2 p1 x y + p2 (r2 + 2 x^2) + s1 r2 + s2 r2^2",
    "y' = g y + p1 (r2 + 2 y^2) + 2 p2 x y + s3 r2 + s4 r2^2",
    'then, with tau_x and tau_y, the tilted detector of OpenCV; absent coefficients are 0',
)
_EQUIDISTANT = LensModel(
    'equidistant',
    ('k1', 'k2', 'k3', 'k4'),
    _Equidistant.distort,
    _Equidistant.by_ideal,
    _Equidistant.by_coefficients,
    _Equidistant.fold_radius2,
    'equidistant',
    (0, 1, 2, 3),
    (
        'x = theta cos(phi), y = theta sin(phi) in place of X/Z, Y/Z, with theta the',
        'angle from +Z in radians and phi the azimuth from +X;',
        "(x', y') = (1 + k1 r2 + k2 r2^2 + k3 r2^3 + k4 r2^4) (x, y)",
    ),
    is_angular=True,
    opencv='fisheye',
    ros_aliases=('fisheye',),
)

LENSES: dict[str, LensModel] = {
    lens.name: lens
    for lens in (
        _of_opencv('plumb_bob', 5),
        _of_opencv('rational_polynomial', 8),
        _of_opencv('thin_prism', 12),
        _of_opencv('tilted', 14),
        _EQUIDISTANT,
    )
}
"""Name -> lens model."""


def ros_distortion(model: str, coefficients: Floats) -> tuple[str, Floats]:
    """
    ``distortion_model`` and ``D`` (c,) of a ``CameraInfo``.

    ROS has the name ``rational_polynomial`` for OpenCV's models of 8, 12 and 14 coefficients,
    which its readers pass to OpenCV.
    """
    lens = LENSES[model]
    return lens.ros, np.asarray(coefficients)[list(lens.ros_order)]


def from_ros_distortion(distortion_model: str, D: Sequence[float]) -> tuple[str, Floats]:
    """
    Lens model and coefficients (c,) of a ``CameraInfo``.

    No coefficients at all are zeros.  Raises ValueError for an unknown model or a wrong number of
    coefficients.
    """
    named = [lens for lens in LENSES.values() if distortion_model in (lens.ros, *lens.ros_aliases)]
    if not named:
        known = ', '.join(dict.fromkeys(lens.ros for lens in LENSES.values()))
        raise ValueError(f'{distortion_model!r} is not {known}, thin_prism or fisheye')
    if not len(D):
        return named[0].name, np.zeros(len(named[0].coefficients))
    for lens in named:
        count = len(lens.coefficients)
        if len(D) in (count, lens.fewest):
            values = np.zeros(count)
            values[list(lens.ros_order[: len(D)])] = D
            return lens.name, values
    counts = ' or '.join(str(len(lens.coefficients)) for lens in named)
    raise ValueError(f'{len(D)} coefficients of {distortion_model}, which has {counts}')
