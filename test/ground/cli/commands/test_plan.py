# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal plan`: table, CSV, JSON, and bad input."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

TINY = Path(__file__).parents[4] / 'bags' / 'tiny'
_PARAMS = ['--params', str(TINY / 'params.yaml')]


@pytest.fixture
def allowed(tmp_path: Path) -> Path:
    path = tmp_path / 'allowed.csv'
    path.write_text('ra_deg,dec_deg\n10,40\n100,-20\n200,50\n')
    return path


@pytest.mark.slow
def test_the_table_and_the_file_say_the_same(allowed, tiny_products, tmp_path, starcal) -> None:
    output = tmp_path / 'plan.csv'
    observed = [str(tiny_products / 'observations.mcap'), *_PARAMS]
    given = ['--pointings', str(allowed), '--images', '5', '--minimise', 'map']
    shown = starcal('plan', *observed, *given, '-o', output).out.splitlines()
    with output.open() as file:
        rows = list(csv.DictReader(file))
    assert sorted(float(row['ra_deg']) for row in rows) == [10.0, 100.0, 200.0]
    for line, row in zip(shown[2:], rows, strict=False):
        assert float(line.split()[-1]) == pytest.approx(float(row['map_rms_arcsec']), rel=1e-3)
    assert 'no other pointing can be reached after image 3' in shown
    content = json.loads(starcal('plan', *observed, *given[:2], '--images', 1, '--json').out)
    assert content['name'] == 'line_of_sight_rms_arcsec' and len(content['steps']) == 1
