# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Thread that publishes the status."""

from __future__ import annotations

import threading

from starcal_ros.ros.kept.status_thread import StatusThread


class Listener:
    """Counts calls; each waits until the test lets it go on."""

    def __init__(self) -> None:
        self.calls = 0
        self.is_in = threading.Event()
        self.may_end = threading.Event()

    def __call__(self) -> None:
        self.calls += 1
        self.is_in.set()
        self.may_end.wait()


def test_a_burst_of_changes_is_one_call() -> None:
    listener = Listener()
    status = StatusThread(listener)
    listener.is_in.wait()  # the first call, at the start
    listener.is_in.clear()
    for _ in range(100):
        status.changed()
    listener.may_end.set()
    listener.is_in.wait()
    status.close()
    assert listener.calls == 2


def test_close_while_a_call_is_under_way_and_another_is_due() -> None:
    """No call follows; an Event with a flag beside it lost one of the two."""
    listener = Listener()
    status = StatusThread(listener)
    listener.is_in.wait()
    status.changed()
    closing = threading.Thread(target=status.close)
    closing.start()
    while not status._is_closed:
        pass
    listener.may_end.set()
    closing.join()
    assert listener.calls == 1


def test_close_at_once() -> None:
    """Whatever the thread does at that moment."""
    for _ in range(1000):
        StatusThread(lambda: None).close()
