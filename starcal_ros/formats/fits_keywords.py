# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The table of FITS keywords: which keywords state a fact, in which unit, within which range.

Names are those of the FITS standard 4.0 and of programs for amateur and professional cameras.  A
value is only a statement: what it is compared with stands in the column ``check``.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
import re
from typing import Any, NamedTuple

import numpy as np

from starcal_ros.arrays import Floats


class Card(NamedTuple):
    """Value and comment of a FITS keyword."""

    value: Any
    comment: str = ''


class Row(NamedTuple):
    """
    Keywords of a fact, of which the first counts; ``unit`` is empty for a text.

    ``low`` to ``high`` is the range of a number, ``check`` what is done with the fact.
    """

    keywords: tuple[str, ...]
    unit: str
    check: str
    low: float = -math.inf
    high: float = math.inf


_COMPARED = 'other times within two minutes, else the zone is taken as not known'
_TRIED = 'tried beside the other statements of the scale; the stars decide'
_ABOVE = 'the stars are above the horizon'
_INSIDE = 'lies in the image; of the size of the image: already cut'
_SOUTH, _EAST = ('OBSGEO-B', 'SITELAT', 'LAT-OBS'), ('OBSGEO-L', 'SITELONG', 'LONG-OBS')
FACTS: Mapping[str, Row] = {
    'middle of the exposure': Row(('DATE-AVG', 'MJD-AVG'), 'time', _COMPARED),
    'start of the exposure': Row(
        ('DATE-BEG', 'DATE-OBS', 'UT-OBS', 'MJD-BEG', 'MJD-OBS', 'JD-OBS', 'JD'),
        'time', _COMPARED,
    ),
    'end of the exposure': Row(('DATE-END', 'MJD-END'), 'time', 'after the start'),
    'time of day, of a date alone': Row(
        ('TIME-OBS', 'UTC-OBS', 'UT-OBS', 'UTSTART', 'UT-START', 'UTCSTART', 'UT', 'UTC'),
        '', 'all agree',
    ),
    'time system': Row(('TIMESYS',), '', 'UTC, TAI, TT, TDB or GPS'),
    'exposure time': Row(
        ('XPOSURE', 'EXPTIME', 'EXPOSURE', 'EXP_TIME', 'EXPT', 'ITIME'), 's', 'positive',
        0.0, 86400.0,
    ),
    'order of the rows': Row(('ROWORDER',), '', 'the stars, if mirrored'),
    'mosaic': Row(('BAYERPAT', 'COLORTYP', 'CFAPAT'), '', 'levels of the four colours'),
    'first column in the mosaic': Row(('XBAYROFF', 'BAYOFFX'), 'px', 'as the mosaic'),
    'first row in the mosaic': Row(('YBAYROFF', 'BAYOFFY'), 'px', 'as the mosaic'),
    'region of the image': Row(('TRIMSEC', 'DATASEC'), '', _INSIDE),
    'region without light': Row(('BIASSEC',), '', 'a strip along an edge'),
    'focal length': Row(('FOCALLEN', 'FOCALLENGTH', 'FOCAL'), 'mm', _TRIED, 0.1, 1e6),
    'pixel size': Row(
        ('XPIXSZ', 'PIXSIZE1', 'XPIXELSZ', 'PIXSIZE', 'CCDXPIXE'), 'um', _TRIED, 0.1, 1000.0
    ),
    'binning': Row(('XBINNING', 'CCDXBIN', 'CCDBINX', 'BINX', 'CCDSUM'), 'px', _TRIED, 1.0, 64.0),
    'pixel scale': Row(
        ('PIXSCALE', 'SECPIX', 'SECPIX1', 'IM_SCALE', 'PIXSCAL1'), 'arcsec', _TRIED,
        1e-3, 3600.0,
    ),
    'step of a column on the sky, both': Row(('CD1_1', 'CD2_1'), 'deg', _TRIED),
    'steps on the sky, both': Row(('CDELT1', 'CDELT2'), 'deg', _TRIED),
    'turn of the steps, both': Row(('PC1_1', 'PC2_1'), '', _TRIED),
    'right ascension': Row(
        ('CRVAL1', 'RA', 'OBJCTRA', 'RA-D', 'TELRA'), 'deg', 'stars of the catalog there',
        0.0, 360.0,
    ),
    'declination': Row(
        ('CRVAL2', 'DEC', 'OBJCTDEC', 'DEC-D', 'TELDEC'), 'deg', 'stars of the catalog there',
        -90.0, 90.0,
    ),
    'geocentric place, all three': Row(('OBSGEO-X', 'OBSGEO-Y', 'OBSGEO-Z'), 'm', _ABOVE),
    'latitude': Row((*_SOUTH, 'LATITUDE', 'GEOLAT', 'OBS-LAT'), 'deg', _ABOVE, -90.0, 90.0),
    'longitude': Row((*_EAST, 'LONGITUD', 'GEOLON', 'OBS-LONG'), 'deg', _ABOVE, -180.0, 360.0),
    'height': Row(
        ('OBSGEO-H', 'SITEELEV', 'ALT-OBS', 'HEIGHT', 'OBS-ELEV'), 'm', 'none', -500.0, 1e5
    ),
    'saturation': Row(('SATURATE',), 'DN', 'none', 0.0),
    'camera': Row(('TELESCOP', 'INSTRUME'), '', 'none'),
    'kind of the frame': Row(('IMAGETYP', 'OBSTYPE', 'FRAME'), '', 'no dark, flat or bias frame'),
}  # fmt: skip

_ANGLES = {key for row in FACTS.values() if row.unit == 'deg' for key in row.keywords}
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
_SEXAGESIMAL = re.compile(r'([+-]?)(\d+)[:\s](\d+)(?:[:\s](\d+(?:\.\d*)?))?\s*([NSEW]?)', re.I)


def stated(header: Mapping[str, Card], fact: str) -> str:
    """Return the first keyword that states a fact, empty if there is none."""
    row = FACTS[fact]
    for key in row.keywords:
        if key in header and (row.unit in ('', 'time') or not math.isnan(_value(header, key))):
            return key
    return ''


def text_of(header: Mapping[str, Card], fact: str) -> str:
    """Text of a fact, empty if there is none."""
    key = stated(header, fact)
    return str(header[key].value).strip() if key else ''


def number_of(header: Mapping[str, Card], fact: str) -> float:
    """
    A fact in the unit of its row; NaN if it is not stated, or outside of its range.

    Raises ValueError for an exposure time in an unknown unit.
    """
    row, key = FACTS[fact], stated(header, fact)
    if not key:
        return math.nan
    value = _value(header, key) * _unit(header, key, row.unit)
    return value if row.low <= value <= row.high else math.nan


def values_of(header: Mapping[str, Card], fact: str) -> Floats:
    """Values of all keywords of a fact; NaN where there is none."""
    return np.array([value_of(header, key) for key in FACTS[fact].keywords])


def value_of(header: Mapping[str, Card], key: str) -> float:
    """Value of a keyword as a number; NaN if it is none."""
    return _value(header, key) if key in header else math.nan


def _value(header: Mapping[str, Card], key: str) -> float:
    """Number of a card; angles in sexagesimal text are degrees, right ascensions hours."""
    value = header[key].value
    if isinstance(value, bool):
        return math.nan
    if isinstance(value, (int, float)):
        return float(value)
    words = str(value).strip()
    if key in _ANGLES and (angle := _SEXAGESIMAL.fullmatch(words)):
        sign, *parts, side = angle.groups()
        degrees = sum(float(part or 0) / 60.0**k for k, part in enumerate(parts))
        turned = sign == '-' or side.upper() in ('S', 'W')
        hours = 15.0 if key in FACTS['right ascension'].keywords else 1.0
        return math.copysign(hours * degrees, -1.0 if turned else 1.0)
    try:
        return float((words.split() or [''])[0].upper().replace('D', 'E'))
    except ValueError:
        return math.nan


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
