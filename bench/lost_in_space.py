# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Lost in space: how often the stars of a frame are identified without attitude, and how fast.

Beside it tetra3 in its fork cedar-solve on the same frames, and how often random points are taken
for stars.

A frame is a list of sources: the brightest stars of the catalog in the field, every tenth missing,
their brightnesses off by 0.3 mag and their places by 0.3 px, and false sources of like
brightness anywhere.  The camera differs from its prior by up to what `lost_in_space` promises, or
not at all.  Seeds are fixed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
import functools
import json
import math
from pathlib import Path
import subprocess
import sys
import tempfile

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from bench.table import Table, timed
from bench.trials import in_processes
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, field_radius_rad, project
from starcal_ros.identification.blind.search import find_in_any, NotFound, SkyMatch
from starcal_ros.identification.blind.sky_fit import FOUND, Ranges, STATED
from starcal_ros.sky.catalog import cone, load_catalog, StarCatalog

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
CEDAR = 'cedar-solve==0.5.1'
CEDAR_WIDTHS_DEG = (15, 25)  # its own database covers 10 to 30 degrees
CEDAR_FOLDER = Path(__file__).parents[1] / 'build' / 'cedar-solve'
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
    """Frames to be found, beside tetra3, then random points; half a day, or some minutes."""
    count, scrambled = (5, 20) if quick else (FRAMES, SCRAMBLED)
    catalog = load_catalog()
    yield found(catalog, count)
    yield beside_tetra3(catalog, count)
    yield random_points(scrambled)


def find_sky(
    xy_px: Floats, prior: CameraModel, catalog: StarCatalog, try_mirrored: bool = False
) -> SkyMatch | NotFound:
    """Identified stars among sources (n, 2), or the reason why there are none."""
    return find_in_any([xy_px], prior, catalog, (False, True)[: 1 + try_mirrored])[0]


def _rates(
    title: str,
    note: str,
    catalog: StarCatalog,
    widths_deg: Sequence[int],
    count: int,
    search: Callable[[list[Frame], float], list[tuple[bool | None, float]]],
) -> Table:
    """
    Rate and time of a search for each width and kind of frame.

    The search returns for each frame whether it is right, or None without a match, and its time.
    """
    columns = ('frame', 'width deg', 'tried', 'found', 'wrong', 'median s', 'p95 s')
    table = Table(title, columns, notes=[note])
    for name, kind in KINDS.items():
        for width_deg in widths_deg:
            found = search(list(frames(catalog, width_deg, *kind, count)), width_deg)
            verdicts = [verdict for verdict, _ in found]
            median_s, p95_s = np.percentile([s for _, s in found], [50, 95]).tolist()
            rates = (verdicts.count(True), verdicts.count(False))
            table.add(name, width_deg, count, *rates, median_s, p95_s)
            print(*table.rows[-1], flush=True)
    return table


def found(catalog: StarCatalog, count: int) -> Table:
    """Rate and time for each width and kind of frame."""

    def search(made: list[Frame], width_deg: float) -> list[tuple[bool | None, float]]:
        warm = next(frames(catalog, width_deg, 20, 10, 0.0, 1))
        find_sky(warm.xy_px, warm.prior, catalog)
        return [judged(frame) for frame in made]

    def judged(frame: Frame) -> tuple[bool | None, float]:
        sky, took_s = timed(lambda: find_sky(frame.xy_px, frame.prior, catalog))
        return _is_right(frame, sky, catalog) if isinstance(sky, SkyMatch) else None, took_s

    note = 'Processor time of one thread; the index, made once, is not in it.'
    title = 'Frames identified without attitude'
    return _rates(title, note, catalog, WIDTHS_DEG, count, search)


def beside_tetra3(catalog: StarCatalog, count: int) -> Table:
    """The same frames for cedar-solve, which is installed in a folder of its own."""
    title = 'The same frames for tetra3 (cedar-solve, its default database, 10 to 30 degrees)'
    note = 'Told the field to 25 %, 5 s for each frame; its other options as they come.'
    python = _cedar_python()
    if python is None:
        return Table(title, (), notes=[note, 'cedar-solve could not be installed.'])
    search = functools.partial(_cedar, python)
    return _rates(title, note, catalog, CEDAR_WIDTHS_DEG, count, search)


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
        results = in_processes(_searched, points, widths_deg, [ranges] * count)
        identified, took_s = np.array(results).T
        wrong = int(identified.sum())
        limit = float(binomtest(wrong, count, alternative='less').proportion_ci().high)
        mean_s = float(took_s.mean())
        table.add('18, 30 and 60', name, '4 to 70', count, wrong, limit, mean_s)
    return table


def _searched(points: Floats, width_deg: float, ranges: Ranges) -> tuple[bool, float]:
    """True if points (n, 2) are taken for stars, and processor time, s."""
    catalog, prior = _catalog(), camera(width_deg)
    search = functools.partial(find_in_any, [points], prior, catalog, ranges=ranges)
    (sky, _), took_s = timed(search)
    return isinstance(sky, SkyMatch), took_s


@functools.lru_cache(maxsize=1)
def _catalog() -> StarCatalog:
    return load_catalog()


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


_CEDAR_SCRIPT = """
import json, sys, time
import numpy as np
import tetra3
solver = tetra3.Tetra3('default_database')
frames, answers = json.load(open(sys.argv[1])), []
for k, frame in enumerate([frames['frames'][0], *frames['frames']]):
    start = time.process_time()
    found = solver.solve_from_centroids(
        np.array(frame)[:, ::-1], tuple(frames['size'][::-1]), fov_estimate=frames['width_deg'],
        fov_max_error=0.25 * frames['width_deg'], solve_timeout=5000)
    seconds = time.process_time() - start
    if k:
        answers.append([found['RA'], found['Dec'], seconds])
print(json.dumps(answers))
"""


def _cedar(python: Path, made: list[Frame], width_deg: float) -> list[tuple[bool | None, float]]:
    """True for each frame whose middle cedar-solve finds, None without a match; its seconds."""
    with tempfile.NamedTemporaryFile('w', suffix='.json') as file:
        content = {'frames': [frame.xy_px.tolist() for frame in made], 'size': SIZE}
        json.dump({**content, 'width_deg': width_deg}, file)
        file.flush()
        command = [str(python), '-c', _CEDAR_SCRIPT, file.name]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    rows: list[tuple[bool | None, float]] = []
    answers = json.loads(done.stdout.splitlines()[-1])
    for frame, (ra_deg, dec_deg, took_s) in zip(made, answers, strict=True):
        is_right = None
        if ra_deg is not None:
            ra, dec = math.radians(ra_deg), math.radians(dec_deg)
            z = [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]
            cosine = float(frame.camera_from_icrf.as_matrix()[2] @ z)
            # Its boresight is that of the middle of the image: the centre may be 5 % off.
            is_right = cosine > math.cos(math.radians(0.1 * width_deg))
        rows.append((is_right, float(took_s)))
    return rows


def _cedar_python() -> Path | None:
    """The interpreter of a venv with cedar-solve, made at the first use; None: it cannot be."""
    python = CEDAR_FOLDER / 'bin' / 'python'
    try:
        if not python.exists():
            subprocess.run([sys.executable, '-m', 'venv', str(CEDAR_FOLDER)], check=True)
        subprocess.run([str(python), '-m', 'pip', 'install', '-q', CEDAR], check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return python
