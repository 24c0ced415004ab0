# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What messages are made of."""

from __future__ import annotations

import pytest
from sample_records import plain, TIME_NS  # type: ignore[import-not-found]

from starcal_ros.formats.messages.message_codec import make_header, stamp_ns


@pytest.mark.parametrize('time_ns', [0, 1, 999_999_999, TIME_NS, -1])
def test_stamps_are_exact(time_ns: int) -> None:
    """A stamp keeps every nanosecond, before 1970 too."""
    header = make_header(time_ns, '', plain)
    assert 0 <= header.stamp.nanosec < 10**9
    assert stamp_ns(header.stamp) == time_ns
