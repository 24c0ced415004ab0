# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Budget of the sigma of lines of sight by cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

TOTAL = 'total'
_MATTERS = 0.05  # of the variance


@dataclass(frozen=True)
class SigmaPart:
    """
    Part of the 1-sigma of lines of sight that is due to one cause, RMS over the detector.

    Its square is the variance that would be gone if the cause were known exactly, or absent.
    Parts of correlated causes overlap: their squares need not sum to the total's.

    Attributes
    ----------
    cause : str
        `TOTAL` for all causes together.
    map_arcsec : float
        Of the camera alone, the common rotation removed.
    pointing_arcsec : float
        In the star tracker frame.
    assumption : str
        The value assumed or estimated for the cause.
    """

    cause: str
    map_arcsec: float
    pointing_arcsec: float
    assumption: str


def parts_that_matter(budget: Sequence[SigmaPart]) -> list[SigmaPart]:
    """Return the total, and the causes of over 5 % of a variance, the largest first."""
    if not budget:
        return []
    total = next(part for part in budget if part.cause == TOTAL)

    def share(part: SigmaPart) -> float:
        of_map = part.map_arcsec**2 / max(total.map_arcsec**2, 1e-300)
        return max(of_map, part.pointing_arcsec**2 / max(total.pointing_arcsec**2, 1e-300))

    causes = [part for part in budget if part.cause != TOTAL and share(part) > _MATTERS]
    return [total, *sorted(causes, key=share, reverse=True)]
