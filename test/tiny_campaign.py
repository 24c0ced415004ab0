# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Small simulated campaign used by several tests."""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.rendering import render
from starcal_ground.simulation.scenario import attitude_samples, Scenario, scenario, scene
from starcal_ground.simulation.simulated_bag import write_bag
from starcal_ros.records import CameraGeometry, Ensemble, Image
from starcal_ros.sky.attitude import AttitudeHistory

SCENARIO = scenario('tiny', seed=7)
TRUTH = SCENARIO.truth


def with_wrong_prior(given: Scenario, turn_deg: float, focal: float = 1.0) -> Scenario:
    """A scenario whose prior is turned across the line of sight, and has another focal length."""
    camera, mounting = given.prior.camera, given.prior.star_tracker_from_camera
    fx, fy = focal * camera.parameters[[0, 2]]
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.array([0.8, 0.6, 0.0]))
    prior = CameraGeometry(camera.replace(fx=fx, fy=fy), (mounting * turn).as_quat())
    return dataclasses.replace(given, prior=prior)


def unsound_bag(folder: Path) -> Path:
    """A bag of whose images two match only with the calibration of the rest."""
    return write_bag(with_wrong_prior(SCENARIO, 1.0, 1.06), folder / 'bag').bag


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


def attitudes(index: int = 1) -> AttitudeHistory:
    held = AttitudeHistory()
    for sample in attitude_samples(SCENARIO, index):
        held.add(sample.time_ns, sample)
    return held


def write_png(path: Path, pixels: np.ndarray) -> str:
    assert cv2.imwrite(str(path), pixels)
    return str(path)
