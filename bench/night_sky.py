# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Simulated cameras of 5 to 120 degrees, calibrated from their images alone.

Field, lens model and its coefficients, principal point and pointings are random, seeds are fixed.
Nothing is stated: no attitudes, focal length, lens model, site or velocity.  A camera is wrong
where its lines of sight are off by more than five of their sigmas, and accepted.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
import math
from pathlib import Path
import tempfile
import time

import numpy as np

from bench.frames import earth_velocity_m_s
from bench.table import Table
from bench.trials import shape_errors_arcsec
from starcal_ground.bag_writer import BagWriter
from starcal_ground.bags.topics import Topics
from starcal_ground.campaign import calibrate, Campaign, chosen, observe
from starcal_ground.images import night_sky
from starcal_ground.simulation.rendering import images
from starcal_ground.simulation.scenario import Inertial, Scenario, scenario
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid
from starcal_ros.camera.lens import LENSES
from starcal_ros.errors import StarcalError
from starcal_ros.records import Calibration, CameraGeometry
from studies.trials import rms

SIZE, IMAGES, CAMERAS = (800, 640), 12, 200
FIELDS_DEG = (5.0, 120.0)  # of the diagonal
WRONG = 5.0  # in sigma
_COLUMNS = ('camera', 'model', 'field deg', 'outcome', 'error arcsec', 'over sigma', 's')


def run(quick: bool) -> Iterator[Table]:
    """One line for each camera, and their sum; twenty minutes, or one."""
    count = 4 if quick else CAMERAS
    table = Table('Cameras calibrated from images alone', _COLUMNS)
    ratios: list[float] = []
    wrong = 0
    for seed in range(count):
        given, half_deg = camera_of(seed)
        start_s = time.process_time()
        error, sigma, outcome = math.nan, math.nan, ''
        try:
            with tempfile.TemporaryDirectory(prefix='starcal_') as folder:
                found = calibrated(given, Path(folder), {}).calibration
            error, sigma = off_arcsec(found, given.truth.camera)
            outcome = 'accepted' if found.accepted else f'refused: {found.reasons[0][:60]}'
            wrong += found.accepted and error > WRONG * sigma
            ratios += [error / sigma] if found.accepted else []
        except StarcalError as failure:
            outcome = f'failed: {str(failure)[:60]}'
        took_s = time.process_time() - start_s
        model = given.truth.camera.model
        table.add(seed, model, 2 * half_deg, outcome, error, error / sigma, took_s)
        print(*table.rows[-1], flush=True)
    total = Table('Sum', ('cameras', 'accepted', 'wrong', 'error / sigma rms'))
    total.add(count, len(ratios), wrong, rms(ratios))
    yield table
    yield total


def camera_of(seed: int) -> tuple[Scenario, float]:
    """A campaign of a random camera, and half of its diagonal, degrees."""
    rng = np.random.default_rng([seed, 28])
    half_deg = 0.5 * math.exp(rng.uniform(*np.log(FIELDS_DEG)))
    model = list(LENSES)[seed % len(LENSES)]
    half_px = 0.5 * math.hypot(*SIZE)
    is_fisheye = model == 'equidistant'
    reach = math.radians(half_deg) if is_fisheye else math.tan(math.radians(half_deg))
    fx = half_px / reach
    middle = (np.array(SIZE) - 1) / 2 + rng.normal(0.0, 0.01 * SIZE[0], 2)
    part = rng.uniform(-0.03, 0.03) / reach**2
    values = {
        'k1': part,
        'k2': rng.normal(0.0, 0.003) / reach**4,
        'p1': rng.normal(0.0, 0.0005) / reach,
        'p2': rng.normal(0.0, 0.0005) / reach,
        'k4': rng.uniform(0.0, 0.01) / reach**2 if not is_fisheye else 0.0,
        's1': rng.normal(0.0, 0.0005) / reach,
        's3': rng.normal(0.0, 0.0005) / reach,
        'tau_x': rng.normal(0.0, 0.002),
        'tau_y': rng.normal(0.0, 0.002),
    }
    lens = [values.get(name, 0.0) for name in LENSES[model].coefficients]
    fy = fx * (1.0 + rng.normal(0.0, 3e-4))
    camera = CameraModel(*SIZE, np.array([fx, 0.0, fy, *middle, *lens]), model)
    ra_deg, z = rng.uniform(0.0, 360.0, IMAGES), rng.uniform(-1.0, 1.0, IMAGES)
    fields = np.stack([ra_deg, np.degrees(np.arcsin(z)), rng.uniform(0.0, 360.0, IMAGES)], axis=-1)
    # A hundred stars an image, or all of the catalog.
    limit = float(np.clip(8.9 - 3.3 * math.log10(half_deg / 4.0), 4.8, 8.9))
    base = scenario('small', seed)
    detector = dataclasses.replace(
        base.detector, zero_point_electrons=500.0 * 10 ** (0.4 * limit), cosmic_rays=0.0
    )
    pointing = Inertial(tuple((a, b, c) for a, b, c in fields.tolist()))
    truth = CameraGeometry(camera, np.array([0.0, 0.0, 0.0, 1.0]))
    return dataclasses.replace(
        base,
        truth=truth,
        prior=truth,
        detector=detector,
        pointing=pointing,
        image_count=IMAGES,
        magnitude_limit=9.0,
    ), half_deg


def calibrated(
    given: Scenario, folder: Path, options: dict[str, object], has_velocity: bool = False
) -> Campaign:
    """The campaign of a bag, in a folder, of the images alone or with the velocity then."""
    bag = folder / 'images.mcap'
    with BagWriter(bag) as writer:
        for image in images(given):
            if has_velocity:
                velocity_m_s = earth_velocity_m_s(image.time_ns)
                writer.write_velocity('/spacecraft/velocity', image.time_ns, velocity_m_s, 'icrf')
            writer.write_image('/camera/image_raw', image, 'camera')
    found = night_sky.from_bags([bag], Topics(), options, folder)
    return calibrate(observe(chosen(found)))


def off_arcsec(found: Calibration, truth: CameraModel) -> tuple[float, float]:
    """RMS error of the lines of sight, common rotation removed, and their 1-sigma, arcsec."""
    pixels = pixel_grid(truth, 15, 15)
    mine = line_of_sight_table(found.geometry.camera, found.map_covariance, pixels)
    error_arcsec = rms(shape_errors_arcsec(line_of_sight(truth, pixels), mine.direction_camera))
    return error_arcsec, rms(mine.shape_sigma_arcsec)
