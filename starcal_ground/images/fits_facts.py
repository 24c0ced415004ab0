# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Facts of FITS headers by the table `fits_keywords`: time, scale, pointing, site."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import contextlib
import math
import re
from typing import NamedTuple

import erfa
import numpy as np

from starcal_ground.fits_keywords import FACTS, stated, text_of, value_of
from starcal_ground.images.time_systems import from_mjd, from_text, system_of, SYSTEMS
from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.formats.image_files import Card

# Keywords with the time of day of a date alone: a custom older than the standard.
_CLOCKS = {
    'DATE-OBS': FACTS['time of day, of a date alone'].keywords,
    'DATE-BEG': ('TIME-BEG',),
    'DATE-END': ('TIME-END', 'UTC-END', 'UT-END', 'UTEND', 'UTSTOP'),
}
# A unit in brackets at the start of a comment (section 4.3.2), over that of the table.
_UNITS: Mapping[str, Mapping[str, float]] = {
    's': {
        's': 1.0, 'sec': 1.0, 'second': 1.0, 'ms': 1e-3, 'msec': 1e-3, 'millisecond': 1e-3,
        'us': 1e-6, 'usec': 1e-6, 'microsecond': 1e-6, 'min': 60.0, 'minute': 60.0,
        'h': 3600.0, 'hr': 3600.0, 'hour': 3600.0, 'd': 86400.0,
    },
    'mm': {'mm': 1.0, 'cm': 10.0, 'm': 1000.0},
    'um': {'um': 1.0, 'micron': 1.0, 'micrometer': 1.0, 'mm': 1000.0, 'm': 1e6},
    'arcsec': {'arcsec': 1.0, '"': 1.0, 'deg': 3600.0, 'arcmin': 60.0},
    'm': {'m': 1.0, 'km': 1000.0, 'ft': 0.3048},
}  # fmt: skip
_BRACKETS = re.compile(r'\s*\[([^]]*)\]')
# Words for another unit than seconds, in a comment without brackets.
_OTHER_UNIT = re.compile(
    r'\b(m|u|milli|micro)s(ec(ond)?s?)?\b|\bminutes?\b|\bhours?\b', re.IGNORECASE
)
_ZONE = re.compile(r'(.*:.*?)\s*(?:([+-])(\d\d):?(\d\d)|(Z|UTC?|GMT))')
_JD_OF_MJD = 2400000.5
# Two times that differ by less are the same: Julian dates of three digits, system of time.  Zones
# differ by 15 minutes, so a start and a middle of an unknown exposure may differ by some.
_SAME_TIME_S, _UNKNOWN_EXPOSURE_S = 120.0, 600.0
_SAME_SCALE = 0.1  # the search begins with a focal length within 25 %
_INSTEAD = 'give --time-key or --times'


def number_of(header: Mapping[str, Card], fact: str) -> float:
    """
    A fact in the unit of its row; NaN if it is not stated, or outside of its range.

    Raises ValueError for an exposure time in an unknown unit.
    """
    row, key = FACTS[fact], stated(header, fact)
    if not key:
        return math.nan
    value = value_of(header, key) * _unit(header, key, row.unit)
    return value if row.low <= value <= row.high else math.nan


def values_of(header: Mapping[str, Card], fact: str) -> Floats:
    """Values of all keywords of a fact; NaN where there is none."""
    return np.array([value_of(header, key) for key in FACTS[fact].keywords])


def _unit(header: Mapping[str, Card], key: str, unit: str) -> float:
    """Unit of a keyword over that of the table: by its comment, or TIMEUNIT."""
    units = _UNITS.get(unit)
    comment = str(header[key].comment)
    if units is None:
        return 1.0
    brackets = _BRACKETS.match(comment)
    words = unit
    if brackets:
        words = brackets[1].strip()
    elif unit == 's' and _OTHER_UNIT.search(comment):
        words = comment
    elif key == 'XPOSURE' and 'TIMEUNIT' in header:
        words = str(header['TIMEUNIT'].value).strip()
    name = re.split(r'/| per ', words.strip())[0].strip()
    factor = units.get(name) or units.get(name.lower().removesuffix('s'))
    if factor is None and unit == 's':  # a stamp would be wrong, without a check by the stars
        raise ValueError(f'{key} is in {words!r}, expected a unit as [s] or [ms]')
    return math.nan if factor is None else factor


class Moment(NamedTuple):
    """
    Stamp of an exposure as its header states it.

    ``is_middle`` is False for the start of an exposure whose time is not stated, ``is_utc`` where
    the zone is local or contradicted; ``doubt`` says why.
    """

    time_ns: int
    is_middle: bool = True
    is_utc: bool = True
    doubt: str = ''


class FocalLength(NamedTuple):
    """A focal length, and the keywords that state it, with the factor of a pixel of a bin."""

    focal_px: float
    keywords: str


def middle_of_exposure(header: Mapping[str, Card], key: str) -> int:
    """
    Stamp of the middle of the exposure; that of ``key`` unless it is empty.

    Raises ValueError when there is none, or a keyword is ambiguous; the text names the remedy.
    """
    if key:
        if key.upper() not in header:
            raise ValueError(f'no keyword {key} (see --time-key)')
        return _stamp(header, key.upper())[0]
    moment = moment_of(header)
    if moment.doubt:
        raise ValueError(f'{moment.doubt}: {_INSTEAD}')
    return moment.time_ns


def moment_of(header: Mapping[str, Card]) -> Moment:
    """When a header states that its image was taken; raises ValueError where it does not."""
    if name := stated(header, 'middle of the exposure'):
        exposure_s = None
        with contextlib.suppress(ValueError):  # not needed
            exposure_s = _exposure_s(header)
        return _compared(header, name, *_stamp(header, name), exposure_s)
    ends = [(f'{kind}-BEG', f'{kind}-END') for kind in ('DATE', 'MJD')]
    between = next((pair for pair in ends if pair[0] in header and pair[1] in header), None)
    exposure_s = None if between else _exposure_s(header)
    name = between[0] if between else _start(header)
    if not name:
        raise ValueError(f'no time (DATE-AVG, DATE-BEG, DATE-OBS): {_INSTEAD}')
    first_ns, is_utc = _stamp(header, name)
    if between or (exposure_s is None and (name, 'DATE-END' in header) == ('DATE-OBS', True)):
        end = between[1] if between else 'DATE-END'
        last_ns, _ = _stamp(header, end)
        if last_ns < first_ns:
            raise ValueError(f'{end} is before {name}: {_INSTEAD}')
        exposure_s = (last_ns - first_ns) / NANOSECONDS_PER_SECOND
    moment = _compared(header, name, first_ns, is_utc, exposure_s)
    if exposure_s is None:
        doubt = (
            f'{name} is the start, and no exposure time is given: --time-key {name} takes it as'
            ' the middle'
        )
        return moment._replace(is_middle=False, doubt=doubt)
    half_ns = round(exposure_s * NANOSECONDS_PER_SECOND / 2)
    return moment._replace(time_ns=first_ns + half_ns)


def _start(header: Mapping[str, Card]) -> str:
    """
    First keyword that states the start of an exposure; empty if there is none.

    Raises ValueError of the first one where all are damaged, or dates alone.
    """
    errors: list[Exception] = []
    for name in FACTS['start of the exposure'].keywords:
        if name in header and not _is_clock(header, name):
            try:
                _stamp(header, name)
            except (ValueError, OverflowError) as error:
                errors.append(error)
            else:
                return name
    if errors:
        raise errors[0]
    return ''


def _is_clock(header: Mapping[str, Card], name: str) -> bool:
    text = str(header[name].value).strip()
    return not text or (name in _CLOCKS['DATE-OBS'] and '-' not in text[:5])


def _compared(
    header: Mapping[str, Card], name: str, time_ns: int, is_utc: bool, exposure_s: float | None
) -> Moment:
    """A moment, in doubt where it is local time or another keyword states another time."""
    if not is_utc:
        system = text_of(header, 'time system')
        return Moment(
            time_ns,
            is_utc=False,
            doubt=f'time system {system!r} is not one of {", ".join(SYSTEMS)}',
        )
    for other in FACTS['start of the exposure'].keywords:
        if other == name or other not in header or _is_clock(header, other):
            continue
        with contextlib.suppress(ValueError, OverflowError):
            # A date alone, or a whole number of days, gives no time.
            if value_of(header, other) % 1.0 in (0.0, 0.5):
                continue
            off_s = (_stamp(header, other)[0] - time_ns) / NANOSECONDS_PER_SECOND
            if abs(off_s) > _SAME_TIME_S + (exposure_s or _UNKNOWN_EXPOSURE_S):
                doubt = f'{name} and {other} differ by {abs(off_s) / 3600.0:.2f} h'
                return Moment(time_ns, is_utc=False, doubt=doubt)
    return Moment(time_ns)


def _stamp(header: Mapping[str, Card], name: str) -> tuple[int, bool]:
    """Stamp of a keyword, and whether its time system is known."""
    system, is_known = 'UTC', True
    try:
        system = system_of(text_of(header, 'time system'))
    except ValueError:
        is_known = False
    value = value_of(header, name)
    if not math.isnan(value):
        days = value - (_JD_OF_MJD if name.startswith('JD') else 0.0)
        return from_mjd(days, system), is_known
    text = str(header[name].value).strip().replace('/', '-')
    if ':' in text:
        zone = _ZONE.fullmatch(text)
        if not zone:
            return from_text(text, system), is_known
        clock, sign, hours, minutes, _ = zone.groups()
        east_s = (
            (int(hours) * 3600 + int(minutes) * 60) * (-1 if sign == '-' else 1) if sign else 0
        )
        return from_text(clock, 'UTC') - east_s * NANOSECONDS_PER_SECOND, True
    clocks = [
        key
        for key in _CLOCKS.get(name, ())
        if key in header and ('T' not in str(header[key].value))
    ]
    # UT is UTC, also where TIMESYS is not.
    stamps = {
        from_text(f'{text}T{header[key].value}', 'UTC' if key.startswith('UT') else system)
        for key in clocks
    }
    if len(stamps) != 1:
        clocks_found = f'{", ".join(clocks)} differ' if clocks else 'no keyword has one'
        raise ValueError(f'{name} = {text!r} has no time of day, and {clocks_found}: {_INSTEAD}')
    return stamps.pop(), is_known or clocks[0].startswith('UT')


def _exposure_s(header: Mapping[str, Card]) -> float | None:
    key = next((key for key in FACTS['exposure time'].keywords if key in header), None)
    if key is None:
        return None
    try:
        exposure_s = number_of(header, 'exposure time')
    except ValueError as error:
        raise ValueError(f'{error}: {_INSTEAD}') from error
    if not exposure_s > 0.0:
        value = header[key].value
        raise ValueError(f'{key} = {value} is not the duration of an exposure: {_INSTEAD}')
    return exposure_s


def focal_lengths_of(header: Mapping[str, Card]) -> list[FocalLength]:
    """Focal lengths in pixels that a header states, the most direct first; none is certain."""
    found: list[FocalLength] = []
    for focal_px, keywords in _scales(header):
        other = all(abs(focal_px / one.focal_px - 1.0) > _SAME_SCALE for one in found)
        if 0.0 < focal_px < math.inf and other:
            found.append(FocalLength(focal_px, keywords))
    return found


def _scales(header: Mapping[str, Card]) -> Iterator[tuple[float, str]]:
    """All statements: of a binned image, in its own pixels and in those of the detector."""
    binning = number_of(header, 'binning')
    of_pixel = (1.0, binning, 1.0 / binning) if binning > 1.0 else (1.0,)
    step_deg = _step_deg(header)
    if step_deg > 0.0:
        yield math.degrees(1.0 / step_deg), 'WCS'
    step_rad = math.radians(number_of(header, 'pixel scale') / 3600.0)
    focal_mm, pixel_um = number_of(header, 'focal length'), number_of(header, 'pixel size')
    for factor in of_pixel:
        times = f' x {factor:g}' if factor != 1.0 else ''
        if step_rad > 0.0:
            yield 1.0 / (step_rad * factor), stated(header, 'pixel scale') + times
        if focal_mm > 0.0 and pixel_um > 0.0:
            keywords = f'{stated(header, "focal length")}, {stated(header, "pixel size")}{times}'
            yield 1000.0 * focal_mm / (pixel_um * factor), keywords


def _step_deg(header: Mapping[str, Card]) -> float:
    """Step of a column on the sky by a WCS; NaN without one of the sky."""
    kind = str(header['CTYPE1'].value).upper() if 'CTYPE1' in header else 'RA'
    if not re.match('RA|DEC|GL|EL|.LON|.LAT', kind):
        return math.nan
    column = np.nan_to_num(values_of(header, 'step of a column on the sky, both'))
    if not column.any():
        steps = values_of(header, 'steps on the sky, both')
        turn = values_of(header, 'turn of the steps, both')
        column = np.nan_to_num(steps) * ([1.0, 0.0] if np.isnan(turn[0]) else np.nan_to_num(turn))
    unit = str(header['CUNIT1'].value).strip().lower() if 'CUNIT1' in header else 'deg'
    return float(np.hypot(*column)) * {'arcsec': 1 / 3600.0, 'arcmin': 1 / 60.0}.get(unit, 1.0)


def pointing_of(header: Mapping[str, Card]) -> tuple[float, float] | None:
    """Right ascension and declination (degrees) that a header states, or None."""
    ra_deg, dec_deg = (number_of(header, name) for name in ('right ascension', 'declination'))
    return None if math.isnan(ra_deg + dec_deg) else (ra_deg, dec_deg)


def site_of(header: Mapping[str, Card]) -> tuple[float, float, float] | None:
    """Latitude, longitude (east positive, degrees) and height (m) of a header, or None."""
    geocentric = values_of(header, 'geocentric place, all three')
    if np.linalg.norm(geocentric) > 6.3e6 and 'OBSGEO-B' not in header:  # not NaN, nor zeros
        longitude_rad, latitude_rad, height_m = erfa.gc2gd(1, geocentric)  # WGS84
        return math.degrees(latitude_rad), math.degrees(longitude_rad), float(height_m)
    latitude, longitude = number_of(header, 'latitude'), number_of(header, 'longitude')
    if math.isnan(latitude + longitude) or not (latitude or longitude):
        return None
    if 'west' in header[stated(header, 'longitude')].comment.lower():
        longitude = -abs(longitude)
    longitude = (longitude + 180.0) % 360.0 - 180.0
    return latitude, longitude, float(np.nan_to_num(number_of(header, 'height')))
