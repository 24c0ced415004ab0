# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A sky with stars below the bundled catalog in one region, and the table of a star archive."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.sky import catalog

_MOTION_MAS = 8.0  # a year, 1-sigma of each axis
_V_LESS_G = 0.15  # for a star without a colour, as in `deep_catalog.johnson_v`


def log10_density(magnitude: NDArray[np.floating]) -> Floats:
    """
    Mean number of stars to a V magnitude per square degree, to 10 %.

    Allen 2000, Astrophysical Quantities, section 19.2.
    """
    fainter = magnitude - 9.0
    return 0.48 + 0.45 * fainter - 0.007 * fainter**2


def deep_sky(
    axis: Floats, radius_rad: float, faintest: float, rng: np.random.Generator, spread: float = 0.3
) -> catalog.StarCatalog:
    """
    The bundled catalog, and stars below it about an axis (3,), sorted by magnitude.

    ``spread`` is the 1-sigma of the logarithm of the density: the densest tenth of the sky has
    three times the mean, the emptiest a third.
    """
    depth = np.linspace(catalog.BUNDLED_MAGNITUDE, faintest, 500)
    area_deg2 = 2 * math.pi * (1.0 - math.cos(radius_rad)) * math.degrees(1.0) ** 2
    number = area_deg2 * 10 ** log10_density(depth) * math.exp(spread * rng.normal())
    count = rng.poisson(number[-1] - number[0])
    magnitude = np.interp(rng.uniform(number[0], number[-1], count), number, depth)
    direction = disc(axis, count, radius_rad, rng)
    motion = rng.normal(0.0, 1e-3 * _MOTION_MAS * ARCSECOND_RAD, (count, 2))
    bundled, ra_rad = catalog.load_catalog(), np.arctan2(direction[:, 1], direction[:, 0])
    drawn = {
        'id': np.arange(count) + 1,
        'ra_rad': ra_rad % (2 * math.pi),
        'dec_rad': np.arcsin(direction[:, 2]),
        'pm_ra_cosdec_rad_per_year': motion[:, 0],
        'pm_dec_rad_per_year': motion[:, 1],
        'parallax_rad': np.zeros(count),
        'magnitude': magnitude,
        'colour_bp_rp': rng.normal(1.0, 0.3, count),
        'motion_source': np.full(count, catalog.MotionSource.GAIA, np.uint8),
        'close_pair': np.zeros(count, np.bool_),
    }
    columns = {name: np.concatenate([getattr(bundled, name), drawn[name]]) for name in drawn}
    sky = dataclasses.replace(bundled, **columns)
    return sky.select(np.argsort(sky.magnitude, kind='stable'))


def disc(axis: Floats, count: int, radius_rad: float, rng: np.random.Generator) -> Floats:
    """Directions (count, 3), even over the disc about an axis."""
    z = rng.uniform(math.cos(radius_rad), 1.0, count)
    angle, r = rng.uniform(0.0, 2 * math.pi, count), np.sqrt(1.0 - z * z)
    local = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1)
    # The smallest rotation; SciPy 1.11 warns of a single pair of vectors in `align_vectors`.
    about = np.cross([0.0, 0.0, 1.0], axis)
    sine = float(np.linalg.norm(about))
    turn = Rotation.from_rotvec(about * (math.atan2(sine, axis[2]) / max(sine, 1e-300)))
    return np.asarray(turn.apply(local))


def archive_table(sky: catalog.StarCatalog, axis: Floats, radius_rad: float) -> str:
    """CSV with the stars about an axis (3,) that have a number, as the Gaia archive writes it."""
    stars = sky.select(catalog.cone(sky, axis, radius_rad))
    stars = stars.select(stars.id > 0)
    mas_rad = 1e-3 * ARCSECOND_RAD
    columns = (
        np.degrees(stars.ra_rad),
        np.degrees(stars.dec_rad),
        stars.pm_ra_cosdec_rad_per_year / mas_rad,
        stars.pm_dec_rad_per_year / mas_rad,
        stars.parallax_rad / mas_rad,
        stars.magnitude - _V_LESS_G,
    )
    lines = ['source_id,ra,dec,pmra,pmdec,parallax,phot_g_mean_mag,ref_epoch']
    for number, ra, dec, *others in zip(stars.id, *columns, strict=True):
        text = ','.join(f'{value:.3f}' for value in others)
        lines.append(f'{number},{ra:.9f},{dec:.9f},{text},{stars.epoch_jyear}')
    return '\n'.join(lines) + '\n'
