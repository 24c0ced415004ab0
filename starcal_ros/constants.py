# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Physical and angular constants, each with its authority; texts of a stamp and of the version."""

from __future__ import annotations

from datetime import datetime, timezone
import math

ARCSECOND_RAD = math.pi / 648000.0  # definition
# The Parker Solar Probe, the fastest spacecraft, has 192 km/s at 9.9 radii of the Sun.  300 km/s
# are reached by a fall to four radii, and are far below the speed of the Earth in cm/s.
FASTEST_M_S = 300e3
SPEED_OF_LIGHT_M_S = 299792458.0  # SI, exact
AU_M = 149597870700.0  # IAU 2012 Resolution B2, exact
NANOSECONDS_PER_SECOND = 1_000_000_000
SECONDS_PER_YEAR = 365.25 * 86400.0  # Julian year, IAU
CLOCKS_SET_NS = 631_152_000_000_000_000  # 1990-01-01: clocks that were never set are before it


def utc_text(time_ns: int) -> str:
    """Date and time to the millisecond, ``2026-05-15 07:20:00.000 UTC``."""
    seconds, rest_ns = divmod(time_ns, NANOSECONDS_PER_SECOND)
    try:
        whole = datetime.fromtimestamp(seconds, timezone.utc)
    except (ValueError, OverflowError, OSError):
        return f'{time_ns} ns'  # outside the calendar of datetime
    return f'{whole:%Y-%m-%d %H:%M:%S}.{rest_ns // 1_000_000:03d} UTC'


MAX_STAMP_NS = 2**31 * NANOSECONDS_PER_SECOND - 1  # builtin_interfaces/Time: int32 seconds


def software_version() -> str:
    """Version of the installed package; 'unknown' in a source tree that is not installed."""
    from importlib import metadata

    try:
        return metadata.version('starcal_ros')
    except metadata.PackageNotFoundError:
        return 'unknown'
