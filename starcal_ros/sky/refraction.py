# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Refraction by the direction of the zenith, where site or clock are not known.

A star at the zenith distance z is raised by ``A tan z + B tan^3 z`` (Explanatory Supplement to the
Astronomical Almanac, 3rd ed., section 7.2.2.5.2).  As vectors, with the zenith Z and the direction
e: ``tan z`` towards the zenith is ``Z / (e . Z) - e``.
"""

from __future__ import annotations

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.constants import ARCSECOND_RAD

USUAL_ARCSEC = (52.0, 7.0)
"""A of sites between the sea and 2000 m, 0.55 micrometres: mean and 1-sigma."""
_CUBIC = -0.00115  # B / A, from the scale height of the air and the Earth's radius
SIDEREAL_RAD_S = 7.292115e-5  # GRS 1980, rotation of the Earth
LEAST_COSINE = 0.17  # 80 degrees of zenith distance, where the formula is off by 1 arcsec


def refracted(direction_icrf: Floats, zenith_icrf: Floats, refraction_arcsec: float) -> Floats:
    """
    Directions (n, 3) of stars as seen through the air.

    ``refraction_arcsec`` is A; the zenith (3,) has the axes of the directions.
    """
    cosine = np.maximum(direction_icrf @ zenith_icrf, LEAST_COSINE)[:, None]
    towards = zenith_icrf / cosine - direction_icrf
    tangent2 = 1.0 / cosine**2 - 1.0
    seen = direction_icrf + refraction_arcsec * ARCSECOND_RAD * (1 + _CUBIC * tangent2) * towards
    return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))


def zenith_of(latitude_rad: float, right_ascension_rad: Floats) -> Floats:
    """Zenith (n, 3) of a site at n times, ICRF; precession, 0.3 degrees since 2000, left out."""
    along = np.cos(latitude_rad)
    return np.stack(
        [
            along * np.cos(right_ascension_rad),
            along * np.sin(right_ascension_rad),
            np.full(np.shape(right_ascension_rad), np.sin(latitude_rad)),
        ],
        axis=-1,
    )
