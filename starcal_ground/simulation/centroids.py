# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Simulated centroids without pixels, and Cramer-Rao bounds.

`true_observations` gives noisy centroids, each with its Cramer-Rao bound (`centroid_bound`);
`cramer_rao_covariance` is the bound of the camera parameters estimated from them.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
import math

import numpy as np

from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.rendering import pixel_stamps
from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.camera import CameraModel, project_jacobians, rotation_jacobian
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.sky import astrometry, attitude

BOUND_SNR = 5.0
_AT_ONCE = 32  # stars whose pixels a processor has at hand


def bound_names(camera: CameraModel) -> tuple[str, ...]:
    """Names of all parameters but the principal point, which trades with the attitude."""
    return tuple(name for name in camera.parameter_names if name not in ('cx', 'cy'))


def true_observations(
    scenario: synthetic.Scenario,
    centroid_sigma_px: float | None = None,
    centroid_noise: bool = True,
    attitude_noise: bool = True,
) -> Ensemble:
    """
    Observations of all stars on the detector above `BOUND_SNR`.

    Parameters
    ----------
    centroid_sigma_px : float, optional
        1-sigma error per axis of every star; default: its Cramer-Rao bound.
    centroid_noise, attitude_noise : bool
        False: no errors are added; the covariances stay the same.
    """
    images = []
    for index, shown in enumerate(synthetic.scenes(scenario, attitude_noise)):
        covariance, snr, keep = scene_bound(scenario, shown)
        if centroid_sigma_px is not None:
            covariance = np.broadcast_to(np.eye(2) * centroid_sigma_px**2, covariance.shape)
        # Drawn before the selection, so that the error of a star does not depend on other stars.
        rng = synthetic.random_stream(scenario.seed, synthetic.CENTROID_STREAM, index)
        error = rng.normal(size=shown.pixel_px.shape) * centroid_noise
        root = np.linalg.cholesky(covariance)
        measured = shown.pixel_px + np.einsum('nij,nj->ni', root, error)
        observed = observations(scenario, shown, measured, covariance, snr).select(keep)
        # A rate is exact where all samples have one error; a sigma of 0 means an unknown one.
        own = 1.0 if scenario.star_tracker_hz > 0 else 1e-6
        tracker_sigma_rad = np.array(scenario.star_tracker_sigma_arcsec) * ARCSECOND_RAD * own
        samples = synthetic.attitude_samples(scenario, index)
        rate = attitude.rate_of(samples, shown.time_ns, tracker_sigma_rad)
        images.append(with_rate(observed, *rate))
    return Ensemble(tuple(images))


def with_rate(
    observed: StarObservations, rate_rad_s: Floats, sigma_rad_s: Floats
) -> StarObservations:
    """Return observations with the rate of the star tracker."""
    return dataclasses.replace(
        observed, star_tracker_rate_rad_s=rate_rad_s, star_tracker_rate_sigma_rad_s=sigma_rad_s
    )


def scene_bound(
    scenario: synthetic.Scenario, shown: synthetic.Scene
) -> tuple[Floats, Floats, Mask]:
    """Bounds and signal-to-noise ratios of stars, and which are used: bright, on the detector."""
    camera = scenario.truth.camera
    path_px = None
    if any(scenario.turn_rad):
        in_camera = shown.direction_icrf @ shown.camera_from_icrf.T
        path_px = rotation_jacobian(camera, in_camera) @ scenario.turn_rad
    covariance, snr = centroid_bound(
        shown.pixel_px,
        shown.flux_electrons,
        scenario.detector,
        (camera.height, camera.width),
        path_px,
    )
    inside = (shown.pixel_px > 0) & (shown.pixel_px < [camera.width - 1, camera.height - 1])
    return covariance, snr, inside.all(axis=1) & (snr > BOUND_SNR)


def observations(
    scenario: synthetic.Scenario,
    shown: synthetic.Scene,
    measured_px: Floats,
    covariance: Floats,
    snr: Floats,
) -> StarObservations:
    """Observations of all stars of a scene by their centroids (n, 2) and covariances (n, 2, 2)."""
    camera, detector = scenario.truth.camera, scenario.detector
    signal_dn = detector.background_electrons / detector.electrons_per_dn
    return StarObservations.of_image(
        shown.time_ns,
        (camera.width, camera.height),
        icrf_from_star_tracker_xyzw=shown.icrf_from_star_tracker_xyzw,
        attitude_gap_s=0.5,
        catalog_id=shown.catalog_id,
        direction_icrf=shown.direction_icrf,
        magnitude=shown.magnitude.astype(np.float32),
        measured_px=measured_px,
        covariance_px2=covariance[:, [0, 0, 1], [0, 1, 1]],
        flux_dn=(shown.flux_electrons / detector.electrons_per_dn).astype(np.float32),
        snr=snr.astype(np.float32),
        background_dn=detector.offset_dn + signal_dn,
        noise_dn=detector.noise_electrons / detector.electrons_per_dn,
        psf_sigma_px=detector.psf_sigma_px,
        catalog_digest=shown.catalog_digest,
        velocity_sigma_m_s=astrometry.GIVEN_SIGMA_M_S,
    )


def centroid_bound(
    pixels_px: Floats,
    flux_electrons: Floats,
    detector: synthetic.Detector,
    shape: tuple[int, int],
    path_px: Floats | None = None,
) -> tuple[Floats, Floats]:
    """
    Cramer-Rao bound of the centroids of single stars, flux free and background fixed.

    Saturated pixels and pixels outside the detector carry no information.  ``path_px`` (n, 2) is
    the path of each star during the exposure.

    Returns
    -------
    covariance_px2 : (n, 2, 2)
        Over a thousand px^2 for a star without a usable pixel.
    snr : (n,)
        Flux divided by its bound.
    """
    height, width = shape
    sigma_px = detector.psf_sigma_at(pixels_px, shape)
    path_px = np.zeros_like(pixels_px) if path_px is None else path_px
    reach_px = math.ceil(0.5 * float(np.abs(path_px).max(initial=0.0)))
    flux = np.asarray(flux_electrons, np.float64)[:, None, None]
    (u, share_u, slope_u), (v, share_v, slope_v) = (
        _stamps_along(pixels_px[:, k], sigma_px, path_px[:, k], reach_px) for k in (0, 1)
    )
    full_electrons = (detector.full_dn - detector.offset_dn) * detector.electrons_per_dn
    on_detector = (v >= 0) & (v < height), (u >= 0) & (u < width)
    information = np.empty((len(flux), 3, 3))
    for first in range(0, len(flux), _AT_ONCE):
        k = slice(first, first + _AT_ONCE)
        # Matrix products sum over all parts of the path at once.
        of_star = flux[k] / share_u.shape[1]
        along_u, along_v = share_u[k], share_v[k].transpose(0, 2, 1)
        # By log flux, which keeps the matrix well scaled.
        gradients = np.empty((len(of_star), 3, v.shape[1], u.shape[1]))
        gradients[:, 0] = of_star * (along_v @ slope_u[k])
        gradients[:, 1] = of_star * (slope_v[k].transpose(0, 2, 1) @ along_u)
        gradients[:, 2] = mean = of_star * (along_v @ along_u)
        usable = mean + detector.background_electrons < full_electrons
        usable &= on_detector[0][k, :, None] & on_detector[1][k, None, :]
        weight = usable / (mean + detector.noise_electrons**2)
        information[k] = np.einsum('niyx,nyx,njyx->nij', gradients, weight, gradients)
    # The last term keeps stars without any information invertible.
    covariance: Floats = np.asarray(np.linalg.inv(information + 1e-6 * np.eye(3)), np.float64)
    return covariance[:, :2, :2], 1 / np.sqrt(covariance[:, 2, 2])


def _stamps_along(
    centers_px: Floats, sigma_px: Floats, path_px: Floats, reach_px: int
) -> tuple[Indices, Floats, Floats]:
    """`pixel_stamps` in the p parts of paths (n,) on one axis: shares and slopes (n, p, m)."""
    count = 8 * reach_px + 1  # parts of a quarter of a pixel
    parts = (np.arange(count) + 0.5) / count - 0.5
    of_parts = [pixel_stamps(centers_px, sigma_px, part * path_px, reach_px) for part in parts]
    pixels, shares, slopes = zip(*of_parts, strict=True)
    return pixels[0], np.stack(shares, axis=1), np.stack(slopes, axis=1)


def cramer_rao_covariance(
    scenario: synthetic.Scenario, bounds: Sequence[tuple[Floats, Floats, Mask]] = ()
) -> Floats:
    """
    Cramer-Rao bound of the covariance of the camera parameters named by `bound_names`.

    Every star above `BOUND_SNR` counts, with its own bound; the attitude of each image is free
    and the parameters not named are held.  ``bounds``: the `scene_bound` of each scene.
    """
    camera = scenario.truth.camera
    columns = [camera.parameter_names.index(name) for name in bound_names(camera)]
    return scaled_inverse(scenario_information(scenario, columns, bounds))


def scenario_information(
    scenario: synthetic.Scenario,
    columns: Sequence[int],
    bounds: Sequence[tuple[Floats, Floats, Mask]] = (),
) -> Floats:
    """Information (k, k) of all images, their rotations free, on some camera parameters."""
    information = np.zeros((len(columns), len(columns)))
    for index, shown in enumerate(synthetic.scenes(scenario)):
        covariance, _, keep = bounds[index] if bounds else scene_bound(scenario, shown)
        in_camera = shown.direction_icrf[keep] @ shown.camera_from_icrf.T
        _, J_parameters, J_rotation = project_jacobians(scenario.truth.camera, in_camera)
        J = np.concatenate([J_parameters[..., columns], J_rotation], axis=-1)
        W = np.linalg.inv(covariance[keep])
        N = np.einsum('nia,nij,njb->ab', J, W, J, optimize=True)
        # The rotation of the image is eliminated.
        information += N[:-3, :-3] - N[:-3, -3:] @ np.linalg.solve(N[-3:, -3:], N[-3:, :-3])
    return information


def scaled_inverse(information: Floats) -> Floats:
    """Inverse of an information matrix whose parameters have different units."""
    scale = 1.0 / np.sqrt(np.diag(information))
    scaled = np.linalg.inv(information * np.outer(scale, scale))
    return np.asarray(scaled * np.outer(scale, scale))
