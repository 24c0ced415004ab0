"""`starcal calibrate` on all 359 images of the paper's night, as `bench calibrate` on 60."""

from __future__ import annotations

from bench.calibrate import compare
from bench.table import Table

MOST_RATIO = 2.0


def run(quick: bool) -> list[Table]:
    """Render the night, which takes minutes, and compare with a bare read."""
    return compare('paper', 12 if quick else 359, None, MOST_RATIO, 1 if quick else 3)
