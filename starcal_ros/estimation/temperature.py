# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Temperature dependence of focal length and alignment (beyond the paper; as in NASA's GIANT).

With ``dT`` the temperature of an image less the reference::

    fx, skew, fy              times g = 1 + a1 dT + a2 dT^2
    camera_from_star_tracker  exp(-[b dT x]) times that at the reference

``a`` are the focal terms, ``b`` the alignment rate: a small passive rotation of the camera frame
per degree.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.records import Calibration, CameraGeometry, Ensemble, TemperatureTerms

FEWEST_SPREAD_K = 1.0  # of the temperatures; sensor errors and lag hide a smaller one
_SCALED = slice(0, 3)  # fx, skew, fy


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
