# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Times of any time system as UTC stamps of ROS: nanoseconds since 1970 without leap seconds.

UTC from 1972 on.  A stamp inside a leap second is that of the second after it, as in POSIX.
"""

from __future__ import annotations

from bisect import bisect_right
from datetime import date, datetime
import functools
import re

import erfa

from starcal_ros.constants import NANOSECONDS_PER_SECOND

_DAY_S = 86400
_UNIX_DAY = date(1970, 1, 1).toordinal()
_UNIX_EPOCH_MJD = 40587
_UNIX_EPOCH_JD = 2440587.5
# TT: IAU 1991 Resolution A4, recommendation IV; GPS: IS-GPS-200, since 1980-01-06.
_TAI_MINUS_NS = {
    'TAI': 0,
    'GPS': 19 * NANOSECONDS_PER_SECOND,
    'TT': -32_184_000_000,
    'TDB': -32_184_000_000,  # from the TT into which `to_utc_ns` converts TDB
}
_LAST_STAMP_NS = ((1 << 31) - 60) * NANOSECONDS_PER_SECOND  # no system is 60 s off UTC
_OTHER_NAMES = {'ET': 'TDB', 'TDT': 'TT', 'GPST': 'GPS', 'IAT': 'TAI', 'UT': 'UTC', '': 'UTC'}
SYSTEMS = ('UTC', 'TAI', 'TT', 'TDB', 'GPS')

# Date or day of the year; hour, minute, second, fraction.
_TIME = re.compile(
    r'(\d{4}-\d\d-\d\d|\d{4}-\d{3})'
    r'(?:[T ]([01]\d|2[0-3]):([0-5]\d)(?::([0-5]\d|60)(?:\.(\d*))?)?)?Z?',
    re.ASCII,
)


def system_of(name: str) -> str:
    """One of `SYSTEMS` by its name; raises ValueError for another, as local time, MET or UT1."""
    known = name.strip().upper()
    known = _OTHER_NAMES.get(known, known)
    if known not in SYSTEMS:
        raise ValueError(f'time system {name!r} is not one of {", ".join(SYSTEMS)}')
    return known


def from_text(text: str, system: str) -> int:
    """
    Stamp of a date and time, ``2026-05-15T07:20:00.5`` or ``2026-135T07:20:00.5``.

    Raises ValueError for other text, a date alone, or a time before 1972.
    """
    match = _TIME.fullmatch(text.strip())
    if not match:
        raise ValueError(f'{text!r} is not a date and time, as 2026-05-15T07:20:00.5')
    day, hour, minute, second, fraction = match.groups()
    if hour is None:
        raise ValueError(f'{text!r} has no time of day')  # midnight would be a guess
    if second == '60' and (system, hour, minute) != ('UTC', '23', '59'):
        raise ValueError(f'{text!r} is not a leap second')
    try:
        day_form = '%Y-%m-%d' if day.count('-') == 2 else '%Y-%j'
        days = datetime.strptime(day, day_form).toordinal() - _UNIX_DAY
    except ValueError as error:
        raise ValueError(f'{text!r} is not a date: {error}') from error
    in_day_s = int(hour) * 3600 + int(minute) * 60 + int(second or 0)
    count_ns = (days * _DAY_S + in_day_s) * NANOSECONDS_PER_SECOND
    return to_utc_ns(count_ns + round(float(f'0.{fraction or 0}') * 1e9), system)


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

    Raises ValueError for another system than `SYSTEMS`, or a time before 1972 or after 2038.
    """
    system = system_of(system)
    if count_ns >= _LAST_STAMP_NS:
        raise ValueError('a time after 2038-01-19, where stamps of ROS end (32 bit)')
    if system == 'UTC':
        if count_ns < _leap_seconds()[0][0]:
            raise ValueError(f'{count_ns / 1e9:.3f} s since 1970 is before 1972, where UTC begins')
        return count_ns
    if system == 'TDB':
        days = count_ns / (_DAY_S * NANOSECONDS_PER_SECOND)
        tdb_minus_tt_s = float(erfa.dtdb(_UNIX_EPOCH_JD, days, 0.0, 0.0, 0.0, 0.0))
        count_ns -= round(tdb_minus_tt_s * NANOSECONDS_PER_SECOND)
    tai_ns = count_ns + _TAI_MINUS_NS[system]
    table = _leap_seconds()
    k = bisect_right(table, tai_ns, key=sum) - 1  # a row begins at the TAI of its stamp
    if k < 0:
        raise ValueError(f'{count_ns / 1e9:.3f} s since 1970 {system} is before 1972')
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
