# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Campaigns with known truth for all tools, and their results."""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses
from dataclasses import dataclass
import functools
import math
from typing import NamedTuple

import numpy as np

from bench.competitors import Case, make_case
from bench.frames import Frame, load_set_up, observed, render_frame
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.scenario import Scenario
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import GRID
from starcal_ros.camera import pixel_grid
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import Ensemble
from studies import rendered_worlds
from studies.worlds import simulate, World, WORLDS

# In sound campaigns the principal point is 2 px off the prior, as after any ground calibration.
_RENDERED = {
    'images, sound': rendered_worlds.world('principal point', 2.0),
    'images, ripple of 0.3 px': rendered_worlds.world('ripple', 0.3),
}
_SIMULATED = {
    'stars, sound': World(principal_point_px=(1.2, -1.6)),
    'stars, ripple of 0.05 px': WORLDS['rip7_050'],
}


@dataclass(frozen=True)
class Campaign:
    """
    Images, if it is rendered, and identified stars: measured by starcal, or simulated.

    ``true_directions`` (n, 3): lines of sight of ``pixels`` (n, 2), a grid over the detector.
    """

    kind: str
    scenario: Scenario
    setup: Setup
    ensemble: Ensemble
    pixels: Floats
    true_directions: Floats
    frames: tuple[Frame, ...] = ()

    @functools.cached_property
    def case(self) -> Case:
        """All stars, and start, of the peers' estimators; all camera parameters are free."""
        return make_case(self.ensemble, self.scenario.prior, np.arange(10))


class Result(NamedTuple):
    """Camera by one variant of a tool: lines of sight (n, 3) of the pixels of a campaign."""

    variant: str
    directions: Floats
    frames: int
    stars: int
    processor_s: float
    sigma_arcsec: float = math.nan  # rms over the pixels, the common rotation removed


def all_campaigns(seeds: int, images: int) -> Iterator[Campaign]:
    """All campaigns, one kind after the other."""
    pixels = pixel_grid(synthetic.scenario('small').prior.camera, GRID, GRID)
    jobs = [(kind, seed) for kind in (*_RENDERED, *_SIMULATED) for seed in range(1, seeds + 1)]
    for kind, seed in jobs:
        if kind in _RENDERED:
            world = _RENDERED[kind]
            scenario = dataclasses.replace(
                rendered_worlds.scenario_of(world, seed), image_count=images
            )
            setup = load_set_up(scenario)
            frames = tuple(rendered_worlds.frames(world, scenario))
            truth = rendered_worlds.true_directions(world, scenario, pixels, 0)
            stars = observed(frames, setup)
            yield Campaign(kind, scenario, setup, stars, pixels, truth, frames)
        else:
            made = simulate(_SIMULATED[kind], seed, images)
            scenario = synthetic.scenario('small', seed)
            truth, setup = made.true_directions[0], load_set_up(scenario)
            yield Campaign(kind, scenario, setup, made.ensemble, pixels, truth)


def drifting(count: int) -> Campaign:
    """Frames of one sky that drifts through the field, for their processor time alone."""
    scenario, none = synthetic.scenario('small', 1), np.empty((0, 3))
    frames = tuple(render_frame(scenario, k) for k in range(count))
    return Campaign('', scenario, load_set_up(scenario), Ensemble(), none, none, frames)
