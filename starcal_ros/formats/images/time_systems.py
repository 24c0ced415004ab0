# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Times of any time system as UTC stamps of ROS: nanoseconds since 1970 without leap seconds.

UTC from 1972 on.  A stamp inside a leap second is that of the second after it, as in POSIX.
"""

from __future__ import annotations

from bisect import bisect_right
from datetime import date
import functools
import re

import erfa

from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.errors import StarcalError

_DAY_S = 86400
_UNIX_DAY = date(1970, 1, 1).toordinal()
_UNIX_EPOCH_MJD = 40587
_UNIX_EPOCH_JD = 2440587.5
_TT_MINUS_TAI_NS = 32_184_000_000  # IAU 1991 Resolution A4, recommendation IV
_TAI_MINUS_GPS_NS = 19 * NANOSECONDS_PER_SECOND  # IS-GPS-200, since 1980-01-06
_LAST_STAMP_NS = ((1 << 31) - 60) * NANOSECONDS_PER_SECOND  # no system is 60 s off UTC
_OTHER_NAMES = {'ET': 'TDB', 'TDT': 'TT', 'GPST': 'GPS', 'IAT': 'TAI', 'UT': 'UTC', '': 'UTC'}
SYSTEMS = ('UTC', 'TAI', 'TT', 'TDB', 'GPS')

_CALENDAR = re.compile(
    r'(\d{4})-(\d\d)-(\d\d)(?:[T ](\d\d):(\d\d)(?::(\d\d)(?:\.(\d*))?)?)?Z?', re.ASCII
)
_DAY_OF_YEAR = re.compile(
    r'(\d{4})-(\d{3})(?:[T ](\d\d):(\d\d)(?::(\d\d)(?:\.(\d*))?)?)?Z?', re.ASCII
)


class TimeError(StarcalError):
    """A time cannot be converted; the text names it."""


def system_of(name: str) -> str:
    """
    One of `SYSTEMS` for the name of a time system.

    Raises TimeError for another system, as local time, MET or UT1.
    """
    known = name.strip().upper()
    known = _OTHER_NAMES.get(known, known)
    if known not in SYSTEMS:
        raise TimeError(f'time system {name!r} is not one of {", ".join(SYSTEMS)}')
    return known


def from_text(text: str, system: str) -> int:
    """
    Stamp of a date and time, ``2026-05-15T07:20:00.5`` or ``2026-135T07:20:00.5``.

    Raises TimeError for other text, a date alone, or a time before 1972.
    """
    text = text.strip()
    found = _CALENDAR.fullmatch(text)
    by_day = None if found else _DAY_OF_YEAR.fullmatch(text)
    if found:
        year, month, day, *clock = found.groups()
        try:
            days = date(int(year), int(month), int(day)).toordinal() - _UNIX_DAY
        except ValueError as error:
            raise TimeError(f'{text!r} is no date: {error}') from error
    elif by_day:
        year, of_year, *clock = by_day.groups()
        if not 1 <= int(of_year) <= 366:
            raise TimeError(f'{text!r} is no date: day {of_year} of the year')
        days = date(int(year), 1, 1).toordinal() - 1 + int(of_year) - _UNIX_DAY
    else:
        raise TimeError(f'{text!r} is not a date and time, as 2026-05-15T07:20:00.5')
    if clock[0] is None:
        raise TimeError(f'{text!r} has no time of day')  # midnight would be a guess
    hour, minute, second = (int(part or 0) for part in clock[:3])
    leap = system == 'UTC' and (hour, minute, second) == (23, 59, 60)
    if hour > 23 or minute > 59 or second > 59 + leap:
        raise TimeError(f'{text!r} is no time of a day')
    fraction = (clock[3] or '')[:12].ljust(12, '0')
    in_day_ns = (hour * 3600 + minute * 60 + second) * NANOSECONDS_PER_SECOND
    in_day_ns += (int(fraction) + 500) // 1000
    return to_utc_ns(days * _DAY_S * NANOSECONDS_PER_SECOND + in_day_ns, system)


def has_clock(text: str) -> bool:
    """True if a text is not a date alone."""
    return not re.fullmatch(r'\d{4}-(\d\d-\d\d|\d{3})Z?', text, re.ASCII)


def from_mjd(days: float, system: str) -> int:
    """Stamp of a modified Julian date, exact to the microsecond of a double."""
    whole, fraction = divmod(days, 1.0)
    in_day_ns = round(fraction * _DAY_S * NANOSECONDS_PER_SECOND)
    return to_utc_ns(
        (int(whole) - _UNIX_EPOCH_MJD) * _DAY_S * NANOSECONDS_PER_SECOND + in_day_ns, system
    )


def to_utc_ns(count_ns: int, system: str) -> int:
    """
    Stamp of a count of nanoseconds in a time system since its own 1970-01-01T00:00:00.

    Raises TimeError for another system than `SYSTEMS`, or a time before 1972 or after 2038.
    """
    system = system_of(system)
    if count_ns >= _LAST_STAMP_NS:
        raise TimeError('a time after 2038-01-19, where stamps of ROS end (32 bit)')
    if system == 'UTC':
        if count_ns < _leap_seconds()[0][0]:
            raise TimeError(f'{count_ns / 1e9:.3f} s since 1970 is before 1972, where UTC begins')
        return count_ns
    if system == 'TAI':
        tai_ns = count_ns
    elif system == 'GPS':
        tai_ns = count_ns + _TAI_MINUS_GPS_NS
    else:
        if system == 'TDB':
            days = count_ns / (_DAY_S * NANOSECONDS_PER_SECOND)
            tdb_minus_tt_s = float(erfa.dtdb(_UNIX_EPOCH_JD, days, 0.0, 0.0, 0.0, 0.0))
            count_ns -= round(tdb_minus_tt_s * NANOSECONDS_PER_SECOND)
        tai_ns = count_ns - _TT_MINUS_TAI_NS
    table = _leap_seconds()
    starts = [start_ns + tai_minus_utc_ns for start_ns, tai_minus_utc_ns in table]
    k = bisect_right(starts, tai_ns) - 1
    if k < 0:
        raise TimeError(f'{count_ns / 1e9:.3f} s since 1970 {system} is before 1972')
    return tai_ns - table[k][1]


@functools.cache
def _leap_seconds() -> tuple[tuple[int, int], ...]:
    """Stamps from which TAI - UTC has a value, and that value, ns; whole seconds, since 1972."""
    rows = []
    for row in erfa.leap_seconds.get():
        if row['year'] >= 1972:
            days = date(int(row['year']), int(row['month']), 1).toordinal() - _UNIX_DAY
            seconds = round(float(row['tai_utc']))
            rows.append((days * _DAY_S * NANOSECONDS_PER_SECOND, seconds * NANOSECONDS_PER_SECOND))
    return tuple(rows)
