# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images that a target sigma needs: planned pointings against random ones and a raster.

A simulated mission of the small camera begins with `_FIRST` random images.  Its target is the
sigma that `_RANDOM` more random ones reach.  For planned pointings and a raster of the sky the
images up to the target are counted; the predicted sigma is that of the plan where it is reached.
"""

from __future__ import annotations

from collections.abc import Iterator
import dataclasses

import numpy as np

from bench.frames import load_set_up
from bench.table import Table
from starcal_ground.planning.plan import plan_pointings, Pointing, Request, target
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import Inertial, Scenario, scenario
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import Ensemble

_FIRST, _RANDOM = 8, 16
_SIGMAS = ('map', 'line_of_sight')


def run(quick: bool) -> Iterator[Table]:
    """A table of missions for each sigma."""
    for name in _SIGMAS[: 1 if quick else None]:
        table = Table(
            f'images to the {name} sigma of {_FIRST} + {_RANDOM} random images',
            ('mission', 'target_arcsec', 'random', 'raster', 'plan', 'predicted/reached'),
        )
        for seed in range(1, 3 if quick else 21):
            table.add(seed, *_mission(seed, name))
        counts = np.array([row[2:] for row in table.rows], float)
        ratio, off = np.median(counts[:, 2]) / np.median(counts[:, 0]), counts[:, 3] - 1.0
        table.notes.append(
            f'plan/random, medians: {ratio:.2f}; predicted off by {np.median(np.abs(off)):.1%} '
            f'(median), {np.sqrt((off**2).mean()):.1%} (rms)'
        )
        yield table


def _mission(seed: int, name: str) -> tuple[float, int, int, int, float]:
    rng = np.random.default_rng([seed, 77])
    base = scenario('small', seed)
    setup = load_set_up(base)
    first = _random(rng, _FIRST)
    random = _random(rng, _RANDOM)
    goal = _reached(base, setup, [*first, *random], name)
    start = _ensemble(base, first)
    planned = plan_pointings(start, setup, Request(_RANDOM, name))
    steps = [step.pointing for step in planned.steps]

    def images_to_goal(more: list[Pointing]) -> tuple[int, float]:
        """Return the number of more images that reach the goal, and the sigma then."""
        sigma = np.inf
        for k in range(1, len(more) + 1):
            sigma = _reached(base, setup, [*first, *more[:k]], name)
            if sigma <= goal:
                return k, sigma
        return len(more), sigma

    by_plan, reached = images_to_goal(steps)
    by_raster, _ = images_to_goal(_raster(2 * _RANDOM))
    return goal, _RANDOM, by_raster, by_plan, planned.steps[by_plan - 1].sigma / reached


def _reached(base: Scenario, setup: Setup, pointings: list[Pointing], name: str) -> float:
    found = estimate_calibration(_ensemble(base, pointings), setup.prior, setup.calibration)
    return target(found, name).sigma(found.posterior.covariance)


def _ensemble(base: Scenario, pointings: list[Pointing]) -> Ensemble:
    attitudes = tuple((one.ra_deg, one.dec_deg, one.roll_deg) for one in pointings)
    mission = dataclasses.replace(base, pointing=Inertial(attitudes), image_count=len(attitudes))
    return true_observations(mission)


def _random(rng: np.random.Generator, count: int) -> list[Pointing]:
    z, ra_deg, roll_deg = rng.uniform((-1.0, 0.0, 0.0), (1.0, 360.0, 360.0), (count, 3)).T
    dec_deg = np.degrees(np.arcsin(z))
    return [Pointing(*row) for row in np.stack([ra_deg, dec_deg, roll_deg], axis=-1).tolist()]


def _raster(count: int) -> list[Pointing]:
    """Rows of declination 40 degrees apart, fields of 45 degrees, no roll."""
    rows = [Pointing(45.0 * k, dec) for dec in (-60.0, -20.0, 20.0, 60.0) for k in range(8)]
    return rows[:count]
