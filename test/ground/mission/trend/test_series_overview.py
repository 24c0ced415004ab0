# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated fleet: each camera that drifted or stepped is named, and no other."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from bench.fleet import simulated_rows, simulated_truth, Truth
from starcal_ground.mission.trend.series import series_of
from starcal_ground.mission.trend.trend_page import write_page
from starcal_ground.mission.trend.trend_table import Row
from starcal_ros.arrays import Floats

MONTHS = 24
UNIT = np.eye(13)
FX, FY, CX, CY, ALIGNMENT_X = UNIT[0], UNIT[2], UNIT[3], UNIT[4], UNIT[10]
DRIFTS = (4.0 * ALIGNMENT_X, -3.0 * UNIT[11], 0.5 * (FX + FY), -0.6 * (FX + FY), 0.3 * CX)
STEPS = (0.5 * (FX + FY) - 30.0 * ALIGNMENT_X, 2.0 * CY)


def months(truth: Truth, count: int = MONTHS) -> list[Floats]:
    return [truth.of_month(month) for month in range(count)]


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(3))
def test_of_200_cameras_those_that_changed_are_named(seed, tmp_path) -> None:
    rng = np.random.default_rng([30, seed])
    names = [f'sat{k:03d}' for k in range(200)]
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
    return dataclasses.replace(
        row, calibration=dataclasses.replace(row.calibration, accepted=False)
    )


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
def test_300_cameras_take_5_kilobytes_each_the_largest_change_first(tmp_path) -> None:
    rng = np.random.default_rng(31)
    truths = {f'sat{k:04d}': simulated_truth(rng) for k in range(300)}
    fleet = (simulated_rows(name, months(truth), rng) for name, truth in truths.items())
    # The newest was refused: it differs from the active one, the last before it.
    fleet = ([*rows[:-1], refused(rows[-1])] for rows in fleet)
    page = write_page(fleet, len(truths), tmp_path, 'fleet')
    text = (tmp_path / 'trend.html').read_text()
    assert page.calibrations == 300 * MONTHS and len(text.encode()) < 300 * 5_000
    rows = re.findall(r'<tr><td class="text">sat.*</td><td>([\d.]*)</td><td class="long">', text)
    calm = [float(px or 0.0) for px in rows[text.count('<td class="text"><strong>') :]]
    assert len(rows) == 300 and calm == sorted(calm, reverse=True) and calm[0] > calm[-1]


@pytest.mark.parametrize('seed', range(10))
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
