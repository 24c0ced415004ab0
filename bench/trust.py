# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Error over reported sigma where the world differs from the model.

Each row is a world: a lens, a detector or a star tracker with a fault of a stated size.  Every
seed renders a campaign of star images in that world, measures it as the observer does, and solves
it with the default options.  The error of the lines of sight over the detector, the best common
rotation removed, is divided by the 1-sigma that the calibration reports.  A row is honest where
the RMS of that ratio over the accepted calibrations is 0.7 to 1.5 and none exceeds 2, or where the
gate refuses and names the cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

from bench.frames import load_set_up, observed
from bench.table import Table
from bench.trials import in_processes, Score, score
from starcal_ros.assessment.lookup import GRID
from starcal_ros.camera import pixel_grid
from starcal_ros.errors import TooFewObservations
from studies.rendered_worlds import frames, scenario_of, true_directions, World, WORLDS
from studies.trials import rms

SEEDS = 10
_HONEST = (0.7, 1.5)
_NEVER = 2.0
QUICK = ('sound', 'principal point', 'ripple', 'columns lost', 'tracker wanders')


def run(quick: bool) -> Iterator[Table]:
    """The tables of all worlds."""
    seeds = 2 if quick else SEEDS
    first = {world.name: world for world in reversed(WORLDS)}
    chosen = [first[name] for name in QUICK] if quick else WORLDS
    columns = 'world, size, unit, accepted, shape rms, worst, pointing rms, error arcsec, verdict'
    table = Table(
        f'Error over reported sigma where the world differs from the model, {seeds} seeds each',
        (*columns.split(', '), 'refused for'),
    )
    jobs = [(world, seed) for world in chosen for seed in range(1, seeds + 1)]
    scores = in_processes(trial, *zip(*jobs, strict=True))
    for k, world in enumerate(chosen):
        table.add(*_summary(world, scores[seeds * k : seeds * (k + 1)]))
    yield table


def _summary(world: World, found: list[Score]) -> tuple[str | float | int, ...]:
    accepted = [one for one in found if one.accepted]
    refused = [one for one in found if not one.accepted]
    shape = [one.shape for one in accepted]
    names = Counter(reason for one in refused for reason in one.reasons[:1])
    is_named = all(any(c in r for r in one.reasons for c in world.causes) for one in refused)
    honest = not accepted or (_HONEST[0] <= rms(shape) <= _HONEST[1] and max(shape) <= _NEVER)
    return (
        *(world.name, world.size, world.unit, f'{len(accepted)} of {len(found)}'),
        *(rms(shape), max(shape, default=0.0), rms([one.pointing for one in accepted])),
        rms([one.shape_arcsec for one in accepted]),
        'NOT HONEST' if not honest else 'honest' if is_named else 'UNNAMED',
        '; '.join(reason[:90] for reason, _ in names.most_common(1)),
    )


def trial(world: World, seed: int) -> Score:
    """Render, measure and solve one campaign in a world."""
    scenario = scenario_of(world, seed)
    setup = load_set_up(scenario, **dict(world.options))
    pixels = pixel_grid(scenario.truth.camera, GRID, GRID)
    ensemble = observed(frames(world, scenario), setup, has_velocity=False)
    cameras = range(scenario.image_count if world.focal_change else 1)
    true = [true_directions(world, scenario, pixels, index) for index in cameras]
    try:
        return score(ensemble, setup, scenario.truth, true)
    except TooFewObservations as error:
        return Score(False, (str(error),))
