# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Planets in a field, and a detector without defects."""

from __future__ import annotations

import dataclasses

import numpy as np

from starcal_ground.simulation.scenario import Detector, Scenario, Scene

QUIET = Detector(cosmic_rays=0.0, hot_fraction=0.0)
# Venus, Jupiter, Mars, Saturn, Mercury, and Uranus, which resembles a star.
PLANET_MAGNITUDES = np.array([-4.2, -2.3, -1.0, 0.4, 1.5, 5.8])


def with_planets(scenario: Scenario, shown: Scene, seed: int) -> Scene:
    """Scene with six planets: four at 3 to 25 px from a bright star, two at random pixels."""
    rng = np.random.default_rng(seed)
    camera = scenario.truth.camera
    size = np.array([camera.width, camera.height])
    rim_px = 30.0
    inside = ((shown.pixel_px > rim_px) & (shown.pixel_px < size - rim_px)).all(axis=1)
    bright = np.flatnonzero(inside)[np.argsort(shown.magnitude[inside])[:40]]
    angle = rng.uniform(0, 2 * np.pi, 4)
    away_px = np.array([25.0, 12.0, 6.0, 3.0])[:, None] * np.stack(
        [np.cos(angle), np.sin(angle)], axis=-1
    )
    beside = shown.pixel_px[rng.choice(bright, 4, replace=False)] + away_px
    anywhere = rng.uniform(rim_px, size - rim_px, (2, 2))
    light = scenario.detector.zero_point_electrons * 10 ** (-0.4 * PLANET_MAGNITUDES)
    return dataclasses.replace(
        shown,
        pixel_px=np.concatenate([shown.pixel_px, beside, anywhere]),
        flux_electrons=np.concatenate([shown.flux_electrons, light]),
    )
