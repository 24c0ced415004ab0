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
from typing import Any
import warnings

import erfa
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Indices
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError, needing
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.sky.catalog import (
    ANGLE_UNIT_RAD,
    CATALOG_EPOCH_JYEAR,
    CATALOG_FORMAT,
    CLOSE_PAIR_RAD,
    column_digest,
    COLUMN_TYPES,
    load_catalog,
    MAGNITUDE_UNIT,
    MOTION_UNIT_RAD,
    MotionSource,
    NO_COLOUR,
    PARALLAX_UNIT_RAD,
    StarCatalog,
)

# Quantity: its unit, and its names in the archive and in VizieR, in lower case.
_COLUMNS: dict[str, tuple[str, tuple[str, ...]]] = {
    'ra': ('deg', ('ra', 'ra_icrs')),
    'dec': ('deg', ('dec', 'de_icrs')),
    'pm_ra': ('mas/yr', ('pmra',)),
    'pm_dec': ('mas/yr', ('pmdec', 'pmde')),
    'parallax': ('mas', ('parallax', 'plx')),
    'g': ('mag', ('phot_g_mean_mag', 'gmag')),
    'colour': ('mag', ('bp_rp', 'bp-rp')),
    'epoch': ('yr', ('ref_epoch',)),
}
_NUMBER = ('source_id', 'source')
_NEEDED = ('ra', 'dec', 'g')
_MAS_RAD = 1e-3 * ARCSECOND_RAD
_SAME_STAR_RAD = 3.0 * ARCSECOND_RAD
_CLOSE_PAIR_MAGNITUDES = 5.0
_MOST_OFF_RAD = 0.3 * ARCSECOND_RAD  # median of the stars of both catalogs; right ones: 1 mas


@dataclass(frozen=True)
class DeepCatalog:
    """Columns of a catalog file, its stars of the table, and the faintest V of these."""

    columns: dict[str, NDArray[np.generic]]
    added: int
    faintest: float


def write_deep_catalog(table: Path, output: Path) -> DeepCatalog:
    """
    Write the catalog file of a table of Gaia.

    Raises CatalogError when the table cannot be read, lacks a column, or is not of Gaia DR3.
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
        format=np.array(CATALOG_FORMAT),
        digest=np.array(column_digest(columns)),
        **columns,  # type: ignore[arg-type]  # no column is named allow_pickle
    )
    return content.getvalue()


def deep_catalog(path: Path) -> DeepCatalog:
    """The stars of a table with those of the bundled catalog that it lacks, brightest first."""
    stars, bundled = _read(path), load_catalog()
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
    )


def integer_columns(values: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Columns of a catalog file of those of a `StarCatalog`, by magnitude, then number."""
    units = {
        'ra': ('ra_rad', ANGLE_UNIT_RAD),
        'dec': ('dec_rad', ANGLE_UNIT_RAD),
        'pm_ra_cosdec': ('pm_ra_cosdec_rad_per_year', MOTION_UNIT_RAD),
        'pm_dec': ('pm_dec_rad_per_year', MOTION_UNIT_RAD),
        'parallax': ('parallax_rad', PARALLAX_UNIT_RAD),
        'magnitude': ('magnitude', MAGNITUDE_UNIT),
        'colour_bp_rp': ('colour_bp_rp', MAGNITUDE_UNIT),
    }
    whole = {name: np.rint(values[of] / unit) for name, (of, unit) in units.items()}
    whole['colour_bp_rp'][np.isnan(whole['colour_bp_rp'])] = NO_COLOUR
    whole['ra'] %= 2**32
    order = np.lexsort([values['id'], whole['magnitude']])
    return {
        name: (whole if name in whole else values)[name][order].astype(kind)
        for name, kind in COLUMN_TYPES.items()
    }


def _check(path: Path, stars: Mapping[str, NDArray[Any]], bundled: StarCatalog) -> None:
    """Raise CatalogError where stars of both catalogs are at different places."""
    _, mine, theirs = np.intersect1d(stars['id'], bundled.id, return_indices=True)
    off = np.linalg.norm(_direction(stars)[mine] - bundled.direction_icrs[theirs], axis=1)
    if len(off) and np.median(off) > _MOST_OFF_RAD:
        raise CatalogError(
            f'{path}: its stars are {np.median(off) / ARCSECOND_RAD:.1f} arcsec off those of the'
            ' bundled catalog: not ICRS, or not at the epoch that ref_epoch states (default 2016)'
        )


def _direction(stars: Mapping[str, NDArray[Any]]) -> Floats:
    """Unit vectors (n, 3) of stars."""
    return np.asarray(erfa.s2c(stars['ra_rad'], stars['dec_rad']))


def close_pairs(direction: Floats) -> NDArray[np.intp]:
    """Rows (k, 2) of the stars within 20 arcsec of each other."""
    reach = 2 * np.sin(CLOSE_PAIR_RAD / 2)
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


def _read(path: Path) -> dict[str, NDArray[Any]]:
    """Stars (n,) of a table with a place and a magnitude, by the names of `StarCatalog`."""
    number, table = _columns(path)
    motion = np.stack([table['pm_ra'], table['pm_dec']], axis=-1) * _MAS_RAD
    has_motion = np.isfinite(motion).all(axis=1)
    motion[~has_motion] = 0.0
    years = CATALOG_EPOCH_JYEAR - np.nan_to_num(table['epoch'], nan=CATALOG_EPOCH_JYEAR)
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
        'motion_source': np.where(has_motion, MotionSource.GAIA, MotionSource.UNKNOWN),
    }


def _columns(path: Path) -> tuple[Indices, dict[str, Floats]]:
    """Numbers (n,) and columns (n,) of a table, in their units."""
    table = _table(path)
    there = {name.lower(): name for name in table.colnames}
    number = next((there[name] for name in _NUMBER if name in there), None)
    found = {
        name: _column(table, next((there[n] for n in names if n in there), None), unit)
        for name, (unit, names) in _COLUMNS.items()
    }
    lacking = [_COLUMNS[name][1][0] for name in _NEEDED if np.isnan(found[name]).all()]
    lacking += [] if number else ['source_id']
    if number is None or lacking:
        raise CatalogError(
            f'{path}: no column {", ".join(lacking)}: give a table of gaia_source or I/355'
        )
    good = np.isfinite([found[name] for name in _NEEDED]).all(axis=0)
    good &= np.abs(found['dec']) <= 90.0
    numbers = np.asarray(table[number], np.int64)
    _, first = np.unique(numbers, return_index=True)
    rows = first[good[first]]
    return numbers[rows], {name: column[rows] for name, column in found.items()}


def _table(path: Path) -> Any:
    """A table of astropy."""
    with needing('mission', CatalogError, path):
        from astropy.table import Table
    if not path.is_file():
        raise CatalogError(f'{path}: no such file')
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # of units that VizieR spells in its own way
            return Table(_parquet(path)) if path.suffix == '.parquet' else Table.read(path)
    except Exception as error:  # astropy raises whatever a damaged file brings about
        words = ' '.join(str(error).split())[:120]
        raise CatalogError(f'{path}: no VOTable, FITS, CSV or Parquet table: {words}') from error


def _parquet(path: Path) -> dict[str, NDArray[Any]]:
    """Columns of a Parquet file; astropy would need pandas."""
    from pyarrow import parquet

    found = parquet.read_table(path)
    return {name: found[name].to_numpy() for name in found.column_names}


def _column(table: Any, name: str | None, unit: str) -> Floats:
    """A column in a unit, NaN where it is masked or missing."""
    from astropy import units

    if name is None:
        return np.full(len(table), np.nan)
    column = table[name]
    masked: Any = np.ma
    values: Floats = masked.filled(masked.asarray(column, np.float64), np.nan)
    if unit in ('mag', 'yr') or column.unit is None:
        return values
    try:
        return values * float(column.unit.to(units.Unit(unit)))
    except (units.UnitConversionError, AttributeError, TypeError):
        return values  # a unit that astropy cannot parse
