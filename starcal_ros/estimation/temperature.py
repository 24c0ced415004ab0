"""
How a camera changes with its temperature (beyond the paper; as NASA's GIANT has it).

With ``dT`` the temperature of an image less the reference::

    fx, skew, fy              times g = 1 + a1 dT + a2 dT^2
    camera_from_star_tracker  exp(-[b dT x]) times that at the reference

``a`` are the focal terms, ``b`` the alignment rate: a passive small rotation in the camera frame
for each degree.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from starcal_ros.arrays import Floats
from starcal_ros.records import Calibration, CameraGeometry, Thermal

FEWEST_SPREAD_K = 1.0  # of the temperatures: what a sensor reads off and lags hides a smaller one
_CHANCE = 0.0027  # of a term that is none being kept: 3 sigma
_SCALED = slice(0, 3)  # fx, skew, fy


def focal_factor(focal: Floats, above_reference_k: Floats) -> Floats:
    """Factors (m,) of the focal length at temperatures (m,) above the reference."""
    return np.asarray(1.0 + _powers(above_reference_k, len(focal)) @ focal)


def parameters_at(parameters: Floats, focal: Floats, above_reference_k: Floats) -> Floats:
    """Camera parameters (m, 10) at temperatures (m,) above the reference."""
    result = np.tile(parameters, (len(above_reference_k), 1))
    result[:, _SCALED] *= focal_factor(focal, above_reference_k)[:, None]
    return result


def parameters_chain(parameters: Floats, focal: Floats, above_reference_k: Floats) -> Floats:
    """Derivatives (m, 10, 10 + q) of `parameters_at` by the parameters, then the q focal terms."""
    q = len(focal)
    chain = np.tile(np.eye(10, 10 + q), (len(above_reference_k), 1, 1))
    chain[:, _SCALED, _SCALED] *= focal_factor(focal, above_reference_k)[:, None, None]
    powers = _powers(above_reference_k, q)
    chain[:, _SCALED, 10:] = parameters[_SCALED][None, :, None] * powers[:, None, :]
    return chain


def turns(rate: Floats, above_reference_k: Floats) -> Rotation:
    """Rotations (m) of the camera frame at temperatures (m,) above the reference."""
    return Rotation.from_rotvec(-np.outer(above_reference_k, rate))


def turns_chain(rate: Floats, above_reference_k: Floats) -> Floats:
    """
    How alignment angles and rate turn the camera of each image, (m, 3, 6).

    Exact to a twelfth of the squared turn: 1e-7 at 0.06 degrees.
    """
    dT = above_reference_k[:, None, None]
    x, y, z = rate
    half = np.eye(3) - 0.5 * dT * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.concatenate([turns(rate, above_reference_k).as_matrix(), dT * half], axis=-1)


def camera_at(calibration: Calibration, temperature_degc: float) -> CameraGeometry:
    """Camera and alignment of a calibration at a temperature; its own where it has no terms."""
    return geometry_at(calibration.geometry, calibration.thermal, temperature_degc)


def geometry_at(
    geometry: CameraGeometry, thermal: Thermal | None, temperature_degc: float
) -> CameraGeometry:
    """Camera and alignment at a temperature, from those at the reference."""
    if thermal is None:
        return geometry
    above_k = np.array([temperature_degc - thermal.reference_degc])
    camera, alignment = geometry.camera, geometry.star_tracker_from_camera_xyzw
    if thermal.focal_per_degc:
        focal = np.array(thermal.focal_per_degc)
        fx, skew, fy = parameters_at(camera.parameters, focal, above_k)[0, _SCALED]
        camera = camera.replace(fx=float(fx), skew=float(skew), fy=float(fy))
    if thermal.alignment_rate_rad_per_degc:
        turn = turns(np.array(thermal.alignment_rate_rad_per_degc), above_k)[0]
        alignment = (Rotation.from_quat(alignment) * turn.inv()).as_quat()
    return CameraGeometry(camera, alignment)


def why_unsupported(temperatures_degc: Floats, order: int) -> str:
    """Why images of these temperatures (m,) carry no thermal terms; empty where they may."""
    unknown = int(np.count_nonzero(~np.isfinite(temperatures_degc)))
    count = len(temperatures_degc)
    if unknown:
        return f'{unknown} of {count} images have no temperature'
    spread = float(temperatures_degc.std())
    if spread < FEWEST_SPREAD_K:
        return f'the temperatures spread by {spread:.2g} degC, less than {FEWEST_SPREAD_K:g}'
    distinct = len(np.unique(temperatures_degc))
    if distinct <= order:
        return f'{distinct} temperatures do not carry a polynomial of degree {order}'
    return ''


def weakest_term(thermal: Thermal, rate_covariance: Floats) -> str:
    """
    The one to leave out of the highest focal term and the rate: 'focal', 'rate' or neither.

    The one that chance explains better, where that is beyond 3 sigma of a single number.
    """
    chances = {}
    if thermal.focal_per_degc:
        sigmas = thermal.focal_per_degc[-1] / thermal.focal_sigma[-1]
        chances['focal'] = float(chdtrc(1, sigmas**2))
    if thermal.alignment_rate_rad_per_degc:
        rate = np.array(thermal.alignment_rate_rad_per_degc)
        chances['rate'] = float(chdtrc(3, rate @ np.linalg.solve(rate_covariance, rate)))
    weakest = max(chances, key=lambda name: chances[name], default='')
    return weakest if chances.get(weakest, 0.0) > _CHANCE else ''


def summary(thermal: Thermal) -> str:
    """Return a line for a person."""
    parts = [
        f'a{k} {value:+.4g} ({sigma:.2g}) /degC' + (f'^{k}' if k > 1 else '')
        for k, (value, sigma) in enumerate(
            zip(thermal.focal_per_degc, thermal.focal_sigma, strict=True), start=1
        )
    ]
    if thermal.alignment_rate_rad_per_degc:
        rates = np.degrees(thermal.alignment_rate_rad_per_degc) * 3600.0
        sigmas = np.degrees(thermal.alignment_rate_sigma) * 3600.0
        axes = (f'{rate:+.3f} ({sigma:.2g})' for rate, sigma in zip(rates, sigmas, strict=True))
        parts.append('alignment ' + ', '.join(axes) + ' arcsec/degC')
    text = f'{"; ".join(parts) or "no terms"}; reference {thermal.reference_degc:g} degC'
    return text + (f'; {thermal.note}' if thermal.note else '')


def _powers(above_reference_k: Floats, order: int) -> Floats:
    """First to ``order``-th powers (m, order)."""
    return np.asarray(above_reference_k[:, None] ** np.arange(1, order + 1))
