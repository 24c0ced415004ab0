# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Order, direction and clock of the attitudes, found from images of known rotation.

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
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.identification.blind.images import Solved
from starcal_ros.pipeline.setup import Setup

_AGREE_RAD = math.radians(0.5)  # alignments of one reading that agree
CLOCK_SEARCH_S = 61.0
_COARSE_STEP_S, _FINE_STEP_S = 0.25, 0.025
_CLEAR = 3.0  # least ratio of the scatters at which the better of two readings is accepted
_CLOCK_LEAST_RAD = math.radians(0.02)  # a clock error causes more scatter than this
_CLOCK_IMAGES = 3  # fewest: estimating the shift absorbs part of the information of two images
_ALIKE_RAD = math.radians(0.003)  # a smaller scatter is due to the stars
_WRONG_ALIGNMENT_RAD = math.radians(25.0)  # chance agreement is this close in one case of 200
_TURNED_RAD = math.radians(5.0)  # roll of a mounting that is right but for quarter turns
_DIRECTIONS = ('st_to_inertial', 'inertial_to_st')
_ROLLS = [Rotation.from_euler('z', 90.0 * turns, degrees=True) for turns in range(4)]
_NORM_TOLERANCE = 1e-3


@dataclass(frozen=True)
class WireAttitudes:
    """Attitudes as received: stamps (n,), ns, and four numbers (n, 4) in the order received."""

    time_ns: NDArray[np.int64]
    quaternion: Floats


def wire_attitudes(stamps_ns: Sequence[int], quaternions: Sequence[Floats]) -> WireAttitudes:
    """Valid rotations among the attitudes, in time order, the numbers as received."""
    numbers = np.array(quaternions, np.float64).reshape(-1, 4)
    norm = np.linalg.norm(numbers, axis=1)
    good = np.abs(norm - 1.0) <= _NORM_TOLERANCE  # false for NaN
    times, first = np.unique(np.array(stamps_ns, np.int64)[good], return_index=True)
    return WireAttitudes(times, (numbers[good] / norm[good, None])[first])


@dataclass(frozen=True)
class Reading:
    """One interpretation of the attitudes, and the mean alignment that follows."""

    order: str
    direction: str
    agreeing: int
    scatter_rad: float
    star_tracker_from_camera: Rotation
    shift_s: float = 0.0

    def __str__(self) -> str:
        return f'{self.direction} ({", ".join(self.order)})'

    def off_by(self, prior: Rotation) -> tuple[float, float]:
        """Errors of a prior alignment against the one found, in pointing and in roll, rad."""
        axes = (prior.inv() * self.star_tracker_from_camera).as_matrix()
        tilt_rad = math.acos(min(max(float(axes[2, 2]), -1.0), 1.0))
        return tilt_rad, math.atan2(float(axes[1, 0]), float(axes[0, 0]))

    def is_off(self, prior: Rotation, setup: Setup) -> bool:
        """True if a prior alignment is off by more than images are searched to."""
        tilt_rad, roll_rad = self.off_by(prior)
        most_tilt_rad, most_roll_rad = setup.star_search.reach_rad(setup.prior.camera)
        return tilt_rad > most_tilt_rad or abs(roll_rad) > most_roll_rad

    def quarter_turns(self, prior: Rotation) -> int:
        """
        Number of quarter turns about the boresight that correct a prior alignment; 0 for none.

        Counted from the camera's +x towards its +y.
        """
        off = (self.off_by(prior * roll) for roll in _ROLLS)
        near = [max(3.0 * tilt_rad, abs(roll_rad)) < _TURNED_RAD for tilt_rad, roll_rad in off]
        return near.index(True) if any(near) else 0


def prior_alignment(setup: Setup) -> Rotation | None:
    """The prior ``star_tracker_from_camera``; None where it is not given."""
    if not setup.is_aligned:
        return None
    return Rotation.from_quat(setup.prior.star_tracker_from_camera_xyzw)


def _ways(setup: Setup) -> list[tuple[str, str]]:
    """Orders and directions of the attitudes; the configured one is first."""
    given = setup.attitude.attitude_direction
    directions = sorted(_DIRECTIONS, key=lambda name: name != given)
    return [(order, direction) for order in ('xyzw', 'wxyz') for direction in directions]


@dataclass(frozen=True)
class Case:
    """Images of known rotation, the attitudes received near them, and the set-up."""

    solved: Sequence[Solved]
    attitudes: WireAttitudes
    setup: Setup

    def best_reading(self) -> Reading | None:
        """
        Reading that fits at least one image, the configured one if it does; None if none fits.

        If the images do not rotate, every reading fits and the prior alignment decides; the
        result is None if it supports no reading.
        """
        fit = self._fitting(self.readings())
        least_rad = min((reading.scatter_rad for reading in fit), default=math.inf)
        if len(self.solved) >= _CLOCK_IMAGES and least_rad > _CLOCK_LEAST_RAD:
            shifted = self._shifted()
            most = max((reading.agreeing for reading in fit), default=0)
            if shifted is not None and (
                not fit or (shifted.agreeing >= most and shifted.scatter_rad * _CLEAR < least_rad)
            ):
                return shifted
        return self._likeliest(fit)

    def readings(self) -> list[Reading]:
        """Every reading with its alignments; the configured one is first."""
        return [self._at_shifts(way, np.zeros(1))[0] for way in _ways(self.setup)]

    def _fitting(self, readings: Sequence[Reading]) -> list[Reading]:
        """Readings supported by most images, and by about as many as the best reading."""
        images = len(self.solved)
        enough = images if images < 3 else max(3, math.ceil(0.6 * images))
        if self.setup.is_aligned and images == 3:
            enough = 2  # one of the attitudes may be wrong
        fit = [reading for reading in readings if reading.agreeing >= enough]
        most = max((reading.agreeing for reading in fit), default=0)
        fit = [reading for reading in fit if reading.agreeing >= 0.8 * most]
        least_rad = min((max(r.scatter_rad, _ALIKE_RAD) for r in fit), default=0.0)
        return [reading for reading in fit if reading.scatter_rad < _CLEAR * least_rad]

    def _likeliest(self, fit: Sequence[Reading]) -> Reading | None:
        """Reading that the prior alignment supports among readings that fit equally well."""
        if len(fit) < 2:
            return next(iter(fit), None)
        prior = prior_alignment(self.setup)
        if prior is None:
            is_given = (fit[0].order, fit[0].direction) == _ways(self.setup)[0]
            return fit[0] if is_given else None
        near = [reading for reading in fit if not reading.is_off(prior, self.setup)]
        if near:
            return near[0]
        likely = [
            reading
            for reading in fit
            if reading.quarter_turns(prior)
            or (prior.inv() * reading.star_tracker_from_camera).magnitude() < _WRONG_ALIGNMENT_RAD
        ]
        return likely[0] if len(likely) == 1 else None

    def _at_shifts(self, way: tuple[str, str], shift_s: Floats) -> list[Reading]:
        """The reading of each shift (s,) of the stamps, with the most alignments that agree."""
        images = len(self.solved)
        stamps_ns = np.array([image.time_ns for image in self.solved])
        at_ns = stamps_ns + np.rint(shift_s[:, None] * NANOSECONDS_PER_SECOND).astype(np.int64)
        read, usable = _read_at(self.attitudes, at_ns.ravel(), way, self.setup)
        quaternion = np.zeros((len(usable), 4))  # of no rotation: it agrees with none
        if read is not None:
            icrf_from_camera = Rotation.concatenate(
                [image.sky.camera_from_icrf for image in self.solved]
            ).inv()
            image = np.flatnonzero(usable) % images
            quaternion[usable] = (read.inv() * icrf_from_camera[image]).as_quat()
        agreeing, scatter_rad, mean = _agreed(quaternion.reshape(-1, images, 4))
        return [
            Reading(*way, int(agreeing[k]), float(scatter_rad[k]), mean[k], float(shift_s[k]))
            for k in range(len(shift_s))
        ]

    def _shifted(self) -> Reading | None:
        """The reading and stamp shift that most images support; None if there is none."""
        steps = round(CLOCK_SEARCH_S / _COARSE_STEP_S)
        coarse: Floats = _COARSE_STEP_S * np.arange(-steps, steps + 1, dtype=np.float64)
        fine: Floats = _FINE_STEP_S * np.arange(-12, 13, dtype=np.float64)
        readings = []
        for way in _ways(self.setup):
            tried = self._at_shifts(way, coarse)
            tried += self._at_shifts(way, min(tried, key=_rank).shift_s + fine)
            readings.append(_middle_of_best(tried))
        return next(iter(self._fitting(readings)), None)


def expected_rotations(attitudes: WireAttitudes, setup: Setup, time_ns: int) -> list[Rotation]:
    """
    Rotations ``camera_from_icrf`` of an image by each reading; the configured one is first.

    They include cameras rolled by quarter turns.  Empty without a prior alignment.
    """
    prior = prior_alignment(setup)
    if prior is None:
        return []
    sent = (_read_at(attitudes, np.array([time_ns]), way, setup)[0] for way in _ways(setup))
    read = [(rotations[0] * prior).inv() for rotations in sent if rotations is not None]
    return [_ROLLS[turns] * rotation for turns in (0, 2, 1, 3) for rotation in read]


def _agreed(quaternion: Floats) -> tuple[NDArray[np.int64], Floats, Rotation]:
    """
    Counts (s,), scatters (s,) and means of the largest groups of alignments that agree.

    ``quaternion`` (s, m, 4) of m alignments, zero where there is none; the scatter of none is pi.
    """
    cosine = np.abs(quaternion @ quaternion.transpose(0, 2, 1))
    near = 2 * np.arccos(np.minimum(cosine, 1.0)) < _AGREE_RAD
    middle = near.sum(axis=2).argmax(axis=1)
    group = near[np.arange(len(near)), middle]
    count = group.sum(axis=1)
    members = quaternion * group[:, :, None]
    _, vectors = np.linalg.eigh(members.transpose(0, 2, 1) @ members)
    mean = vectors[:, :, -1]
    # Half of the angle from the mean: its cosine would lose half of the digits.
    along = np.einsum('smi,si->sm', members, mean)
    across = np.linalg.norm(members - along[:, :, None] * mean[:, None], axis=2)
    off = 2.0 * np.arctan2(across, np.abs(along))
    squared = (off**2).sum(axis=1) / np.maximum(count, 1)
    return count, np.where(count > 0, np.sqrt(squared), math.pi), Rotation.from_quat(mean)


def _read_at(
    attitudes: WireAttitudes, at_ns: NDArray[np.int64], way: tuple[str, str], setup: Setup
) -> tuple[Rotation | None, NDArray[np.bool_]]:
    """
    Rotations ``icrf_from_star_tracker`` at the selected stamps of (n,).

    Stamps without two samples near enough are omitted; None if no stamp remains.
    """
    order, direction = way
    times = attitudes.time_ns
    if len(times) < 2:
        return None, np.zeros(len(at_ns), bool)
    after = np.clip(np.searchsorted(times, at_ns, side='left'), 1, len(times) - 1)
    gap_ns = times[after] - times[after - 1]
    usable = (at_ns >= times[after - 1]) & (at_ns <= times[after])
    usable &= gap_ns <= setup.attitude.max_attitude_gap_s * NANOSECONDS_PER_SECOND
    if not usable.any():
        return None, usable
    ends = after[usable]
    q = attitudes.quaternion[:, [1, 2, 3, 0]] if order == 'wxyz' else attitudes.quaternion
    before, behind = Rotation.from_quat(q[ends - 1]), Rotation.from_quat(q[ends])
    part = (at_ns[usable] - times[ends - 1]) / np.maximum(gap_ns[usable], 1)
    sent = before * Rotation.from_rotvec(part[:, None] * (before.inv() * behind).as_rotvec())
    return (sent.inv() if direction == 'inertial_to_st' else sent), usable


def _rank(reading: Reading) -> tuple[int, float]:
    return -reading.agreeing, reading.scatter_rad


def _middle_of_best(tried: Sequence[Reading]) -> Reading:
    """The best shift; the middle of equally good ones, which a camera at rest has."""
    best = min(tried, key=_rank)
    limit_rad = max(1.2 * best.scatter_rad, _ALIKE_RAD)
    by_shift = sorted(tried, key=lambda r: r.shift_s)
    good = [r.agreeing == best.agreeing and r.scatter_rad <= limit_rad for r in by_shift]
    first = last = by_shift.index(best)
    while first > 0 and good[first - 1]:
        first -= 1
    while last + 1 < len(good) and good[last + 1]:
        last += 1
    middle_s = 0.5 * (by_shift[first].shift_s + by_shift[last].shift_s)
    nearest = min(by_shift[first : last + 1], key=lambda r: abs(r.shift_s - middle_s))
    return dataclasses.replace(nearest, shift_s=middle_s)
