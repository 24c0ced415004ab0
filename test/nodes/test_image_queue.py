# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The image queue: order, waiting, overrun, close."""

from __future__ import annotations

import threading
import time

from starcal_ros.ros.image_queue import ImageQueue, Waiting

SECOND_NS = 10**9


def put(queue: ImageQueue, *stamps: int) -> None:
    """Put images of these stamps."""
    for stamp in stamps:
        queue.put(stamp, 8, 8, f'image {stamp}')


def take(queue: ImageQueue) -> Waiting:
    """Take an image; fail without one."""
    taken = queue.take()
    assert taken is not None
    return taken


def test_order_is_of_arrival() -> None:
    queue = ImageQueue(5, 10.0, lambda _: True)
    put(queue, 3, 1, 2)
    assert [take(queue).time_ns for _ in range(3)] == [3, 1, 2]


def test_surplus_keeps_its_place_without_pixels() -> None:
    queue = ImageQueue(2, 10.0, lambda _: True)
    put(queue, 1, 2, 3)
    assert len(queue) == 3
    assert [take(queue).message for _ in range(2)] == ['image 1', 'image 2']
    put(queue, 4)
    assert [take(queue).message for _ in range(2)] == [None, 'image 4']


def test_an_image_waits_until_it_is_ready() -> None:
    ready = threading.Event()
    queue = ImageQueue(2, 60.0, lambda _: ready.is_set())
    taken: list[Waiting] = []
    thread = threading.Thread(target=lambda: taken.append(take(queue)))
    thread.start()
    put(queue, 1)
    thread.join(0.1)
    assert not taken
    ready.set()
    queue.wake()
    thread.join(240.0)
    assert [w.time_ns for w in taken] == [1]


def test_an_image_waits_no_longer_than_its_time() -> None:
    queue = ImageQueue(2, 0.01, lambda _: False)
    put(queue, 1)
    assert take(queue).time_ns == 1


def test_close_ends_the_waiting() -> None:
    queue = ImageQueue(2, 60.0, lambda _: False)
    put(queue, 1)
    found: list[object] = []
    thread = threading.Thread(target=lambda: found.append(queue.take()))
    thread.start()
    queue.close()
    thread.join(240.0)
    assert found == [None]


def test_a_stamp_in_the_future_does_not_hold_the_others_back() -> None:
    """It is released when the next image shows its stamp to be wrong; a small lead waits."""
    queue = ImageQueue(5, 60.0, lambda stamp: stamp < 10 * SECOND_NS)
    put(queue, 100 * SECOND_NS, SECOND_NS)
    assert [take(queue).time_ns for _ in range(2)] == [100 * SECOND_NS, SECOND_NS]
    queue = ImageQueue(5, 0.05, lambda stamp: stamp < 10 * SECOND_NS)
    put(queue, 11 * SECOND_NS, 9 * SECOND_NS)
    taken = take(queue)
    assert taken.time_ns == 11 * SECOND_NS
    assert time.monotonic() - taken.arrived_s >= 0.05


def test_calls_are_made_by_the_thread_that_takes_before_the_next_image() -> None:
    queue = ImageQueue(2, 60.0, lambda stamp: stamp > 0)
    made: list[object] = []

    def takes() -> None:
        while (taken := queue.take()) is not None:
            made.append(taken.time_ns)
        made.append(threading.current_thread())

    thread = threading.Thread(target=takes)
    queue.call(lambda: made.append(threading.current_thread()))
    put(queue, 1)
    queue.call(queue.close)  # while the lock of the queue is free
    thread.start()
    thread.join(240.0)
    assert made == [thread, thread]
    queue.call(lambda: made.append('too late'))
    assert queue.take() is None and len(made) == 2
