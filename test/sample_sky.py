"""A sky of random stars, and a detector without flaws."""

from __future__ import annotations

import numpy as np

from starcal_ros.catalog import StarCatalog
from starcal_ros.synthetic import (
    Detector,
)

QUIET = Detector(cosmic_rays=0.0, hot_fraction=0.0)


def random_catalog(seed: int, count: int = 40_000, faintest: float = 9.0) -> StarCatalog:
    """Stars all over the sky, as many more of each magnitude as there really are."""
    rng = np.random.default_rng(seed)
    zero = np.zeros(count)
    return StarCatalog(
        id=np.arange(count, dtype=np.int64) + 1,
        ra_rad=rng.uniform(0, 2 * np.pi, count),
        dec_rad=np.arcsin(rng.uniform(-1, 1, count)),
        pm_ra_cosdec_rad_per_year=zero,
        pm_dec_rad_per_year=zero,
        parallax_rad=zero,
        magnitude=np.sort(faintest + np.log10(rng.uniform(size=count)) / 0.5),
        colour_bp_rp=zero,
        motion_source=zero.astype(np.uint8),
        close_pair=zero.astype(np.bool_),
        epoch_jyear=2016.0,
        digest='random',
    )


CATALOG = random_catalog(1)
