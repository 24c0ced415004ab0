# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Commands for missions: export, import and trend."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
import contextlib
import dataclasses
import glob
import math
from pathlib import Path
from typing import TYPE_CHECKING

from starcal_ground.cli.arguments import complain, EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED
from starcal_ground.cli.terminal import print_text, progress_bar
from starcal_ground.outputs import check_outputs, make_folder
from starcal_ros.errors import OptionError
from starcal_ros.text import significant

if TYPE_CHECKING:
    from starcal_ros.records import StarObservations

_FAILURES_SHOWN = 5


def _export(args: argparse.Namespace) -> int:
    """Write a calibration in the format of another tool."""
    from starcal_ground.mission.export.export_formats import export
    from starcal_ground.mission.export.spice import SpiceNames
    from starcal_ground.products import OBSERVATIONS_TOPIC
    from starcal_ros.formats.bag.reader import read_observations
    from starcal_ros.formats.products.product_files import calibration_file, read_calibration

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
    observations: Iterable[StarObservations] = ()
    if args.to == 'ck':
        observations = read_observations([_observations_of(args.calibration)], OBSERVATIONS_TOPIC)
    done = export(
        *(calibration, args.to, args.output, names, args.image_topic, args.table),
        *(observations, args.kernels),
    )
    print_text(f'written: {", ".join(map(str, done.files))}')
    if not calibration.accepted:
        complain(f'warning: the gate refused this calibration: {"; ".join(calibration.reasons)}')
    if not math.isfinite(done.worst_px):
        print_text('the format cannot see the whole detector: use spice, opencv or csv')
    else:
        print_text(
            f'largest error of a pixel against the calibration: {significant(done.worst_px, 3)} px'
        )
    for loss in done.losses:
        print_text(f'left out: {loss.part}, {significant(loss.cost_px, 3)} px alone')
    return EXIT_ACCEPTED


def _observations_of(calibration: Path) -> Path:
    from starcal_ground.outputs import OBSERVATIONS_FILE
    from starcal_ros.formats.products.product_files import calibration_file

    path = calibration_file(calibration).with_name(OBSERVATIONS_FILE)
    if not path.exists():
        raise OptionError(f'--to ck: needs {path} with the stars of the images')
    return path


def _import(args: argparse.Namespace) -> int:
    """Make a bag from the files of a mission."""
    from starcal_ground.images.image_series import ImageOptions
    from starcal_ground.mission.ingest import recording, sources, tables
    from starcal_ground.mission.ingest.guard import Guard

    options = ImageOptions(
        time_key=args.time_key,
        hdu=args.hdu,
        channel=args.channel,
        bayer=args.bayer,
        value_range=None if args.value_range is None else tuple(args.value_range),
        temperature_key=args.temperature_key,
    )
    needed = 4 * (1 + len(args.more_star_trackers))
    given = len(args.alignment)
    if args.camera and given != needed and (given or args.more_star_trackers):
        raise OptionError(
            f'--alignment: {given} numbers, {needed} are needed: x y z w for each star tracker;'
            ' only that of a single one is found from the images'
        )
    paths, solved = _expanded(args.images), _expanded(args.attitude, '--attitude')
    inputs = [args.times, args.camera, *solved, *(args.velocity or ())]
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
        attitudes, *others = (
            guard.call(_names(solved), sources.attitudes, solved, frame, stamps, files)
            for frame in (args.star_tracker, *args.more_star_trackers)
        )
        further = dict(
            zip(map(recording.frame_name, args.more_star_trackers), others, strict=True)
        )
        velocities = args.velocity and guard.call(
            _names(args.velocity), sources.velocities, args.velocity, args.spacecraft, stamps
        )
        prior = args.camera and recording.Prior(args.camera, tuple(args.alignment) or (0.0,) * 4)
        made = recording.write_bag(
            args.output, files, options, guard, attitudes, velocities, prior, advance, further
        )
    print_text(f'bag {made.bag}: {len(files)} images')
    for note in made.notes:
        print_text(f'note: {note}')
    if made.params:
        print_text(f'calibrate with: starcal calibrate {made.bag} --params {made.params} -o DIR')
    return EXIT_ACCEPTED


def _names(paths: Sequence[Path]) -> str:
    return ', '.join(map(str, paths))


def _expanded(patterns: Sequence[str], option: str = '--images') -> list[Path]:
    """Files of patterns, each once, in order of their names."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        names = sorted(glob.glob(pattern)) if glob.has_magic(pattern) else [pattern]
        if not names:
            raise OptionError(f'{option}: no file matches {pattern}')
        found |= dict.fromkeys(map(Path, names))
    return list(found)


def _catalog(args: argparse.Namespace) -> int:
    """Make a catalog file from a table of Gaia."""
    from starcal_ground.mission.ingest.gaia_catalog import refusals, write_deep_catalog

    output = args.output if args.output.suffix == '.npz' else Path(f'{args.output}.npz')
    check_outputs([output], [args.table])
    made = write_deep_catalog(args.table, output)
    print_text(
        f'{made.added} stars of {args.table} to V = {made.faintest:.1f}, with the bundled ones'
        f' {len(made.columns["id"])}, written to {output}'
    )
    if made.refused:
        print_text(refusals(made.refused))
    print_text(
        f'in the parameter file: catalog: {output.absolute()}, magnitude_limit:'
        f' {made.faintest:.1f}'
    )
    return EXIT_ACCEPTED


def _trend(args: argparse.Namespace) -> int:
    """Follow calibrations over years."""
    from starcal_ground.mission.trend import fleet, places, trend_page
    from starcal_ground.mission.trend.fleet import find, read_cameras, Task
    from starcal_ground.mission.trend.trend_table import Table

    root, cameras = places.absolute(args.root), read_cameras(args.cameras, args.params)
    if places.is_remote(args.output):
        raise OptionError(f'-o: {args.output}: results are written to a local folder, no URL')
    with _reading(args.root):
        if not places.exists(root):
            raise OptionError(f'{args.root}: no such folder')

    def tasks() -> Iterator[Task]:
        with _reading(args.root):
            yield from find(root, cameras)

    folder = Path(places.absolute(args.output))
    make_folder(folder)
    check_outputs([folder / trend_page.TREND_FILE])
    table = Table(folder)
    with progress_bar(None, 'calibrations') as advance:
        done = fleet.update(table, tasks(), args.workers, args.scheduler, advance)
    if done == fleet.Done():
        raise OptionError(
            f'{args.root}: no calibration.json below it, and no bag to calibrate with --params'
        )
    page = trend_page.write_page(table.cameras(), len(table.names()), folder, args.root)
    print_text(f'{done.computed} new, {done.known} known, {done.failed} failed')
    for row in page.failures[:_FAILURES_SHOWN]:
        print_text(f'failed: {row.path}: {row.error}')
    if args.parquet:
        print_text(f'written to {table.write_parquet()}')
    print_text(f'{page.years:.2f} years; look at {page.path}')
    if done.silent == fleet.MOST_SILENT:
        complain(
            f'{args.root}: no answer for {done.silent} files; run again when the store answers:'
            ' the others are left for that run'
        )
        return EXIT_REFUSED
    return EXIT_ACCEPTED if page.calibrations else EXIT_REFUSED


@contextlib.contextmanager
def _reading(root: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OptionError(f'{root}: cannot be read: {error.strerror or error}') from error


COMMANDS: Mapping[str, Callable[[argparse.Namespace], int]] = {
    'export': _export,
    'import': _import,
    'catalog': _catalog,
    'trend': _trend,
}
