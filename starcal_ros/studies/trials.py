"""
One trial of a Monte Carlo study: star fields whose truth is known, and how far off an answer is.

A field is drawn whole; fewer images, fewer stars or another star tracker are parts or multiples of
the same draws, so that cells of a study differ by what they compare and not by their luck.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.assessment.agreement import alignment_difference_rad, lines_of_sight
from starcal_ros.assessment.observability import GRID, line_of_sight_sigma_arcsec, map_sigma_px
from starcal_ros.camera import CameraModel, line_of_sight, PARAMETER_NAMES, project
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import CalibrationOptions, Estimate
from starcal_ros.estimation.normal_equations import arrange, normal_blocks, star_table
from starcal_ros.records import CameraGeometry, Ensemble, StarObservations
from starcal_ros.simulation.scenario import Scenario, scenario

CENTROID_SIGMA_PX = 0.1
OUTLIER_REACH_PX = 20.0  # a misidentified star: anywhere in a square of this half side
FAR_FOCAL = 0.2
FAR_PRINCIPAL_POINT_PX = 100.0
FAR_ALIGNMENT_RAD = math.radians(0.3)
LEAST_TRACKER_ARCSEC = 1e-3  # what a calibration takes for a perfect star tracker

_FREE = [PARAMETER_NAMES.index(name) for name in CalibrationOptions().estimate]
ESTIMATED = np.array([*_FREE, 10, 11, 12])
"""Rows of a (13, 13) covariance that a calibration with default options estimates."""


@dataclass(frozen=True)
class StarField:
    """
    Images at random attitudes, each with stars uniformly over the detector; m images, n stars.

    Attributes
    ----------
    truth, prior : CameraGeometry
    camera_from_icrf : Rotation (m,)
        The truth.
    pixel_px, direction_icrf : (m, n, 2), (m, n, 3)
        The truth.
    centroid_error_px : (m, n, 2)
    tracker_error : (m, 3)
        In units of the star tracker's sigma, about its axes.
    luck, outlier_px : (m, n), (m, n, 2)
        A star whose luck, uniform in 0 to 1, is under the share of outliers is off by this.
    """

    truth: CameraGeometry
    prior: CameraGeometry
    camera_from_icrf: Rotation
    pixel_px: Floats
    direction_icrf: Floats
    centroid_error_px: Floats
    tracker_error: Floats
    luck: Floats
    outlier_px: Floats

    def part(self, first: int, count: int, stars: int) -> StarField:
        """Some images in a row with the first stars of each."""
        m, n = slice(first, first + count), slice(stars)
        return StarField(
            self.truth,
            self.prior,
            self.camera_from_icrf[m],
            self.pixel_px[m, n],
            self.direction_icrf[m, n],
            self.centroid_error_px[m, n],
            self.tracker_error[m],
            self.luck[m, n],
            self.outlier_px[m, n],
        )


def draw_scenario(rng: np.random.Generator) -> Scenario:
    """The paper's campaign with its truth, and the prior that launch has spoilt, at random."""
    return scenario('paper', int(rng.integers(2**31)))


def draw_star_field(rng: np.random.Generator, images: int, stars: int) -> StarField:
    """A star field of the paper's camera (2592 x 2048, 35 mm), with all its errors drawn."""
    drawn = draw_scenario(rng)
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
        luck=rng.uniform(0.0, 1.0, (images, stars)),
        outlier_px=rng.uniform(-OUTLIER_REACH_PX, OUTLIER_REACH_PX, pixels.shape),
    )


def far_prior(truth: CameraGeometry, rng: np.random.Generator) -> CameraGeometry:
    """
    A prior far off in a random direction.

    The focal lengths are off by `FAR_FOCAL`, the principal point by `FAR_PRINCIPAL_POINT_PX` and
    the alignment by `FAR_ALIGNMENT_RAD`; of distortion and skew it knows nothing.
    """
    fx, _, fy, cx, cy = truth.camera.parameters[:5]
    longer = 1.0 + FAR_FOCAL * rng.choice([-1.0, 1.0])
    angle = rng.uniform(0.0, 2.0 * np.pi)
    pinhole = {
        'fx': longer * fx,
        'fy': longer * fy,
        'cx': cx + FAR_PRINCIPAL_POINT_PX * math.cos(angle),
        'cy': cy + FAR_PRINCIPAL_POINT_PX * math.sin(angle),
    }
    camera = truth.camera.replace(**{**dict.fromkeys(PARAMETER_NAMES, 0.0), **pinhole})
    axis = rng.normal(size=3)
    turn = Rotation.from_rotvec(FAR_ALIGNMENT_RAD * axis / np.linalg.norm(axis))
    star_tracker_from_camera = Rotation.from_quat(truth.star_tracker_from_camera_xyzw) * turn
    return CameraGeometry(camera, star_tracker_from_camera.as_quat())


def observe(field: StarField, tracker_arcsec: float, outlier_share: float = 0.0) -> Ensemble:
    """What is measured of a star field, with a star tracker of that noise about each axis."""
    camera = field.truth.camera
    star_tracker_from_camera = Rotation.from_quat(field.truth.star_tracker_from_camera_xyzw)
    error = Rotation.from_rotvec(tracker_arcsec * ARCSECOND_RAD * field.tracker_error)
    reported = (star_tracker_from_camera * field.camera_from_icrf).inv() * error
    measured = field.pixel_px + field.centroid_error_px
    measured += (field.luck < outlier_share)[..., None] * field.outlier_px
    n = measured.shape[1]
    ones = np.ones(n, np.float32)
    images = [
        StarObservations(
            time_ns=k,
            width=camera.width,
            height=camera.height,
            refusal='',
            detail='',
            icrf_from_star_tracker_xyzw=quaternion,
            attitude_gap_s=0.0,
            catalog_id=np.arange(k * n, (k + 1) * n),
            direction_icrf=field.direction_icrf[k],
            magnitude=6 * ones,
            measured_px=measured[k],
            covariance_px2=np.tile([CENTROID_SIGMA_PX**2, 0.0, CENTROID_SIGMA_PX**2], (n, 1)),
            flux_dn=1000 * ones,
            snr=10 * ones,
            refused_stars={},
            background_dn=0.0,
            noise_dn=1.0,
            psf_sigma_px=1.0,
            catalog_digest='',
        )
        for k, quaternion in enumerate(reported.as_quat())
    ]
    return Ensemble(tuple(images))


def information_blocks(field: StarField) -> Floats:
    """Normal matrices (m, 13, 13) of the images on camera and own rotation, at the truth."""
    table = star_table(observe(field, 0.0).images)
    _, blocks = normal_blocks(
        arrange(table, np.ones(len(table), bool), table.covariance_px2),
        field.truth.camera.parameters,
        field.camera_from_icrf.as_matrix(),
    )
    return blocks[:, :13, :13]


def bound(method: str, blocks: Floats, tracker_arcsec: float) -> Floats:
    """
    Cramer-Rao bound (13, 13) of a method's own model of the images.

    ``single`` takes the star tracker as perfect, ``per_image`` learns nothing from it,
    ``hierarchical`` knows its sigma: that one is the bound of any method.  The alignment of
    ``per_image`` is no part of its model and left at zero.  The sigma is the same about all axes,
    so the frame in which it is given does not matter.
    """
    N = blocks[:, [*_FREE, 10, 11, 12]][:, :, [*_FREE, 10, 11, 12]]
    f = len(_FREE)
    covariance = np.zeros((13, 13))
    if method == 'single':
        covariance[np.ix_(ESTIMATED, ESTIMATED)] = _inverse(N.sum(axis=0))
        return covariance
    A, B, C = N[:, :f, :f].sum(axis=0), N[:, f:, :f], N[:, f:, f:]
    if method == 'per_image':
        S = A - np.einsum('mqi,mqj->ij', B, np.linalg.solve(C, B))
        covariance[np.ix_(_FREE, _FREE)] = _inverse(S)
        return covariance
    tracker = np.eye(3) / (max(tracker_arcsec, LEAST_TRACKER_ARCSEC) * ARCSECOND_RAD) ** 2
    B = np.concatenate([B, np.broadcast_to(-tracker, C.shape)], axis=2)
    S = np.zeros((f + 3, f + 3))
    S[:f, :f], S[f:, f:] = A, len(blocks) * tracker
    S -= np.einsum('mqi,mqj->ij', B, np.linalg.solve(C + tracker, B))
    covariance[np.ix_(ESTIMATED, ESTIMATED)] = _inverse(S)
    return covariance


def _inverse(information: Floats) -> Floats:
    scale = 1.0 / np.sqrt(np.diag(information))
    scaled = np.linalg.inv(information * np.outer(scale, scale))
    return np.asarray(scaled * np.outer(scale, scale))


def map_bound_px(camera: CameraModel, covariance: Floats) -> float:
    """RMS over the detector of what `map_error_px` is to be expected to be, px."""
    return _rms(map_sigma_px(camera, covariance, GRID))


def pointing_bound_arcsec(camera: CameraModel, covariance: Floats) -> float:
    """RMS over the detector of what `pointing_error_arcsec` is to be expected to be."""
    return _rms(line_of_sight_sigma_arcsec(camera, covariance, GRID, GRID))


def pointing_error_arcsec(found: CameraGeometry, true: CameraGeometry) -> float:
    """RMS over the detector between the lines of sight in the star tracker frame, arcsec."""
    of_found, of_true = (lines_of_sight(geometry, GRID, GRID) for geometry in (found, true))
    return _rms(np.linalg.norm(of_found - of_true, axis=1)) / ARCSECOND_RAD


def errors(found: CameraGeometry, true: CameraGeometry) -> Floats:
    """Found less true (13,): camera parameters, then the passive turn of the camera frame, rad."""
    turn_rad = alignment_difference_rad(found, true)
    return np.concatenate([found.camera.parameters - true.camera.parameters, turn_rad])


def normalised_error_squared(estimate: Estimate, true: CameraGeometry) -> float:
    """Squared length of `errors` in the metric of the covariance reported: chi^2 with 11."""
    covariance = estimate.covariance[np.ix_(ESTIMATED, ESTIMATED)]
    sigma = np.sqrt(np.diag(covariance))
    error = errors(estimate.geometry, true)[ESTIMATED] / sigma
    return float(error @ np.linalg.solve(covariance / np.outer(sigma, sigma), error))


def unused_residual_px(camera: CameraModel, field: StarField) -> float:
    """
    RMS per axis of the residuals of images that a calibration has not seen, px.

    Each image is turned to fit (as in the paper's Fig. 7): what the camera gets wrong stays.
    """
    squares = 0.0
    measured = field.pixel_px + field.centroid_error_px
    for pixels, directions in zip(measured, field.direction_icrf, strict=True):
        rotation, _ = Rotation.align_vectors(line_of_sight(camera, pixels), directions)
        squares += float(((pixels - project(camera, rotation.apply(directions))) ** 2).sum())
    return math.sqrt(squares / measured.size)


def calibration_options(method: str, tracker_arcsec: float, **other: object) -> CalibrationOptions:
    """Options for few images and stars too, told a star tracker's sigma about each axis."""
    told = max(tracker_arcsec, LEAST_TRACKER_ARCSEC)
    options = CalibrationOptions(
        method=method,
        star_tracker_sigma_arcsec=(told, told, told),
        min_images=2,
        min_stars=10,
    )
    return dataclasses.replace(options, **other)  # type: ignore[arg-type]


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
