# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes of each star tracker as they arrive, and which of them an image waits for."""

from __future__ import annotations

from collections import deque
import threading

from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.records import AttitudeSample
from starcal_ros.sky.attitude import AttitudeHistory

_LAGS = 100  # samples from which the delay of a star tracker is learned
_MORE = 2  # times the longest of them: it has fallen silent


class StarTrackers:
    """
    The attitude samples of star trackers, of which one may be slower than another or fall silent.

    The first of ``histories`` is that of the first star tracker.  One thread may add samples of
    each star tracker while others ask.

    Parameters
    ----------
    count : int
    keep_s, jump_s : float
        As of `AttitudeHistory`.
    max_gap_s : float
        Longest time between the samples about an image.
    patience_s : float
        Longest delay of a star tracker that an image waits for.
    """

    def __init__(
        self, count: int, keep_s: float, jump_s: float, max_gap_s: float, patience_s: float
    ) -> None:
        self.histories = tuple(AttitudeHistory(keep_s, jump_s) for _ in range(count))
        self._max_gap_s, self._max_gap_ns = max_gap_s, int(max_gap_s * NANOSECONDS_PER_SECOND)
        self._most_ns = int(patience_s * NANOSECONDS_PER_SECOND)
        self._lags_ns: tuple[deque[int], ...] = tuple(deque(maxlen=_LAGS) for _ in range(count))
        self._lock = threading.Lock()  # of the lags

    def add(self, which: int, time_ns: int, sample: AttitudeSample | None) -> None:
        """Add a sample of a star tracker; None marks an invalid one."""
        before_ns = self.histories[which].latest_ns
        self.histories[which].add(time_ns, sample)
        newest_ns = self._newest_ns()
        if before_ns is not None and newest_ns is not None:
            with self._lock:
                self._lags_ns[which].append(newest_ns - before_ns)

    def has_come(self, time_ns: int) -> bool:
        """
        Return True if a star tracker has the attitude of a time, or none will, and no other may.

        One that is alive may.  By its stamps, it is no further behind the newest of all star
        trackers than twice as far as it was before any of its last samples: that holds for any
        rate, delay or burst of telemetry, and at any speed of a replay.
        """
        return any(self._is_settled(history, time_ns) for history in self.histories) and not any(
            self._may_follow(which, time_ns) for which in range(len(self.histories))
        )

    def _is_settled(self, history: AttitudeHistory, time_ns: int) -> bool:
        """True if the samples about a time are there, or can no longer arrive."""
        latest_ns = history.latest_ns
        if latest_ns is None or latest_ns < time_ns:
            return False
        if latest_ns - time_ns > self._max_gap_ns:
            return True
        try:
            history.at(time_ns, self._max_gap_s)
        except ImageRefused:
            return False
        return True

    def _may_follow(self, which: int, time_ns: int) -> bool:
        """True if a star tracker is alive and has sent nothing after a time."""
        latest_ns, newest_ns = self.histories[which].latest_ns, self._newest_ns()
        if latest_ns is None or newest_ns is None or latest_ns >= time_ns:
            return False
        with self._lock:
            longest_ns = max(self._lags_ns[which], default=self._max_gap_ns)
        return newest_ns - latest_ns <= min(_MORE * longest_ns, self._most_ns)

    def _newest_ns(self) -> int | None:
        stamps = [history.latest_ns for history in self.histories]
        return max((stamp for stamp in stamps if stamp is not None), default=None)
