# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Set-up and attitudes as a diagnosis takes them, and the alignment that it finds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.identification.star_finder import ACQUISITION_RADIUS_RAD, ACQUISITION_ROLL_RAD
from starcal_ros.pipeline.diagnosis.attitude_reading import SetUp, WireAttitudes
from starcal_ros.pipeline.diagnosis.diagnose import Diagnosis
from starcal_ros.pipeline.setup import Setup

_NORM_TOLERANCE = 1e-3
IMAGES_OF_AN_ALIGNMENT = 3


def found_alignment(found: Diagnosis) -> tuple[list[float] | None, str]:
    """The alignment of a diagnosis without a prior one, or None, with a sentence on it."""
    if found.cause != 'prior_alignment' or not isinstance(found.found, list):
        return None, found.in_a_sentence()
    if found.images < IMAGES_OF_AN_ALIGNMENT:
        return None, (f'{found.images} images agree, {IMAGES_OF_AN_ALIGNMENT} are needed.')
    return found.found, (
        f'prior_alignment is not given: found {found.found} from {found.images} images that agree.'
    )


def wire_attitudes(stamps_ns: Sequence[int], quaternions: Sequence[Floats]) -> WireAttitudes:
    """Attitudes that are rotations, in time order, their numbers as they were sent."""
    numbers = np.array(quaternions, np.float64).reshape(-1, 4)
    norm = np.linalg.norm(numbers, axis=1)
    good = np.abs(norm - 1.0) <= _NORM_TOLERANCE  # false for NaN
    times = np.array(stamps_ns, np.int64)[good]
    times, first = np.unique(times, return_index=True)
    return WireAttitudes(times, (numbers[good] / norm[good, None])[first])


def set_up(setup: Setup) -> SetUp:
    """The part of a setup that is held against the images."""
    prior = setup.prior
    return SetUp(
        camera=prior.camera,
        star_tracker_from_camera=Rotation.from_quat(prior.star_tracker_from_camera_xyzw)
        if setup.is_aligned
        else None,
        attitude_direction=setup.attitude.attitude_direction,
        stamp_offset_s=setup.attitude.stamp_offset_s,
        max_attitude_gap_s=setup.attitude.max_attitude_gap_s,
        acquisition_rad=ACQUISITION_RADIUS_RAD,
        acquisition_roll_rad=ACQUISITION_ROLL_RAD,
    )
