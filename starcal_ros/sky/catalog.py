# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Star catalog: positions at one epoch, proper motions and magnitudes; reading and cone search.

The bundled file covers the whole sky to V = 9, merged from Gaia DR3, Hipparcos-2 and Tycho-2 by
``tools/build_catalog.py``; ``data/ATTRIBUTION.md`` states its sources, licences and accuracy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property, lru_cache, partial
import hashlib
import itertools
import math
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from starcal_ros.arrays import AnyArray, Codes, Floats, Indices, Mask, Rows, rows_of
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError, errors_as
from starcal_ros.untrusted import read_archive

CATALOG_PATH = Path(__file__).parent / 'data' / 'star_catalog.npz'
BUNDLED_MAGNITUDE = 9.0  # V, to which it has all stars
CATALOG_FORMAT = 1
CATALOG_EPOCH_JYEAR = 2016.0  # J2016.0 TCB, Gaia Collaboration 2023, A&A 674, A1

# Columns of the file, in digest order.  Integers, so that equal catalogs have equal bytes.
COLUMN_TYPES = {
    'id': '<i8',  # Gaia DR3 source id, or minus the Hipparcos number
    'ra': '<u4',  # ANGLE_UNIT_RAD
    'dec': '<i4',  # ANGLE_UNIT_RAD
    'pm_ra_cosdec': '<i4',  # MOTION_UNIT_RAD per Julian year
    'pm_dec': '<i4',  # MOTION_UNIT_RAD per Julian year
    'parallax': '<u2',  # PARALLAX_UNIT_RAD; 0 unknown
    'magnitude': '<i2',  # MAGNITUDE_UNIT, V
    'colour_bp_rp': '<i2',  # MAGNITUDE_UNIT; NO_COLOUR unknown
    'motion_source': '|u1',  # MotionSource
    'close_pair': '|u1',  # 0 or 1
}
ANGLE_UNIT_RAD = 2 * math.pi / 2**32  # 0.3 mas
MOTION_UNIT_RAD = 1e-5 * ARCSECOND_RAD  # 0.01 mas
PARALLAX_UNIT_RAD = 2e-5 * ARCSECOND_RAD  # 0.02 mas
MAGNITUDE_UNIT = 1e-3
_ROUNDING_MAG = 1e-9  # a star at the limit is within it, however its magnitude is rounded
NO_COLOUR = -32768

# Largest separation of a close pair.
CLOSE_PAIR_RAD = 20.0 * ARCSECOND_RAD

DEEPER_MAG = 2.0
"""Stars so far below the magnitude limit are kept for blends: they have 16 % of its light."""

# Margin of a cone: 35 years of motion of the fastest star (8.7 arcsec a year) and 20 arcsec of
# aberration.
CONE_MARGIN_RAD = 330 * ARCSECOND_RAD


# 1-sigma of the proper motion of a star of V = 9 per axis, and its factor for each magnitude
# fainter: 68 % of the stars of the bundled catalog with V = 6 to 9 move by less, to 20 %.
_USUAL_MOTION_MAS = 16.0
_USUAL_MOTION_FACTOR = 0.85


class MotionSource(IntEnum):
    """Source of a star's proper motion, which determines the accuracy of its position."""

    UNKNOWN = 0  # Gaia position without a motion
    DIFFERENCE = 1  # Gaia position at J2016 minus Tycho-2 position at J2000, over 16 years
    HIPPARCOS = 2  # Hipparcos-2 solution
    GAIA = 3  # Gaia solution
    TYCHO = 4  # Tycho-2 solution
    UNKNOWN_J2000 = 5  # position of about J2000, such as in 2MASS, without a motion


# By `MotionSource`, per axis: 1-sigma of a place, mas; its epoch, a Julian year; 1-sigma of the
# motion, mas a year, NaN for that of a usual star.  Lindegren et al. 2021, van Leeuwen 2007, Hog
# et al. 2000, Skrutskie et al. 2006; DIFFERENCE as in ``data/ATTRIBUTION.md``.
_ACCURACY = np.array([
    (0.1, 2016.0, np.nan),
    (0.1, 2016.0, 2.2),
    (1.0, 1991.25, 1.0),
    (0.1, 2016.0, 0.1),
    (60.0, 1991.5, 2.5),
    (80.0, 2000.0, np.nan),
])  # fmt: skip


# Balanced, a tree takes three times as long to build, and answers no sooner.
direction_tree = partial(cKDTree, balanced_tree=False, compact_nodes=False)


@dataclass(frozen=True, eq=False)
class StarCatalog:
    """
    Stars at the catalog epoch, one row each, all columns (n,).

    Attributes
    ----------
    id : int64
        Gaia DR3 source id, or minus the Hipparcos number of a star without one.
    ra_rad, dec_rad : float64
        Barycentric ICRS position at ``epoch_jyear``.
    pm_ra_cosdec_rad_per_year, pm_dec_rad_per_year : float64
        Proper motion per Julian year; 0 where unknown.
    parallax_rad : float64
        0 where unknown.
    magnitude : float64
        Johnson V.
    colour_bp_rp : float64
        Gaia BP - RP in magnitudes; NaN where unknown.
    motion_source : uint8
        `MotionSource`.
    close_pair : bool
        Another star within 20 arcsec and 5 magnitudes: the position may be that of the pair, and
        most cameras do not resolve it.  Neighbours down to V = 10 count, below the limit of the
        catalog.
    epoch_jyear : float
    digest : str
        SHA-256 of the columns of the file, also in selections: identifies the source catalog.
    deeper : StarCatalog, optional
        Fainter stars of the file, to `DEEPER_MAG` below the magnitude limit: too faint to be
        measured, but their light moves the centroids of others.
    """

    id: Indices
    ra_rad: Floats
    dec_rad: Floats
    pm_ra_cosdec_rad_per_year: Floats
    pm_dec_rad_per_year: Floats
    parallax_rad: Floats
    magnitude: Floats
    colour_bp_rp: Floats
    motion_source: Codes
    close_pair: Mask
    epoch_jyear: float
    digest: str
    deeper: StarCatalog | None = None

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.id)

    @cached_property
    def direction_icrs(self) -> Floats:
        """Unit vectors (n, 3) of the positions at the catalog epoch."""
        cos_dec = np.cos(self.dec_rad)
        return np.stack(
            [cos_dec * np.cos(self.ra_rad), cos_dec * np.sin(self.ra_rad), np.sin(self.dec_rad)],
            axis=-1,
        )

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the directions."""
        return direction_tree(self.direction_icrs)

    def near(self, direction_icrs: Floats, radius_rad: float) -> Rows:
        """Rows (m,), ascending, of the stars near any of some directions (n, 3), as `cone`."""
        rows = self.tree.query_ball_point(direction_icrs, _chord_with_margin(radius_rad))
        return np.unique(np.fromiter(itertools.chain.from_iterable(rows), np.intp))

    def select(self, rows: Mask | Indices | Rows | slice) -> StarCatalog:
        """Return the stars selected by a mask (n,), row numbers or a slice, in that order."""
        return rows_of(self, rows)

    def place_sigma_rad(self, rows: Indices | Rows, jyear: float) -> Floats:
        """
        1-sigma (m,) per axis of the places of stars in a Julian year, by their `MotionSource`.

        Without a proper motion it grows with the years by that of a usual star.
        """
        place_mas, epoch, motion_mas = _ACCURACY[self.motion_source[rows]].T
        usual_mas = _USUAL_MOTION_MAS * _USUAL_MOTION_FACTOR ** (self.magnitude[rows] - 9.0)
        motion_mas = np.where(np.isnan(motion_mas), usual_mas, motion_mas)
        sigma_mas = np.hypot(place_mas, motion_mas * (jyear - epoch))
        return np.asarray(1e-3 * ARCSECOND_RAD * sigma_mas)

    @cached_property
    def _order(self) -> Indices:
        """Rows (n,) in the order of the identifiers."""
        return np.argsort(self.id)

    def rows_of(self, identifiers: Indices) -> tuple[Indices, Mask]:
        """Rows (n,) of stars by identifier, and a mask (n,) of those in the catalog."""
        if len(self) == 0:
            return np.zeros(len(identifiers), np.int64), np.zeros(len(identifiers), np.bool_)
        place = np.searchsorted(self.id, identifiers, sorter=self._order)
        rows = self._order[np.minimum(place, len(self) - 1)]
        return rows, np.asarray(self.id[rows] == identifiers)

    def colours_bp_rp(self, identifiers: Indices) -> Floats:
        """BP - RP (n,) of stars by identifier; NaN for an unknown star or colour."""
        rows, known = self.rows_of(identifiers)
        colours = np.full(len(identifiers), np.nan)
        colours[known] = self.colour_bp_rp[rows[known]]
        return colours


def column_digest(columns: Mapping[str, AnyArray]) -> str:
    """SHA-256 (hexadecimal) of the integer columns with their names, types and epoch."""
    digest = hashlib.sha256(f'starcal {CATALOG_FORMAT} J{CATALOG_EPOCH_JYEAR}'.encode())
    for name, kind in COLUMN_TYPES.items():
        digest.update(f'{name} {kind} '.encode())
        digest.update(np.ascontiguousarray(columns[name], dtype=kind).tobytes())
    return digest.hexdigest()


def _read_columns(path: Path) -> tuple[dict[str, AnyArray], str]:
    with errors_as(CatalogError, f'{path}: star catalog'):
        entries = read_archive(path, ('format', 'digest', *COLUMN_TYPES))
    missing = [name for name in ('format', 'digest', *COLUMN_TYPES) if name not in entries]
    if missing:
        raise CatalogError(f'{path}: not a star catalog (missing: {", ".join(missing)})')
    if str(entries['format']) != str(CATALOG_FORMAT):
        raise CatalogError(
            f'{path}: star catalog has format {entries["format"]}, '
            f'this version reads {CATALOG_FORMAT}'
        )
    columns = {name: entries[name] for name in COLUMN_TYPES}
    digest = str(entries['digest'])
    for name, kind in COLUMN_TYPES.items():
        if columns[name].dtype != np.dtype(kind) or columns[name].shape != columns['id'].shape:
            raise CatalogError(
                f'{path}: star catalog is damaged (column {name} is {columns[name].dtype} '
                f'{columns[name].shape}, expected {np.dtype(kind)} {columns["id"].shape})'
            )
    if column_digest(columns) != digest:
        raise CatalogError(f'{path}: star catalog is damaged (digest mismatch)')
    if columns['motion_source'].max(initial=0) >= len(MotionSource):
        raise CatalogError(f'{path}: star catalog has a motion_source of a later version')
    return columns, digest


def load_catalog(path: Path | None = None, magnitude_limit: float | None = None) -> StarCatalog:
    """
    Read a star catalog, by default the bundled one, sorted by magnitude.

    Raises CatalogError if the file is missing, not a star catalog, of another format, or damaged.

    Parameters
    ----------
    path : Path, optional
        File written by ``tools/build_catalog.py``.
    magnitude_limit : float, optional
        Omit stars fainter than this V.
    """
    return _bundled(magnitude_limit) if path is None else _read(Path(path), magnitude_limit)


@lru_cache(maxsize=4)
def _bundled(magnitude_limit: float | None) -> StarCatalog:
    """Return one object for each limit: indices of patterns are kept by catalog."""
    return _read(CATALOG_PATH, magnitude_limit)


def _read(path: Path, magnitude_limit: float | None) -> StarCatalog:
    columns, digest = _read_columns(path)
    if magnitude_limit is None:
        return _scaled(columns, digest)
    limits = np.array([magnitude_limit, magnitude_limit + DEEPER_MAG])
    limits = np.floor((limits + _ROUNDING_MAG) / MAGNITUDE_UNIT)
    count, most = np.searchsorted(columns['magnitude'], limits, side='right').tolist()
    catalog, deeper = (
        _scaled({name: column[rows] for name, column in columns.items()}, digest)
        for rows in (slice(count), slice(count, most))
    )
    return replace(catalog, deeper=deeper) if len(deeper) else catalog


def _scaled(cut: Mapping[str, AnyArray], digest: str) -> StarCatalog:
    """Catalog of integer columns."""

    def scaled(name: str, unit: float) -> Floats:
        return np.asarray(cut[name], np.float64) * unit

    return StarCatalog(
        id=cut['id'].astype(np.int64),
        ra_rad=scaled('ra', ANGLE_UNIT_RAD),
        dec_rad=scaled('dec', ANGLE_UNIT_RAD),
        pm_ra_cosdec_rad_per_year=scaled('pm_ra_cosdec', MOTION_UNIT_RAD),
        pm_dec_rad_per_year=scaled('pm_dec', MOTION_UNIT_RAD),
        parallax_rad=scaled('parallax', PARALLAX_UNIT_RAD),
        magnitude=scaled('magnitude', MAGNITUDE_UNIT),
        colour_bp_rp=np.where(
            cut['colour_bp_rp'] == NO_COLOUR, np.nan, scaled('colour_bp_rp', MAGNITUDE_UNIT)
        ),
        motion_source=cut['motion_source'].astype(np.uint8),
        close_pair=cut['close_pair'].astype(np.bool_),
        epoch_jyear=CATALOG_EPOCH_JYEAR,
        digest=digest,
    )


def cone(
    catalog: StarCatalog,
    direction_icrs: Floats,
    radius_rad: float,
    magnitude_limit: float | None = None,
) -> Rows:
    """
    Rows (m,), in ascending order, of all stars that can appear within a radius of a direction.

    Catalog positions are compared with the radius plus `CONE_MARGIN_RAD`, so that neither proper
    motion between 1981 and 2051 nor aberration loses a star; some rows lie outside the radius.

    Parameters
    ----------
    catalog : StarCatalog
    direction_icrs : (3,)
        Axis of the cone, of any non-zero length.
    radius_rad : float
        Half of the opening angle, 0 to pi.
    magnitude_limit : float, optional
        Omit stars fainter than this V.
    """
    axis, chord = direction_icrs / np.linalg.norm(direction_icrs), _chord_with_margin(radius_rad)
    rows = np.sort(np.array(catalog.tree.query_ball_point(axis, chord), np.intp))
    if magnitude_limit is not None:
        rows = rows[catalog.magnitude[rows] <= magnitude_limit + _ROUNDING_MAG]
    return rows


def _chord_with_margin(radius_rad: float) -> float:
    return 2.0 * math.sin(0.5 * min(radius_rad + CONE_MARGIN_RAD, math.pi))


def sky_circle(direction_icrs: Floats, radius_rad: float) -> str:
    """Centre and radius of the sky within a radius of directions (n, 3), for a query."""
    axis = direction_icrs.mean(axis=0)
    axis /= np.linalg.norm(axis)
    apart_rad = np.arccos(np.clip(direction_icrs @ axis, -1.0, 1.0)).max()
    ra_deg, dec_deg = (
        math.degrees(math.atan2(axis[1], axis[0])) % 360.0,
        math.degrees(math.asin(axis[2])),
    )
    radius_deg = math.degrees(apart_rad + radius_rad + CONE_MARGIN_RAD)
    return f'RA {ra_deg:.2f}, Dec {dec_deg:+.2f}, radius {radius_deg:.2f} deg'
