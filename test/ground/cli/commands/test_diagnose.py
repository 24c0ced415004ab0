# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal diagnose` of bags that match, and that do not."""

from __future__ import annotations

import json
from pathlib import Path

from mission_files import params_with  # type: ignore[import-not-found]
import pytest

REAL_SKY = Path(__file__).parents[5] / 'shared' / 'realsky'


@pytest.mark.slow
@pytest.mark.parametrize(
    'given',
    [
        lambda few, folder: [few, '--params', params_with(folder)],
        # More images than there are, or than most cameras take: a sound set that is refused.
        lambda few, folder: [few, '--params', params_with(folder, min_images=4)],
        lambda few, folder: [few, '--params', params_with(folder, min_coverage=1.0)],
        lambda few, _: [few, '--set', 'min_images=4'],
        lambda *_: [REAL_SKY / 'polaris'],
    ],
)
def test_it_says_that_all_fits_only_of_what_calibrate_accepts(
    given, few_images, tmp_path, starcal
) -> None:
    arguments = given(few_images, tmp_path)
    if not Path(arguments[0]).exists():
        pytest.skip('the real sky is not here')
    status, out, _ = starcal('diagnose', *arguments, '--json')
    found = json.loads(out)
    answer = starcal('calibrate', *arguments, '-o', tmp_path / 'out', '--no-report')
    assert (status == 0) == (answer.status == 0), answer.err
    assert (found['cause'] == 'none') == (status == 0)
    if answer.status:
        assert found['cause'] in ('refused', 'not_linear')
        assert found['cause'] != 'refused' or 'but starcal calibrate refuses' in found['sentence']
