# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The bundled catalog against the literature and itself; searches against brute force."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError
from starcal_ros.sky.catalog import (
    CATALOG_PATH,
    column_digest,
    COLUMN_TYPES,
    cone,
    CONE_MARGIN_RAD,
    load_catalog,
    MotionSource,
    StarCatalog,
)

MAS_RAD = ARCSECOND_RAD / 1000


@pytest.fixture(scope='module')
def catalog() -> StarCatalog:
    return load_catalog()


def unit(ra_deg, dec_deg):
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.stack(
        [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec) + 0 * ra], axis=-1
    )


def degrees(sexagesimal):
    first, minutes, seconds = sexagesimal.split()
    sign = -1 if first.startswith('-') else 1
    return sign * (abs(int(first)) + int(minutes) / 60 + float(seconds) / 3600)


# SIMBAD: ICRS at J2000.0, proper motion in mas/year, V; and how far the catalog may be off at
# J2016.  Hipparcos-2 stars repeat their source, up to its rounding; 61 Cygni and the two fast
# stars rest on other measurements, whose motion over 16 years errs by 10 to 25 mas/year.
LITERATURE = {
    'Vega': ('18 36 56.33635', '+38 47 01.2802', 200.94, 286.23, 0.03, 0.005),
    'Sirius': ('06 45 08.91728', '-16 42 58.0171', -546.01, -1223.07, -1.46, 0.005),
    'Polaris': ('02 31 49.09456', '+89 15 50.7923', 44.48, -11.85, 1.98, 0.005),
    'Altair': ('19 50 46.99855', '+08 52 05.9563', 536.23, 385.29, 0.76, 0.005),
    'Arcturus': ('14 15 39.67207', '+19 10 56.6730', -1093.39, -2000.06, -0.05, 0.005),
    'Deneb': ('20 41 25.91514', '+45 16 49.2197', 2.01, 1.85, 1.25, 0.005),
    'Pollux': ('07 45 18.94987', '+28 01 34.3160', -626.55, -45.80, 1.14, 0.005),
    'epsilon Eridani': ('03 32 55.84496', '-09 27 29.7312', -975.17, 19.49, 3.73, 0.03),
    '61 Cygni A': ('21 06 53.93960', '+38 44 57.9017', 4164.17, 3249.99, 5.21, 0.05),
    '61 Cygni B': ('21 06 55.26313', '+38 44 31.3615', 4107.40, 3143.72, 6.03, 0.3),
    'Lalande 21185': ('11 03 20.1940', '+35 58 11.5682', -580.27, -4765.85, 7.52, 0.3),
    "Kapteyn's Star": ('05 11 40.58984', '-45 01 06.3617', 6505.08, -5730.84, 8.85, 0.5),
}


@pytest.mark.parametrize('name', LITERATURE)
def test_places_well_known_stars(catalog, name):
    ra, dec, pm_ra, pm_dec, magnitude, off_arcsec = LITERATURE[name]
    ra_deg, dec_deg = 15 * degrees(ra), degrees(dec)
    place = unit(ra_deg, dec_deg)
    east = unit(ra_deg + 90, 0.0)
    there = place + 16 * MAS_RAD * (pm_ra * east + pm_dec * np.cross(place, east))
    there /= np.linalg.norm(there)
    away = np.linalg.norm(catalog.direction_icrs - there, axis=1)
    row = int(np.argmin(away))
    assert away[row] < off_arcsec * ARCSECOND_RAD
    # V from Hp without a colour errs by 0.1; Sirius saturated Hipparcos and is 0.3 off.
    assert catalog.magnitude[row] == pytest.approx(
        magnitude, abs=0.35 if name == 'Sirius' else 0.12
    )
    motion = [catalog.pm_ra_cosdec_rad_per_year[row], catalog.pm_dec_rad_per_year[row]]
    # By difference from a Tycho-2 place that errs by 0.1 to 0.4 arcsec for stars this fast.
    assert motion == pytest.approx([pm_ra * MAS_RAD, pm_dec * MAS_RAD], abs=45 * MAS_RAD)


# Stars with V < 1.7 and their places to a minute of arc (Bright Star Catalogue, J2000).
BRIGHTEST = [
    (101.29, -16.72), (95.99, -52.70), (213.92, 19.18), (219.90, -60.83), (279.23, 38.78),
    (79.17, 46.00), (78.63, -8.20), (114.83, 5.22), (24.43, -57.24), (88.79, 7.41),
    (210.96, -60.37), (297.70, 8.87), (186.65, -63.10), (68.98, 16.51), (201.30, -11.16),
    (247.35, -26.43), (116.33, 28.03), (344.41, -29.62), (310.36, 45.28), (191.93, -59.69),
    (152.09, 11.97), (104.66, -28.97), (113.65, 31.89), (263.40, -37.10), (187.79, -57.11),
    (81.28, 6.35), (81.57, 28.61), (138.30, -69.72),
]  # fmt: skip


def test_lacks_none_of_the_brightest(catalog):
    bright = catalog.select(catalog.magnitude < 1.8)
    away, row = cKDTree(bright.direction_icrs).query(unit(*np.array(BRIGHTEST).T))
    # Rounding of the list and 16 years of motion: 61 arcsec for alpha Centauri.
    assert away.max() < 100 * ARCSECOND_RAD
    assert len(set(row)) == len(BRIGHTEST)
    # alpha Centauri B (V = 1.33) is the only other one this bright.
    others = np.delete(bright.magnitude, row)
    assert (others < 1.45).sum() <= 1


def test_counts_stars_by_magnitude(catalog):
    counts = [int((catalog.magnitude < limit).sum()) for limit in range(3, 10)]
    # The sky's count as astronomy teaching repeats it, rounded; V = 6 and on are estimates there.
    taught = [171, 513, 1602, 4800, 14000, 42000, 121000]
    assert counts == pytest.approx(taught, rel=0.1)
    # Today's output, to notice a change of the file.
    assert counts == [174, 507, 1606, 4931, 15203, 45068, 129531]


def test_counts_stars_in_hercules(catalog):
    centre = unit(255.0, 30.0)
    east = unit(255.0 + 90, 0.0)
    depth = catalog.direction_icrs @ centre
    x = catalog.direction_icrs @ east / depth
    y = catalog.direction_icrs @ np.cross(centre, east) / depth
    inside = (depth > 0) & (np.abs(x) < math.tan(math.radians(10)))
    inside &= np.abs(y) < math.tan(math.radians(8))
    counts = [int((catalog.magnitude[inside] < limit).sum()) for limit in (6, 7, 8, 9)]
    # Counted apart from this file in other catalogs; V from Gaia errs by 0.03 mag, 3 % of stars.
    assert counts == pytest.approx([39, 110, 316, 871], rel=0.03)


def test_has_no_star_twice(catalog):
    tree = cKDTree(catalog.direction_icrs)
    assert len(np.unique(catalog.id)) == len(catalog)
    # Gaia DR3 holds no two sources within 0.18 arcsec (Lindegren et al. 2021, A&A 649, A2).
    assert len(tree.query_pairs(0.18 * ARCSECOND_RAD)) == 0
    pairs = tree.query_pairs(3 * ARCSECOND_RAD, output_type='ndarray')
    assert len(pairs) > 500  # double stars that Gaia resolved; see the next line
    assert (catalog.id[pairs] > 0).all()  # one source list, so not a merge of two
    alike = np.abs(np.diff(catalog.magnitude[pairs], axis=1)[:, 0]) <= 5
    assert catalog.close_pair[pairs[alike]].all()
    # Where a Hipparcos star stands near a Gaia star, the two are plainly not one.
    pairs = tree.query_pairs(20 * ARCSECOND_RAD, output_type='ndarray')
    mixed = pairs[(catalog.id[pairs] < 0).sum(axis=1) == 1]
    assert (np.abs(np.diff(catalog.magnitude[mixed], axis=1)) > 1.3).all()


def test_columns_are_sound(catalog):
    assert CATALOG_PATH.stat().st_size < 4e6
    assert catalog.epoch_jyear == 2016.0
    assert (np.diff(catalog.magnitude) >= 0).all() and catalog.magnitude[-1] < 9
    assert ((catalog.ra_rad >= 0) & (catalog.ra_rad < 2 * np.pi)).all()
    assert (np.abs(catalog.dec_rad) <= np.pi / 2).all()
    assert (catalog.parallax_rad >= 0).all()
    assert catalog.parallax_rad.max() < 0.8 * ARCSECOND_RAD  # Hipparcos on alpha Centauri B
    speed = np.hypot(catalog.pm_ra_cosdec_rad_per_year, catalog.pm_dec_rad_per_year)
    assert 8.6 * ARCSECOND_RAD < speed.max() < 8.7 * ARCSECOND_RAD  # Kapteyn's Star
    assert (speed[catalog.motion_source == MotionSource.UNKNOWN] == 0).all()
    assert (catalog.motion_source == MotionSource.UNKNOWN).sum() < 500
    assert np.isnan(catalog.colour_bp_rp).sum() < 200
    # Carbon stars and miras.
    assert np.nanmin(catalog.colour_bp_rp) > -1 and np.nanmax(catalog.colour_bp_rp) < 7
    assert np.isnan(catalog.colour_bp_rp[catalog.id < 0]).all()


def test_magnitude_limit_cuts(catalog):
    for limit in (-5.0, 3.0, 6.5, 9.0, 20.0):
        cut = load_catalog(magnitude_limit=limit)
        keep = catalog.magnitude <= limit
        assert np.array_equal(cut.id, catalog.id[keep])
        assert cut.digest == catalog.digest


@pytest.mark.parametrize('radius_deg', [0.0, 0.5, 13.0, 90.0, 179.99, 180.0])
@pytest.mark.parametrize('limit', [None, 6.0])
def test_cone_finds_what_brute_force_finds(catalog, radius_deg, limit):
    rng = np.random.default_rng(20160101)
    for axis in [*rng.normal(size=(3, 3)), np.array([0.0, 0.0, 1.0])]:
        rows = cone(catalog, axis, math.radians(radius_deg), limit)
        cross = np.linalg.norm(np.cross(catalog.direction_icrs, axis), axis=1)
        angle = np.arctan2(cross, catalog.direction_icrs @ axis)
        bright = np.ones(len(catalog), bool) if limit is None else catalog.magnitude <= limit
        # Rows on the rim may fall either way by the rounding of a cosine: 1e-12 rad there.
        edge = math.radians(radius_deg) + CONE_MARGIN_RAD
        assert np.isin(np.flatnonzero(bright & (angle < edge - 1e-9)), rows).all()
        assert (angle[rows] < edge + 1e-9).all() and bright[rows].all()
        assert (np.diff(rows) > 0).all()


@pytest.mark.parametrize(
    ('source', 'magnitude', 'jyear', 'mas'),
    [
        (MotionSource.GAIA, 12.0, 2026.0, 1.0),
        (MotionSource.DIFFERENCE, 8.0, 2026.0, 22.0),
        (MotionSource.TYCHO, 10.0, 2026.5, 106.0),
        (MotionSource.UNKNOWN, 9.0, 2016.0, 0.1),
        (MotionSource.UNKNOWN, 9.0, 2026.0, 160.0),  # ten years of 16 mas
        (MotionSource.UNKNOWN, 13.0, 2026.0, 83.5),  # fainter ones are farther, and slower
        (MotionSource.UNKNOWN_J2000, 13.0, 2000.0, 80.0),
        (MotionSource.UNKNOWN_J2000, 13.0, 2026.0, 231.5),
    ],
)
def test_a_place_is_known_as_well_as_its_motion(catalog, source, magnitude, jyear, mas) -> None:
    star = dataclasses.replace(
        catalog.select(slice(1)),
        motion_source=np.array([source], np.uint8),
        magnitude=np.array([magnitude]),
    )
    sigma_rad = star.place_sigma_rad(np.array([0]), jyear)
    assert sigma_rad / MAS_RAD == pytest.approx([mas], rel=0.01)


def test_the_usual_motion_is_that_of_two_thirds_of_the_stars(catalog) -> None:
    """In each magnitude to 20 %, by stars whose motion is known."""
    known = catalog.select(catalog.motion_source == MotionSource.GAIA)
    unknown = dataclasses.replace(known, motion_source=0 * known.motion_source)
    in_a_year = unknown.place_sigma_rad(np.arange(len(known)), 2017.0)
    in_sigma = np.abs(known.pm_dec_rad_per_year) / in_a_year
    for v in (5.0, 6.0):
        rows = (known.magnitude > v) & (known.magnitude < v + 1.0)
        assert np.quantile(in_sigma[rows], 0.683) == pytest.approx(1.2, abs=0.3)


def test_cone_loses_no_fast_star(catalog):
    speed = np.hypot(catalog.pm_ra_cosdec_rad_per_year, catalog.pm_dec_rad_per_year)
    for row in np.argsort(-speed)[:5]:
        place = catalog.direction_icrs[row]
        east = np.array([-np.sin(catalog.ra_rad[row]), np.cos(catalog.ra_rad[row]), 0.0])
        motion = catalog.pm_ra_cosdec_rad_per_year[row] * east
        motion += catalog.pm_dec_rad_per_year[row] * np.cross(place, east)
        for years in (-35, 35):
            assert row in cone(catalog, place + years * motion, 0.0)


def test_bad_files_are_refused(tmp_path: Path):
    good = CATALOG_PATH.read_bytes()
    path = tmp_path / 'stars.npz'
    with pytest.raises(CatalogError, match='stars.npz: star catalog: cannot be read: No such'):
        load_catalog(path)
    for content in (b'stars', good[:-100]):
        path.write_bytes(content)
        with pytest.raises(CatalogError, match='stars.npz: star catalog: not a NumPy archive'):
            load_catalog(path)
    np.savez(path, ra=np.zeros(3))
    with pytest.raises(CatalogError, match='missing: format, digest, id'):
        load_catalog(path)


def test_altered_contents_are_refused(tmp_path: Path):
    with np.load(CATALOG_PATH) as file:
        entries = {name: file[name] for name in file.files}
    path = tmp_path / 'stars.npz'
    ra = entries['ra'].copy()
    ra[1000] += 1
    columns = {name: entries[name] for name in COLUMN_TYPES}
    later = {**columns, 'motion_source': np.full_like(columns['motion_source'], 6)}
    for changed, match in (
        ({'format': np.array(2)}, 'format 2, this version reads 1'),
        ({'ra': ra}, 'digest'),
        ({**later, 'digest': np.array(column_digest(later))}, 'motion_source of a later version'),
        ({'ra': ra[:-1]}, 'column ra'),
        ({'ra': ra.astype(np.float64)}, 'column ra is float64'),
    ):
        np.savez(path, **{**entries, **changed})
        with pytest.raises(CatalogError, match=match):
            load_catalog(path)
