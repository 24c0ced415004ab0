# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Stars of one frame: `observe.observe_next` against the detectors of sep and photutils.

Those two only detect and centroid; starcal also predicts, identifies, fits the PSF and checks
every star.  All use the same mono16 frame of 2592 x 2048.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
import importlib.util
import math
import statistics
import time
import timeit

import numpy as np
from scipy.spatial.transform import Rotation

from bench.frames import history, load_set_up, paper_scenario, render_frame
from bench.table import Table
from starcal_ros.arrays import Pixels
from starcal_ros.pipeline import observe

MAGNITUDE_LIMIT = 7.35  # leaves 122 stars
AT_LEAST_S = 0.1  # of calls in a row: a call of 6 ms after another method times the caches
DETECTION_SIGMA = 5.0
ACQUISITION_DEG = 1.2


def run(quick: bool) -> Iterator[Table]:
    """Time each method on one frame, alternating."""
    scenario = paper_scenario(MAGNITUDE_LIMIT)
    setup = load_set_up(scenario, magnitude_limit=MAGNITUDE_LIMIT)
    image, samples = render_frame(scenario, 0)
    attitudes = history(samples)
    _, track = observe.observe_next(image, attitudes, setup, observe.Track(setup.prior))
    track = dataclasses.replace(track, latest_ns=None)  # the same image once more
    prior = Rotation.from_quat(setup.prior.star_tracker_from_camera_xyzw)
    rotation = Rotation.from_rotvec(np.radians(ACQUISITION_DEG) * np.array([0.6, -0.8, 0.0]))
    shifted = dataclasses.replace(
        setup.prior, star_tracker_from_camera_xyzw=(prior * rotation).as_quat()
    )
    ways: dict[str, Callable[[], int]] = {
        'starcal, tracking': lambda: len(observe.observe_next(image, attitudes, setup, track)[0]),
        'starcal, first image': lambda: len(observe.observe_next(image, attitudes, setup)[0]),
        f'starcal, alignment {ACQUISITION_DEG} deg off': lambda: len(
            observe.observe_next(image, attitudes, setup, observe.Track(shifted))[0]
        ),
    }
    if importlib.util.find_spec('sep'):
        ways['sep Background + extract'] = lambda: _sep(image.pixels)
    if importlib.util.find_spec('photutils'):
        psf_fwhm_px = 2.355 * scenario.detector.psf_sigma_px
        ways['photutils DAOStarFinder'] = lambda: _photutils(image.pixels, psf_fwhm_px)
    took_ms: dict[str, list[float]] = {name: [] for name in ways}
    stars = {name: measure() for name, measure in ways.items()}
    timers = {name: timeit.Timer(way, timer=time.process_time) for name, way in ways.items()}
    calls = {name: math.ceil(AT_LEAST_S / timer.timeit(1)) for name, timer in timers.items()}
    for _ in range(2 if quick else 7):
        for name, timer in timers.items():
            took_ms[name].append(1e3 * timer.timeit(calls[name]) / calls[name])
    height, width = image.pixels.shape
    table = Table(
        f'Stars of one frame of {width} x {height}, mono16, in one thread of Python',
        ('way', 'stars', 'least ms', 'median ms', 'by tracking'),
        notes=[
            f'Processor time per call, over calls in a row that take {AT_LEAST_S:g} s.',
            'by tracking: least time over that of starcal, tracking.',
        ],
    )
    ours_ms = min(took_ms['starcal, tracking'])
    for name, ms in took_ms.items():
        table.add(name, stars[name], min(ms), statistics.median(ms), f'{min(ms) / ours_ms:.1f}')
    yield table


def _sep(pixels: Pixels) -> int:
    """Sources found as in the documentation of sep."""
    import sep

    data = pixels.astype(np.float32)
    background = sep.Background(data)
    found = sep.extract(data - background, DETECTION_SIGMA, err=background.globalrms)
    return len(found)


def _photutils(pixels: Pixels, psf_fwhm_px: float) -> int:
    """Sources found as in the documentation of photutils."""
    from astropy.stats import sigma_clipped_stats
    from photutils.detection import DAOStarFinder

    data = pixels.astype(np.float32)
    _, median, noise = sigma_clipped_stats(data, sigma=3.0)
    found = DAOStarFinder(threshold=DETECTION_SIGMA * noise, fwhm=psf_fwhm_px)(data - median)
    return 0 if found is None else len(found)
