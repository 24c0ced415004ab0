# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Convention of the recorded attitudes, found from images with a measured rotation.

The rotation of the camera and an attitude together give the alignment of the camera.  With the
right order and direction of the quaternion and the right clock, it is the same for all images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.constants import NANOSECONDS_PER_SECOND

_AGREE_RAD = math.radians(0.5)  # alignments of one reading that agree
CLOCK_SEARCH_S = 61.0
_CLOCK_STEP_S = 0.05
_CLOCK_GAIN = 3.0  # by which a shift makes alignments agree better, at least
_CLOCK_LEAST_RAD = math.radians(0.02)  # a scatter under this is no clock's
_DIRECTIONS = ('st_to_inertial', 'inertial_to_st')


@dataclass(frozen=True)
class WireAttitudes:
    """Attitudes as they were sent: stamps (n,), ns, and the four numbers (n, 4) in their order."""

    time_ns: NDArray[np.int64]
    quaternion: Floats


@dataclass(frozen=True)
class SetUp:
    """
    The set-up that is held against the images.

    ``star_tracker_from_camera`` is the prior alignment, None where it is not given;
    ``acquisition_rad`` the largest error of it that a search of the image covers.
    """

    camera: CameraModel
    star_tracker_from_camera: Rotation | None
    attitude_direction: str
    stamp_offset_s: float
    max_attitude_gap_s: float
    acquisition_rad: float
    acquisition_roll_rad: float


@dataclass(frozen=True)
class Placed:
    """Stamp of an image and its measured rotation ``camera_from_icrf``."""

    time_ns: int
    camera_from_icrf: Rotation


@dataclass(frozen=True)
class Reading:
    """One way to read the attitudes, and the alignment (in the mean) that it gives."""

    order: str
    direction: str
    agreeing: int
    scatter_rad: float
    star_tracker_from_camera: Rotation
    shift_s: float = 0.0


def in_words(reading: Reading) -> str:
    """Direction and order of a reading."""
    order = 'w, x, y, z' if reading.order == 'wxyz' else 'x, y, z, w'
    return f'{reading.direction} ({order})'


def off_by(reading: Reading, setup: SetUp) -> tuple[float, float]:
    """Pointing and roll difference of the prior alignment from the measured one, rad."""
    if setup.star_tracker_from_camera is None:
        return math.pi, math.pi
    turn = setup.star_tracker_from_camera.inv() * reading.star_tracker_from_camera
    axis = turn.apply([0.0, 0.0, 1.0])
    x = turn.apply([1.0, 0.0, 0.0])
    return math.acos(min(max(float(axis[2]), -1.0), 1.0)), math.atan2(float(x[1]), float(x[0]))


def is_off(reading: Reading, setup: SetUp) -> bool:
    """True if the error of the prior alignment is beyond the range of the search."""
    tilt_rad, roll_rad = off_by(reading, setup)
    return tilt_rad > setup.acquisition_rad or abs(roll_rad) > setup.acquisition_roll_rad


def best_reading(
    solved: Sequence[Placed], attitudes: WireAttitudes, setup: SetUp
) -> Reading | None:
    """The reading whose alignments agree best, the one set up first; None where none does."""
    at_stamps = readings(solved, attitudes, setup, 0.0)
    best = _agreeing_best(at_stamps, len(solved), setup)
    if best is not None and best.scatter_rad < _CLOCK_LEAST_RAD:
        return best
    shifted = _shifted(solved, attitudes, setup)
    if shifted is None:
        return best
    if best is None or (
        shifted.agreeing >= best.agreeing and shifted.scatter_rad * _CLOCK_GAIN < best.scatter_rad
    ):
        return shifted
    return best


def _agreeing_best(readings: Sequence[Reading], images: int, setup: SetUp) -> Reading | None:
    """The best of readings under which most of the images agree."""
    enough = max(2 if images < 4 else 3, math.ceil(0.6 * images))
    if images == 1 or (setup.star_tracker_from_camera is None and images < 3):
        enough = images
    fit = [reading for reading in readings if reading.agreeing >= enough]
    if not fit:
        return None

    def rank(item: tuple[int, Reading]) -> tuple[float, ...]:
        """Agreement, then the prior: images with one attitude agree under all conventions."""
        number, reading = item
        near = setup.star_tracker_from_camera is not None and not is_off(reading, setup)
        return (-reading.agreeing, not near, number)

    return min(enumerate(fit), key=rank)[1]


def readings(
    solved: Sequence[Placed], attitudes: WireAttitudes, setup: SetUp, shift_s: float
) -> list[Reading]:
    """Every reading with the alignments it gives, the one set up first."""
    directions = sorted(_DIRECTIONS, key=lambda name: name != setup.attitude_direction)
    return [
        _reading(solved, attitudes, setup, order, direction, shift_s)
        for order in ('xyzw', 'wxyz')
        for direction in directions
    ]


def _reading(
    solved: Sequence[Placed],
    attitudes: WireAttitudes,
    setup: SetUp,
    order: str,
    direction: str,
    shift_s: float,
) -> Reading:
    stamps_ns = np.array([image.time_ns for image in solved])
    at_ns = stamps_ns + round(shift_s * NANOSECONDS_PER_SECOND)
    quaternion = _at(attitudes, at_ns, order, setup.max_attitude_gap_s)
    usable = np.isfinite(quaternion[:, 0])
    if not usable.any():
        return Reading(order, direction, 0, math.pi, Rotation.identity(), shift_s)
    icrf_from_tracker = Rotation.from_quat(quaternion[usable])
    if direction == 'inertial_to_st':
        icrf_from_tracker = icrf_from_tracker.inv()
    icrf_from_camera = Rotation.concatenate(
        [image.camera_from_icrf for image, good in zip(solved, usable, strict=True) if good]
    ).inv()
    return _agreed(icrf_from_tracker.inv() * icrf_from_camera, order, direction, shift_s)


def _agreed(alignments: Rotation, order: str, direction: str, shift_s: float) -> Reading:
    """The largest group of alignments that agree."""
    q = alignments.as_quat()
    apart = 2 * np.arccos(np.minimum(np.abs(q @ q.T), 1.0))
    near = apart < _AGREE_RAD
    middle = int(near.sum(axis=1).argmax())
    group = near[middle]
    mean = alignments[group].mean()
    off = (mean.inv() * alignments[group]).magnitude()
    scatter_rad = float(np.sqrt((off**2).mean()))
    return Reading(order, direction, int(group.sum()), scatter_rad, mean, shift_s)


def _at(
    attitudes: WireAttitudes, at_ns: NDArray[np.int64], order: str, max_gap_s: float
) -> Floats:
    """Quaternions (n, 4), x, y, z, w, at stamps (n,); NaN where no two samples are near enough."""
    q = attitudes.quaternion[:, [1, 2, 3, 0]] if order == 'wxyz' else attitudes.quaternion
    times = attitudes.time_ns
    found = np.full((len(at_ns), 4), np.nan)
    if len(times) < 2:
        return found
    after = np.clip(np.searchsorted(times, at_ns, side='left'), 1, len(times) - 1)
    gap_ns = times[after] - times[after - 1]
    inside = (at_ns >= times[after - 1]) & (at_ns <= times[after])
    inside &= gap_ns <= max_gap_s * NANOSECONDS_PER_SECOND
    if not inside.any():
        return found
    ends = after[inside]
    before, behind = Rotation.from_quat(q[ends - 1]), Rotation.from_quat(q[ends])
    part = (at_ns[inside] - times[ends - 1]) / np.maximum(gap_ns[inside], 1)
    step = (before.inv() * behind).as_rotvec()
    found[inside] = (before * Rotation.from_rotvec(part[:, None] * step)).as_quat()
    return found


def _shifted(solved: Sequence[Placed], attitudes: WireAttitudes, setup: SetUp) -> Reading | None:
    """The shift of the stamps at which the attitudes agree best; None where none does."""
    coarse = np.arange(-CLOCK_SEARCH_S, CLOCK_SEARCH_S + 1e-9, 0.25)
    fine = np.arange(-0.3, 0.3 + 1e-9, _CLOCK_STEP_S / 2)
    best: Reading | None = None
    for direction in sorted(_DIRECTIONS, key=lambda name: name != setup.attitude_direction):
        for order in ('xyzw', 'wxyz'):

            def tried(
                shifts: NDArray[np.floating], order: str = order, direction: str = direction
            ) -> Reading:
                made = [
                    _reading(solved, attitudes, setup, order, direction, float(s)) for s in shifts
                ]
                return min(made, key=lambda r: (-r.agreeing, r.scatter_rad))

            near = tried(coarse)
            one = tried(near.shift_s + fine)
            if one.agreeing < max(3, math.ceil(0.6 * len(solved))):
                continue
            if best is None or (-one.agreeing, 3 * one.scatter_rad) < (
                -best.agreeing,
                best.scatter_rad,
            ):
                best = one
        if best is not None:
            return best
    return best
