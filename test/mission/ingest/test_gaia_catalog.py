# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Catalogs from tables as the Gaia archive and VizieR write them, written by astropy."""

from __future__ import annotations

from pathlib import Path

from astropy import units
from astropy.table import MaskedColumn, Table
import numpy as np
import pyarrow
from pyarrow import parquet
import pytest

from starcal_ros.cli.main import main
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError
from starcal_ros.mission.ingest.gaia_catalog import deep_catalog, write_deep_catalog
from starcal_ros.sky.catalog import load_catalog, MotionSource, StarCatalog

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
    assert len(catalog) == len(BUNDLED) + FAINT
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


def test_bad_tables_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / 'a.csv').write_text('name,x\nVega,1\n')
    (tmp_path / 'b.fits').write_bytes(b'no table')
    out = str(tmp_path / 'deep')
    for name, said in (
        ('a.csv', 'no column ra, dec, phot_g_mean_mag, source_id'),
        ('b.fits', 'no VOTable, FITS, CSV or Parquet table'),
        ('c.vot', 'no such file'),
    ):
        assert main(['catalog', str(tmp_path / name), '-o', out]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count('\n') == 1
    assert not Path(f'{out}.npz').exists()
