# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A star catalog as deep as needed, from a table of Gaia DR3 and the bundled catalog.

Read are VOTable, FITS, CSV and Parquet as the Gaia archive and VizieR (I/355/gaiadr3) give them.
Stars of the table take the place of those of the bundled catalog with their number; other stars
stay, since Gaia lacks the brightest, and a blind search needs all of the sky.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import io
from pathlib import Path
import re
from typing import Any, NamedTuple
import warnings

import erfa
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcal_ground.mission.ingest.mission_records import Guard
from starcal_ros.arrays import Floats, Indices
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError, IngestError, needing
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.sky import catalog as sky_catalog
from starcal_ros.untrusted import regular_file, shown


class _Column(NamedTuple):
    """A column of a table: unit, the range that a star can have, its names in lower case."""

    unit: str
    low: float
    high: float
    names: tuple[str, ...]  # of the archive, then of VizieR


# Ranges are wider than the extremes of Gaia DR3, and within what a catalog file can hold.  Numbers
# that stand for none, as 99.99 or -999, are outside.
_COLUMNS = {
    'ra': _Column('deg', 0.0, 360.0, ('ra', 'ra_icrs')),
    'dec': _Column('deg', -90.0, 90.0, ('dec', 'de_icrs')),
    'pm_ra': _Column('mas/yr', -11e3, 11e3, ('pmra',)),
    'pm_dec': _Column('mas/yr', -11e3, 11e3, ('pmdec', 'pmde')),
    'parallax': _Column('mas', -800.0, 800.0, ('parallax', 'plx')),
    'g': _Column('mag', -2.0, 25.0, ('phot_g_mean_mag', 'gmag')),
    'colour': _Column('mag', -8.0, 12.0, ('bp_rp', 'bp-rp')),
    'epoch': _Column('yr', 1980.0, 2050.0, ('ref_epoch',)),
}
_NUMBER = ('source_id', 'source')
_NEEDED = ('ra', 'dec', 'g')
_MOST_COLUMNS = 1000  # gaia_source has 152
_MOST_ROWS = 10_000_000  # of Parquet, whose rows may take no space in the file: V = 13 of all sky
_PROCESSOR_S, _WALL_S = 60.0, 120.0  # three million rows of a VOTable in text
_masked: Any = np.ma
_NUMERAL = re.compile(r'[-+.\deE]+')
_MAS_RAD = 1e-3 * ARCSECOND_RAD
_SAME_STAR_RAD = 3.0 * ARCSECOND_RAD
_CLOSE_PAIR_MAGNITUDES = 5.0
_MOST_OFF_RAD = 0.3 * ARCSECOND_RAD  # median of the stars of both catalogs; right ones: 1 mas
_ALIKE_MAG = 1.0  # of V by the colour and V of the bundled catalog


@dataclass(frozen=True)
class DeepCatalog:
    """
    Columns of a catalog file, its stars of the table, and the faintest V of these.

    ``refused`` has the number of rows of the table that were left out, by reason, ``unmoved`` that
    of its stars without a proper motion.
    """

    columns: dict[str, NDArray[np.generic]]
    added: int
    faintest: float
    refused: dict[str, int]
    unmoved: int


def write_deep_catalog(table: Path, output: Path) -> DeepCatalog:
    """
    Write the catalog file of a table of Gaia.

    Raises as `deep_catalog`.
    """
    made = deep_catalog(table)
    write_atomically(output, catalog_file(made.columns))
    return made


def catalog_file(columns: Mapping[str, NDArray[np.generic]]) -> bytes:
    """
    Content of a catalog file.

    Equal stars give equal bytes, since numpy dates archive members 1980, except that Python 3.10
    writes another archive version than 3.11 and later.  The digest covers only the stars.
    """
    content = io.BytesIO()
    np.savez_compressed(
        content,
        format=np.array(sky_catalog.CATALOG_FORMAT),
        digest=np.array(sky_catalog.column_digest(columns)),
        **columns,  # type: ignore[arg-type]  # no column is named allow_pickle
    )
    return content.getvalue()


def deep_catalog(path: Path) -> DeepCatalog:
    """
    The stars of a table with those of the bundled catalog that it lacks, brightest first.

    Raises IngestError when the table cannot be read, lacks a column, or a column has no numbers.
    Raises CatalogError when it has no bright stars of the bundled catalog, or at other places.
    """
    with Guard(_PROCESSOR_S, _WALL_S) as guard:
        stars, refused = guard.call(path, _read, path)
    bundled = sky_catalog.load_catalog()
    _check(path, stars, bundled)
    kept = ~np.isin(bundled.id, stars['id'])
    # Of stars without a number of Gaia, or with another one in the bundled catalog.
    apart, _ = cKDTree(bundled.direction_icrs[kept]).query(_direction(stars))
    new = apart > _SAME_STAR_RAD
    values = {
        name: np.concatenate([values[new], getattr(bundled, name)[kept]])
        for name, values in stars.items()
    }
    pairs = close_pairs(_direction(values))
    values['close_pair'] = marked_close(pairs, values['magnitude'])
    values['close_pair'][int(new.sum()) :] |= bundled.close_pair[kept]
    return DeepCatalog(
        integer_columns(values),
        int(new.sum()),
        float(stars['magnitude'][new].max(initial=0.0)),
        refused,
        int((stars['motion_source'][new] == sky_catalog.MotionSource.UNKNOWN).sum()),
    )


def integer_columns(values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """
    Columns of a catalog file of those of a `StarCatalog`, by magnitude, then number.

    Raises CatalogError for a value that the type of its column cannot hold.
    """
    units = {
        'ra': ('ra_rad', sky_catalog.ANGLE_UNIT_RAD),
        'dec': ('dec_rad', sky_catalog.ANGLE_UNIT_RAD),
        'pm_ra_cosdec': ('pm_ra_cosdec_rad_per_year', sky_catalog.MOTION_UNIT_RAD),
        'pm_dec': ('pm_dec_rad_per_year', sky_catalog.MOTION_UNIT_RAD),
        'parallax': ('parallax_rad', sky_catalog.PARALLAX_UNIT_RAD),
        'magnitude': ('magnitude', sky_catalog.MAGNITUDE_UNIT),
        'colour_bp_rp': ('colour_bp_rp', sky_catalog.MAGNITUDE_UNIT),
    }
    whole = {name: np.rint(values[of] / unit) for name, (of, unit) in units.items()}
    whole['colour_bp_rp'][np.isnan(whole['colour_bp_rp'])] = sky_catalog.NO_COLOUR
    whole['ra'] %= 2**32
    for name, stored in whole.items():
        room = np.iinfo(sky_catalog.COLUMN_TYPES[name])
        if len(stored) and not (room.min <= stored.min() and stored.max() <= room.max):
            raise CatalogError(f'{name}: {stored.min():g} to {stored.max():g} steps do not fit')
    order = np.lexsort([values['id'], whole['magnitude']])
    return {
        name: (whole if name in whole else values)[name][order].astype(kind)
        for name, kind in sky_catalog.COLUMN_TYPES.items()
    }


def _check(
    path: Path, stars: Mapping[str, NDArray[Any]], bundled: sky_catalog.StarCatalog
) -> None:
    """Raise CatalogError where bright stars are missing, or are at different places."""
    direction = _direction(stars)
    _, mine, theirs = np.intersect1d(stars['id'], bundled.id, return_indices=True)
    off = np.linalg.norm(direction[mine] - bundled.direction_icrs[theirs], axis=1)
    if len(off) and np.median(off) > _MOST_OFF_RAD:
        raise CatalogError(
            f'{path}: its stars are {np.median(off) / ARCSECOND_RAD:.1f} arcsec off those of the'
            ' bundled catalog: not ICRS, or not at the epoch that ref_epoch states (default 2016)'
        )
    apart, row = cKDTree(bundled.direction_icrs).query(direction)
    fainter = stars['magnitude'] - bundled.magnitude[row]
    if not ((apart < _MOST_OFF_RAD) & (np.abs(fainter) < _ALIKE_MAG)).any():
        raise CatalogError(
            f'{path}: none of its {len(apart)} stars is at the place of a star of the bundled'
            ' catalog, which has all to V = 9, and as bright: give ra and dec in degrees, ICRS, G'
            ' in magnitudes, and the bright stars of the field too'
        )


def _direction(stars: Mapping[str, NDArray[Any]]) -> Floats:
    """Unit vectors (n, 3) of stars."""
    return np.asarray(erfa.s2c(stars['ra_rad'], stars['dec_rad']))


def close_pairs(direction: Floats) -> NDArray[np.intp]:
    """Rows (k, 2) of the stars within 20 arcsec of each other."""
    reach = 2 * np.sin(sky_catalog.CLOSE_PAIR_RAD / 2)
    return np.asarray(cKDTree(direction).query_pairs(reach, output_type='ndarray'))


def marked_close(pairs: NDArray[np.intp], magnitude: Floats) -> NDArray[np.bool_]:
    """Mask of stars (n,) that are in a pair with one at most 5 magnitudes fainter."""
    fainter_by = magnitude[pairs[:, 1]] - magnitude[pairs[:, 0]]
    marked = np.zeros(len(magnitude), np.bool_)
    marked[pairs[fainter_by <= _CLOSE_PAIR_MAGNITUDES, 0]] = True
    marked[pairs[-fainter_by <= _CLOSE_PAIR_MAGNITUDES, 1]] = True
    return marked


def johnson_v(g: Floats, bp_rp: Floats) -> Floats:
    """V from G and BP - RP, Gaia DR3 documentation section 5.5.1; without a colour, G + 0.15."""
    c = np.clip(bp_rp, -0.5, 5.0)  # its range
    v = g - (-0.02704 + 0.01424 * c - 0.2156 * c**2 + 0.01426 * c**3)
    return np.asarray(np.where(np.isnan(v), g + 0.15, v))


def _read(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, int]]:
    """Stars (n,) of a table by the names of `StarCatalog`, and how many rows were refused, why."""
    number, table, refused = _rows(path)
    motion = np.stack([table['pm_ra'], table['pm_dec']], axis=-1) * _MAS_RAD
    has_motion = np.isfinite(motion).all(axis=1)
    motion[~has_motion] = 0.0
    years = sky_catalog.CATALOG_EPOCH_JYEAR - np.nan_to_num(
        table['epoch'], nan=sky_catalog.CATALOG_EPOCH_JYEAR
    )
    ra, dec = np.radians(table['ra']), np.radians(table['dec'])
    return {
        'id': number,
        'ra_rad': (ra + motion[:, 0] * years / np.maximum(np.cos(dec), 1e-9)) % (2 * np.pi),
        'dec_rad': dec + motion[:, 1] * years,
        'pm_ra_cosdec_rad_per_year': motion[:, 0],
        'pm_dec_rad_per_year': motion[:, 1],
        'parallax_rad': np.nan_to_num(table['parallax']).clip(0) * _MAS_RAD,
        'magnitude': johnson_v(table['g'], table['colour']),
        'colour_bp_rp': table['colour'],
        'motion_source': np.where(
            has_motion, sky_catalog.MotionSource.GAIA, sky_catalog.MotionSource.UNKNOWN
        ),
    }, refused


def _rows(path: Path) -> tuple[Indices, dict[str, Floats], dict[str, int]]:
    """Numbers (n,) and columns (n,) of the sound rows, in their units, and the rows refused."""
    table = _table(path)
    there = {name.lower(): name for name in table.colnames}
    name_of = {
        key: next((there[name] for name in column.names if name in there), None)
        for key, column in _COLUMNS.items()
    }
    number = next((there[name] for name in _NUMBER if name in there), None)
    lacking = [_COLUMNS[key].names[0] for key in _NEEDED if name_of[key] is None]
    lacking += [] if number else ['source_id']
    if number is None or lacking:
        raise IngestError(
            f'{path}: no column {", ".join(lacking)}: give a table of gaia_source or I/355'
        )
    identifier = _masked.filled(_numbers(path, table, number, 'iu'), 0)
    values = {
        key: np.full(len(table), np.nan)
        if name is None
        else _in_unit(_numbers(path, table, name, 'iuf'), table[name].unit, _COLUMNS[key].unit)
        for key, name in name_of.items()
    }
    reasons = {'without a number': (identifier < 1) | (identifier > np.iinfo(np.int64).max)}
    for key, (unit, low, high, _) in _COLUMNS.items():
        name, outside = name_of[key], (values[key] < low) | (values[key] > high)
        if key in _NEEDED:
            reasons[f'without {name}'] = np.isnan(values[key])
        reasons[f'{name} outside {low:g} to {high:g} {unit}'] = outside
    kept, refused = np.ones(len(table), np.bool_), {}
    for reason, is_bad in reasons.items():
        refused[reason] = int((kept & is_bad).sum())
        kept &= ~is_bad
    rows = np.flatnonzero(kept)
    rows = rows[np.unique(identifier[rows], return_index=True)[1]]
    refused['with a number twice'] = int(kept.sum()) - len(rows)
    refused = {reason: count for reason, count in refused.items() if count}
    if not len(rows):
        raise IngestError(f'{path}: no star in {len(table)} rows; {refusals(refused)}')
    return identifier[rows].astype(np.int64), {k: v[rows] for k, v in values.items()}, refused


def refusals(refused: Mapping[str, int]) -> str:
    """Return the rows refused in words; empty if there are none."""
    counts = ', '.join(f'{count} {reason}' for reason, count in refused.items())
    return counts and f'rows refused: {counts}'


def _table(path: Path) -> Any:
    """A table of astropy."""
    with needing('mission', IngestError, path):
        from astropy.table import Table
    try:
        with regular_file(path) as file:
            columns = file.readline(2**20).count(b',') if path.suffix == '.csv' else 0
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of units that VizieR spells in its own way
            if path.suffix == '.parquet':
                return Table(_parquet(path))
            if columns > _MOST_COLUMNS:
                raise ValueError(f'more than {_MOST_COLUMNS} columns')
            return Table.read(path)
    except OSError as error:
        raise IngestError(f'{path}: cannot be read: {error.strerror or error}') from error
    except MemoryError:
        raise
    except Exception as error:  # astropy raises whatever a damaged file brings about
        words = ' '.join(str(error).split())[:120]
        raise IngestError(f'{path}: no VOTable, FITS, CSV or Parquet table: {words}') from error


def _parquet(path: Path) -> dict[str, NDArray[Any]]:
    """The columns of `_COLUMNS` in a Parquet file; astropy would need pandas."""
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        if file.metadata.num_rows > _MOST_ROWS:
            raise ValueError(f'more than {_MOST_ROWS} rows')
        known = {*_NUMBER, *(name for column in _COLUMNS.values() for name in column.names)}
        names = [name for name in file.schema_arrow.names if name.lower() in known]
        table = file.read(names)
    return {
        name: (table[name].fill_null(0) if name.lower() in _NUMBER else table[name]).to_numpy()
        for name in names
    }


def _numbers(path: Path, table: Any, name: str, kinds: str) -> Any:
    """A masked column (n,); raises IngestError for one that is not of these kinds of numbers."""
    column = _masked.asarray(table[name])
    if column.ndim == 1 and column.dtype.kind in kinds:
        return column
    of_text = (str(value) for value in column.ravel() if not _NUMERAL.fullmatch(str(value)))
    value = shown(next(of_text, str(column.ravel()[0]))) if column.size else 'nothing'
    what = 'a whole number of 64 bits' if kinds == 'iu' else 'a number'
    raise IngestError(f'{path}: column {name}: {value} is not {what}; leave a missing value empty')


def _in_unit(column: Any, own: Any, unit: str) -> Floats:
    """A masked column in a unit, NaN where it is masked."""
    from astropy import units

    values: Floats = _masked.filled(column.astype(np.float64), np.nan)
    if unit in ('mag', 'yr') or own is None:
        return values
    try:
        return values * float(own.to(units.Unit(unit)))
    except (units.UnitConversionError, AttributeError, TypeError):
        return values  # a unit that astropy cannot parse
