# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A simulated fleet: each camera that drifted or stepped is named, and no other."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import re
import subprocess

from browser import BROWSER  # type: ignore[import-not-found]
import numpy as np
import pytest

from bench.fleet import simulated_rows, simulated_truth, Truth
from starcal_ground.mission.trend.series import findings, series_of
from starcal_ground.mission.trend.trend_page import write_page
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
def test_of_200_cameras_those_that_changed_are_named(seed: int, tmp_path: Path) -> None:
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
def test_300_cameras_are_searched_and_sorted_on_a_page_of_5_kilobytes_each(tmp_path: Path) -> None:
    rng = np.random.default_rng(31)
    truths = {f'sat{k:04d}': simulated_truth(rng) for k in range(300)}
    fleet = (simulated_rows(name, months(truth), rng) for name, truth in truths.items())
    page = write_page(fleet, len(truths), tmp_path, 'fleet')
    text = (tmp_path / 'trend.html').read_text()
    assert page.calibrations == 300 * MONTHS and len(text.encode()) < 300 * 5_000
    assert text.count('<tr><td class="text">sat') == 300 and 'id="search"' in text


_USE = """<script>
const name = (row) => row.cells[0].textContent.split(',')[0];
const shown = () => [...body.rows].filter((row) => !row.hidden).map(name).join();
const search = document.getElementById('search');
const [camera, , calibrations] = table.tHead.rows[0].cells;
const views = [];
calibrations.click(); views.push(shown());
calibrations.click(); views.push(shown());
camera.click(); search.value = 'NAV sat1'; search.dispatchEvent(new Event('input'));
document.body.dataset.shown = [...views, shown()].join(';');
</script>"""


@pytest.mark.slow
@pytest.mark.packaging
@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason='no Chromium on this machine')
def test_a_browser_searches_and_sorts_the_cameras(tmp_path: Path) -> None:
    rng = np.random.default_rng(34)
    counts = {'sat2': 10, 'sat10': 9, 'sat1': 7}
    rows = [simulated_rows(k, months(simulated_truth(rng), n), rng) for k, n in counts.items()]
    write_page(rows, len(rows), tmp_path, 'fleet')
    page = (tmp_path / 'trend.html').read_text()
    used = tmp_path / 'used.html'
    used.write_text(page.replace('</body>', f'{_USE}</body>'))
    line = [BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage']
    done = subprocess.run(
        [*line, f'--user-data-dir={tmp_path / "profile"}', '--dump-dom', used.as_uri()],
        capture_output=True, text=True, check=True, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert 'data-shown="sat1,sat10,sat2;sat2,sat10,sat1;sat1,sat10"' in done.stdout


@pytest.mark.parametrize('seed', range(10))
def test_a_drift_and_a_step_are_found_once_and_within_2_sigma(seed: int) -> None:
    rng = np.random.default_rng([32, seed])
    truth = dataclasses.replace(
        simulated_truth(rng), drift_per_year=40.0 * ALIGNMENT_X, step=0.5 * FX, step_after=13
    )
    found = findings(series_of(simulated_rows('sat', months(truth), rng)))
    (drift,) = [(one.name, term) for one, term in found if term.kind == 'drift']
    (step,) = [(one.name, term) for one, term in found if term.kind == 'step']
    assert drift[0] == 'boresight about x' and abs(drift[1].size - 40.0) < 2 * drift[1].sigma
    assert (step[0], step[1].after) == ('fx', 13)
    assert abs(step[1].size - 0.5) < 2 * step[1].sigma
