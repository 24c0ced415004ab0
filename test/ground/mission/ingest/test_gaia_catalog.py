# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Catalogs from tables as the Gaia archive and VizieR write them, written by astropy."""

from __future__ import annotations

from collections import Counter
import dataclasses
import os
from pathlib import Path
from typing import Any

from astropy import units
from astropy.table import MaskedColumn, Table
import numpy as np
import pyarrow
from pyarrow import parquet
import pytest

from starcal_ground.cli.main import main
from starcal_ground.mission.ingest.gaia_catalog import (
    deep_catalog,
    integer_columns,
    write_deep_catalog,
)
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError, StarcalError
from starcal_ros.sky.catalog import load_catalog, MotionSource, StarCatalog

pytestmark = pytest.mark.slow  # a child process reads each table

BUNDLED = load_catalog()
FAINT = 300


def table(shift_arcsec: float = 0.0, epoch: float = 2016.0) -> Table:
    """A field of the archive: all bundled stars of Gaia in it, and fainter ones."""
    rng = np.random.default_rng(5)
    middle = np.radians([200.0, 30.0])
    near = np.hypot(BUNDLED.ra_rad - middle[0], BUNDLED.dec_rad - middle[1]) < np.radians(3.0)
    own = BUNDLED.select(near & (BUNDLED.id > 0))
    ra = np.degrees(np.r_[own.ra_rad, middle[0] + rng.uniform(-0.04, 0.04, FAINT)])
    dec = np.degrees(np.r_[own.dec_rad, middle[1] + rng.uniform(-0.04, 0.04, FAINT)])
    motion = np.r_[np.zeros(len(own)), np.full(FAINT, 40.0)]
    found = Table(
        {
            'source_id': np.r_[own.id, 1 + np.arange(FAINT)],
            'ra': ra + shift_arcsec / 3600.0,
            'dec': dec,
            'pmra': MaskedColumn(motion, mask=np.arange(len(ra)) == len(ra) - 1),
            'pmdec': -motion,
            'parallax': np.full(len(ra), 2.0),
            'phot_g_mean_mag': np.r_[own.magnitude, rng.uniform(9.5, 14.0, FAINT)],
            'bp_rp': np.full(len(ra), 0.8),
            'ref_epoch': np.full(len(ra), epoch),
        }
    )
    for name, unit in (('ra', 'deg'), ('pmra', 'mas/yr'), ('parallax', 'mas')):
        found[name].unit = units.Unit(unit)
    return found


def write(given: Table, path: Path) -> None:
    if path.suffix == '.parquet':
        columns = {name: np.ma.filled(given[name], np.nan) for name in given.colnames}
        parquet.write_table(pyarrow.table(columns), path)
    else:
        given.write(path, format={'.vot': 'votable', '.csv': 'ascii.csv'}.get(path.suffix))


def loaded(path: Path) -> StarCatalog:
    return load_catalog(path)


@pytest.mark.parametrize('ending', ['vot', 'fits', 'csv', 'parquet'])
def test_a_table_of_each_kind_is_added_to_the_bundled_catalog(tmp_path: Path, ending: str) -> None:
    given, path = table(), tmp_path / f'gaia.{ending}'
    write(given, path)
    made = write_deep_catalog(path, tmp_path / 'deep.npz')
    catalog = loaded(tmp_path / 'deep.npz')
    assert len(catalog) == len(BUNDLED) + FAINT and made.unmoved == 1
    assert (np.diff(catalog.magnitude) >= 0).all() and made.faintest > 13.5
    faint = catalog.select((catalog.id > 0) & (catalog.id <= FAINT))
    faint = faint.select(np.argsort(faint.id))
    # Steps of the file: 0.3 mas of place, 0.01 mas a year of motion.
    assert np.abs(np.degrees(faint.ra_rad) - given['ra'][-FAINT:]).max() * 3.6e6 < 0.3
    assert faint.pm_dec_rad_per_year[0] / ARCSECOND_RAD == pytest.approx(-0.04, abs=1e-5)
    assert faint.motion_source[-1] == MotionSource.UNKNOWN  # its motion is masked
    assert set(faint.motion_source[:-1]) == {MotionSource.GAIA}
    # V of a star of BP - RP = 0.8 is 0.146 mag fainter than G by the polynomial of Gaia.
    assert faint.magnitude - given['phot_g_mean_mag'][-FAINT:] == pytest.approx(0.146, abs=0.01)


def test_the_names_of_vizier_are_read(tmp_path: Path) -> None:
    given = table()
    names = {
        'source_id': 'Source', 'ra': 'RA_ICRS', 'dec': 'DE_ICRS', 'pmra': 'pmRA', 'pmdec': 'pmDE',
        'parallax': 'Plx', 'phot_g_mean_mag': 'Gmag', 'bp_rp': 'BP-RP',
    }  # fmt: skip
    for old, new in names.items():
        given.rename_column(old, new)
    given.remove_column('ref_epoch')
    given.write(tmp_path / 'vizier.fits')
    assert deep_catalog(tmp_path / 'vizier.fits').added > FAINT


def test_an_earlier_epoch_is_brought_to_that_of_the_catalog(tmp_path: Path) -> None:
    table(epoch=2015.5).write(tmp_path / 'dr2.fits')
    write_deep_catalog(tmp_path / 'dr2.fits', tmp_path / 'deep.npz')
    faint = loaded(tmp_path / 'deep.npz')
    row = int(np.flatnonzero(faint.id == 1)[0])
    moved_mas = (np.degrees(faint.dec_rad[row]) - table()['dec'][-FAINT]) * 3.6e6
    assert moved_mas == pytest.approx(-20.0, abs=0.3)


def test_places_of_another_frame_are_refused(tmp_path: Path) -> None:
    table(shift_arcsec=2.0).write(tmp_path / 'off.fits')
    with pytest.raises(CatalogError, match=r'1\.7 arcsec off those of the bundled catalog'):
        deep_catalog(tmp_path / 'off.fits')


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


def test_rows_outside_the_range_of_a_column_are_counted_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = table()
    expected: Counter[str] = Counter()
    for row, (name, value, words) in enumerate(OUTSIDE, start=-FAINT + 1):  # faint stars
        given[name][row] = value
        expected[words if words.startswith('with') else f'{name} {words}'] += 1
    given.write(tmp_path / 'a.fits')
    out = tmp_path / 'deep.npz'
    assert main(['catalog', str(tmp_path / 'a.fits'), '-o', str(out)]) == 0
    (line,) = [one for one in capsys.readouterr().out.splitlines() if 'refused' in one]
    counts = (one.split(' ', 1) for one in line.removeprefix('rows refused: ').split(', '))
    assert {words: int(count) for count, words in counts} == expected
    catalog = loaded(out)
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
def test_a_table_without_the_bright_stars_of_its_field_is_refused(
    tmp_path: Path, change: dict[str, float], words: str
) -> None:
    given = table()
    given['source_id'] = 10**18 + np.arange(len(given))  # no number of the bundled catalog
    for name, factor in change.items():
        given[name] = (given[name] * factor).astype(given[name].dtype)
    given.write(tmp_path / 'a.fits')
    with pytest.raises(StarcalError, match=words):
        deep_catalog(tmp_path / 'a.fits')


def test_bright_stars_are_known_by_their_places(tmp_path: Path) -> None:
    given = table()
    given['source_id'] = 10**18 + np.arange(len(given))
    given.write(tmp_path / 'a.fits')
    assert deep_catalog(tmp_path / 'a.fits').added > 0


def write_bomb(path: Path) -> Path:
    """A Parquet file of a kilobyte a column whose rows, all alike, take gigabytes."""
    schema = pyarrow.schema([(name, pyarrow.float64()) for name in ('ra', 'dec', 'source_id')])
    with parquet.ParquetWriter(path, schema) as writer:
        part = pyarrow.table({name: np.zeros(2**20) for name in schema.names})
        for _ in range(12):
            writer.write_table(part)
    assert path.stat().st_size < 2**20
    return path


HEADER = 'source_id,ra,dec,phot_g_mean_mag\n'


@pytest.mark.parametrize(
    ('name', 'content', 'words'),
    [
        ('a.csv', 'name,x\nVega,1\n', 'no column ra, dec, phot_g_mean_mag, source_id'),
        ('b.fits', 'no table', 'no VOTable, FITS, CSV or Parquet table'),
        ('c.vot', None, 'cannot be read: No such file'),
        ('text.csv', f'{HEADER}5,1,2,3\n6,abc,2,3\n', "column ra: 'abc' is not a number"),
        ('dash.csv', f'{HEADER}5,1,2,--\n6,1,2,3\n', "column phot_g_mean_mag: '--' is not a"),
        ('bool.csv', f'{HEADER}5,1,True,3\n', "column dec: 'True' is not a number"),
        ('id.csv', f'{HEADER}99999999999999999999,1,2,3\n', "source_id: '99999999999999999999'"),
        ('float.csv', f'{HEADER}5.1e18,1,2,3\n', 'is not a whole number of 64 bits'),
        ('empty.csv', HEADER, 'no star in 0 rows'),
        ('wide.csv', ','.join(map(str, range(200_000))), 'more than 1000 columns'),
        ('folder.csv', 'folder', 'cannot be read: Is a directory'),
        ('pipe.csv', 'pipe', 'not a regular file'),
        ('bomb.parquet', 'bomb', 'more than 10000000 rows'),
    ],
)
def test_bad_tables_are_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    content: str | None,
    words: str,
) -> None:
    path, out = tmp_path / name, str(tmp_path / 'deep')
    makers: dict[str, Any] = {'folder': Path.mkdir, 'pipe': os.mkfifo, 'bomb': write_bomb}
    if content is not None:
        makers.get(content, lambda path: path.write_text(content))(path)
    assert main(['catalog', str(path), '-o', out]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count('\n') == 1
    assert not Path(f'{out}.npz').exists()
