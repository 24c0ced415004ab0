"""Images in order of arrival, each held back until its attitude has come."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
import threading
import time
from typing import Any

from starcal_ros.constants import NANOSECONDS_PER_SECOND

# A stamp so far ahead of the image after it is wrong: no waiting brings its attitude.
_WRONG_NS = 10 * NANOSECONDS_PER_SECOND


@dataclass(frozen=True)
class Waiting:
    """An image message in the queue; ``message`` is None for one that found the queue full."""

    time_ns: int
    width: int
    height: int
    message: Any
    arrived_s: float


class ImageQueue:
    """
    A queue between the thread that takes images and the one that measures stars.

    Every image put comes out, in order: one that finds the queue full comes out without its
    pixels, so that it too can be answered for.

    Parameters
    ----------
    size : int
        Images held with their pixels.
    timeout_s : float
        Longest wait for an image to be ready.
    is_ready : callable
        Whether an image of a stamp has all it needs; called in the thread that takes.
    """

    def __init__(self, size: int, timeout_s: float, is_ready: Callable[[int], bool]) -> None:
        self._size = size
        self._timeout_s = timeout_s
        self._is_ready = is_ready
        self._images: deque[Waiting] = deque()
        self._held = 0
        self._closed = False
        self._changed = threading.Condition()

    def __len__(self) -> int:
        """Return the number of images waiting."""
        return len(self._images)

    def put(self, time_ns: int, width: int, height: int, message: Any) -> None:
        """Add an image; never waits."""
        with self._changed:
            kept = message if self._held < self._size else None
            self._held += kept is not None
            self._images.append(Waiting(time_ns, width, height, kept, time.monotonic()))
            self._changed.notify()

    def wake(self) -> None:
        """Look again whether the first image is ready."""
        with self._changed:
            self._changed.notify()

    def close(self) -> None:
        """End the waiting: `take` returns None from now on."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def take(self) -> Waiting | None:
        """The next image once it is ready or has waited long enough; None when closed."""
        with self._changed:
            while not self._closed:
                left_s = None
                if self._images:
                    first = self._images[0]
                    left_s = first.arrived_s + self._timeout_s - time.monotonic()
                    if first.message is None or left_s <= 0 or self._is_due(first):
                        self._images.popleft()
                        self._held -= first.message is not None
                        return first
                self._changed.wait(left_s)
            return None

    def _is_due(self, first: Waiting) -> bool:
        """Whether the first image is ready, or its stamp is wrong beside that of the next."""
        if self._is_ready(first.time_ns):
            return True
        following = self._images[1].time_ns if len(self._images) > 1 else first.time_ns
        return first.time_ns - following > _WRONG_NS and self._is_ready(following)
