# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Statistics of the last minute."""

from __future__ import annotations

import pytest

from starcal_ros.ros.image_queue import Recent, WINDOW_S


class Clock:
    """Clock set by the test."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_nothing_has_come() -> None:
    recent = Recent(Clock())
    assert (recent.rate_hz(), recent.median(), recent.largest()) == (0.0, None, None)


def test_rate_is_right_from_the_start() -> None:
    """Before the window is full the rate is over the time since the start."""
    clock = Clock()
    recent = Recent(clock)
    for k in range(40):
        clock.now_s += 0.25
        recent.add(float(k))
    assert recent.rate_hz() == pytest.approx(4.0)
    assert (recent.median(), recent.largest()) == (19.5, 39.0)


def test_what_is_old_is_forgotten() -> None:
    clock = Clock()
    recent = Recent(clock)
    recent.add(1000.0)
    for k in range(1, 301):
        clock.now_s += 1.0
        recent.add(float(k))
    # Those that came 60 s ago to now: 61 of them.
    assert recent.rate_hz() == pytest.approx(61 / WINDOW_S)
    assert (recent.median(), recent.largest()) == (270.0, 300.0)
    clock.now_s += WINDOW_S + 1
    assert (recent.rate_hz(), recent.median(), recent.largest()) == (0.0, None, None)
