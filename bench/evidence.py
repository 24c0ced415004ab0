# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Evidence that the reported sigma is true: ``python -m bench evidence``.

Random missions, simulated and rendered worlds that differ from the model, frames with a planet,
turning cameras, campaigns beside their Cramer-Rao bound, and sets of real images are calibrated
with default options.  Each result is a line of the results file as soon as it is there; a run that
was stopped continues where the file ends, unless the sources have changed.  `bench.evidence_page`
makes the tables and the page.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import as_completed, ProcessPoolExecutor
import dataclasses
from dataclasses import dataclass
import hashlib
import json
import math
import multiprocessing
from pathlib import Path
import sys
import tempfile
import time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench import evidence_page, trials
from bench.frames import load_set_up, observed
from bench.trials import bound_arcsec, Score
from starcal_ground.cli.arguments import number
from starcal_ground.images.first_setup import air_of
from starcal_ground.products import write_camera_info
from starcal_ground.simulation.centroids import camera_information, scenario_information
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import GRID, line_of_sight_table
from starcal_ros.camera import CameraModel, line_of_sight, PARAMETER_NAMES, pixel_grid
from starcal_ros.formats.bag import reader
from starcal_ros.formats.messages.message_codec import VELOCITY_TYPE
from starcal_ros.pipeline import campaign
from starcal_ros.pipeline.setup import load_setup, read_values, Setup
from starcal_ros.pipeline.solve import ensemble_of, solve
from starcal_ros.records import Calibration
from studies import missions, rendered_worlds, worlds
from studies.trials import rms

ROOT = Path(__file__).parents[1]
SOURCES = ('starcal_ros', 'starcal_ground', 'studies', 'bench/evidence.py', 'bench/trials.py')
# Campaigns of a group, or of each of its worlds.
COUNTS = {'real': 1, 'bags': 8, 'bodies': 5, 'rendered': 5, 'observed': 5}
MISSIONS = 300
_HELD_PX = 1e-3  # sigma of a principal point that is known
_INNER = 0.9  # of the detector, where two calibrations of real images are compared


@dataclass(frozen=True)
class Job:
    """A campaign of a group; ``name`` is its world, or the folder of a real set."""

    group: str
    name: str
    seed: int

    @property
    def kind(self) -> str:
        """Group and world, or group and set."""
        name = Path(self.name).name if self.group == 'real' else self.name
        return f'{self.group} {name}'.strip()

    def __str__(self) -> str:
        return f'{self.kind} {self.seed}'


def jobs(seed: int, real: Path | None) -> Iterator[Job]:
    """Campaigns of all groups, those that take longest first."""
    sets = sorted(real.iterdir()) if real else []
    names = {
        'real': [str(path) for path in sets if _prior(path).is_file()],
        'bags': [_label(world) for world in rendered_worlds.BAGS],
        'rendered': [_label(world) for world in rendered_worlds.WORLDS],
        'bodies': [_label(world) for world in rendered_worlds.BODIES],
        'observed': list(worlds.WORLDS),
    }
    for group, of_group in names.items():
        for name in of_group:
            yield from (Job(group, name, 100 * seed + k) for k in range(COUNTS[group]))
    for k in range(MISSIONS):
        yield from (Job(group, '', 1000 * seed + k) for group in ('departing', 'sound'))


def _label(world: rendered_worlds.World) -> str:
    return f'{world.name} {world.size:g} {world.unit}' if world.unit else world.name


def run_job(job: Job) -> dict[str, object]:
    """Scores of a campaign, as a line of the results."""
    start_s = time.process_time()
    row: dict[str, object] = {'job': str(job), 'group': job.group, 'kind': job.kind}
    try:
        row |= _score(job)
    except Exception as error:  # a defect of one campaign is a result too
        row |= dataclasses.asdict(Score(False, (f'{type(error).__name__}: {error}',), 'failed'))
    return {**row, 'cpu_s': round(time.process_time() - start_s, 2)}


def _score(job: Job) -> dict[str, object]:
    if job.group == 'real':
        return real_set(Path(job.name))
    if job.group == 'observed':
        return dataclasses.asdict(simulated(worlds.WORLDS[job.name], job.seed))
    if job.group in ('departing', 'sound'):
        sound, world = (missions.drawn(*divmod(job.seed, 1000), k) for k in (True, False))
        score = simulated(sound if job.group == 'sound' else world, job.seed)
        fields = [field.name for field in dataclasses.fields(world)]
        differs = [name for name in fields if getattr(sound, name) != getattr(world, name)]
        return {**dataclasses.asdict(score), 'departures': differs * (job.group == 'departing')}
    all_worlds = (*rendered_worlds.WORLDS, *rendered_worlds.BODIES, *rendered_worlds.BAGS)
    given = next(one for one in all_worlds if _label(one) == job.name)
    return dataclasses.asdict(rendered(given, job.seed, has_bound=job.group == 'bags'))


def simulated(world: worlds.World, seed: int) -> Score:
    """
    Score of a campaign of observations of a world, with default options.

    It has a bound where velocity and shutter are stated: that of a world without departures.
    """
    made = worlds.simulate(world, seed)
    setup = load_set_up(made.scenario, shutter=world.shutter)
    score = trials.score(made.ensemble, setup, made.scenario.truth, made.true_directions)
    if world.shutter != 'global' or world.velocity_m_s:
        return score
    camera = made.scenario.truth.camera
    to_camera = made.scenario.truth.star_tracker_from_camera.inv()
    p = len(camera.parameters)
    information = np.zeros((p, p))
    for image in made.ensemble.images:
        if len(image) < 3:
            continue
        to_icrf = Rotation.from_quat(image.icrf_from_star_tracker_xyzw)
        in_camera = (to_camera * to_icrf.inv()).apply(image.direction_icrf)
        stated_px2 = image.covariance_px2[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        information += camera_information(camera, in_camera, stated_px2 / world.claim**2, range(p))
    centre_px = setup.calibration.principal_point_prior * max(camera.width, camera.height)
    bound = bound_arcsec(camera, information, centre_px)
    return dataclasses.replace(score, bound_arcsec=bound)


def rendered(world: rendered_worlds.World, seed: int, has_bound: bool = False) -> Score:
    """
    Score of a campaign of images that are rendered in a world and measured.

    Its bound is that of a known principal point, as that of other simulators.
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
    bound = bound_arcsec(camera, information, _HELD_PX)
    return dataclasses.replace(score, bound_arcsec=bound)


def _prior(folder: Path) -> Path:
    """File that states the camera of a real set: its own parameter file, or one beside it."""
    own = folder / 'params.yaml'
    return own if own.is_file() else folder.with_name(f'{folder.name}.prior.json')


def _setup_of(folder: Path, bags: list[Path]) -> Setup:
    """Set-up of a real set; images without a velocity were taken on the ground."""
    prior = _prior(folder)
    if prior.suffix == '.yaml':
        return load_setup({**read_values(prior), 'min_images': 2})
    stated = json.loads(prior.read_text())
    numbers = np.array([*stated['k_prior'], *stated['d_prior']])
    is_in_space = any(topic.type_name == VELOCITY_TYPE for topic in reader.topics(bags))
    with tempfile.TemporaryDirectory() as temporary:
        camera = Path(temporary, 'camera.yaml')
        write_camera_info(CameraModel(stated['width'], stated['height'], numbers), camera)
        return load_setup(
            {
                'camera_info_url': f'file://{camera}',
                'prior_alignment': stated['align_prior_xyzw'],
                'star_tracker_sigma_arcsec': [stated['sigma_st_arcsec']] * 3,
                'min_images': 2,
                **({} if is_in_space else {'observer': 'ground'}),
            }
        )


def real_set(folder: Path) -> dict[str, object]:
    """
    Score of a set of real images, as ``starcal calibrate`` has it.

    ``ratios`` has the difference of its halves and that from an independent fit, their 1-sigma,
    and one over the other; the fit has a sigma of its own, which is not known.
    """
    bags = sorted(folder.glob('*.mcap'))
    setup = _setup_of(folder, bags)
    source = campaign.Source(tuple(bags), reader.Topics(), setup, air_of(setup))
    whole = campaign.calibrate(campaign.observe(campaign.chosen(source)))
    good = [image for image in whole.observations if not image.refusal]
    half, found = len(good) // 2, {'whole': whole.calibration}
    splits = {'turns': (good[::2], good[1::2]), 'time': (good[:half], good[half:])}
    for split, parts in splits.items() if half > 1 else ():
        for k, part in enumerate(parts):
            found[f'{split} {k}'] = solve(ensemble_of(part, whole.setup), whole.setup)
    seen = {name: _inner_directions(calibration) for name, calibration in found.items()}
    ratios = {}
    for split in splits if half > 1 else ():
        (one, sigma), (other, other_sigma) = seen[f'{split} 0'], seen[f'{split} 1']
        ratios[split] = _difference(one, other, math.hypot(sigma, other_sigma))
    fit = folder.with_name(f'{folder.name}.independent') / 'calibration.json'
    if fit.is_file():
        stated = json.loads(fit.read_text())
        numbers = np.array([stated['params'][name] for name in PARAMETER_NAMES])
        camera = CameraModel(stated['W'], stated['H'], numbers)
        ratios['fit'] = _difference(seen['whole'][0], _inner(camera)[0], seen['whole'][1])
    ends = {one.termination for one in found.values()}
    score = Score(
        all(one.accepted for one in found.values()),
        tuple(f'{name}: {one.reasons[0]}' for name, one in found.items() if one.reasons),
        termination=''.join(ends - {'converged'}) or 'converged',
        iterations=max(one.iterations for one in found.values()),
        sigma_arcsec=seen['whole'][1],
    )
    return {**dataclasses.asdict(score), 'images': len(good), 'ratios': ratios}


def _inner_directions(found: Calibration) -> tuple[Floats, float]:
    """Lines of sight (n, 3) over the inner detector, and their rms 1-sigma, arcsec."""
    directions, pixels = _inner(found.geometry.camera)
    table = line_of_sight_table(found.geometry.camera, found.map_covariance, pixels)
    return directions, rms(table.shape_sigma_arcsec)


def _inner(camera: CameraModel) -> tuple[Floats, Floats]:
    """Lines of sight (n, 3) of pixels (n, 2) over the inner detector."""
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    pixels = middle + _INNER * (pixel_grid(camera, 13, 13) - middle)
    return line_of_sight(camera, pixels), pixels


def _difference(one: Floats, other: Floats, sigma_arcsec: float) -> list[float]:
    """Difference of two maps, arcsec rms, its 1-sigma, and the ratio."""
    off_arcsec = rms(trials.shape_errors_arcsec(one, other))
    return [round(off_arcsec, 4), round(sigma_arcsec, 4), round(off_arcsec / sigma_arcsec, 3)]


def digest() -> str:
    """Digest of the sources on which the results depend."""
    found = hashlib.sha256()
    for name in SOURCES:
        path = ROOT / name
        for file in sorted(path.rglob('*.py')) if path.is_dir() else [path]:
            found.update(file.read_bytes())
    return found.hexdigest()[:16]


def main(argv: list[str]) -> int:
    """Run the campaigns that the results file lacks, then write the tables and the page."""
    args = parser().parse_args(argv)
    own = {'digest': digest()}
    real = args.real or ROOT.parent / 'shared' / 'realsky'
    if not real.is_dir():
        print(f'{real}: no such folder, so the real sets are left out; name one with --real')
    done = {str(row['job']) for row in evidence_page.rows_of(args.output, own['digest'])}
    counts: Counter[str] = Counter()
    todo = []
    for job in jobs(args.seed, real if real.is_dir() else None):
        if args.only and not any(word in str(job) for word in args.only):
            continue
        counts[job.kind] += 1
        if counts[job.kind] <= (args.count or MISSIONS) and str(job) not in done:
            todo.append(job)
    with args.output.open('a') as file:
        for k, row in enumerate(_results(todo, args.workers)):
            file.write(json.dumps({**row, **own}) + '\n')
            file.flush()
            said = f'{k + 1} of {len(todo)} campaigns: {row["job"]}'
            print(f'\r{said[:78]:<78}', end='', file=sys.stderr, flush=True)
    print(file=sys.stderr)
    after = evidence_page.rows_of(args.output, own['digest'])
    before = evidence_page.rows_of(args.before) if args.before else []
    tables = evidence_page.tables(after, before)
    for table in tables:
        print(table.text())
    evidence_page.write(tables, after, before, args.output.with_suffix('.html'))
    if args.document:
        evidence_page.write_document(tables, args.document)
    return 0


def _results(todo: list[Job], workers: int) -> Iterator[dict[str, Any]]:
    """Rows of jobs as they end; each on one thread of BLAS."""
    with (
        trials.environment(OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1'),
        ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context('spawn')) as pool,
    ):
        try:
            for future in as_completed([pool.submit(run_job, job) for job in todo]):
                yield future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def parser() -> argparse.ArgumentParser:
    """Parser of the arguments."""
    made = argparse.ArgumentParser(prog='python -m bench evidence', description='Is sigma true?')
    add = made.add_argument
    what = 'results, a JSON line each; the page is FILE with .html'
    add('-o', '--output', type=Path, default=Path('evidence.jsonl'), metavar='FILE', help=what)
    add('--before', type=Path, metavar='FILE', help='results of other sources, shown beside')
    add('--only', nargs='+', metavar='WORD', help='campaigns whose name has one of these words')
    what = 'campaigns of each kind at most (default: all)'
    add('--count', type=number(int, 1), metavar='N', help=what)
    what = 'seed of all campaigns (default: 1)'
    add('--seed', type=number(int, 0), default=1, metavar='S', help=what)
    add('--real', type=Path, metavar='DIR', help='folder of sets of real images')
    add('--workers', type=number(int, 1), default=2, metavar='N', help='processes (default: 2)')
    what = (
        'document whose tables between the marks <!-- evidence --> and <!-- end --> are replaced'
    )
    add('--document', type=Path, metavar='FILE', help=what)
    return made
