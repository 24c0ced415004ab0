# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calibrations of campaigns with known truth by starcal and by other tools that are installed.

Whole pipelines get the images, estimators the same identified stars.  The error is that of the
lines of sight over the detector.  Each peer is scored by its best variant in each campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
import math
from typing import NamedTuple

import numpy as np

from bench.peers import giant, solvers, starcal, tetra3rs
from bench.peers.campaigns import all_campaigns, Campaign, drifting, Result
from bench.table import Table, timed
from bench.trials import shape_errors_arcsec
from starcal_ros.processes import one_blas_thread
from studies.trials import rms


class Tool(NamedTuple):
    """A way of calibration; what each cannot do is in docs/peers.md."""

    calibrate: Callable[[Campaign], list[Result]]
    installed: bool = True
    from_images: bool = False


_OURS = 'starcal, estimator'
TOOLS = {
    'starcal, bag to camera': Tool(starcal.whole, from_images=True),
    'GIANT': Tool(giant.whole, giant.INSTALLED, from_images=True),
    'tetra3rs': Tool(tetra3rs.whole, tetra3rs.INSTALLED, from_images=True),
    _OURS: Tool(starcal.estimator),
    'GIANT, estimator': Tool(giant.estimator, giant.INSTALLED),
    'mrcal': Tool(solvers.mrcal, solvers.MRCAL.exists()),
    'OpenCV': Tool(solvers.opencv),
    'SciPy': Tool(solvers.least_squares),
}


def run(quick: bool) -> Iterator[Table]:
    """The errors of each tool, and the processor time of frames."""
    tools = {name: tool for name, tool in TOOLS.items() if tool.installed}
    for name in TOOLS.keys() - tools.keys():
        print(f'peers: {name} is not installed: skipped')
    seeds, images, turns = (1, 5, 1) if quick else (3, 14, 2)
    rows: dict[tuple[str, str], list[tuple[float, Result]]] = {}
    with one_blas_thread():
        for campaign in all_campaigns(seeds, images):
            chosen = [name for name in tools if campaign.frames or not tools[name].from_images]
            found = [[tools[name].calibrate(campaign) for name in chosen] for _ in range(turns)]
            for name, runs in zip(chosen, zip(*found, strict=True), strict=True):
                rows.setdefault((campaign.kind, name), []).append(_best(campaign, runs))
        times = _frame_time(4 if quick else 16, turns, 'tetra3rs' in tools)
    yield _table(rows, f'seeds 1 to {seeds}, {images} images each')
    yield times


def _best(campaign: Campaign, runs: tuple[list[Result], ...]) -> tuple[float, Result]:
    """Error of the best variant in arcsec, and its result with the least time of the runs."""
    errors = []
    for seen in (one.directions for one in runs[0]):
        unit = seen / np.linalg.norm(seen, axis=1, keepdims=True)
        found = bool(np.isfinite(unit).all())  # or it did not converge
        errors.append(
            rms(shape_errors_arcsec(campaign.true_directions, unit)) if found else math.inf
        )
    k = int(np.argmin(errors))
    least_s = min(results[k].processor_s for results in runs)
    return errors[k], runs[0][k]._replace(processor_s=least_s)


def _table(rows: dict[tuple[str, str], list[tuple[float, Result]]], title: str) -> Table:
    measured = ('campaign', 'tool', 'error "', 'by ours', 'sigma "', 'error/sigma', 'worst')
    columns = (*measured, 'frames', 'stars', 'cpu s', 'best variants')
    table = Table(f'Error of the lines of sight, rms of {title}', columns)
    table.notes.append(
        "by ours: over the error of starcal's estimator.  cpu s: least of several runs."
    )
    for (kind, name), row in rows.items():
        error, sigma = np.array([(error, one.sigma_arcsec) for error, one in row]).T
        ratio = error / sigma
        sigmas = (rms(sigma), rms(ratio), float(ratio.max()))
        stated = sigmas if np.isfinite(sigma).all() else (None, None, None)
        over_ours = rms(error) / rms([one for one, _ in rows[kind, _OURS]])
        used = np.mean([(one.frames, one.stars, one.processor_s) for _, one in row], axis=0)
        variants = '; '.join(sorted({one.variant for _, one in row}))
        table.add(kind, name, rms(error), over_ours, *stated, *used.tolist(), variants)
    return table


def _frame_time(count: int, turns: int, with_tetra3rs: bool) -> Table:
    """Identification and measurement without imports and indices of the sky."""
    campaign = drifting(count)
    ways: dict[str, Callable[[Campaign], tuple[int, int]]] = {
        'starcal, with attitudes': starcal.tracked,
        'starcal, without attitudes: identification alone': starcal.identified,
    }
    if with_tetra3rs:
        ways['tetra3rs, without attitudes'] = tetra3rs.identified
    counts = {name: way(campaign) for name, way in ways.items()}  # and indices of the sky
    took_s = [[timed(partial(way, campaign))[1] for way in ways.values()] for _ in range(turns)]
    title = f'Processor time of {count} frames of 1296 x 1024'
    table = Table(title, ('way', 'frames found', 'stars measured', 'least s'))
    for name, least_s in zip(ways, np.min(took_s, axis=0).tolist(), strict=True):
        table.add(name, *counts[name], least_s)
    return table
