# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The text form of a stamp."""

from __future__ import annotations

import pytest

from starcal_ros.constants import utc_text


@pytest.mark.parametrize(
    ('time_ns', 'text'),
    [
        (1_778_829_600_012_999_999, '2026-05-15 07:20:00.012 UTC'),
        (-1, '1969-12-31 23:59:59.999 UTC'),
        (10**30, f'{10**30} ns'),
    ],
)
def test_a_stamp_is_a_date_where_the_calendar_has_it(time_ns: int, text: str) -> None:
    assert utc_text(time_ns) == text
