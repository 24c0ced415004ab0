# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of a trend: which calibrations still hold, and which cameras of a fleet changed."""

from collections.abc import Mapping, Sequence
import dataclasses
import re

import numpy as np
import pytest
from trend_rows import DAY_NS, made  # type: ignore[import-not-found]

from bench.fleet import simulated_rows, simulated_truth, Truth
from starcal_ground.mission.trend.series import series_of
from starcal_ground.mission.trend.trend_page import verdict_of, write_page
from starcal_ground.mission.trend.trend_table import Row
from starcal_ros.arrays import Floats
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


def test_a_drift_is_in_the_headline_and_an_assumed_activation_in_the_page(tmp_path) -> None:
    for is_accepted in (False, True):
        write_page([[made(1, accepted=is_accepted)]], 1, tmp_path, 'fleet')
        assert ('No activation is rec' in (tmp_path / 'trend.html').read_text()) is is_accepted
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


@pytest.mark.parametrize(('note', 'is_missed'), [('met', False), ('missed by 0.2 px', True)])
def test_a_requirement_that_the_newest_misses_is_in_the_verdict(tmp_path, note, is_missed) -> None:
    check = GateCheck('map', 'requirements', 0.7, 0.5, 'px', not is_missed, note)
    page = write_page([[made(1), made(2, gate=(check,))]], 1, tmp_path, 'fleet')
    assert page.verdicts[0].attention == 'misses a requirement' * is_missed
    words = 'Missed by the newest: map 0.7 px, at most 0.5 px required: missed by 0.2 px.'
    assert (words in page.path.read_text()) is is_missed


MONTHS = 24
UNIT = np.eye(13)
FX, FY, CX, CY, ALIGNMENT_X = UNIT[0], UNIT[2], UNIT[3], UNIT[4], UNIT[10]
DRIFTS = (4.0 * ALIGNMENT_X, -3.0 * UNIT[11], 0.5 * (FX + FY), -0.6 * (FX + FY), 0.3 * CX)
STEPS = (0.5 * (FX + FY) - 30.0 * ALIGNMENT_X, 2.0 * CY)


def months(truth: Truth, count: int = MONTHS) -> list[Floats]:
    return [truth.of_month(month) for month in range(count)]


@pytest.mark.slow
def test_of_100_cameras_those_that_changed_are_named(tmp_path) -> None:
    rng = np.random.default_rng([30, 0])
    names = [f'sat{k:03d}' for k in range(100)]
    truths = {name: simulated_truth(rng) for name in names}
    *drifted, stepped, shaken, _, _ = rng.choice(names, 9, replace=False).tolist()
    for name, drift in zip(drifted, DRIFTS, strict=True):
        truths[name] = dataclasses.replace(truths[name], drift_per_year=drift)
    for name, step in zip((stepped, shaken), STEPS, strict=True):
        after = int(rng.integers(3, MONTHS - 4))
        truths[name] = dataclasses.replace(truths[name], step=step, step_after=after)
    of_month = {name: months(truth) for name, truth in truths.items()}
    fleet = [simulated_rows(name, of_month[name], rng) for name in names]
    write_page(fleet, len(fleet), tmp_path, 'fleet')
    found = found_in((tmp_path / 'trend.html').read_text())
    expected = dict.fromkeys(drifted, 'drift') | dict.fromkeys((stepped, shaken), 'step')
    assert found == expected


def refused(row: Row) -> Row:
    assert row.calibration is not None
    made = dataclasses.replace(row.calibration, accepted=False)
    return dataclasses.replace(row, calibration=made)


def found_in(page: str) -> dict[str, str]:
    """Cameras of a page for which something was found, in brief."""
    found = {}
    for name, text in re.findall(
        r'<tr><td class="text">(\w+), nav.*<td class="long">(.*)</td>', page
    ):
        if 'No step' not in text:
            found[name] = ' '.join(kind for kind in ('drift', 'step') if f'{kind}s of' in text)
    return found


@pytest.mark.slow
def test_each_camera_takes_5_kilobytes_and_the_largest_change_is_first(tmp_path) -> None:
    rng = np.random.default_rng(31)
    truths = {f'sat{k:04d}': simulated_truth(rng) for k in range(16)}
    every = [simulated_rows(name, months(truth), rng) for name, truth in truths.items()]
    # The newest was refused: it differs from the active one, the last before it.
    fleet = [[*rows[:-1], refused(rows[-1])] for rows in every]
    few = write_page(fleet[:10], 10, tmp_path, 'fleet').path.read_text()
    page = write_page(fleet, len(fleet), tmp_path, 'fleet')
    text = page.path.read_text()
    assert page.calibrations == 16 * MONTHS
    assert len(text.encode()) - len(few.encode()) < 6 * 5_000
    rows = re.findall(r'<tr><td class="text">sat.*</td><td>([\d.]*)</td><td class="long">', text)
    calm = [float(px or 0.0) for px in rows[text.count('<td class="text"><strong>') :]]
    assert len(rows) == 16 and calm == sorted(calm, reverse=True) and calm[0] > calm[-1]


@pytest.mark.parametrize('seed', range(4))
def test_a_drift_and_a_step_are_found_once_and_within_2_sigma(seed) -> None:
    rng = np.random.default_rng([32, seed])
    truth = dataclasses.replace(
        simulated_truth(rng), drift_per_year=40.0 * ALIGNMENT_X, step=0.5 * FX, step_after=13
    )
    found = series_of(simulated_rows('sat', months(truth), rng))
    drifts = {one.name: t for one in found for t in one.trend.terms if t.kind == 'drift'}
    steps = {one.name: t for one in found for t in one.trend.terms if t.kind == 'step'}
    # The alignment drifts by as much as the boresight, and is less well known.
    assert drifts.keys() <= {'boresight about x', 'alignment_x'} and steps.keys() == {'fx'}
    drift, step = drifts['boresight about x'], steps['fx']
    assert abs(drift.size - 40.0) < 2 * drift.sigma
    assert step.after == 13 and abs(step.size - 0.5) < 2 * step.sigma
