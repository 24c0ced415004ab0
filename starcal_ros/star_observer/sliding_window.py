# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Statistics of numbers that arrived in the last minute."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import threading
import time

import numpy as np

WINDOW_S = 60.0
_MOST = 100_000  # a minute at 1.6 kHz; bounds the memory under a flood of messages


class Recent:
    """
    Numbers of the last `WINDOW_S` of wall clock, safe to use from several threads.

    Parameters
    ----------
    clock_s : callable
        Monotonic seconds.
    """

    def __init__(self, clock_s: Callable[[], float] = time.monotonic) -> None:
        self._clock_s = clock_s
        self._start_s = clock_s()
        self._times_s: deque[float] = deque(maxlen=_MOST)
        self._values: deque[float] = deque(maxlen=_MOST)
        self._lock = threading.Lock()

    def add(self, value: float) -> None:
        """Add a number that has just arrived."""
        with self._lock:
            self._forget()
            self._times_s.append(self._clock_s())
            self._values.append(value)

    def rate_hz(self) -> float:
        """Numbers per second in the window, or since the start if that is shorter."""
        with self._lock:
            now_s = self._forget()
            passed_s = min(now_s - self._start_s, WINDOW_S)
            return len(self._times_s) / passed_s if passed_s > 0 else 0.0

    def median(self) -> float | None:
        """Median; None without numbers."""
        with self._lock:
            self._forget()
            return float(np.median(self._values)) if self._values else None

    def largest(self) -> float | None:
        """Largest number; None without numbers."""
        with self._lock:
            self._forget()
            return max(self._values, default=None)

    def _forget(self) -> float:
        now_s = self._clock_s()
        while self._times_s and self._times_s[0] < now_s - WINDOW_S:
            self._times_s.popleft()
            self._values.popleft()
        return now_s
