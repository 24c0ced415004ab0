# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Quaternion order, direction and clock with which attitudes fit images of known rotation.

Each attitude, with the rotation of the camera, gives the alignment of the camera.  In the right
order, direction and clock, all attitudes give the same alignment.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
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
_COARSE_STEP_S, _FINE_STEP_S = 0.25, 0.025
_CLEAR = 3.0  # ratio of the scatters above which the better of two readings is the right one
_CLOCK_LEAST_RAD = math.radians(0.02)  # a clock error causes more scatter than this
_CLOCK_IMAGES = 3  # fewest: the shift itself takes part of what two images show
_ALIKE_RAD = math.radians(0.003)  # a scatter under this is that of the stars
_WRONG_ALIGNMENT_RAD = math.radians(25.0)  # chance alone comes so near in one case of 200
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
    ``acquisition_rad`` the largest error of it that a search of the image covers; ``shift_s`` was
    added to the stamps of the images, whose clock is far from that of the attitudes.
    """

    camera: CameraModel
    star_tracker_from_camera: Rotation | None
    attitude_direction: str
    stamp_offset_s: float
    max_attitude_gap_s: float
    acquisition_rad: float
    acquisition_roll_rad: float
    shift_s: float = 0.0


@dataclass(frozen=True)
class Placed:
    """An image whose rotation is known: its stamp and ``camera_from_icrf``."""

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
    """Errors of the prior alignment in pointing and in roll, given the one found, rad."""
    if setup.star_tracker_from_camera is None:
        return math.pi, math.pi
    turn = setup.star_tracker_from_camera.inv() * reading.star_tracker_from_camera
    axis = turn.apply([0.0, 0.0, 1.0])
    x = turn.apply([1.0, 0.0, 0.0])
    return math.acos(min(max(float(axis[2]), -1.0), 1.0)), math.atan2(float(x[1]), float(x[0]))


def is_off(reading: Reading, setup: SetUp) -> bool:
    """True if the prior alignment is farther off than is searched."""
    tilt_rad, roll_rad = off_by(reading, setup)
    return tilt_rad > setup.acquisition_rad or abs(roll_rad) > setup.acquisition_roll_rad


def quarter_turns(reading: Reading, setup: SetUp) -> int:
    """
    Number of quarter turns about the boresight that correct the prior alignment; 0 for none.

    Counted from the camera's +x towards its +y.
    """
    prior = setup.star_tracker_from_camera
    if prior is None or not is_off(reading, setup):
        return 0
    for turns in (1, 2, 3):
        turned = prior * Rotation.from_euler('z', 90.0 * turns, degrees=True)
        if not is_off(reading, dataclasses.replace(setup, star_tracker_from_camera=turned)):
            return turns
    return 0


def best_reading(
    solved: Sequence[Placed], attitudes: WireAttitudes, setup: SetUp
) -> Reading | None:
    """
    Reading that fits at least one image, the configured one if it does; None if none fits.

    Images that do not rotate fit every reading: then the prior alignment decides.  If it supports
    none, the result is None.
    """
    fit = _fitting(readings(solved, attitudes, setup, 0.0), len(solved), setup)
    least_rad = min((reading.scatter_rad for reading in fit), default=math.inf)
    if len(solved) >= _CLOCK_IMAGES and least_rad > _CLOCK_LEAST_RAD:
        shifted = _shifted(solved, attitudes, setup)
        most = max((reading.agreeing for reading in fit), default=0)
        if shifted is not None and (
            not fit or (shifted.agreeing >= most and shifted.scatter_rad * _CLEAR < least_rad)
        ):
            return shifted
    return _likeliest(fit, setup)


def _fitting(found: Sequence[Reading], images: int, setup: SetUp) -> list[Reading]:
    """Readings under which most of the images agree, and about as many as under the best."""
    enough = images if images < 3 else max(3, math.ceil(0.6 * images))
    if setup.star_tracker_from_camera is not None and images == 3:
        enough = 2  # one of the attitudes may be wrong
    fit = [reading for reading in found if reading.agreeing >= enough]
    most = max((reading.agreeing for reading in fit), default=0)
    fit = [reading for reading in fit if reading.agreeing >= 0.8 * most]
    least_rad = min((max(r.scatter_rad, _ALIKE_RAD) for r in fit), default=0.0)
    return [reading for reading in fit if reading.scatter_rad < _CLEAR * least_rad]


def _likeliest(fit: Sequence[Reading], setup: SetUp) -> Reading | None:
    """Reading that the prior alignment supports among readings that fit equally well."""
    if len(fit) < 2:
        return next(iter(fit), None)
    given = next((reading for reading in fit if _is_given(reading, setup)), None)
    if setup.star_tracker_from_camera is None:
        return given
    near = [reading for reading in fit if not is_off(reading, setup)]
    if near:
        return given if given in near else near[0]
    turned = [reading for reading in fit if quarter_turns(reading, setup)]
    close = [
        reading
        for reading in fit
        if (setup.star_tracker_from_camera.inv() * reading.star_tracker_from_camera).magnitude()
        < _WRONG_ALIGNMENT_RAD
    ]
    likely = [reading for reading in fit if reading in turned or reading in close]
    return likely[0] if len(likely) == 1 else None


def _is_given(reading: Reading, setup: SetUp) -> bool:
    """True if a reading is the one set up."""
    return reading.order == 'xyzw' and reading.direction == setup.attitude_direction


def readings(
    solved: Sequence[Placed], attitudes: WireAttitudes, setup: SetUp, shift_s: float
) -> list[Reading]:
    """Every reading with the alignments it gives, the one set up first."""
    return [_reading(solved, attitudes, setup, *way, shift_s) for way in _ways(setup)]


def _ways(setup: SetUp) -> list[tuple[str, str]]:
    """Orders and directions of the attitudes, those set up first."""
    directions = sorted(_DIRECTIONS, key=lambda name: name != setup.attitude_direction)
    return [(order, direction) for order in ('xyzw', 'wxyz') for direction in directions]


def expected_rotations(attitudes: WireAttitudes, setup: SetUp, time_ns: int) -> list[Rotation]:
    """
    The rotations ``camera_from_icrf`` of an image by each reading, the one set up first.

    With those of a camera that is rolled by quarter turns; none without a prior alignment.
    """
    prior = setup.star_tracker_from_camera
    if prior is None:
        return []
    at_ns = np.array([time_ns], np.int64)
    read = []
    for order, direction in _ways(setup):
        quaternion = _at(attitudes, at_ns, order, setup.max_attitude_gap_s)[0]
        if np.isfinite(quaternion).all():
            sent = Rotation.from_quat(quaternion)
            read.append(((sent if direction == _DIRECTIONS[0] else sent.inv()) * prior).inv())
    rolls = [Rotation.from_euler('z', 90.0 * turns, degrees=True) for turns in (0, 2, 1, 3)]
    return [roll * rotation for roll in rolls for rotation in read]


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
    """The reading and the shift of the stamps that most images agree under; None: no shift."""
    coarse = np.arange(-CLOCK_SEARCH_S, CLOCK_SEARCH_S + 1e-9, _COARSE_STEP_S)
    fine = np.arange(-0.3, 0.3 + 1e-9, _FINE_STEP_S)
    found = []
    for way in _ways(setup):
        tried = [_reading(solved, attitudes, setup, *way, float(s)) for s in coarse]
        near = min(tried, key=lambda r: (-r.agreeing, r.scatter_rad)).shift_s
        tried += [_reading(solved, attitudes, setup, *way, float(near + s)) for s in fine]
        found.append(_middle_of_best(tried))
    fit = _fitting(found, len(solved), setup)
    return fit[0] if fit else None


def _middle_of_best(tried: Sequence[Reading]) -> Reading:
    """The best of shifts; where a range is as good, as for a camera at rest, its middle."""
    best = min(tried, key=lambda r: (-r.agreeing, r.scatter_rad))
    limit_rad = max(1.2 * best.scatter_rad, _ALIKE_RAD)
    by_shift = sorted(tried, key=lambda r: r.shift_s)
    at = by_shift.index(best)
    first = last = at
    while first > 0 and _as_good(by_shift[first - 1], best, limit_rad):
        first -= 1
    while last + 1 < len(by_shift) and _as_good(by_shift[last + 1], best, limit_rad):
        last += 1
    middle_s = 0.5 * (by_shift[first].shift_s + by_shift[last].shift_s)
    nearest = min(by_shift[first : last + 1], key=lambda r: abs(r.shift_s - middle_s))
    return dataclasses.replace(nearest, shift_s=middle_s)


def _as_good(reading: Reading, best: Reading, limit_rad: float) -> bool:
    return reading.agreeing == best.agreeing and reading.scatter_rad <= limit_rad
