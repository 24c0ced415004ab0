# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Trials of a Monte Carlo study: star fields with known truth, and errors of their calibration.

A field is drawn at full size; cells with fewer images, fewer stars or another star tracker use
parts or multiples of the same draws, so that their difference has little sampling noise.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.comparison import chi_squared, parameter_difference
from starcal_ground.simulation.centroids import scaled_inverse
from starcal_ground.simulation.scenario import scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import GRID, grid_lines_of_sight, line_of_sight_table
from starcal_ros.assessment.observability import map_sigma_px
from starcal_ros.camera import CameraModel, line_of_sight, PARAMETER_NAMES, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.levenberg_marquardt import eliminated, inverse, NormalEquations
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.estimation.star_equations import arrange, normal_blocks, star_table
from starcal_ros.records import CameraGeometry, Ensemble, MapCovariance, StarObservations

CENTROID_SIGMA_PX = 0.1
OUTLIER_REACH_PX = 20.0  # half side of the square over which misidentified stars scatter
LEAST_TRACKER_ARCSEC = 1e-3  # assumed sigma of a perfect star tracker

# The paper holds the principal point, which trades with the attitude.
PAPER_ESTIMATE = ('fx', 'skew', 'fy', 'distortion')

_NAMES = estimated_parameters(CalibrationOptions(estimate=PAPER_ESTIMATE), 'plumb_bob')
_FREE = [PARAMETER_NAMES.index(name) for name in _NAMES]
ESTIMATED = np.array([*_FREE, 10, 11, 12])
"""Rows of the (13, 13) covariance that a calibration with the paper's choice estimates."""


@dataclass(frozen=True)
class StarField:
    """
    Images at random attitudes with stars uniform over the detector; m images, n stars each.

    Attributes
    ----------
    truth, prior : CameraGeometry
    camera_from_icrf : Rotation (m,)
        True attitudes.
    pixel_px, direction_icrf : (m, n, 2), (m, n, 3)
        True positions.
    centroid_error_px : (m, n, 2)
    tracker_error : (m, 3)
        In units of the star tracker's sigma, about its axes.
    outlier_draw, outlier_px : (m, n), (m, n, 2)
        A star is displaced by ``outlier_px`` if its draw, uniform in 0 to 1, is below the outlier
        share.
    """

    truth: CameraGeometry
    prior: CameraGeometry
    camera_from_icrf: Rotation
    pixel_px: Floats
    direction_icrf: Floats
    centroid_error_px: Floats
    tracker_error: Floats
    outlier_draw: Floats
    outlier_px: Floats

    def part(self, images: int, stars: int) -> StarField:
        """The first images with the first stars of each."""
        m, n = slice(images), slice(stars)
        by_star = ('pixel_px', 'direction_icrf', 'centroid_error_px', 'outlier_draw', 'outlier_px')
        return dataclasses.replace(
            self,
            camera_from_icrf=self.camera_from_icrf[m],
            tracker_error=self.tracker_error[m],
            **{name: getattr(self, name)[m, n] for name in by_star},
        )


def draw_star_field(rng: np.random.Generator, images: int, stars: int) -> StarField:
    """Random star field of the paper's camera (2592 x 2048, 35 mm) with all its errors."""
    drawn = scenario('paper', int(rng.integers(2**31)))
    camera = drawn.truth.camera
    rotations = Rotation.from_quat(rng.normal(size=(images, 4)))
    pixels = rng.uniform(0.0, 1.0, (images, stars, 2)) * [camera.width - 1, camera.height - 1]
    return StarField(
        truth=drawn.truth,
        prior=drawn.prior,
        camera_from_icrf=rotations,
        pixel_px=pixels,
        direction_icrf=line_of_sight(camera, pixels) @ rotations.as_matrix(),
        centroid_error_px=CENTROID_SIGMA_PX * rng.normal(size=pixels.shape),
        tracker_error=rng.normal(size=(images, 3)),
        outlier_draw=rng.uniform(0.0, 1.0, (images, stars)),
        outlier_px=rng.uniform(-OUTLIER_REACH_PX, OUTLIER_REACH_PX, pixels.shape),
    )


def observe(field: StarField, tracker_arcsec: float, outlier_share: float = 0.0) -> Ensemble:
    """Observations of a star field with the given star tracker noise about each axis."""
    camera = field.truth.camera
    error = Rotation.from_rotvec(tracker_arcsec * ARCSECOND_RAD * field.tracker_error)
    reported = (field.truth.star_tracker_from_camera * field.camera_from_icrf).inv() * error
    measured = field.pixel_px + field.centroid_error_px
    measured += (field.outlier_draw < outlier_share)[..., None] * field.outlier_px
    n = measured.shape[1]
    ones = np.ones(n, np.float32)
    images = [
        StarObservations.of_image(
            k,
            (camera.width, camera.height),
            icrf_from_star_tracker_xyzw=quaternion,
            catalog_id=np.arange(k * n, (k + 1) * n),
            direction_icrf=field.direction_icrf[k],
            magnitude=6 * ones,
            measured_px=measured[k],
            covariance_px2=np.tile([CENTROID_SIGMA_PX**2, 0.0, CENTROID_SIGMA_PX**2], (n, 1)),
            flux_dn=1000 * ones,
            snr=10 * ones,
            velocity_sigma_m_s=0.0,
        )
        for k, quaternion in enumerate(reported.as_quat())
    ]
    return Ensemble(tuple(images))


def information_blocks(field: StarField) -> Floats:
    """Normal matrices (m, 13, 13) of the images for camera and own rotation, at the truth."""
    table = star_table(observe(field, 0.0).images)
    _, blocks = normal_blocks(
        arrange(table, np.ones(len(table), bool), table.covariance_px2),
        field.truth.camera.model,
        field.truth.camera.parameters,
        field.camera_from_icrf.as_matrix(),
    )
    return blocks[:, :13, :13]


def shared_covariance(normal: NormalEquations) -> Floats:
    """Covariance of the shared unknowns, the images eliminated."""
    return inverse(eliminated(normal).information)


def bound(method: str, blocks: Floats, tracker_arcsec: float) -> MapCovariance:
    """
    Cramer-Rao bound (13, 13) under the assumptions of a method.

    ``single`` assumes a perfect star tracker, ``per_image`` does not use it, ``hierarchical``
    assumes its true sigma, which gives the bound of any method.  ``per_image`` does not model the
    alignment, whose rows are zero.  The sigma is the same about all axes, so its frame is
    irrelevant.
    """
    N = blocks[:, [*_FREE, 10, 11, 12]][:, :, [*_FREE, 10, 11, 12]]
    f = len(_FREE)
    covariance = np.zeros((13, 13))
    if method == 'single':
        covariance[np.ix_(ESTIMATED, ESTIMATED)] = scaled_inverse(N.sum(axis=0))
        return MapCovariance(covariance)
    A, B, C = N[:, :f, :f].sum(axis=0), N[:, f:, :f], N[:, f:, f:]
    if method == 'per_image':
        S = A - np.einsum('mqi,mqj->ij', B, np.linalg.solve(C, B))
        covariance[np.ix_(_FREE, _FREE)] = scaled_inverse(S)
        return MapCovariance(covariance)
    tracker = np.eye(3) / (max(tracker_arcsec, LEAST_TRACKER_ARCSEC) * ARCSECOND_RAD) ** 2
    B = np.concatenate([B, np.broadcast_to(-tracker, C.shape)], axis=2)
    S = np.zeros((f + 3, f + 3))
    S[:f, :f], S[f:, f:] = A, len(blocks) * tracker
    S -= np.einsum('mqi,mqj->ij', B, np.linalg.solve(C + tracker, B))
    covariance[np.ix_(ESTIMATED, ESTIMATED)] = scaled_inverse(S)
    return MapCovariance(covariance)


def map_bound_px(camera: CameraModel, covariance: MapCovariance) -> float:
    """Expected `map_error_px` for a covariance, RMS over the detector, px."""
    return rms(map_sigma_px(camera, covariance))


def pointing_bound_arcsec(camera: CameraModel, covariance: MapCovariance) -> float:
    """Expected `pointing_error_arcsec` for a covariance, RMS over the detector."""
    table = line_of_sight_table(camera, covariance, pixel_grid(camera, GRID, GRID))
    return rms(table.sigma_arcsec)


def pointing_error_arcsec(found: CameraGeometry, true: CameraGeometry) -> float:
    """RMS difference of the lines of sight in the star tracker frame over the detector, arcsec."""
    of_found, of_true = (grid_lines_of_sight(geometry, GRID, GRID) for geometry in (found, true))
    return rms(np.linalg.norm(of_found - of_true, axis=1)) / ARCSECOND_RAD


def normalised_error_squared(estimate: Estimate, true: CameraGeometry) -> float:
    """Squared errors normalised by the reported covariance: chi^2, 11 degrees of freedom."""
    error = parameter_difference(estimate.geometry, true)
    covariance = estimate.covariance[np.ix_(ESTIMATED, ESTIMATED)]
    return chi_squared(error[ESTIMATED], covariance).value


def calibration_options(method: str, tracker_arcsec: float, **other: object) -> CalibrationOptions:
    """
    Options of the paper's model, for few images and stars.

    Eight camera parameters, or those of ``estimate`` without a prior, at a known velocity and
    without motion in an image; the assumed star tracker sigma is per axis.
    """
    assumed = max(tracker_arcsec, LEAST_TRACKER_ARCSEC)
    options = CalibrationOptions(
        method=method,
        estimate=PAPER_ESTIMATE,
        principal_point_prior=0.0,
        lens_prior=0.0,
        star_tracker_sigma_arcsec=(assumed, assumed, assumed),
        velocity_sigma_m_s=0.0,
        shutter='global',
        stamp_sigma_s=0.0,
        min_images=2,
        min_stars=10,
    )
    return dataclasses.replace(options, **other)  # type: ignore[arg-type]


def rms(values: Floats | Sequence[float]) -> float:
    """Root of the mean square; NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan
