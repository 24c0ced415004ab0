# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Times of any time system as UTC stamps of ROS: nanoseconds since 1970 without leap seconds.

UTC from 1972 on.  A stamp inside a leap second is that of the second after it, as in POSIX.
Headers of FITS files (FITS standard 4.0) give the middle of the exposure.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from datetime import date, datetime
import functools
import math
import re

import erfa

from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.formats.image_files import Card

_DAY_S = 86400
_UNIX_DAY = date(1970, 1, 1).toordinal()
_UNIX_EPOCH_MJD = 40587
_UNIX_EPOCH_JD = 2440587.5
# TT: IAU 1991 Resolution A4, recommendation IV; GPS: IS-GPS-200, since 1980-01-06.
_TAI_MINUS_NS = {
    'TAI': 0,
    'GPS': 19 * NANOSECONDS_PER_SECOND,
    'TT': -32_184_000_000,
    'TDB': -32_184_000_000,  # of the TT that `to_utc_ns` makes of it
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


_EXPOSURE_KEYS = ('XPOSURE', 'EXPTIME', 'EXPOSURE')  # the first is that of the standard
# Keywords with the time of day of a date alone: a custom older than the standard.
_CLOCKS = {
    'DATE-OBS': ('TIME-OBS', 'UTC-OBS', 'UT-OBS', 'UTSTART', 'UT-START', 'UTCSTART', 'UT', 'UTC'),
    'DATE-BEG': ('TIME-BEG',),
    'DATE-END': ('TIME-END', 'UTC-END', 'UT-END', 'UTEND', 'UTSTOP'),
}
_UNITS_S = {
    's': 1.0, 'sec': 1.0, 'second': 1.0,
    'ms': 1e-3, 'msec': 1e-3, 'millisecond': 1e-3,
    'us': 1e-6, 'usec': 1e-6, 'microsecond': 1e-6,
    'min': 60.0, 'minute': 60.0, 'h': 3600.0, 'hr': 3600.0, 'hour': 3600.0, 'd': 86400.0,
}  # fmt: skip
_BRACKETS = re.compile(r'\s*\[([^]]*)\]')  # unit at the start of a comment: section 4.3.2
# Words for another unit than seconds, in a comment without brackets.
_OTHER_UNIT = re.compile(
    r'\b(m|u|milli|micro)s(ec(ond)?s?)?\b|\bminutes?\b|\bhours?\b', re.IGNORECASE
)
_INSTEAD = 'give --time-key or --times'


def middle_of_exposure(header: Mapping[str, Card], key: str) -> int:
    """
    Stamp of the middle of the exposure; that of ``key`` unless it is empty.

    Raises ValueError when there is none, or a keyword is ambiguous; the text names the remedy.
    """
    if key:
        if key not in header:
            raise ValueError(f'no keyword {key} (see --time-key)')
        return _stamp(header, key)
    for name in ('DATE-AVG', 'MJD-AVG'):
        if name in header:
            return _stamp(header, name)
    for start, end in (('DATE-BEG', 'DATE-END'), ('MJD-BEG', 'MJD-END')):
        if start in header and end in header:
            first_ns, last_ns = _stamp(header, start), _stamp(header, end)
            if last_ns < first_ns:
                raise ValueError(f'{end} is before {start}: {_INSTEAD}')
            return (first_ns + last_ns) // 2
    exposure_s = _exposure_s(header)
    for name in ('DATE-BEG', 'DATE-OBS', 'MJD-OBS'):
        if name in header:
            if exposure_s is None:
                raise ValueError(
                    f'{name} is the start, and no exposure time is given: --time-key {name} '
                    'takes it as the middle'
                )
            return _stamp(header, name) + round(exposure_s * NANOSECONDS_PER_SECOND / 2)
    raise ValueError(f'no time (DATE-AVG, DATE-BEG, DATE-OBS): {_INSTEAD}')


def _stamp(header: Mapping[str, Card], name: str) -> int:
    system = system_of(str(header['TIMESYS'].value if 'TIMESYS' in header else 'UTC'))
    value = header[name].value
    if isinstance(value, (int, float)):
        return from_mjd(float(value), system)
    text = str(value).strip()
    if ':' in text:
        return from_text(text, system)
    clocks = [key for key in _CLOCKS.get(name, ()) if key in header]
    # UT is UTC, also where TIMESYS is not.
    stamps = {
        from_text(f'{text}T{header[key].value}', 'UTC' if key.startswith('UT') else system)
        for key in clocks
    }
    if len(stamps) != 1:
        clocks_found = f'{", ".join(clocks)} differ' if clocks else 'no keyword has one'
        raise ValueError(f'{name} = {text!r} has no time of day, and {clocks_found}: {_INSTEAD}')
    return stamps.pop()


def _exposure_s(header: Mapping[str, Card]) -> float | None:
    key = next((key for key in _EXPOSURE_KEYS if key in header), None)
    if key is None:
        return None
    value, comment = header[key]
    brackets = _BRACKETS.match(comment)
    unit = 's'
    if brackets:
        unit = brackets[1]
    elif _OTHER_UNIT.search(comment):
        unit = comment
    elif key == 'XPOSURE' and 'TIMEUNIT' in header:
        unit = str(header['TIMEUNIT'].value)
    scale_s = _UNITS_S.get(unit.strip()) or _UNITS_S.get(unit.strip().lower().removesuffix('s'))
    if scale_s is None:
        raise ValueError(
            f'{key} is in {unit.strip()!r}, expected a unit as [s] or [ms]: {_INSTEAD}'
        )
    try:
        exposure_s = float(value) * scale_s
    except (TypeError, ValueError):
        exposure_s = math.nan
    if not 0.0 < exposure_s < math.inf:
        raise ValueError(f'{key} = {value} is not the duration of an exposure: {_INSTEAD}')
    return exposure_s


def number(header: Mapping[str, Card], *keys: str) -> float:
    """Value of the first keyword with a number; NaN if there is none."""
    values = (header[key].value for key in keys if key in header)
    return next((float(one) for one in values if isinstance(one, (int, float))), math.nan)
