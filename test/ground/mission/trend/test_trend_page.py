# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The verdict of a trend: whether the active calibration still holds."""

from __future__ import annotations

import pytest
from trend_rows import made  # type: ignore[import-not-found]

from starcal_ground.mission.trend.series import Active, Change
from starcal_ground.mission.trend.trend_page import verdict_of


@pytest.mark.parametrize(('size_px', 'holds'), [(0.04, True), (0.4, False)])
def test_the_newest_calibration_decides(size_px: float, holds: bool) -> None:
    rows = [made(day) for day in (1, 2, 3)]
    active = [Active(0, rows[0].time_ns, 0, False)]
    new = [Change(2, 0, size_px, 0.0), Change(1, 0, 7.0, 0.0)]
    is_stable, (judged, found) = verdict_of(rows, active, new, [])
    assert is_stable is holds
    assert f'by up to {size_px:g} px' in judged and ('holds' in judged) is holds
    assert found == 'No step or drift was found.'


def test_an_active_calibration_that_is_the_newest_holds() -> None:
    rows = [made(day) for day in (1, 2)]
    active = [Active(1, rows[1].time_ns, 0, True)]
    is_stable, (judged, _) = verdict_of(rows, active, [Change(1, 0, 9.0, 0.0)], [])
    assert is_stable and judged == 'The active calibration is the newest one.'
