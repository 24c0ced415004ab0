# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
``python -m studies.one_objective``: the prototype against the estimator of the package.

Both estimate the same random missions, or the same bag, in turns in one process.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
import contextlib
import functools
import json
from pathlib import Path
import sys
import time
from typing import Any
from unittest import mock

import numpy as np

from bench.evidence import Job, run_job
from starcal_ground.cli.arguments import number
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.pipeline import solve
from studies.one_objective import estimate
from studies.trials import rms

ENGINES: dict[str, Callable[..., Any]] = {
    'today': estimate_calibration,
    'centroids': functools.partial(estimate.estimate_calibration, has_own_amplitudes=False),
    'prototype': estimate.estimate_calibration,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Estimate the campaigns that the results file lacks, then print the comparison."""
    args = parser().parse_args(argv)
    done = [json.loads(line) for line in _lines(args.output)]
    with args.output.open('a') as file:
        for job in jobs(args.group, args.seed, args.count):
            for engine in args.engines:
                if any(row['job'] == str(job) and row['engine'] == engine for row in done):
                    continue
                done.append(estimated(engine, job))
                file.write(f'{json.dumps(done[-1])}\n')
                file.flush()
    for line in compared(done):
        print(line)
    return 0


def jobs(group: str, seed: int, count: int) -> Iterator[Job]:
    """Random missions ``departing`` or ``sound``, campaigns of a world, or a folder of a bag."""
    if Path(group).is_dir():
        yield Job('real', group, 0)
        return
    for k in range(count):
        if group in ('departing', 'sound'):
            yield Job(group, '', 1000 * seed + k)
        else:
            yield Job('observed', group, 100 * seed + k)


def estimated(engine: str, job: Job) -> dict[str, object]:
    """Score of a campaign by an engine, with the processor time of its estimates alone."""
    with using(ENGINES[engine]) as took_s:
        return {'engine': engine, **run_job(job), 'estimate_s': round(sum(took_s), 3)}


@contextlib.contextmanager
def using(engine: Callable[..., Any]) -> Iterator[list[float]]:
    """Context manager: `solve` estimates by an engine; gives the seconds of its calls."""
    took_s: list[float] = []

    def timed(*given: Any) -> Any:
        start_s = time.process_time()
        try:
            return engine(*given)
        finally:
            took_s.append(time.process_time() - start_s)

    with mock.patch.object(solve, 'estimate_calibration', timed):
        yield took_s


def compared(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Lines of a table: each engine, by the campaigns that all of them estimated."""
    by_engine = {name: {} for name in ENGINES}  # type: dict[str, dict[str, dict[str, Any]]]
    for row in rows:
        by_engine[row['engine']][row['job']] = row
    both = set.intersection(*({*found} for found in by_engine.values() if found))
    accepted = [
        job
        for job in sorted(both)
        if all(found[job]['accepted'] for found in by_engine.values() if found)
    ]
    yield f'{len(both)} campaigns, {len(accepted)} accepted by all'
    for name, found in by_engine.items():
        if not found:
            continue
        chosen = [found[job] for job in accepted]
        bounds = [(r['sigma_arcsec'], r['shape_arcsec'], r['bound_arcsec']) for r in chosen]
        sigma, error, bound = np.array(bounds).reshape(-1, 3).T
        known = np.isfinite(bound)
        ended = [found[job]['termination'] for job in sorted(both)]
        yield (
            f'{name}: accepted {sum(bool(found[job]["accepted"]) for job in both)},'
            f' map {_rms(r["shape"] for r in chosen)},'
            f' pointing {_rms(r["pointing"] for r in chosen)},'
            f' z {_rms(z for r in chosen for zs in r["z"].values() for z in zs)},'
            f' sigma / bound {_median(sigma[known] / bound[known])},'
            f' error / bound {_rms(error[known] / bound[known])},'
            f' not converged {sum(one == "iteration_limit" for one in ended)},'
            f' rounds {_median([found[job]["iterations"] for job in both])},'
            f' {sum(found[job]["estimate_s"] for job in both):.1f} s'
        )


def _rms(values: Any) -> str:
    some = np.abs(np.array([*values], np.float64))
    return f'rms {rms(some):.3f} worst {some.max(initial=0.0):.2f}'


def _median(values: Any) -> str:
    return f'median {float(np.median(values)):.3f}' if len(values) else 'unknown'


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.is_file() else []


def parser() -> argparse.ArgumentParser:
    """Parser of the arguments."""
    made = argparse.ArgumentParser(prog='python -m studies.one_objective', description=__doc__)
    what = 'departing or sound random missions, an observed world, or a folder with a bag'
    made.add_argument('group', metavar='GROUP', help=what)
    made.add_argument('-o', '--output', type=Path, required=True, help='results, JSON lines')
    made.add_argument('--seed', type=number(int, 0), default=1, help='of all campaigns')
    made.add_argument('--count', type=number(int, 1), default=20, help='number of campaigns')
    what = 'estimators to run (default: all)'
    made.add_argument('--engines', nargs='+', choices=[*ENGINES], default=[*ENGINES], help=what)
    return made


if __name__ == '__main__':
    sys.exit(main())
