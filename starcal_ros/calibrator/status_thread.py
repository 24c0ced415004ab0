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
        # Both flags change under this lock only, so that neither hides the other.
        self._changed = threading.Condition()
        self._is_due, self._is_closed = True, False
        self._thread = threading.Thread(target=self._work, name='status')
        self._thread.start()

    def changed(self) -> None:
        """Have the function called; returns at once."""
        with self._changed:
            self._is_due = True
            self._changed.notify()

    def close(self) -> None:
        """End the thread; a call under way is waited for."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        while self._wait():
            self._tell()

    def _wait(self) -> bool:
        """Return True when a call is due, False when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_due or self._is_closed)
            self._is_due = False
            return not self._is_closed
