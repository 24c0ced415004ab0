# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Which star trackers an image waits for."""

from __future__ import annotations

import numpy as np
import pytest

from starcal_ros.records import AttitudeSample
from starcal_ros.ros.image_queue import StarTrackers

MS = 10**6
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


def two() -> StarTrackers:
    """Two star trackers, of which an image is to have samples at most 2 s apart."""
    return StarTrackers(2, keep_s=100.0, jump_s=10.0, max_gap_s=2.0, patience_s=10.0)


def send(trackers: StarTrackers, which: int, *stamps_ms: int, valid: bool = True) -> None:
    for stamp_ms in stamps_ms:
        sample = AttitudeSample(stamp_ms * MS, IDENTITY) if valid else None
        trackers.add(which, stamp_ms * MS, sample)


def learned(delay_ms: int, period_ms: int = 200) -> StarTrackers:
    """The first star tracker sends at 10 Hz up to 5 s, the other slower and later."""
    trackers = two()
    for stamp_ms in range(0, 5001, 100):
        send(trackers, 0, stamp_ms)
        if (stamp_ms - delay_ms) >= 0 and (stamp_ms - delay_ms) % period_ms == 0:
            send(trackers, 1, stamp_ms - delay_ms)
    return trackers


@pytest.mark.parametrize(('delay_ms', 'period_ms'), [(0, 200), (1000, 200), (0, 1000)])
def test_a_slow_or_delayed_one_is_waited_for(delay_ms: int, period_ms: int) -> None:
    trackers = learned(delay_ms, period_ms)
    send(trackers, 0, *range(5100, 5201, 100))
    assert not trackers.has_come(5150 * MS)
    send(trackers, 1, 6000)
    send(trackers, 0, *range(5300, 6201, 100))
    assert trackers.has_come(5150 * MS)


def test_one_that_falls_silent_is_waited_for_twice_its_delay() -> None:
    trackers = learned(delay_ms=1000)  # it is behind by 1.2 s before each of its samples
    send(trackers, 0, *range(5100, 6401, 100))
    assert not trackers.has_come(5350 * MS)
    send(trackers, 0, 6500)
    assert trackers.has_come(5350 * MS)


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
    first_ms: list[int], other_ms: list[int], expected: set[int]
) -> None:
    trackers = two()
    send(trackers, 0, *first_ms)
    send(trackers, 1, *other_ms)
    assert trackers.awaited(250 * MS) == expected


@pytest.mark.parametrize('stamps_ms', [[], [-(10**9), -(10**9) + 100]])
def test_one_that_sends_nothing_or_by_another_clock_is_not(stamps_ms: list[int]) -> None:
    trackers = two()
    send(trackers, 1, *stamps_ms)
    send(trackers, 0, *range(0, 1301, 100))
    assert trackers.has_come(250 * MS)


def test_one_whose_samples_are_invalid_is_waited_for_no_longer_than_they_take() -> None:
    trackers = learned(delay_ms=0)
    send(trackers, 0, *range(5100, 6201, 100))
    send(trackers, 1, 5200, valid=False)
    assert trackers.has_come(5150 * MS)
    assert not trackers.has_come(5250 * MS)


def test_a_single_one_has_come_with_the_samples_about_the_image() -> None:
    one = StarTrackers(1, keep_s=100.0, jump_s=10.0, max_gap_s=2.0, patience_s=10.0)
    assert not one.has_come(50 * MS)
    send(one, 0, 0)
    assert not one.has_come(50 * MS)
    send(one, 0, 2000)
    assert one.has_come(50 * MS)
    send(one, 0, 5000)
    assert one.has_come(2900 * MS)  # none will, of which an image is told
    assert not one.has_come(3100 * MS)


def test_an_image_waits_for_the_samples_of_its_rate_while_they_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock_s = [0.0]
    monkeypatch.setattr('starcal_ros.ros.image_queue.time.monotonic', lambda: clock_s[0])
    one = StarTrackers(1, keep_s=100.0, jump_s=10.0, max_gap_s=2.0, patience_s=10.0)
    send(one, 0, *range(0, 2001, 100))
    assert one.has_come(1050 * MS)  # the next one, due at 2100 ms, is more than a second later
    assert not one.has_come(1150 * MS)
    clock_s[0] = 2.5  # it has fallen silent
    assert one.has_come(1150 * MS)
