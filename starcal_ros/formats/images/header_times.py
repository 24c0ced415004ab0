# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Stamp of the middle of an exposure from the header of a FITS file; FITS standard 4.0."""

from __future__ import annotations

from collections.abc import Mapping
import math
import re
from typing import Any, NamedTuple

from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.formats.images.time_systems import from_mjd, from_text, system_of, TimeError

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


class Card(NamedTuple):
    """Value and comment of a keyword."""

    value: Any
    comment: str = ''


def middle_of_exposure(header: Mapping[str, Card], key: str) -> int:
    """
    Stamp of the middle of the exposure; that of ``key`` unless it is empty.

    Raises TimeError when there is none, or a keyword is ambiguous; the text names the remedy.
    """
    if key:
        if key not in header:
            raise TimeError(f'no keyword {key} (see --time-key)')
        return _stamp(header, key)
    for name in ('DATE-AVG', 'MJD-AVG'):
        if name in header:
            return _stamp(header, name)
    for start, end in (('DATE-BEG', 'DATE-END'), ('MJD-BEG', 'MJD-END')):
        if start in header and end in header:
            first_ns, last_ns = _stamp(header, start), _stamp(header, end)
            if last_ns < first_ns:
                raise TimeError(f'{end} is before {start}: {_INSTEAD}')
            return (first_ns + last_ns) // 2
    exposure_s = _exposure_s(header)
    for name in ('DATE-BEG', 'DATE-OBS', 'MJD-OBS'):
        if name in header:
            if exposure_s is None:
                raise TimeError(
                    f'{name} is the start, and no exposure time is given: --time-key {name} '
                    'takes it as the middle'
                )
            return _stamp(header, name) + round(exposure_s * NANOSECONDS_PER_SECOND / 2)
    raise TimeError(f'no time (DATE-AVG, DATE-BEG, DATE-OBS): {_INSTEAD}')


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
        found = f'{", ".join(clocks)} differ' if clocks else 'no keyword has one'
        raise TimeError(f'{name} = {text!r} has no time of day, and {found}: {_INSTEAD}')
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
        raise TimeError(
            f'{key} is in {unit.strip()!r}, expected a unit as [s] or [ms]: {_INSTEAD}'
        )
    try:
        exposure_s = float(value) * scale_s
    except (TypeError, ValueError):
        exposure_s = math.nan
    if not 0.0 < exposure_s < math.inf:
        raise TimeError(f'{key} = {value} is not the duration of an exposure: {_INSTEAD}')
    return exposure_s
