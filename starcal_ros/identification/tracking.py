"""
The stars of an image whose camera is known: nothing looks at the whole image.

A sequence carries what its images have shown (`Followed`): the camera and alignment with which
stars are predicted, and how their light falls.  The brightest predictions are looked for in
windows; their common small turn places all the others to a fraction of a pixel, and each is then
measured in its own stamp.  Where the windows do not bear the prediction out beyond chance, the
track is lost and says so: then the whole image is to be searched (`identification`).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import pdtrc

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.camera import (
    CameraModel,
    field_radius_rad,
    project,
    project_jacobians,
    rotation_jacobian,
)
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.prediction import Prediction, seen
from starcal_ros.identification.star_finder import IdentificationOptions, measure_predicted, Shot
from starcal_ros.image.centroiding import CentroidOptions, known_model
from starcal_ros.image.detection import (
    Background,
    brightest_near,
    measure_background,
    sample_background,
)
from starcal_ros.image.psf_field import Instrument
from starcal_ros.records import CameraGeometry, StarObservations
from starcal_ros.robust_statistics import median
from starcal_ros.sky.catalog import cone, StarCatalog

_GUIDES = 24  # brightest predictions that are looked for in windows
_NEIGHBOUR_PX = 3.0  # a small turn moves the guides alike; a roll of 0.1 degrees, by 3 px
_CHANCE = 1e-9  # greatest probability that the windows bear out a wrong prediction
_GOOD_SNR = 10.0  # of stars that correct the prediction
_STEADY_PX = 1.0  # turn that the next image finds anew as well, from wherever it starts
_SYSTEMATIC_PX = 0.15  # rms from which the camera of the prediction is corrected
# How far the camera that predicts may be from the one before, 1-sigma: a part of the focal length
# for the intrinsics, and the distortion of a lens that is not quite known.
_CAMERA_SIGMA = np.array([0.01, 1e-3, 0.01, 0.01, 0.01, 0.05, 0.1, 0.1, 1e-3, 1e-3])


@dataclass(frozen=True)
class Followed:
    """
    What the images so far have shown.

    ``geometry`` predicts the next image: its camera may differ from the one that is calibrated
    from, as it only has to bring the stars into their windows.
    """

    geometry: CameraGeometry
    field_radius_rad: float
    instrument: Instrument


def following(
    geometry: CameraGeometry, observations: StarObservations, instrument: Instrument | None
) -> Followed | None:
    """
    What to predict the next image with: camera and alignment as this image shows them.

    None where the image was refused, or does not tell its PSF.
    """
    if observations.refusal or instrument is None:
        return None
    corrected = _corrected(geometry, observations)
    return Followed(corrected, field_radius_rad(corrected.camera), instrument)


def follow(
    shot: Shot,
    before: Followed,
    catalog: StarCatalog,
    centroid_options: CentroidOptions,
    options: IdentificationOptions,
) -> tuple[StarObservations, Followed]:
    """
    The stars of the next image, and what is known after it.

    Raises
    ------
    ImageRefused
        ``no_match`` when the track is lost, ``too_few_stars``, ``incomplete``.
    """
    pixels = shot.image.pixels
    prediction = _predict(shot, before, catalog, options)
    # Moments stand and fall with the level under each star; a fit finds its own.
    fitted = centroid_options.centroid == 'psf'
    background = sample_background(pixels) if fitted else measure_background(pixels)
    turn_rad = _find_turn(
        pixels, background, prediction, before.geometry.camera, centroid_options, options
    )
    turn = Rotation.from_rotvec(-turn_rad)
    direction_camera = turn.apply(prediction.direction_camera)
    prediction = dataclasses.replace(
        prediction,
        direction_camera=direction_camera,
        xy_px=project(before.geometry.camera, direction_camera),
    )
    model = known_model(pixels, background, before.instrument, prediction.xy_px, centroid_options)
    observations, instrument = measure_predicted(
        shot, prediction, model, before.instrument, catalog, centroid_options, options
    )
    if observations.refusal:
        raise ImageRefused(observations.refusal, observations.detail)
    instrument = instrument or before.instrument
    turn_px = turn.magnitude() * prediction.px_per_rad
    if turn_px < _STEADY_PX and _fits(before.geometry, turn, observations):
        return observations, dataclasses.replace(before, instrument=instrument)
    corrected = _corrected(before.geometry, observations)
    radius_rad = before.field_radius_rad
    if corrected.camera is not before.geometry.camera:
        radius_rad = field_radius_rad(corrected.camera)
    return observations, Followed(corrected, radius_rad, instrument)


def _predict(
    shot: Shot, before: Followed, catalog: StarCatalog, options: IdentificationOptions
) -> Prediction:
    """Apparent catalog stars in the field, brightest first."""
    camera = before.geometry.camera
    icrf_from_camera = (
        Rotation.from_quat(shot.icrf_from_star_tracker_xyzw)
        * Rotation.from_quat(before.geometry.star_tracker_from_camera_xyzw)
    ).as_matrix()
    # The catalog is sorted by magnitude, and so are the rows of a cone.
    index = cone(catalog, icrf_from_camera[:, 2], before.field_radius_rad, options.magnitude_limit)
    index, direction_icrf = seen(catalog, index, shot.image.time_ns, shot.velocity_m_s, shot.site)
    direction_camera = direction_icrf @ icrf_from_camera
    # Beyond the edge of the field a distortion polynomial may fold over, back into the image.
    near = direction_camera[:, 2] > np.cos(before.field_radius_rad + 2e-3)
    index, direction_icrf, direction_camera = (
        index[near],
        direction_icrf[near],
        direction_camera[near],
    )
    xy_px = project(camera, direction_camera)
    return Prediction(index, direction_icrf, direction_camera, xy_px, float(camera.parameters[0]))


def _find_turn(
    pixels: Pixels,
    background: Background,
    prediction: Prediction,
    camera: CameraModel,
    centroid_options: CentroidOptions,
    options: IdentificationOptions,
) -> Floats:
    """
    Small passive rotation (3,) of the camera, rad, that brings the predictions onto their stars.

    Raises
    ------
    ImageRefused
        ``no_match``.
    """
    reach_px = options.search_radius_px
    xy = prediction.xy_px
    rim = reach_px + 4.0
    inside = ((xy > rim) & (xy < [camera.width - 1 - rim, camera.height - 1 - rim])).all(axis=1)
    guides = np.nonzero(inside)[0][:_GUIDES]
    place_px, found = brightest_near(
        pixels, background, xy[guides], reach_px, centroid_options.detection_sigma
    )
    guides, place_px = guides[found], place_px[found]
    lost = ImageRefused('no_match', f'{len(guides)} of the brightest stars meet a source')
    if len(guides) < 4:
        raise lost
    J = rotation_jacobian(camera, prediction.direction_camera[guides])
    offset_px = place_px - xy[guides]
    apart2 = ((offset_px[:, None] - offset_px[None]) ** 2).sum(axis=2)
    common = int((apart2 < _NEIGHBOUR_PX**2).sum(axis=1).argmax())
    near = apart2[common] < _NEIGHBOUR_PX**2
    limit_px = _NEIGHBOUR_PX
    turn_rad = np.zeros(3)
    for _ in range(2):
        if np.count_nonzero(near) < 4:
            raise lost
        A, b = J[near].reshape(-1, 3), offset_px[near].ravel()
        # A trace keeps the roll at rest where all guides stand in one place.
        normal = A.T @ A + 1e-9 * float((A * A).sum()) * np.eye(3)
        turn_rad = np.linalg.solve(normal, A.T @ b)
        left_px = np.hypot(*(offset_px - J @ turn_rad).T)
        limit_px = min(max(4.0 * median(left_px[near]), 0.75), _NEIGHBOUR_PX)
        near = left_px < limit_px
    matched = int(np.count_nonzero(near))
    side_px = 2 * reach_px + 1
    expected = len(guides) * np.pi * limit_px**2 / side_px**2
    trials = (side_px / limit_px) ** 2
    # Three angles were fitted: two parameters can buy one match.
    if matched < 4 or pdtrc(matched - 3, expected) * trials > _CHANCE:
        raise lost
    return np.asarray(turn_rad)


def _fits(geometry: CameraGeometry, turn: Rotation, observations: StarObservations) -> bool:
    """Whether the stars stand where the camera shows them once it is turned."""
    bright = _bright(observations)
    camera_from_icrf = turn * _icrf_from_camera(geometry, observations).inv()
    directions = observations.direction_icrf[bright] @ camera_from_icrf.as_matrix().T
    off_px = observations.measured_px[bright] - project(geometry.camera, directions)
    return _rms_px(off_px) < _SYSTEMATIC_PX


def _corrected(geometry: CameraGeometry, observations: StarObservations) -> CameraGeometry:
    """The geometry turned to where this image shows its stars, its camera corrected if need be."""
    camera = geometry.camera
    icrf_from_camera = _icrf_from_camera(geometry, observations)
    directions = observations.direction_icrf @ icrf_from_camera.as_matrix()
    variance_px2 = 0.5 * (observations.covariance_px2[:, 0] + observations.covariance_px2[:, 2])
    bright = _bright(observations)
    directions, measured_px = directions[bright], observations.measured_px[bright]
    # No prediction needs to be better than a twentieth of a pixel.
    weight = 1.0 / (variance_px2[bright] + 0.05**2)
    off_px = measured_px - project(camera, directions)
    J = rotation_jacobian(camera, directions)
    step = _step(J, off_px, weight, np.zeros(3), np.zeros(3))
    turn = Rotation.from_rotvec(-step)
    left_px = off_px - J @ step
    if _rms_px(left_px) > _SYSTEMATIC_PX:
        camera, turn = _corrected_camera(camera, turn, directions, measured_px, weight)
    icrf_from_star_tracker = Rotation.from_quat(observations.icrf_from_star_tracker_xyzw)
    camera_from_star_tracker = turn * icrf_from_camera.inv() * icrf_from_star_tracker
    return CameraGeometry(camera, camera_from_star_tracker.inv().as_quat())


def _bright(observations: StarObservations) -> NDArray[np.bool_]:
    """Which stars (n,) correct a prediction: all, where there are too few bright ones."""
    bright = observations.snr > _GOOD_SNR
    return np.asarray(bright | (np.count_nonzero(bright) < 4))


def _icrf_from_camera(geometry: CameraGeometry, observations: StarObservations) -> Rotation:
    return Rotation.from_quat(observations.icrf_from_star_tracker_xyzw) * Rotation.from_quat(
        geometry.star_tracker_from_camera_xyzw
    )


def _rms_px(off_px: Floats) -> float:
    """Root mean square per axis of (n, 2), with what is beyond 3 px as 3 px."""
    return float(np.sqrt(np.mean(np.minimum(off_px**2, 9.0))))


def _corrected_camera(
    camera: CameraModel,
    turn: Rotation,
    directions: Floats,
    measured_px: Floats,
    weight: Floats,
) -> tuple[CameraModel, Rotation]:
    """Camera and turn that fit the stars of one image, held near what the camera was."""
    before = camera.parameters
    sigma = _CAMERA_SIGMA * np.r_[np.full(5, before[0]), np.ones(5)]
    held = np.r_[np.ones(10), np.zeros(3)]
    for _ in range(3):
        pixels, J_parameters, J_rotation = project_jacobians(camera, turn.apply(directions))
        J = np.concatenate([J_parameters * sigma, J_rotation], axis=-1)
        pull = np.r_[(before - camera.parameters) / sigma, np.zeros(3)]
        step = _step(J, measured_px - pixels, weight, held, pull)
        camera = dataclasses.replace(camera, parameters=camera.parameters + sigma * step[:10])
        turn = Rotation.from_rotvec(-step[10:]) * turn
    return camera, turn


def _step(J: Floats, residual_px: Floats, weight: Floats, held: Floats, pull: Floats) -> Floats:
    """Robust step (k,) of ``J`` (n, 2, k), with a prior of weight ``held`` (k,) at ``pull``."""
    off2 = weight * (residual_px**2).sum(axis=1)
    root = np.sqrt(weight) / (1.0 + off2 / max(9.0, 9.0 * median(off2)))
    A = (J * root[:, None, None]).reshape(-1, J.shape[-1])
    b = (residual_px * root[:, None]).ravel()
    return np.asarray(np.linalg.solve(A.T @ A + np.diag(held), A.T @ b + held * pull))
