# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal diagnose`, and what `inspect` says where no image matches."""

from __future__ import annotations

import json
from pathlib import Path

from mission_files import params_with, TINY  # type: ignore[import-not-found]
import pytest

from starcal_ground.cli import main
from starcal_ground.diagnosis.diagnose import CAUSES


@pytest.fixture
def wrong_params(tmp_path: Path) -> Path:
    """The parameters of the tiny bag with the conjugate of the attitudes asked for."""
    path: Path = params_with(tmp_path, attitude_direction='inertial_to_st')
    return path


def test_nothing_wrong(capsys: pytest.CaptureFixture[str]) -> None:
    status = main.main(['diagnose', str(TINY), '--params', str(TINY / 'params.yaml'), '--json'])
    found = json.loads(capsys.readouterr().out)
    assert (status, found['cause'], found['found'], found['mend']) == (0, 'none', None, [])
    assert found['cause'] in CAUSES and len(found['evidence']) == 3


def test_the_cause_and_its_remedy(wrong_params: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = main.main(['diagnose', str(TINY), '--params', str(wrong_params)])
    lines = capsys.readouterr().out.splitlines()
    assert status == 3
    assert lines[0] == (
        'The attitude quaternions are st_to_inertial (x, y, z, w), not inertial_to_st.'
    )
    assert lines[-1].strip() == 'attitude_direction: st_to_inertial'


@pytest.mark.slow
def test_inspect_ends_with_it(wrong_params: Path, capsys: pytest.CaptureFixture[str]) -> None:
    params = ['--params', str(wrong_params)]
    assert main.main(['inspect', str(TINY), *params, '--json']) == 3
    problems = json.loads(capsys.readouterr().out)['problems']
    assert 'Set attitude_direction: st_to_inertial.' in problems[-1]
