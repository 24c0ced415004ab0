# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Campaigns of random pointings with a fault of the lens, and whether their sigma is true."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.scenario import Inertial, Scenario, scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import Ensemble

WIDTH, HEIGHT = 1296, 1024


def of_random_pointings(seed: int, images: int = 12) -> Scenario:
    rng = np.random.default_rng([seed, 3])
    fields = np.stack(
        [
            rng.uniform(0.0, 360.0, images),
            np.degrees(np.arcsin(rng.uniform(-0.9, 0.9, images))),
            rng.uniform(0.0, 360.0, images),
        ],
        axis=-1,
    )
    pointing = Inertial(tuple((float(a), float(b), float(c)) for a, b, c in fields))
    return dataclasses.replace(
        scenario('small', seed), pointing=pointing, image_count=images, magnitude_limit=8.0
    )


def displaced(ensemble: Ensemble, move: Callable[[Floats], Floats]) -> Ensemble:
    images = tuple(
        dataclasses.replace(image, measured_px=image.measured_px + move(image.measured_px))
        for image in ensemble.images
    )
    return dataclasses.replace(ensemble, images=images)


def estimated(given: Scenario, ensemble: Ensemble, **options: object) -> Estimate:
    values: dict[str, object] = {'velocity_sigma_m_s': 10.0, **options}  # as with a topic
    changed = CalibrationOptions(
        star_tracker_sigma_arcsec=given.star_tracker_sigma_arcsec,
        **values,  # type: ignore[arg-type]
    )
    return estimate_calibration(ensemble, given.prior, changed)


def honesty(
    given: Scenario, found: Estimate, move: Callable[[Floats], Floats]
) -> tuple[float, float]:
    """Error of the lines of sight over the reported sigma, and the error, arcsec."""
    camera = given.truth.camera
    pixels = pixel_grid(camera, 25, 25)
    at = pixels
    for _ in range(30):  # a contraction: 0.3 px over hundreds of pixels
        at = pixels - move(at)
    true = line_of_sight(camera, at)
    table = line_of_sight_table(found.geometry.camera, found.map_covariance, pixels)
    rotation, _ = Rotation.align_vectors(true, table.direction_camera)
    error = np.linalg.norm(rotation.apply(table.direction_camera) - true, axis=1) / ARCSECOND_RAD
    rms = float(np.sqrt(np.mean(error**2)))
    return rms / float(np.sqrt(np.mean(table.shape_sigma_arcsec**2))), rms
