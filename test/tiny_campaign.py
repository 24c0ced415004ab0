# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Small simulated campaign used by several tests."""

import functools
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.rendering import render
from starcal_ground.simulation.scenario import attitude_samples, scenario, scene
from starcal_ros.records import AttitudeSample, Ensemble, Image
from starcal_ros.sky.attitude import AttitudeHistory

SCENARIO = scenario('tiny', seed=7)
TRUTH = SCENARIO.truth


def values(camera_yaml: Path, **others: object) -> dict[str, object]:
    """Complete content of a parameter file."""
    return {
        'camera_info_url': str(camera_yaml),
        'prior_alignment': SCENARIO.prior.star_tracker_from_camera_xyzw.tolist(),
        'star_tracker_sigma_arcsec': [10.0, 10.0, 40.0],
        **others,
    }


@functools.cache
def ensemble() -> Ensemble:
    return true_observations(SCENARIO)


@functools.cache
def image(index: int = 1) -> Image:
    return render(SCENARIO, scene(SCENARIO, index), index)


def attitudes(*indices: int, turn: Rotation | None = None) -> AttitudeHistory:
    """Samples about images, number 1 by default; the star tracker may report a turn too much."""
    held = AttitudeHistory()
    for index in indices or (1,):
        for sample in attitude_samples(SCENARIO, index):
            if turn is not None:
                reported = Rotation.from_quat(sample.icrf_from_star_tracker_xyzw) * turn
                sample = AttitudeSample(sample.time_ns, reported.as_quat())
            held.add(sample.time_ns, sample)
    return held


def write_png(path: Path, pixels: np.ndarray) -> str:
    assert cv2.imwrite(str(path), pixels)
    return str(path)
