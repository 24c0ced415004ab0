# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Identification and measurement of 16 frames of 1296 x 1024: starcal against tetra3rs.

Processor time of whole sets, imports and indices of the sky apart, the least of several turns.
Without attitudes both find the sky by its patterns, and are told the focal length.
"""

from __future__ import annotations

from collections.abc import Callable
import importlib
import importlib.util
import math
import time

import numpy as np

from bench.frames import history, load_set_up, render_frame
from bench.table import Table
from starcal_ros.arrays import Pixels
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.from_stars import from_stars, pinhole
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.studies.simulation.scenario import scenario

FRAMES = 16
_TURNS = 3
_TETRA3RS_SIGMA = 5.0  # its default, and that of starcal


def run(quick: bool) -> list[Table]:
    """Time each way on the same frames, by turns."""
    given = scenario('small', 1)
    setup = load_set_up(given)
    shown = [render_frame(given, k) for k in range(4 if quick else FRAMES)]
    frames = [image for image, _ in shown]
    catalog = load_catalog()

    def tracked() -> tuple[int, int]:
        track, counts = observe.Track(setup.prior), []
        for image, samples in shown:
            found, track = observe.observe_next(image, history(samples), setup, track)
            counts.append(0 if found.refusal else len(found))
        return sum(count > 0 for count in counts), sum(counts)

    camera = given.truth.camera
    focal_px = float(camera.parameters[0])

    def blind() -> tuple[int, int]:
        hint = pinhole((camera.width, camera.height), focal_px)
        found = from_stars(frames, catalog, hint)
        return len(found.icrf_from_camera), 0

    ways: dict[str, Callable[[], tuple[int, int]]] = {
        'starcal, with attitudes': tracked,
        'starcal, without attitudes: identification alone': blind,
    }
    if importlib.util.find_spec('tetra3rs'):
        width_rad = 2.0 * math.atan(0.5 * camera.width / focal_px)
        ways['tetra3rs, without attitudes'] = _tetra3rs(
            [image.pixels for image in frames], math.degrees(width_rad)
        )
    counts = {name: way() for name, way in ways.items()}  # the indices of the sky are made here
    took_s: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(1 if quick else _TURNS):
        for name, way in ways.items():
            start_s = time.process_time()
            way()
            took_s[name].append(time.process_time() - start_s)
    table = Table(
        f'Processor time of {len(frames)} frames of 1296 x 1024',
        ('way', 'frames found', 'stars measured', 'least s'),
        notes=['stars measured: 0 where a way only identifies'],
    )
    for name, (found, stars) in counts.items():
        table.add(name, found, stars, min(took_s[name]))
    print(table.text())
    return [table]


def _tetra3rs(frames: list[Pixels], width_deg: float) -> Callable[[], tuple[int, int]]:
    """Detection, identification and matches by tetra3rs, in one thread."""
    peer = importlib.import_module('tetra3rs')
    database = peer.SolverDatabase.generate_from_gaia(
        max_fov_deg=1.1 * width_deg, min_fov_deg=0.9 * width_deg, star_max_magnitude=9.0
    )

    def found() -> tuple[int, int]:
        solved = []
        for pixels in frames:
            stars = peer.extract_centroids(
                np.asarray(pixels), sigma_threshold=_TETRA3RS_SIGMA, threads=1
            )
            solved.append(
                database.solve_from_centroids(
                    stars.centroids, fov_estimate_deg=width_deg, image_shape=pixels.shape
                )
            )
        good = [one for one in solved if one]
        return len(good), sum(len(one.matched_catalog_ids) for one in good)

    return found
