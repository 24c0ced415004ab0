# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Trials on all processors, and the error of a calibration over its reported 1-sigma."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
import contextlib
from dataclasses import dataclass
import math
import multiprocessing
import os
from pathlib import Path
import time
from typing import Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import GRID, line_of_sight_table
from starcal_ros.camera import pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.solve import solve
from starcal_ros.records import CameraGeometry, Ensemble
from studies.trials import rms
from studies.workers import processors

ResultT = TypeVar('ResultT')


@dataclass(frozen=True)
class Score:
    """
    Verdict of the gate on one calibration, and its errors over their reported 1-sigma.

    ``shape``: lines of sight over the detector in the camera frame, the common rotation removed,
    rms; ``shape_arcsec`` the error and ``sigma_arcsec`` the 1-sigma of it.  ``pointing``: lines of
    sight in the star tracker frame.  ``corners``: ``shape`` of the four corners of the detector.
    """

    accepted: bool
    reasons: tuple[str, ...]
    shape: float = math.nan
    pointing: float = math.nan
    shape_arcsec: float = math.nan
    sigma_arcsec: float = math.nan
    seconds: float = math.nan  # processor time of the estimate
    corners: float = math.nan


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
    pixels = pixel_grid(truth.camera, GRID, GRID)
    table = line_of_sight_table(found.geometry.camera, found.map_covariance, pixels)
    estimated = table.direction_camera
    to_tracker, to_true = (g.star_tracker_from_camera for g in (found.geometry, truth))
    off = [to_tracker.apply(estimated) - to_true.apply(true) for true in true_directions]
    off_arcsec = np.array([shape_errors_arcsec(true, estimated) for true in true_directions])
    shape_arcsec = rms(off_arcsec)
    sigma_arcsec = rms(table.shape_sigma_arcsec)
    pointing_arcsec = rms(np.linalg.norm(off, axis=-1)) / ARCSECOND_RAD
    corner = [0, GRID - 1, -GRID, -1]
    corners = rms(off_arcsec[:, corner]) / rms(table.shape_sigma_arcsec[corner])
    return Score(
        *(found.accepted, found.reasons, shape_arcsec / sigma_arcsec),
        *(pointing_arcsec / rms(table.sigma_arcsec), shape_arcsec, sigma_arcsec, seconds),
        corners,
    )


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
