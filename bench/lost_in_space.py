# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Lost in space: how often the stars of a frame are identified without attitude, and how fast.

Beside it how often random points are taken for stars.

A frame is a list of sources: the brightest stars of the catalog in the field, every tenth missing,
their brightnesses off by 0.3 mag and their places by 0.3 px, and false sources of like
brightness anywhere.  The camera differs from its prior by up to what `lost_in_space` promises, or
not at all.  Seeds are fixed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import functools
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from bench.table import Table, timed
from starcal_ground.blind.search import find_in_any, SkyMatch
from starcal_ground.blind.sky_fit import FOUND, Ranges, STATED
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, field_radius_rad, project
from starcal_ros.sky.catalog import cone, load_catalog, StarCatalog
from studies.workers import processors, run_each

SEED = 416
WIDTHS_DEG = (4, 8, 15, 25, 40, 55, 70)
SIZE = (1024, 820)
FRAMES = 200  # of each width and kind
SCRAMBLED = 10_000
KINDS = {
    '20 stars, 10 false, prior exact': (20, 10, 0.0),
    '20 stars, 10 false, prior off': (20, 10, 1.0),
    '10 stars, 20 false, prior off': (10, 20, 1.0),
    '6 stars, 12 false, prior off': (6, 12, 1.0),
}
"""Name -> true and false sources, and how far the camera is off in parts of what is promised."""
RIGHT = 0.8  # share of its stars that a match has right


@dataclass(frozen=True)
class Frame:
    """
    Sources of a frame, brightest first, and the truth.

    ``xy_px`` (n, 2); ``star`` (n,) rows of the catalog, -1 where false; ``prior`` the camera that
    is given, ``camera_from_icrf`` the truth.
    """

    xy_px: Floats
    star: NDArray[np.int64]
    prior: CameraModel
    camera_from_icrf: Rotation


def run(quick: bool) -> Iterator[Table]:
    """Frames to be found, then random points."""
    count, scrambled = (5, 20) if quick else (FRAMES, SCRAMBLED)
    catalog = load_catalog()
    yield found(catalog, count)
    yield random_points(scrambled)


def find_sky(
    xy_px: Floats, prior: CameraModel, catalog: StarCatalog, try_mirrored: bool = False
) -> SkyMatch | None:
    """Identified stars among sources (n, 2), or None."""
    return find_in_any([xy_px], [prior], catalog, (False, True)[: 1 + try_mirrored])[0]


def found(catalog: StarCatalog, count: int) -> Table:
    """Rate and time for each width and kind of frame."""
    table = Table(
        'Frames identified without attitude',
        ('frame', 'width deg', 'tried', 'found', 'wrong', 'median s', 'p95 s'),
        notes=['Processor time of one thread; the index, made once, is not in it.'],
    )
    for name, kind in KINDS.items():
        for width_deg in WIDTHS_DEG:
            made = list(frames(catalog, width_deg, *kind, count))
            _judged(made[0], catalog)  # makes the index
            verdicts, took_s = zip(*(_judged(frame, catalog) for frame in made), strict=True)
            median_s, p95_s = np.percentile(took_s, [50, 95]).tolist()
            rates = (verdicts.count(True), verdicts.count(False))
            table.add(name, width_deg, count, *rates, median_s, p95_s)
            print(*table.rows[-1], flush=True)
    return table


def _judged(frame: Frame, catalog: StarCatalog) -> tuple[bool | None, float]:
    """True for a right match, None without one, and the processor time, s."""
    sky, took_s = timed(lambda: find_sky(frame.xy_px, frame.prior, catalog))
    return _is_right(frame, sky, catalog) if isinstance(sky, SkyMatch) else None, took_s


def random_points(count: int) -> Table:
    """Number of frames of random points that are accepted, and the rate that this allows."""
    table = Table(
        'Random points that must not be identified',
        ('points', 'camera', 'widths deg', 'tried', 'identified', '95 % limit', 's each'),
        notes=[
            'Camera: stated to 25 %, or found by another image and so known to 2 %.',
            '95 % limit: Clopper and Pearson, one-sided; with none it is 3 in those tried.',
            'One process for each processor; s each: processor time.',
        ],
    )
    rng = np.random.default_rng([SEED, 99])
    points = [rng.uniform([0, 0], SIZE, ((18, 30, 60)[k % 3], 2)) for k in range(count)]
    widths_deg = [WIDTHS_DEG[k % len(WIDTHS_DEG)] for k in range(count)]
    for name, ranges in {'stated': STATED, 'found': FOUND}.items():
        search = functools.partial(_searched, ranges)
        results = run_each(search, zip(points, widths_deg, strict=True), processors())
        identified, took_s = np.array(results).T
        wrong = int(identified.sum())
        limit = float(binomtest(wrong, count, alternative='less').proportion_ci().high)
        mean_s = float(took_s.mean())
        table.add('18, 30 and 60', name, '4 to 70', count, wrong, limit, mean_s)
    return table


def _searched(ranges: Ranges, given: tuple[Floats, float]) -> tuple[bool, float]:
    """True if points (n, 2) are taken for stars, and processor time, s."""
    points, width_deg = given
    catalog, prior = load_catalog(), camera(width_deg)
    search = functools.partial(find_in_any, [points], [prior], catalog, ranges=ranges)
    (sky, _), took_s = timed(search)
    return isinstance(sky, SkyMatch), took_s


def camera(width_deg: float) -> CameraModel:
    """A camera without distortion of so wide a field."""
    width, height = SIZE
    focal_px = width / 2 / math.tan(math.radians(width_deg / 2))
    ideal = [focal_px, 0, focal_px, (width - 1) / 2, (height - 1) / 2, 0, 0, 0, 0, 0]
    return CameraModel(width, height, np.array(ideal))


def frames(
    catalog: StarCatalog, width_deg: float, stars: int, false: int, off: float, count: int
) -> Iterator[Frame]:
    """Random frames; a field with too few stars in the catalog is drawn anew."""
    rng = np.random.default_rng([SEED, int(10 * width_deg), stars, false, int(10 * off)])
    prior = camera(width_deg)
    half_px = 0.5 * math.hypot(*SIZE)
    made = 0
    while made < count:
        focal_px = float(prior.parameters[0]) * math.exp(off * rng.uniform(-0.223, 0.223))
        shift_px = rng.normal(size=2)
        shift_px *= off * rng.uniform() * 0.05 * SIZE[0] / math.hypot(*shift_px)
        cx, cy = (prior.parameters[3:5] + shift_px).tolist()
        k1 = off * rng.uniform(-0.03, 0.03) * (focal_px / half_px) ** 2
        true = prior.replace(fx=focal_px, fy=focal_px, cx=cx, cy=cy, k1=k1)
        rotation = Rotation.random(random_state=rng)
        axis = rotation.as_matrix()[2]
        rows = cone(catalog, axis, field_radius_rad(true, 60.0))
        xy_px = project(true, rotation.apply(catalog.direction_icrs[rows]))
        inside = (xy_px > 2).all(axis=1) & (xy_px < np.array(SIZE) - 3).all(axis=1)
        inside &= rng.uniform(size=len(rows)) > 0.1
        rows, xy_px = rows[inside], xy_px[inside]
        if len(rows) < stars:
            continue
        magnitude = catalog.magnitude[rows] + 0.3 * rng.normal(size=len(rows))
        shown = np.argsort(magnitude)[:stars]
        faint = rng.choice(magnitude[shown], false) + 0.3 * rng.normal(size=false)
        order = np.argsort(np.r_[magnitude[shown], faint])
        xy_px = xy_px[shown] + 0.3 * rng.normal(size=(stars, 2))
        places = np.concatenate([xy_px, rng.uniform([0, 0], SIZE, (false, 2))])
        star = np.r_[rows[shown], np.full(false, -1)]
        made += 1
        yield Frame(places[order], star[order], prior, rotation)


def _is_right(frame: Frame, sky: SkyMatch, catalog: StarCatalog) -> bool:
    """True if most stars are the drawn ones or lie within two pixels of them, as in a pair."""
    drawn = {tuple(xy): star for xy, star in zip(frame.xy_px.tolist(), frame.star, strict=True)}
    rows = np.array([drawn[tuple(xy)] for xy in sky.xy_px.tolist()], np.int64)
    places = catalog.direction_icrs
    apart = np.linalg.norm(places[rows] - places[sky.catalog_index], axis=1)
    near = apart * float(frame.prior.parameters[0]) < 2.0
    return float(np.mean((rows >= 0) & near)) >= RIGHT
