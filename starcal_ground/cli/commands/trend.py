# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Follow calibrations over years.

Adds every calibration.json and state folder under ROOT to a table in DIR, one SQLite file. With
--params it calibrates bags too. Writes trend.html: each parameter, boresight and alignment over
time, steps and drifts with p-values, and the change that a recalibration would have made; prints
the verdicts.

  # all calibrations of a mission; another run adds only new ones
  starcal trend mission -o trend
  # a thousand bags on two processes
  starcal trend fleet -o trend --params camera.yaml --workers 2
  # on a Dask cluster with access to the same files
  starcal trend /data/fleet -o trend --params camera.yaml --scheduler tcp://host:8786
"""

from __future__ import annotations

import argparse
from pathlib import Path

from starcal_ground.cli import arguments, terminal
from starcal_ros.errors import errors_as, OptionError

_SHOWN = 5  # failures, and cameras: the page has all


def add_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    what = 'folder tree with calibrations and bags, or its URL, e.g. s3://bucket/fleet'
    add('root', metavar='ROOT', help=what)
    what = 'folder for trend.html and the table trend.sqlite'
    add('-o', '--output', required=True, metavar='DIR', help=what)
    what = (
        'ROS parameter file for bags without a calibration beside them; {spacecraft} and {camera} '
        'in its path are replaced'
    )
    add('--params', default='', metavar='FILE', help=what)
    what = "pattern with the names of spacecraft and cameras, e.g. '{spacecraft}/{camera}/*.mcap'"
    add('--cameras', default='', metavar='PATTERN', help=what)
    where = command.add_mutually_exclusive_group()
    what = 'worker processes (default: 0, in-process)'
    where.add_argument(
        '--workers', type=arguments.number(int, 0, 1024), default=0, metavar='N', help=what
    )
    what = 'address of a Dask scheduler, e.g. tcp://host:8786'
    where.add_argument('--scheduler', default='', metavar='ADDRESS', help=what)


def run(args: argparse.Namespace) -> int:
    from starcal_ground.mission.trend import fleet, trend_page, trend_table
    from starcal_ground.products import check_outputs, make_folder

    root, cameras = fleet.absolute(args.root), fleet.Cameras(args.cameras, args.params)
    if fleet.is_remote(args.output):
        raise OptionError(f'-o: {args.output}: results are written to a local folder, no URL')
    with errors_as(OptionError, args.root):
        if not fleet.exists(root):
            raise OptionError(f'{args.root}: no such folder')
    folder = Path(fleet.absolute(args.output))
    make_folder(folder)
    check_outputs([folder / trend_page.TREND_FILE])
    table = trend_table.Table(folder)
    with terminal.progress_bar(None, 'calibrations') as advance, errors_as(OptionError, args.root):
        found = fleet.find(root, cameras)
        done = fleet.update(table, found, args.workers, args.scheduler, advance, root)
    if done == fleet.Done():
        raise OptionError(
            f'{args.root}: no calibration.json below it, and no bag to calibrate with --params'
        )
    page = trend_page.write_page(table.cameras(), len(table.names()), folder, args.root)
    terminal.print_text(f'{done.computed} new, {done.known} known, {done.failed} failed')
    failures = [*done.unreachable, *(f'{row.path}: {row.error}' for row in page.failures)]
    for failure in failures[:_SHOWN]:
        terminal.print_text(f'failed: {failure}')
    for verdict in page.verdicts[:_SHOWN]:
        words = f'{verdict.name}: {verdict.word}. {" ".join(verdict.sentences)}'
        terminal.print_wrapped(words)
    terminal.print_text(f'calibrations: {page.calibrations}; look at {page.path}')
    return arguments.EXIT_ACCEPTED if page.calibrations else arguments.EXIT_REFUSED
