# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The error of a calibration over its reported 1-sigma; memory and environment of processes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass, field
import math
import os
from pathlib import Path
import time

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import scaled_inverse
from starcal_ros.arrays import Floats, Mask
from starcal_ros.assessment.lookup import GRID, grid_derivatives, line_of_sight_table, sigma_arcsec
from starcal_ros.camera import CameraModel, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.solve import solve
from starcal_ros.records import CameraGeometry, Ensemble, MapCovariance
from studies.trials import rms
from studies.worlds import unit


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
    Calibrate and compare with the truth.

    ``true_directions``: lines of sight (n, 3) of the pixels of the grid; several if the camera
    changes, since the error is then that of using the calibration with each of them.
    """
    start_s = time.process_time()
    found = solve(ensemble, setup)
    seconds = time.process_time() - start_s
    camera = found.geometry.camera
    at = grid_derivatives(camera)
    to_tracker, to_true = (g.star_tracker_from_camera for g in (found.geometry, truth))
    seen = (to_true.inv() * to_tracker).apply(at.directions)
    # (t, n, 3) of the t true cameras; the shape without the rotation common to the detector.
    shape_rad = np.array([turned_onto(true, at.directions) - true for true in true_directions])
    pointing_rad = seen - np.array(true_directions)
    shape_rad2 = at.covariance_rad2(found.map_covariance, at.of_shape(camera))
    pointing_rad2 = at.covariance_rad2(found.map_covariance, at.J)
    error_arcsec, sigma = _rms_arcsec(shape_rad), rms(sigma_arcsec(shape_rad2))
    from_middle = pixel_grid(camera, GRID, GRID) - pixel_grid(camera, GRID, GRID).mean(axis=0)
    radius = np.hypot(*from_middle.T) / np.hypot(*from_middle[0])
    return Score(
        *(found.accepted, found.reasons, found.termination, found.iterations),
        shape=error_arcsec / sigma,
        pointing=_rms_arcsec(pointing_rad) / rms(sigma_arcsec(pointing_rad2)),
        shape_arcsec=error_arcsec,
        sigma_arcsec=sigma,
        seconds=seconds,
        z={
            'centre': _over_sigma(at.directions, shape_rad, shape_rad2, radius < 0.3),
            'corners': _over_sigma(at.directions, shape_rad, shape_rad2, radius > 0.85),
            'pointing': _over_sigma(at.directions, pointing_rad, pointing_rad2, radius < 2.0),
        },
    )


def _rms_arcsec(off_rad: Floats) -> float:
    return rms(np.linalg.norm(off_rad, axis=-1)) / ARCSECOND_RAD


def _over_sigma(
    directions: Floats, off_rad: Floats, covariance_rad2: Floats, zone: Mask
) -> list[float]:
    """Errors (t, n, 3) across directions (n, 3) over their 1-sigma, at every third of a zone."""
    zone = zone & (np.indices((GRID, GRID)) % 3 == 0).all(axis=0).ravel()
    d, C = directions[zone], covariance_rad2[zone]
    across = unit(np.asarray(np.cross(d, [0.0, 1.0, 0.0])))
    axes = np.stack([across, np.cross(d, across)])
    sigma_rad = np.sqrt(np.einsum('ani,nij,anj->an', axes, C, axes))
    z = np.einsum('ani,tni->tan', axes, off_rad[:, zone]) / sigma_rad
    return [round(value, 3) for value in z.ravel().tolist()]


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


def without_last(information: Floats, count: int) -> Floats:
    """Information without its last unknowns, which are free."""
    B = information[:-count, -count:]
    rest = information[:-count, :-count]
    return np.asarray(rest - B @ np.linalg.solve(information[-count:, -count:], B.T))


def shape_errors_arcsec(true: Floats, estimated: Floats) -> Floats:
    """Angles (n,) between unit vectors (n, 3), the best common rotation removed."""
    return np.asarray(np.linalg.norm(turned_onto(true, estimated) - true, axis=1) / ARCSECOND_RAD)


def turned_onto(true: Floats, estimated: Floats) -> Floats:
    """Unit vectors (n, 3) rotated onto others."""
    common, _ = Rotation.align_vectors(true, estimated)
    return np.asarray(common.apply(estimated))


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
