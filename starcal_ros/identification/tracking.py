# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Stars of an image with a track: measurement in windows without a search of the whole image.

The track (`TrackedCamera`) holds the camera, the alignment and the PSF measured in earlier images.
The brightest predictions are searched in windows; their common small rotation predicts all other
stars to a fraction of a pixel, and each is measured in its own window.  If the matches in the
windows are consistent with chance the track is lost, and the caller searches the whole image
(`star_finder`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import pdtrc

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import CameraModel, project, project_jacobians, rotation_jacobian
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.prediction import Prediction
from starcal_ros.identification.star_finder import (
    Exposure,
    measure_predicted,
    predicted,
    SEARCH_RADIUS_PX,
    StarSearch,
)
from starcal_ros.records import CameraGeometry, StarObservations
from starcal_ros.robust_statistics import median
from starcal_ros.stars import detection
from starcal_ros.stars.image_model import Instrument, known_model

_GUIDES = 24  # brightest predictions, searched in windows
_NEIGHBOUR_PX = 3.0  # offsets of all guides agree to this under a roll of 0.1 degrees
_MAX_P_VALUE = 1e-9  # p-value of the matches in the windows, given a wrong prediction
_GOOD_SNR = 10.0  # smallest signal-to-noise ratio of stars that correct the prediction
_SYSTEMATIC_PX = 0.15  # rms from which the camera of the prediction is corrected
# 1-sigma of the predicting camera about the one before: intrinsics as parts of the focal length,
# and distortion for a lens with an inaccurate prior.
_INTRINSIC_SIGMA = np.array([0.01, 1e-3, 0.01, 0.01, 0.01])
_COEFFICIENT_SIGMA = {'k1': 0.05, 'k2': 0.1, 'k3': 0.1, 'k4': 0.05, 'k5': 0.1, 'k6': 0.1}
_SMALL_SIGMA = 1e-3  # 1-sigma of the other coefficients: decentring, thin prism, tilt


@dataclass(frozen=True)
class TrackedCamera:
    """
    State of a track: geometry and PSF from the images so far.

    ``geometry`` predicts the next image; its camera may differ from the prior of the calibration,
    because it only has to predict the windows.
    """

    geometry: CameraGeometry
    instrument: Instrument


def start_tracking(
    geometry: CameraGeometry, observations: StarObservations, instrument: Instrument | None
) -> TrackedCamera | None:
    """
    Track with the camera and alignment measured in an image.

    None if the image was refused or its PSF was not measured.
    """
    if observations.refusal or instrument is None:
        return None
    return TrackedCamera(_corrected(geometry, observations), instrument)


def track_stars(
    exposure: Exposure, before: TrackedCamera, search: StarSearch
) -> tuple[StarObservations, TrackedCamera]:
    """
    Observations of the next image, and the updated track.

    Raises ImageRefused ``no_match`` if the track is lost; ``too_few_stars``, ``incomplete`` or
    ``smeared``.
    """
    pixels = exposure.image.pixels
    camera = before.geometry.camera
    margin_rad = SEARCH_RADIUS_PX / float(camera.parameters[0])
    prediction = predicted(exposure, before.geometry, search, margin_rad)
    # The moment method needs the local background; a PSF fit estimates its own level.
    fitted = search.centroid.centroid == 'psf'
    background = (
        detection.sample_background(pixels) if fitted else detection.measure_background(pixels)
    )
    rotation_rad = _find_rotation(pixels, background, prediction, camera)
    rotation = Rotation.from_rotvec(-rotation_rad)
    direction_camera = rotation.apply(prediction.direction_camera)
    xy_px = project(camera, direction_camera)
    prediction = dataclasses.replace(prediction, direction_camera=direction_camera, xy_px=xy_px)
    model = known_model(pixels, background, before.instrument, prediction.xy_px, search.centroid)
    observations, instrument = measure_predicted(
        exposure, prediction, model, before.instrument, search
    )
    if observations.refusal:
        raise ImageRefused(observations.refusal, observations.detail)
    corrected = _corrected(before.geometry, observations)
    return observations, TrackedCamera(corrected, instrument or before.instrument)


def _find_rotation(
    pixels: Pixels, background: detection.Background, prediction: Prediction, camera: CameraModel
) -> Floats:
    """
    Small passive rotation (3,) of the camera, rad, from the predictions to the stars.

    Raises ImageRefused ``no_match``.
    """
    reach_px = SEARCH_RADIUS_PX
    xy = prediction.xy_px
    rim = reach_px + 4.0
    inside = ((xy > rim) & (xy < [camera.width - 1 - rim, camera.height - 1 - rim])).all(axis=1)
    guides = np.nonzero(inside)[0][:_GUIDES]
    place_px, snr = detection.brightest_near(pixels, background, xy[guides], reach_px)
    found = snr > detection.DETECTION_SIGMA
    guides, place_px = guides[found], place_px[found]
    lost = ImageRefused('no_match', f'{len(guides)} of the brightest stars match a source')
    if len(guides) < 4:
        raise lost
    J = rotation_jacobian(camera, prediction.direction_camera[guides])
    offset_px = place_px - xy[guides]
    apart2 = ((offset_px[:, None] - offset_px[None]) ** 2).sum(axis=2)
    common = int((apart2 < _NEIGHBOUR_PX**2).sum(axis=1).argmax())
    near = apart2[common] < _NEIGHBOUR_PX**2
    limit_px = _NEIGHBOUR_PX
    rotation_rad = np.zeros(3)
    for _ in range(2):
        if np.count_nonzero(near) < 4:
            raise lost
        A, b = J[near].reshape(-1, 3), offset_px[near].ravel()
        # The damping bounds the roll if all guides lie in one place.
        normal = A.T @ A + 1e-9 * float((A * A).sum()) * np.eye(3)
        rotation_rad = np.linalg.solve(normal, A.T @ b)
        left_px = np.hypot(*(offset_px - J @ rotation_rad).T)
        limit_px = min(max(4.0 * median(left_px[near]), 0.75), _NEIGHBOUR_PX)
        near = left_px < limit_px
    matched = int(np.count_nonzero(near))
    side_px = 2 * reach_px + 1
    expected = len(guides) * np.pi * limit_px**2 / side_px**2
    trials = (side_px / limit_px) ** 2
    # Three angles were fitted: two parameters can make one false match.
    if matched < 4 or pdtrc(matched - 3, expected) * trials > _MAX_P_VALUE:
        raise lost
    return np.asarray(rotation_rad)


def _corrected(geometry: CameraGeometry, observations: StarObservations) -> CameraGeometry:
    """Geometry aligned to the stars of an image; its camera is corrected if it does not fit."""
    camera = geometry.camera
    icrf_from_camera = geometry.icrf_from_camera(observations.icrf_from_star_tracker_xyzw)
    directions = observations.direction_icrf @ icrf_from_camera.as_matrix()
    variance_px2 = 0.5 * (observations.covariance_px2[:, 0] + observations.covariance_px2[:, 2])
    bright = observations.snr > _GOOD_SNR
    bright |= np.count_nonzero(bright) < 4
    directions, measured_px = directions[bright], observations.measured_px[bright]
    # A prediction need not be better than 0.05 px.
    weight = 1.0 / (variance_px2[bright] + 0.05**2)
    off_px = measured_px - project(camera, directions)
    J = rotation_jacobian(camera, directions)
    step = _step(J, off_px, weight, np.zeros(3), np.zeros(3))
    rotation = Rotation.from_rotvec(-step)
    left_px = off_px - J @ step
    if _rms_px(left_px) > _SYSTEMATIC_PX:
        camera, rotation = _corrected_camera(camera, rotation, directions, measured_px, weight)
    icrf_from_star_tracker = Rotation.from_quat(observations.icrf_from_star_tracker_xyzw)
    camera_from_star_tracker = rotation * icrf_from_camera.inv() * icrf_from_star_tracker
    return CameraGeometry(camera, camera_from_star_tracker.inv().as_quat())


def _rms_px(off_px: Floats) -> float:
    """Root mean square per axis of (n, 2), each value limited to 3 px."""
    return float(np.sqrt(np.mean(np.minimum(off_px**2, 9.0))))


def _corrected_camera(
    camera: CameraModel,
    rotation: Rotation,
    directions: Floats,
    measured_px: Floats,
    weight: Floats,
) -> tuple[CameraModel, Rotation]:
    """Camera and rotation fitted to the stars of one image, with a prior on the camera."""
    before = camera.parameters
    coefficients = [_COEFFICIENT_SIGMA.get(k, _SMALL_SIGMA) for k in camera.parameter_names[5:]]
    sigma = np.r_[before[0] * _INTRINSIC_SIGMA, coefficients]
    # The principal point of a narrow field is no farther from the middle than of another one.
    sigma[3:5] = np.minimum(sigma[3:5], _INTRINSIC_SIGMA[3:5] * camera.width)
    held = np.r_[np.ones(len(before)), np.zeros(3)]
    for _ in range(3):
        pixels, J_parameters, J_rotation = project_jacobians(camera, rotation.apply(directions))
        J = np.concatenate([J_parameters * sigma, J_rotation], axis=-1)
        pull = np.r_[(before - camera.parameters) / sigma, np.zeros(3)]
        step = _step(J, measured_px - pixels, weight, held, pull)
        camera = dataclasses.replace(camera, parameters=camera.parameters + sigma * step[:-3])
        rotation = Rotation.from_rotvec(-step[-3:]) * rotation
    return camera, rotation


def _step(J: Floats, residual_px: Floats, weight: Floats, held: Floats, pull: Floats) -> Floats:
    """Robust step (k,) of ``J`` (n, 2, k), with a prior of weight ``held`` (k,) at ``pull``."""
    off2 = weight * (residual_px**2).sum(axis=1)
    root = np.sqrt(weight) / (1.0 + off2 / max(9.0, 9.0 * median(off2)))
    A = (J * root[:, None, None]).reshape(-1, J.shape[-1])
    b = (residual_px * root[:, None]).ravel()
    return np.asarray(np.linalg.solve(A.T @ A + np.diag(held), A.T @ b + held * pull))
