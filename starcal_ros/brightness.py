"""
Whether the stars of an image are as bright as the catalog says.

Where stars are many, or a part of a field agrees with another field, places can meet by chance.
Brightnesses then do not: they are a second witness that the search of places has not heard.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from starcal_ros.errors import ImageRefused
from starcal_ros.robust import MAD_TO_SIGMA, median

Floats = NDArray[np.float64]

_FEWEST = 4  # stars whose scatter means anything
# A camera's band is not V: stars of a real sky scatter by 0.15 to 0.3 mag and none is off by more
# than 1.5.  Stars met by chance scatter by 1.0 to 1.7 mag.
_MOST_SCATTER_MAG = 0.75
_MOST_OFF_MAG = 1.5


def refuse_unlike(
    magnitude: NDArray[np.floating], flux_dn: Floats, refusal: NDArray[np.str_]
) -> NDArray[np.str_]:
    """
    Refusals (n,) with ``ambiguous`` for stars that are not as bright as the others make them.

    ``magnitude``, ``flux_dn`` (n,); only stars without a refusal are judged.

    Raises
    ------
    ImageRefused
        ``no_match`` where most of the stars are not.
    """
    good = np.flatnonzero(refusal == '')
    if len(good) < _FEWEST:
        return refusal
    zero_point = magnitude[good] + 2.5 * np.log10(flux_dn[good])
    off_mag = np.abs(zero_point - median(zero_point))
    scatter_mag = MAD_TO_SIGMA * median(off_mag)
    if scatter_mag > _MOST_SCATTER_MAG:
        raise ImageRefused(
            'no_match',
            f'{len(good)} stars stand where catalog stars should,'
            f' but their brightnesses scatter by {scatter_mag:.1f} mag',
        )
    changed = refusal.copy()
    changed[good[off_mag > max(_MOST_OFF_MAG, 5.0 * scatter_mag)]] = 'ambiguous'
    return changed
