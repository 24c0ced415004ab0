# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrations to export, with one property each that formats differ in."""

import dataclasses

import numpy as np
from sample_records import without_field  # type: ignore[import-not-found]

from starcal_ros.camera import CameraModel
from starcal_ros.camera.detector_field import DetectorField, term_count
from starcal_ros.records import (
    Calibration,
    CameraGeometry,
    factored_field,
    MapCovariance,
    TemperatureTerms,
)

_COEFFICIENTS = {
    'plumb_bob': [-0.051, 0.117, 0.01, 5.1e-4, 3.2e-4],
    'rational_polynomial': [0.21, 0.04, 0.01, 5.1e-4, 3.2e-4, 0.27, 0.02, 0.003],
    'thin_prism': [0.21, 0.04, 0.01, 5e-4, 3e-4, 0.27, 0.02, 0.003, 1e-3, -2e-4, 7e-4, 1e-4],
    'equidistant': [-0.02, 0.004, -0.001, 2e-4],
}
_TILTED = [*_COEFFICIENTS['thin_prism'], 0.01, -0.02]


def calibration(
    model: str = 'plumb_bob',
    skew: float = -0.74,
    with_field: bool = False,
    temperature: bool = False,
) -> Calibration:
    """A calibration of a lens model: 20 degrees wide."""
    coefficients = _TILTED if model == 'tilted' else _COEFFICIENTS[model]
    camera = CameraModel(
        1296, 1024, np.array([3641.5, skew, 3642.3, 651.25, 505.75, *coefficients]), model
    )
    p = len(camera.parameter_names) + 3
    made: Calibration = dataclasses.replace(
        without_field(),
        geometry=CameraGeometry(camera, unit([0.1, -0.7, 0.12, 0.69])),
        covariance=np.eye(p) * 1e-8,
        estimated=camera.parameter_names,
        temperature=TemperatureTerms(
            20.0, (4e-5, -6e-7), (1e-6, 1e-7), (1e-6, 2e-6, 3e-6), (1e-7,) * 3
        )
        if temperature
        else None,
        parent_frame='star_tracker',
        child_frame='camera_optical_frame',
    )
    if not with_field:
        return made
    t = term_count(1296, 1024, 2)
    field = DetectorField(1296, 1024, 2, np.random.default_rng(5).normal(0, 0.03, (2, t)))
    covariance = MapCovariance(np.eye(p + 2 * t) * 1e-8)
    return dataclasses.replace(made, field=factored_field(field, covariance))


def unit(xyzw: list[float]) -> np.ndarray:
    quaternion = np.array(xyzw)
    return np.asarray(quaternion / np.linalg.norm(quaternion))
