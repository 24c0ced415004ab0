"""Star-tracker attitude in time: checked samples, kept sorted, interpolated to an image."""

from __future__ import annotations

from array import array
import bisect
from dataclasses import dataclass
import math
import threading

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.options import option
from starcal_ros.records import AttitudeSample

# A tracker that sends single precision keeps the norm to 1e-7; more than 1e-3 is not a rounding.
_NORM_TOLERANCE = 1e-3
_INVALID = [math.nan] * 4
_RUNS = 3  # the clock now, the one before it, and a wrong stamp between


@dataclass(frozen=True)
class AttitudeOptions:
    """How attitude messages are read and matched to images."""

    max_attitude_gap_s: float = option(
        2.0, 'longest time between the attitude samples about an image, s', low=0.0
    )
    stamp_offset_s: float = option(
        0.0, 'added to image stamps to reach the middle of the exposure on the attitude clock, s'
    )
    attitude_direction: str = option(
        'st_to_inertial',
        'what the attitude quaternion takes to what (ROS does not fix it)',
        choices=('st_to_inertial', 'inertial_to_st'),
    )


def attitude_sample(
    time_ns: int, quaternion_xyzw: Floats, direction: str
) -> AttitudeSample | None:
    """
    A checked sample in the project's own direction, or None where it is not a rotation.

    ``quaternion_xyzw`` is (4,) as on the wire; ``direction`` is the option `attitude_direction`.
    """
    q = np.asarray(quaternion_xyzw, np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or abs(norm - 1.0) > _NORM_TOLERANCE:
        return None
    q = q / norm
    if direction == 'inertial_to_st':
        q = q * np.array([-1.0, -1.0, -1.0, 1.0])
    return AttitudeSample(time_ns, q)


def _nanoseconds(seconds: float) -> int:
    return int(min(seconds, 9e9) * NANOSECONDS_PER_SECOND)  # no stamp of ROS reaches 9e9 s


class AttitudeHistory:
    """
    Attitude samples in time order, whatever order they came in.

    A second sample with the same stamp is left out: the first stands.  A sample that
    `attitude_sample` refused is remembered by time, so that an image about it can say so.

    Stamps that leap, of a clock that was set or of one wrong stamp, must not mix with the others:
    with ``jump_s``, a sample stamped further than that from the newest of the others starts a run
    of its own.  A run that goes on after a leap forwards joins the one before it.  An attitude is
    sought in the run that was added to last, then in the others.

    One thread may add while another looks up.

    Parameters
    ----------
    keep_s : float
        A sample this much older than the newest of its run is let go.
    jump_s : float
        Smallest leap of the stamps that is taken for one; at least the longest gap between
        samples that is to be bridged.
    """

    def __init__(self, keep_s: float = math.inf, jump_s: float = math.inf) -> None:
        self._keep_ns = _nanoseconds(keep_s)
        self._jump_ns = _nanoseconds(jump_s)
        self._runs: list[_Run] = []  # the one added to last at the end
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return the number of samples held."""
        with self._lock:
            return sum(map(len, self._runs))

    @property
    def latest_ns(self) -> int | None:
        """Stamp of the newest sample; of one alone after a leap only where there is no other."""
        with self._lock:
            for run in reversed(self._runs):
                if len(run) > 1:
                    return run.last_ns
            return self._runs[-1].last_ns if self._runs else None

    def add(self, time_ns: int, sample: AttitudeSample | None) -> None:
        """Insert a sample, or the fact that the one of this stamp was invalid (None)."""
        with self._lock:
            run = self._run_of(time_ns)
            run.add(time_ns, sample)
            if len(run) == 2 and len(self._runs) > 1 and self._runs[-2].last_ns < run.first_ns:
                run.put_before(self._runs.pop(-2))
            run.forget_before(run.last_ns - self._keep_ns)

    def _run_of(self, time_ns: int) -> _Run:
        """The run that a sample of this stamp goes on with, put last; a new one where none is."""
        for k in reversed(range(len(self._runs))):
            if abs(time_ns - self._runs[k].last_ns) <= self._jump_ns:
                self._runs.append(self._runs.pop(k))
                break
        else:
            if len(self._runs) == _RUNS:  # a wrong stamp makes a run of one
                self._runs.remove(min(self._runs, key=len))
            self._runs.append(_Run())
        return self._runs[-1]

    def at(self, time_ns: int, max_gap_s: float) -> tuple[Floats, float]:
        """
        Attitude at a time by spherical interpolation, and the gap between the samples about it.

        Returns
        -------
        icrf_from_star_tracker_xyzw : (4,)
        gap_s : float
            0 where a sample has exactly this stamp.

        Raises
        ------
        ImageRefused
            ``no_attitude``, ``bad_attitude`` or ``attitude_gap``.
        """
        refusals = []
        with self._lock:
            for run in reversed(self._runs):
                try:
                    return run.at(time_ns, max_gap_s)
                except ImageRefused as refused:
                    refusals.append(refused)
        if not refusals:
            raise ImageRefused('no_attitude', 'no attitude sample has come')
        raise min(refusals, key=lambda refused: refused.reason == 'no_attitude')


class _Run:
    """Samples of one clock in time order: stamps and quaternions side by side, 40 bytes each."""

    def __init__(self) -> None:
        self._times_ns = array('q')
        self._xyzw = array('d')  # four to a sample; NaN where it was invalid
        self._start = 0  # those before it are forgotten

    def __len__(self) -> int:
        return len(self._times_ns) - self._start

    @property
    def first_ns(self) -> int:
        """Stamp of the oldest sample."""
        return self._times_ns[self._start]

    @property
    def last_ns(self) -> int:
        """Stamp of the newest sample."""
        return self._times_ns[-1]

    def add(self, time_ns: int, sample: AttitudeSample | None) -> None:
        """Insert a sample in its place."""
        xyzw = array('d', _INVALID if sample is None else sample.icrf_from_star_tracker_xyzw)
        k = self._index(time_ns)
        if k < len(self._times_ns) and self._times_ns[k] == time_ns:
            if math.isnan(self._xyzw[4 * k]):
                self._xyzw[4 * k : 4 * k + 4] = xyzw
            return
        self._times_ns.insert(k, time_ns)
        self._xyzw[4 * k : 4 * k] = xyzw

    def put_before(self, earlier: _Run) -> None:
        """Put the samples of a run that ends before this one in front of its own."""
        self._times_ns = earlier._times_ns[earlier._start :] + self._times_ns[self._start :]
        self._xyzw = earlier._xyzw[4 * earlier._start :] + self._xyzw[4 * self._start :]
        self._start = 0

    def forget_before(self, horizon_ns: int) -> None:
        """Let go of samples from before a time."""
        while len(self) > 1 and self.first_ns < horizon_ns:
            self._start += 1
        if self._start > len(self._times_ns) // 2:  # seldom: it moves all that is left
            del self._times_ns[: self._start], self._xyzw[: 4 * self._start]
            self._start = 0

    def _index(self, time_ns: int) -> int:
        return bisect.bisect_left(self._times_ns, time_ns, lo=self._start)

    def _valid(self, low: int, high: int) -> NDArray[np.bool_]:
        """Which of the samples of a range of indexes are rotations."""
        return np.asarray(np.isfinite(self._xyzw[4 * low : 4 * high : 4]))

    def at(self, time_ns: int, max_gap_s: float) -> tuple[Floats, float]:
        """See `AttitudeHistory.at`."""
        k, end = self._index(time_ns), len(self._times_ns)
        if k < end and self._times_ns[k] == time_ns:
            if self._valid(k, k + 1).all():
                return np.array(self._xyzw[4 * k : 4 * k + 4]), 0.0
            raise ImageRefused('bad_attitude', 'the sample at the image is not a unit quaternion')
        reach_ns = _nanoseconds(max_gap_s)
        low, high = self._index(time_ns - reach_ns), self._index(time_ns + reach_ns + 1)
        before, after = self._valid(low, k).nonzero()[0], self._valid(k, high).nonzero()[0]
        if len(before) and len(after):
            i, j = low + int(before[-1]), k + int(after[0])
            gap_s = (self._times_ns[j] - self._times_ns[i]) / NANOSECONDS_PER_SECOND
            if gap_s <= max_gap_s:
                return self._between(i, j, time_ns), gap_s
        about = self._valid(max(k - 1, self._start), min(k + 1, end))
        if len(about) and not about.all():
            raise ImageRefused('bad_attitude', 'the samples about the image are not valid')
        if k in (self._start, end):
            side = 'before' if k == self._start else 'after'
            raise ImageRefused('no_attitude', f'no attitude sample {side} the image')
        gap_s = (self._times_ns[k] - self._times_ns[k - 1]) / NANOSECONDS_PER_SECOND
        raise ImageRefused('attitude_gap', f'{gap_s:.3f} s between samples, over {max_gap_s:g} s')

    def _between(self, i: int, j: int, time_ns: int) -> Floats:
        """Attitude (4,) at a time between two samples."""
        ends = np.array([self._xyzw[4 * i : 4 * i + 4], self._xyzw[4 * j : 4 * j + 4]])
        # Times relative to the first sample: seconds since 1970 would lose 0.1 us in a double.
        gap_s = (self._times_ns[j] - self._times_ns[i]) / NANOSECONDS_PER_SECOND
        since_s = (time_ns - self._times_ns[i]) / NANOSECONDS_PER_SECOND
        return np.asarray(Slerp([0.0, gap_s], Rotation.from_quat(ends))(since_s).as_quat())
