# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Acquisition: rates of false matches and of fields found.

Every trial is a rendered image of 640 x 512, pixels to stars: `star_finder.observe_stars`, from
the search beside the predictions to the whole one of 1.5 degrees and 5 degrees of roll, and in one
row `tracking.track_stars`.  Seeds are fixed; a match is wrong if more than one star in ten is
identified as another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
from dataclasses import dataclass, field
import time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from bench.table import Table
from starcal_ground.simulation import rendering
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.scenario import Inertial, Scenario, Scene
from starcal_ros.arrays import Floats
from starcal_ros.errors import ImageRefused
from starcal_ros.identification import star_finder
from starcal_ros.identification.tracking import start_tracking, track_stars, TrackedCamera
from starcal_ros.records import CameraGeometry, Image
from starcal_ros.sky.catalog import load_catalog, StarCatalog

SEED = 20161
IMAGES = 45  # rendered for each kind of field
ATTITUDES = 100  # tried on each of them
TRUE_FIELDS = 100  # for each row of what is to be found
QUICK = 12  # of a hundred
MATCH_PX = 2.0  # a star farther from its true pixel is another one
RIGHT = 0.9  # share of right stars in a right match


@dataclass(frozen=True)
class Found:
    """Result of one trial."""

    accepted: bool
    wrong: bool
    seconds: float


def run(quick: bool) -> Iterator[Table]:
    """Run scrambled fields, then true fields; takes ten minutes, or one."""
    share = QUICK / 100 if quick else 1.0
    yield scrambled(max(3, round(IMAGES * share)), max(4, round(ATTITUDES * share)))
    yield to_be_found(max(6, round(TRUE_FIELDS * share)))


def scrambled(images: int, attitudes: int) -> Table:
    """Number of accepted fields among those that no attitude in the search range explains."""
    table = Table(
        'Fields that must be refused',
        ('field', 'tried', 'wrongly accepted', '95 % limit', 'ms each'),
        notes=[
            'limit: Clopper and Pearson, one-sided; with none accepted it is 3 in those tried.'
        ],
    )
    catalog = load_catalog(None, star_finder.IdentificationOptions().magnitude_limit)
    every = []
    for seed, (name, kind) in enumerate(SCRAMBLES.items()):
        rng = np.random.default_rng([SEED, seed])
        scenario = random_fields(rng, images)
        found = []
        for image, scene, tried in scrambled_images(kind, scenario, rng, attitudes):
            known: CameraGeometry | TrackedCamera = scenario.prior
            if kind.is_tracked:
                known = tracked_from(image, scene, scenario.prior, catalog)
            found += [trial(image, scene, attitude, known, catalog) for attitude in tried]
        every += found
        milliseconds = 1e3 * float(np.mean([one.seconds for one in found]))
        table.add(name, *_wrong(found), milliseconds)
    table.add('all', *_wrong(every), None)
    return table


def _wrong(found: list[Found]) -> tuple[int, int, float]:
    """Trials, wrong ones among them, and the one-sided 95 % limit of their rate."""
    tried, wrong = len(found), sum(one.wrong for one in found)
    limit = binomtest(wrong, tried, alternative='less').proportion_ci().high
    return tried, wrong, float(limit)


def to_be_found(fields: int) -> Table:
    """Number of fields found from a random error within the search range."""
    table = Table(
        'Fields to be found, off by up to 1.5 degrees and 5 degrees of roll',
        ('field', 'tried', 'found', 'refused', 'wrong', 'median ms', 'worst ms'),
    )
    catalog = load_catalog(None, star_finder.IdentificationOptions().magnitude_limit)
    for seed, (name, (detector, missing, strange)) in enumerate(DIFFICULTIES.items()):
        rng = np.random.default_rng([SEED, 100 + seed])
        scenario = with_detector(random_fields(rng, fields), detector)
        found = []
        for index in range(fields):
            drawn = synthetic.scene(scenario, index)
            image = rendering.render(scenario, changed(drawn, rng, missing, strange), index)
            off = turned(scenario.prior, error_within_the_search(rng))
            found.append(trial(image, drawn, drawn.icrf_from_star_tracker_xyzw, off, catalog))
        wrong = sum(one.wrong for one in found)
        right = sum(one.accepted for one in found) - wrong
        ms = 1e3 * np.array([one.seconds for one in found])
        counts = (fields, right, fields - right - wrong, wrong)
        table.add(name, *counts, float(np.median(ms)), float(ms.max()))
    return table


def trial(
    image: Image,
    drawn: Scene,
    icrf_from_star_tracker_xyzw: Floats,
    known: CameraGeometry | TrackedCamera,
    catalog: StarCatalog,
) -> Found:
    """Search or track one image, and compare its stars with the true ones."""
    exposure = star_finder.Exposure(image, icrf_from_star_tracker_xyzw, 0.0)
    search = star_finder.StarSearch(catalog)
    start_s = time.process_time()
    try:
        if isinstance(known, TrackedCamera):
            stars, _ = track_stars(exposure, known, search)
        else:
            stars, _ = star_finder.observe_stars(exposure, known, search)
    except ImageRefused:
        return Found(accepted=False, wrong=False, seconds=time.process_time() - start_s)
    seconds = time.process_time() - start_s
    if stars.refusal:
        return Found(accepted=False, wrong=False, seconds=seconds)
    place = dict(zip(drawn.catalog_id.tolist(), drawn.pixel_px, strict=True))
    nowhere = np.array([np.nan, np.nan])
    true_px = np.array([place.get(number, nowhere) for number in stars.catalog_id.tolist()])
    right = np.linalg.norm(stars.measured_px - true_px, axis=1) < MATCH_PX
    return Found(accepted=True, wrong=bool(right.mean() < RIGHT), seconds=seconds)


def tracked_from(
    image: Image, drawn: Scene, prior: CameraGeometry, catalog: StarCatalog
) -> TrackedCamera | CameraGeometry:
    """Track from an image with the right attitude, to measure other images with."""
    exposure = star_finder.Exposure(image, drawn.icrf_from_star_tracker_xyzw, 0.0)
    stars, instrument = star_finder.observe_stars(exposure, prior, star_finder.StarSearch(catalog))
    return start_tracking(star_finder.realigned(prior, stars), stars, instrument) or prior


def random_fields(rng: np.random.Generator, count: int) -> Scenario:
    """Camera of 20 x 16 degrees with random pointings."""
    x, y, z = Rotation.random(count, random_state=rng).apply([0.0, 0.0, 1.0]).T
    ra_deg, dec_deg = np.degrees(np.arctan2(y, x)) % 360, np.degrees(np.arcsin(z))
    fields = np.stack([ra_deg, dec_deg, rng.uniform(0, 360, count)], axis=-1).tolist()
    return dataclasses.replace(
        synthetic.scenario('tiny', seed=int(rng.integers(1000))),
        pointing=Inertial(tuple((ra, dec, roll) for ra, dec, roll in fields)),
        image_count=count,
    )


def with_detector(scenario: Scenario, detector: dict[str, Any]) -> Scenario:
    """Scenario with some other values of the detector."""
    changed_one = dataclasses.replace(scenario.detector, **detector)
    return dataclasses.replace(scenario, detector=changed_one)


def turned(geometry: CameraGeometry, rotation: Rotation) -> CameraGeometry:
    """Geometry with the camera rotated about its own axes."""
    alignment = geometry.star_tracker_from_camera * rotation
    return CameraGeometry(geometry.camera, alignment.as_quat())


def error_within_the_search(rng: np.random.Generator) -> Rotation:
    """Rotation of the camera by up to 1.5 degrees, uniform over the disc, and a roll up to 5."""
    tilt_rad, roll_rad = np.radians([1.48 * np.sqrt(rng.uniform()), rng.uniform(-4.9, 4.9)])
    about = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(tilt_rad * np.array([np.cos(about), np.sin(about), 0.0]))
    return tilt * Rotation.from_rotvec([0.0, 0.0, roll_rad])


def changed(drawn: Scene, rng: np.random.Generator, missing: float, strange: int) -> Scene:
    """Scene without a share of its stars and with bright objects that are not in the catalog."""
    seen = rng.uniform(size=len(drawn.pixel_px)) >= missing
    electrons = 10 ** rng.uniform(4.0, 6.5, strange)
    return dataclasses.replace(
        drawn,
        pixel_px=np.concatenate([drawn.pixel_px[seen], scattered(rng, strange)]),
        flux_electrons=np.concatenate([drawn.flux_electrons[seen], electrons]),
    )


def scattered(rng: np.random.Generator, count: int) -> Floats:
    """Uniform random pixels (count, 2) in the image."""
    return rng.uniform([0, 0], [639, 511], (count, 2))


def as_drawn(drawn: Scene, rng: np.random.Generator) -> Scene:
    """Return the true stars."""
    return drawn


def at_random_pixels(drawn: Scene, rng: np.random.Generator) -> Scene:
    """Return no star of the catalog: true brightnesses elsewhere."""
    pixels = scattered(rng, len(drawn.pixel_px))
    return dataclasses.replace(drawn, pixel_px=pixels, catalog_id=np.zeros_like(drawn.catalog_id))


def crowded(drawn: Scene, rng: np.random.Generator) -> Scene:
    """Return the true stars among one more source per hundred pixels."""
    more = 3300
    return dataclasses.replace(
        drawn,
        pixel_px=np.concatenate([drawn.pixel_px, scattered(rng, more)]),
        flux_electrons=np.concatenate([drawn.flux_electrons, 10 ** rng.uniform(2.5, 4, more)]),
    )


def shifted_copies(drawn: Scene, rng: np.random.Generator) -> Scene:
    """Return each star four times, as with a shaken camera or a reflection."""
    shifts = np.concatenate([np.zeros((1, 2)), rng.uniform(-40, 40, (3, 2))])
    return dataclasses.replace(
        drawn,
        pixel_px=(drawn.pixel_px[None] + shifts[:, None]).reshape(-1, 2),
        flux_electrons=np.tile(drawn.flux_electrons, 4),
    )


def anywhere(scenario: Scenario, drawn: Scene, rng: np.random.Generator, count: int) -> Floats:
    """Random attitudes (count, 4)."""
    return np.asarray(Rotation.random(count, random_state=rng).as_quat())


def beyond(scenario: Scenario, drawn: Scene, rng: np.random.Generator, count: int) -> Floats:
    """Attitudes (count, 4) 2 to 8 degrees off: most stars are shared, but displaced."""
    # About axes across the line of sight: the camera's x and y, seen from the star tracker.
    st_from_camera = scenario.truth.star_tracker_from_camera
    about = rng.uniform(0, 2 * np.pi, count)
    axis = st_from_camera.apply(np.stack([np.cos(about), np.sin(about), 0 * about], axis=-1))
    angle_rad = np.radians(rng.uniform(2.0, 8.0, count))
    right = Rotation.from_quat(drawn.icrf_from_star_tracker_xyzw)
    return np.asarray((right * Rotation.from_rotvec(angle_rad[:, None] * axis)).as_quat())


@dataclass(frozen=True)
class Scramble:
    """A kind of field: its sources, attitudes to try, detector, and whether it is tracked."""

    sources: Callable[[Scene, np.random.Generator], Scene] = as_drawn
    attitudes: Callable[[Scenario, Scene, np.random.Generator, int], Floats] = anywhere
    detector: dict[str, Any] = field(default_factory=dict)
    is_tracked: bool = False


def scrambled_images(
    kind: Scramble, scenario: Scenario, rng: np.random.Generator, count: int
) -> Iterator[tuple[Image, Scene, Floats]]:
    """Images of a kind, their truth, and the attitudes (count, 4) to try on each."""
    scenario = with_detector(scenario, kind.detector)
    for index in range(scenario.image_count):
        drawn = synthetic.scene(scenario, index)
        shown = kind.sources(drawn, rng)
        true = dataclasses.replace(drawn, catalog_id=shown.catalog_id)
        tried = kind.attitudes(scenario, drawn, rng, count)
        yield rendering.render(scenario, shown, index), true, tried


SCRAMBLES = {
    'true stars, random attitude': Scramble(),
    'true stars, attitude 2 to 8 degrees off': Scramble(attitudes=beyond),
    'stars at random pixels': Scramble(at_random_pixels),
    'one star per hundred pixels': Scramble(
        crowded, detector={'hot_fraction': 2e-3, 'cosmic_rays': 30.0}
    ),
    'each star four times': Scramble(shifted_copies),
    'tracked, random attitude': Scramble(is_tracked=True),
    'tracked, attitude 2 to 8 degrees off': Scramble(attitudes=beyond, is_tracked=True),
}

QUIET: dict[str, Any] = {'hot_fraction': 0.0, 'cosmic_rays': 0.0}
DIFFICULTIES: dict[str, tuple[dict[str, Any], float, int]] = {
    'clean': (QUIET, 0.0, 0),
    'hot pixels: 1 in 1000': ({**QUIET, 'hot_fraction': 1e-3}, 0.0, 0),
    'hot pixels: 1 in 100': ({**QUIET, 'hot_fraction': 1e-2}, 0.0, 0),
    '50 cosmic rays': ({**QUIET, 'cosmic_rays': 50.0}, 0.0, 0),
    '500 cosmic rays': ({**QUIET, 'cosmic_rays': 500.0}, 0.0, 0),
    '5 planets': (QUIET, 0.0, 5),
    '50 planets': (QUIET, 0.0, 50),
    'half of the stars missing': (QUIET, 0.5, 0),
    '4 of 5 stars missing': (QUIET, 0.8, 0),
    '9 of 10 stars missing': (QUIET, 0.9, 0),
    'hot 1 in 1000, 50 cosmic rays, 5 planets, half missing': (
        *({'hot_fraction': 1e-3, 'cosmic_rays': 50.0}, 0.5, 5),
    ),
}
"""Changes by name: detector options, share of stars missing, bright objects added."""
