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
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import stdtr

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import parameter_names
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.estimation.star_equations import Measurements, normal_blocks
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    Ensemble,
    StarTrackerAlignment,
    TemperatureTerms,
)

METHODS = ('hierarchical', 'per_image', 'single')
FEWEST_SPREAD_K = 1.0  # of the temperatures; sensor errors and lag hide a smaller one
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
        Lens model, of `lens.COEFFICIENTS`; it has p camera parameters.
    free : (f,) int
        Camera parameters that are estimated, ascending.
    prior_parameters, prior_sigma : (p,)
        Gaussian prior of the camera parameters; infinite sigma: none.
    is_weak : (p,) bool, or False
        True where the prior is that of any lens: no data sheet states it.
    time_s : (m,)
        Times of the images; (0,): not known.
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


def image_blocks(
    problem: Problem, state: State, measurements: Measurements, loss_scale: float = np.inf
) -> tuple[float, Floats]:
    """Cost and the matrices of `star_equations.normal_blocks` at a state."""
    return normal_blocks(
        measurements,
        problem.model,
        image_parameters(problem, state),
        state.camera_from_icrf.as_matrix(),
        loss_scale,
    )


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


_FEWEST_IMAGES = 4  # for a mean, a slope and a scatter about them
_HOUR_S = 3600.0


@dataclass(frozen=True)
class AttitudeErrors:
    """
    Star-tracker errors of m images as their stars show them.

    Attributes
    ----------
    time_ns : (m,)
    error_rad : (m, 3)
        About the axes of the star tracker of the image.
    variance_rad2 : (m, 3)
        Its variance from the centroids.
    tracker_sigma_rad : (3,)
        1-sigma of a star tracker.
    seen : (m,) bool
        True if the stars of the image show an attitude that fits.
    """

    time_ns: NDArray[np.int64]
    error_rad: Floats
    variance_rad2: Floats
    tracker_sigma_rad: Floats
    seen: Mask


def star_tracker_names(ensemble: Ensemble) -> tuple[str, ...]:
    """Names of the star trackers of an ensemble; the first, whose name is empty, is always one."""
    return ('', *sorted({image.star_tracker for image in ensemble.images} - {''}))


def star_tracker_alignments(
    names: tuple[str, ...],
    problem: Problem,
    state: State,
    covariance: Floats,
    errors: AttitudeErrors,
) -> tuple[StarTrackerAlignment, ...]:
    """
    Return the alignments to the star trackers of an ensemble; none where there is one only.

    Parameters
    ----------
    names : tuple of str
        From `star_tracker_names`.
    covariance : (3 + 3 s, 3 + 3 s)
        Covariance of the alignment and of the mountings of the s further star trackers.
    errors : AttitudeErrors
        Each about the axes of its own star tracker.
    """
    if problem.first_from_star_tracker is None:
        return ()
    mountings = np.concatenate([np.zeros(3), state.mountings]).reshape(-1, 3)
    A = state.camera_from_star_tracker
    found = []
    for k, name in enumerate(names):
        here = problem.star_tracker == k
        assumed = problem.first_from_star_tracker[here][0] if k else Rotation.identity()
        alignment = Rotation.from_rotvec(-mountings[k]) * A * assumed
        to_angles = np.zeros((3, len(covariance)))
        to_mounting = np.zeros_like(to_angles)
        if k:
            to_mounting[:, 3 * k : 3 * k + 3] = np.eye(3)
        to_angles[:, :3] = np.eye(3)
        to_angles += to_mounting
        of_mounting = to_mounting @ covariance @ to_mounting.T
        rate, total, p_value = _drift(errors, here)
        found.append(
            StarTrackerAlignment(
                frame=name,
                images=int(here.sum()),
                star_tracker_from_camera_xyzw=canonical_xyzw(alignment.inv()),
                alignment_covariance_rad2=to_angles @ covariance @ to_angles.T,
                first_from_star_tracker_xyzw=canonical_xyzw(A.inv() * alignment),
                mounting_covariance_rad2=of_mounting,
                drift_arcsec_per_hour=tuple(float(one) for one in rate),
                drift_arcsec=total,
                drift_p_value=p_value,
            )
        )
    return tuple(found)


def canonical_xyzw(rotation: Rotation) -> Floats:
    """Return one of the two quaternions (4,), so that equal rotations are equal numbers."""
    quaternion = rotation.as_quat()
    return np.asarray(quaternion * np.copysign(1.0, quaternion[3]))


def _drift(errors: AttitudeErrors, here: Mask) -> tuple[Floats, float, float]:
    """
    Slope (3,) of the errors in time, arcsec/h; its length over the span; p-value of none.

    By the scatter about the slope: a drift raises the sigma of the star tracker that is estimated.
    """
    unknown = np.full(3, np.nan), math.nan, math.nan
    used = here & errors.seen
    if np.count_nonzero(used) < _FEWEST_IMAGES:
        return unknown
    time_ns = errors.time_ns[used]
    hours = (time_ns - time_ns[0]) / (NANOSECONDS_PER_SECOND * _HOUR_S)
    weight = 1.0 / (errors.variance_rad2[used] + errors.tracker_sigma_rad**2)
    middle = (weight * hours[:, None]).sum(axis=0) / weight.sum(axis=0)
    from_middle = hours[:, None] - middle
    information = (weight * from_middle**2).sum(axis=0)
    if not (information > 0).all():
        return unknown
    slope = (weight * from_middle * errors.error_rad[used]).sum(axis=0) / information
    error_rad = errors.error_rad[used]
    mean_rad = (weight * error_rad).sum(axis=0) / weight.sum(axis=0)
    freedom = len(hours) - 2
    scatter = (weight * (error_rad - mean_rad - from_middle * slope) ** 2).sum(axis=0) / freedom
    t = slope * np.sqrt(information / np.maximum(scatter, 1e-300))
    p_value = min(1.0, 3.0 * 2.0 * float(stdtr(freedom, -np.abs(t)).min()))  # of three axes
    rate = slope / ARCSECOND_RAD
    return rate, float(np.linalg.norm(rate) * np.ptp(hours)), p_value


def focal_factor(focal: Floats, above_reference_k: Floats) -> Floats:
    """Factors (m,) of the focal length at temperature differences (m,) from the reference."""
    return np.asarray(1.0 + _powers(above_reference_k, len(focal)) @ focal)


def parameters_at(parameters: Floats, focal: Floats, above_reference_k: Floats) -> Floats:
    """Camera parameters (m, p) at temperatures (m,) above the reference."""
    result = np.tile(parameters, (len(above_reference_k), 1))
    result[:, _SCALED] *= focal_factor(focal, above_reference_k)[:, None]
    return result


def parameters_chain(parameters: Floats, focal: Floats, above_reference_k: Floats) -> Floats:
    """Derivatives (m, p, p + q) of `parameters_at` by the parameters, then the q focal terms."""
    p, q = len(parameters), len(focal)
    chain = np.tile(np.eye(p, p + q), (len(above_reference_k), 1, 1))
    chain[:, _SCALED, _SCALED] *= focal_factor(focal, above_reference_k)[:, None, None]
    powers = _powers(above_reference_k, q)
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
    x, y, z = rate
    half = np.eye(3) - 0.5 * dT * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
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


def why_unsupported(temperatures_degc: Floats, order: int) -> str:
    """Reason why temperatures (m,) do not determine thermal terms; '' if they do."""
    unknown = int(np.count_nonzero(~np.isfinite(temperatures_degc)))
    count = len(temperatures_degc)
    if unknown:
        return f'{unknown} of {count} images have no temperature'
    spread = float(temperatures_degc.std())
    if spread < FEWEST_SPREAD_K:
        return f'the temperatures spread by {spread:.2g} degC, less than {FEWEST_SPREAD_K:g}'
    distinct = len(np.unique(temperatures_degc))
    if distinct <= order:
        return f'{distinct} temperatures do not determine a polynomial of degree {order}'
    return ''


def _powers(above_reference_k: Floats, order: int) -> Floats:
    """Powers 1 to ``order`` of the temperature differences, (m, order)."""
    return np.asarray(above_reference_k[:, None] ** np.arange(1, order + 1))
