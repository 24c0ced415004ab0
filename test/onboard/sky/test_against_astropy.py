# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Apparent directions, refraction and time scales against astropy and the full ERFA chain."""

from astropy import units as u
from astropy.coordinates import AltAz, Distance, EarthLocation, GCRS, ICRS, SkyCoord
import erfa
import numpy as np
from offline_time import Time  # type: ignore[import-not-found]
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.sky.astrometry import (
    apparent_directions,
    RELATIVE_HUMIDITY,
    SiteOptions,
    through_the_air,
    tt_julian_date,
    WAVELENGTH_UM,
)
from starcal_ros.sky.catalog import StarCatalog

MAS_RAD = 1e-3 * ARCSECOND_RAD

# UTC as seconds since 1970: 1995-01-01, 2004-02-29, 2016-01-01, 2026-11-21, 2039-12-31.
TIMES_S = [788918400, 1078012800, 1451606400, 1795219200, 2208902400]
pytestmark = [
    # astropy and ERFA say so for dates more than five years beyond the last known leap second.
    pytest.mark.filterwarnings('ignore:.*dubious year')
]


def random_stars(count: int) -> StarCatalog:
    """Stars over the whole sky with the poles; the last three are near and fast."""
    rng = np.random.default_rng(19950101)
    pm = rng.normal(0.0, 0.1, (2, count))
    parallax = 0.005 + rng.exponential(0.02, count)  # none so small that ERFA overrides it
    ra = rng.uniform(0, 2 * np.pi, count)
    dec = np.arcsin(rng.uniform(-1, 1, count))
    dec[:2] = np.pi / 2 - 1e-4, -np.pi / 2 + 1e-4
    # Barnard's star, alpha Centauri A, 61 Cygni A: SIMBAD.
    ra[-3:] = np.radians([269.452076, 219.902058, 316.724748])
    dec[-3:] = np.radians([4.693364, -60.833993, 38.749417])
    pm[:, -3:] = [-0.801551, -3.679250, 4.164170], [10.362394, 0.473670, 3.249990]
    parallax[-3:] = 0.546976, 0.743000, 0.286820
    return StarCatalog(
        id=np.arange(1, count + 1),
        ra_rad=ra,
        dec_rad=dec,
        pm_ra_cosdec_rad_per_year=pm[0] * ARCSECOND_RAD,
        pm_dec_rad_per_year=pm[1] * ARCSECOND_RAD,
        parallax_rad=parallax * ARCSECOND_RAD,
        magnitude=np.zeros(count),
        colour_bp_rp=np.zeros(count),
        motion_source=np.zeros(count, np.uint8),
        close_pair=np.zeros(count, bool),
        epoch_jyear=2016.0,
        digest='',
    )


def places(stars: StarCatalog) -> SkyCoord:
    """Stars of a catalog as astropy coordinates."""
    return SkyCoord(
        ra=stars.ra_rad * u.rad,
        dec=stars.dec_rad * u.rad,
        pm_ra_cosdec=stars.pm_ra_cosdec_rad_per_year * u.rad / u.yr,
        pm_dec=stars.pm_dec_rad_per_year * u.rad / u.yr,
        distance=Distance(parallax=stars.parallax_rad * u.rad),
        obstime=Time(2016.0, format='jyear', scale='tcb'),
        frame=ICRS(),
    )


def unit_vectors(coordinates: SkyCoord) -> np.ndarray:
    """Directions (n, 3) along the axes of the coordinates' own frame."""
    xyz = np.moveaxis(coordinates.cartesian.xyz.value, 0, -1)
    return np.asarray(xyz / np.linalg.norm(xyz, axis=1, keepdims=True))


SITES = [
    SiteOptions('ground', 37.18, -3.6, 700.0, air_pressure_hpa=930.0, air_temperature_degc=12.0),
    SiteOptions('ground', -33.0, 151.0, 10.0, air_pressure_hpa=1013.0, air_temperature_degc=25.0),
    SiteOptions('ground', 78.0, 15.0, 3000.0, air_pressure_hpa=700.0, air_temperature_degc=-30.0),
]


@pytest.mark.parametrize('site', SITES)
@pytest.mark.parametrize('time_s', TIMES_S[1:3])  # of which astropy knows UT1 without a download
def test_the_air_bends_light_as_in_astropy(site: SiteOptions, time_s: int) -> None:
    stars = random_stars(500)
    time = Time(time_s, format='unix', scale='utc')
    place = EarthLocation.from_geodetic(
        site.longitude_deg * u.deg, site.latitude_deg * u.deg, site.height_m * u.m
    )
    at_time = places(stars).apply_space_motion(new_obstime=time)
    position, velocity = place.get_gcrs_posvel(time)
    # Without air, along axes of the ICRF and along those of the horizon: what turns the one to
    # the other is the rotation that refraction is not part of.
    topocentric = GCRS(obstime=time, obsgeoloc=position, obsgeovel=velocity)
    without_air = unit_vectors(at_time.transform_to(topocentric))
    altaz = AltAz(obstime=time, location=place)
    to_right_handed = np.array([1.0, -1.0, 1.0])  # azimuth counts from north to east
    in_horizon = unit_vectors(at_time.transform_to(altaz)) * to_right_handed
    icrf_from_horizon, _ = Rotation.align_vectors(without_air, in_horizon)
    # The frames differ by a rotation alone; astropy's own ways to them by 0.3 mas.
    assert np.abs(icrf_from_horizon.apply(in_horizon) - without_air).max() < MAS_RAD
    air = altaz.replicate_without_data(
        pressure=site.air_pressure_hpa * u.hPa,
        temperature=site.air_temperature_degc * u.deg_C,
        relative_humidity=RELATIVE_HUMIDITY,
        obswl=WAVELENGTH_UM * u.micron,
    )
    seen = at_time.transform_to(air)
    expected = icrf_from_horizon.apply(unit_vectors(seen) * to_right_handed)
    time_ns = time_s * NANOSECONDS_PER_SECOND
    ours, elevation_rad = through_the_air(apparent_directions(stars, time_ns), time_ns, site)
    high = seen.alt.deg > 30.0
    assert np.count_nonzero(high) > 80
    away_arcsec = np.linalg.norm(ours - expected, axis=1)[high] / ARCSECOND_RAD
    bent_arcsec = np.linalg.norm(without_air - expected, axis=1)[high] / ARCSECOND_RAD
    assert bent_arcsec.max() > 50.0
    # One arcsecond is wanted.  The same theory; UT1 is up to 0.4 s from UTC at these dates, which
    # turns the zenith by 6 arcsec and what refraction does at 30 degrees by 0.01.
    assert away_arcsec.max() < 0.02
    # The elevation itself has those 6 arcsec, and it only says which stars are too low.
    assert np.abs(elevation_rad - seen.alt.rad)[high].max() < 10 * ARCSECOND_RAD


@pytest.mark.parametrize('time_s', TIMES_S)
def test_agrees_with_the_whole_chain_of_erfa(time_s):
    """ICRS to CIRS by ``atci13``, rotated to the GCRS by its precession and nutation."""
    stars = random_stars(500)
    jd1, jd2 = tt_julian_date(time_s * NANOSECONDS_PER_SECOND)
    there = erfa.pmsafe(
        stars.ra_rad,
        stars.dec_rad,
        stars.pm_ra_cosdec_rad_per_year / np.cos(stars.dec_rad),
        stars.pm_dec_rad_per_year,
        stars.parallax_rad / ARCSECOND_RAD,
        0.0,
        *(erfa.DJ00, 16.0 * erfa.DJY, erfa.DJ00, 0.0),  # atci13 counts from J2000
    )
    ra_cirs, dec_cirs, _ = erfa.atci13(*there, jd1, jd2)
    astrom, _ = erfa.apci13(jd1, jd2)
    expected = erfa.s2c(ra_cirs, dec_cirs) @ astrom['bpn']  # rows: the transpose turns back
    ours = apparent_directions(stars, time_s * NANOSECONDS_PER_SECOND)
    away_mas = np.linalg.norm(ours - expected, axis=1) / MAS_RAD
    # The same theory; pmsafe treats the light time of the motion its own way: 0.00006 mas.
    assert away_mas.max() < 0.001
