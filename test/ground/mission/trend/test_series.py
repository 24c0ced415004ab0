# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Series, activations and changes of calibrations whose differences are known."""

from __future__ import annotations

from export_calibrations import calibration  # type: ignore[import-not-found]
import numpy as np
import pytest
from trend_rows import DAY_NS, made  # type: ignore[import-not-found]

from starcal_ground.mission.trend.series import (
    activations,
    change,
    distinct,
    groups,
    pairs,
    series_of,
)
from starcal_ground.mission.trend.trend_table import FAILED, Row
from starcal_ros.constants import ARCSECOND_RAD


def test_boresight_and_alignment_turn_as_the_camera_does() -> None:
    rows = [made(1), made(2, (10.0, -20.0, 30.0))]
    found = {series.name: series.value for series in series_of(rows)}
    for axis, expected in zip('xyz', (10.0, -20.0, 30.0), strict=True):
        np.testing.assert_allclose(found[f'alignment_{axis}'], [0, expected], atol=1e-6)
    # The middle is 0.06 degrees off the axis: a roll of 30 arcsec moves it by 0.03.
    np.testing.assert_allclose(found['boresight about x'], [0, 10.0], atol=0.05)
    np.testing.assert_allclose(found['boresight about y'], [0, -20.0], atol=0.05)


def test_a_change_is_the_rotation_in_pixels() -> None:
    rows = [made(1, active_since_ns=1 * DAY_NS), made(2, (10.0, 0, 0)), made(3, (0, 0, 0))]
    active = activations(rows)
    assert active == [(DAY_NS, 0)] and pairs(rows, active) == [(1, 0), (2, 0)]
    first, second = (change(rows, *pair) for pair in pairs(rows, active))
    pixels = 10 * ARCSECOND_RAD * calibration().geometry.camera.parameters[0]
    assert first.px == pytest.approx(pixels, rel=0.05)  # less far off the axis
    # Each angle of both calibrations has a 1-sigma of 1e-4 rad, the parameters much less.
    assert first.sigmas == pytest.approx(10 * ARCSECOND_RAD / 2e-4, rel=0.1)
    assert (second.row, second.against) == (2, 0) and second.px < 1e-6


def test_activations_follow_one_another() -> None:
    rows = [made(1, active_since_ns=5), made(2), made(3, active_since_ns=9)]
    assert activations(rows) == [(5, 0), (9, 2)]


def test_without_activations_each_accepted_one_is_taken_as_active() -> None:
    rows = [made(1), made(2, accepted=False, reasons=('bad',)), made(3)]
    assert [k for _, k in activations(rows)] == [0, 2]
    assert pairs(rows, activations(rows)) == [(1, 0), (2, 0)]


def test_refused_calibrations_alone_were_never_active() -> None:
    rows = [made(day, accepted=False, reasons=('bad',)) for day in (1, 2)]
    assert activations(rows) == [] and pairs(rows, []) == []


def test_a_calibration_that_was_activated_twice_counts_once_in_a_series() -> None:
    rows = [made(1, active_since_ns=5), made(2, active_since_ns=8), made(1, active_since_ns=9)]
    assert [row.stamp for row in distinct(rows)] == ['1', '2']
    assert [k for _, k in activations(rows)] == [0, 1, 2]


def test_cameras_are_apart_and_failures_are_none() -> None:
    other = made(2, child_frame='other')
    rows = [made(1), other, made(3), Row('x', 'x', FAILED, error='bad')]
    assert [len(group) for group in groups(rows).values()] == [2, 1]
