# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images that match no star, kept by the star observer: diagnosed, and measured again later."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
import dataclasses
import os
import threading

from starcal_ros.arrays import Floats
from starcal_ros.pipeline.diagnosis.attitude_reading import wire_attitudes, WireAttitudes
from starcal_ros.pipeline.diagnosis.diagnose import diagnose, Diagnosis, IMAGES_OF_AN_ALIGNMENT
from starcal_ros.pipeline.setup import Setup
from starcal_ros.processes import ChildProcess
from starcal_ros.records import Image
from starcal_ros.stars.hot_pixels import NO_HOT_PIXELS

KEPT = 5  # images; of 5 megapixels and 16 bit they are 50 MB
DIAGNOSED = 5  # images in a row without a match
_LOWEST_PRIORITY = 19  # of a diagnosis that no image waits for
_ATTITUDES = 20_000  # of the last minutes, for the search of a shift of clocks


class Unmatched:
    """
    The last images that matched no star, and why they did not.

    After five in a row, then ten, twenty and so on, they are diagnosed in another process; without
    a prior alignment after each image from the third on.  Safe to use from several threads.
    """

    def __init__(self, setup: Setup, on_answer: Callable[[Diagnosis], None]) -> None:
        self._setup = setup
        self._on_answer = on_answer
        self._lock = threading.Lock()
        self._images: deque[Image] = deque(maxlen=KEPT)
        self._attitudes: deque[tuple[int, Floats]] = deque(maxlen=_ATTITUDES)
        self._in_a_row = 0
        self._next = DIAGNOSED if setup.is_aligned else IMAGES_OF_AN_ALIGNMENT
        self._process: ChildProcess | None = None
        self._is_closed = False
        self._thread: threading.Thread | None = None
        self._diagnosis: Diagnosis | None = None

    @property
    def diagnosis(self) -> Diagnosis | None:
        """Why the last images matched nothing; None: not asked yet, or they match again."""
        with self._lock:
            return self._diagnosis

    def add_attitude(self, time_ns: int, quaternion: Floats) -> None:
        """Keep an attitude as it was sent."""
        with self._lock:
            self._attitudes.append((time_ns, quaternion))

    def matched(self) -> None:
        """Forget the diagnosis: an image matched."""
        with self._lock:
            self._in_a_row, self._diagnosis = 0, None
            self._next = DIAGNOSED

    def add(self, image: Image) -> None:
        """Keep an image that matched nothing, and have it diagnosed if it is time."""
        with self._lock:
            self._images.append(image)
            self._in_a_row += 1
            busy = self._thread is not None and self._thread.is_alive()
            if busy or self._in_a_row < self._next:
                return
            self._next = 2 * self._in_a_row if self._setup.is_aligned else self._in_a_row + 1
            stamps, quaternions = (
                zip(*self._attitudes, strict=True) if self._attitudes else ((), ())
            )
            question = (
                tuple(self._images),
                wire_attitudes(stamps, quaternions),
                dataclasses.replace(self._setup, dark=None, flat=None, hot=NO_HOT_PIXELS),
            )
            self._thread = threading.Thread(
                target=self._ask, args=question, name='diagnose', daemon=True
            )
            self._thread.start()

    def images(self) -> list[Image]:
        """Return the images kept, which may be measured again."""
        with self._lock:
            return list(self._images)

    def drop(self, images: Sequence[Image]) -> None:
        """Keep these images no longer."""
        stamps_ns = {image.time_ns for image in images}
        with self._lock:
            kept = [image for image in self._images if image.time_ns not in stamps_ns]
            self._images.clear()
            self._images.extend(kept)

    def aligned(self, setup: Setup) -> None:
        """Go on with the alignment found."""
        with self._lock:
            self._setup = setup
            self._in_a_row, self._diagnosis, self._next = 0, None, DIAGNOSED

    def close(self) -> None:
        """End a diagnosis under way; there is none after it."""
        with self._lock:
            self._is_closed = True
            if self._process is not None:
                self._process.kill()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _ask(self, *question: object) -> None:
        with self._lock:
            if self._is_closed:
                return
            process = self._process = ChildProcess()
        try:
            found = process.call(_answer, *question)
        except Exception:  # whatever it is, the node goes on
            return
        finally:
            process.end()
        with self._lock:
            if not self._in_a_row:
                return  # images match again
            self._diagnosis = found
        self._on_answer(found)


def _answer(images: tuple[Image, ...], attitudes: WireAttitudes, setup: Setup) -> Diagnosis:
    """Diagnose in a process of its own."""
    if setup.is_aligned:  # else all images wait for the answer
        os.nice(_LOWEST_PRIORITY)
    return diagnose(images, attitudes, setup)
