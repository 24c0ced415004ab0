# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`starcal calibrate`: bags to products, or to a record of why there are none."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
from dataclasses import dataclass
from pathlib import Path
import sys
import tempfile
import threading

from starcal_ros.assessment import comparison
from starcal_ros.assessment.residuals import Residuals
from starcal_ros.cli import output
from starcal_ros.cli.arguments import complain, EXIT_ACCEPTED, EXIT_REFUSED, is_interrupt
from starcal_ros.cli.commands.selection import Selection, selection
from starcal_ros.cli.output import check_folder
from starcal_ros.cli.terminal import print_text, with_progress
from starcal_ros.errors import (
    missing_package,
    NotFromStars,
    OptionError,
    StarcalError,
    TooFewObservations,
)
from starcal_ros.estimation.calibration_options import tracker_sigma_is_given
from starcal_ros.formats.bag import reader
from starcal_ros.formats.products.product_files import make_folder, REPORT_FILE, write_atomically
from starcal_ros.formats.products.product_folder import (
    NotCalibrated,
    write_not_calibrated,
    write_observations,
    write_products,
)
from starcal_ros.pipeline import inspect, solve
from starcal_ros.pipeline import topics as bag_topics
from starcal_ros.pipeline.provenance import inputs_of, software_version
from starcal_ros.pipeline.setup import files_of, read_setup, read_values, Setup
from starcal_ros.pipeline.topics import measured_again, Topics, Wanted, without_attitudes
from starcal_ros.records import Calibration, CameraGeometry, Image, StarObservations
from starcal_ros.report.pictures import thumbnails

HALVES = ('odd', 'even')
ThroughAir = Callable[[Sequence[StarObservations]], tuple[list[StarObservations], str]]


@dataclass(frozen=True)
class Job:
    """
    Bags to calibrate from, and the folder for the products.

    ``inputs`` gives the digests of the input files; ``through_air`` gives the observations as they
    are solved, and what was found in words, where the attitudes are those of the stars.
    """

    folder: Path
    bags: Sequence[Path]
    asked: Topics
    setup: Setup
    inputs: Callable[[], Mapping[str, str]]
    through_air: ThroughAir | None = None


def calibrate(args: argparse.Namespace, asked: Topics) -> int:
    """Calibrate from bags in one process, as the two nodes do on the graph, or from images."""
    from starcal_ros.formats.images.photographs import image_paths

    photographs = image_paths(args.bags)
    values = read_values(args.params) if args.params else {}
    if photographs or without_attitudes(args.bags, asked, values, args.camera_alone):
        return _calibrate_by_stars(args, asked, photographs)
    if args.params is None:
        raise OptionError('--params: needed for a bag with attitudes, unless --camera-alone')
    setup = read_setup(args.params)
    check_folder(args.output, args.bags, (args.params, *files_of(setup.frames).values()))
    files = (*reader.mcap_files(args.bags), args.params)
    found = ''
    try:
        if not setup.is_aligned:
            from starcal_ros.pipeline.diagnosis.bags import (
                aligned_by_bags,  # seldom needed, slow to load
            )

            setup, found = aligned_by_bags(args.bags, asked, setup)
    except OptionError as error:
        make_folder(args.output)
        _write_failure(args.output, NotCalibrated(str(error), tuple(map(str, args.bags)), {}))
        raise
    if found:
        print_text(found, file=sys.stderr)
    return _calibrate(args, asked, setup, args.bags, files)


def _calibrate_by_stars(args: argparse.Namespace, asked: Topics, photographs: list[Path]) -> int:
    """Calibrate from photographs or bags whose attitudes are those of their stars."""
    from starcal_ros.pipeline import night_sky  # seldom needed, slow to load

    bags = [] if photographs else args.bags
    read = [] if photographs else reader.mcap_files(bags)
    check_folder(args.output, bags, (*photographs, *filter(None, [args.params])))
    values = read_values(args.params) if args.params else {}
    make_folder(args.output)
    with tempfile.TemporaryDirectory(prefix='starcal_') as folder:
        try:
            if photographs:
                chosen, notes = night_sky.photographs_of(
                    photographs, args.focal_length_mm, args.pixel_size_um
                )
                for note in notes:
                    print_text(note, file=sys.stderr)
                read = [one.path for one in chosen]
                found = night_sky.from_photographs(chosen, values, Path(folder))
            else:
                found = night_sky.from_bags(bags, asked, values, Path(folder))
        except NotFromStars as error:
            _write_failure(args.output, NotCalibrated(str(error), tuple(map(str, args.bags)), {}))
            raise
        for note in found.notes:
            print_text(note, file=sys.stderr)
        files = [*read, *filter(None, [args.params])]
        return _calibrate(args, found.topics, found.setup, found.bags, files, found.through_air)


def _calibrate(
    args: argparse.Namespace,
    asked: Topics,
    setup: Setup,
    bags: Sequence[Path],
    files: Sequence[Path],
    through_air: ThroughAir | None = None,
) -> int:
    """Calibrate with a set-up, write the products and print the result."""
    wanted = selection(args.from_time, args.to_time, args.first, args.every)
    if args.output.exists() and not args.output.is_dir():
        raise OptionError(f'{args.output}: not a folder')
    with ThreadPoolExecutor(1, 'digests') as thread:
        # While the images are read; an error or Ctrl-C ends it at once.
        stopped = threading.Event()
        inputs = thread.submit(inputs_of, files, stopped.is_set)
        try:
            job = Job(args.output, bags, asked, setup, inputs.result, through_air)
            calibration, observations, report = calibrate_into(job, wanted, not args.no_report)
        finally:
            stopped.set()
    output.print_calibration(calibration, setup.prior)
    if calibration.has_alignment and not tracker_sigma_is_given(setup.calibration):
        sigma = ', '.join(f'{arcsec:.1f}' for arcsec in calibration.star_tracker_sigma_arcsec)
        print_text(
            f'star tracker    {sigma}" (x, y, z) from the scatter: star_tracker_sigma_arcsec'
            ' is not given'
        )
    print_text(f'products written to {args.output}' + (f'; {report}' if report else ''))
    if args.split_half:
        _split(args.output, observations, setup, inputs.result())
    return EXIT_ACCEPTED if calibration.accepted else EXIT_REFUSED


def calibrate_into(
    job: Job, wanted: Wanted | None = None, with_report: bool = False
) -> tuple[Calibration, list[StarObservations], str]:
    """
    Calibrate from bags and write the products, with or without a report.

    Also returns the observations and where the report is, or why there is none.
    """
    folder, bags, setup = job.folder, job.bags, job.setup
    topics = bag_topics.choose_topics(bags, job.asked, setup)
    count = bag_topics.count(bags, topics)
    album, drawings = thumbnails.Album(count, setup), Drawings()

    def show(image: Image, observed: StarObservations, geometry: CameraGeometry) -> None:
        with drawings.kind('pictures of images'):
            album.show(image, observed, geometry)

    records = bag_topics.read(bags, topics, setup, show, wanted)
    observations = list(with_progress(records, count, 'images'))
    if not observations and isinstance(wanted, Selection):
        raise OptionError(wanted.without_images())
    if job.through_air is not None:
        observations, text = job.through_air(observations)
        if text:
            print_text(text, file=sys.stderr)
    # Each image was identified by itself: what matched nothing does not by the others either.
    again = topics if job.through_air is None else Topics()
    make_folder(folder)
    # After all reading: the bag may be the observations.mcap of an earlier run in this folder.
    write_observations(observations, folder, setup.frames.camera_frame)
    with ThreadPoolExecutor(1, 'pictures') as thread:
        drawn = thread.submit(album.thumbnails)
        if with_report:
            thread.submit(_load_report)
        try:
            calibration, left, observations = _solve_twice(job, again, observations)
        except TooFewObservations as error:
            failure = _failure(str(error), job, observations, bool(topics.image))
            _write_failure(folder, failure, album.unmatched)
            raise TooFewObservations(failure.reason) from error
        pictures: Sequence[thumbnails.Thumbnail] = ()
        with drawings.kind('pictures of images'):
            pictures = drawn.result()
        written = thread.submit(_write_all, calibration, left, pictures, folder)
        page, report = '', ''
        try:
            if with_report:
                with drawings.kind('report'):
                    page, report = _drawn(calibration, left, observations, pictures, folder)
        finally:
            written.result()
            if not page:  # one that is there is of the products that were replaced
                (folder / REPORT_FILE).unlink(missing_ok=True)
    if page:
        from starcal_ros.report.page import with_digests

        # After the products that it is of.
        write_atomically(folder / REPORT_FILE, with_digests(page, folder))
    return calibration, observations, report


def _load_report() -> None:
    """Import the modules of the report and compile its template."""
    with contextlib.suppress(ModuleNotFoundError):
        from starcal_ros.report import page

        page.page_template('report.html')


def _write_all(
    calibration: Calibration,
    left: Residuals,
    pictures: Sequence[thumbnails.Thumbnail],
    folder: Path,
) -> None:
    thumbnails.write_thumbnails(pictures, folder / thumbnails.THUMBNAILS_FOLDER)
    write_products(calibration, folder, left)


def _drawn(
    calibration: Calibration,
    left: Residuals,
    observations: Sequence[StarObservations],
    pictures: Sequence[thumbnails.Thumbnail],
    folder: Path,
) -> tuple[str, str]:
    """The report of what is being written, and where it will be; or why there is none."""
    try:
        from starcal_ros.report import page
    except ModuleNotFoundError as error:
        return '', f'no report: {missing_package(error, "report")}'
    found = page.Found(calibration, left, tuple(observations), thumbnails.ordered(pictures))
    return page.render(found, folder), f'look at {folder / REPORT_FILE}'


def _solve_twice(
    job: Job, topics: Topics, observations: list[StarObservations]
) -> tuple[Calibration, Residuals, list[StarObservations]]:
    """Solve, and once more if that calibration identifies stars in images that matched nothing."""
    calibration, left = _solve(observations, job.setup, job.inputs())
    if not (calibration.accepted and topics.image):
        return calibration, left, observations
    again = measured_again(job.bags, topics, job.setup, calibration.geometry, observations)
    gained = _used(again) - _used(observations)
    if not gained:
        return calibration, left, observations
    print_text(
        f'{gained} images matched nothing at first, and are used with the calibration of the'
        ' others',
        file=sys.stderr,
    )
    write_observations(again, job.folder, job.setup.frames.camera_frame)
    return *_solve(again, job.setup, job.inputs()), again


def _solve(
    observations: Sequence[StarObservations], setup: Setup, inputs: Mapping[str, str]
) -> tuple[Calibration, Residuals]:
    ensemble = solve.ensemble_of(observations, setup)
    return solve.solve_with_residuals(ensemble, setup, inputs=inputs)


def _used(observations: Sequence[StarObservations]) -> int:
    return sum(not record.refusal for record in observations)


def _split(
    folder: Path, observations: Sequence[StarObservations], setup: Setup, inputs: Mapping[str, str]
) -> None:
    """Calibrate each half of the images into a folder of its own, and print their comparison."""
    used = [record for record in observations if not record.refusal]
    made = []
    for k, name in enumerate(HALVES):
        half = folder / name
        make_folder(half)
        write_observations(used[k::2], half, setup.frames.camera_frame)
        calibration, left = _solve(used[k::2], setup, inputs)
        write_products(calibration, half, left)
        made.append(calibration)
    print_text(
        f'\nimages of odd (A) and of even (B) number, in {folder / "odd"} and {folder / "even"}'
    )
    output.print_comparison(comparison.compare(*made))


def _failure(
    words: str, job: Job, observations: Sequence[StarObservations], has_images: bool
) -> NotCalibrated:
    """The record of a failure, with the cause for which most images are refused."""
    from starcal_ros.pipeline.diagnosis.bags import of_a_failure, of_refusals

    groups = inspect.refusals(observations)
    refused = {group.reason: group.count for group in groups}
    if observations and not _used(observations):
        words = f'no image of {len(observations)} can be used'
    if refused:
        words += f' ({", ".join(f"{reason} {count}" for reason, count in refused.items())})'
    named = tuple(map(str, job.bags))
    found = of_refusals(groups, len(observations))
    if has_images and not _used(observations):
        found = of_a_failure(job.bags, job.asked, job.setup, groups)
    if found is None:
        return NotCalibrated(words, named, refused)
    command = 'starcal diagnose' if job.through_air is None else ''
    words = f'{found.in_a_sentence(command)} {words[0].upper()}{words[1:]}'
    return NotCalibrated(words, named, refused, found.cause, found.evidence, found.mend)


def _write_failure(
    folder: Path, failure: NotCalibrated, pictures: Sequence[thumbnails.Thumbnail] = ()
) -> None:
    """Replace what a folder holds of an earlier calibration by the record of a failure."""
    software = f'starcal {software_version()}'
    write_not_calibrated(dataclasses.replace(failure, software=software), folder)
    thumbnails.write_thumbnails(pictures, folder / thumbnails.THUMBNAILS_FOLDER)
    with Drawings().kind('report'):
        try:
            from starcal_ros.report import page
        except ModuleNotFoundError as error:
            missing_package(error, 'report')  # raises where another module is missing
        else:
            page.write_report(folder)


class Drawings:
    """Drawings of one result; one that fails costs a line on stderr, once for each kind."""

    def __init__(self) -> None:
        self._failed: set[str] = set()

    @contextlib.contextmanager
    def kind(self, name: str) -> Iterator[None]:
        """End the block quietly where drawing fails; writing belongs outside of it."""
        try:
            yield
        # Other versions of contourpy, Jinja2 and OpenCV fail in their own ways.
        except Exception as error:
            if is_interrupt(error):
                raise
            if name not in self._failed:
                self._failed.add(name)
                kind = '' if isinstance(error, StarcalError) else f'{type(error).__name__}: '
                complain(f'warning: no {name}, the other results are complete: {kind}{error}')
