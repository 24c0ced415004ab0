# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
``python -m studies STUDY -o DIR``: Monte Carlo studies of calibrations with known truth.

``paper`` instead simulates the night of the paper and compares the results with its figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
import dataclasses
import functools
import json
from pathlib import Path
import sys
import time
from typing import TypeVar

from starcal_ground.cli import terminal
from starcal_ground.cli.arguments import number
from starcal_ground.products import make_folder
from starcal_ground.simulation.scenario import scenario
from starcal_ground.written_files import write_marked
from starcal_ros.constants import software_version
from starcal_ros.errors import OptionError, StarcalError
from starcal_ros.estimation.problem import METHODS
from studies import monte_carlo, paper
from studies.monte_carlo import Design, Row
from studies.workers import processors, run_each

NAMES = (*monte_carlo.STUDIES, 'paper')
Value = TypeVar('Value')


def main(argv: Sequence[str] | None = None) -> int:
    """Run a study; returns the exit status: 2 for bad input, 130 when interrupted."""
    args = parser().parse_args(argv)
    try:
        if args.study == 'paper':
            _paper(args)
        else:
            _monte_carlo(args)
    except StarcalError as error:
        print(f'studies: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('studies: interrupted', file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """Parser of the arguments."""
    made = argparse.ArgumentParser(
        prog='python -m studies', description='Monte Carlo studies, and the night of the paper.'
    )
    what = '; '.join(f'{name}: {title}' for name, (title, _) in monte_carlo.STUDIES.items())
    what += '; paper: its night from pixels, with its figures and Table 1'
    made.add_argument('study', metavar='STUDY', choices=NAMES, help=what)
    what = 'folder for STUDY.json, or for paper.md with its figures'
    made.add_argument('-o', '--output', type=Path, metavar='DIR', required=True, help=what)
    what = 'number of trials (default: depends on the study)'
    made.add_argument('--trials', type=number(int, 1, 10**6), metavar='N', help=what)
    what = 'seed of all trials (default: 1)'
    made.add_argument('--seed', type=number(int, 0), default=1, metavar='S', help=what)
    arcsec = number(float, 0, 3600)
    for name, kind, metavar, what in (
        ('images', number(int, 2, 1000), 'M', 'numbers of images; paper: frames of the night'),
        ('stars', number(int, 3, 1000), 'N', 'numbers of stars in an image'),
        ('tracker', arcsec, 'ARCSEC', 'true star tracker sigmas about each axis, arcsec'),
    ):
        made.add_argument(f'--{name}', type=kind, nargs='+', metavar=metavar, help=what)
    what = f'methods to compare: {", ".join(METHODS)}'
    made.add_argument('--methods', nargs='+', choices=METHODS, metavar='METHOD', help=what)
    what = 'star tracker sigma that the calibration assumes, arcsec (default: the true one)'
    made.add_argument('--tracker-assumed', type=arcsec, metavar='ARCSEC', help=what)
    what = 'worker processes; 0 runs in-process (default: one per CPU)'
    count = number(int, 0, 1024)
    made.add_argument('--workers', type=count, default=processors(), metavar='N', help=what)
    return made


def _monte_carlo(args: argparse.Namespace) -> None:
    """Run a Monte Carlo study."""
    title, default = monte_carlo.STUDIES[args.study]
    design = dataclasses.replace(
        default,
        trials=default.trials if args.trials is None else args.trials,
        seed=args.seed,
        images=_each(args.images or default.images),
        stars=_each(args.stars or default.stars),
        tracker_arcsec=_each(args.tracker or default.tracker_arcsec),
        methods=_each(args.methods or default.methods),
        assumed_arcsec=args.tracker_assumed,
    )
    start_s = time.monotonic()
    result = monte_carlo.conclude(design, _rows(design, args))
    path = args.output / f'{design.study}.json'
    write_marked(path, monte_carlo.content(result, _software()))
    print(
        f'{design.study}: {title}; {design.trials} trials, seed {design.seed},'
        f' {time.monotonic() - start_s:.1f} s'
    )
    terminal.print_table(*monte_carlo.table(result), left=0)
    print(f'written to {path}')


def _rows(design: Design, args: argparse.Namespace) -> list[Row]:
    """Rows of all trials of a design."""
    make_folder(args.output)
    trial = functools.partial(monte_carlo.run_trial, design)
    with terminal.progress_bar(design.trials, 'trials') as advance:
        rows = run_each(trial, range(design.trials), args.workers, lambda _: advance())
    return [row for of_trial in rows for row in of_trial]


def _each(values: Iterable[Value]) -> tuple[Value, ...]:
    """Different values in their order."""
    return tuple(dict.fromkeys(values))


def _paper(args: argparse.Namespace) -> None:
    """Reproduce the paper."""
    trials = paper.TABLE_1.trials if args.trials is None else args.trials
    table1 = dataclasses.replace(paper.TABLE_1, seed=args.seed, trials=trials)
    night = scenario(paper.NIGHT, args.seed).image_count
    if args.images and (len(args.images) > 1 or not 6 <= args.images[0] <= night):
        raise OptionError(f'--images: {args.images} is not one number of 6 to {night}')
    images = args.images[0] if args.images else night
    make_folder(args.output / 'images')
    frame = functools.partial(paper.observe_frame_of, args.seed, images)
    with terminal.progress_bar(images, 'frames') as advance:
        observations = run_each(frame, range(images), args.workers, lambda _: advance())
    result = paper.study(
        observations, monte_carlo.conclude(table1, _rows(table1, args)), args.seed
    )
    for name, svg in paper.svgs(result).items():
        write_marked(args.output / 'images' / f'paper_{name}.svg', svg)
    path = args.output / 'paper.md'
    write_marked(path, paper.page(result, _software()))
    content = {'software': _software(), **paper.numbers(result)}
    write_marked(path.with_suffix('.json'), json.dumps(content, indent=1) + '\n')
    print(f'written to {path}, with figures in {args.output / "images"}')


def _software() -> str:
    return f'starcal {software_version()}'


if __name__ == '__main__':
    sys.exit(main())
