# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The commands for missions, as a person types them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from export_calibrations import calibration  # type: ignore[import-not-found]
import pytest
import spiceypy

from starcal_ground.written_files import write_calibration


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / 'out').mkdir()
    write_calibration(calibration(), tmp_path / 'out/calibration.json')
    return tmp_path / 'out'


def test_export_writes_kernels_that_load(folder, tmp_path, starcal) -> None:
    kernels = tmp_path / 'deep/kernels'
    line = (
        f'export {folder} --to spice -o {kernels} --spacecraft-id -999 --star-tracker-id -999100'
    )
    out = starcal(*line.split()).out
    assert 'largest error of a pixel against the calibration: 0 px' in out
    spiceypy.kclear()
    for path in kernels.iterdir():
        spiceypy.furnsh(str(path))
    assert spiceypy.pxform('CAMERA_OPTICAL_FRAME', 'STAR_TRACKER', 0.0).shape == (3, 3)
    spiceypy.kclear()


@pytest.mark.parametrize('accepted', [True, False])
def test_export_states_the_cost_of_each_part_and_a_refusal_by_the_gate(
    folder, tmp_path, starcal, accepted
) -> None:
    reasons = () if accepted else ('error of the map 2 px, limit 0.1 px',)
    judged = dataclasses.replace(calibration(), accepted=accepted, reasons=reasons)
    write_calibration(judged, folder / 'calibration.json')
    answer = starcal('export', folder, '--to', 'opencv', '-o', tmp_path)
    expected = [f'starcal: warning: the gate refused this calibration: {one}' for one in reasons]
    assert (answer.status, answer.err.splitlines()) == (0, expected)
    lines = answer.out.splitlines()
    assert lines[1].startswith('largest error') and lines[2].startswith('left out: skew, 0.')
