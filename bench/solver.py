# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The least-squares search against SciPy and OpenCV, with the same stars and start.

About 80 stars per image with 0.1 px noise; the true skew is zero, because OpenCV has none.  Times
are from alternating runs in one process, memory from a separate process per solver.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
import multiprocessing
from pathlib import Path
import time
import timeit
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from bench import competitors
from bench.table import Table, verdict
from bench.trials import memory_mb
from starcal_ros.estimation.star_equations import normal_blocks, ROTATION
from starcal_ros.records import Ensemble
from studies.workers import run_each

LIMIT_S = 60.0  # longest wait for a competitor
TARGETS_FROM = 100  # images; below, Python overhead dominates
TARGETS = {'scipy': 10.0, 'opencv': 12.0}
TARGET_MEMORY_MB = 40.0

SOLVERS: dict[str, tuple[str, Callable[[competitors.Case], competitors.Answer]]] = {
    'starcal': ('starcal, search alone', competitors.solve_starcal),
    'estimate': ('starcal, whole estimate', competitors.estimate_starcal),
    'scipy': ('SciPy trf, sparse Jacobian', competitors.solve_scipy),
    'opencv': ('OpenCV calibrateCamera', competitors.solve_opencv),
}


def cost_of(case: competitors.Case, answer: competitors.Answer, steps: int = 0) -> float:
    """Least-squares cost of a result, after Gauss-Newton steps of the rotations only."""
    rotations = Rotation.from_matrix(answer.camera_from_icrf)
    held = (case.measurements, 'plumb_bob', answer.parameters)
    for _ in range(steps):
        _, blocks = normal_blocks(*held, rotations.as_matrix())
        gradient = blocks[:, ROTATION, -1, None]
        step = np.linalg.solve(blocks[:, ROTATION, ROTATION], gradient)[..., 0]
        rotations = Rotation.from_rotvec(-step) * rotations
    return normal_blocks(*held, rotations.as_matrix())[0]


@dataclass
class Result:
    """Time, peak memory above the data, and result of a solver."""

    best_s: float
    peak_mb: float
    answer: competitors.Answer


def _solve_apart(name: str, case: competitors.Case, pipe: Any) -> None:
    """In a separate process: send the result through the pipe."""
    _, solve = SOLVERS[name]
    solve(competitors.make_case(Ensemble(case.ensemble.images[:5]), case.prior))
    Path('/proc/self/clear_refs').write_text('5')  # the peak counts from now (man 5 proc)
    before_mb = memory_mb('self')
    start_s = time.perf_counter()
    answer = solve(case)
    took_s = time.perf_counter() - start_s
    pipe.send(Result(took_s, memory_mb('self', 'VmHWM') - before_mb, answer))


def solve_apart(name: str, case: competitors.Case) -> Result | None:
    """Result of a solver in a separate process; None after the time limit."""
    context = multiprocessing.get_context('spawn')
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_solve_apart, args=(name, case, sender))
    process.start()
    sender.close()
    try:
        return receiver.recv() if receiver.poll(LIMIT_S) else None
    except EOFError:
        return None
    finally:
        process.kill()
        process.join()


def solve_all(case: competitors.Case, names: list[str], repeats: int) -> dict[str, Result]:
    """Results of the solvers within the time limit."""
    apart = {name: solve_apart(name, case) for name in names}
    results = {name: result for name, result in apart.items() if result}
    for _ in range(repeats):
        for name, result in results.items():
            if name != 'opencv':  # which takes so long that once, apart, is enough
                calls = 3 if name == 'starcal' else 1  # its time is the shortest
                took_s = timeit.repeat(partial(SOLVERS[name][1], case), number=1, repeat=calls)
                result.best_s = min(result.best_s, *took_s)
    return results


def add_rows(
    table: Table, case: competitors.Case, names: list[str], results: dict[str, Result]
) -> None:
    """Add a row for each solver, relative to starcal."""
    ours, m = results['starcal'], case.table.image_count
    sigma = np.sqrt(np.diag(competitors.covariance_of(case, ours.answer, scaled=False)))
    least = cost_of(case, ours.answer)
    for name in names:
        label, result = SOLVERS[name][0], results.get(name)
        ratio = (result.best_s if result else LIMIT_S) / ours.best_s
        judged = verdict(ratio, TARGETS[name]) if name in TARGETS and m >= TARGETS_FROM else ''
        if result is None:
            table.add(m, label, None, None, f'> {ratio:.0f}', judged, None, None, None)
            continue
        off = (result.answer.parameters - ours.answer.parameters)[competitors.FREE] / sigma
        cost = cost_of(case, result.answer, 3 if name == 'opencv' else 0)
        # The complete estimate rejects and reweights stars, so its cost is not comparable.
        cost_off = None if name == 'estimate' else cost / least - 1.0
        time_ms, iterations = 1e3 * result.best_s, result.answer.iterations or None
        table.add(
            *(m, label, iterations, time_ms, f'{ratio:.1f}', judged),
            *(cost_off, float(np.abs(off).max()), result.peak_mb),
        )


def run(quick: bool) -> Iterator[Table]:
    """
    Compare the solvers at several numbers of images.

    All use one thread of linear algebra: on two shared cores more threads wait for each other,
    which makes SciPy up to five times slower and no solver faster.
    """
    yield from run_each(measure, [quick], workers=1)


def measure(quick: bool) -> Table:
    """Table of `run`."""
    sizes = (6,) if quick else (15, 359, 2000)
    repeats = 1 if quick else 3
    table = Table(
        f'Solvers, {competitors.SIGMA_PX} px noise, 8 camera parameters and m rotations free',
        ('m', 'solver', 'iterations', 'ms', 'by ours', 'target', 'cost off', 'sigma off', 'MB'),
        notes=[
            'by ours: its time over that of our search.  cost off: final cost over ours, less 1.',
            'sigma off: worst of the 8 parameters against ours, sigma.  MB: peak above the data.',
            'The cost of OpenCV is that of its camera with the best rotations, as it shifts',
            'cameras too and has no skew.',
        ],
    )
    names = list(SOLVERS)
    for m in sizes:
        print(f'solver: m = {m}', flush=True)
        case = competitors.make_case(*competitors.make_ensemble(m))
        results = solve_all(case, names, repeats)
        add_rows(table, case, names, results)
        for name in [name for name in names if name not in results]:
            table.notes.append(f'{SOLVERS[name][0]}: stopped after {LIMIT_S:.0f} s at m = {m}.')
            names.remove(name)  # more images would take longer yet
    if results['starcal'].peak_mb > TARGET_MEMORY_MB:
        table.notes.append(f'Memory of our search MISSED {TARGET_MEMORY_MB:.0f} MB at m = {m}.')
    return table
