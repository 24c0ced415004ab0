# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""tetra3rs: detection, identification by patterns, and its calibration of the camera."""

from __future__ import annotations

import functools
import importlib.util
import math
from typing import Any

import numpy as np

from bench.frames import earth_velocity_m_s
from bench.peers.campaigns import Campaign, Result
from bench.table import timed
from starcal_ros.arrays import Pixels
from starcal_ros.camera import CameraModel

INSTALLED = importlib.util.find_spec('tetra3rs') is not None
_MODELS: list[dict[str, Any]] = [{'model': 'polynomial', 'order': k} for k in (3, 4, 5, 6)]
_MODELS += [{'model': 'radial'}]
# Best of those tried: the default of 5 sigma finds twice the stars, for errors 10 % larger.
_DETECTION = {'sigma_threshold': 10.0, 'matched_filter_sigma': 0.95, 'deblend': 'reject'}


def _width_deg(camera: CameraModel) -> float:
    """Horizontal field of view of a camera without distortion."""
    return math.degrees(2.0 * math.atan(0.5 * camera.width / camera.parameters[0]))


@functools.lru_cache(maxsize=1)
def _index(field_deg: float) -> Any:
    """Index of the sky for a field of view; made once."""
    import tetra3rs

    fields: dict[str, Any] = {'min_fov_deg': 0.9 * field_deg, 'max_fov_deg': 1.1 * field_deg}
    stars: dict[str, Any] = {'star_max_magnitude': 9.0, 'epoch_proper_motion_year': 2026.5}
    return tetra3rs.SolverDatabase.generate_from_gaia(**fields, **stars)


def _centroids(pixels: Pixels, **options: Any) -> Any:
    """Stars of a frame, found in one thread."""
    import tetra3rs

    return tetra3rs.extract_centroids(np.asarray(pixels), threads=1, **options).centroids


def whole(campaign: Campaign) -> list[Result]:
    """From images to a camera by each model."""
    prior, results = campaign.scenario.prior.camera, []
    _index(_width_deg(prior))  # exists before the time is taken
    middle_px = np.array([prior.width - 1, prior.height - 1]) / 2.0  # its pixels count from there
    for model in _MODELS:
        (fit, frames), took_s = timed(functools.partial(_calibrate, campaign, model))
        points = [fit.camera_model.pixel_to_tanplane(*at) for at in campaign.pixels - middle_px]
        used = (np.insert(points, 2, 1.0, axis=1), frames, fit.n_inliers)
        results.append(Result(' '.join(map(str, model.values())), *used, took_s))
    return results


def _calibrate(campaign: Campaign, model: dict[str, Any]) -> tuple[Any, int]:
    """Fit and number of frames identified; the second round starts with the camera found."""
    prior, fit = campaign.scenario.prior.camera, None
    field_deg, shape = _width_deg(prior), (prior.height, prior.width)
    options = {'fov_estimate_deg': field_deg, 'image_shape': shape}
    stars = [_centroids(image.pixels, **_DETECTION) for image, _ in campaign.frames]
    for _ in range(2):
        solved = [
            _index(field_deg).solve_from_centroids(
                found,
                **options,
                camera_model=fit and fit.camera_model,
                observer_velocity_km_s=list(earth_velocity_m_s(image.time_ns) / 1e3),
            )
            for found, (image, _) in zip(stars, campaign.frames, strict=True)
        ]
        fit = _index(field_deg).calibrate_camera(solved, stars, image_shape=shape, **model)
    return fit, sum(map(bool, solved))


def identified(campaign: Campaign) -> tuple[int, int]:
    """Number of frames found, and of stars matched, with its default options."""
    field_deg = _width_deg(campaign.scenario.truth.camera)
    solve = functools.partial(_index(field_deg).solve_from_centroids, fov_estimate_deg=field_deg)
    images = [image.pixels for image, _ in campaign.frames]
    found = [solve(_centroids(pixels), image_shape=pixels.shape) for pixels in images]
    return sum(map(bool, found)), sum(len(one.matched_catalog_ids) for one in found if one)
