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

from starcal_ground.cli import output
from starcal_ground.cli.arguments import complain, EXIT_ACCEPTED, EXIT_REFUSED, is_interrupt, Time
from starcal_ground.cli.output import check_folder
from starcal_ground.cli.terminal import print_text, progress_bar
from starcal_ground.outputs import make_folder, REPORT_FILE
from starcal_ground.products import (
    NotCalibrated,
    write_not_calibrated,
    write_observations,
    write_products,
)
from starcal_ground.report import thumbnails
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.errors import (
    missing_package,
    NotFromStars,
    OptionError,
    StarcalError,
    TooFewObservations,
)
from starcal_ros.estimation.options import tracker_sigma_is_given
from starcal_ros.formats.bag import reader
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.pipeline import campaign
from starcal_ros.pipeline.provenance import inputs_of, software_version
from starcal_ros.pipeline.setup import files_of, read_setup, read_values
from starcal_ros.pipeline.topics import Topics, without_attitudes
from starcal_ros.records import CameraGeometry, Image, StarObservations


@dataclass
class Selection:
    """
    Selection of the images between two times, both included, queried in the order of the bag.

    None: from the first image, to the last one.
    """

    start: Time | None
    end: Time | None
    _first_ns: int | None = None
    _last_ns: int = 0

    def __call__(self, time_ns: int) -> bool:
        """True if the image of a stamp is taken."""
        if self._first_ns is None:
            self._first_ns = time_ns
        self._last_ns = max(self._last_ns, time_ns)
        is_before = self.start is not None and time_ns < self._ns(self.start)
        return not (is_before or (self.end is not None and time_ns > self._ns(self.end)))

    def without_images(self) -> str:
        """Error message for a selection without images."""
        if self._first_ns is None:
            return '--from, --to: the bag has no images'
        first, last = (utc_text(time_ns) for time_ns in (self._first_ns, self._last_ns))
        return (
            f'--from, --to: no image is between these times: the images span {first} to {last},'
            f' +0 to +{(self._last_ns - self._first_ns) / NANOSECONDS_PER_SECOND:g} s'
        )

    def _ns(self, time: Time) -> int:
        origin_ns = (self._first_ns or 0) if time.since_first_image else 0
        return origin_ns + round(time.seconds * NANOSECONDS_PER_SECOND)


def calibrate(args: argparse.Namespace, asked: Topics) -> int:
    """Calibrate from bags in one process, as the two nodes do on the graph, or from images."""
    with _source(args, asked) as (source, files), _digests(files) as inputs:
        if args.output.exists() and not args.output.is_dir():
            raise OptionError(f'{args.output}: not a folder')
        _tell(source.notes)
        wanted = None
        if args.from_time or args.to_time:
            wanted = Selection(args.from_time, args.to_time)
        made, report = calibrate_into(args.output, source, inputs, wanted, not args.no_report)
    calibration, setup = made.calibration, made.setup
    output.print_calibration(calibration, setup.prior)
    if calibration.has_alignment and not tracker_sigma_is_given(setup.calibration):
        sigma = ', '.join(f'{arcsec:.1f}' for arcsec in calibration.star_tracker_sigma_arcsec)
        print_text(
            f'star tracker    {sigma}" (x, y, z) from the scatter: star_tracker_sigma_arcsec'
            ' is not given'
        )
    print_text(f'products written to {args.output}' + (f'; {report}' if report else ''))
    return EXIT_ACCEPTED if calibration.accepted else EXIT_REFUSED


@contextlib.contextmanager
def _source(
    args: argparse.Namespace, asked: Topics
) -> Iterator[tuple[campaign.Source, Sequence[Path]]]:
    """The source that the arguments name, and its files; that of images lasts for the block."""
    from starcal_ground.images.photographs import image_paths

    photographs = image_paths(args.bags)
    values = read_values(args.params) if args.params else {}
    if photographs or without_attitudes(args.bags, asked, values, args.camera_alone):
        with tempfile.TemporaryDirectory(prefix='starcal_') as folder:
            yield _source_by_stars(args, asked, photographs, Path(folder))
        return
    if args.params is None:
        raise OptionError('--params: needed for a bag with attitudes, unless --camera-alone')
    setup = read_setup(args.params)
    check_folder(args.output, args.bags, (args.params, *files_of(setup.frames).values()))
    with _failure_recorded(args, OptionError):
        source = campaign.source_of(args.bags, setup, asked)
    yield source, (*reader.mcap_files(args.bags), args.params)


def _source_by_stars(
    args: argparse.Namespace, asked: Topics, photographs: list[Path], folder: Path
) -> tuple[campaign.Source, Sequence[Path]]:
    """Photographs, or bags without attitudes: those of their stars are written to a folder."""
    from starcal_ground.images import night_sky  # seldom needed, slow to load

    bags = [] if photographs else args.bags
    files = [] if photographs else reader.mcap_files(bags)
    params = list(filter(None, [args.params]))
    check_folder(args.output, bags, (*photographs, *params))
    values = read_values(args.params) if args.params else {}
    make_folder(args.output)
    with _failure_recorded(args, NotFromStars):
        if photographs:
            chosen, notes = night_sky.photographs_of(
                photographs, args.focal_length_mm, args.pixel_size_um
            )
            _tell(notes)
            files = [photograph.path for photograph in chosen]
            sky = night_sky.from_photographs(chosen, values, folder)
        else:
            sky = night_sky.from_bags(bags, asked, values, folder)
    _tell(sky.notes)
    source = campaign.source_of(sky.bags, sky.setup, sky.topics, sky.through_air)
    return source, (*files, *params)


@contextlib.contextmanager
def _failure_recorded(args: argparse.Namespace, kind: type[StarcalError]) -> Iterator[None]:
    """Write an error of a kind that ends the block to the folder as well."""
    try:
        yield
    except kind as error:
        make_folder(args.output)
        _write_failure(args.output, NotCalibrated(str(error), tuple(map(str, args.bags)), {}))
        raise


@contextlib.contextmanager
def _digests(files: Sequence[Path]) -> Iterator[Callable[[], Mapping[str, str]]]:
    """Digests of input files, which are read during the block; its end stops that at once."""
    with ThreadPoolExecutor(1, 'digests') as thread:
        stopped = threading.Event()
        try:
            yield thread.submit(inputs_of, files, stopped.is_set).result
        finally:
            stopped.set()


def _tell(notes: Sequence[str]) -> None:
    for note in notes:
        print_text(note, file=sys.stderr)


def calibrate_into(
    folder: Path,
    source: campaign.Source,
    inputs: Callable[[], Mapping[str, str]],
    wanted: Selection | None = None,
    with_report: bool = False,
) -> tuple[campaign.Campaign, str]:
    """
    Calibrate and write the products, with or without a report.

    Also returns where the report is, or why there is none.
    """
    album, drawings = thumbnails.Album(source.image_count, source.setup), Drawings()

    def show(image: Image, observed: StarObservations, geometry: CameraGeometry) -> None:
        with drawings.kind('pictures of images'):
            album.show(image, observed, geometry)

    with progress_bar(source.image_count, 'images') as advance:
        observed = campaign.observe(source, wanted, show, advance)
    if wanted is not None and not observed.observations:
        raise OptionError(wanted.without_images())
    make_folder(folder)
    # After all reading: the bag may be the observations.mcap of an earlier run in this folder.
    write_observations(observed.observations, folder, source.setup.frames.camera_frame)
    with ThreadPoolExecutor(1, 'pictures') as thread:
        drawn = thread.submit(album.thumbnails)
        if with_report:
            thread.submit(_load_report)
        made = _calibrated(folder, observed, inputs(), album)
        pictures: Sequence[thumbnails.Thumbnail] = ()
        with drawings.kind('pictures of images'):
            pictures = drawn.result()
        written = thread.submit(_write_all, made, pictures, folder)
        page, report = '', ''
        try:
            if with_report:
                with drawings.kind('report'):
                    page, report = _drawn(made, pictures, folder)
        finally:
            written.result()
            if not page:  # one that is there is of the products that were replaced
                (folder / REPORT_FILE).unlink(missing_ok=True)
    if page:
        from starcal_ground.report.page import with_digests

        # After the products that it is of.
        write_atomically(folder / REPORT_FILE, with_digests(page, folder))
    return made, report


def _calibrated(
    folder: Path,
    observed: campaign.Observed,
    inputs: Mapping[str, str],
    album: thumbnails.Album,
) -> campaign.Campaign:
    """The calibration of observed images; a failure is recorded in the folder."""
    try:
        made = campaign.calibrate(observed, inputs)
    except TooFewObservations as error:
        failure = _failure(str(error), observed)
        _write_failure(folder, failure, album.unmatched)
        raise TooFewObservations(failure.reason) from error
    _tell(made.notes[len(observed.source.notes) :])
    if made.observations is not observed.observations:
        write_observations(made.observations, folder, made.setup.frames.camera_frame)
    return made


def _load_report() -> None:
    """Import the modules of the report and compile its template."""
    with contextlib.suppress(ModuleNotFoundError):
        from starcal_ground.report import page

        page.page_template('report.html')


def _write_all(
    made: campaign.Campaign, pictures: Sequence[thumbnails.Thumbnail], folder: Path
) -> None:
    thumbnails.write_thumbnails(pictures, folder / thumbnails.THUMBNAILS_FOLDER)
    write_products(made.calibration, folder, made.residuals)


def _drawn(
    made: campaign.Campaign, pictures: Sequence[thumbnails.Thumbnail], folder: Path
) -> tuple[str, str]:
    """The report of what is being written, and where it will be; or why there is none."""
    try:
        from starcal_ground.report import page
    except ModuleNotFoundError as error:
        return '', f'no report: {missing_package(error, "report")}'
    ordered = thumbnails.ordered(pictures)
    content = page.Found(made.calibration, made.residuals, made.observations, ordered)
    return page.render(content, folder), f'look at {folder / REPORT_FILE}'


def _failure(words: str, observed: campaign.Observed) -> NotCalibrated:
    """The record of a failure, with the cause for which most images are refused."""
    from starcal_ros.pipeline.diagnosis.bags import of_a_failure, of_refusals, refusals

    source, count = observed.source, len(observed.observations)
    groups = refusals(observed.observations)
    refused = {group.reason: group.count for group in groups}
    is_none_used = sum(refused.values()) == count
    if count and is_none_used:
        words = f'no image of {count} can be used'
    if refused:
        words += f' ({", ".join(f"{reason} {count}" for reason, count in refused.items())})'
    named = tuple(map(str, source.bags))
    cause = of_refusals(groups, count)
    if source.topics.image and is_none_used:
        cause = of_a_failure(source.bags, source.topics, source.setup, groups)
    if cause is None:
        return NotCalibrated(words, named, refused)
    command = 'starcal diagnose' if source.through_air is None else ''
    words = f'{cause.in_a_sentence(command)} {words[0].upper()}{words[1:]}'
    return NotCalibrated(words, named, refused, cause.cause, cause.evidence, cause.mend)


def _write_failure(
    folder: Path, failure: NotCalibrated, pictures: Sequence[thumbnails.Thumbnail] = ()
) -> None:
    """Replace what a folder holds of an earlier calibration by the record of a failure."""
    software = f'starcal {software_version()}'
    write_not_calibrated(dataclasses.replace(failure, software=software), folder)
    thumbnails.write_thumbnails(pictures, folder / thumbnails.THUMBNAILS_FOLDER)
    with Drawings().kind('report'):
        try:
            from starcal_ground.report import page
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
