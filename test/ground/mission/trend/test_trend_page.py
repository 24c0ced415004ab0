# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The verdict of a trend: whether the active calibration still holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import dataclasses
from pathlib import Path

import pytest
from trend_rows import made  # type: ignore[import-not-found]

from starcal_ground.mission.trend.series import Active, Change
from starcal_ground.mission.trend.trend_page import attention_of, verdict_of, write_page
from starcal_ros.records import GateCheck

# Days of calibrations, which one is active, change of each later one (px); then the verdict.
VERDICTS: Mapping[str, tuple[Sequence[int], int | None, Sequence[float], bool | None, str]] = {
    'close': ((1, 2, 3), 0, (7.0, 0.04), True, 'by up to 0.04 px, within 0.1 px: the active'),
    'differs': ((1, 2, 3), 0, (7.0, 0.4), False, 'by up to 0.4 px, not within 0.1 px: consider'),
    'newest': ((1, 2), 1, (), True, 'The active calibration is the newest one.'),
    'alone': ((1,), 0, (), None, 'There is none to compare the active calibration with.'),
    'refused': ((1, 2), None, (), None, 'None is active: the gate accepted none.'),
    'nothing': ((1,), None, (), None, 'None is active: the gate accepted none.'),
}


@pytest.mark.parametrize('name', VERDICTS)
def test_the_verdict_is_open_where_too_few_tell(name: str) -> None:
    days, place, sizes_px, expected, words = VERDICTS[name]
    rows = [made(day) for day in days]
    active = [] if place is None else [Active(place, rows[place].time_ns, 0, False)]
    new = [Change(k, 0, size_px, 0.0) for k, size_px in enumerate(sizes_px, 1)]
    is_stable, (judged, found) = verdict_of(rows, rows, active, new, [])
    assert is_stable is expected and words in judged
    assert found == f'Steps and drifts need 6 calibrations; there are {len(rows)}.'
    assert attention_of([], is_stable) == ('changed' if expected is False else '')


def test_steps_are_looked_for_in_many() -> None:
    rows = [made(day) for day in range(1, 8)]
    assert verdict_of(rows, rows, [], [], [])[1][1] == 'No step or drift was found.'


def test_without_an_active_calibration_there_is_no_table_of_them(tmp_path: Path) -> None:
    for is_accepted in (False, True):
        write_page([[dataclasses.replace(made(1), accepted=is_accepted)]], 1, tmp_path, 'fleet')
        assert ('Active calibrations' in (tmp_path / 'trend.html').read_text()) is is_accepted


@pytest.mark.parametrize(('note', 'is_missed'), [('met', False), ('missed by 0.2 px', True)])
def test_a_requirement_that_the_newest_misses_is_in_the_verdict(
    tmp_path: Path, note: str, is_missed: bool
) -> None:
    check = GateCheck('map', 'requirements', 0.7, 0.5, 'px', not is_missed, note)
    write_page([[made(1), made(2, gate=(check,))]], 1, tmp_path, 'fleet')
    page = (tmp_path / 'trend.html').read_text()
    words = 'Missed by the newest: map 0.7 px, at most 0.5 px required: missed by 0.2 px.'
    assert (words in page) is is_missed
    assert attention_of([], True, [note] * is_missed) == 'misses a requirement' * is_missed
