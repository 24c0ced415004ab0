# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Campaigns with a known truth, their estimates, and errors in the metric of the covariance."""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import fcntl
import functools
import hashlib
from pathlib import Path
import pickle
import shutil
import sys
from typing import Any

import cloudpickle  # type: ignore[import-untyped]
from geometries import turn_between  # type: ignore[import-not-found]
import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Inertial, Scenario, scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import CameraGeometry, Ensemble, StarObservations
from studies.worlds import Campaign, simulate, World

WIDTH, HEIGHT = 1296, 1024
ROOT = Path(__file__).parents[1]
ESTIMATES = ROOT / '.pytest_cache' / 'estimates'


def of_random_pointings(seed: int, images: int = 12) -> Scenario:
    """Return the small scenario with its images anywhere in the sky."""
    rng = np.random.default_rng([seed, 3])
    ra_deg = rng.uniform(0.0, 360.0, images)
    dec_deg = np.degrees(np.arcsin(rng.uniform(-0.9, 0.9, images)))
    roll_deg = rng.uniform(0.0, 360.0, images)
    pointing = Inertial(
        tuple(zip(ra_deg.tolist(), dec_deg.tolist(), roll_deg.tolist(), strict=True))
    )
    return dataclasses.replace(
        scenario('small', seed), pointing=pointing, image_count=images, magnitude_limit=8.0
    )


@functools.cache
def observed(seed: int, images: int = 12) -> tuple[Scenario, Ensemble]:
    """Return that scenario and its observations."""
    given = of_random_pointings(seed, images)
    return given, true_observations(given)


@functools.cache
def campaign(world: World, seed: int) -> Campaign:
    return simulate(world, seed)


def each_image(
    ensemble: Ensemble, change: Callable[[int, StarObservations], dict[str, Any]]
) -> Ensemble:
    """Return the ensemble with fields of its images changed, by their number and content."""
    images = enumerate(ensemble.images)
    return Ensemble(
        tuple(dataclasses.replace(image, **change(k, image)) for k, image in images),
        ensemble.refused,
    )


def displaced(ensemble: Ensemble, move: Callable[[Floats], Floats]) -> Ensemble:
    """Return the ensemble with its stars displaced by a function of their pixels (n, 2)."""
    return each_image(
        ensemble, lambda _, image: {'measured_px': image.measured_px + move(image.measured_px)}
    )


def with_noise(
    ensemble: Ensemble,
    seed: int,
    tracker_arcsec: tuple[float, ...],
    centroid_scale: float = 1.0,
) -> Ensemble:
    """Return the ensemble with errors of star tracker and centroids, so many times their sigma."""
    rng = np.random.default_rng(seed)

    def noisy(_: int, image: StarObservations) -> dict[str, Any]:
        uu, uv, vv = image.covariance_px2.T
        L = np.linalg.cholesky(np.array([[uu, uv], [uv, vv]]).transpose(2, 0, 1))
        n = centroid_scale * np.einsum('nij,nj->ni', L, rng.normal(size=(len(image), 2)))
        error = Rotation.from_rotvec(rng.normal(size=3) * tracker_arcsec * np.array(ARCSECOND_RAD))
        reported = Rotation.from_quat(image.icrf_from_star_tracker_xyzw) * error
        return {
            'measured_px': image.measured_px + n,
            'icrf_from_star_tracker_xyzw': reported.as_quat(),
        }

    return each_image(ensemble, noisy)


def options_of(given: Scenario, **options: Any) -> CalibrationOptions:
    """Return options with the star tracker of a scenario, unless another is named."""
    values = {'star_tracker_sigma_arcsec': given.star_tracker_sigma_arcsec, **options}
    return CalibrationOptions(**values)


def estimated(given: Scenario, ensemble: Ensemble, **options: object) -> Estimate:
    """Return the estimate of observations whose velocity is known, as with a topic."""
    values = {'velocity_sigma_m_s': 10.0, **options}
    return estimate_calibration(ensemble, given.prior, options_of(given, **values))


def estimate_of(made: Campaign, **options: object) -> Estimate:
    chosen = options_of(made.scenario, **options)
    return estimate_calibration(made.ensemble, made.scenario.prior, chosen)


def solved(world: World, seed: int, **options: object) -> Estimate:
    """Estimate of a world, made once for all workers until a source changes; not to be changed."""
    key = hashlib.sha256(pickle.dumps((world, seed, sorted(options.items())))).hexdigest()[:16]
    path = _folder_of_these_sources() / key
    with _locked(path.with_suffix('.lock')):
        if not path.exists():
            part = path.with_suffix('.part')
            part.write_bytes(cloudpickle.dumps(estimate_of(campaign(world, seed), **options)))
            part.rename(path)
    estimate: Estimate = pickle.loads(path.read_bytes())
    return estimate


@functools.cache
def _folder_of_these_sources() -> Path:
    """Folder of estimates by the sources; one other stays for a run that began before an edit."""
    digest = hashlib.sha256(f'{sys.version} {np.__version__} {scipy.__version__}'.encode())
    for folder in ('starcal_ros', 'starcal_ground/simulation', 'studies'):
        for path in sorted((ROOT / folder).rglob('*.py')):
            digest.update(path.read_bytes())
    kept = ESTIMATES / digest.hexdigest()[:16]
    ESTIMATES.mkdir(parents=True, exist_ok=True)
    with _locked(ESTIMATES / 'lock'):
        others = [one for one in ESTIMATES.iterdir() if one.is_dir() and one != kept]
        for old in sorted(others, key=lambda one: one.stat().st_mtime)[:-1]:
            shutil.rmtree(old)
        kept.mkdir(exist_ok=True)
    return kept


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Hold a lock that the system releases when its process ends."""
    with path.open('w') as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def errors_of(found: Estimate, truth: CameraGeometry) -> Floats:
    """Errors (p + 3,): of the camera parameters, and the passive turn of the camera frame, rad."""
    turn = -turn_between(found.geometry, truth).as_rotvec()
    return np.asarray(np.r_[found.geometry.camera.parameters - truth.camera.parameters, turn])


def normalised(error: Floats, covariance: Floats) -> float:
    """Squared length of an error in the metric of its covariance: chi squared."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    whitened = np.linalg.solve(np.linalg.cholesky(correlation), error / sigma)
    return float(whitened @ whitened)


def normalised_error(found: Estimate, truth: CameraGeometry, rows: Any) -> float:
    """Chi squared of some rows of the errors by the reported covariance."""
    at = np.arange(len(found.covariance))[rows]
    return normalised(errors_of(found, truth)[at], found.covariance[np.ix_(at, at)])


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
