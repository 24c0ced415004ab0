# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Evidence that the reported sigma is true: ``python -m bench evidence``.

Random missions, worlds that differ from the model (observed and rendered), frames with a planet,
turning cameras, campaigns beside their Cramer-Rao bound, and sets of real images are calibrated.
Each result is a line of the results file as soon as it is there: a run that was stopped continues
where the file ends, unless the sources have changed.  `docs.make_evidence` makes the page.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
import dataclasses
from dataclasses import dataclass
import hashlib
import json
import math
from pathlib import Path
import sys
import tempfile
import time

import numpy as np

from bench import trials
from bench.frames import load_set_up, observed
from bench.trials import bound_arcsec, Score, without_last
from docs import make_evidence
from starcal_ground import campaign
from starcal_ground.bags import reader
from starcal_ground.campaign import ensemble_of
from starcal_ground.cli.arguments import number
from starcal_ground.images.first_setup import air_of
from starcal_ground.parameter_files import read_values
from starcal_ground.products import write_camera_info
from starcal_ground.simulation.centroids import scenario_information
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import GRID, line_of_sight_table
from starcal_ros.camera import (
    CameraModel,
    line_of_sight,
    PARAMETER_NAMES,
    pixel_grid,
    project_jacobians,
)
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import StarcalError
from starcal_ros.formats.messages.message_codec import VELOCITY_TYPE
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.pipeline.solve import solve
from starcal_ros.records import Calibration
from studies import missions, rendered_worlds, worlds
from studies.trials import rms
from studies.workers import run_each

ROOT = Path(__file__).parents[1]
SOURCES = (
    *('starcal_ros', 'starcal_ground', 'studies'),
    *('bench/evidence.py', 'bench/frames.py', 'bench/trials.py'),
)
MISSIONS = 300  # sound ones, and departing ones
# Campaigns of each world of a group; the reading of a real set is not random.
COUNTS = {'real': 1, 'bags': 16, 'rendered': 10, 'bodies': 10, 'observed': 10}
RENDERED = {
    group: {f'{one.name} {one.size:g} {one.unit}'.removesuffix(' 0 '): one for one in of_group}
    for group, of_group in (
        ('rendered', rendered_worlds.WORLDS),
        ('bodies', rendered_worlds.BODIES),
        ('bags', rendered_worlds.BAGS),
    )
}
_HELD_PX = 1e-3  # 1-sigma of a principal point that is known
_INNER = 0.9  # of the detector: where two calibrations of real images are compared


@dataclass(frozen=True)
class Job:
    """A campaign of a group; ``world`` is its world, or the folder of a real set."""

    group: str
    world: str
    seed: int

    @property
    def kind(self) -> str:
        """Group and world, or group and set."""
        world = Path(self.world).name if self.group == 'real' else self.world
        return f'{self.group} {world}'.strip()

    def __str__(self) -> str:
        return f'{self.kind} {self.seed}'


def jobs(seed: int, real: Sequence[Path]) -> Iterator[Job]:
    """Campaigns of all groups, those that take longest first."""
    sets = [path for folder in real for path in sorted(folder.iterdir())]
    kinds = [('real', str(path)) for path in sets if _prior(path).is_file()]
    kinds += [(group, name) for group, of_group in RENDERED.items() for name in of_group]
    kinds += [('observed', name) for name in worlds.WORLDS]
    for group, name in kinds:
        yield from (Job(group, name, 100 * seed + k) for k in range(COUNTS[group]))
    for k in range(MISSIONS):
        yield from (Job(group, '', 1000 * seed + k) for group in ('departing', 'sound'))


def run_job(job: Job) -> dict[str, object]:
    """Scores of a campaign, as a line of the results."""
    start_s = time.process_time()
    try:
        row = _scored(job)
    except StarcalError as error:
        row = dataclasses.asdict(Score(False, (str(error),), 'refused'))
    except Exception as error:  # a defect that one campaign shows is a result too
        row = dataclasses.asdict(Score(False, (f'{type(error).__name__}: {error}',), 'failed'))
    cpu_s = round(time.process_time() - start_s, 2)
    return {'job': str(job), 'group': job.group, 'kind': job.kind, **row, 'cpu_s': cpu_s}


def _scored(job: Job) -> dict[str, object]:
    if job.group == 'real':
        return real_set(Path(job.world))
    if job.group == 'observed':
        return dataclasses.asdict(simulated(worlds.WORLDS[job.world], job.seed))
    if job.group in RENDERED:
        world = RENDERED[job.group][job.world]
        score = rendered(world, job.seed, has_bound=job.group == 'bags')
        return dataclasses.asdict(score)
    seed, mission = divmod(job.seed, 1000)
    sound = missions.drawn(seed, mission, True)
    drawn = missions.drawn(seed, mission, job.group == 'sound')
    departures = [k for k, value in vars(drawn).items() if value != getattr(sound, k)]
    return {**dataclasses.asdict(simulated(drawn, job.seed)), 'departures': departures}


def simulated(world: worlds.World, seed: int) -> Score:
    """
    Score of a campaign of observations of a world, with default options.

    Where velocity and shutter are stated, it has the bound of a world without departures.
    """
    made = worlds.simulate(world, seed)
    setup = load_set_up(made.scenario, shutter=world.shutter)
    score = trials.score(made.ensemble, setup, made.scenario.truth, made.true_directions)
    if world.shutter != 'global' or world.velocity_m_s:
        return score
    camera, p = made.scenario.truth.camera, len(made.scenario.truth.camera.parameters)
    information = np.zeros((p + 3, p + 3))
    tracker = np.eye(3) / (world.tracker_arcsec * ARCSECOND_RAD) ** 2
    for image, to_camera in zip(made.ensemble.images, made.camera_from_icrf, strict=True):
        in_camera = to_camera.apply(image.direction_icrf)
        _, by_camera, by_rotation = project_jacobians(camera, in_camera)
        J = np.concatenate([by_camera, np.zeros_like(by_rotation), by_rotation], axis=-1)
        true_px2 = image.covariance_px2[:, [0, 1, 1, 2]].reshape(-1, 2, 2) / world.claim**2
        N = np.einsum('nai,nab,nbj->ij', J, np.linalg.inv(true_px2), J, optimize=True)
        # The tracker measures the rotation of the image less that of the alignment.
        N[p:, p:] += np.kron([[1, -1], [-1, 1]], tracker)
        information += without_last(N, 3)
    centre_px = setup.calibration.principal_point_prior * max(camera.width, camera.height)
    bound = bound_arcsec(camera, without_last(information, 3), centre_px)
    return dataclasses.replace(score, bound_arcsec=bound)


def rendered(world: rendered_worlds.World, seed: int, has_bound: bool = False) -> Score:
    """
    Score of a campaign of images that are rendered in a world and measured.

    The bound is that of a known principal point, as in other simulators.
    """
    scenario = rendered_worlds.scenario_of(world, seed)
    setup = load_set_up(scenario, **dict(world.options))
    camera = scenario.truth.camera
    pixels = pixel_grid(camera, GRID, GRID)
    ensemble = observed(rendered_worlds.frames(world, scenario), setup, world.has_velocity)
    cameras = range(scenario.image_count if world.focal_change else 1)
    true = [rendered_worlds.true_directions(world, scenario, pixels, k) for k in cameras]
    score = trials.score(ensemble, setup, scenario.truth, true)
    if not has_bound:
        return score
    information = scenario_information(scenario, range(len(camera.parameters)))
    return dataclasses.replace(score, bound_arcsec=bound_arcsec(camera, information, _HELD_PX))


def _prior(folder: Path) -> Path:
    """File that states the camera of a real set: a parameter file in it, or one beside it."""
    params = folder / 'params.yaml'
    return params if params.is_file() else folder.with_name(f'{folder.name}.prior.json')


def _setup_of(prior: Path, bags: Sequence[Path]) -> Setup:
    """Setup of a real set; images without a velocity are taken on the ground."""
    if prior.suffix == '.yaml':
        return load_setup({**read_values(prior), 'min_images': 2})
    stated = json.loads(prior.read_text())
    numbers = np.array([*stated['k_prior'], *stated['d_prior']])
    is_in_space = any(topic.type_name == VELOCITY_TYPE for topic in reader.topics(bags))
    with tempfile.TemporaryDirectory() as temporary:
        camera = Path(temporary, 'camera.yaml')
        write_camera_info(CameraModel(stated['width'], stated['height'], numbers), camera)
        options = {
            'camera_info_url': f'file://{camera}',
            'prior_alignment': stated['align_prior_xyzw'],
            'star_tracker_sigma_arcsec': [stated['sigma_st_arcsec']] * 3,
            'min_images': 2,
            'observer': 'space' if is_in_space else 'ground',
        }
        return load_setup(options)


def real_set(folder: Path) -> dict[str, object]:
    """
    Score of a set of real images and of its halves.

    ``ratios`` has the difference of its halves, and that of the whole from an independent fit over
    the sigma of the whole alone: that of the fit is not known.
    """
    bags = sorted(folder.glob('*.mcap'))
    setup = _setup_of(_prior(folder), bags)
    source = campaign.Source(tuple(bags), reader.Topics(), setup, air_of(setup))
    whole = campaign.calibrate(campaign.observe(campaign.chosen(source)))
    good = [image for image in whole.observations if not image.refusal]
    half, found, ratios = len(good) // 2, {'whole': whole.calibration}, {}
    splits = {'turns': (good[::2], good[1::2]), 'time': (good[:half], good[half:])}
    for split, parts in splits.items() if half > 1 else ():
        two = [solve(ensemble_of(part, whole.setup), whole.setup) for part in parts]
        found |= {f'{split} {k}': one for k, one in enumerate(two)}
        (one, sigma), (other, other_sigma) = map(_inner, two)
        off_arcsec = rms(trials.shape_errors_arcsec(one, other))
        ratios[split] = off_arcsec / math.hypot(sigma, other_sigma)
    directions, sigma = _inner(whole.calibration)
    fit = folder.with_name(f'{folder.name}.independent') / 'calibration.json'
    if fit.is_file():
        stated = json.loads(fit.read_text())
        numbers = np.array([stated['params'][name] for name in PARAMETER_NAMES])
        camera = CameraModel(stated['W'], stated['H'], numbers)
        fitted = line_of_sight(camera, _inner_pixels(camera))
        ratios['fit'] = rms(trials.shape_errors_arcsec(fitted, directions)) / sigma
    score = Score(
        all(one.accepted for one in found.values()),
        tuple(f'{name}: {reason}' for name, one in found.items() for reason in one.reasons[:1]),
        ' '.join({one.termination for one in found.values()} - {'converged'}) or 'converged',
        max(one.iterations for one in found.values()),
        sigma_arcsec=sigma,
    )
    return {**dataclasses.asdict(score), 'images': len(good), 'ratios': ratios}


def _inner(found: Calibration) -> tuple[Floats, float]:
    """Lines of sight (n, 3) over the inner detector, and their rms 1-sigma, arcsec."""
    camera = found.geometry.camera
    table = line_of_sight_table(camera, found.map_covariance, _inner_pixels(camera))
    return table.direction_camera, rms(table.shape_sigma_arcsec)


def _inner_pixels(camera: CameraModel) -> Floats:
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    return np.asarray(middle + _INNER * (pixel_grid(camera, 13, 13) - middle))


def digest() -> str:
    """Digest of the sources on which the results depend."""
    paths = [ROOT / name for name in SOURCES]
    files = [file for path in paths for file in (sorted(path.rglob('*.py')) or [path])]
    return hashlib.sha256(b''.join(file.read_bytes() for file in files)).hexdigest()[:16]


def main(argv: Sequence[str]) -> int:
    """Run the campaigns that the results file lacks, then print the tables and write the page."""
    args = parser().parse_args(argv)
    version, real = digest(), args.real or [ROOT.parent / 'shared' / 'realsky']
    for folder in real:
        if not folder.is_dir():
            print(f'{folder}: no such folder, its real sets are left out; name it with --real')
    done = {row['job'] for row in make_evidence.rows_of(args.output, version)}
    counts: Counter[str] = Counter()
    todo = []
    for job in jobs(args.seed, list(filter(Path.is_dir, real))):
        if not args.only or str(job).startswith(tuple(args.only)):
            counts[job.kind] += 1
            if counts[job.kind] <= args.count and str(job) not in done:
                todo.append(job)
    ended, start_s = 0, time.monotonic()
    with args.output.open('a') as file:
        file.write('\n' * bool(file.tell()))  # after a line that a killed run has cut

        def on_each(row: dict[str, object]) -> None:
            nonlocal ended
            file.write(f'{json.dumps({**row, "digest": version})}\n')
            file.flush()
            ended += 1
            said = f'{ended} of {len(todo)}, {time.monotonic() - start_s:.0f} s: {row["job"]}'
            print(f'\r{said[:78]:<78}', end='', file=sys.stderr, flush=True)

        try:
            run_each(run_job, todo, workers=2, on_each=on_each)
        except KeyboardInterrupt:
            print('\nevidence: interrupted; the same command continues', file=sys.stderr)
            return 130
    print(file=sys.stderr)
    make_evidence.write(args.output, args.before)
    return 0


def parser() -> argparse.ArgumentParser:
    """Parser of the arguments."""
    made = argparse.ArgumentParser(prog='python -m bench evidence', description='Is sigma true?')
    what = 'results, a JSON line each; the page is beside it (default: evidence.jsonl)'
    made.add_argument('-o', '--output', type=Path, default='evidence.jsonl', help=what)
    made.add_argument('--before', type=Path, help='results of other sources, to show beside these')
    made.add_argument('--only', nargs='+', metavar='NAME', help='campaigns whose names begin so')
    count = number(int, 1)
    made.add_argument('--count', type=count, default=MISSIONS, help='campaigns of each kind')
    made.add_argument('--seed', type=number(int, 0), default=1, help='of all campaigns')
    what = 'folders with sets of real images'
    made.add_argument('--real', type=Path, nargs='+', metavar='DIR', help=what)
    return made
