# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""NASA GIANT 2.0: detection, identification with attitudes, and its calibration of the camera."""

from __future__ import annotations

from copy import deepcopy
import dataclasses
from datetime import datetime, timedelta
import functools
import importlib.util
import math
import sys
import types
from typing import Any

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from bench.frames import earth_velocity_m_s, Frame, history
from bench.peers.campaigns import Campaign, Result
from bench.table import timed
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import field_radius_rad
from starcal_ros.constants import AU_M
from starcal_ros.records import MapCovariance
from starcal_ros.sky.astrometry import tt_julian_date
from starcal_ros.sky.catalog import cone
from studies.trials import rms

INSTALLED = importlib.util.find_spec('giant') is not None
# Its names of the camera parameters, in the order of starcal.
_GIANT = ('fx', 'alpha', 'fy', 'px', 'py', 'k1', 'k2', 'k3', 'p1', 'p2')
_HELD: dict[str, tuple[str, ...]] = {'cx, cy free': (), 'cx, cy held': ('px', 'py')}
_LEAST_PARALLAX_RAD = 1e-12  # of stars without one: GIANT needs a distance
# Bright stars by RANSAC, then all of them, then with the camera found.
_PASSES: tuple[dict[str, Any], ...] = (
    {'max_magnitude': 6.5, 'tolerance': 20.0, 'ransac_tolerance': 5.0, 'max_combos': 500},
    {'max_magnitude': 9.0, 'tolerance': 5.0, 'max_combos': 0},
    {'max_magnitude': 9.0, 'tolerance': 1.5, 'max_combos': 0},
    {'max_magnitude': 9.0, 'tolerance': 1.5, 'max_combos': 0},
)


def _giant() -> Any:
    """The package, with an empty module for a matcher of images that nothing here uses."""
    name = 'giant.image_processing.feature_matchers.roma_matcher'
    matcher = types.ModuleType(name)
    matcher.RoMaFeatureMatcher = matcher.RoMaFeatureMatcherOptions = None  # type: ignore[attr-defined]
    sys.modules.setdefault(name, matcher)
    import giant.calibration

    return giant


def _model(campaign: Campaign, held: tuple[str, ...]) -> Any:
    """GIANT's Brown model, equal to starcal's, at the prior; each image has a rotation."""
    camera, images = campaign.scenario.prior.camera, len(campaign.ensemble.images)
    free = [name for name in _GIANT if name not in held]
    return _giant().camera_models.BrownModel(
        **dict(zip(_GIANT, camera.parameters.tolist(), strict=True)),
        n_rows=camera.height,
        n_cols=camera.width,
        field_of_view=math.degrees(field_radius_rad(camera, 50.0)),
        misalignment=[np.zeros(3) for _ in range(images)],
        estimation_parameters=[*free, 'multiple misalignments'],
    )


def _catalog(campaign: Campaign) -> Any:
    """The bundled catalog at the date of a campaign; GIANT applies parallax and aberration."""
    import pandas

    giant, stars = _giant(), campaign.setup.catalog
    day_jd, fraction = tt_julian_date(campaign.scenario.start_ns)
    years = 2000.0 + (day_jd - 2451545.0 + fraction) / 365.25 - stars.epoch_jyear
    east = stars.pm_ra_cosdec_rad_per_year / np.cos(stars.dec_rad)
    columns = giant.catalogs.meta_catalog.GIANT_COLUMNS
    table = pandas.DataFrame(0.0, index=range(len(stars)), columns=columns)
    table['ra'] = np.degrees(stars.ra_rad + years * east) % 360.0
    table['dec'] = np.degrees(stars.dec_rad + years * stars.pm_dec_rad_per_year)
    table['distance'] = AU_M / 1e3 / np.maximum(stars.parallax_rad, _LEAST_PARALLAX_RAD)
    table['mag'] = stars.magnitude

    class Bundled(giant.catalogs.meta_catalog.Catalog):  # type: ignore[misc,name-defined]
        """Stars about a direction."""

        def query_catalog(self, **asked: Any) -> Any:
            """Rows of GIANT's table."""
            axis = erfa.s2c(*np.radians(asked['search_center']))
            near = cone(stars, axis, math.radians(asked['search_radius']))
            return table.iloc[near[stars.magnitude[near] < asked['max_mag']]]

    return Bundled()


def _image(campaign: Campaign, frame: Frame) -> Any:
    """GIANT's image of a frame: attitude of the star tracker, prior alignment, velocity."""
    image, samples = frame
    xyzw, _ = history(samples).at(image.time_ns, 1.0)
    tracker_from_camera = campaign.scenario.prior.star_tracker_from_camera
    camera_from_icrf = (Rotation.from_quat(xyzw) * tracker_from_camera).inv()
    _, barycentric = erfa.epv00(*tt_julian_date(image.time_ns))
    return _giant().image.OpNavImage(
        image.pixels,
        observation_date=datetime(1970, 1, 1) + timedelta(microseconds=image.time_ns // 1000),
        rotation_inertial_to_camera=_giant().rotations.Rotation(camera_from_icrf.as_matrix()),
        position=barycentric['p'] * AU_M / 1e3,
        velocity=earth_velocity_m_s(image.time_ns) / 1e3,
        saturation=campaign.scenario.detector.full_dn,
        temperature=0.0,
        exposure_type='long',
    )


def _options() -> Any:
    """Options of the least squares; the defaults take rounding at a minimum for divergence."""
    geometric = _giant().calibration.estimators.geometric
    return geometric.IterativeNonlinearLstSqOptions(residual_rtol=1e-8)


def estimator(campaign: Campaign) -> list[Result]:
    """From stars to a camera; without weights, for which it needs a dense matrix of all stars."""
    case, results = campaign.case, []
    rotations = case.start.camera_from_icrf.as_matrix()
    directions = [
        rotation @ case.table.direction_icrf[stars].T
        for rotation, stars in zip(rotations, case.rows_of_images, strict=True)
    ]
    geometric = _giant().calibration.estimators.geometric
    for variant, held in _HELD.items():
        tool = geometric.IterativeNonlinearLSTSQ(_model(campaign, held), _options())
        tool.measurements, tool.camera_frame_directions = case.table.measured_px.T, directions
        tool.temperatures = [0.0] * len(directions)
        _, took_s = timed(tool.estimate)
        results.append(_result(campaign, variant, tool, took_s))
    return results


def whole(campaign: Campaign) -> list[Result]:
    """From images to a camera, with the principal point estimated and held."""
    images = [_image(campaign, frame) for frame in campaign.frames]
    catalog = _catalog(campaign)
    return [
        _result(
            campaign, name, *timed(functools.partial(_calibrated, campaign, images, catalog, held))
        )
        for name, held in _HELD.items()
    ]


def _calibrated(campaign: Campaign, images: list[Any], catalog: Any, held: tuple[str, ...]) -> Any:
    """GIANT's estimator after several passes of identification and calibration."""
    giant = _giant()
    camera = giant.camera.Camera(deepcopy(images), _model(campaign, held), parse_data=False)
    options = giant.calibration.CalibrationOptions()
    options.geometric_estimator_options = _options()
    options.star_id_options.catalog = catalog
    stars = options.point_of_interest_finder_options
    stars.point_spread_function = giant.point_spread_functions.IterativeGaussian
    stars.centroid_size = 2
    tool = giant.calibration.Calibration(camera, options)
    for number, chosen in enumerate(_PASSES):
        for name, value in chosen.items():
            setattr(tool.star_id, name, value)
        tool.id_stars()
        tool.estimate_attitude()
        if number:
            tool.remove_outliers()
            tool.estimate_geometric_calibration()
    return tool.geometric_estimator


def _result(campaign: Campaign, variant: str, found: Any, took_s: float) -> Result:
    """Camera of an estimator; its covariance, for errors of 1 px, is scaled by the residuals."""
    frames = sum(np.size(seen) > 0 for seen in found.camera_frame_directions)
    used = (frames, found.measurements.shape[1], took_s)
    if not found.successful:
        return Result(variant, np.full((len(campaign.pixels), 3), np.nan), *used)
    parameters = np.array([getattr(found.model, name) for name in _GIANT])
    camera = dataclasses.replace(campaign.scenario.prior.camera, parameters=parameters)
    rows = [k for k, name in enumerate(_GIANT) if name not in _HELD[variant]]
    freedom = found.measurements.size - len(found.model.state_vector)
    variance_px2 = float((found.postfit_residuals**2).sum()) / freedom
    matrix = np.zeros((13, 13))
    matrix[np.ix_(rows, rows)] = variance_px2 * found.postfit_covariance[: len(rows), : len(rows)]
    table = line_of_sight_table(camera, MapCovariance(matrix), campaign.pixels)
    return Result(variant, table.direction_camera, *used, rms(table.shape_sigma_arcsec))
