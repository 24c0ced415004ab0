# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Cameras of 0.3 to 110 degrees, rendered and calibrated with attitudes; narrow ones without, too.

Fields from 2.5 degrees show the sky of the bundled catalog, about 200 stars an image above the
limit of the detector and those below it, to V = 9.  Trails are those of a camera that turns by 6
px during each exposure, in an arbitrary direction.

The sky of a narrower field is that of the bundled catalog to V = 9, and below a draw with the mean
density of stars (Allen 2000, Astrophysical Quantities, section 19.2) in one region 10 degrees
wide, in which all images lie; the catalog file covers that region.  The mounting is off by 5
arcsec to 0.3 degrees, stated as its sigma.  From images alone the focal length is given to 10 %,
and the velocity.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from functools import partial
import math
from pathlib import Path
import subprocess
import tempfile
import time

import numpy as np
from scipy.spatial.transform import Rotation

from bench.frames import load_set_up, observed, render_frame
from bench.night_sky import calibrated, off_arcsec
from bench.peers import scamp
from bench.peers.campaigns import Campaign
from bench.table import Table
from bench.trials import bound_arcsec, shape_errors_arcsec
from starcal_ground.mission.ingest.deep_catalog import catalog_file, integer_columns
from starcal_ground.products import write_camera_info
from starcal_ground.simulation import centroids
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.deep_sky import deep_sky, disc, log10_density
from starcal_ground.simulation.scenario import Inertial, Scenario
from starcal_ros.assessment.lookup import GRID
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import StarcalError
from starcal_ros.pipeline import solve
from starcal_ros.records import Calibration, CameraGeometry, Ensemble
from starcal_ros.sky.catalog import BUNDLED_MAGNITUDE, load_catalog
from studies.trials import rms
from studies.workers import processors, run_each

SIZE, IMAGES, SEEDS = (800, 640), 14, 10
FIELDS_DEG = (0.3, 0.5, 1.0, 2.5, 5.0)  # of the width
WIDE_DEG = (10.0, 20.0, 40.0, 70.0, 110.0)
TRAIL_PX, TRAILED_DEG = 6.0, (*FIELDS_DEG[1:], 20.0)
_STARS, _STARS_OF_WIDE = 20, 200  # in a mean image
_CENTRE_SIGMA_PX = 0.03 * SIZE[0]  # prior of the principal point
_REGION_RAD = math.radians(5.0)
_BELOW_LIMIT_MAG = 1.0  # rendered and in the catalog, too faint to be measured
_MOST_MAG = 14.0
_LEAST_ELECTRONS = 200.0  # of the faintest star that is measured


def run(quick: bool) -> Iterator[Table]:
    """One line for each field, with attitudes, without, with trails; ten minutes or one."""
    kinds = [
        *((field_deg, blind, 0.0) for field_deg in FIELDS_DEG for blind in (False, True)),
        *((field_deg, False, 0.0) for field_deg in WIDE_DEG),
        *((field_deg, False, TRAIL_PX) for field_deg in TRAILED_DEG),
    ]
    kinds, seeds = (kinds[:2], 2) if quick else (kinds, SEEDS)
    columns = (
        'field deg, attitudes, trail px, accepted, of, error / bound, error / sigma, worst,'
        ' error arcsec, wrong stars, images, s an image, first reason'
    )
    table = Table(f'Narrow cameras, {IMAGES} images', columns.split(', '))
    for field_deg, blind, trail_px in kinds:
        of_seed = partial(trial, field_deg=field_deg, blind=blind, trail_px=trail_px)
        trials = run_each(of_seed, range(seeds), processors())
        good = np.array([one.numbers for one in trials if not one.reason])
        reason = next((one.reason for one in trials if one.reason), '')
        figures = good.reshape(-1, 6).T
        table.add(
            *(field_deg, 'none' if blind else 'given', trail_px, len(good), seeds),
            *(rms(figures[0]), rms(figures[1]), float(figures[1].max(initial=0.0))),
            *(rms(figures[2]), int(figures[3].sum()), float(figures[4].sum())),
            *(float(figures[5].mean()) if len(good) else math.nan, reason[:60]),
        )
        print(*table.rows[-1], flush=True)
    yield table
    if scamp.INSTALLED:
        yield _peer(seeds)
    else:
        print('Source Extractor and SCAMP are not installed: left out')


def _peer(seeds: int) -> Table:
    """Errors of SCAMP with the images and attitudes of `_with_attitudes`."""
    columns = ('field deg', 'solved', 'error / bound', 'median', 'heads', 'sources', 's an image')
    table = Table('Source Extractor and SCAMP, given attitudes', columns)
    for field_deg in FIELDS_DEG:
        trials = run_each(partial(by_scamp, field_deg=field_deg), range(seeds), processors())
        solved = np.array([row for row in trials if math.isfinite(row[0])]).reshape(-1, 4)
        if len(solved):
            means = np.mean(solved[:, 1:], axis=0).tolist()
            error = solved[:, 0]
            table.add(field_deg, len(solved), rms(error), float(np.median(error)), *means)
        else:
            table.add(field_deg, 0, *[math.nan] * 5)
        print(*table.rows[-1], flush=True)
    return table


def by_scamp(seed: int, field_deg: float) -> tuple[float, float, float, float]:
    """Error over bound of SCAMP (NaN: it failed), its images, sources and s an image."""
    given = scenario_of(field_deg, seed)
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        setup = load_set_up(given, **_write_catalog(given, Path(name)))
    frames = tuple(render_frame(given, index) for index in range(IMAGES))
    camera = given.truth.camera
    pixels = pixel_grid(camera, GRID, GRID)
    true = line_of_sight(camera, pixels)
    campaign = Campaign('narrow', given, setup, Ensemble(), pixels, true, frames)
    try:
        result = scamp.whole(campaign, 3.0 * mounting_sigma_rad(seed))
    except subprocess.SubprocessError:
        return math.nan, 0.0, 0.0, math.nan
    error_rad = rms(shape_errors_arcsec(true, result.directions)) * ARCSECOND_RAD
    error = error_rad * float(camera.parameters[0]) / bound_px(given)
    return error, float(result.frames), float(result.stars), result.processor_s / IMAGES


@dataclasses.dataclass(frozen=True)
class Trial:
    """Error over bound and sigma, error, stars wrong, images used, s an image; or a reason."""

    numbers: tuple[float, ...]
    reason: str = ''


def trial(seed: int, field_deg: float, blind: bool, trail_px: float) -> Trial:
    """The calibration of a camera against its truth."""
    given = scenario_of(field_deg, seed, trail_px)
    with tempfile.TemporaryDirectory(prefix='starcal_') as name:
        folder = Path(name)
        start_s = time.process_time()
        try:
            found, ensemble = (_from_images if blind else _with_attitudes)(given, folder)
        except StarcalError as error:
            return Trial((), f'{type(error).__name__}: {error}')
    took_s = (time.process_time() - start_s) / IMAGES
    true = given.truth.camera
    error_arcsec, sigma_arcsec = off_arcsec(found, true)
    numbers = (
        error_arcsec / (bound_px(given) / float(true.parameters[0]) / ARCSECOND_RAD),
        *(error_arcsec / sigma_arcsec, error_arcsec, float(wrong_stars(given, ensemble))),
        *(float(len(ensemble.images)), took_s),
    )
    return Trial(numbers, '' if found.accepted else found.reasons[0])


def scenario_of(field_deg: float, seed: int, trail_px: float = 0.0) -> Scenario:
    """A campaign of a camera of this width, whose mounting is off by what is stated."""
    rng = np.random.default_rng([seed, round(100 * field_deg)])
    fx = SIZE[0] / 2 / math.tan(math.radians(field_deg / 2))
    reach = 0.5 * math.hypot(*SIZE) / fx
    middle = (np.array(SIZE) - 1) / 2
    nominal = CameraModel(*SIZE, np.array([fx, 0.0, fx, *middle, 0.0, 0.0, 0.0, 0.0, 0.0]))
    focal_px = fx * (1.0 + rng.normal(0.0, 3e-3))
    true = nominal.replace(
        fx=focal_px,
        fy=focal_px * (1.0 + rng.normal(0.0, 3e-4)),
        cx=middle[0] + rng.normal(0.0, 5.0),
        cy=middle[1] + rng.normal(0.0, 5.0),
        k1=rng.normal(0.0, 3e-3) / reach**2,
    )
    per_deg2 = _STARS / (field_deg**2 * SIZE[1] / SIZE[0])
    depth = np.linspace(7.0, _MOST_MAG, 200)
    limit = float(np.interp(math.log10(per_deg2), log10_density(depth), depth))
    axis, sky = rng.normal(size=3), None
    axis /= np.linalg.norm(axis)
    if limit + _BELOW_LIMIT_MAG > BUNDLED_MAGNITUDE and field_deg < 2.0:
        sky = deep_sky(axis, _REGION_RAD, limit + _BELOW_LIMIT_MAG, rng)
    if sky is None:
        bundled = load_catalog(None, BUNDLED_MAGNITUDE - 0.1).magnitude
        in_sky = _STARS_OF_WIDE * 4.0 * math.pi / _solid_angle(nominal)
        limit = float(bundled[min(int(in_sky), len(bundled)) - 1])
    apart = disc(axis, IMAGES, 0.9 * _REGION_RAD if sky else math.pi, rng)
    ra_deg, dec_deg = (
        np.degrees(np.arctan2(apart[:, 1], apart[:, 0])),
        np.degrees(np.arcsin(apart[:, 2])),
    )
    attitudes = np.stack([ra_deg, dec_deg, rng.uniform(0.0, 360.0, IMAGES)], axis=-1)
    base = synthetic.scenario('small', seed)
    detector = dataclasses.replace(
        base.detector, zero_point_electrons=_LEAST_ELECTRONS * 10 ** (0.4 * limit), bits=14
    )
    off_rad = mounting_sigma_rad(seed) * rng.normal(size=3)
    along_rad = rng.uniform(0.0, 2.0 * math.pi)
    mounting = base.prior.star_tracker_from_camera
    return dataclasses.replace(
        base,
        truth=CameraGeometry(true, (mounting * Rotation.from_rotvec(off_rad)).as_quat()),
        prior=CameraGeometry(nominal, mounting.as_quat()),
        detector=detector,
        star_tracker_sigma_arcsec=(5.0, 5.0, 20.0),
        pointing=Inertial(tuple((a, b, c) for a, b, c in attitudes.tolist())),
        image_count=IMAGES,
        magnitude_limit=limit + _BELOW_LIMIT_MAG if sky else BUNDLED_MAGNITUDE,
        sky=sky,
        turn_rad=tuple(
            (trail_px / fx * np.array([math.cos(along_rad), math.sin(along_rad), 0.0])).tolist()
        ),
    )


def mounting_sigma_rad(seed: int) -> float:
    """1-sigma of the mounting of a seed: 5 arcsec to 0.3 degrees."""
    return float(np.geomspace(5.0, 1080.0, SEEDS)[seed % SEEDS]) * ARCSECOND_RAD


def _solid_angle(camera: CameraModel) -> float:
    """Solid angle, sr, of the field of a camera without distortion."""
    u, v = 0.5 * camera.width / camera.parameters[0], 0.5 * camera.height / camera.parameters[0]
    return 4.0 * math.asin(u * v / math.sqrt((1.0 + u * u) * (1.0 + v * v)))


def _write_catalog(given: Scenario, folder: Path) -> dict[str, object]:
    """Options of the sky of a scenario, whose catalog is written to a folder."""
    limit = 2.5 * math.log10(given.detector.zero_point_electrons / _LEAST_ELECTRONS)
    values: dict[str, object] = {
        'magnitude_limit': min(limit + _BELOW_LIMIT_MAG, given.magnitude_limit)
    }
    if given.sky is not None:
        path = folder / 'catalog.npz'
        path.write_bytes(catalog_file(integer_columns(vars(given.sky))))
        values['catalog'] = str(path)
    return values


def _with_attitudes(given: Scenario, folder: Path) -> tuple[Calibration, Ensemble]:
    """Calibration by the attitudes of the star tracker, and its ensemble."""
    sigma_deg = math.degrees(mounting_sigma_rad(given.seed))
    values = _write_catalog(given, folder)
    setup = load_set_up(given, prior_alignment_sigma_deg=sigma_deg, **values)
    frames = (render_frame(given, index) for index in range(IMAGES))
    ensemble = observed(frames, setup)
    return solve.solve(ensemble, setup), ensemble


def _from_images(given: Scenario, folder: Path) -> tuple[Calibration, Ensemble]:
    """Calibration from a bag of the images alone, the focal length given to 10 %."""
    rng = np.random.default_rng(given.seed)
    fx = float(given.prior.camera.parameters[0]) * (1.0 + rng.uniform(-0.1, 0.1))
    camera = folder / 'camera.yaml'
    write_camera_info(given.prior.camera.replace(fx=fx, fy=fx), camera)
    values = {**_write_catalog(given, folder), 'camera_info_url': f'file://{camera}'}
    campaign = calibrated(given, folder, values, has_velocity=True)
    return campaign.calibration, campaign.ensemble


def bound_px(given: Scenario) -> float:
    """Cramer-Rao bound of the rms error of the lines of sight, px."""
    camera = given.truth.camera
    information = centroids.scenario_information(given, range(len(camera.parameters)))
    focal_px = float(camera.parameters[0])
    return bound_arcsec(camera, information, _CENTRE_SIGMA_PX) * ARCSECOND_RAD * focal_px


def wrong_stars(given: Scenario, ensemble: Ensemble) -> int:
    """Number of stars measured more than 3 px from where they are."""
    index = {given.time_ns(k): k for k in range(given.image_count)}
    wrong = 0
    for image in ensemble.images:
        shown = synthetic.scene(given, index[image.time_ns])
        place = dict(zip(shown.catalog_id.tolist(), shown.pixel_px, strict=True))
        for star, xy_px in zip(image.catalog_id.tolist(), image.measured_px, strict=True):
            wrong += star not in place or bool(np.hypot(*(xy_px - place[star])) > 3.0)
    return wrong
