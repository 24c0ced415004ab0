# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Random missions: whether the reported sigma is honest over all that the documents promise.

``python -m bench.coverage --count 100 --seed 1 [--sound] [NAME...]`` draws missions from the prior
of `drawn`, or takes the named worlds of `studies.worlds`, calibrates each and divides its errors
by the reported 1-sigma.  Mission k of a seed is the same for any count, and with ``--sound``, but
for the departures from the model that a sound mission lacks.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
import dataclasses
from functools import partial
import math

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from bench import trials
from bench.frames import load_set_up
from bench.table import Table
from bench.trials import Score
from starcal_ground.simulation.centroids import camera_information, scaled_inverse
from starcal_ros.assessment.lookup import GRID, line_of_sight_table
from starcal_ros.camera import pixel_grid
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import MapCovariance
from starcal_ros.sky.catalog import load_catalog
from studies import worlds
from studies.trials import rms
from studies.worlds import Campaign, simulate, World, WORLDS

_MISSIONS = 92  # random stream (seed, purpose, mission)
_DEEPEST = 9.0  # magnitude
_FEWEST = 200  # stars in all
_LIES = 2.0  # error over sigma


def drawn(seed: int, mission: int, sound: bool) -> World:
    """Mission of the prior; a sound one has the same camera, pointings and stars."""
    rng = np.random.default_rng([seed, _MISSIONS, mission])
    field_deg = _log(rng, 6.0, 100.0)
    lenses = ['plumb_bob', 'plumb_bob', 'rational_polynomial', 'equidistant']
    faint_px, rate = _log(rng, 0.12, 0.5), _log(rng, 1e-3, 0.3)
    # Catalog and light so that the image has so many stars, the faintest with this sigma.
    magnitude = np.sort(load_catalog(None, _DEEPEST).magnitude)
    magnitude = magnitude[magnitude > worlds.SATURATED_MAGNITUDE]
    share = math.radians(field_deg) ** 2 * 0.79 / (4.0 * math.pi)
    faintest = int(min(max(_log(rng, 6.0, 250.0) / share, 40.0), len(magnitude) - 1))
    stars = share * faintest
    psf2, noise2 = worlds.PSF_SIGMA_PX**2, worlds.NOISE_ELECTRONS**2
    electrons = psf2 + math.sqrt(psf2**2 + 4.0 * faint_px**2 * psf2 * noise2)
    electrons /= 2.0 * faint_px**2
    limit = float(magnitude[faintest])
    least = max(3, math.ceil(_FEWEST / stars))
    world = World(
        images=max(round(_log(rng, 3.0, 200.0)), least),
        pointing=str(rng.choice(['sky', 'strip', 'fields4', 'sky', 'side'])),
        model=str(rng.choice(lenses[: 2 if field_deg < 30.0 else 3 if field_deg < 50.0 else 4])),
        field_deg=field_deg,
        corner=float(rng.choice([-1.0, -1.0, 1.0])) * _log(rng, 5e-4, 0.03),
        shutter=str(rng.choice(['global', 'unknown'])),
        magnitude_limit=limit,
        zero_point_dn=electrons * 10.0 ** (0.4 * limit) / worlds.ELECTRONS_PER_DN,
        bright_px=_log(rng, 0.01, 0.1),
        tracker_arcsec=_log(rng, 2.0, 60.0),
        rate_deg_s=_with(rng, 0.5, rate),
        stamp_s=0.005 * rng.normal(),
    )
    # Without a velocity the mission is in a low orbit; these pointings are about a velocity.
    lacks_velocity = world.pointing == 'side' or rng.random() < 0.3
    world = dataclasses.replace(world, velocity_m_s=7600.0 if lacks_velocity else 0.0)
    lens = partial(worlds.ripple, _log(rng, 0.003, 0.3), _log(rng, 2.0, 20.0))
    tilt = partial(worlds.tilt, _log(rng, 0.05, 1.0))
    departures = {
        'lens': [worlds.no_departure, worlds.no_departure, lens, tilt][rng.integers(4)],
        'breathing': _with(rng, 0.4, _log(rng, 2e-6, 1e-4)),
        'star_arcsec': _with(rng, 0.5, _log(rng, 0.02, 0.3)),
        'blend': _with(rng, 0.3, _log(rng, 0.1, 0.5)),
        'outlier_fraction': _with(rng, 0.5, rng.uniform(0.0, 0.03)),
        'claim': _with(rng, 0.4, _log(rng, 0.6, 1.6), 1.0),
        'tracker_claim': _with(rng, 0.4, _log(rng, 0.7, 1.5), 1.0),
        'wander_arcsec': _with(rng, 0.3, world.tracker_arcsec * rng.uniform()),
        'smooth_arcsec': _with(rng, 0.3, world.tracker_arcsec * rng.uniform()),
        'tracker_hz': _with(rng, 0.4, float(rng.choice([4.0, 10.0]))),
        'row_s': _with(rng, 0.5, 2e-5 * rng.normal()) if world.shutter == 'unknown' else 0.0,
    }
    return world if sound else dataclasses.replace(world, **departures)  # type: ignore[arg-type]


def _log(rng: Generator, low: float, high: float) -> float:
    """A number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _with(rng: Generator, probability: float, value: float, otherwise: float = 0.0) -> float:
    return float(value) if rng.random() < probability else otherwise


def score(world: World, seed: int) -> tuple[Score, float]:
    """
    Score of a campaign of a world with default options, and its sigma over the bound.

    The bound is that of a world without departures, whose velocity and shutter are known.  Raises
    TooFewObservations if the stars do not determine the camera.
    """
    made = simulate(world, seed)
    setup = load_set_up(made.scenario, shutter=world.shutter)
    found = trials.score(made.ensemble, setup, made.scenario.truth, made.true_directions)
    return found, found.sigma_arcsec / _bound_arcsec(made, setup.calibration)


def _bound_arcsec(made: Campaign, options: CalibrationOptions) -> float:
    """Cramer-Rao bound of the rms 1-sigma of the shape: the lens model, free image rotations."""
    camera = made.scenario.truth.camera
    to_camera = made.scenario.truth.star_tracker_from_camera.inv()
    p = len(camera.parameters)
    information = np.zeros((p, p))
    prior_px = options.principal_point_prior * max(camera.width, camera.height)
    information[[3, 4], [3, 4]] = 1.0 / prior_px**2
    for image in made.ensemble.images:
        if len(image) < 3:
            continue
        to_icrf = Rotation.from_quat(image.icrf_from_star_tracker_xyzw)
        in_camera = (to_camera * to_icrf.inv()).apply(image.direction_icrf)
        stated_px2 = image.covariance_px2[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        covariance_px2 = stated_px2 / made.world.claim**2
        information += camera_information(camera, in_camera, covariance_px2, range(p))
    covariance = np.zeros((p + 3, p + 3))
    covariance[:p, :p] = scaled_inverse(information)
    pixels = pixel_grid(camera, GRID, GRID)
    table = line_of_sight_table(camera, MapCovariance(covariance), pixels)
    return rms(table.shape_sigma_arcsec)


def _trial(world: World, seed: int) -> tuple[Score, float]:
    try:
        return score(world, seed)
    except TooFewObservations as error:
        return Score(False, (str(error),)), math.nan


def table_of(missions: Sequence[tuple[str, World, int]]) -> Table:
    """Scores of missions (group, world, seed), a row for each group; errors of accepted ones."""
    columns = 'missions, accepted, map rms, within 1 sigma, 2 sigma, worst, corners rms'
    table = Table(
        'Random missions: error over reported sigma; median of the sigma over its bound where'
        ' velocity and shutter are stated',
        [*columns.split(', '), 'pointing rms', 'worst pointing', 'sigma / bound', 'cpu s'],
    )
    _, of_world, seeds = zip(*missions, strict=True)
    results = trials.in_processes(_trial, of_world, seeds)
    for group in dict.fromkeys(name for name, *_ in missions):
        of_group = [
            (world, *result)
            for (name, world, _), result in zip(missions, results, strict=True)
            if name == group
        ]
        accepted = [trial for _, trial, _ in of_group if trial.accepted]
        shape = np.array([trial.shape for trial in accepted])
        pointing = [trial.pointing for trial in accepted]
        over_bound = [
            bound
            for world, trial, bound in of_group
            if trial.accepted and world.shutter == 'global' and not world.velocity_m_s
        ]
        table.add(
            *(group, f'{len(accepted)} of {len(of_group)}', rms(shape)),
            *(float(np.mean(shape <= k)) if len(shape) else math.nan for k in (1.0, 2.0)),
            *(max(shape, default=math.nan), rms([trial.corners for trial in accepted])),
            *(rms(pointing), max(pointing, default=math.nan)),
            float(np.median(over_bound or [math.nan])),
            float(np.median([trial.seconds for trial in accepted] or [math.nan])),
        )
    for (group, _, seed), (trial, _) in zip(missions, results, strict=True):
        if trial.accepted and max(trial.shape, trial.pointing) > _LIES:
            errors = f'map {trial.shape:.2f}, pointing {trial.pointing:.2f} sigma'
            table.notes.append(f'{group} {seed}: {errors}')
    reasons = Counter(trial.reasons[0][:70] for trial, _ in results if not trial.accepted)
    table.notes += [f'refused: {count} x {reason}' for reason, count in reasons.most_common()]
    return table


def _missions(count: int, seed: int, groups: Sequence[str]) -> list[tuple[str, World, int]]:
    """Missions of groups; their noise follows from the seed and their number."""
    return [
        (group, drawn(seed, k, group == 'sound'), 1000 * seed + k)
        for group in groups
        for k in range(count)
    ]


def run(quick: bool) -> Iterator[Table]:
    """The table of 30 sound and 40 departing missions, or of a few."""
    sound, departing = (2, 3) if quick else (30, 40)
    missions = _missions(sound, 1, ['sound']) + _missions(departing, 2, ['departing'])
    yield table_of(missions)


def main() -> None:
    """Print the table of the missions asked for."""
    parser = argparse.ArgumentParser(prog='python -m bench.coverage', description=__doc__)
    parser.add_argument('names', nargs='*', metavar='NAME', help='worlds in place of missions')
    parser.add_argument('--count', type=int, default=100, help='missions, or seeds of a world')
    parser.add_argument('--seed', type=int, default=1, help='of the missions; first of a world')
    parser.add_argument('--sound', action='store_true', help='without departures from the model')
    args = parser.parse_args()
    for name in args.names:
        if name not in WORLDS:
            parser.error(f'{name!r} is not one of {", ".join(WORLDS)}')
    missions = [
        (name, WORLDS[name], args.seed + k) for name in args.names for k in range(args.count)
    ]
    group = 'sound' if args.sound else 'departing'
    print(table_of(missions or _missions(args.count, args.seed, [group])).text())


if __name__ == '__main__':
    main()
