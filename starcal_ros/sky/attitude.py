# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Star-tracker attitudes: samples in time order, interpolated, in the frame of the first one."""

from __future__ import annotations

from array import array
import bisect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
import math
import threading

import numpy as np

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.options import option
from starcal_ros.records import AttitudeSample

# Rounding to single precision changes the norm by 1e-7: a change of 1e-3 has another cause.
_NORM_TOLERANCE = 1e-3
_INVALID = [math.nan] * 4
_RUNS = 3  # the present clock, the previous one, and a wrong stamp between
ARC_S = 1.0
"""Half of the time over which samples give the rate at an image."""
_MOST_OF_A_RATE = 100  # samples: of correlated errors more show no more
# Correlation lengths of the errors of samples: the slope over two seconds is worst for the last.
_MEMORIES_S = (1e-6, 0.1, 0.5)


@dataclass(frozen=True)
class AttitudeOptions:
    """Attitude messages and their match to the images."""

    max_attitude_gap_s: float = option(
        2.0, 'largest gap between the attitude samples before and after an image, s', low=0.0
    )
    stamp_offset_s: float = option(
        0.0,
        'offset added to image stamps to give the middle of the exposure on the attitude clock, s',
        low=-1e9,
        high=1e9,
        basic=True,
    )
    attitude_direction: str = option(
        'st_to_inertial',
        'direction of the rotation in the attitude messages (ROS does not define it)',
        choices=('st_to_inertial', 'inertial_to_st'),
        basic=True,
    )
    more_star_trackers: tuple[str, ...] = option(
        ('',),
        'frames of additional star trackers, each with attitudes on the topic <frame>/attitude;'
        ' empty: none',
    )
    more_alignments: tuple[float, ...] = option(
        (0.0,),
        'prior orientation of the camera in the frame of each additional star tracker, one'
        ' quaternion (x, y, z, w) after another',
    )


def attitude_sample(
    time_ns: int, quaternion_xyzw: Floats, direction: str
) -> AttitudeSample | None:
    """
    Attitude sample icrf_from_star_tracker, or None if the quaternion is not a unit quaternion.

    ``quaternion_xyzw`` is (4,) as received; ``direction`` is the option `attitude_direction`.
    """
    q = np.asarray(quaternion_xyzw, np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or abs(norm - 1.0) > _NORM_TOLERANCE:
        return None
    return AttitudeSample(time_ns, with_direction(q / norm, direction))


def with_direction(xyzw: Floats, direction: str) -> Floats:
    """Quaternions (..., 4) of messages as ``icrf_from_star_tracker``, or those as messages."""
    return xyzw * [-1.0, -1.0, -1.0, 1.0] if direction == 'inertial_to_st' else xyzw


def _nanoseconds(seconds: float) -> int:
    return int(min(seconds, 9e9) * NANOSECONDS_PER_SECOND)  # beyond the range of ROS stamps


class AttitudeHistory:
    """
    Attitude samples in time order; they may be added in any order.

    If two samples have the same stamp, the first is kept.  The stamp of an invalid sample is also
    kept, so that the refusal of an image at that time can name the cause.

    Stamps may jump because a clock was set or one stamp is wrong: a sample further than
    ``jump_s`` from the newest sample of every run starts a new run.  A run that continues after a
    forward jump is joined to the previous one.  An attitude is looked up in the most recently
    extended run first, then in the others.

    One thread may add samples while another looks them up.

    Parameters
    ----------
    keep_s : float
        Age relative to the newest sample of the run, beyond which samples are dropped once they
        are half of all.
    jump_s : float
        Difference of stamps that counts as a jump; at least the longest gap to interpolate over.
    """

    def __init__(self, keep_s: float = math.inf, jump_s: float = math.inf) -> None:
        self._keep_ns = _nanoseconds(keep_s)
        self._jump_ns = _nanoseconds(jump_s)
        self._runs: list[_Run] = []  # the most recently extended one last
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return the number of samples held."""
        with self._lock:
            return sum(map(len, self._runs))

    @property
    def latest_ns(self) -> int | None:
        """Stamp of the newest sample, without a lone sample after a jump if there are others."""
        with self._lock:
            for run in reversed(self._runs):
                if len(run) > 1:
                    return run.last_ns
            return self._runs[-1].last_ns if self._runs else None

    def samples(self) -> tuple[Indices, Floats]:
        """Stamps (n,), ns, and attitudes (n, 4) of the valid samples, in time order."""
        with self._lock:
            columns = [run.columns() for run in self._runs] or [_Run().columns()]
        time_ns, xyzw = (np.concatenate(column) for column in zip(*columns, strict=True))
        valid = np.isfinite(xyzw[:, 0])
        time_ns, rows = np.unique(time_ns[valid], return_index=True)
        return time_ns, xyzw[valid][rows]

    def add(self, time_ns: int, sample: AttitudeSample | None) -> None:
        """Insert a sample; None marks an invalid sample at this stamp."""
        with self._lock:
            run = self._run_of(time_ns)
            run.add(time_ns, sample)
            if len(run) == 2 and len(self._runs) > 1 and self._runs[-2].last_ns < run.first_ns:
                run.put_before(self._runs.pop(-2))
            run.forget_before(run.last_ns - self._keep_ns)

    def _run_of(self, time_ns: int) -> _Run:
        """Run that a sample with this stamp extends, moved to the end; a new one if none fits."""
        for k in reversed(range(len(self._runs))):
            if abs(time_ns - self._runs[k].last_ns) <= self._jump_ns:
                self._runs.append(self._runs.pop(k))
                break
        else:
            if len(self._runs) == _RUNS:  # a wrong stamp makes a run with one sample
                self._runs.remove(min(self._runs, key=len))
            self._runs.append(_Run())
        return self._runs[-1]

    def at(self, time_ns: int, max_gap_s: float) -> tuple[Floats, float]:
        """
        Attitude at a time by spherical interpolation, and the gap between its two samples.

        Raises ImageRefused ``no_attitude``, ``bad_attitude`` or ``attitude_gap``.

        Returns
        -------
        icrf_from_star_tracker_xyzw : (4,)
        gap_s : float
            0 where a sample has exactly this stamp.
        """
        before, after = self.around(time_ns, max_gap_s)
        if before is after:
            return before.icrf_from_star_tracker_xyzw, 0.0
        gap_s = (after.time_ns - before.time_ns) / NANOSECONDS_PER_SECOND
        return _between(before, after, time_ns), gap_s

    def around(self, time_ns: int, max_gap_s: float) -> tuple[AttitudeSample, AttitudeSample]:
        """
        The samples that `at` interpolates between; twice the same one if it has this stamp.

        Raises ImageRefused ``no_attitude``, ``bad_attitude`` or ``attitude_gap``.
        """
        before, after = self._in_a_run(lambda run: run.around(time_ns, max_gap_s))
        return before, after

    def rate_at(
        self, time_ns: int, max_gap_s: float, sample_sigma_rad: Floats
    ) -> tuple[Floats, Floats]:
        """
        Angular rate (3,) in the star tracker frame and its 1-sigma, rad/s; NaN if unknown.

        The slope of the samples within `ARC_S` (`rate_of`), at least of those on both sides of the
        time, or of a sample with exactly this stamp and the previous one.
        """
        try:
            samples = self._in_a_run(lambda run: run.arc(time_ns, max_gap_s))
        except ImageRefused:
            return np.full(3, math.nan), np.full(3, math.nan)
        return rate_of(samples, time_ns, sample_sigma_rad)

    def expects(self, time_ns: int) -> bool:
        """True if a further sample within `ARC_S` after a time is due, by the last step."""
        with self._lock:
            return bool(self._runs) and self._runs[-1].expects(time_ns)

    def _in_a_run(
        self, look_up: Callable[[_Run], tuple[AttitudeSample, ...]]
    ) -> tuple[AttitudeSample, ...]:
        """Samples of the most recently extended run that has them."""
        refusals = []
        with self._lock:
            for run in reversed(self._runs):
                try:
                    return look_up(run)
                except ImageRefused as refused:
                    refusals.append(refused)
        if not refusals:
            raise ImageRefused('no_attitude', 'no attitude sample received')
        raise min(refusals, key=lambda refused: refused.reason == 'no_attitude')


class _Run:
    """Samples of one clock in time order; 40 bytes per sample."""

    def __init__(self) -> None:
        self._times_ns = array('q')
        self._xyzw = array('d')  # four per sample; NaN for an invalid one

    def __len__(self) -> int:
        return len(self._times_ns)

    def columns(self) -> tuple[Indices, Floats]:
        """Stamps (n,) and attitudes (n, 4); NaN for an invalid one."""
        return np.array(self._times_ns, np.int64), np.array(self._xyzw).reshape(-1, 4)

    @property
    def first_ns(self) -> int:
        """Stamp of the oldest sample."""
        return self._times_ns[0]

    @property
    def last_ns(self) -> int:
        """Stamp of the newest sample."""
        return self._times_ns[-1]

    def add(self, time_ns: int, sample: AttitudeSample | None) -> None:
        """Insert a sample in its place."""
        xyzw = array('d', _INVALID if sample is None else sample.icrf_from_star_tracker_xyzw)
        k = self._index(time_ns)
        if k < len(self) and self._times_ns[k] == time_ns:
            if math.isnan(self._xyzw[4 * k]):
                self._xyzw[4 * k : 4 * k + 4] = xyzw
            return
        self._times_ns.insert(k, time_ns)
        self._xyzw[4 * k : 4 * k] = xyzw

    def put_before(self, earlier: _Run) -> None:
        """Prepend the samples of a run that ends before this one starts."""
        self._times_ns = earlier._times_ns + self._times_ns
        self._xyzw = earlier._xyzw + self._xyzw

    def forget_before(self, horizon_ns: int) -> None:
        """Drop the samples before a time once they are half of all: that moves all the rest."""
        old = self._index(horizon_ns)
        if 2 * old > len(self):
            del self._times_ns[:old], self._xyzw[: 4 * old]

    def _index(self, time_ns: int) -> int:
        return bisect.bisect_left(self._times_ns, time_ns)

    def _valid(self, low: int, high: int) -> Mask:
        """Mask of the valid samples in a range of indices."""
        return np.asarray(np.isfinite(self._xyzw[4 * low : 4 * high : 4]))

    def around(self, time_ns: int, max_gap_s: float) -> tuple[AttitudeSample, AttitudeSample]:
        """See `AttitudeHistory.around`."""
        k, end = self._index(time_ns), len(self)
        if k < end and self._times_ns[k] == time_ns:
            if self._valid(k, k + 1).all():
                sample = self._sample(k)
                return sample, sample
            raise ImageRefused('bad_attitude', 'the sample at the image is no unit quaternion')
        reach_ns = _nanoseconds(max_gap_s)
        low, high = self._index(time_ns - reach_ns), self._index(time_ns + reach_ns + 1)
        before, after = self._valid(low, k).nonzero()[0], self._valid(k, high).nonzero()[0]
        if len(before) and len(after):
            i, j = low + int(before[-1]), k + int(after[0])
            gap_s = (self._times_ns[j] - self._times_ns[i]) / NANOSECONDS_PER_SECOND
            if gap_s <= max_gap_s:
                return self._sample(i), self._sample(j)
        about = self._valid(max(k - 1, 0), min(k + 1, end))
        if len(about) and not about.all():
            raise ImageRefused('bad_attitude', 'the samples next to the image are invalid')
        if k in (0, end):
            side = 'before' if k == 0 else 'after'
            raise ImageRefused('no_attitude', f'no attitude sample {side} the image')
        gap_s = (self._times_ns[k] - self._times_ns[k - 1]) / NANOSECONDS_PER_SECOND
        raise ImageRefused('attitude_gap', f'{gap_s:.3f} s between samples, over {max_gap_s:g} s')

    def arc(self, time_ns: int, max_gap_s: float) -> tuple[AttitudeSample, ...]:
        """
        Return the samples about a time that its rate is taken from: two or more.

        A sample with exactly this stamp that has no other in the arc is taken with the one before
        it: a node may not have a later one yet.
        """
        before, after = self.around(time_ns, max_gap_s)
        arc_ns = _nanoseconds(ARC_S)
        low = self._index(min(before.time_ns, time_ns - arc_ns))
        high = self._index(max(after.time_ns, time_ns + arc_ns) + 1)
        places = low + self._valid(low, high).nonzero()[0]
        if len(places) < 2:
            low = self._index(time_ns - _nanoseconds(max_gap_s))
            places = low + self._valid(low, high).nonzero()[0][-2:]
        if len(places) < 2:
            raise ImageRefused('no_attitude', 'no attitude sample before that of the image')
        thinned = places[:: -(-len(places) // _MOST_OF_A_RATE)]
        return tuple(self._sample(int(k)) for k in thinned)

    def expects(self, time_ns: int) -> bool:
        """See `AttitudeHistory.expects`."""
        if len(self) < 2:
            return False
        due_ns = 2 * self._times_ns[-1] - self._times_ns[-2]
        return due_ns <= time_ns + _nanoseconds(ARC_S)

    def _sample(self, k: int) -> AttitudeSample:
        return AttitudeSample(self._times_ns[k], np.array(self._xyzw[4 * k : 4 * k + 4]))


def rate_of(
    samples: Sequence[AttitudeSample], time_ns: int, sample_sigma_rad: Floats
) -> tuple[Floats, Floats]:
    """
    Angular rate (3,) in the star tracker frame by two or more samples, and its 1-sigma, rad/s.

    The slope of a parabola by least squares, since a camera that speeds up bends the arc; of a
    line through two or three samples.  The errors of the samples have the scatter about it, at
    least ``sample_sigma_rad`` (3,), and the correlation that the slope takes most of: the samples
    of a star tracker that filters them scatter less about a slope than it is off.
    """
    from scipy.spatial.transform import Rotation  # half of the start of a short command

    late_s = np.array([s.time_ns - time_ns for s in samples]) / NANOSECONDS_PER_SECOND
    rotations = Rotation.from_quat([s.icrf_from_star_tracker_xyzw for s in samples])
    turned = (rotations[int(np.argmin(np.abs(late_s)))].inv() * rotations).as_rotvec()
    degree = 2 if len(samples) > 3 else 1
    powers = np.vander(late_s, degree + 1, increasing=True)
    fit = np.linalg.pinv(powers)
    rate: Floats = fit[1] @ turned
    left = len(samples) - degree - 1
    scatter2 = ((turned - powers @ (fit @ turned)) ** 2).sum(axis=0) / max(left, 1)
    apart_s = np.abs(np.subtract.outer(late_s, late_s))
    factor2 = max(
        fit[1] @ np.exp(-0.5 * (apart_s / memory_s) ** 2) @ fit[1] for memory_s in _MEMORIES_S
    )
    variance = np.maximum(scatter2 if left else 0.0, np.square(sample_sigma_rad))
    return rate, np.sqrt(factor2 * variance)


def _between(before: AttitudeSample, after: AttitudeSample, time_ns: int) -> Floats:
    """Attitude (4,) at a time between two samples."""
    from scipy.spatial.transform import Rotation  # half of the start of a short command

    start, end = (
        Rotation.from_quat(sample.icrf_from_star_tracker_xyzw) for sample in (before, after)
    )
    # Times are relative: a double holds seconds since 1970 to 0.1 us only.
    gap_s = (after.time_ns - before.time_ns) / NANOSECONDS_PER_SECOND
    since_s = (time_ns - before.time_ns) / NANOSECONDS_PER_SECOND
    turned = Rotation.from_rotvec(since_s / gap_s * (start.inv() * end).as_rotvec())
    return np.asarray((start * turned).as_quat())


IDENTITY_XYZW = np.array([0.0, 0.0, 0.0, 1.0])
IDENTITY_XYZW.setflags(write=False)


@dataclass(frozen=True)
class Mounting:
    """Frame name of an additional star tracker, and its assumed orientation (4,) in the first."""

    frame: str
    first_from_star_tracker_xyzw: Floats


@dataclass(frozen=True)
class Attitude:
    """
    Attitude of the first star tracker at an image, from any star tracker by its mounting.

    The fields are those of `StarObservations` with these names.
    """

    icrf_from_star_tracker_xyzw: Floats
    attitude_gap_s: float
    star_tracker_rate_rad_s: Floats
    star_tracker_rate_sigma_rad_s: Floats
    star_tracker: str = ''
    first_from_star_tracker_xyzw: Floats = field(default_factory=lambda: IDENTITY_XYZW)


def attitudes_at(
    time_ns: int,
    first: AttitudeHistory,
    others: Sequence[AttitudeHistory],
    mountings: Sequence[Mounting],
    max_gap_s: float,
    taken: Mapping[str, int],
    sample_sigma_rad: Floats,
) -> list[Attitude]:
    """
    Attitudes at a time, starting with the star tracker that has the fewest images ``taken``.

    ``sample_sigma_rad`` (3,) is the noise of a sample about the axes of a star tracker.

    In this order every star tracker is calibrated, and each can replace a silent one.  Raises
    ImageRefused if no star tracker has an attitude, with the reason of the first.
    """
    from scipy.spatial.transform import Rotation  # half of the start of a short command

    usable: list[Attitude] = []
    refusals: list[ImageRefused] = []
    for history, mounting in zip((first, *others), (None, *mountings), strict=True):
        try:
            quaternion, gap_s = history.at(time_ns, max_gap_s)
        except ImageRefused as refused:
            refusals.append(refused)
            continue
        rate_rad_s, sigma_rad_s = history.rate_at(time_ns, max_gap_s, sample_sigma_rad)
        if mounting is None:
            usable.append(Attitude(quaternion, gap_s, rate_rad_s, sigma_rad_s))
            continue
        mounted = Rotation.from_quat(mounting.first_from_star_tracker_xyzw)
        first_xyzw = (Rotation.from_quat(quaternion) * mounted.inv()).as_quat()
        # The axes of a star tracker lie across those of the first one: each takes its part.
        sigma_rad_s = np.sqrt(mounted.as_matrix() ** 2 @ sigma_rad_s**2)
        usable.append(
            Attitude(
                first_xyzw,
                gap_s,
                mounted.apply(rate_rad_s),
                sigma_rad_s,
                mounting.frame,
                mounting.first_from_star_tracker_xyzw,
            )
        )
    if not usable:
        raise refusals[0]
    return sorted(usable, key=lambda attitude: taken.get(attitude.star_tracker, 0))
