# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A star catalog as deep as needed, from a table of stars and the bundled catalog.

Read are VOTable, FITS and CSV with the columns of a row of `_SOURCES`, and index files of
astrometry.net.  Stars of the table take the place of those of the bundled catalog with their
number; other stars stay, since Gaia lacks the brightest, and a blind search needs all of the sky.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
from starcal_ground.written_files import write_marked
from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError, IngestError, needing
from starcal_ros.robust_statistics import median
from starcal_ros.sky import catalog as sky_catalog
from starcal_ros.sky.catalog import MotionSource
from starcal_ros.untrusted import regular_file, shown

UNMOVED = (MotionSource.UNKNOWN, MotionSource.UNKNOWN_J2000)


def johnson_v(g: Floats, bp_rp: Floats) -> Floats:
    """V from G and BP - RP, Gaia DR3 documentation section 5.5.1; without a colour, G + 0.15."""
    c = np.clip(bp_rp, -0.5, 5.0)  # its range
    v = g - (-0.02704 + 0.01424 * c - 0.2156 * c**2 + 0.01426 * c**3)
    return np.asarray(np.where(np.isnan(v), g + 0.15, v))


def _of_tycho(vt: Floats, bt_vt: Floats) -> Floats:
    """V from VT and BT - VT, The Hipparcos and Tycho Catalogues (ESA 1997), section 1.3."""
    return np.asarray(vt - np.where(np.isnan(bt_vt), 0.06, 0.09 * bt_vt))


def _of_2mass(j: Floats, j_k: Floats) -> Floats:
    """V from J and J - K, Stassun et al. 2018, AJ 156, 102; without a colour, J + 1.4."""
    c = np.clip(j_k, -0.1, 1.0)
    v = j + 0.1496 + 3.5143 * c - 2.325 * c**2 + 1.4688 * c**3
    return np.asarray(np.where(np.isnan(v), j + 1.4, v))


class _Source(NamedTuple):
    """Columns of a source by their keys, lower case, and the epoch of places without a column."""

    title: str
    columns: Mapping[str, str]
    jyear: float
    motion: MotionSource
    v: Callable[[Floats, Floats], Floats]


def _source(title: str, names: str, jyear: float, motion: MotionSource, v: Any) -> _Source:
    """A source whose columns are named in the order of the keys, - where it has none."""
    keys = ('number', 'ra', 'dec', 'pm_ra', 'pm_dec', 'parallax', 'magnitude', 'colour', 'blue',
            'red', 'epoch')  # fmt: skip
    pairs = zip(keys, names.split(), strict=True)
    return _Source(title, {key: name for key, name in pairs if name != '-'}, jyear, motion, v)


_GAIA, _TYCHO, _NONE = MotionSource.GAIA, MotionSource.TYCHO, MotionSource.UNKNOWN
# A source without a colour has the difference of two bands; stars without a number, their places.
_SOURCES = (
    _source('Gaia, archive', 'source_id ra dec pmra pmdec parallax phot_g_mean_mag bp_rp - -'
            ' ref_epoch', 2016.0, _GAIA, johnson_v),
    _source('Gaia DR3, VizieR I/355', 'source ra_icrs de_icrs pmra pmde plx gmag bp-rp - - -',
            2016.0, _GAIA, johnson_v),
    _source('Gaia DR2, astrometry.net 5000', 'source_id ra dec pmra pmdec parallax phot_g_mean_mag'
            ' - phot_bp_mean_mag phot_rp_mean_mag ref_epoch', 2015.5, _GAIA, johnson_v),
    _source('Tycho-2, VizieR I/259', '- ramdeg demdeg pmra pmde - vtmag - btmag vtmag -',
            2000.0, _TYCHO, _of_tycho),
    _source('Tycho-2, astrometry.net 4100', '- ra dec - - - mag_vt - - - -',
            2000.0, _NONE, _of_tycho),
    _source('2MASS, VizieR II/246', '- raj2000 dej2000 - - - jmag - jmag kmag -',
            2000.0, _NONE, _of_2mass),
    _source('2MASS, astrometry.net 4200', '- ra dec - - - j_mag - - - -',
            2000.0, _NONE, _of_2mass),
)  # fmt: skip
# Units, and ranges wider than the extremes of Gaia DR3 and within what a catalog file can hold.
# Marks of a missing number, such as 99.99 or -999, are outside.
_RANGES = {
    'ra': ('deg', 0.0, 360.0),
    'dec': ('deg', -90.0, 90.0),
    'pm_ra': ('mas/yr', -11e3, 11e3),
    'pm_dec': ('mas/yr', -11e3, 11e3),
    'parallax': ('mas', -800.0, 800.0),
    'magnitude': ('mag', -2.0, 25.0),
    'colour': ('mag', -8.0, 12.0),
    'epoch': ('yr', 1980.0, 2050.0),
}
_NEEDED = ('number', 'ra', 'dec', 'magnitude')
_MOST_COLUMNS = 1000  # gaia_source has 152
_PROCESSOR_S, _WALL_S = 60.0, 120.0  # three million rows of a VOTable in text
_masked: Any = np.ma
_NUMERAL = re.compile(r'[-+.\deE]+')
_MAS_RAD = 1e-3 * ARCSECOND_RAD
_SAME_STAR_RAD = 3.0 * ARCSECOND_RAD
_CLOSE_PAIR_MAGNITUDES = 5.0
_OLD_JYEAR = 2008.0  # places without a motion are of Gaia after it, of about J2000 before
_PLACE_DIGITS = 10**5  # steps per degree in the number made for a star without one
_NEAR_RAD = 30.0 * ARCSECOND_RAD  # to a star of the bundled catalog, with its proper motion
_MOST_OFF_RAD = 0.3 * ARCSECOND_RAD  # median of the stars of both catalogs; right ones: 1 mas
_MOST_TURN_RAD, _MOST_YEARS, _SIGMAS = 0.1 * ARCSECOND_RAD, 3.0, 5.0
_FEWEST = 4  # stars that show an epoch and a rotation
_ALIKE_MAG = 1.0  # largest difference of V by the colour and V of the bundled catalog


@dataclass(frozen=True)
class DeepCatalog:
    """
    Columns of a catalog file, its stars of the table, and the faintest V of these.

    ``source`` is the title of the source.  ``refused`` has the number of rows of the table that
    were left out, by reason, ``unmoved`` that of its stars without a proper motion, ``checked``
    that of the stars of the bundled catalog at whose places the table has them.
    """

    columns: dict[str, NDArray[np.generic]]
    source: str
    added: int
    faintest: float
    refused: dict[str, int]
    unmoved: int
    checked: int


def write_deep_catalog(table: Path, output: Path) -> DeepCatalog:
    """
    Write the catalog file of a table of stars.

    Raises as `deep_catalog`.
    """
    made = deep_catalog(table)
    write_marked(output, catalog_file(made.columns))
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
        table = guard.call(path, _read, path)
    stars, bundled = table.stars, sky_catalog.load_catalog()
    checked = _check(path, table, bundled)
    kept = ~np.isin(bundled.id, stars['id'])
    # Stars without a Gaia number, or with another one in the bundled catalog, match by place.
    apart, _ = cKDTree(_at(bundled, table.jyear)[0][kept]).query(_direction(stars))
    new = apart > _SAME_STAR_RAD
    values = {
        name: np.concatenate([values[new], getattr(bundled, name)[kept]])
        for name, values in stars.items()
    }
    pairs = close_pairs(_direction(values))
    values['close_pair'] = marked_close(pairs, values['magnitude'])
    values['close_pair'][int(new.sum()) :] |= bundled.close_pair[kept]
    unmoved = np.isin(stars['motion_source'], UNMOVED)
    return DeepCatalog(
        integer_columns(values),
        table.source,
        int(new.sum()),
        float(stars['magnitude'][new].max(initial=0.0)),
        table.refused,
        int(unmoved[new].sum()),
        checked,
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


def _check(path: Path, table: _Table, bundled: sky_catalog.StarCatalog) -> int:
    """
    Number of stars that have the places of the bundled catalog in the year of theirs.

    Raises CatalogError where bright stars are missing, or are at different places.
    """
    stars, (then, motion) = table.stars, _at(bundled, table.jyear)
    direction = _direction(stars)
    _, mine, theirs = np.intersect1d(stars['id'], bundled.id, return_indices=True)
    if len(mine) < _FEWEST:
        mine, theirs = _alike(direction, then, stars['magnitude'], bundled)
    if len(mine) == 0 and _covers(direction, then):
        raise CatalogError(
            f'{path}: none of its {len(direction)} stars is at the place of a star of the bundled'
            ' catalog, which has all to V = 9, and as bright: give ra and dec in degrees, ICRS,'
            ' magnitudes as in the source, and the bright stars of the field too'
        )
    off = direction[mine] - then[theirs]
    off_rad = median(np.linalg.norm(off, axis=1)) if len(mine) else 0.0
    years = turned_rad = 0.0
    if len(mine) >= _FEWEST:
        years, turned_rad = _epoch_and_turn(off, then[theirs], motion[theirs])
    epoch, turned_arcsec = table.epoch + years, turned_rad / ARCSECOND_RAD
    epochs = f'of J{epoch:.1f}, not J{table.epoch:.1f}: state their epoch in a column ref_epoch'
    turned = f'turned by {turned_arcsec:.2f} arcsec: give ICRS, not another frame or equinox'
    share, cause = max(
        (abs(years) / _MOST_YEARS, epochs),
        (turned_rad / _MOST_TURN_RAD, turned),
        (off_rad / _MOST_OFF_RAD / 1e3, 'neither turned nor of another epoch as a whole'),
    )
    if max(share, off_rad / _MOST_OFF_RAD) > 1.0:
        size = f'{off_rad / ARCSECOND_RAD:.2f} arcsec'
        raise CatalogError(
            f'{path}: its stars are {size} off those of the bundled catalog: {cause}'
        )
    return len(mine)


def _alike(
    direction: Floats, bright: Floats, magnitude: Floats, bundled: sky_catalog.StarCatalog
) -> tuple[Indices, Indices]:
    """Rows (k,) of stars near those of the bundled catalog and as bright, and rows of those."""
    apart, row = cKDTree(bright).query(direction)
    fainter = np.abs(magnitude - bundled.magnitude[row])
    mine = np.flatnonzero((apart < _NEAR_RAD) & (fainter < _ALIKE_MAG))
    return mine, row[mine]


def _epoch_and_turn(off: Floats, direction: Floats, motion: Floats) -> tuple[float, float]:
    """
    Error of the epoch, years, and rotation, rad, that offsets (n, 3) of stars show; else zeros.

    A robust fit of both, which at five sigma or less are zero.
    """
    A = np.stack([motion, *np.cross(np.eye(3)[:, None], direction)], axis=-1).reshape(-1, 4)
    scale = np.linalg.norm(A, axis=0) + 1e-30
    A, b, weight = A / scale, off.ravel(), np.ones(off.size)
    for _ in range(10):
        N = np.linalg.pinv(A.T @ (A * weight[:, None]), rcond=1e-9)
        x = N @ (A.T @ (weight * b))
        residual = b - A @ x
        # The factor exceeds 1.48: one of three axes, along the line of sight, shows no error.
        sigma = max(2.0 * median(np.abs(residual)), 1e-3 * ARCSECOND_RAD)
        weight = 1.0 / (1.0 + (residual / (3.0 * sigma)) ** 2) ** 2
    turn = np.linalg.norm((A[:, 1:] @ x[1:]).reshape(-1, 3), axis=1)
    chi2 = float(x[1:] @ np.linalg.pinv(N[1:, 1:], rcond=1e-9) @ x[1:])
    has_epoch, has_turn = (
        x[0] ** 2 > N[0, 0] * (_SIGMAS * sigma) ** 2,
        chi2 > (_SIGMAS * sigma) ** 2,
    )
    return has_epoch * float(x[0] / scale[0]), has_turn * median(turn)


def _covers(direction: Floats, bright: Floats) -> bool:
    """Return True if stars of the bundled catalog (n, 3) are in the sky of a table's stars."""
    tree = cKDTree(direction)
    nearest = tree.query(direction, k=[min(2, len(direction))])[0]
    apart, _ = tree.query(bright)
    return bool((apart < max(float(np.quantile(nearest, 0.9)), _NEAR_RAD)).any())


def _at(catalog: sky_catalog.StarCatalog, jyear: float) -> tuple[Floats, Floats]:
    """Directions (n, 3) of the stars of a catalog in a Julian year, and their motions in one."""
    ra_rate = catalog.pm_ra_cosdec_rad_per_year / np.cos(catalog.dec_rad)
    place = catalog.ra_rad, catalog.dec_rad, 1.0
    pv = erfa.s2pv(*place, ra_rate, catalog.pm_dec_rad_per_year, 0.0)
    return pv['p'] + (jyear - catalog.epoch_jyear) * pv['v'], pv['v']


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


class _Table(NamedTuple):
    """
    Stars (n,) of a table by the names of `StarCatalog`, its source, and the rows refused.

    ``epoch`` is that of most of its places, ``jyear`` that of most of ``stars``.
    """

    source: str
    stars: dict[str, NDArray[Any]]
    epoch: float
    jyear: float
    refused: dict[str, int]


def _read(path: Path) -> _Table:
    """The stars of a file."""
    source, number, table, refused = _rows(path)
    motion = np.stack([table['pm_ra'], table['pm_dec']], axis=-1) * _MAS_RAD
    has_motion = np.isfinite(motion).all(axis=1)
    motion[~has_motion] = 0.0
    epoch = np.where(np.isnan(table['epoch']), source.jyear, table['epoch'])
    years = sky_catalog.CATALOG_EPOCH_JYEAR - epoch
    ra, dec = np.radians(table['ra']), np.radians(table['dec'])
    unknown = np.where(epoch < _OLD_JYEAR, MotionSource.UNKNOWN_J2000, MotionSource.UNKNOWN)
    stars = {
        'id': number,
        'ra_rad': (ra + motion[:, 0] * years / np.maximum(np.cos(dec), 1e-9)) % (2 * np.pi),
        'dec_rad': dec + motion[:, 1] * years,
        'pm_ra_cosdec_rad_per_year': motion[:, 0],
        'pm_dec_rad_per_year': motion[:, 1],
        'parallax_rad': np.nan_to_num(table['parallax']).clip(0) * _MAS_RAD,
        'magnitude': source.v(table['magnitude'], table['colour']),
        'colour_bp_rp': np.where(source.motion == _GAIA, table['colour'], np.nan),
        'motion_source': np.where(has_motion, source.motion, unknown),
    }
    jyear = np.where(has_motion, sky_catalog.CATALOG_EPOCH_JYEAR, epoch)
    return _Table(source.title, stars, median(epoch), median(jyear), refused)


def _rows(path: Path) -> tuple[_Source, Indices, dict[str, Floats], dict[str, int]]:
    """The source, numbers (n,) and columns (n,) of the sound rows, and the rows refused."""
    table = _table(path)
    there = {name.lower(): name for name in table.colnames}
    source = max(_SOURCES, key=lambda row: _match(row, there))
    names = source.columns
    if lacking := [names[key] for key in _NEEDED if names.get(key, '') not in {'', *there}]:
        titles = '; '.join(row.title for row in _SOURCES)
        raise IngestError(f'{path}: no column {", ".join(lacking)}: give a table of {titles}')

    def column(key: str, unit: str = 'mag') -> Floats:
        name = there.get(names.get(key, ''), '')
        if not name:
            return np.full(len(table), np.nan)
        return _in_unit(_numbers(path, table, name, 'iuf'), table[name].unit, unit)

    values = {key: column(key, unit) for key, (unit, _, _) in _RANGES.items()}
    if 'blue' in names:
        values['colour'] = column('blue') - column('red')
    reasons: dict[str, Mask] = {}
    if 'number' in names:
        identifier = _masked.filled(_numbers(path, table, there[names['number']], 'iu'), 0)
        reasons['without a number'] = (identifier < 1) | (identifier > np.iinfo(np.int64).max)
    for key, (unit, low, high) in _RANGES.items():
        name, value = names.get(key, key), values[key]
        if key in _NEEDED:
            reasons[f'without {name}'] = np.isnan(value)
        reasons[f'{name} outside {low:g} to {high:g} {unit}'] = (value < low) | (value > high)
    kept, refused = np.ones(len(table), np.bool_), {}
    for reason, is_bad in reasons.items():
        refused[reason] = int((kept & is_bad).sum())
        kept &= ~is_bad
    rows = np.flatnonzero(kept)
    values = {key: value[rows] for key, value in values.items()}
    stars = identifier[rows] if 'number' in names else _numbers_of_places(values)
    first = np.unique(stars, return_index=True)[1]
    refused['with a number twice'] = len(rows) - len(first)
    refused = {reason: count for reason, count in refused.items() if count}
    if not len(rows):
        raise IngestError(f'{path}: no star in {len(table)} rows; {refusals(refused)}')
    return source, stars[first].astype(np.int64), {k: v[first] for k, v in values.items()}, refused


def _match(source: _Source, there: Mapping[str, str]) -> tuple[bool, int]:
    """Return whether a table has the columns that a source needs, and how many in all."""
    names = source.columns
    needed = all(names[key] in there for key in _NEEDED if key in names)
    return needed, sum(name in there for name in names.values())


def _numbers_of_places(values: Mapping[str, Floats]) -> Indices:
    """
    Negative numbers (n,) of stars without one: the digits of ra, and of dec + 90.

    They are those of one place in any table, and below those of Hipparcos.
    """
    ra, dec = (np.rint(values[key] * _PLACE_DIGITS).astype(np.int64) for key in ('ra', 'dec'))
    digits = 1000 * _PLACE_DIGITS
    return np.asarray(-((digits + ra) * digits + dec + 90 * _PLACE_DIGITS))


def refusals(refused: Mapping[str, int]) -> str:
    """Return the rows refused in words; empty if there are none."""
    counts = ', '.join(f'{count} {reason}' for reason, count in refused.items())
    return counts and f'rows refused: {counts}'


def _table(path: Path) -> Any:
    """A table of astropy."""
    with needing('mission', IngestError, path):
        from astropy.io import fits
        from astropy.table import Table
    try:
        with regular_file(path) as file:
            start = file.readline(2**20)
        columns = start.count(b',') if path.suffix == '.csv' else 0
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')  # VizieR spells units in its own way
            if columns > _MOST_COLUMNS:
                raise ValueError(f'more than {_MOST_COLUMNS} columns')
            if start.startswith(b'SIMPLE  ='):
                with fits.open(path) as hdus:
                    stars = index_stars(hdus)
                if stars:
                    return Table(stars)
            return Table.read(path)
    except OSError as error:
        raise IngestError(f'{path}: cannot be read: {error.strerror or error}') from error
    except MemoryError:
        raise
    except Exception as error:  # astropy raises whatever a damaged file brings about
        words = ' '.join(str(error).split())[:120]
        raise IngestError(f'{path}: no VOTable, FITS or CSV table: {words}') from error


def index_stars(hdus: Any) -> dict[str, NDArray[Any]]:
    """
    Columns of the stars of an index file of astrometry.net by names in lower case.

    Empty for other FITS files.  Places are 32-bit steps in a cube about the unit sphere.
    """
    tables = {
        hdu.columns.names[0]: hdu.data for hdu in hdus[1:] if len(getattr(hdu, 'columns', ()))
    }
    if 'kdtree_data_stars' not in tables:
        return {}
    order = '<' if str(hdus[0].header['ENDIAN']).startswith('04') else '>'
    box, steps = (
        np.frombuffer(np.asarray(tables[name]).tobytes(), order + kind).astype(np.float64)
        for name, kind in (('kdtree_range_stars', 'f8'), ('kdtree_data_stars', 'u4'))
    )
    ra_rad, dec_rad = erfa.c2s(box[:3] + steps.reshape(-1, 3) / box[6])
    stars = {'ra': np.degrees(ra_rad) % 360.0, 'dec': np.degrees(dec_rad)}
    for data in (data for name, data in tables.items() if not name.startswith('kdtree')):
        if len(data) == len(ra_rad):
            stars |= {name.lower(): data[name] for name in data.names}
    return stars


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
