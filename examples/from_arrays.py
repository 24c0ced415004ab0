# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calibrate a camera from numpy arrays: centroids, star directions and attitudes.

The arrays are simulated here, so that the result can be compared with the truth; yours come from
your own centroiding and star identification.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import starcal_ground

PRIOR_PARAMETERS = (1500.0, 0.0, 1500.0, 511.5, 383.5, 0.0, 0.0, 0.0, 0.0, 0.0)
TRUE_PARAMETERS = (1502.0, 0.1, 1501.0, 511.5, 383.5, -0.05, 0.08, 0.0, 2e-4, -1e-4)
CENTROID_SIGMA_PX = 0.1
STAR_TRACKER_SIGMA_ARCSEC = 10.0

Arrays = NDArray[np.float64]


def exposures(camera: starcal_ground.CameraModel, count: int) -> Iterator[tuple[Arrays, ...]]:
    """Yield centroids (n, 2), directions (n, 3) and attitude (4,) of simulated images."""
    rng = np.random.default_rng(1)
    camera_from_star_tracker = Rotation.from_euler('xyz', [40.0, -20.0, 30.0], degrees=True)
    for _ in range(count):
        camera_from_icrf = Rotation.random(random_state=rng)
        in_field = [0.35, 0.27, 0.0] * rng.uniform(-1.0, 1.0, (60, 3)) + [0.0, 0.0, 1.0]
        in_field /= np.linalg.norm(in_field, axis=1, keepdims=True)
        measured_px = starcal_ground.project(camera, in_field)
        measured_px += rng.normal(0.0, CENTROID_SIGMA_PX, measured_px.shape)
        error_rad = np.radians(rng.normal(0.0, STAR_TRACKER_SIGMA_ARCSEC, 3) / 3600.0)
        star_tracker_from_icrf = camera_from_star_tracker.inv() * camera_from_icrf
        attitude = star_tracker_from_icrf.inv() * Rotation.from_rotvec(error_rad)
        yield measured_px, camera_from_icrf.inv().apply(in_field), attitude.as_quat()


def main() -> None:
    """Calibrate, and print the result beside the truth."""
    truth = starcal_ground.CameraModel(1024, 768, np.array(TRUE_PARAMETERS))
    prior = starcal_ground.CameraGeometry(
        starcal_ground.CameraModel(1024, 768, np.array(PRIOR_PARAMETERS)),
        Rotation.from_euler('xyz', [40.01, -20.0, 30.0], degrees=True).inv().as_quat(),
    )
    covariance_px2 = CENTROID_SIGMA_PX**2 * np.eye(2)
    images = [
        starcal_ground.observations_of(
            prior.camera, k, measured_px, covariance_px2, direction_icrf, attitude_xyzw
        )
        for k, (measured_px, direction_icrf, attitude_xyzw) in enumerate(exposures(truth, 20))
    ]
    calibration = starcal_ground.calibrate(
        images, prior, star_tracker_sigma_arcsec=[STAR_TRACKER_SIGMA_ARCSEC] * 3
    )

    camera, sigma = calibration.geometry.camera, calibration.sigma
    print('accepted' if calibration.accepted else f'refused: {", ".join(calibration.reasons)}')
    for k, name in enumerate(camera.parameter_names):
        found, true = camera.parameters[k], truth.parameters[k]
        print(f'{name:<5} {found:12.6g}  sigma {sigma[k]:.2g}  truth {true:g}')
    corner = starcal_ground.lines_of_sight(calibration, [0.0, 0.0], frame='star_tracker')
    print('line of sight of pixel (0, 0) in the star tracker frame:', corner.round(6))


if __name__ == '__main__':
    main()
