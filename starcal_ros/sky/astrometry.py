# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Apparent directions of catalog stars: motion, parallax, light bending, aberration, refraction.

The chain of the IAU astrometric model in the order of ERFA's ``atciq``: ICRS place at epoch ->
proper motion and parallax (``pmpx``) -> bending of light by the Sun (``ldsun``) -> aberration
(``ab``), stopped before precession and nutation so that the axes stay those of the ICRS.

For a camera on the ground, diurnal aberration and refraction follow (``atioq``); the result is
rotated back to the axes of the ICRS.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import math

import erfa
import numpy as np

from starcal_ros.arrays import Floats, Rows
from starcal_ros.constants import (
    ARCSECOND_RAD,
    AU_M,
    FASTEST_M_S,
    NANOSECONDS_PER_SECOND,
    SPEED_OF_LIGHT_M_S,
)
from starcal_ros.options import option
from starcal_ros.sky.catalog import StarCatalog

SIDEREAL_RAD_S = 7.292115e-5  # GRS 1980, rotation of the Earth
_WEATHER = 0.057  # relative 1-sigma of the refraction at a site: 15 K of 283 K, 20 hPa of 1013 hPa
LEAST_COSINE = 0.17  # 80 degrees of zenith distance, where A tan z + B tan^3 z is off by 1 arcsec
_UNIX_EPOCH_JD = 2440587.5  # 1970-01-01T00:00 UTC, POSIX
_DAY_S = 86400
_AU_PER_DAY_C = AU_M / _DAY_S / SPEED_OF_LIGHT_M_S
_TT_MINUS_TAI_S = 32.184  # IAU 1991 Resolution A4, recommendation IV
_J2000_JD = 2451545.0  # IAU 1994, epoch J2000.0
_JULIAN_YEAR_DAYS = 365.25  # IAU, definition
_UTC_START_JD = 2436934.5  # 1960-01-01, where UTC and ERFA's dat begin
# Refraction changes by less than 0.1 % with the humidity.  From 0.55 to 1 micrometre it changes by
# 1.4 %, or 2 arcsec at 20 degrees of elevation, most of it common to all stars of an image.
RELATIVE_HUMIDITY = 0.5
WAVELENGTH_UM = 0.55
MIN_ELEVATION_DEG = 10.0  # nearer to the horizon the refraction model is off by over 1 arcsec


@dataclass(frozen=True)
class SiteOptions:
    """Site of the camera, in space or on the ground."""

    observer: str = option(
        'space',
        'location of the camera; ground: refraction and the rotation of the Earth are modelled,'
        ' and velocity inputs are ignored; without a site, which the nodes need, starcal finds the'
        ' air by the stars',
        choices=('space', 'ground'),
    )
    latitude_deg: float = option(
        0.0, 'geodetic latitude of the site (WGS84), degrees', low=-90.0, high=90.0
    )
    longitude_deg: float = option(
        0.0, 'longitude of the site, east positive, degrees', low=-180.0, high=360.0
    )
    height_m: float = option(
        0.0, 'height of the site above the ellipsoid, m', low=-500.0, high=100000.0
    )
    observer_velocity_m_s: tuple[float, ...] = option(
        (0.0, 0.0, 0.0),
        'barycentric velocity of the observer along the ICRF axes, m/s, used without a velocity'
        " message; zeros: the Earth's velocity, with the uncertainty of an orbit",
        low=-FASTEST_M_S,
        high=FASTEST_M_S,
        length=3,
    )
    # The air at the site, constant in flight: ten degrees change a refraction of 60 arcsec by
    # 2 arcsec, nearly the same for all stars of an image.  Zero means the pressure at the height.
    air_pressure_hpa: float = 0.0
    air_temperature_degc: float = 10.0

    @property
    def is_known(self) -> bool:
        """True if a place on the ground is stated; none is where both angles are zero."""
        return self.observer == 'ground' and bool(self.latitude_deg or self.longitude_deg)


@dataclass(frozen=True)
class Velocity:
    """
    Barycentric velocity of the observer, ICRF axes.

    Attributes
    ----------
    m_s : (3,) or None
        Velocity; None for that of the Earth.
    sigma_m_s : float
        1-sigma of each component; NaN if unknown.
    """

    m_s: Floats | None = None
    sigma_m_s: float = math.nan


EARTH = Velocity()
"""Velocity of the Earth, used where that of the observer is unknown."""
# The last sample of telemetry is up to a second old, in which an orbital velocity changes by this.
GIVEN_SIGMA_M_S = 10.0
# In an orbit about the Earth a velocity is less than this about the Earth, and more about the
# barycentre.
ESCAPE_M_S = 11.2e3


def velocity_of(site: SiteOptions, measured_m_s: Floats | None) -> Velocity:
    """
    Velocity of the observer from a message (3,), or from the options without one.

    The sigma of a velocity that may be one about the Earth is not known.
    """
    if site.observer == 'ground':  # a date is as uncertain as the site
        return Velocity(None, 0.0) if site.is_known else EARTH
    if measured_m_s is None and any(site.observer_velocity_m_s):
        measured_m_s = np.array(site.observer_velocity_m_s)
    if measured_m_s is None:
        return EARTH
    is_slow = np.linalg.norm(measured_m_s) < ESCAPE_M_S
    return Velocity(measured_m_s, math.nan if is_slow else GIVEN_SIGMA_M_S)


@functools.lru_cache(maxsize=16)  # several functions ask for the time of an image
def tt_julian_date(time_unix_ns: int) -> tuple[float, float]:
    """
    Terrestrial time as a two-part Julian date (day at 0h, fraction), accurate to 0.1 ns.

    After the last leap second in ERFA's table, its TAI - UTC is used; ERFA does the same, but
    warns for dates more than five years later. Raises ValueError before 1960, the start of UTC.

    Parameters
    ----------
    time_unix_ns : int
        UTC as in a ROS stamp: nanoseconds since 1970 without leap seconds.
    """
    day, in_day_ns = divmod(int(time_unix_ns), _DAY_S * NANOSECONDS_PER_SECOND)
    day_jd = _UNIX_EPOCH_JD + day
    if day_jd < _UTC_START_JD:
        raise ValueError(f'time_unix_ns is {time_unix_ns}, expected a time from 1960 on')
    year, month, day_of_month, _ = erfa.jd2cal(day_jd, 0.0)
    last = erfa.leap_seconds.get()[-1]
    if (year, month) >= (last['year'], last['month']):
        tai_minus_utc_s = float(last['tai_utc'])
    else:
        fraction = in_day_ns / (_DAY_S * NANOSECONDS_PER_SECOND)
        tai_minus_utc_s = float(erfa.dat(year, month, day_of_month, fraction))
    rest_s = in_day_ns / NANOSECONDS_PER_SECOND + tai_minus_utc_s + _TT_MINUS_TAI_S
    return day_jd, rest_s / _DAY_S


def julian_year(time_unix_ns: int) -> float:
    """Julian epoch (TT) of a POSIX time in nanoseconds."""
    day_jd, rest_days = tt_julian_date(time_unix_ns)
    return 2000.0 + (day_jd - _J2000_JD + rest_days) / _JULIAN_YEAR_DAYS


def earth_velocity_c(time_unix_ns: int) -> Floats:
    """Barycentric velocity (3,) of the Earth, axes of the ICRS, in units of the speed of light."""
    _, barycentric = erfa.epv00(*tt_julian_date(time_unix_ns))
    return np.asarray(barycentric['v'] * _AU_PER_DAY_C)


def apparent_directions(
    stars: StarCatalog,
    time_unix_ns: int,
    observer_velocity_m_s: Floats | None = None,
    rows: Rows | slice = slice(None),
) -> Floats:
    """
    Apparent directions of catalog stars: unit vectors (n, 3) along the axes of the ICRS.

    Proper motion, parallax, light bending by the Sun and stellar aberration are applied; the
    radial velocity is assumed zero.  Takes 0.05 ms plus 0.1 ms per thousand stars.

    The observer is at the centre of the Earth: another position changes the parallax by 6 mas for
    the nearest star at the distance of the Moon.  TT replaces TDB; they differ by at most 2 ms, or
    60 m along the Earth's orbit.

    Parameters
    ----------
    stars : StarCatalog
    time_unix_ns : int
        As for `tt_julian_date`.
    observer_velocity_m_s : (3,), optional
        Barycentric velocity of the observer, axes of the ICRS; default: that of the Earth.
    rows : (n,), optional
        Rows of the catalog; default: all.
    """
    day_jd, rest_days = tt_julian_date(time_unix_ns)
    heliocentric, barycentric = erfa.epv00(day_jd, rest_days)
    if observer_velocity_m_s is None:
        velocity_c = barycentric['v'] * _AU_PER_DAY_C
    else:
        velocity_c = np.asarray(observer_velocity_m_s, np.float64) / SPEED_OF_LIGHT_M_S
        if velocity_c.shape != (3,) or not np.linalg.norm(velocity_c) < 1:
            raise ValueError(
                f'observer_velocity_m_s is {observer_velocity_m_s!r}, expected three numbers below'
                ' light speed'
            )
    sun_distance_au = float(np.linalg.norm(heliocentric['p']))
    natural = erfa.pmpx(
        stars.ra_rad[rows],
        stars.dec_rad[rows],
        # ERFA takes the proper motion in right ascension as a coordinate rate.
        stars.pm_ra_cosdec_rad_per_year[rows] / np.cos(stars.dec_rad[rows]),
        stars.pm_dec_rad_per_year[rows],
        stars.parallax_rad[rows] / erfa.DAS2R,  # only parallax is in arcseconds
        0.0,
        julian_year(time_unix_ns) - stars.epoch_jyear,
        barycentric['p'],
    )
    bent = erfa.ldsun(natural, heliocentric['p'] / sun_distance_au, sun_distance_au)
    inverse_gamma = math.sqrt(1.0 - float(velocity_c @ velocity_c))
    return np.asarray(erfa.ab(bent, velocity_c, sun_distance_au, inverse_gamma))


def standard_pressure_hpa(height_m: float, temperature_degc: float) -> float:
    """
    Standard air pressure at a height.

    Allen, Astrophysical Quantities, 3rd ed., section 52, as in ERFA's ``apco13``.
    """
    at_sea_level_k = 273.15 + temperature_degc + 0.0065 * height_m
    return 1013.25 * math.exp(-height_m / (29.3 * at_sea_level_k))


def through_the_air(
    direction_icrf: Floats, time_unix_ns: int, site: SiteOptions
) -> tuple[Floats, Floats]:
    """
    Observed directions (n, 3) for a camera on the ground, and their elevations (n,), rad.

    Diurnal aberration (0.3 arcsec) and refraction are applied.  The result is along the axes of
    the ICRF, so an ICRF attitude rotates it to the camera.  UTC replaces UT1: they differ by at
    most 0.9 s, which moves a star by 0.02 arcsec at 30 degrees of elevation.  Polar motion is
    neglected: 0.001 arcsec there.

    Parameters
    ----------
    direction_icrf : (n, 3)
        Apparent directions for an observer at the centre of the Earth.
    time_unix_ns : int
        As for `tt_julian_date`.
    site : SiteOptions

    Notes
    -----
    ERFA ``refco`` and ``atioq``: A tan z + B tan^3 z, within 1 arcsec of a model atmosphere down
    to 15 degrees of elevation.
    """
    tt_jd = tt_julian_date(time_unix_ns)
    cirs_from_icrf = erfa.c2i06a(*tt_jd)
    local = erfa.apio(
        erfa.sp00(*tt_jd),
        _earth_rotation_rad(time_unix_ns),
        math.radians(site.longitude_deg),
        math.radians(site.latitude_deg),
        site.height_m,
        0.0,
        0.0,
        *_refraction_rad(site),
    )
    place = erfa.c2s(direction_icrf @ cirs_from_icrf.T)
    _, zenith_distance, _, dec, ra = erfa.atioq(*place, local)
    return np.asarray(erfa.s2c(ra, dec) @ cirs_from_icrf), np.asarray(np.pi / 2 - zenith_distance)


def air_above(time_unix_ns: int, site: SiteOptions) -> tuple[Floats, Floats]:
    """
    Zenith (3,) of a site, ICRF, and refraction (2,) 45 degrees from it with its 1-sigma, arcsec.

    NaN and zeros in space, and where the site is not stated.  The 1-sigma is that of 15 degrees
    and 20 hPa of weather.
    """
    if not site.is_known:
        return np.full(3, math.nan), np.zeros(2)
    right_ascension = _earth_rotation_rad(time_unix_ns) + math.radians(site.longitude_deg)
    zenith_cirs = erfa.s2c(right_ascension, math.radians(site.latitude_deg))
    size_arcsec = sum(_refraction_rad(site)) / ARCSECOND_RAD
    zenith_icrf = zenith_cirs @ erfa.c2i06a(*tt_julian_date(time_unix_ns))
    return np.asarray(zenith_icrf), size_arcsec * np.array([1.0, _WEATHER])


def _earth_rotation_rad(time_unix_ns: int) -> float:
    day, in_day_ns = divmod(int(time_unix_ns), _DAY_S * NANOSECONDS_PER_SECOND)
    in_day = in_day_ns / (_DAY_S * NANOSECONDS_PER_SECOND)
    return float(erfa.era00(_UNIX_EPOCH_JD + day, in_day))


def _refraction_rad(site: SiteOptions) -> tuple[float, float]:
    """Return A and B of ``A tan z + B tan^3 z``."""
    temperature_degc = site.air_temperature_degc
    pressure_hpa = site.air_pressure_hpa or standard_pressure_hpa(site.height_m, temperature_degc)
    a, b = erfa.refco(pressure_hpa, temperature_degc, RELATIVE_HUMIDITY, WAVELENGTH_UM)
    return float(a), float(b)
