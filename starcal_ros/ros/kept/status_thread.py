# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A thread that publishes the state of the ensemble, once per burst of changes."""

from __future__ import annotations

from collections.abc import Callable
import threading


class StatusThread:
    """
    Calls a function at the start and after each change, in a thread of its own.

    A guard condition of ROS would not do: before ros2/rmw_fastrtps#895 a trigger during the wait
    of the executor is lost, and with it the status of the last image.

    Parameters
    ----------
    tell : callable
        Publishes the status; it must not raise.  Changes during a call lead to one more call.
    """

    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell = tell
        self._is_due, self._is_closed = threading.Event(), False
        self._is_due.set()
        self._thread = threading.Thread(target=self._work, name='status')
        self._thread.start()

    def changed(self) -> None:
        """Have the function called; returns at once."""
        self._is_due.set()

    def close(self) -> None:
        """End the thread; a call under way is waited for."""
        self._is_closed = True
        self._is_due.set()
        self._thread.join()

    def _work(self) -> None:
        while self._is_due.wait():
            self._is_due.clear()
            if self._is_closed:
                return
            self._tell()
