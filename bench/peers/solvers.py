# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
SciPy, OpenCV and mrcal on identified stars; the first two as in `bench.competitors`.

SciPy gets starcal's camera with its derivatives.  Its sigma is computed here, from the Jacobian at
the minimum and scaled by the residuals.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
import subprocess
import tempfile

import cv2
import numpy as np

from bench import competitors, mrcal_process
from bench.peers.campaigns import Campaign, Result
from bench.table import timed
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import line_of_sight
from starcal_ros.records import MapCovariance
from studies.trials import rms

MRCAL = Path('/usr/lib/python3/dist-packages/mrcal')  # of Debian's python3-mrcal
_FREE = {'cx, cy free': np.arange(10), 'cx, cy held': competitors.FREE}
_THIN_PRISM = cv2.CALIB_RATIONAL_MODEL | cv2.CALIB_THIN_PRISM_MODEL
_INVERSION = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
_OPENCV_MODELS = (0, _THIN_PRISM, _THIN_PRISM | cv2.CALIB_TILTED_MODEL)


def least_squares(campaign: Campaign) -> list[Result]:
    """SciPy, with the principal point estimated, and held at its prior."""
    results = []
    for variant, free in _FREE.items():
        case = competitors.make_case(campaign.case.ensemble, campaign.case.prior, free)
        answer, took_s = timed(functools.partial(competitors.solve_scipy, case))
        camera = dataclasses.replace(case.prior.camera, parameters=answer.parameters)
        matrix = np.zeros((13, 13))  # ten parameters and an alignment, which does not matter
        matrix[np.ix_(free, free)] = competitors.covariance_of(case, answer)
        table = line_of_sight_table(camera, MapCovariance(matrix), campaign.pixels)
        used = (line_of_sight(camera, campaign.pixels), case.table.image_count, len(case.table))
        results.append(Result(variant, *used, took_s, rms(table.shape_sigma_arcsec)))
    return results


def opencv(campaign: Campaign) -> list[Result]:
    """`cv2.calibrateCameraExtended` with 5, 12 and 14 coefficients."""
    case, results = campaign.case, []
    for model in _OPENCV_MODELS:
        flags = model | cv2.CALIB_USE_LU
        (K, D, _), took_s = timed(functools.partial(competitors.calibrate_opencv, case, flags))
        # By default OpenCV inverts its distortion in five steps only.
        pixels, same = campaign.pixels[:, None], np.eye(3)
        points = cv2.undistortPointsIter(pixels, K, D, same, same, _INVERSION)[:, 0]
        seen = np.insert(np.float64(points), 2, 1.0, axis=1)
        used = (case.table.image_count, len(case.table))
        results.append(Result(f'{len(D)} coefficients', seen, *used, took_s))
    return results


def mrcal(campaign: Campaign) -> list[Result]:
    """Run mrcal with each of its lens models, in a process of its own."""
    case, table, camera = campaign.case, campaign.case.table, campaign.case.prior.camera
    with tempfile.TemporaryDirectory() as name:
        given, found = (str(Path(name, file)) for file in ('given.npz', 'found.npz'))
        np.savez(
            given,
            size=[camera.width, camera.height],
            core=camera.parameters[[0, 2, 3, 4]],
            distortion=camera.parameters[[5, 6, 8, 9, 7]],  # k1, k2, p1, p2, k3
            rotvec=case.start.camera_from_icrf.as_rotvec(),
            image=table.image,
            direction=table.direction_icrf,
            measured_px=table.measured_px,
            sigma_px=case.sigma_px.mean(axis=1),
            pixels=campaign.pixels,
        )
        command = ['/usr/bin/python3', '-I', mrcal_process.__file__, given, found]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        with np.load(found) as results:
            seen, took_s = results['directions'], results['processor_s'].tolist()
    used = (table.image_count, len(table))
    rows = zip(mrcal_process.MODELS, seen, took_s, strict=True)
    return [Result(model, directions, *used, spent_s) for model, directions, spent_s in rows]
