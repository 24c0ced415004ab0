# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The image queue, the star trackers that an image waits for, and statistics of a minute."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from starcal_ros.records import AttitudeSample
from starcal_ros.ros.image_queue import (
    Arrivals,
    ImageQueue,
    Recent,
    StarTrackers,
    Waiting,
    WINDOW_S,
)

SECOND_NS, MS = 10**9, 10**6
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def put(queue: ImageQueue, *stamps: int) -> None:
    for stamp in stamps:
        queue.put(stamp, 8, 8, f'image {stamp}')


def take(queue: ImageQueue) -> Waiting:
    taken = queue.take()
    assert taken is not None
    return taken


def test_order_is_of_arrival_and_surplus_keeps_its_place_without_pixels() -> None:
    queue = ImageQueue(2, 10.0, lambda _: True)
    put(queue, 3, 1, 2)
    assert len(queue) == 3
    assert [take(queue).message for _ in range(2)] == ['image 3', 'image 1']
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


def test_an_image_waits_no_longer_than_its_time_and_close_ends_the_waiting() -> None:
    queue = ImageQueue(2, 0.01, lambda _: False)
    put(queue, 1)
    assert take(queue).time_ns == 1
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


def star_trackers(count: int) -> StarTrackers:
    """Star trackers of which an image is to have samples at most 2 s apart."""
    return StarTrackers(count, keep_s=100.0, jump_s=10.0, max_gap_s=2.0, patience_s=10.0)


def send(trackers: StarTrackers, which: int, *stamps_ms: int, valid: bool = True) -> None:
    for stamp_ms in stamps_ms:
        sample = AttitudeSample(stamp_ms * MS, IDENTITY) if valid else None
        trackers.add(which, stamp_ms * MS, sample)


def learned(delay_ms: int, period_ms: int = 200) -> StarTrackers:
    """The first star tracker sends at 10 Hz up to 5 s, the other slower and later."""
    trackers = star_trackers(2)
    for stamp_ms in range(0, 5001, 100):
        send(trackers, 0, stamp_ms)
        if (stamp_ms - delay_ms) >= 0 and (stamp_ms - delay_ms) % period_ms == 0:
            send(trackers, 1, stamp_ms - delay_ms)
    return trackers


@pytest.mark.parametrize(('delay_ms', 'period_ms'), [(0, 200), (1000, 200), (0, 1000)])
def test_a_slow_or_delayed_one_is_waited_for(delay_ms, period_ms) -> None:
    trackers = learned(delay_ms, period_ms)
    send(trackers, 0, *range(5100, 5201, 100))
    assert not trackers.has_come(5150 * MS)
    send(trackers, 1, 6000)
    send(trackers, 0, *range(5300, 6201, 100))
    assert trackers.has_come(5150 * MS)


def test_one_that_falls_silent_or_is_invalid_is_waited_for_by_its_delay() -> None:
    trackers = learned(delay_ms=1000)  # it is behind by 1.2 s before each of its samples
    send(trackers, 0, *range(5100, 6401, 100))
    assert not trackers.has_come(5350 * MS)
    send(trackers, 0, 6500)
    assert trackers.has_come(5350 * MS)
    # One whose samples are invalid is waited for no longer than they take.
    trackers = learned(delay_ms=0)
    send(trackers, 0, *range(5100, 6201, 100))
    send(trackers, 1, 5200, valid=False)
    assert trackers.has_come(5150 * MS)
    assert not trackers.has_come(5250 * MS)


@pytest.mark.parametrize(
    ('first_ms', 'other_ms', 'expected'),
    [
        ([], [], {0, 1}),
        ([0, 300], [], {1}),  # of a delay that is not known yet
        ([0, 300], [0], {1}),
        ([0, 300], [0, 300], set()),
        ([0, 20_000], [100], {1}),  # however late it is
        ([0], [250], {0}),
    ],
)
def test_a_star_tracker_is_awaited_until_it_has_sent_something_after_a_time(
    first_ms, other_ms, expected
) -> None:
    trackers = star_trackers(2)
    send(trackers, 0, *first_ms)
    send(trackers, 1, *other_ms)
    assert trackers.awaited(250 * MS) == expected


def test_one_that_sends_nothing_or_by_another_clock_is_not() -> None:
    for stamps_ms in ([], [-(10**9), -(10**9) + 100]):
        trackers = star_trackers(2)
        send(trackers, 1, *stamps_ms)
        send(trackers, 0, *range(0, 1301, 100))
        assert trackers.has_come(250 * MS)


def test_a_single_one_has_come_with_the_samples_about_the_image() -> None:
    one = star_trackers(1)
    assert not one.has_come(50 * MS)
    send(one, 0, 0)
    assert not one.has_come(50 * MS)
    send(one, 0, 2000)
    assert one.has_come(50 * MS)
    send(one, 0, 5000)
    assert one.has_come(2900 * MS)  # none will, of which an image is told
    assert not one.has_come(3100 * MS)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    clock = SimpleNamespace(now_s=100.0)
    monkeypatch.setattr('starcal_ros.ros.image_queue.time.monotonic', lambda: clock.now_s)
    return clock


def test_an_image_waits_for_the_samples_of_its_rate_while_they_come(clock) -> None:
    one = star_trackers(1)
    send(one, 0, *range(0, 2001, 100))
    assert one.has_come(1050 * MS)  # the next one, due at 2100 ms, is more than a second later
    assert not one.has_come(1150 * MS)
    clock.now_s += 2.5  # it has fallen silent
    assert one.has_come(1150 * MS)


def test_rate_is_right_from_the_start_and_what_is_old_is_forgotten(clock) -> None:
    """Before the window is full the rate is over the time since the start."""
    recent = Recent()
    assert (recent.rate_hz(), recent.median(), recent.largest()) == (0.0, None, None)
    for k in range(40):
        clock.now_s += 0.25
        recent.add(float(k))
    assert recent.rate_hz() == pytest.approx(4.0)
    assert (recent.median(), recent.largest()) == (19.5, 39.0)
    recent = Recent()
    recent.add(1000.0)
    for k in range(1, 301):
        clock.now_s += 1.0
        recent.add(float(k))
    # Those that came 60 s ago to now: 61 of them.
    assert recent.rate_hz() == pytest.approx(61 / WINDOW_S)
    assert (recent.median(), recent.largest()) == (270.0, 300.0)
    clock.now_s += WINDOW_S + 1
    assert (recent.rate_hz(), recent.median(), recent.largest()) == (0.0, None, None)


@pytest.mark.parametrize(
    ('steps_s', 'silent_s', 'words'),
    [
        ([], 1e6, ''),
        ([600.0], 1100.0, ''),  # an image each ten minutes
        ([600.0], 1300.0, 'no message for 1300 s, at most 600 s before'),
        ([0.1] * 100, 4.9, ''),
        ([0.1] * 100, 5.1, 'no message for 5 s, at most 0.1 s before'),
        ([0.01] * 100, 1e6, ''),  # a burst
        ([*[0.1] * 600, 60.0] * 2 + [0.1] * 600, 100.0, ''),  # telemetry once a minute
    ],
)
def test_a_stream_has_ended_by_its_own_interval(clock, steps_s, silent_s, words) -> None:
    arrivals = Arrivals()
    assert not arrivals and not arrivals.ended(5.0)
    arrivals.add()
    for step_s in steps_s:
        clock.now_s += step_s
        arrivals.add()
    clock.now_s += silent_s
    assert arrivals and arrivals.ended(5.0) == words
    arrivals.add()
    assert not arrivals.ended(5.0)
