# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of a failure."""

from __future__ import annotations

from pathlib import Path

from starcal_ground.products import NotCalibrated
from starcal_ground.report.page import write_failure_page


def test_a_remedy_is_a_sentence_and_only_a_parameter_is_code(tmp_path: Path) -> None:
    mend = ('# no parameter mends this: record RAW images', 'search_radius_px: 40')
    record = NotCalibrated('no image matched', ('bag',), {'no_match': 3}, mend=mend)
    text = write_failure_page(record, tmp_path).read_text()
    assert '<li>No parameter mends this: record RAW images</li>' in text
    assert '<li><code>search_radius_px: 40</code></li>' in text
