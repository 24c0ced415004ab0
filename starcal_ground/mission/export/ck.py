# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Attitude of the calibrated camera at each image, by its stars, as a SPICE CK of type 3.

Each image is an interval of its own, so that nothing is interpolated from one to the next.
Source: NAIF's CK Required Reading; a C-matrix takes inertial to frame coordinates.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.mission.export.losses import Content, Loss
from starcal_ground.mission.export.spice import SpiceNames
from starcal_ground.mission.ingest.kernels import ephemeris_time, loaded
from starcal_ros.arrays import Floats
from starcal_ros.camera import line_of_sight
from starcal_ros.errors import ProductError
from starcal_ros.estimation.temperature import camera_at
from starcal_ros.records import Calibration, StarObservations
from starcal_ros.robust_statistics import RAYLEIGH_TO_SIGMA

CK_FILE = 'camera.bc'
_LEAST_STARS = 3
_OUTLIER = 4.5  # sigma, of the median: as `outlier_sigma` of a calibration by default
_INTERNAL_NAME = 'starcal: attitude of the calibrated camera'


def attitude_by_stars(
    calibration: Calibration, image: StarObservations
) -> tuple[Rotation, float] | None:
    """
    Attitude icrf_from_camera of an image, and its 1-sigma across the boresight in px.

    None for an image that was refused or has fewer than three stars.
    """
    if image.refusal or len(image) < _LEAST_STARS:
        return None
    degc = image.temperature_degc
    geometry = camera_at(calibration, degc) if np.isfinite(degc) else calibration.geometry
    seen = line_of_sight(geometry.camera, image.measured_px)
    information = 1.0 / image.covariance_px2[:, [0, 2]].mean(axis=1)
    used = np.isfinite(seen).all(axis=1)
    for _ in range(2):  # the second without the stars that the first does not fit
        if used.sum() < _LEAST_STARS:
            return None
        rotation, _ = Rotation.align_vectors(
            image.direction_icrf[used], seen[used], information[used]
        )
        off = np.linalg.norm(rotation.apply(seen) - image.direction_icrf, axis=1)
        off = off * np.sqrt(information)
        used = used & (off <= _OUTLIER * RAYLEIGH_TO_SIGMA * np.median(off[used]))
    return rotation, float(1.0 / np.sqrt(information[used].sum()))


def ck_of_images(
    calibration: Calibration,
    observations: Iterable[StarObservations],
    names: SpiceNames,
    kernels: Sequence[Path],
) -> Content:
    """
    A CK of the attitudes of images; ``kernels`` are the LSK and the SCLK of the spacecraft.

    With a star tracker ID they are of its frame, in which the frame kernel of `spice_kernels` has
    the camera; else of the camera itself, by its instrument ID.  Raises ProductError if no image
    has stars, or SPICE refuses the file.  Raises IngestError for a kernel that cannot be read.
    """
    found = {
        image.time_ns: one
        for image in observations
        if (one := attitude_by_stars(calibration, image)) is not None
    }
    if not found:
        raise ProductError('--to ck: no image with stars among the observations')
    times_ns = sorted(found)
    icrf_from_frame = Rotation.concatenate([found[time_ns][0] for time_ns in times_ns])
    if names.star_tracker_id:
        icrf_from_frame = icrf_from_frame * calibration.geometry.star_tracker_from_camera.inv()
    structure = names.star_tracker_id or names.camera_id
    q = np.roll(icrf_from_frame.inv().as_quat(), 1, axis=1)
    with loaded(kernels) as spice:
        try:
            ticks = np.array(
                [spice.sce2c(names.spacecraft_id, ephemeris_time(spice, t)) for t in times_ns]
            )
            data = _ck(spice, structure, ticks, q)
        except spice.SpiceyError as error:
            words = ' '.join(str(error).split())[:240]
            raise ProductError(f'{CK_FILE}: {words}') from error
    sigma_px = float(np.median([sigma_px for _, sigma_px in found.values()]))
    loss = Loss('1-sigma of the attitude of an image (median)', sigma_px)
    return Content({CK_FILE: data}, losses=(loss,))


def _ck(spice: Any, structure: int, ticks: Floats, q: Floats) -> bytes:
    """Content of a CK with an interval for each attitude."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, 'attitude.bc')
        handle = spice.ckopn(str(path), _INTERNAL_NAME, 0)
        no_rate = np.zeros((len(ticks), 3))
        spice.ckw03(
            *(handle, ticks[0], ticks[-1], structure, 'J2000', False, 'starcal', len(ticks)),
            *(ticks, q, no_rate, len(ticks), ticks),
        )
        spice.ckcls(handle)
        return path.read_bytes()
