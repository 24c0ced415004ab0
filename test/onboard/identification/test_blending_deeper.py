# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Real stars below the magnitude limit: what they pull is taken off, though none is measured."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from starcal_ground.simulation.rendering import render
from starcal_ground.simulation.scenario import scenario, scene
from starcal_ros.identification.star_finder import (
    Exposure,
    IdentificationOptions,
    observe_stars,
    StarSearch,
)
from starcal_ros.identification.tracking import start_tracking, track_stars
from starcal_ros.sky.catalog import DEEPER_MAG, load_catalog

# The sky of the bundled catalog to V = 9, in pixels of 1.7 arcmin.
SCENARIO = scenario('tiny', seed=8)
LIMIT = 7.0
OPTIONS = IdentificationOptions(magnitude_limit=LIMIT)


def excess_sigma2(deeper: bool) -> float:
    """Mean square of the errors over their sigmas, of six images of which five are tracked."""
    catalog = load_catalog(None, LIMIT)
    if not deeper:
        catalog = dataclasses.replace(catalog, deeper=None)
    search, track, squares = StarSearch(catalog, identification=OPTIONS), None, []
    for index in range(6):
        shown = scene(SCENARIO, index)
        image = Exposure(render(SCENARIO, shown, index), shown.icrf_from_star_tracker_xyzw, 0.5)
        if track is None:
            found, instrument = observe_stars(image, SCENARIO.prior, search)
            track = start_tracking(SCENARIO.prior, found, instrument)
            assert track is not None
        else:
            found, track = track_stars(image, track, search)
        row = {star: k for k, star in enumerate(shown.catalog_id.tolist())}
        true_px = shown.pixel_px[[row[star] for star in found.catalog_id.tolist()]]
        sigma_px = np.sqrt(found.covariance_px2[:, [0, 2]])
        assert np.isin(found.refused_catalog_id, catalog.id).all()
        squares.append(((found.measured_px - true_px) / sigma_px) ** 2)
    return float(np.mean(np.concatenate(squares)))


def test_the_pull_of_deeper_stars_is_taken_off() -> None:
    assert excess_sigma2(deeper=False) > 1.2
    assert excess_sigma2(deeper=True) < 1.1


@pytest.mark.parametrize('limit', [5.0, 7.0, 9.0])
def test_deeper_stars_follow_the_limit(limit: float) -> None:
    catalog, deeper = load_catalog(None, limit), load_catalog(None, limit).deeper
    assert catalog.magnitude[-1] <= limit
    if limit == 9.0:
        assert deeper is None
        return
    assert deeper is not None
    assert limit < deeper.magnitude[0] and deeper.magnitude[-1] <= limit + DEEPER_MAG
    whole = load_catalog(None, limit + DEEPER_MAG)
    assert np.array_equal(np.concatenate([catalog.id, deeper.id]), whole.id)
