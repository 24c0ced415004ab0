# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images that wait for their attitude; star trackers, rates and latencies.

Without messages: rclpy is not imported.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
import math
import threading
import time
from typing import Any

import numpy as np

from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import ImageRefused
from starcal_ros.records import AttitudeSample, refused_image, StarObservations
from starcal_ros.sky.attitude import AttitudeHistory
from starcal_ros.text import significant

# A stamp this far ahead of the next image is wrong: its attitude will never arrive.
_WRONG_NS = 10 * NANOSECONDS_PER_SECOND
WINDOW_S = 60.0
_MOST = 100_000  # a minute at 1.6 kHz; bounds the memory under a flood of messages
# Arrivals that show the usual interval of a stream: more than telemetry sends in a burst once a
# minute, and few enough that an outage of a driver at 10 Hz counts as usual for two minutes.
_ARRIVALS = 1000
_LONGER = 2.0  # times the longest interval without a message: a busy machine is late by less
_SILENT_S = 2.0  # without a sample: no image waits for more of them for its rate
_LAGS = 100  # samples from which the delay of a star tracker is learned
_MORE = 2  # silent after so many times its longest lag


@dataclass(frozen=True)
class Waiting:
    """An image in the queue; ``message`` is None if the queue was full on its arrival."""

    time_ns: int
    width: int
    height: int
    message: Any
    arrived_s: float

    def refused(self, reason: str, detail: str) -> StarObservations:
        """Observations without stars, as the image cannot be measured."""
        return refused_image(self.time_ns, self.width, self.height, reason, detail)


class ImageQueue:
    """
    Queue between the subscription thread and the thread that measures stars.

    Every image put in comes out, in order; if the queue is full it comes out without pixels, so
    that its refusal can still be published.

    Parameters
    ----------
    size : int
        Images held with their pixels.
    timeout_s : float
        Longest wait for an image to be ready.
    is_ready : callable
        Returns True if the attitude of a stamp is available; called in the thread of `take`.
    """

    def __init__(self, size: int, timeout_s: float, is_ready: Callable[[int], bool]) -> None:
        self._size = size
        self._timeout_s = timeout_s
        self._is_ready = is_ready
        self._images: deque[Waiting] = deque()
        self._calls: deque[Callable[[], None]] = deque()
        self._held = 0
        self._closed = False
        self._changed = threading.Condition()

    def __len__(self) -> int:
        """Return the number of images waiting."""
        return len(self._images)

    @property
    def is_closed(self) -> bool:
        """True after `close`."""
        return self._closed

    def put(self, time_ns: int, width: int, height: int, message: Any) -> None:
        """Add an image; never waits."""
        with self._changed:
            kept = message if self._held < self._size else None
            self._held += kept is not None
            self._images.append(Waiting(time_ns, width, height, kept, time.monotonic()))
            self._changed.notify()

    def call(self, function: Callable[[], None]) -> None:
        """Have the thread of `take` call a function before the next image; never waits."""
        with self._changed:
            self._calls.append(function)
            self._changed.notify()

    def wake(self) -> None:
        """Check the first image again."""
        with self._changed:
            self._changed.notify()

    def close(self) -> None:
        """Close the queue: `take` returns None from now on."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def take(self) -> Waiting | None:
        """Return the next image once it is ready or timed out; None after `close`."""
        while callable(taken := self._next()):
            taken()
        return taken

    def _next(self) -> Waiting | Callable[[], None] | None:
        with self._changed:
            while not self._closed:
                if self._calls:
                    return self._calls.popleft()
                left_s = None
                if self._images:
                    first = self._images[0]
                    left_s = first.arrived_s + self._timeout_s - time.monotonic()
                    if first.message is None or left_s <= 0 or self._is_due(first):
                        self._images.popleft()
                        self._held -= first.message is not None
                        return first
                self._changed.wait(left_s and min(left_s, _SILENT_S))
            return None

    def _is_due(self, first: Waiting) -> bool:
        """Return True if the first image is ready or its stamp is wrong."""
        if self._is_ready(first.time_ns):
            return True
        following = self._images[1].time_ns if len(self._images) > 1 else first.time_ns
        return first.time_ns - following > _WRONG_NS and self._is_ready(following)


class Recent:
    """Numbers of the last `WINDOW_S` of wall clock, safe to use from several threads."""

    def __init__(self) -> None:
        self._start_s = time.monotonic()
        self._numbers: deque[tuple[float, float]] = deque(maxlen=_MOST)  # times, s, and values
        self._lock = threading.Lock()

    def add(self, value: float) -> None:
        """Add a number that has just arrived."""
        with self._lock:
            self._numbers.append((time.monotonic(), value))

    def rate_hz(self) -> float:
        """Numbers per second in the window, or since the start if that is shorter."""
        passed_s = min(time.monotonic() - self._start_s, WINDOW_S)
        return len(self._values()) / passed_s if passed_s > 0 else 0.0

    def median(self) -> float | None:
        """Median; None without numbers."""
        values = self._values()
        return float(np.median(values)) if values else None

    def largest(self) -> float | None:
        """Largest number; None without numbers."""
        return max(self._values(), default=None)

    def _values(self) -> list[float]:
        """Numbers in the window; those before it are forgotten."""
        with self._lock:
            while self._numbers and self._numbers[0][0] < time.monotonic() - WINDOW_S:
                self._numbers.popleft()
            return [value for _, value in self._numbers]


class Arrivals:
    """
    Times of the last messages of a stream, safe to use from several threads.

    By wall clock, which runs at any speed of a replay and without /clock.
    """

    def __init__(self) -> None:
        self._times_s: deque[float] = deque(maxlen=_ARRIVALS)

    def __bool__(self) -> bool:
        """True if a message has come."""
        return bool(self._times_s)

    def add(self) -> None:
        """Add a message that has just arrived."""
        self._times_s.append(time.monotonic())

    def ended(self, least_s: float) -> str:
        """
        Return why the stream seems to have ended; empty if it does not.

        Nothing came for ``least_s``, and for twice the longest interval of the last messages.
        Messages within less than ``least_s`` show no usual interval.
        """
        times_s = list(self._times_s)
        if not times_s or times_s[-1] - times_s[0] < least_s:
            return ''
        longest_s, silent_s = float(np.diff(times_s).max()), time.monotonic() - times_s[-1]
        if silent_s < max(least_s, _LONGER * longest_s):
            return ''
        return f'no message for {silent_s:.0f} s, at most {significant(longest_s, 2)} s before'


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
        self._heard_s = [-math.inf] * count  # wall clock of the last sample of each
        self._lock = threading.Lock()  # guards the lags and the times of the last samples

    def add(self, which: int, time_ns: int, sample: AttitudeSample | None) -> None:
        """Add a sample of a star tracker; None marks an invalid one."""
        before_ns = self.histories[which].latest_ns
        self.histories[which].add(time_ns, sample)
        newest_ns = self._newest_ns()
        with self._lock:
            self._heard_s[which] = time.monotonic()
            if before_ns is not None and newest_ns is not None:
                self._lags_ns[which].append(newest_ns - before_ns)

    def has_come(self, time_ns: int) -> bool:
        """
        Return True if a star tracker has the attitude of a time, or none will, and no other may.

        One that is alive may.  By its stamps, it is no further behind the newest of all star
        trackers than twice as far as it was before any of its last samples: that holds for any
        rate, delay or burst of telemetry, and at any speed of a replay.
        """
        each = range(len(self.histories))
        return any(self._is_settled(which, time_ns) for which in each) and not any(
            self._may_follow(which, time_ns) for which in each
        )

    def awaited(self, time_ns: int) -> frozenset[int]:
        """
        Star trackers that have sent nothing at or after a time, by their places.

        Delays are learnt from samples, so that `has_come` does not wait for the first late ones.
        """
        latest = (history.latest_ns for history in self.histories)
        return frozenset(k for k, ns in enumerate(latest) if ns is None or ns < time_ns)

    def _is_settled(self, which: int, time_ns: int) -> bool:
        """True if the samples about a time, for its rate too, are there or no longer come."""
        history = self.histories[which]
        latest_ns = history.latest_ns
        if latest_ns is None or latest_ns < time_ns:
            return False
        if latest_ns - time_ns > self._max_gap_ns:
            return True
        try:
            history.at(time_ns, self._max_gap_s)
        except ImageRefused:
            return False
        with self._lock:
            silent_s = time.monotonic() - self._heard_s[which]
        return silent_s > _SILENT_S or not history.expects(time_ns)

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
