# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The attitude of an image by its own stars, as a calibrated camera shows them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import CameraModel, line_of_sight
from starcal_ros.estimation.problem import camera_at
from starcal_ros.records import Calibration, StarObservations
from starcal_ros.robust_statistics import RAYLEIGH_TO_SIGMA

_LEAST_STARS = 3
_OUTLIER = 4.5  # sigma, of the median: as `outlier_sigma` of a calibration by default


def camera_of_image(calibration: Calibration, image: StarObservations) -> CameraModel:
    """Camera at the temperature of an image; the calibration's own where that is not known."""
    degc = image.temperature_degc
    return (camera_at(calibration, degc) if np.isfinite(degc) else calibration.geometry).camera


def without_outliers(distance: Floats) -> Mask:
    """Mask (n,) of the distances from a fit that are within 4.5 sigma by their median."""
    return np.asarray(distance <= _OUTLIER * RAYLEIGH_TO_SIGMA * np.median(distance))


def attitude_by_stars(
    calibration: Calibration, image: StarObservations
) -> tuple[Rotation, float] | None:
    """
    Attitude icrf_from_camera of an image, and its 1-sigma across the boresight in px.

    None for an image that was refused or has fewer than three stars.
    """
    if image.refusal or len(image) < _LEAST_STARS:
        return None
    measured = line_of_sight(camera_of_image(calibration, image), image.measured_px)
    information = 1.0 / image.covariance_px2[:, [0, 2]].mean(axis=1)
    used: Mask = np.asarray(np.isfinite(measured).all(axis=1))
    for _ in range(2):  # the second without the stars that the first does not fit
        if used.sum() < _LEAST_STARS:
            return None
        rotation, _ = Rotation.align_vectors(
            image.direction_icrf[used], measured[used], information[used]
        )
        off = np.linalg.norm(rotation.apply(measured) - image.direction_icrf, axis=1)
        used[used] = without_outliers((off * np.sqrt(information))[used])
    return rotation, float(1.0 / np.sqrt(information[used].sum()))
