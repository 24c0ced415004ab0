# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
One camera for several images that were identified without attitude.

An image by itself cannot tell a rotation from a shift of the principal point; several share it,
and in a wide field its second order shows.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.blind.search import mirrored_camera, SkyMatch
from starcal_ground.blind.sky_fit import moved, prior_equations, star_equations, STATED
from starcal_ros.camera import CameraModel
from starcal_ros.robust_statistics import MAD_TO_SIGMA
from starcal_ros.sky.catalog import StarCatalog

_MOST_STEPS = 20
_CONVERGED_PX = 0.02  # last step: a tenth of the error of the centroid of a bright source
_LEAST_PX = 0.1  # scatter of a source about its star: centroids are no better


@dataclass(frozen=True)
class CommonCamera:
    """Camera of all images, rotations ``camera_from_icrf``, sigma of its principal point."""

    camera: CameraModel
    camera_from_icrf: Rotation
    centre_sigma_px: tuple[float, float]


def common_camera(
    skies: Sequence[SkyMatch], prior: CameraModel, catalog: StarCatalog, centre: float
) -> CommonCamera:
    """
    The camera that fits the stars of all images; ``centre`` is the range of its centre, widths.

    The distortion is free within the range of the search.  Prior and result are of the images as
    they are given, the rotations of those mirrored back.
    """
    is_mirrored = skies[0].mirrored
    prior = mirrored_camera(prior) if is_mirrored else prior
    ranges = dataclasses.replace(STATED, centre=centre)
    parameters = np.median([sky.camera.parameters for sky in skies], axis=0)
    # It starts where the prior is: a step that the prior forbids would be taken back slowly.
    parameters[3:5] = prior.parameters[3:5]
    camera = dataclasses.replace(skies[0].camera, parameters=parameters)
    prior = prior.replace(fx=float(parameters[0]), fy=float(parameters[2]))
    rotations = [sky.camera_from_icrf for sky in skies]
    stars = [catalog.direction_icrs[sky.catalog_index] for sky in skies]
    scatter_px = 1.0
    for _ in range(_MOST_STEPS):
        equations = [
            star_equations(camera, rotation, directions, sky.camera_px, scatter_px)
            for rotation, directions, sky in zip(rotations, stars, skies, strict=True)
        ]
        residual_px = np.concatenate([residual for _, _, residual in equations], axis=1)
        # The rotation of each image is eliminated.
        held, right = prior_equations(camera, prior, ranges)
        N_camera = np.diag(held)
        for N, b, _ in equations:
            eliminated = np.linalg.solve(N[:3, :3], np.column_stack([N[:3, 3:], b[:3]]))
            N_camera += N[3:, 3:] - N[3:, :3] @ eliminated[:, :4]
            right = right + b[3:] - N[3:, :3] @ eliminated[:, 4]
        step = np.linalg.solve(N_camera, right).astype(np.float64)
        turns = [-np.linalg.solve(N[:3, :3], b[:3] - N[:3, 3:] @ step) for N, b, _ in equations]
        rotations = [
            Rotation.from_rotvec(turn) * rotation
            for turn, rotation in zip(turns, rotations, strict=True)
        ]
        camera = moved(camera, prior, step, prior.width)
        scatter_px = max(_LEAST_PX, MAD_TO_SIGMA * float(np.median(np.abs(residual_px))))
        turned_px = float(camera.parameters[0]) * float(np.abs(turns).max())
        if max(abs(step[1]), abs(step[2]), turned_px) < _CONVERGED_PX:
            break
    covariance = np.linalg.inv(N_camera)
    sigma_px = (math.sqrt(covariance[1, 1]), math.sqrt(covariance[2, 2]))
    camera = mirrored_camera(camera) if is_mirrored else camera
    return CommonCamera(camera, Rotation.concatenate(rotations), sigma_px)
