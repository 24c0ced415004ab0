# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Predicted pixels of catalog stars, and the smooth correction to the measured ones."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.polynomial.polynomial import polyvander2d
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices, Mask, rows_of
from starcal_ros.camera import before_fold, CameraModel, field_radius_rad, project
from starcal_ros.records import CameraGeometry
from starcal_ros.robust_statistics import median, medians, RAYLEIGH_TO_SIGMA
from starcal_ros.sky import astrometry
from starcal_ros.sky.astrometry import SiteOptions
from starcal_ros.sky.catalog import cone, StarCatalog

SPACE = SiteOptions()


@dataclass(frozen=True)
class Prediction:
    """
    Catalog stars in and near the image.

    ``catalog_index`` (n,) rows of the catalog, brightest first; ``direction_icrf`` (n, 3)
    apparent; ``direction_camera`` (n, 3); ``xy_px`` (n, 2) by ``camera``.
    """

    catalog_index: Indices
    direction_icrf: Floats
    direction_camera: Floats
    xy_px: Floats
    camera: CameraModel

    @property
    def px_per_rad(self) -> float:
        """Focal length."""
        return float(self.camera.parameters[0])

    def select(self, stars: Mask) -> Prediction:
        """Return the stars of a mask (n,)."""
        return rows_of(self, stars)


def predict(
    geometry: CameraGeometry,
    icrf_from_star_tracker_xyzw: Floats,
    time_ns: int,
    catalog: StarCatalog,
    magnitude_limit: float,
    margin_rad: float,
    velocity_m_s: Floats | None = None,
    site: SiteOptions = SPACE,
) -> Prediction:
    """
    Predicted catalog stars for an attitude, an alignment and a camera.

    Omits stars fainter than the magnitude limit and, on the ground, those below the elevation
    limit.  Includes stars up to ``margin_rad`` outside the image: acquisition may move them into
    it.
    """
    camera = geometry.camera
    icrf_from_camera = geometry.icrf_from_camera(icrf_from_star_tracker_xyzw)
    margin_px = margin_rad * float(camera.parameters[0])
    boresight_icrf = icrf_from_camera.apply([0.0, 0.0, 1.0])
    radius_rad = field_radius_rad(camera, margin_px)
    index = cone(catalog, boresight_icrf, radius_rad, magnitude_limit)
    index, direction_icrf = visible(catalog, index, time_ns, velocity_m_s, site)
    direction_camera = icrf_from_camera.inv().apply(direction_icrf)
    xy_px = project(camera, direction_camera)
    with np.errstate(invalid='ignore'):
        near = in_image(xy_px, camera, margin_px)
    # Far outside the image the distortion polynomial may fold back into it.
    near[near] = before_fold(camera, direction_camera[near])
    return Prediction(index, direction_icrf, direction_camera, xy_px, camera).select(near)


def deeper_stars(
    prediction: Prediction,
    near: Mask,
    reach_px: float,
    deeper: StarCatalog | None,
    time_ns: int,
    velocity_m_s: Floats | None,
    site: SiteOptions,
) -> tuple[Floats, Floats]:
    """
    Predicted pixels (k, 2) and magnitudes (k,) of fainter stars about some (n,) of a prediction.

    The prediction may have been corrected to an image: each follows its nearest star.
    """
    if deeper is None or np.count_nonzero(near) < 3:
        return np.empty((0, 2)), np.empty(0)
    camera, about = prediction.camera, prediction.select(near)
    index = deeper.near(about.direction_icrf, reach_px / about.px_per_rad)
    index, direction_icrf = visible(deeper, index, time_ns, velocity_m_s, site)
    camera_from_icrf, _ = Rotation.align_vectors(about.direction_camera, about.direction_icrf)
    direction_camera = camera_from_icrf.apply(direction_icrf.reshape(-1, 3))
    xy_px = project(camera, direction_camera)
    expected_px = project(camera, about.direction_camera)
    distance_px, nearest = cKDTree(expected_px).query(np.nan_to_num(xy_px, nan=-1e6))
    xy_px = xy_px + (about.xy_px - expected_px)[nearest]
    reached = distance_px < reach_px
    return xy_px[reached], deeper.magnitude[index][reached]


def visible(
    catalog: StarCatalog,
    index: NDArray[np.intp],
    time_ns: int,
    velocity_m_s: Floats | None,
    site: SiteOptions,
) -> tuple[NDArray[np.intp], Floats]:
    """Catalog rows (m,) above the elevation limit, and apparent ICRF directions (m, 3)."""
    if not site.is_known:
        return index, astrometry.apparent_directions(catalog, time_ns, velocity_m_s, index)
    direction_icrf, elevation_rad = astrometry.through_the_air(
        astrometry.apparent_directions(catalog, time_ns, rows=index), time_ns, site
    )
    high = elevation_rad >= math.radians(astrometry.MIN_ELEVATION_DEG)
    return index[high], direction_icrf[high]


def in_image(xy_px: Floats, camera: CameraModel, margin_px: float = 0.0) -> Mask:
    """Mask (n,) of the pixels (n, 2) inside the image widened by a margin."""
    u, v, m = xy_px[:, 0], xy_px[:, 1], margin_px
    return (u > -m) & (u < camera.width - 1 + m) & (v > -m) & (v < camera.height - 1 + m)


def window_area(camera: CameraModel, margin_px: float) -> float:
    """Area of the image widened by a margin, in areas of the image."""
    return (1.0 + 2.0 * margin_px / camera.width) * (1.0 + 2.0 * margin_px / camera.height)


def warp_degree(n: int) -> int:
    """Degree of the correction in u and v that n stars support."""
    return 5 if n >= 150 else 3 if n >= 36 else 1 if n >= 12 else 0


def polynomial_terms(uv: Floats, degree: int) -> Floats:
    """Products (n, t) of powers of u and v (n, 2) whose exponents add up to the degree at most."""
    i, j = np.indices((degree + 1, degree + 1)).reshape(2, -1)
    u, v = uv.T
    return np.asarray(polyvander2d(u, v, [degree, degree])[:, i + j <= degree])


def fit_warp(
    predicted_px: Floats, measured_px: Floats, sigma_px: Floats, at_px: Floats, half_px: float
) -> tuple[Floats, float]:
    """
    Smooth correction (k, 2) at ``at_px`` from predicted to measured pixels, and robust scatter.

    Robust fit of a polynomial in u and v, whose degree of 0 to 5 depends on the number of stars.
    It absorbs a distortion that the prior lacks, serves the search only and enters no observation.
    """
    n = len(predicted_px)

    def terms(xy_px: Floats) -> Floats:
        return polynomial_terms((xy_px - half_px) / half_px, warp_degree(n))

    A = terms(predicted_px)
    residual = measured_px - predicted_px
    coefficients: Floats = np.zeros((A.shape[1], 2))
    coefficients[0] = medians(residual)
    scatter = math.inf
    for _ in range(8):
        left = residual - A @ coefficients
        size = np.hypot(left[:, 0], left[:, 1])
        before = scatter
        scatter = max(median(size) * RAYLEIGH_TO_SIGMA, 0.01)
        spread2 = sigma_px**2 + scatter**2
        weight = 1.0 / spread2 / (1.0 + size**2 / (9.0 * spread2)) ** 2
        weighted = A.T * weight
        normal = weighted @ A
        # Powers up to 5 on -1 to 1 keep ten digits of the normal matrix; the damping bounds the
        # correction in corners without stars.
        normal.flat[:: len(normal) + 1] *= 1.0 + 1e-9
        coefficients = np.asarray(np.linalg.solve(normal, weighted @ residual))
        if abs(scatter - before) < 0.03 * scatter:
            break
    at = A if at_px is predicted_px else terms(at_px)
    return at @ coefficients, scatter
