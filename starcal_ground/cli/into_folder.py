# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A calibration into a folder: products, pictures and report, or why there are none."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
import contextlib
import dataclasses
import functools
from pathlib import Path
import threading

from starcal_ground import campaign, products, written_files
from starcal_ground.bags import reader
from starcal_ground.cli import arguments
from starcal_ground.cli.terminal import progress_bar
from starcal_ground.planning.plan import with_images_to_reach
from starcal_ground.products import NotCalibrated
from starcal_ground.report import thumbnails
from starcal_ros.constants import software_version
from starcal_ros.errors import missing_package, OptionError, StarcalError, TooFewObservations
from starcal_ros.formats.messages.message_codec import offset_ns
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Image, ORIGINAL, PIXELS_OF, StarObservations


def check_folder(folder: Path, bags: Sequence[Path], files: Sequence[Path]) -> None:
    """
    `check_outputs` of the products of a calibration, which do not become part of a bag either.

    Raises OptionError or ProductError naming the folder or the file.
    """
    bag_files = reader.files_of_bags(bags)
    if products.same_as_one_of(folder, [file.parent for file in bag_files]):
        raise OptionError(f'{folder}: holds the bag that is read; choose another folder (-o)')
    written = [folder / name for name in (*products.PRODUCT_FILES, products.NOT_CALIBRATED_FILE)]
    pictures = thumbnails.thumbnails_in(folder / thumbnails.THUMBNAILS_FOLDER)
    products.check_outputs((*written, *pictures), (*bag_files, *files))


@contextlib.contextmanager
def failure_recorded(
    folder: Path, bags: Sequence[Path], kind: type[StarcalError]
) -> Iterator[None]:
    """Write an error of a kind that ends the block to the folder as well."""
    try:
        yield
    except kind as error:
        products.make_folder(folder)
        look = _write_failure(folder, NotCalibrated(str(error), tuple(map(str, bags)), {}))
        raise type(error)(f'{error}{look}') from error


@contextlib.contextmanager
def digests(files: Sequence[Path]) -> Iterator[Callable[[], Mapping[str, str]]]:
    """Digests of input files, which are read during the block; its end stops that at once."""
    with ThreadPoolExecutor(1, 'digests') as thread:
        stopped = threading.Event()
        try:
            yield thread.submit(products.inputs_of, files, stopped.is_set).result
        finally:
            stopped.set()


def calibrate_into(
    folder: Path,
    source: campaign.Source,
    inputs: Callable[[], Mapping[str, str]],
    selection: arguments.Selection | None = None,
    with_report: bool = False,
) -> tuple[campaign.Campaign, str]:
    """
    Calibrate and write the products, with or without a report.

    Also returns where the report is, or why there is none.
    """
    album, drawings = thumbnails.Album(source.setup), Drawings()

    def show(image: Image, observed: StarObservations, geometry: CameraGeometry) -> None:
        with drawings.kind('pictures of images'):
            album.show(image, observed, geometry)

    with progress_bar(source.image_count, 'images') as advance:
        observed = campaign.observe(source, selection, show, advance)
    if selection is not None and not observed.observations:
        raise OptionError(selection.without_images())
    products.make_folder(folder)
    # After all reading: the bag may be the observations.mcap of an earlier run in this folder.
    origin = _origin_of(source)
    _write_observations(observed.observations, folder, source.setup, origin)
    with ThreadPoolExecutor(1, 'pictures') as thread:
        drawn = thread.submit(album.thumbnails)
        if with_report:
            thread.submit(_load_report)
        made = _calibrated(folder, observed, inputs(), album, origin)
        pictures: tuple[thumbnails.Thumbnail, ...] = ()
        with drawings.kind('pictures of images'):
            again = {
                id(old): new
                for old, new in zip(observed.measured, made.observations, strict=True)
                if new.measured_px is not old.measured_px
            }
            shown = album.thumbnails_again(again, made.calibration.geometry)
            pictures = thumbnails.ordered((*drawn.result(), *shown))
        # The disk is waited for, twice a picture, while the report is drawn.
        places = pictures, folder / thumbnails.THUMBNAILS_FOLDER
        written = thread.submit(thumbnails.write_thumbnails, *places)
        products.write_products(made.calibration, folder, made.residuals)
        page, report, path = '', '', folder / products.REPORT_FILE
        if with_report:
            with drawings.kind('report'):
                page, report = _drawn(made, pictures, folder)
        if page:
            written_files.write_marked(path, page)
        else:  # one that is there is of the products that were replaced
            path.unlink(missing_ok=True)
        written.result()
    return made, report


def _calibrated(
    folder: Path,
    observed: campaign.Observed,
    inputs: Mapping[str, str],
    album: thumbnails.Album,
    origin: Mapping[str, str],
) -> campaign.Campaign:
    """The calibration of observed images; a failure is recorded in the folder."""
    try:
        progress = functools.partial(progress_bar, label='images again')
        made = campaign.calibrate(observed, inputs, progress)
    except TooFewObservations as error:
        from starcal_ground.source_diagnosis import failure_of  # slow, and seldom needed

        failure = failure_of(error, observed)
        if not observed.source.setup.has_tracker:  # its bags are temporary
            failure = dataclasses.replace(failure, inputs=tuple(inputs))
        look = _write_failure(folder, failure, album.unmatched)
        raise TooFewObservations(f'{failure.reason}{look}') from error
    made = with_images_to_reach(made)
    if made.observations is not observed.observations:
        _write_observations(made.observations, folder, made.setup, origin)
    return made


def _origin_of(source: campaign.Source) -> dict[str, str]:
    """Metadata of the observations: files that the bags, and each image, were made from."""
    offset_s = source.setup.attitude.stamp_offset_s if source.topics.image else 0.0
    names = reader.image_files(source.bags, offset_ns(offset_s))
    of_files = {
        key: words
        for key, words in source.setup.origin.items()
        if key == PIXELS_OF or key.startswith(ORIGINAL)
    }
    return of_files | {f'{reader.IMAGE_FILE}{k}': name for k, name in names.items()}


def _write_observations(
    observations: Sequence[StarObservations],
    folder: Path,
    setup: Setup,
    origin: Mapping[str, str],
) -> None:
    frame = setup.frames.camera_frame
    products.write_observations(observations, folder, frame, setup.has_tracker, origin)


def _load_report() -> None:
    """Import the modules of the report and compile its template."""
    with contextlib.suppress(ModuleNotFoundError):
        from starcal_ground.report import page

        page.page_template('report.html')


def _drawn(
    made: campaign.Campaign, pictures: tuple[thumbnails.Thumbnail, ...], folder: Path
) -> tuple[str, str]:
    """The report of the products of a folder, and where it will be; or why there is none."""
    try:
        from starcal_ground.report import page
    except ModuleNotFoundError as error:
        return '', f'no report: {missing_package(error)}'
    content = page.Found(made.calibration, made.residuals, made.observations, pictures)
    return page.render(content, folder), f'look at {folder / products.REPORT_FILE}'


def _write_failure(
    folder: Path, failure: NotCalibrated, pictures: Sequence[thumbnails.Thumbnail] = ()
) -> str:
    """
    Replace what a folder holds of an earlier calibration by the record of a failure.

    Returns where its report is, to append to the error; empty without one.
    """
    software = f'starcal {software_version()}'
    products.write_not_calibrated(dataclasses.replace(failure, software=software), folder)
    thumbnails.write_thumbnails(pictures, folder / thumbnails.THUMBNAILS_FOLDER)
    with Drawings().kind('report'):
        try:
            from starcal_ground.report import page
        except ModuleNotFoundError as error:
            missing_package(error)  # raises where another module is missing
        else:
            return f'; look at {page.write_report(folder)}'
    return ''


class Drawings:
    """Drawings of one result; one that fails costs a line on stderr, once for each kind."""

    def __init__(self) -> None:
        self._failed: set[str] = set()

    @contextlib.contextmanager
    def kind(self, name: str) -> Iterator[None]:
        """End the block quietly where drawing fails; writing belongs outside of it."""
        try:
            yield
        # Other versions of Jinja2 and OpenCV fail in their own ways.
        except Exception as error:
            if arguments.is_interrupt(error):
                raise
            if name not in self._failed:
                self._failed.add(name)
                kind = '' if isinstance(error, StarcalError) else f'{type(error).__name__}: '
                arguments.complain(
                    f'warning: no {name}, the other results are complete: {kind}{error}'
                )
