# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Error over reported sigma where the world differs from the model.

Each row is a world: a lens, a detector or a star tracker with a fault of a stated size.  Every
seed renders a campaign of star images in that world, measures it as the observer does, and solves
it with the default options.  The error of the lines of sight over the detector, the best common
rotation removed, is divided by the 1-sigma that the calibration reports.  A row is honest where
the RMS of that ratio over the accepted calibrations is 0.7 to 1.5 and none exceeds 2, or where the
gate refuses and names the cause.  The worlds of simulated observations follow (`bench.worlds`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
import dataclasses
from dataclasses import dataclass
import math
import multiprocessing
import os

import erfa
import numpy as np
from scipy.spatial.transform import Rotation

from bench import worlds
from bench.frames import history, load_set_up
from bench.table import Table
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import line_of_sight_table
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid, project
from starcal_ros.constants import ARCSECOND_RAD, AU_M, SPEED_OF_LIGHT_M_S
from starcal_ros.errors import TooFewObservations
from starcal_ros.pipeline import observe, solve
from starcal_ros.records import AttitudeSample, CameraGeometry, Ensemble, Image
from starcal_ros.sky.astrometry import tt_julian_date
from starcal_ros.studies.simulation import rendering
from starcal_ros.studies.simulation import scenario as synthetic
from starcal_ros.studies.simulation.scenario import Inertial, Scenario, Scene

Field = Callable[[Floats], Floats]  # displacement (n, 2) px of pixels (n, 2)

SEEDS = 10
IMAGES = 14
COPIES = 30
_GRID = 25
_WANDER_IMAGES = 10.0  # correlation length of the star tracker that wanders
_ABBBA = (0, 1, 1, 1, 0)
_LENSES = {'two lenses': (0, 1), 'two lenses as ABBBA': _ABBBA}  # by image
_HONEST = (0.7, 1.5)
_NEVER = 2.0


@dataclass(frozen=True)
class World:
    """A fault of the world and its size, and words of which a refusal must hold one."""

    name: str
    size: float = 0.0
    unit: str = ''
    causes: tuple[str, ...] = ()


_FIELD = ('residual over predicted sigma',)
_LARGE_FIELD = ('1-sigma of the distortion map',)
WORLDS = (
    World('sound'),
    *(World('principal point', size, 'px', ('cx', 'cy')) for size in (2.0, 20.0, 60.0)),
    *(World('tilted detector', size, 'px', _FIELD) for size in (0.3, 1.0, 3.0)),
    *(World('8th-order radial', size, 'px', _FIELD) for size in (0.3, 1.0, 3.0)),
    *(World('ripple', size, 'px', (*_FIELD, *_LARGE_FIELD)) for size in (0.03, 0.1, 0.3, 1.0)),
    World('fisheye', 0.0, '', ('lens', *_FIELD, *_LARGE_FIELD)),
    *(World('columns lost', size, 'px', ('step',)) for size in (1.0, 3.0)),
    World('odd rows shifted', 1.0, 'px', ('rows', 'step')),
    World('two lenses', 1.0, 'px', ('image to image',)),
    *(World('two lenses as ABBBA', size, 'px', ('image to image',)) for size in (0.3, 1.0)),
    World('one image', COPIES, 'times', _FIELD),
    *(World('focal breathing', size, 'px', ('image to image',)) for size in (0.5, 2.0, 4.0)),
    World('aberration reversed', 0.5, 'year', ('velocity', 'aberration')),
    World('tracker wanders', 60.0, 'arcsec', ('1-sigma of a line of sight',)),
)
QUICK = ('sound', 'principal point', 'ripple', 'columns lost', 'tracker wanders')


def run(quick: bool) -> Iterator[Table]:
    """The tables of all worlds."""
    seeds = 2 if quick else SEEDS
    rendered = [w for w in WORLDS if not quick or w.name in QUICK]
    if quick:
        names = [w.name for w in rendered]
        rendered = [w for k, w in enumerate(rendered) if w.name not in names[:k]]
    os.environ.update(OPENBLAS_NUM_THREADS='1', OMP_NUM_THREADS='1')
    table = Table(
        f'Error over reported sigma where the world differs from the model, {seeds} seeds each',
        (
            'world',
            'size',
            'unit',
            'accepted',
            'shape rms',
            'worst',
            'pointing rms',
            'error arcsec',
            'verdict',
            'refused for',
        ),
    )
    jobs = [(world, seed) for world in rendered for seed in range(1, seeds + 1)]
    context = multiprocessing.get_context('forkserver')
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context) as pool:
        results = list(pool.map(_trial, jobs))
    for world in rendered:
        found = [r for (w, _), r in zip(jobs, results, strict=True) if w is world]
        table.add(*_summary(world, found))
    yield table
    yield from worlds.run(quick)


@dataclass(frozen=True)
class Outcome:
    """One campaign: its errors over the reported sigma, and the verdict of the gate."""

    accepted: bool
    reasons: tuple[str, ...]
    shape: float = math.nan
    pointing: float = math.nan
    error_arcsec: float = math.nan


def _summary(world: World, found: list[Outcome]) -> tuple[str | float | int, ...]:
    accepted = [one for one in found if one.accepted]
    refused = [one for one in found if not one.accepted]
    shape = np.array([one.shape for one in accepted])
    pointing = np.array([one.pointing for one in accepted])
    names = Counter(reason for one in refused for reason in one.reasons[:1])
    unnamed = [
        one for one in refused if not any(c in r for r in one.reasons for c in world.causes)
    ]
    of_shape = worlds.rms(shape)
    honest = not accepted or (
        _HONEST[0] <= of_shape <= _HONEST[1] and float(shape.max()) <= _NEVER
    )
    verdict = 'honest' if honest and not unnamed else 'NOT HONEST' if not honest else 'UNNAMED'
    return (
        world.name,
        world.size,
        world.unit,
        f'{len(accepted)} of {len(found)}',
        of_shape,
        float(shape.max(initial=0.0)),
        worlds.rms(pointing),
        worlds.rms(np.array([one.error_arcsec for one in accepted])),
        verdict,
        '; '.join(reason[:90] for reason, _ in names.most_common(1)),
    )


def _trial(job: tuple[World, int]) -> Outcome:
    return trial(*job)


def trial(world: World, seed: int) -> Outcome:
    """Render, measure and solve one campaign in a world."""
    scenario = scenario_of(world, seed)
    setup = load_set_up(scenario)
    track = observe.Track(setup.prior)
    ensemble = Ensemble()
    for image, samples in frames(world, scenario):
        observed, track = observe.observe_next(image, history(samples), setup, track)
        ensemble = solve.add_to_ensemble(ensemble, observed, setup)
    try:
        found = solve.solve(ensemble, setup)
    except TooFewObservations as error:
        return Outcome(False, (str(error),))
    camera = scenario.truth.camera
    pixels = pixel_grid(camera, _GRID, _GRID)
    table = line_of_sight_table(found.geometry.camera, found.map_covariance, pixels)
    estimated = table.direction_camera
    to_tracker, to_true = (
        Rotation.from_quat(g.star_tracker_from_camera_xyzw)
        for g in (found.geometry, scenario.truth)
    )
    # A camera that changes is asked for in each image: the error is that of using it there.
    shape_rad, pointing_rad = [], []
    for index in range(scenario.image_count if _changes(world) else 1):
        true = true_directions(world, scenario, pixels, index)
        rotation, _ = Rotation.align_vectors(true, estimated)
        shape_rad.append(np.linalg.norm(rotation.apply(estimated) - true, axis=1))
        off = to_tracker.apply(estimated) - to_true.apply(true)
        pointing_rad.append(np.linalg.norm(off, axis=1))
    return Outcome(
        found.accepted,
        found.reasons,
        worlds.rms(np.array(shape_rad)) / ARCSECOND_RAD / worlds.rms(table.shape_sigma_arcsec),
        worlds.rms(np.array(pointing_rad)) / ARCSECOND_RAD / worlds.rms(table.sigma_arcsec),
        worlds.rms(np.array(shape_rad)) / ARCSECOND_RAD,
    )


def scenario_of(world: World, seed: int) -> Scenario:
    """A campaign of random pointings; the faults of the camera itself are in its truth."""
    base = synthetic.scenario('small', seed)
    rng = np.random.default_rng([seed, 77])
    count = IMAGES
    if world.name == 'one image':
        count = COPIES
    if world.name == 'two lenses as ABBBA':
        count = len(_ABBBA)
    if world.name == 'tracker wanders':
        count = 2 * IMAGES
    fields = np.stack(
        [
            rng.uniform(0.0, 360.0, count),
            np.degrees(np.arcsin(rng.uniform(-0.95, 0.95, count))),
            rng.uniform(0.0, 360.0, count),
        ],
        axis=-1,
    )
    if world.name == 'one image':
        fields[:] = fields[0]
    truth, prior = base.truth, base.prior
    if world.name == 'fisheye':  # a wide lens, which Brown's series follows only in part
        truth, prior = (_wide(g) for g in (truth, prior))
    if world.name == 'principal point':
        angle = rng.uniform(0.0, 2.0 * np.pi)
        camera = truth.camera
        cx, cy = camera.intrinsics[3:] + world.size * np.array([np.cos(angle), np.sin(angle)])
        truth = dataclasses.replace(truth, camera=camera.replace(cx=float(cx), cy=float(cy)))
    return dataclasses.replace(
        base,
        truth=truth,
        prior=prior,
        pointing=Inertial(tuple((float(a), float(b), float(c)) for a, b, c in fields)),
        start_ns=base.start_ns + seed * 8_640_000_000_000,
        cadence_s=60.0,
        image_count=count,
    )


def _wide(geometry: CameraGeometry) -> CameraGeometry:
    """The camera with a third of the focal length and hardly any distortion."""
    fx, _, fy = geometry.camera.intrinsics[:3] / 3.0
    camera = geometry.camera.replace(fx=fx, fy=fy, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
    return dataclasses.replace(geometry, camera=camera)


def frames(world: World, scenario: Scenario) -> list[tuple[Image, list[AttitudeSample]]]:
    """All frames of a campaign in a world, with the star tracker's samples about each."""
    pattern = rendering.fixed_pattern(scenario)
    rng = np.random.default_rng([scenario.seed, 78])
    wander_rad: Floats = np.zeros(3)
    step = math.exp(-1.0 / _WANDER_IMAGES)
    made = []
    first: Image | None = None
    for index in range(scenario.image_count):
        shown = synthetic.scene(scenario, index)
        moved = dataclasses.replace(shown, pixel_px=_seen_at(world, scenario, shown, index))
        if world.name == 'one image' and first is not None:
            noise = rng.integers(-1, 2, first.pixels.shape)
            pixels = np.clip(first.pixels.astype(np.int64) + noise, 0, scenario.detector.full_dn)
            image = Image(shown.time_ns, pixels.astype(np.uint16))
        else:
            image = rendering.render(scenario, moved, index, pattern)
        first = first or image
        samples = list(synthetic.attitude_samples(scenario, index))
        if world.name == 'tracker wanders':
            sigma_rad = world.size * ARCSECOND_RAD
            keep, add = (step, math.sqrt(1.0 - step**2)) if index else (0.0, 1.0)
            wander_rad = keep * wander_rad + add * sigma_rad * rng.normal(size=3)
            samples = [_rotated(sample, wander_rad) for sample in samples]
        made.append((_read_out(world, image), samples))
    return made


def _rotated(sample: AttitudeSample, error_rad: Floats) -> AttitudeSample:
    reported = Rotation.from_quat(sample.icrf_from_star_tracker_xyzw)
    rotated = reported * Rotation.from_rotvec(error_rad)
    return dataclasses.replace(sample, icrf_from_star_tracker_xyzw=rotated.as_quat())


def _read_out(world: World, image: Image) -> Image:
    """The image after the faults of the read-out."""
    pixels = image.pixels
    if world.name == 'columns lost':
        lost, middle = int(world.size), pixels.shape[1] // 2
        pixels = pixels.copy()
        pixels[:, middle:-lost] = image.pixels[:, middle + lost :]
    if world.name == 'odd rows shifted':
        pixels = pixels.copy()
        pixels[1::2, 1:] = image.pixels[1::2, :-1]
    return dataclasses.replace(image, pixels=pixels)


def _seen_at(world: World, scenario: Scenario, shown: Scene, index: int) -> Floats:
    """Pixels (n, 2) of the stars of a scene on the detector of a world."""
    camera, pixels = camera_at(world, scenario, index), shown.pixel_px
    if _changes(world):
        return np.asarray(project(camera, shown.direction_icrf @ shown.camera_from_icrf.T))
    if world.name == 'aberration reversed':
        e = shown.direction_icrf
        _, barycentric = erfa.epv00(*tt_julian_date(shown.time_ns))
        beta = barycentric['v'] * (AU_M / 86400.0) / SPEED_OF_LIGHT_M_S
        seen = e - 2.0 * (beta - e * (e @ beta)[:, None])
        return np.asarray(project(camera, seen @ shown.camera_from_icrf.T))
    return np.asarray(pixels + displacement(world, scenario)(pixels))


def _changes(world: World) -> bool:
    return world.name in _LENSES or world.name == 'focal breathing'


def camera_at(world: World, scenario: Scenario, index: int) -> CameraModel:
    """True camera of an image; a field of the world comes on top."""
    camera = scenario.truth.camera
    if not _changes(world):
        return camera
    lenses = _LENSES.get(world.name)
    if lenses:  # the size is the shift at a corner
        part = float(lenses[index % len(lenses)])
        part *= float(camera.parameters[0]) / math.hypot(camera.width / 2, camera.height / 2)
    else:  # a change of focal length
        part = np.random.default_rng([scenario.seed, 79, index]).uniform(-1.0, 1.0)
    fx, _, fy = camera.intrinsics[:3]
    change = part * world.size
    return camera.replace(fx=fx + change, fy=fy + change * fy / fx)


def displacement(world: World, scenario: Scenario) -> Field:
    """Displacement that the world adds to the true camera of a scenario, px."""
    camera = scenario.truth.camera
    middle = np.array([camera.width - 1, camera.height - 1]) / 2.0
    corner_px = float(np.hypot(*middle))
    rng = np.random.default_rng([scenario.seed, 80])
    angle = float(rng.uniform(0.0, 2.0 * np.pi))
    size = world.size
    if world.name == 'tilted detector':

        def keystone(pixels: Floats) -> Floats:
            xy = (pixels - middle) / corner_px
            along = xy @ np.array([math.cos(angle), math.sin(angle)])
            return np.asarray(size * along[:, None] * xy)

        return keystone
    if world.name == '8th-order radial':

        def radial(pixels: Floats) -> Floats:
            xy = (pixels - middle) / corner_px
            return np.asarray(size * xy * (xy**2).sum(axis=1, keepdims=True) ** 4)

        return radial
    if world.name == 'ripple':
        count = 8
        wave_px = rng.uniform(0.35, 1.2, count) * camera.width
        direction = rng.uniform(0.0, 2.0 * np.pi, count)
        vectors = 2.0 * np.pi / wave_px * np.stack([np.cos(direction), np.sin(direction)])
        phase = rng.uniform(0.0, 2.0 * np.pi, (2, count))
        gain = size * math.sqrt(2.0 / count) * rng.choice([-1.0, 1.0], (2, count))

        def ripple(pixels: Floats) -> Floats:
            at = pixels @ vectors
            return np.stack([(gain[k] * np.sin(at + phase[k])).sum(axis=1) for k in (0, 1)], -1)

        return ripple
    if world.name == 'fisheye':
        focal_px = camera.parameters[0]

        def fisheye(pixels: Floats) -> Floats:
            xy = (pixels - middle) / focal_px
            r = np.linalg.norm(xy, axis=1, keepdims=True)
            return np.asarray(focal_px * xy * (np.arctan(r) / np.maximum(r, 1e-12) - 1.0))

        return fisheye
    return np.zeros_like


def true_directions(world: World, scenario: Scenario, pixels: Floats, index: int) -> Floats:
    """True lines of sight (n, 3) in the camera frame of measured pixels (n, 2) of an image."""
    field = displacement(world, scenario)
    if world.name == 'odd rows shifted':  # a star lies on both kinds of rows: half of the shift
        pixels = pixels - [0.5 * world.size, 0.0]
    at = pixels.copy()
    for _ in range(60):  # the displacement is a contraction: 0.1 px of 10 px at most
        at = pixels - field(at)
    return line_of_sight(camera_at(world, scenario, index), at)
