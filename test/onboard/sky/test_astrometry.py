# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Apparent directions against special relativity and approximations; time scales; bad calls."""

import dataclasses
import datetime
import math

import numpy as np
import pytest

from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SPEED_OF_LIGHT_M_S
from starcal_ros.sky.astrometry import (
    air_above,
    apparent_directions,
    SiteOptions,
    standard_pressure_hpa,
    through_the_air,
    tt_julian_date,
)
from starcal_ros.sky.catalog import load_catalog, StarCatalog

MICROARCSECOND_RAD = 1e-6 * ARCSECOND_RAD


def unix_ns(*date):
    since = datetime.datetime(*date) - datetime.datetime(1970, 1, 1)
    return (since.days * 86400 + since.seconds) * NANOSECONDS_PER_SECOND


@pytest.fixture(scope='module')
def stars() -> StarCatalog:
    return load_catalog(magnitude_limit=6.0)


def angle_between(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


@pytest.mark.parametrize('speed_km_s', [7.5, 30000.0])
def test_aberration_is_that_of_special_relativity(stars, speed_km_s):
    axis = np.array([0.6, -0.48, 0.64])
    beta = 1000 * speed_km_s / SPEED_OF_LIGHT_M_S
    time_ns = unix_ns(2024, 5, 1)
    at_rest = apparent_directions(stars, time_ns, np.zeros(3))
    moving = apparent_directions(stars, time_ns, axis * 1000 * speed_km_s)
    before, after = angle_between(at_rest, axis), angle_between(moving, axis)
    # Half-angle form: tan(theta'/2) = sqrt((1 - beta)/(1 + beta)) tan(theta/2).
    expected = 2 * np.arctan(math.sqrt((1 - beta) / (1 + beta)) * np.tan(before / 2))
    # ERFA's ab carries the Sun's potential too: 2e-8 of the aberration (Explanatory Supplement
    # 3rd ed. section 7.2.5).
    allowed = 0.01 * MICROARCSECOND_RAD + 3e-8 * beta
    assert np.abs(after - expected).max() < allowed
    # Towards the axis, in the plane of star and axis.
    across = np.cross(at_rest, axis)
    off_plane = np.sum(moving * across, axis=1) / np.linalg.norm(across, axis=1)
    assert np.abs(off_plane).max() < allowed


def test_directions_are_unit_vectors_and_each_star_stands_alone(stars):
    time_ns = unix_ns(2024, 5, 1)
    every = apparent_directions(stars, time_ns)
    assert every.shape == (len(stars), 3) and every.dtype == np.float64
    assert np.abs(np.linalg.norm(every, axis=1) - 1).max() < 1e-15 * 4  # rounding of the norm
    some = np.array([7, 3, 2000])
    assert np.array_equal(apparent_directions(stars.select(some), time_ns), every[some])
    assert apparent_directions(stars.select(slice(0)), time_ns).shape == (0, 3)


@pytest.mark.parametrize(
    ('date', 'tai_minus_utc_s'),
    [
        # IERS Bulletin C; before 1972 the USNO table tai-utc.dat, which also drifts.
        ((1961, 1, 1), 1.422818),
        ((1971, 12, 31), 4.2131700 + (41316 - 39126) * 0.002592),
        ((1972, 1, 1), 10),
        ((1998, 12, 31), 31),
        ((1999, 1, 1), 32),
        ((2016, 12, 31), 36),
        ((2017, 1, 1), 37),
        ((2024, 5, 1), 37),
        ((2060, 1, 1), 37),  # none announced since: ERFA's last is kept, and no warning
    ],
)
def test_terrestrial_time(date, tai_minus_utc_s):
    day_jd, rest = tt_julian_date(unix_ns(*date))
    assert day_jd == 2440587.5 + (datetime.date(*date) - datetime.date(1970, 1, 1)).days
    # A tenth of a nanosecond; the drift before 1972 is given to a microsecond.
    allowed_s = 1e-10 if date[0] >= 1972 else 1e-6
    assert rest * 86400 == pytest.approx(tai_minus_utc_s + 32.184, abs=allowed_s)


def test_terrestrial_time_keeps_nanoseconds():
    noon_ns = unix_ns(2024, 5, 1, 12)
    day_jd, rest = tt_julian_date(noon_ns)
    day_later_jd, rest_later = tt_julian_date(noon_ns + 1)
    assert day_jd == day_later_jd
    # Doubles near half a day step by 5 to 10 ps.
    assert (rest_later - rest) * 86400e9 == pytest.approx(1.0, abs=0.02)
    last = tt_julian_date(unix_ns(2024, 5, 2) - 1)
    first = tt_julian_date(unix_ns(2024, 5, 2))
    seconds = (first[0] - last[0] + (first[1] - last[1])) * 86400
    assert seconds == pytest.approx(1e-9, abs=2e-11)


def test_times_before_utc_are_refused(stars):
    assert tt_julian_date(unix_ns(1960, 1, 1))[0] == 2436934.5
    with pytest.raises(ValueError, match='time_unix_ns is -315619200000000001, expected .* 1960'):
        apparent_directions(stars, unix_ns(1960, 1, 1) - 1)


@pytest.mark.parametrize(
    'velocity', [[1.0, 2.0], [np.nan, 0.0, 0.0], [3e8, 0.0, 0.0], [[1.0, 2.0, 3.0]]]
)
def test_velocities_that_are_none_are_refused(stars, velocity):
    with pytest.raises(ValueError, match='velocity_m_s'):
        apparent_directions(stars, 0, np.array(velocity))


TIME_NS = unix_ns(2024, 5, 1, 3)


def test_the_air_above_a_site_is_that_which_its_stars_are_seen_through():
    site = SiteOptions('ground', -33.5, -70.7, 550.0)
    zenith_icrf, (size_arcsec, sigma_arcsec) = air_above(TIME_NS, site)
    directions = np.random.default_rng(1).normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    airless = dataclasses.replace(site, air_pressure_hpa=1e-9)
    _, elevation_rad = through_the_air(directions, TIME_NS, airless)
    # Without air the heights are of that zenith, but for 0.3 arcsec of aberration.
    high = elevation_rad > 0.2
    off_rad = np.arcsin(directions[high] @ zenith_icrf) - elevation_rad[high]
    assert np.abs(off_rad).max() < 0.5 * ARCSECOND_RAD
    near = np.abs(np.degrees(elevation_rad) - 45.0) < 0.2
    bent = angle_between(through_the_air(directions[near], TIME_NS, site)[0], directions[near])
    # 0.2 degrees change a tangent there by 0.7 %; aberration adds 0.3 arcsec.
    assert np.median(bent) / ARCSECOND_RAD == pytest.approx(size_arcsec, rel=0.01)
    assert sigma_arcsec == pytest.approx(0.057 * size_arcsec)
    # Ten degrees beside those assumed are within the 1-sigma.
    for degc in (0.0, 20.0):
        other = dataclasses.replace(site, air_temperature_degc=degc)
        assert abs(air_above(TIME_NS, other)[1][0] - size_arcsec) < sigma_arcsec
    nowhere, none = air_above(TIME_NS, SiteOptions())
    assert np.isnan(nowhere).all() and not none.any()


def test_air_pressure_follows_from_height():
    # ISO 2533 at 0, 1500 and 3000 m, for its own temperatures there.  The formula takes the air
    # at one temperature from there to the sea: 1.3 % off at 3000 m.
    standard = ((0.0, 15.0, 1013.25), (1500.0, 5.25, 845.6), (3000.0, -4.5, 701.1))
    for height_m, degc, hpa in standard:
        assert standard_pressure_hpa(height_m, degc) == pytest.approx(hpa, rel=0.015)
    high = SiteOptions('ground', 51.5, 0.0, 1500.0, air_temperature_degc=5.25)
    said = dataclasses.replace(high, air_pressure_hpa=standard_pressure_hpa(1500.0, 5.25))
    ours, same = (through_the_air(np.eye(3), TIME_NS, site) for site in (high, said))
    np.testing.assert_array_equal(ours[0], same[0])
    np.testing.assert_array_equal(ours[1], same[1])


def test_under_the_horizon_all_stays_finite():
    site = SiteOptions('ground', 89.0, 0.0)
    seen, elevation_rad = through_the_air(np.array([[0.0, 0.0, -1.0], [1, 0, 0]]), TIME_NS, site)
    assert np.isfinite(seen).all() and elevation_rad[0] < -1.5
    assert through_the_air(np.empty((0, 3)), TIME_NS, site)[0].shape == (0, 3)
