# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Catalogs from tables as their sources write them, written by astropy."""

from collections import Counter
import dataclasses
from pathlib import Path
import re
from typing import Any

from astropy import units
from astropy.io import fits, votable
from astropy.table import MaskedColumn, Table
import erfa
import numpy as np
import pytest
from starcal_tool import assert_refused  # type: ignore[import-not-found]

from starcal_ground.mission.ingest.deep_catalog import (
    deep_catalog,
    integer_columns,
    UNMOVED,
    write_deep_catalog,
)
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError, StarcalError
from starcal_ros.sky.catalog import load_catalog, MotionSource, StarCatalog

# A child process reads each table.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures('forked_readers')]

BUNDLED = load_catalog()
FAINT = 300


ARCHIVE = {
    'ra': 'ra', 'dec': 'dec', 'pm_ra': 'pmra', 'pm_dec': 'pmdec', 'number': 'source_id',
    'parallax': 'parallax', 'g': 'phot_g_mean_mag', 'bp_rp': 'bp_rp', 'epoch': 'ref_epoch',
}  # fmt: skip
# Title, names of the columns by quantity, epoch of the places, and the source of their motion.
SOURCES: list[tuple[str, dict[str, str], float, MotionSource]] = [
    ('Gaia, archive', ARCHIVE, 2016.0, MotionSource.GAIA),
    ('Gaia, archive', ARCHIVE, 2015.5, MotionSource.GAIA),
    ('Gaia, archive', {k: v for k, v in ARCHIVE.items() if k[:2] != 'pm'}, 2016.0,
     MotionSource.UNKNOWN),
    ('Gaia DR3, VizieR I/355', {
        'number': 'Source', 'ra': 'RA_ICRS', 'dec': 'DE_ICRS', 'pm_ra': 'pmRA', 'pm_dec': 'pmDE',
        'parallax': 'Plx', 'g': 'Gmag', 'bp_rp': 'BP-RP',
    }, 2016.0, MotionSource.GAIA),
    ('Gaia DR2, astrometry.net 5000', {
        **{k: v for k, v in ARCHIVE.items() if k != 'bp_rp'}, 'bp': 'phot_bp_mean_mag',
        'rp': 'phot_rp_mean_mag',
    }, 2015.5, MotionSource.GAIA),
    ('Tycho-2, VizieR I/259', {
        'ra': 'RAmdeg', 'dec': 'DEmdeg', 'pm_ra': 'pmRA', 'pm_dec': 'pmDE', 'vt': 'VTmag',
        'bt': 'BTmag',
    }, 2000.0, MotionSource.TYCHO),
    ('2MASS, VizieR II/246', {'ra': 'RAJ2000', 'dec': 'DEJ2000', 'j': 'Jmag', 'k': 'Kmag'}, 2000.0,
     MotionSource.UNKNOWN_J2000),
    ('Tycho-2, astrometry.net 4100', {'ra': 'ra', 'dec': 'dec', 'vt': 'MAG_VT'}, 2000.0,
     MotionSource.UNKNOWN_J2000),
    ('2MASS, astrometry.net 4200', {'ra': 'ra', 'dec': 'dec', 'j': 'j_mag'}, 2000.0,
     MotionSource.UNKNOWN_J2000),
]  # fmt: skip
UNITS = {'ra': 'deg', 'dec': 'deg', 'pm_ra': 'mas/yr', 'pm_dec': 'mas/yr', 'parallax': 'mas'}


def truth() -> dict[str, Any]:
    """A field at J2016: all bundled stars of Gaia in it, and fainter ones; motions in mas/yr."""
    rng = np.random.default_rng(5)
    middle = np.radians([200.0, 30.0])
    near = np.hypot(BUNDLED.ra_rad - middle[0], BUNDLED.dec_rad - middle[1]) < np.radians(3.0)
    own = BUNDLED.select(near & (BUNDLED.id > 0))
    n = len(own) + FAINT
    v = np.r_[own.magnitude, rng.uniform(9.5, 14.0, FAINT)]
    mas = 1e-3 * ARCSECOND_RAD
    return {
        'number': np.r_[own.id, 1 + np.arange(FAINT)],
        'ra': np.degrees(np.r_[own.ra_rad, middle[0] + rng.uniform(-0.04, 0.04, FAINT)]),
        'dec': np.degrees(np.r_[own.dec_rad, middle[1] + rng.uniform(-0.04, 0.04, FAINT)]),
        'pm_ra': np.r_[own.pm_ra_cosdec_rad_per_year / mas, np.full(FAINT, 40.0)],
        'pm_dec': np.r_[own.pm_dec_rad_per_year / mas, np.full(FAINT, -40.0)],
        'parallax': np.full(n, 2.0),
        # Colours of a star like the Sun.
        'v': v,
        'g': v - 0.146,
        'bp_rp': np.full(n, 0.8),
        'bp': v + 0.2,
        'rp': v - 0.6,
        'vt': v + 0.065,
        'bt': v + 0.785,
        'j': v - 1.18,
        'k': v - 1.54,
    }


def table(
    names: dict[str, str] = ARCHIVE, epoch: float = 2016.0, stated: float | None = None
) -> Table:
    """The field as a source has it at an epoch, which a column states otherwise."""
    values = truth()
    for place, motion in (('ra', 'pm_ra'), ('dec', 'pm_dec')):
        moved_deg = (epoch - 2016.0) * values[motion] / 3.6e6
        values[place] += moved_deg / (1.0 if place == 'dec' else np.cos(np.radians(values['dec'])))
    values['epoch'] = np.full(len(values['ra']), epoch if stated is None else stated)
    made = Table({name: MaskedColumn(values[key]) for key, name in names.items()})
    for key, unit in UNITS.items():
        if key in names:
            made[names[key]].unit = units.Unit(unit)
    return made


def write(given: Table, path: Path) -> None:
    if path.suffix == '.vot':
        # The writer in C of astropy 6.1 writes a byte beyond its buffer, and later tests crash.
        votable.from_table(given).to_xml(str(path), _debug_python_based_parser=True)
    else:
        given.write(path, format={'.csv': 'ascii.csv'}.get(path.suffix))


def write_index(given: Table, path: Path) -> None:
    """An index file of astrometry.net, whose tree has the places as steps in a cube."""
    direction = erfa.s2c(*np.radians([given['ra'], given['dec']]))
    scale = 2.0**31 - 1
    box = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0, scale], '<f8')
    steps = np.rint((direction + 1.0) * scale).astype('<u4')
    tags = {name: given[name] for name in given.colnames}
    if 'source_id' not in tags:
        del tags['ra'], tags['dec']

    def raw(name: str, array: Any, size: int) -> fits.BinTableHDU:
        rows = np.frombuffer(array.tobytes(), f'S{size}')
        column = fits.Column(name, f'{size}A', array=fits.column.chararray.array(rows, size))
        return fits.BinTableHDU.from_columns([column])

    primary = fits.PrimaryHDU()
    primary.header['ENDIAN'] = '04:03:02:01'
    tables = [raw('kdtree_range_stars', box, 8), raw('kdtree_data_stars', steps, 12)]
    fits.HDUList([primary, *tables, fits.table_to_hdu(Table(tags))]).writeto(path)


@pytest.mark.parametrize(('title', 'names', 'epoch', 'motion_source'), SOURCES)
def test_a_table_of_each_source_is_added_to_the_bundled_catalog(
    tmp_path, title, names, epoch, motion_source
) -> None:
    path, true = tmp_path / 'table.fits', truth()
    (write_index if 'net' in title else write)(table(names, epoch), path)
    made = write_deep_catalog(path, tmp_path / 'deep.npz')
    is_unmoved = motion_source in UNMOVED
    assert made.source == title and made.checked == len(true['v']) - FAINT
    assert made.unmoved == is_unmoved * (FAINT if motion_source else made.added)
    faint = load_catalog(tmp_path / 'deep.npz')
    near = np.abs(np.degrees(faint.dec_rad) - 30.0) < 4.0
    near &= np.abs(np.degrees(faint.ra_rad) - 200.0) < 5.0
    faint = faint.select(near & (faint.magnitude > 9.2))
    assert len(faint) == FAINT and set(faint.motion_source) == {motion_source}
    # By declination, which no motion that is common to all changes.
    faint = faint.select(np.argsort(faint.dec_rad))
    order = -FAINT + np.argsort(true['dec'][-FAINT:])
    # Steps of the file: 0.3 mas of place, 0.01 mas a year of motion; of a tree of a place: 0.2.
    years = (epoch - 2016.0) * is_unmoved
    moved_mas = (np.degrees(faint.dec_rad) - true['dec'][order]) * 3.6e6
    assert moved_mas == pytest.approx(-40.0 * years, abs=0.5)
    moved_mas = (np.degrees(faint.ra_rad) - true['ra'][order]) * 3.6e6 * np.cos(faint.dec_rad)
    assert moved_mas == pytest.approx(40.0 * years, abs=0.5)
    motion_mas = faint.pm_dec_rad_per_year / ARCSECOND_RAD * 1e3
    assert motion_mas == pytest.approx(0.0 if is_unmoved else -40.0, abs=0.01)
    off_mag = 0.25 if names.get('j') == 'j_mag' else 0.02  # without a colour
    assert faint.magnitude == pytest.approx(true['v'][order], abs=off_mag)


@pytest.mark.parametrize('ending', ['vot', 'csv'])
def test_a_table_of_each_kind_is_read(tmp_path, ending) -> None:
    given, path = table(), tmp_path / f'gaia.{ending}'
    given['pmra'].mask = np.arange(len(given)) == len(given) - 1
    write(given, path)
    made = deep_catalog(path)
    assert len(made.columns['id']) == len(BUNDLED) + FAINT and made.unmoved == 1
    assert (np.diff(made.columns['magnitude']) >= 0).all() and made.faintest > 13.5


# Epoch of the places, the one that is stated, a rotation, arcsec; the words of the refusal.
@pytest.mark.parametrize(
    ('epoch', 'stated', 'turn_arcsec', 'words'),
    [
        (2000.0, 2016.0, 0.0, r'of J2000\.0, not J2016\.0: state their epoch'),
        (2016.0, 2000.0, 0.0, r'of J2016\.0, not J2000\.0'),
        (2016.0, 2016.0, 2.0, r'are 1\.74 arcsec off .* turned by 1\.74 arcsec: give ICRS'),
        (2016.0, 2016.0, 2300.0, r'turned by \d{4}\.\d+ arcsec'),  # equinox B1950
    ],
)
def test_places_of_another_epoch_or_frame_are_refused(
    tmp_path, epoch, stated, turn_arcsec, words
) -> None:
    given = table(ARCHIVE, epoch, stated)
    given['ra'] += turn_arcsec / 3600.0
    given.write(tmp_path / 'off.fits')
    with pytest.raises(CatalogError, match=words):
        deep_catalog(tmp_path / 'off.fits')


@pytest.mark.parametrize(
    'from_icrs',
    [
        lambda ra, dec: erfa.fk54z(ra, dec, 2000.0)[:2],  # equinox B1950
        erfa.icrs2g,
        lambda ra, dec: erfa.eqec06(2451545.0, 0.0, ra, dec),
    ],
    ids=['B1950', 'galactic', 'ecliptic'],
)
def test_places_of_other_coordinates_are_refused(tmp_path, from_icrs) -> None:
    given = table(SOURCES[5][1], 2000.0)  # without numbers of Gaia
    place = from_icrs(*np.radians([given['RAmdeg'], given['DEmdeg']]))
    given['RAmdeg'], given['DEmdeg'] = np.degrees(place)
    given.write(tmp_path / 'a.fits')
    with pytest.raises(CatalogError, match='none of its .* in degrees, ICRS'):
        deep_catalog(tmp_path / 'a.fits')


def test_the_document_names_the_columns_of_each_source() -> None:
    text = (Path(__file__).parents[4] / 'docs' / 'mission_calibrate.md').read_text()
    rows = dict(
        re.findall(r'^\| ([^|]+) \| ((?:`[^|]+`(?:, )?)+) \| .*20\d\d', text, re.MULTILINE)
    )
    for title, names, _, _ in SOURCES:
        ours = set(names.values()) - ({'ra', 'dec'} if title.endswith(('4100', '4200')) else set())
        assert ours <= {name.strip('`') for name in rows[title].split(', ')}, title


def test_a_field_without_bright_stars_is_taken_unchecked(tmp_path) -> None:
    given = table()[-FAINT:]
    for name, middle in (('ra', 200.0), ('dec', 30.0)):  # half a degree from all stars to V = 9
        given[name] = middle + 0.02 * (given[name] - middle)
    given.write(tmp_path / 'a.fits')
    assert deep_catalog(tmp_path / 'a.fits').checked == 0


# A number that stands for none, or that no star has: column, value, the words of the refusal.
OUTSIDE = [
    *(('phot_g_mean_mag', value, 'outside -2 to 25 mag') for value in (99.0, 99.99, 999.0, 400.0)),
    ('phot_g_mean_mag', -999.0, 'outside -2 to 25 mag'),
    ('phot_g_mean_mag', np.inf, 'outside -2 to 25 mag'),
    ('phot_g_mean_mag', np.nan, 'without phot_g_mean_mag'),
    ('ra', 361.0, 'outside 0 to 360 deg'),
    ('dec', -91.0, 'outside -90 to 90 deg'),
    ('pmra', 3e7, 'outside -11000 to 11000 mas/yr'),
    ('pmdec', -99999.0, 'outside -11000 to 11000 mas/yr'),
    ('parallax', 1e6, 'outside -800 to 800 mas'),
    ('parallax', -9999.0, 'outside -800 to 800 mas'),
    ('bp_rp', 99.99, 'outside -8 to 12 mag'),
    ('ref_epoch', 0.0, 'outside 1980 to 2050 yr'),
    ('source_id', 0, 'without a number'),
    ('source_id', 1, 'with a number twice'),
]


def test_rows_outside_the_range_of_a_column_are_counted_and_left_out(tmp_path, starcal) -> None:
    given = table()
    expected: Counter[str] = Counter()
    for row, (name, value, words) in enumerate(OUTSIDE, start=-FAINT + 1):  # faint stars
        given[name][row] = value
        expected[words if words.startswith('with') else f'{name} {words}'] += 1
    given.write(tmp_path / 'a.fits')
    out = tmp_path / 'deep.npz'
    said = starcal('catalog', tmp_path / 'a.fits', '-o', out).out
    (line,) = [one for one in said.splitlines() if 'refused' in one]
    counts = (one.split(' ', 1) for one in line.removeprefix('rows refused: ').split(', '))
    assert {words: int(count) for count, words in counts} == expected
    catalog = load_catalog(out)
    assert len(catalog) == len(BUNDLED) + FAINT - len(OUTSIDE)
    assert catalog.magnitude.min() == BUNDLED.magnitude.min() and catalog.magnitude.max() < 14.5
    assert np.abs(catalog.pm_dec_rad_per_year).max() < 11.0 * ARCSECOND_RAD


def test_ranges_of_columns_fit_the_file() -> None:
    """Also of V, which a colour moves from G by up to 5 mag."""
    fields = dataclasses.fields(StarCatalog)[:-2]  # but epoch and digest
    values: dict[str, Any] = {field.name: np.zeros(2) for field in fields}
    extremes = {'dec_rad': 0.5 * np.pi, 'magnitude': 30.0, 'colour_bp_rp': 12.0,
                'pm_dec_rad_per_year': 11.0 * ARCSECOND_RAD}  # fmt: skip
    for name, one in extremes.items():
        values[name] = np.array([-one, one])
    values['parallax_rad'][1] = 0.8 * ARCSECOND_RAD
    assert integer_columns(values)['magnitude'].tolist() == [-30000, 30000]
    for name, one in (('magnitude', 40.0), ('parallax_rad', 2.0 * ARCSECOND_RAD)):
        with pytest.raises(CatalogError, match='steps do not fit'):
            integer_columns({**values, name: np.array([0.0, one])})


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'ra': 1 / 15}, 'is at the place of a star of the bundled catalog'),  # hours
        ({'phot_g_mean_mag': 1e-3}, 'and as bright'),
        ({'source_id': 0}, 'no star in'),
    ],
)
def test_a_table_without_the_bright_stars_of_its_field_is_refused(tmp_path, change, words) -> None:
    given = table()
    given['source_id'] = 10**18 + np.arange(len(given))  # no number of the bundled catalog
    for name, factor in change.items():
        given[name] = (given[name] * factor).astype(given[name].dtype)
    given.write(tmp_path / 'a.fits')
    with pytest.raises(StarcalError, match=words):
        deep_catalog(tmp_path / 'a.fits')


HEADER = 'source_id,ra,dec,phot_g_mean_mag\n'


@pytest.mark.parametrize(
    ('name', 'content', 'words'),
    [
        ('a.csv', 'name,x\nVega,1\n', 'no column source_id, ra, dec, phot_g_mean_mag: give'),
        ('b.fits', 'no table', 'no VOTable, FITS or CSV table'),
        ('text.csv', f'{HEADER}5,1,2,3\n6,abc,2,3\n', "column ra: 'abc' is not a number"),
        ('dash.csv', f'{HEADER}5,1,2,--\n6,1,2,3\n', "column phot_g_mean_mag: '--' is not a"),
        ('bool.csv', f'{HEADER}5,1,True,3\n', "column dec: 'True' is not a number"),
        ('id.csv', f'{HEADER}99999999999999999999,1,2,3\n', "source_id: '99999999999999999999'"),
        ('float.csv', f'{HEADER}5.1e18,1,2,3\n', 'is not a whole number of 64 bits'),
        ('empty.csv', HEADER, 'no star in 0 rows'),
        ('wide.csv', ','.join(map(str, range(200_000))), 'more than 1000 columns'),
    ],
)
def test_bad_tables_are_one_line(tmp_path, starcal, name, content, words) -> None:
    (tmp_path / name).write_text(content)
    assert_refused(starcal('catalog', tmp_path / name, '-o', tmp_path / 'deep'), words)
    assert not (tmp_path / 'deep.npz').exists()
