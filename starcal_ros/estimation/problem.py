# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The three methods of calibration as least-squares problems (Eqs. 10-19, 25).

- ``per_image`` (the paper's Method 1): every image has its own rotation.
- ``single`` (Method 2): one rotation for all images, the star tracker taken as perfect.
- ``hierarchical`` (beyond the paper): one common alignment, and for each image an attitude error
  of the star tracker's covariance.  The other two are its limits.

With R_k = camera_from_icrf of image k, the attitude error of the star tracker in it is
``eta_k = -Log(A' R_k T_k')``, a small rotation in the star tracker frame, where A =
camera_from_star_tracker and T_k = star_tracker_from_icrf as measured.

With terms of temperature (beyond the paper; as in NASA's GIANT), parameters and A are those of the
image, ``dT`` above the reference::

    fx, skew, fy              times g = 1 + a1 dT + a2 dT^2
    camera_from_star_tracker  exp(-[b dT x]) times that at the reference

``a`` are the focal terms, ``b`` the alignment rate: a small passive rotation of the camera frame
per degree.  The derivatives by the shared unknowns follow by the chain rule, with one small matrix
for each image.

Several star trackers have different axes.  T_k is then that of the tracker that gave the attitude.
Its alignment is A of the first tracker, turned by its mounting M (first from this one) and by the
small rotation h of the camera frame by which the mounting is wrong: ``exp(-[h x]) A M``.  A small
rotation a of A turns that alignment by ``a + h``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import parameter_names
from starcal_ros.records import Calibration, CameraGeometry, Ensemble, TemperatureTerms

METHODS = ('hierarchical', 'per_image', 'single')
FEWEST_SPREAD_K = 1.0  # standard deviation; sensor errors and lag hide a smaller one
_SCALED = slice(0, 3)  # fx, skew, fy


@dataclass(frozen=True)
class State:
    """Point of the search: camera parameters, alignment and the rotation of every image."""

    parameters: Floats  # (p,)
    camera_from_star_tracker: Rotation
    camera_from_icrf: Rotation  # (m,)
    focal: Floats = field(default_factory=lambda: np.empty(0))  # (q,) terms of temperature
    rate: Floats = field(default_factory=lambda: np.empty(0))  # (3,) of the alignment, or (0,)
    # (3 s,) h of the further star trackers, rad
    mountings: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class Problem:
    """
    Inputs of one search, for m images.

    Attributes
    ----------
    method : str
    model : str
        Lens model, of `lens.LENSES`; it has p camera parameters.
    free : (f,) int
        Camera parameters that are estimated, ascending.
    prior_parameters, prior_sigma : (p,)
        Gaussian prior of the camera parameters; infinite sigma: none.
    is_weak : (p,) bool, or False
        True where the prior is that of any lens: no data sheet states it.
    time_s : (m,)
        Times of the images, from the mean of all stars; (0,): not known.
    star_tracker_from_icrf : Rotation (m,)
        As measured.
    star_tracker_sigma_rad : (m, 3)
        1-sigma of each attitude about the star tracker's axes; infinite: not to be trusted.
    above_reference_k : (m,)
        Temperature of each image less the reference; (0,) where no term is estimated.
    star_tracker : (m,) int
        Which star tracker gave the attitude of each image: 0 is the first.
    first_from_star_tracker : Rotation (m,) or None
        Its mounting as assumed; None where there is one star tracker only.
    mounting_sigma_rad : float
        1-sigma of each angle of the mountings as assumed.
    """

    method: str
    model: str
    free: NDArray[np.int64]
    prior_parameters: Floats
    prior_sigma: Floats
    star_tracker_from_icrf: Rotation
    star_tracker_sigma_rad: Floats
    above_reference_k: Floats = field(default_factory=lambda: np.empty(0))
    star_tracker: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    first_from_star_tracker: Rotation | None = None
    mounting_sigma_rad: float = np.inf
    is_weak: Mask | bool = False
    time_s: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the p camera parameters."""
        return parameter_names(self.model)

    @property
    def camera_count(self) -> int:
        """Number p of the camera parameters."""
        return len(self.prior_parameters)


def image_parameters(problem: Problem, state: State) -> Floats:
    """Camera parameters: (p,) of all images, or (m, p) where they differ."""
    if len(state.focal) == 0:
        return state.parameters
    return parameters_at(state.parameters, state.focal, problem.above_reference_k)


def image_alignment(problem: Problem, state: State) -> Rotation:
    """camera_from_star_tracker: of all images, or (m,) where they differ."""
    alignment = state.camera_from_star_tracker
    if len(state.rate):
        alignment = turns(state.rate, problem.above_reference_k) * alignment
    if problem.first_from_star_tracker is None:
        return alignment
    mounted: Rotation = mounting_turns(problem, state) * alignment
    return mounted * problem.first_from_star_tracker


def mounting_turns(problem: Problem, state: State) -> Rotation:
    """Rotations (m,) of the camera frame by which the mountings of the images are wrong."""
    return Rotation.from_rotvec(-mounting_errors_rad(problem, state))


def mounting_errors_rad(problem: Problem, state: State) -> Floats:
    """Errors (m, 3) of the mounting of the star tracker of each image, rad; 0 of the first."""
    errors = np.concatenate([np.zeros((1, 3)), state.mountings.reshape(-1, 3)])
    return np.asarray(errors[problem.star_tracker])


def whitened_attitude_errors(problem: Problem, state: State) -> tuple[Floats, Floats]:
    """
    Star tracker errors (m, 3) in sigma, and their derivative (m, 3, 3) by the images' rotations.

    The derivative by the alignment at the temperature of the image is the negative of it.
    """
    eta = attitude_errors(problem, state, state.camera_from_icrf)
    # d Log: the inverse Jacobian of SO(3) to first order, exact to eta^2 / 12 (1e-9 at 20 arcsec).
    half = 0.5 * cross_matrix(eta)
    J = (np.eye(3) + half) @ image_alignment(problem, state).inv().as_matrix()
    sigma = problem.star_tracker_sigma_rad
    return eta / sigma, J / sigma[:, :, None]


def attitude_errors(problem: Problem, state: State, camera_from_icrf: Rotation) -> Floats:
    """Star tracker errors (m, 3), rad in its frame, when these are the rotations of the images."""
    return -np.asarray(
        (
            image_alignment(problem, state).inv()
            * camera_from_icrf
            * problem.star_tracker_from_icrf.inv()
        ).as_rotvec()
    )


def cross_matrix(v: Floats) -> Floats:
    """Matrices (m, 3, 3) with ``cross_matrix(v) @ w = v x w``."""
    x, y, z = v.T
    zero = np.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turn_derivatives(turns: Floats) -> Floats:
    """
    Matrices (m, 3, 3) D with ``exp(-[(h + d) x]) = exp(-[D d x]) exp(-[h x])`` for turns h (m, 3).

    The left Jacobian of SO(3), to first order in d.
    """
    angle = np.linalg.norm(turns, axis=1)[:, None, None]
    H = cross_matrix(turns)
    with np.errstate(divide='ignore', invalid='ignore'):
        second = np.where(angle > 1e-4, (1.0 - np.sinc(angle / np.pi)) / angle**2, 1.0 / 6.0)
    first = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) - first * H + second * (H @ H))


def star_tracker_names(ensemble: Ensemble) -> tuple[str, ...]:
    """Names of the star trackers of an ensemble; the first, whose name is empty, is always one."""
    return ('', *sorted({image.star_tracker for image in ensemble.images} - {''}))


def canonical_xyzw(rotation: Rotation) -> Floats:
    """Return one of the two quaternions (4,), so that equal rotations are equal numbers."""
    quaternion = rotation.as_quat()
    return np.asarray(quaternion * np.copysign(1.0, quaternion[3]))


def parameters_at(parameters: Floats, focal: Floats, above_reference_k: Floats) -> Floats:
    """Camera parameters (m, p) at temperatures (m,) above the reference."""
    result = np.tile(parameters, (len(above_reference_k), 1))
    result[:, _SCALED] *= 1.0 + (_powers(above_reference_k, len(focal)) @ focal)[:, None]
    return result


def parameters_chain(parameters: Floats, focal: Floats, above_reference_k: Floats) -> Floats:
    """Derivatives (m, p, p + q) of `parameters_at` by the parameters, then the q focal terms."""
    p, q = len(parameters), len(focal)
    chain = np.tile(np.eye(p, p + q), (len(above_reference_k), 1, 1))
    powers = _powers(above_reference_k, q)
    chain[:, _SCALED, _SCALED] *= 1.0 + (powers @ focal)[:, None, None]
    chain[:, _SCALED, p:] = parameters[_SCALED][None, :, None] * powers[:, None, :]
    return chain


def turns(rate: Floats, above_reference_k: Floats) -> Rotation:
    """Rotations (m) of the camera frame at temperature differences (m,) from the reference."""
    return Rotation.from_rotvec(-np.outer(above_reference_k, rate))


def turns_chain(rate: Floats, above_reference_k: Floats) -> Floats:
    """
    Derivative (m, 3, 6) of the rotation of each image by alignment angles and rate.

    Relative error: a twelfth of the squared rotation, 1e-7 at 0.06 degrees.
    """
    dT = above_reference_k[:, None, None]
    half = np.eye(3) - 0.5 * dT * cross_matrix(rate[None])
    return np.concatenate([turns(rate, above_reference_k).as_matrix(), dT * half], axis=-1)


def reference_degc(ensemble: Ensemble) -> float:
    """Temperature that terms refer to: the multiple of 10 degC nearest the mean of the images."""
    temperatures_degc = np.array([image.temperature_degc for image in ensemble.images])
    measured_degc = temperatures_degc[np.isfinite(temperatures_degc)]
    return 10.0 * round(float(measured_degc.mean()) / 10.0) if len(measured_degc) else 0.0


def camera_at(calibration: Calibration, temperature_degc: float) -> CameraGeometry:
    """Camera and alignment of a calibration at a temperature; its own where it has no terms."""
    return geometry_at(calibration.geometry, calibration.temperature, temperature_degc)


def geometry_at(
    geometry: CameraGeometry, thermal: TemperatureTerms | None, temperature_degc: float
) -> CameraGeometry:
    """Camera and alignment at a temperature; unchanged without thermal terms."""
    if thermal is None:
        return geometry
    above_k = np.array([temperature_degc - thermal.reference_degc])
    camera, alignment = geometry.camera, geometry.star_tracker_from_camera_xyzw
    if thermal.focal_per_degc:
        focal = np.array(thermal.focal_per_degc)
        fx, skew, fy = parameters_at(camera.parameters, focal, above_k)[0, _SCALED]
        camera = camera.replace(fx=float(fx), skew=float(skew), fy=float(fy))
    if thermal.alignment_rate_rad_per_degc:
        rotation = turns(np.array(thermal.alignment_rate_rad_per_degc), above_k)[0]
        alignment = (Rotation.from_quat(alignment) * rotation.inv()).as_quat()
    return CameraGeometry(camera, alignment)


def supported_terms(ensemble: Ensemble, order: int, with_rate: bool) -> tuple[int, bool, str]:
    """Return order and rate of thermal terms, or none and why temperatures determine none."""
    if not (order or with_rate):
        return 0, False, ''
    temperatures_degc = np.array([image.temperature_degc for image in ensemble.images])
    note = ''
    if unknown := np.count_nonzero(~np.isfinite(temperatures_degc)):
        note = f'{unknown} of {len(temperatures_degc)} images have no temperature'
    elif (spread := float(temperatures_degc.std())) < FEWEST_SPREAD_K:
        note = f'the temperatures spread by {spread:.2g} degC, less than {FEWEST_SPREAD_K:g}'
    elif (distinct := len(np.unique(temperatures_degc))) <= order:
        note = f'{distinct} temperatures do not determine a polynomial of degree {order}'
    return (0, False, note) if note else (order, with_rate, '')


def _powers(above_reference_k: Floats, order: int) -> Floats:
    """Powers 1 to ``order`` of the temperature differences, (m, order)."""
    return np.asarray(above_reference_k[:, None] ** np.arange(1, order + 1))
