# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal diagnose` of bags that match, and that do not."""

from __future__ import annotations

import json
from pathlib import Path

from mission_files import params_with, TINY  # type: ignore[import-not-found]
import pytest
import yaml

REAL_SKY = Path(__file__).parents[5] / 'shared' / 'realsky'


def _of_camera(folder: Path, **numbers: float) -> list[str]:
    """Arguments for the tiny bag with other numbers in its camera matrix."""
    content = yaml.safe_load((TINY / 'camera.yaml').read_text())
    for name, value in numbers.items():
        content['camera_matrix']['data'][{'cx': 2, 'cy': 5}[name]] = value
    path = folder / 'camera.yaml'
    path.write_text(yaml.safe_dump(content))
    return [str(TINY), '--params', str(params_with(folder, camera_info_url=str(path)))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ('given', 'cause'),
    [
        (lambda folder: [str(TINY), '--params', str(params_with(folder))], 'none'),
        (lambda folder: _of_camera(folder, cx=511.5, cy=383.5), 'principal_point'),
        # More images than there are, or than most cameras take: a sound set that is refused.
        (lambda folder: [str(TINY), '--params', str(params_with(folder, min_images=11))], None),
        (lambda folder: [str(TINY), '--params', str(params_with(folder, min_coverage=1.0))], None),
        (lambda folder: [str(TINY), '--set', 'min_images=11'], None),
        (lambda folder: [str(REAL_SKY / 'polaris')], None),
    ],
)
def test_it_says_that_all_fits_only_of_what_calibrate_accepts(
    given, cause, tmp_path, starcal
) -> None:
    arguments = given(tmp_path)
    if not Path(arguments[0]).exists():
        pytest.skip('the real sky is not here')
    status, out, _ = starcal('diagnose', *arguments, '--json')
    found = json.loads(out)
    answer = starcal('calibrate', *arguments, '-o', tmp_path / 'out', '--no-report')
    assert (status == 0) == (answer.status == 0), answer.err
    assert (found['cause'] == 'none') == (status == 0)
    assert cause in (None, found['cause'])
    if cause is None and answer.status:
        assert found['cause'] in ('refused', 'not_linear')
        assert found['cause'] != 'refused' or 'but starcal calibrate refuses' in found['sentence']
