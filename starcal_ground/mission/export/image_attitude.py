# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The attitude of an image by its own stars, as a calibrated camera shows them."""

from __future__ import annotations

from dataclasses import dataclass

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


@dataclass(frozen=True)
class StarAttitude:
    """
    Attitude of an image by its stars.

    ``covariance_px2`` (3, 3) of its angles about the axes of the ICRF, in pixels at the centre, is
    that by the noise of the stars.  ``own_px2`` is the variance per axis that they show beyond it:
    of a camera that changes from image to image, or a shutter that rolls.
    """

    icrf_from_camera: Rotation
    covariance_px2: Floats
    own_px2: float

    @property
    def sigma_px(self) -> float:
        """
        1-sigma about an axis across the boresight.

        What the image has of its own may displace all of its stars together.
        """
        across_px2 = np.sort(np.linalg.eigvalsh(self.covariance_px2))[:2].mean()
        return float(np.sqrt(across_px2 + self.own_px2))


def attitude_by_stars(calibration: Calibration, image: StarObservations) -> StarAttitude | None:
    """
    Attitude of an image, its stars weighted as in the calibration.

    None for an image that was refused or has fewer than three stars.
    """
    if image.refusal or len(image) < _LEAST_STARS:
        return None
    camera, towards = camera_of_image(calibration, image), image.direction_icrf
    measured = line_of_sight(camera, image.measured_px)
    variance_px2 = calibration.centroid_scale * image.covariance_px2[:, [0, 2]].mean(axis=1)
    variance_px2 += calibration.centroid_floor_px**2
    used: Mask = np.asarray(np.isfinite(measured).all(axis=1))
    for _ in range(2):  # the second without the stars that the first does not fit
        if used.sum() < _LEAST_STARS:
            return None
        rotation, _ = Rotation.align_vectors(
            towards[used], measured[used], 1.0 / variance_px2[used]
        )
        off = np.linalg.norm(rotation.apply(measured) - towards, axis=1) * camera.parameters[0]
        fitted = used.copy()
        used[used] = without_outliers((off / np.sqrt(variance_px2))[used])
    weight, along = fitted / variance_px2, np.einsum('ni,nj->nij', towards, towards)
    information = np.einsum('n,nij->ij', weight, np.eye(3) - along)
    # Three angles of two components of each star follow its residual.
    freedom = 2.0 - 3.0 / np.count_nonzero(used)
    beyond_px2 = off[used] ** 2 / freedom - variance_px2[used]
    own_px2 = max(float(np.average(beyond_px2, weights=1.0 / variance_px2[used])), 0.0)
    return StarAttitude(rotation, np.linalg.inv(information), own_px2)
