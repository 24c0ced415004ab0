"""Star-tracker attitude in time: checked samples, kept sorted, interpolated to an image."""

from __future__ import annotations

import bisect
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.options import option
from starcal_ros.records import AttitudeSample

Floats = NDArray[np.float64]

# A tracker that sends single precision keeps the norm to 1e-7; more than 1e-3 is not a rounding.
_NORM_TOLERANCE = 1e-3


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


class AttitudeHistory:
    """
    Attitude samples in time order, whatever order they came in.

    A second sample with the same stamp is left out: the first stands.  A sample that
    `attitude_sample` refused is remembered by time, so that an image about it can say so.
    """

    def __init__(self, keep_s: float = float('inf')) -> None:
        self._keep_s = keep_s
        self._times_ns: list[int] = []
        self._samples: list[AttitudeSample | None] = []

    def __len__(self) -> int:
        """Return the number of samples held."""
        return len(self._times_ns)

    @property
    def latest_ns(self) -> int | None:
        """Stamp of the newest sample."""
        return self._times_ns[-1] if self._times_ns else None

    def add(self, time_ns: int, sample: AttitudeSample | None) -> None:
        """Insert a sample, or the fact that the one of this stamp was invalid (None)."""
        k = bisect.bisect_left(self._times_ns, time_ns)
        if k < len(self._times_ns) and self._times_ns[k] == time_ns:
            if self._samples[k] is None:
                self._samples[k] = sample
            return
        self._times_ns.insert(k, time_ns)
        self._samples.insert(k, sample)
        if self._keep_s < float('inf'):
            horizon_ns = self._times_ns[-1] - int(self._keep_s * NANOSECONDS_PER_SECOND)
            drop = bisect.bisect_left(self._times_ns, horizon_ns)
            del self._times_ns[:drop], self._samples[:drop]

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
        k = bisect.bisect_left(self._times_ns, time_ns)
        if k < len(self._times_ns) and self._times_ns[k] == time_ns:
            exact = self._samples[k]
            if exact is not None:
                return exact.icrf_from_star_tracker_xyzw, 0.0
            raise ImageRefused('bad_attitude', 'the sample at the image is not a unit quaternion')
        good_before = next((i for i in range(k - 1, -1, -1) if self._samples[i]), None)
        good_after = next((i for i in range(k, len(self._samples)) if self._samples[i]), None)
        if good_before is None or good_after is None:
            side = 'before' if good_before is None else 'after'
            near = self._samples[max(k - 1, 0) : k + 1]
            if near and None in near:
                raise ImageRefused('bad_attitude', f'no valid attitude sample {side} the image')
            raise ImageRefused('no_attitude', f'no attitude sample {side} the image')
        gap_s = (self._times_ns[good_after] - self._times_ns[good_before]) / NANOSECONDS_PER_SECOND
        if gap_s > max_gap_s:
            if good_after - good_before > 1:
                raise ImageRefused('bad_attitude', 'the samples about the image are not valid')
            raise ImageRefused(
                'attitude_gap', f'{gap_s:.3f} s between samples, over {max_gap_s:g} s'
            )
        before, after = self._samples[good_before], self._samples[good_after]
        assert (
            before is not None and after is not None
        )  # by the search above; for the type checker
        # Times relative to the first sample: seconds since 1970 would lose 0.1 us in a double.
        path = Slerp(
            [0.0, gap_s],
            Rotation.from_quat(
                [before.icrf_from_star_tracker_xyzw, after.icrf_from_star_tracker_xyzw]
            ),
        )
        since_s = (time_ns - before.time_ns) / NANOSECONDS_PER_SECOND
        return np.asarray(path(since_s).as_quat()), gap_s
