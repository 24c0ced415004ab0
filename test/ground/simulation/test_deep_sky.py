# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The drawn sky against the density of stars, and its table read as a user would."""

from __future__ import annotations

import math

import erfa
import numpy as np
import pytest

from starcal_ground.mission.ingest.deep_catalog import write_deep_catalog
from starcal_ground.simulation.deep_sky import deep_sky, disc, log10_density
from starcal_ground.simulation.scenario import scenario
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.sky.catalog import BUNDLED_MAGNITUDE, cone, load_catalog

AXIS = erfa.s2c(1.0, -0.9)


def test_the_sky_has_the_mean_density_and_the_bundled_stars_and_a_disc_is_even() -> None:
    sky = deep_sky(AXIS, math.radians(3.0), 13.0, np.random.default_rng(2), spread=0.0)
    assert (np.diff(sky.magnitude) >= 0).all()
    assert len(sky.select(sky.magnitude < BUNDLED_MAGNITUDE)) == len(load_catalog())
    faint = sky.select(sky.magnitude >= BUNDLED_MAGNITUDE)
    expected = 28.26 * np.diff(10 ** log10_density(np.array([BUNDLED_MAGNITUDE, 13.0])))
    assert len(faint) == pytest.approx(expected[0], rel=0.05)  # 5 sigma of 2,700 stars
    assert len(cone(sky, AXIS, math.radians(3.0))) >= len(faint)
    # A disc is even.
    direction = disc(AXIS, 10_000, 0.5, np.random.default_rng(1))
    inside = np.count_nonzero(direction @ AXIS > math.cos(0.25)) / 10_000
    assert inside == pytest.approx((1 - math.cos(0.25)) / (1 - math.cos(0.5)), abs=0.02)


@pytest.mark.slow
def test_the_table_of_a_scenario_gives_its_sky(tmp_path) -> None:
    narrow = scenario('narrow')
    assert narrow.sky is not None and narrow.table is not None
    (tmp_path / 'gaia.csv').write_text(narrow.table)
    made = write_deep_catalog(tmp_path / 'gaia.csv', tmp_path / 'gaia.npz')
    assert made.source == 'Gaia, archive' and made.checked > 50 and made.unmoved == 0
    read = load_catalog(tmp_path / 'gaia.npz')
    _, ours, theirs = np.intersect1d(narrow.sky.id, read.id, return_indices=True)
    assert len(ours) == len(narrow.sky) == len(read)
    sky, read = narrow.sky.select(ours), read.select(theirs)
    off_rad = np.linalg.norm(sky.direction_icrs - read.direction_icrs, axis=1)
    assert off_rad.max() < 1e-3 * ARCSECOND_RAD
    assert np.abs(sky.magnitude - read.magnitude).max() < 2e-3
