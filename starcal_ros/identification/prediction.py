"""Where the stars of the catalog fall: through attitude, alignment and camera to pixels."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.camera import field_radius_rad, line_of_sight, project
from starcal_ros.records import CameraGeometry
from starcal_ros.sky.astrometry import apparent_directions, SiteOptions, through_the_air
from starcal_ros.sky.catalog import cone, StarCatalog

SPACE = SiteOptions()


@dataclass(frozen=True)
class Prediction:
    """
    Catalog stars in and about the image.

    ``catalog_index`` (n,) rows of the catalog, brightest first; ``direction_icrf`` (n, 3),
    apparent; ``direction_camera`` (n, 3); ``xy_px`` (n, 2); ``px_per_rad`` the
    scale of the image, its focal length.
    """

    catalog_index: NDArray[np.int64]
    direction_icrf: Floats
    direction_camera: Floats
    xy_px: Floats
    px_per_rad: float


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
    Apparent catalog stars where attitude, alignment and camera put them.

    Those fainter than a magnitude are left out, and those too near to the horizon of a site;
    stars outside the image are kept up to ``margin_rad``, as far as acquisition may bring them in.
    """
    camera = geometry.camera
    icrf_from_camera = Rotation.from_quat(icrf_from_star_tracker_xyzw) * Rotation.from_quat(
        geometry.star_tracker_from_camera_xyzw
    )
    margin_px = margin_rad * float(camera.parameters[0])
    boresight_icrf = icrf_from_camera.apply([0.0, 0.0, 1.0])
    radius_rad = field_radius_rad(camera, margin_px)
    index = cone(catalog, boresight_icrf, radius_rad, magnitude_limit)
    index = index[np.argsort(catalog.magnitude[index], kind='stable')]
    index, direction_icrf = seen(catalog, index, time_ns, velocity_m_s, site)
    direction_camera = icrf_from_camera.inv().apply(direction_icrf)
    xy_px = project(camera, direction_camera)
    with np.errstate(invalid='ignore'):
        # A distortion polynomial folds over far outside: only what the inverse leads back is real.
        near = in_image(xy_px, camera.width, camera.height, margin_px)
    near[near] &= np.einsum(
        'ij,ij->i', line_of_sight(camera, xy_px[near]), direction_camera[near]
    ) > np.cos(1e-6)
    return Prediction(
        index[near],
        direction_icrf[near],
        direction_camera[near],
        xy_px[near],
        float(camera.parameters[0]),
    )


def seen(
    catalog: StarCatalog,
    index: NDArray[np.intp],
    time_ns: int,
    velocity_m_s: Floats | None,
    site: SiteOptions,
) -> tuple[NDArray[np.intp], Floats]:
    """Those rows (m,) of the catalog that the observer can see, and where (m, 3), ICRF axes."""
    if site.observer != 'ground':
        return index, apparent_directions(catalog.select(index), time_ns, velocity_m_s)
    direction_icrf, elevation_rad = through_the_air(
        apparent_directions(catalog.select(index), time_ns), time_ns, site
    )
    high = elevation_rad >= math.radians(site.min_elevation_deg)
    return index[high], direction_icrf[high]


def in_image(xy_px: Floats, width: int, height: int, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """Whether (n,) pixels lie in the image widened by a margin."""
    u, v, m = xy_px[:, 0], xy_px[:, 1], margin_px
    return (u > -m) & (u < width - 1 + m) & (v > -m) & (v < height - 1 + m)


def within_image(prediction: Prediction, width: int, height: int) -> Prediction:
    """Those of the predicted stars that fall into the image."""
    inside = in_image(prediction.xy_px, width, height)
    return Prediction(
        prediction.catalog_index[inside],
        prediction.direction_icrf[inside],
        prediction.direction_camera[inside],
        prediction.xy_px[inside],
        prediction.px_per_rad,
    )
