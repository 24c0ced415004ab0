"""Stamps as people read them."""

from __future__ import annotations

from datetime import datetime, timezone

from starcal_ros.constants import NANOSECONDS_PER_SECOND


def utc_text(time_ns: int) -> str:
    """Date and time to the millisecond, ``2026-05-15 07:20:00.000 UTC``."""
    seconds, rest_ns = divmod(time_ns, NANOSECONDS_PER_SECOND)
    try:
        whole = datetime.fromtimestamp(seconds, timezone.utc)
    except (ValueError, OverflowError, OSError):
        return f'{time_ns} ns'  # not a date that a calendar has
    return f'{whole:%Y-%m-%d %H:%M:%S}.{rest_ns // 1_000_000:03d} UTC'
