# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A drift of the simulated camera over the dates of its bags, as a trend finds it."""

from __future__ import annotations

from datetime import datetime, timezone
import json
from pathlib import Path

import numpy as np
import pytest

from starcal_ground.cli.main import main
from starcal_ground.mission.trend.series import series_of
from starcal_ground.mission.trend.trend_table import Table
from starcal_ground.simulation.scenario import at_date, scenario
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SECONDS_PER_YEAR

YEAR_NS = round(SECONDS_PER_YEAR) * NANOSECONDS_PER_SECOND
CAMPAIGNS = 6  # the fewest that a trend tests
FOCAL_PPM, TURN_ARCSEC = 200.0, 30.0  # a year


def test_a_drift_is_linear_from_the_date_of_the_scenario() -> None:
    made = scenario('tiny')
    assert at_date(made, made.start_ns, FOCAL_PPM, TURN_ARCSEC).time_ns(3) == made.time_ns(3)
    for years in (-1, 0, 3):
        later = at_date(made, made.start_ns + years * YEAR_NS, FOCAL_PPM, TURN_ARCSEC)
        before, after = made.truth, later.truth
        grown = after.camera.parameters[[0, 2]] / before.camera.parameters[[0, 2]] - 1.0
        # Roundings of a focal length of 1800 px, which is about 1.
        np.testing.assert_allclose(grown, 1e-6 * FOCAL_PPM * years, rtol=0, atol=1e-15)
        turn = before.star_tracker_from_camera.inv() * after.star_tracker_from_camera
        expected = [TURN_ARCSEC * ARCSECOND_RAD * years, 0.0, 0.0]
        np.testing.assert_allclose(turn.as_rotvec(), expected, rtol=0, atol=1e-15)  # rounding
        assert later.prior is made.prior


@pytest.mark.slow
def test_a_trend_finds_the_drift_of_simulated_bags(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for k in range(CAMPAIGNS):
        bag, out = tmp_path / 'bags' / str(k), tmp_path / 'mission' / str(k)
        camera = ['--scenario', 'tiny', '--images', '4', '--seed', str(k), '--camera-seed', '1']
        drifts = ['--focal-drift', str(FOCAL_PPM), '--alignment-drift', str(TURN_ARCSEC)]
        date = ['--date', f'{2026 + k}-05-15T07:20:00']
        assert main(['simulate', '-o', str(bag), *camera, *drifts, *date]) == 0
        start = datetime.fromtimestamp(
            json.loads((bag / 'truth.json').read_text())['t0'], timezone.utc
        )
        assert f'{start:%Y-%m-%dT%H:%M}' == f'{2026 + k}-05-15T07:20'
        params = ['--params', str(bag / 'params.yaml'), '--no-report', '--quiet']
        assert main(['calibrate', str(bag), '-o', str(out), *params]) in (0, 3)
    capsys.readouterr()
    assert main(['trend', str(tmp_path / 'mission'), '-o', str(tmp_path / 'trend')]) == 0
    said = ' '.join(capsys.readouterr().out.split())
    assert 'drifting' in said and 'Found: drifts of fx, fy, boresight about x.' in said
    (rows,) = Table(tmp_path / 'trend').cameras()
    found = {one.name: term for one in series_of(rows) for term in one.trend.terms}
    focal_px = scenario('tiny').truth.camera.parameters[0]
    for name, per_year in (
        ('fx', 1e-6 * FOCAL_PPM * focal_px),
        ('boresight about x', TURN_ARCSEC),
    ):
        off = (abs(found[name].size) - per_year) / found[name].sigma
        assert abs(off) < 4.0  # one in 16,000 good ones is beyond
