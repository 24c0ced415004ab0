# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The verdict of a trend: whether the active calibration still holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import re

import pytest
from trend_rows import DAY_NS, made  # type: ignore[import-not-found]

from starcal_ground.mission.trend.series import series_of
from starcal_ground.mission.trend.trend_page import verdict_of, write_page
from starcal_ros.records import GateCheck

# Days of calibrations, which one is active, turn of the newest (arcsec); then the verdict.
VERDICTS: Mapping[str, tuple[Sequence[int], int | None, float, bool | None, str]] = {
    'close': ((1, 2, 3), 0, 2.0, True, 'by up to 0.035 px (0.048 sigma), within 0.1 px: the'),
    'differs': ((1, 2, 3), 0, 20.0, False, 'by up to 0.35 px (0.48 sigma), not within 0.1 px: '),
    'newest': ((1, 2), 1, 0.0, True, 'The active calibration is the newest one.'),
    'alone': ((1,), 0, 0.0, None, 'There is none to compare the active calibration with.'),
    'refused': ((1, 2), None, 0.0, None, 'None is active: the gate accepted none.'),
    'nothing': ((1,), None, 0.0, None, 'None is active: the gate accepted none.'),
}


@pytest.mark.parametrize('name', VERDICTS)
def test_the_verdict_is_open_where_too_few_tell(name) -> None:
    days, place, turn_arcsec, expected, words = VERDICTS[name]
    turns = [(turn_arcsec * (day == days[-1]), 0.0, 0.0) for day in days]
    stamps = [int(k == place) * day * DAY_NS for k, day in enumerate(days)]
    rows = [
        made(day, turn, active_since_ns=since_ns, accepted=False)
        for day, turn, since_ns in zip(days, turns, stamps, strict=True)
    ]
    verdict = verdict_of('camera', rows, series_of(rows))
    assert verdict.is_stable is expected and words in verdict.sentences[0]
    assert verdict.found == f'Steps and drifts need 6 calibrations; there are {len(rows)}.'
    assert verdict.attention == ('changed' if expected is False else '')
    assert verdict.word == {None: 'too few to tell', True: 'sound', False: 'changed'}[expected]
    headlines = {None: 'Too few to tell', True: '✓ Sound', False: '✕ Needs attention: changed'}
    assert verdict.headline[1] == headlines[expected]


def test_a_drift_is_in_the_headline_of_the_page(tmp_path) -> None:
    rows = [made(day, (0, 20.0 * day, 0)) for day in range(1, 9)]
    page = write_page([rows], 1, tmp_path, 'fleet')
    assert page.verdicts[0].is_stable and page.verdicts[0].word == 'drifting'
    text = page.path.read_text()
    assert '<strong>✕ Needs attention: drifting</strong>' in text and '✓' not in text


@pytest.mark.parametrize(('count', 'words'), [(5, 'Not tested: 5 of the 6'), (6, 'No change')])
def test_a_series_that_is_too_short_is_not_tested(tmp_path, count, words) -> None:
    write_page([[made(day) for day in range(1, count + 1)]], 1, tmp_path, 'fleet')
    captions = re.findall('<figcaption>(.*)</figcaption>', (tmp_path / 'trend.html').read_text())
    assert len(captions) > 10 and all(words in caption for caption in captions[1:])


def test_an_activation_that_is_assumed_is_named(tmp_path) -> None:
    for is_accepted in (False, True):
        write_page([[made(1, accepted=is_accepted)]], 1, tmp_path, 'fleet')
        assert ('No activation is rec' in (tmp_path / 'trend.html').read_text()) is is_accepted


@pytest.mark.parametrize(('note', 'is_missed'), [('met', False), ('missed by 0.2 px', True)])
def test_a_requirement_that_the_newest_misses_is_in_the_verdict(tmp_path, note, is_missed) -> None:
    check = GateCheck('map', 'requirements', 0.7, 0.5, 'px', not is_missed, note)
    page = write_page([[made(1), made(2, gate=(check,))]], 1, tmp_path, 'fleet')
    assert page.verdicts[0].attention == 'misses a requirement' * is_missed
    words = 'Missed by the newest: map 0.7 px, at most 0.5 px required: missed by 0.2 px.'
    assert (words in page.path.read_text()) is is_missed
