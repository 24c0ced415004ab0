# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Commands for missions: export, import and trend."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
import dataclasses
import glob
import math
from pathlib import Path

from starcal_ros.cli.arguments import complain, EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED
from starcal_ros.cli.folders import make_folder
from starcal_ros.cli.terminal import print_text, progress_bar
from starcal_ros.errors import OptionError

_FAILURES_SHOWN = 5


def _export(args: argparse.Namespace) -> int:
    """Write a calibration in the format of another tool."""
    from starcal_ros.export.formats import export
    from starcal_ros.export.spice import SpiceNames
    from starcal_ros.products.calibration_json import read_calibration
    from starcal_ros.products.folder import calibration_file

    calibration = read_calibration(calibration_file(args.calibration))
    names = None
    if args.spacecraft_id is not None:
        names = SpiceNames(
            args.spacecraft_id,
            args.instrument_id,
            args.star_tracker_id,
            args.camera_frame,
            args.star_tracker_frame,
            args.pixel_size_um,
        )
    make_folder(args.output)
    done = export(calibration, args.to, args.output, names, args.image_topic)
    print_text(f'written: {", ".join(map(str, done.files))}')
    if not calibration.accepted:
        complain(f'warning: the gate refused this calibration: {"; ".join(calibration.reasons)}')
    if not math.isfinite(done.worst_px):
        print_text('the format cannot see the whole detector: use spice, opencv or csv')
    else:
        print_text(f'largest error of a pixel against the calibration: {done.worst_px:.3g} px')
    for loss in done.losses:
        print_text(f'left out: {loss.part}, {loss.cost_px:.3g} px alone')
    return EXIT_ACCEPTED


def _import(args: argparse.Namespace) -> int:
    """Make a bag from the files of a mission."""
    from starcal_ros.ingest import recording, sources, tables
    from starcal_ros.ingest.guard import Guard
    from starcal_ros.ingest.images import ImageOptions

    options = ImageOptions(
        time_key=args.time_key,
        hdu=args.hdu,
        channel=args.channel,
        bayer=args.bayer,
        value_range=None if args.value_range is None else tuple(args.value_range),
        temperature_key=args.temperature_key,
    )
    paths = _expanded(args.images)
    inputs = [args.times, args.camera, *args.attitude, *(args.velocity or ())]
    recording.check_place(args.output, [*paths, *filter(None, inputs)], args.camera)
    with Guard() as guard, progress_bar(2 * len(paths), 'images') as advance:
        if args.times:
            times = guard.call(args.times, tables.read_times, args.times)
            options = dataclasses.replace(options, times=times)
        files, problems = recording.look_at_all(paths, options, guard, advance)
        for problem in problems:
            complain(problem)
        if problems:
            return EXIT_BAD_INPUT
        stamps = [file.time_ns for file in files]
        attitudes = guard.call(
            _names(args.attitude), sources.attitudes, args.attitude, args.star_tracker, stamps
        )
        velocities = args.velocity and guard.call(
            _names(args.velocity), sources.velocities, args.velocity, args.spacecraft, stamps
        )
        prior = args.camera and recording.Prior(args.camera, tuple(args.alignment))
        made = recording.write_bag(
            args.output, files, options, guard, attitudes, velocities, prior, advance
        )
    print_text(f'bag {made.bag}: {len(files)} images')
    for note in made.notes:
        print_text(f'note: {note}')
    if made.params:
        print_text(f'calibrate with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return EXIT_ACCEPTED


def _names(paths: Sequence[Path]) -> str:
    return ', '.join(map(str, paths))


def _expanded(patterns: Sequence[str]) -> list[Path]:
    """Files of patterns, each once, in order of their names."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        names = sorted(glob.glob(pattern)) if glob.has_magic(pattern) else [pattern]
        if not names:
            raise OptionError(f'--images: no file matches {pattern}')
        found |= dict.fromkeys(map(Path, names))
    return list(found)


def _trend(args: argparse.Namespace) -> int:
    """Follow calibrations over years."""
    from starcal_ros.trend import fleet, page, tasks
    from starcal_ros.trend.table import Table

    if not args.root.is_dir():
        raise OptionError(f'{args.root}: no such folder')
    if not 0 <= args.workers <= 1024:
        raise OptionError(f'--workers: {args.workers} is not within 0 to 1024')
    make_folder(args.output)
    table = Table(args.output)
    found = list(tasks.find(args.root, args.params))
    # A file that was repaired or removed is no longer among the tasks.
    table.forget_failed(() if args.retry else {task.key for task in found})
    if not found:
        raise OptionError(
            f'{args.root}: no calibration.json below it, and no bag to calibrate with --params'
        )
    with progress_bar(len(found), 'calibrations') as advance:
        done = fleet.update(table, found, args.workers, args.scheduler, advance)
    rows = table.rows()
    path = page.write_page(rows, args.output, str(args.root))
    copies = f', {done.repeated} the same as another' if done.repeated else ''
    print_text(f'{done.computed} new, {done.known} known before, {done.failed} failed{copies}')
    for row in [row for row in rows if row.error][:_FAILURES_SHOWN]:
        print_text(f'failed: {row.path}: {row.error}')
    print_text(f'{page.span_years(rows):.2f} years; look at {path}')
    return EXIT_ACCEPTED if any(not row.error for row in rows) else EXIT_REFUSED


COMMANDS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    'export': _export,
    'import': _import,
    'trend': _trend,
}
