# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Interpretations of received attitudes, each held against the rotations that the stars show.

The right interpretation gives one alignment for all images.  Every order and sign of the numbers,
every direction and all fixed inertial axes are linear maps of the quaternion that change its
distances to others not at all: any of them is a proper or improper rotation in four dimensions,
q -> l q r or q -> l q* r.  The alignment takes up r; the stars show l in three images that turn
about two axes.  So interpretations that differ in r alone explain the stars equally, and only the
prior alignment can decide between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import functools
import itertools
import math

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices, Integers, Mask
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.pipeline.setup import Setup
from starcal_ros.sky.attitude import AttitudeHistory, IDENTITY_XYZW, with_direction

CLOCK_SEARCH_S = 71.0  # Terrestrial Time is 69.2 s ahead of UTC, the atomic time 37 s
IMAGES_OF_A_READING = 3  # fewest to search a shift or axes: two fit about any of them
_ZONE_S, _ZONES = 900.0, 56  # time zones differ by quarters of an hour, up to 14 hours
_ABOUT_A_ZONE_S = 1.5  # either side of it
_MOST_ATTITUDES = 20_000  # half an hour at 10 Hz: they are sent to another process
_AGREE_RAD = math.radians(0.5)  # alignments of one reading that agree
_COARSE_STEP_S, _FINE_STEP_S = 0.25, 0.025
_CLEAR = 3.0  # least ratio of the scatters at which the better of two readings is accepted
_LEAST_RAD = math.radians(0.02)  # a clock error, or other axes, cause more scatter than this
_ALIKE_RAD = math.radians(0.003)  # a smaller scatter is due to the stars
_WRONG_ALIGNMENT_RAD = math.radians(25.0)  # chance agreement is this close in one case of 200
_TURNED_RAD = math.radians(5.0)  # roll of a mounting that is right but for quarter turns
_TURNS = 0.1  # second axis of the turns of three images, as sin(angle / 2), that shows the axes
_UNIX_EPOCH_JD = 2440587.5
_B1950_JD = 2433282.42345905
_DIRECTIONS = ('st_to_inertial', 'inertial_to_st')
XYZW = 'x, y, z, w'
W_FIRST = 'w, x, y, z'
_ROLLS = [Rotation.from_euler('z', 90.0 * turns, degrees=True) for turns in range(4)]


def _galactic(*_: float) -> Floats:
    poles = [erfa.s2c(*erfa.g2icrs(*lb)) for lb in ((0, 0), (math.pi / 2, 0), (0, math.pi / 2))]
    return np.array(poles)


# Rotation matrices from the ICRF to other axes that attitudes may be in, at a Julian date (UTC).
_OTHER_AXES: Mapping[str, Callable[..., Floats]] = {
    'the mean equator and equinox of date': lambda *utc_jd: erfa.bp06(*utc_jd)[2],
    'the mean equator and equinox of B1950': lambda *_: erfa.pmat76(_B1950_JD, 0.0),
    'the ecliptic of J2000': lambda *_: erfa.ecm06(erfa.DJ00, 0.0),
    'the ecliptic of date': lambda *utc_jd: erfa.ecm06(*utc_jd),
    'the galactic system': _galactic,
    'the rotating Earth': lambda *utc_jd: erfa.c2t06a(*utc_jd, *utc_jd, 0.0, 0.0),
}


@dataclass(frozen=True)
class WireAttitudes:
    """Attitudes as received: stamps (n,), ns, and four numbers (n, 4) in the order received."""

    time_ns: Integers
    quaternion: Floats


def wire_attitudes(history: AttitudeHistory, direction: str) -> WireAttitudes:
    """The last valid attitudes as received; ``direction`` is `attitude_direction`."""
    time_ns, xyzw = history.samples()
    last = slice(-_MOST_ATTITUDES, None)
    return WireAttitudes(time_ns[last], with_direction(xyzw[last], direction))


@dataclass(frozen=True)
class Meaning:
    """
    Meaning of received numbers: their order and signs, the direction, and the inertial axes.

    ``numbers`` are those in the fields x, y, z, w.  ``axes`` is one of `_OTHER_AXES`, empty for
    the ICRF, or a name of the axes whose rotation from the ICRF is ``axes_from_icrf``.
    """

    numbers: str
    direction: str
    axes: str = ''
    axes_from_icrf: Rotation | None = None

    def __str__(self) -> str:
        axes = f' in axes of {self.axes}' if self.axes else ''
        return f'{self.direction} ({self.numbers}){axes}'

    @property
    def changes(self) -> int:
        """Number of differences from x, y, z, w in the ICRF; other axes are as many as three."""
        fields = self.numbers.split(', ')
        moved = sum(name[-1] != right for name, right in zip(fields, 'xyzw', strict=True))
        return moved + self.numbers.count('-') + 3 * bool(self.axes)

    def at(self, time_ns: Integers, sent: Floats) -> Rotation:
        """Rotations ``icrf_from_star_tracker`` (m,) of received numbers (m, 4) at stamps (m,)."""
        xyzw = np.empty_like(sent)
        for field, name in enumerate(self.numbers.split(', ')):
            xyzw[:, 'xyzw'.index(name[-1])] = -sent[:, field] if name[0] == '-' else sent[:, field]
        read = Rotation.from_quat(xyzw)
        if self.direction == 'inertial_to_st':
            read = read.inv()
        if self.axes_from_icrf is not None:
            return self.axes_from_icrf.inv() * read
        if not self.axes:
            return read
        days = time_ns / (86400 * NANOSECONDS_PER_SECOND)
        from_icrf = [_OTHER_AXES[self.axes](_UNIX_EPOCH_JD, float(day)) for day in days]
        return Rotation.from_matrix(np.array(from_icrf)).inv() * read


@functools.cache
def _orders_and_signs() -> tuple[str, ...]:
    """Every order and sign of four numbers; w is +w, since -q is the rotation q."""
    return tuple(
        ', '.join(f'{sign}{name}' for sign, name in zip(signs, order, strict=True))
        for order in itertools.permutations('xyzw')
        for signs in itertools.product(('', '-'), repeat=4)
        if signs[order.index('w')] == ''
    )


@functools.cache
def _exchanged_axes() -> tuple[tuple[str, Rotation], ...]:
    """Right-handed axes that are those of the ICRF in another order or sense."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if np.linalg.det(matrix) > 0 and not np.allclose(matrix, np.eye(3)):
                along = ', '.join(
                    f'{"-" if sign < 0 else ""}{"xyz"[k]}'
                    for k, sign in zip(order, signs, strict=True)
                )
                name = f'a frame whose x, y, z are {along} of the ICRF'
                found.append((name, Rotation.from_matrix(matrix)))
    return tuple(found)


@dataclass(frozen=True)
class Reading:
    """
    A meaning of the attitudes, and the mean alignment that follows.

    ``alike`` are readings that explain the stars equally, and that no prior alignment excludes.
    """

    meaning: Meaning
    agreeing: int
    scatter_rad: float
    star_tracker_from_camera: Rotation
    shift_s: float = 0.0
    alike: tuple[Reading, ...] = ()

    def __str__(self) -> str:
        return str(self.meaning)

    def with_camera(self, camera_from_other: Rotation) -> Reading:
        """The reading with the alignment of a camera of other axes."""
        alignment = self.star_tracker_from_camera * camera_from_other
        return replace(self, star_tracker_from_camera=alignment)

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


def _usual(setup: Setup) -> list[Meaning]:
    """The usual orders and directions of the attitudes; the configured one is first."""
    given = setup.attitude.attitude_direction
    directions = sorted(_DIRECTIONS, key=lambda name: name != given)
    return [Meaning(order, direction) for order in (XYZW, W_FIRST) for direction in directions]


@dataclass(frozen=True)
class Case:
    """
    Stamps (m,) of images whose rotation is known, the attitudes received near them, the set-up.

    ``icrf_from_camera`` has the rotations.
    """

    time_ns: Integers
    icrf_from_camera: Rotation
    attitudes: WireAttitudes
    setup: Setup

    def best_reading(self) -> Reading | None:
        """
        Reading that fits at least one image, the configured one if it does; None if none fits.

        If the images do not rotate, every reading fits and the prior alignment decides; the
        result is None if it supports no reading.
        """
        fit = self._fitting(self.usual_readings())
        least_rad = min((reading.scatter_rad for reading in fit), default=math.inf)
        if len(self.time_ns) >= IMAGES_OF_A_READING and least_rad > _LEAST_RAD:
            most = max((reading.agreeing for reading in fit), default=0)
            for others in self._others():
                good = [
                    other
                    for other in self._fitting(others)
                    if not fit
                    or (other.agreeing >= most and other.scatter_rad * _CLEAR < least_rad)
                ]
                if good:
                    return self._plainest(good)
        return self._likeliest(fit)

    def usual_readings(self) -> list[Reading]:
        """The readings of the usual meanings; the configured one is first."""
        return self._read(_usual(self.setup))

    def turned_by_frozen_attitudes(self) -> float | None:
        """Angle that the camera turns by while the attitudes stay the same; None: they turn."""
        rows, sent = self._unshifted
        if len(rows) < 2:
            return None
        turned = _largest_turn(Rotation.from_quat(sent))
        camera_rad = _largest_turn(self.icrf_from_camera[rows])
        # The noise of a star tracker is arcseconds, and an image's rotation is known to less.
        return camera_rad if turned < _LEAST_RAD and camera_rad > 2.0 * _AGREE_RAD else None

    def turns(self) -> tuple[float, float] | None:
        """
        Angles between two images by the stars and by the attitudes that differ most, rad.

        No order, sign, direction, alignment or inertial axes change them.
        """
        rows, sent = self._unshifted
        if len(rows) < 2:
            return None
        i, j = np.triu_indices(len(rows), 1)
        camera = self.icrf_from_camera[rows]
        by_stars = (camera[i].inv() * camera[j]).magnitude()
        received = Rotation.from_quat(sent)
        by_attitudes = (received[i].inv() * received[j]).magnitude()
        k = int(np.abs(by_stars - by_attitudes).argmax())
        return float(by_stars[k]), float(by_attitudes[k])

    def _fitting(self, readings: Sequence[Reading]) -> list[Reading]:
        """Readings supported by most images, and by about as many as the best reading."""
        images = len(self.time_ns)
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
            is_given = fit[0].meaning == _usual(self.setup)[0]
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

    def _plainest(self, fit: Sequence[Reading]) -> Reading:
        """The reading that the prior alignment supports; else the plainest, with another kind."""
        by_changes = sorted(fit, key=lambda reading: reading.meaning.changes)
        prior = prior_alignment(self.setup)
        near = [r for r in by_changes if prior is not None and not r.is_off(prior, self.setup)]
        if near:
            return near[0]
        first = by_changes[0]
        others = [r for r in by_changes if bool(r.meaning.axes) != bool(first.meaning.axes)]
        return replace(first, alike=tuple(others[:1]))

    def _sent(self, shift_s: Floats) -> tuple[Floats, Mask]:
        """
        Received numbers (s, m, 4) at the stamps of the images, shifted; usable ones (s, m).

        Numbers are interpolated on the sphere: that needs no meaning of them.  Stamps without two
        samples near enough are not usable.
        """
        at_ns = self.time_ns + np.rint(shift_s[:, None] * NANOSECONDS_PER_SECOND).astype(np.int64)
        return _sent_at(self.attitudes, at_ns, self.setup.attitude.max_attitude_gap_s)

    @functools.cached_property
    def _unshifted(self) -> tuple[Indices, Floats]:
        """Rows (n,) of the images with usable attitudes, and the numbers (n, 4) at them."""
        sent, usable = self._sent(np.zeros(1))
        return np.flatnonzero(usable[0]), sent[0, usable[0]]

    def _read(self, meanings: Sequence[Meaning], shift_s: Floats | None = None) -> list[Reading]:
        """The reading of each meaning at each shift (s,) of the stamps, with its alignment."""
        shift_s = np.zeros(1) if shift_s is None else shift_s
        sent, usable = self._sent(shift_s)
        camera = self.icrf_from_camera[np.tile(np.arange(len(self.time_ns)), len(shift_s))]
        stamps = np.tile(self.time_ns, len(shift_s))
        readings = []
        for meaning in meanings:
            read = meaning.at(stamps, sent.reshape(-1, 4))
            alignments = (read.inv() * camera).as_quat().reshape(sent.shape)
            # One that is not usable is of no rotation, and agrees with none.
            agreeing, scatter_rad, mean = _agreed(np.where(usable[..., None], alignments, 0.0))
            readings += [
                Reading(meaning, int(agreeing[k]), float(scatter_rad[k]), mean[k], float(shift))
                for k, shift in enumerate(shift_s)
            ]
        return readings

    def _others(self) -> Iterator[list[Reading]]:
        """
        Readings with other meanings, the plainer ones first.

        Axes that have a name; a shift of the stamps; any order and sign of the numbers, and axes
        in another order or sense; any fixed axes.
        """
        usual = _usual(self.setup)
        yield self._read([replace(one, axes=axes) for axes in _OTHER_AXES for one in usual])
        shifts = _shifts(self.time_ns, self.attitudes.time_ns)
        fine: Floats = _FINE_STEP_S * np.arange(-12, 13, dtype=np.float64)
        readings = []
        for meaning in usual:
            tried = self._read([meaning], shifts)
            tried += self._read([meaning], min(tried, key=_rank).shift_s + fine)
            readings.append(_middle_of_best(tried))
        yield readings
        given = usual[0]
        meanings = [replace(given, numbers=numbers) for numbers in _orders_and_signs()]
        meanings += [
            Meaning(XYZW, direction, name, axes)
            for direction in (one.direction for one in usual[:2])
            for name, axes in _exchanged_axes()
        ]
        yield self._read(meanings)
        by_direction = (self._read([*self._of_fixed_axes(one)]) for one in usual[:2])
        yield [min(tried, key=_rank) for tried in by_direction if tried]

    def _of_fixed_axes(self, usual: Meaning) -> Iterator[Meaning]:
        """
        Meanings with the axes that the turns of three images show, for each three of them.

        The turns by the attitudes are those of the camera in other axes.
        """
        rows, sent = self._unshifted
        if len(rows) < IMAGES_OF_A_READING:
            return
        read = usual.at(self.time_ns[rows], sent)
        camera = self.icrf_from_camera[rows]
        for three in itertools.combinations(range(len(rows)), 3):
            by_attitudes, by_stars = (_turns_between(r[list(three)]) for r in (read, camera))
            if np.linalg.svd(by_stars, compute_uv=False)[1] < _TURNS:
                continue
            axes_from_icrf, _ = Rotation.align_vectors(by_attitudes, by_stars)
            degrees = math.degrees(axes_from_icrf.magnitude())
            vector = axes_from_icrf.as_rotvec()
            ra, dec = np.degrees(erfa.c2s(vector))
            about = f'{degrees:.1f} degrees about RA {ra % 360:.0f}, Dec {dec:.0f}'
            name = f'a frame turned by {about}'
            yield replace(usual, axes=name, axes_from_icrf=axes_from_icrf)


def _turns_between(rotations: Rotation) -> Floats:
    """Turns (3, 3) between three rotations, in the axes on their left, times sin(angle / 2)."""
    between = (rotations[[1, 2, 2]] * rotations[[0, 1, 0]].inv()).as_quat()
    return np.asarray(between[:, :3] * np.where(between[:, 3:] < 0, -1.0, 1.0))


def _largest_turn(rotations: Rotation) -> float:
    """Largest angle from the first of some rotations, rad."""
    return float((rotations[0].inv() * rotations).magnitude().max())


def _shifts(images_ns: Integers, attitudes_ns: Integers) -> Floats:
    """Shifts of the stamps of images to search, s: near zero, and those of time zones."""
    steps = round(CLOCK_SEARCH_S / _COARSE_STEP_S)
    near: Floats = _COARSE_STEP_S * np.arange(-steps, steps + 1, dtype=np.float64)
    about = round(_ABOUT_A_ZONE_S / _COARSE_STEP_S)
    zones = _ZONE_S * np.delete(np.arange(-_ZONES, _ZONES + 1, dtype=np.float64), _ZONES)
    shifts = np.concatenate(
        [near, (zones[:, None] + near[steps - about : steps + about + 1]).ravel()]
    )
    if not len(attitudes_ns):
        return shifts
    low_s = (int(attitudes_ns[0]) - int(images_ns[-1])) / NANOSECONDS_PER_SECOND
    high_s = (int(attitudes_ns[-1]) - int(images_ns[0])) / NANOSECONDS_PER_SECOND
    return shifts[(shifts >= min(low_s, 0.0)) & (shifts <= max(high_s, 0.0))]


def expected_rotations(attitudes: WireAttitudes, setup: Setup, time_ns: int) -> list[Rotation]:
    """
    Rotations ``camera_from_icrf`` of an image by the usual readings; the configured one is first.

    They include cameras rolled by quarter turns.  Empty without a prior alignment.
    """
    prior = prior_alignment(setup)
    at_ns = np.array([[time_ns]])
    sent, usable = _sent_at(attitudes, at_ns, setup.attitude.max_attitude_gap_s)
    if prior is None or not usable.any():
        return []
    read = (meaning.at(at_ns[0], sent[0])[0] for meaning in _usual(setup))
    predicted = [(rotation * prior).inv() for rotation in read]
    return [_ROLLS[turns] * rotation for turns in (0, 2, 1, 3) for rotation in predicted]


def _sent_at(attitudes: WireAttitudes, at_ns: Integers, max_gap_s: float) -> tuple[Floats, Mask]:
    """
    Received numbers (..., 4) at stamps (...), interpolated, and which of them are usable.

    Those that are not are of the identity.
    """
    times = attitudes.time_ns
    sent = np.broadcast_to(IDENTITY_XYZW, (*at_ns.shape, 4)).copy()
    usable = np.zeros(at_ns.shape, bool)
    if len(times) < 2:
        return sent, usable
    after = np.clip(np.searchsorted(times, at_ns, side='left'), 1, len(times) - 1)
    gap_ns = times[after] - times[after - 1]
    usable = (at_ns >= times[after - 1]) & (at_ns <= times[after])
    usable &= gap_ns <= max_gap_s * NANOSECONDS_PER_SECOND
    if not usable.any():
        return sent, usable
    row = after[usable]
    part = (at_ns[usable] - times[row - 1]) / np.maximum(gap_ns[usable], 1)
    before, behind = (Rotation.from_quat(attitudes.quaternion[k]) for k in (row - 1, row))
    turned = Rotation.from_rotvec(part[:, None] * (before.inv() * behind).as_rotvec())
    sent[usable] = (before * turned).as_quat()
    return sent, usable


def _agreed(quaternion: Floats) -> tuple[Integers, Floats, Rotation]:
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
    return replace(nearest, shift_s=middle_s)
