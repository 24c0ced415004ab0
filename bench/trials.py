# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Trials on all processors, and the error of a calibration over its reported 1-sigma."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
import contextlib
from dataclasses import dataclass, field
import math
import multiprocessing
import os
from pathlib import Path
import time
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import scaled_inverse
from starcal_ros.arrays import Floats, Mask
from starcal_ros.assessment.lookup import GRID, grid_derivatives, line_of_sight_table, sigma_arcsec
from starcal_ros.camera import CameraModel, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import TooFewObservations
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.solve import solve
from starcal_ros.records import CameraGeometry, Ensemble, MapCovariance
from studies.trials import rms
from studies.workers import processors
from studies.worlds import unit

ResultT = TypeVar('ResultT')


@dataclass(frozen=True)
class Score:
    """
    Verdict of the gate on one calibration, and its errors over their reported 1-sigma.

    ``shape``: lines of sight over the detector in the camera frame, the common rotation removed,
    rms; ``shape_arcsec`` the error, ``sigma_arcsec`` its 1-sigma, ``bound_arcsec`` the Cramer-Rao
    bound of that.  ``pointing``: lines of sight in the star tracker frame.  ``z`` has the errors
    of single angles over their 1-sigma: of the shape at the centre and in the corners of the
    detector, and of the pointing.
    """

    accepted: bool
    reasons: tuple[str, ...]
    termination: str = ''
    iterations: int = 0
    shape: float = math.nan
    pointing: float = math.nan
    shape_arcsec: float = math.nan
    sigma_arcsec: float = math.nan
    bound_arcsec: float = math.nan
    seconds: float = math.nan  # processor time of the estimate
    z: Mapping[str, list[float]] = field(default_factory=dict)


def score(
    ensemble: Ensemble, setup: Setup, truth: CameraGeometry, true_directions: Sequence[Floats]
) -> Score:
    """
    Calibrate and compare with the truth; too few observations are a refusal.

    ``true_directions``: lines of sight (n, 3) of the pixels of the grid; several if the camera
    changes, since the error is then that of using the calibration with each of them.
    """
    start_s = time.process_time()
    try:
        found = solve(ensemble, setup)
    except TooFewObservations as error:
        return Score(False, (str(error),))
    seconds = time.process_time() - start_s
    at = grid_derivatives(found.geometry.camera)
    true = unit(np.mean(true_directions, axis=0))
    common, _ = Rotation.align_vectors(true, at.directions)
    to_tracker, to_true = (g.star_tracker_from_camera for g in (found.geometry, truth))
    in_camera = to_true.inv() * to_tracker
    errors = {
        'shape': [shape_errors_arcsec(one, at.directions) for one in true_directions],
        'pointing': [
            np.linalg.norm(in_camera.apply(at.directions) - one, axis=1) / ARCSECOND_RAD
            for one in true_directions
        ],
    }
    covariance_rad2 = {
        name: at.covariance_rad2(found.map_covariance, J)
        for name, J in (('shape', at.of_shape(found.geometry.camera)), ('pointing', at.J))
    }
    sigma = {name: rms(sigma_arcsec(value)) for name, value in covariance_rad2.items()}
    shape_rad, pointing_rad = (r.apply(at.directions) - true for r in (common, in_camera))
    middle, corners = _zones(truth.camera)
    z = {
        name: _over_sigma(at.directions[zone], error_rad[zone], covariance_rad2[what][zone])
        for name, zone, what, error_rad in (
            ('centre', middle, 'shape', shape_rad),
            ('corners', corners, 'shape', shape_rad),
            ('pointing', middle | corners, 'pointing', pointing_rad),
        )
    }
    return Score(
        *(found.accepted, found.reasons, found.termination, found.iterations),
        shape=rms(np.ravel(errors['shape'])) / sigma['shape'],
        pointing=rms(np.ravel(errors['pointing'])) / sigma['pointing'],
        shape_arcsec=rms(np.ravel(errors['shape'])),
        sigma_arcsec=sigma['shape'],
        seconds=seconds,
        z=z,
    )


def _zones(camera: CameraModel) -> tuple[Mask, Mask]:
    """Points of the grid within 0.3 of the half diagonal, and beyond 0.85 of it: every third."""
    from_middle = (
        pixel_grid(camera, GRID, GRID) - np.array([camera.width - 1, camera.height - 1]) / 2
    )
    radius = np.hypot(*from_middle.T) / np.hypot(*from_middle[0])
    every_third = np.zeros((GRID, GRID), bool)
    every_third[::3, ::3] = True
    return every_third.ravel() & (radius < 0.3), every_third.ravel() & (radius > 0.85)


def _over_sigma(directions: Floats, error_rad: Floats, covariance_rad2: Floats) -> list[float]:
    """Errors (n, 3) along two axes across directions (n, 3), each over its 1-sigma."""
    across = unit(np.asarray(np.cross(directions, [0.0, 1.0, 0.0])))
    z = [
        (error_rad * axis).sum(axis=1)
        / np.sqrt(np.einsum('ni,nij,nj->n', axis, covariance_rad2, axis))
        for axis in (across, np.cross(directions, across))
    ]
    return [round(value, 3) for value in np.concatenate(z).tolist()]


def bound_arcsec(camera: CameraModel, information: Floats, centre_sigma_px: float) -> float:
    """
    Cramer-Rao bound of the rms 1-sigma of the shape of a camera.

    ``information`` (p, p) is that of the images, each of which has a free rotation; the principal
    point has a prior, since only in a wide field is it no rotation.
    """
    p = len(camera.parameters)
    covariance = np.zeros((p + 3, p + 3))
    information = information + np.diag([0, 0, 0, 1, 1] + [0] * (p - 5)) / centre_sigma_px**2
    covariance[:p, :p] = scaled_inverse(information)
    pixels = pixel_grid(camera, GRID, GRID)
    return rms(line_of_sight_table(camera, MapCovariance(covariance), pixels).shape_sigma_arcsec)


def shape_errors_arcsec(true: Floats, estimated: Floats) -> Floats:
    """Angles (n,) between unit vectors (n, 3), the best common rotation removed."""
    common, _ = Rotation.align_vectors(true, estimated)
    return np.asarray(np.linalg.norm(common.apply(estimated) - true, axis=1) / ARCSECOND_RAD)


def in_processes(function: Callable[..., ResultT], *arguments: Sequence[Any]) -> list[ResultT]:
    """Results of a function in the order of its arguments; one thread of BLAS per process."""
    chunk = max(1, len(arguments[0]) // 200)
    spawn = multiprocessing.get_context('spawn')
    with (
        environment(OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1'),
        ProcessPoolExecutor(processors(), mp_context=spawn) as pool,
    ):
        return list(pool.map(function, *arguments, chunksize=chunk))


def memory_mb(process: int | str, field: str = 'VmRSS') -> float:
    """Resident memory of a process, or its peak (``VmHWM``); 0 if it has ended."""
    lines = Path(f'/proc/{process}/status').read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024


@contextlib.contextmanager
def environment(**values: str) -> Iterator[None]:
    """Context manager: processes started within it have some more environment variables."""
    before = os.environ.copy()
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
