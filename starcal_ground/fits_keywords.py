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
from typing import NamedTuple

from starcal_ros.formats.image_files import Card, REGION, ROW_ORDER, WITHOUT_LIGHT


class Fact(NamedTuple):
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
FACTS: Mapping[str, Fact] = {
    'middle of the exposure': Fact(('DATE-AVG', 'MJD-AVG'), 'time', _COMPARED),
    'start of the exposure': Fact(
        ('DATE-BEG', 'DATE-OBS', 'UT-OBS', 'MJD-BEG', 'MJD-OBS', 'JD-OBS', 'JD'),
        'time', _COMPARED,
    ),
    'end of the exposure': Fact(('DATE-END', 'MJD-END'), 'time', 'after the start'),
    'time of day, of a date alone': Fact(
        ('TIME-OBS', 'UTC-OBS', 'UT-OBS', 'UTSTART', 'UT-START', 'UTCSTART', 'UT', 'UTC'),
        '', 'all agree',
    ),
    'time system': Fact(('TIMESYS',), '', 'UTC, TAI, TT, TDB or GPS'),
    'exposure time': Fact(
        ('XPOSURE', 'EXPTIME', 'EXPOSURE', 'EXP_TIME', 'EXPT', 'ITIME'), 's', 'positive',
        0.0, 86400.0,
    ),
    'order of the rows': Fact(ROW_ORDER, '', 'the stars, if mirrored'),
    'mosaic': Fact(('BAYERPAT', 'COLORTYP', 'CFAPAT'), '', 'levels of the four colours'),
    'first column in the mosaic': Fact(('XBAYROFF', 'BAYOFFX'), 'px', 'as the mosaic'),
    'first row in the mosaic': Fact(('YBAYROFF', 'BAYOFFY'), 'px', 'as the mosaic'),
    'region of the image': Fact(REGION, '', _INSIDE),
    'region without light': Fact(WITHOUT_LIGHT, '', 'a strip along an edge'),
    'focal length': Fact(('FOCALLEN', 'FOCALLENGTH', 'FOCAL'), 'mm', _TRIED, 0.1, 1e6),
    'pixel size': Fact(
        ('XPIXSZ', 'PIXSIZE1', 'XPIXELSZ', 'PIXSIZE', 'CCDXPIXE'), 'um', _TRIED, 0.1, 1000.0
    ),
    'binning': Fact(('XBINNING', 'CCDXBIN', 'CCDBINX', 'BINX', 'CCDSUM'), 'px', _TRIED, 1.0, 64.0),
    'pixel scale': Fact(
        ('PIXSCALE', 'SECPIX', 'SECPIX1', 'IM_SCALE', 'PIXSCAL1'), 'arcsec', _TRIED,
        1e-3, 3600.0,
    ),
    'step of a column on the sky, both': Fact(('CD1_1', 'CD2_1'), 'deg', _TRIED),
    'steps on the sky, both': Fact(('CDELT1', 'CDELT2'), 'deg', _TRIED),
    'turn of the steps, both': Fact(('PC1_1', 'PC2_1'), '', _TRIED),
    'right ascension': Fact(
        ('CRVAL1', 'RA', 'OBJCTRA', 'RA-D', 'TELRA'), 'deg', 'stars of the catalog there',
        0.0, 360.0,
    ),
    'declination': Fact(
        ('CRVAL2', 'DEC', 'OBJCTDEC', 'DEC-D', 'TELDEC'), 'deg', 'stars of the catalog there',
        -90.0, 90.0,
    ),
    'geocentric place, all three': Fact(('OBSGEO-X', 'OBSGEO-Y', 'OBSGEO-Z'), 'm', _ABOVE),
    'latitude': Fact((*_SOUTH, 'LATITUDE', 'GEOLAT', 'OBS-LAT'), 'deg', _ABOVE, -90.0, 90.0),
    'longitude': Fact((*_EAST, 'LONGITUD', 'GEOLON', 'OBS-LONG'), 'deg', _ABOVE, -180.0, 360.0),
    'height': Fact(
        ('OBSGEO-H', 'SITEELEV', 'ALT-OBS', 'HEIGHT', 'OBS-ELEV'), 'm', 'none', -500.0, 1e5
    ),
    'saturation': Fact(('SATURATE',), 'DN', 'none', 0.0),
    'camera': Fact(('TELESCOP', 'INSTRUME'), '', 'none'),
    'kind of the frame': Fact(('IMAGETYP', 'OBSTYPE', 'FRAME'), '', 'no dark, flat or bias frame'),
}  # fmt: skip

_ANGLES = {key for row in FACTS.values() if row.unit == 'deg' for key in row.keywords}
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
