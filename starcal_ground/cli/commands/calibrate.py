# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calibrate from bags, without a ROS graph.

Measures the stars of all images, estimates camera and alignment, checks the result against the
limits of the gate and writes report.html, calibration.json, camera_info.yaml and observations.mcap
to DIR. Images without attitudes give the camera alone: their attitudes are found from the stars.

  # the bag in the repository
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out
  # photographs of the night sky alone
  starcal calibrate 'night/*.jpg' -o out
  # the images of the first 30 s
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out --to +30
  # one of several cameras, from two bags together
  starcal calibrate night1 night2.mcap --params camera1.yaml -o out --image-topic /camera1/image
  # repeat from the recorded observations, with other options and without images
  starcal calibrate out/observations.mcap --params bags/tiny/params.yaml -o again
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
import contextlib
from dataclasses import dataclass
from datetime import datetime, timezone
import math
from pathlib import Path
import tempfile
from typing import TYPE_CHECKING

from starcal_ground.cli import arguments
from starcal_ground.cli.terminal import print_table, print_text, print_verdict
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.errors import NotFromStars, OptionError
from starcal_ros.text import significant

if TYPE_CHECKING:
    from starcal_ros.pipeline.campaign import Source
    from starcal_ros.records import Calibration, CameraGeometry


def add_arguments(command: argparse.ArgumentParser) -> None:
    arguments.add_bags(command, arguments.BAGS_OR_IMAGES)
    what = 'ROS parameter file: prior camera, mounting and options; images need none'
    arguments.add_params(command, what)
    arguments.add_output(
        command, 'DIR', 'folder for the products, created if absent', required=True
    )
    what = 'write no report; starcal report DIR writes it later'
    command.add_argument('--no-report', action='store_true', help=what)
    arguments.add_camera_alone(command)
    arguments.add_lens(command)
    arguments.add_topics(command)
    when = 'UTC in ISO 8601, seconds since 1970, or +seconds after the first image'
    for name, what in (('from', f'use images from T on: {when}'), ('to', 'use images up to T')):
        command.add_argument(
            f'--{name}', dest=f'{name}_time', type=parse_time, metavar='T', help=what
        )


def run(args: argparse.Namespace) -> int:
    from starcal_ground.cli import into_folder
    from starcal_ros.estimation.options import tracker_sigma_is_given

    with _source(args) as (source, files), into_folder.digests(files) as inputs:
        if args.output.exists() and not args.output.is_dir():
            raise OptionError(f'{args.output}: not a folder')
        arguments.print_notes(source.notes)
        selection = None
        if args.from_time or args.to_time:
            selection = Selection(args.from_time, args.to_time)
        made, report = into_folder.calibrate_into(
            args.output, source, inputs, selection, not args.no_report
        )
    calibration, setup = made.calibration, made.setup
    print_calibration(calibration, setup.prior)
    if calibration.has_alignment and not tracker_sigma_is_given(setup.calibration):
        sigma = ', '.join(f'{arcsec:.1f}' for arcsec in calibration.star_tracker_sigma_arcsec)
        print_text(
            f'star tracker    {sigma}" (x, y, z) from the scatter: star_tracker_sigma_arcsec'
            ' is not given'
        )
    print_text(f'products written to {args.output}' + (f'; {report}' if report else ''))
    return arguments.EXIT_ACCEPTED if calibration.accepted else arguments.EXIT_REFUSED


@contextlib.contextmanager
def _source(args: argparse.Namespace) -> Iterator[tuple[Source, Sequence[Path]]]:
    """The source that the arguments name, and its files; that of images lasts for the block."""
    from starcal_ground.cli.into_folder import check_folder, failure_recorded
    from starcal_ground.images.photographs import image_paths
    from starcal_ros.formats.bag import reader
    from starcal_ros.pipeline.campaign import source_of
    from starcal_ros.pipeline.setup import files_of, read_setup, read_values
    from starcal_ros.pipeline.topics import without_attitudes

    photographs, topics = image_paths(args.bags), arguments.topics(args)
    values = read_values(args.params) if args.params else {}
    if photographs or without_attitudes(args.bags, topics, values, args.camera_alone):
        with tempfile.TemporaryDirectory(prefix='starcal_') as folder:
            yield _source_by_stars(args, values, photographs, Path(folder))
        return
    if args.params is None:
        raise OptionError('--params: needed for a bag with attitudes, unless --camera-alone')
    setup = read_setup(args.params)
    check_folder(args.output, args.bags, (args.params, *files_of(setup.frames).values()))
    with failure_recorded(args.output, args.bags, OptionError):
        source = source_of(args.bags, setup, topics)
    yield source, (*reader.mcap_files(args.bags), args.params)


def _source_by_stars(
    args: argparse.Namespace, values: Mapping[str, object], photographs: list[Path], folder: Path
) -> tuple[Source, Sequence[Path]]:
    """Photographs, or bags without attitudes: those of their stars are written to a folder."""
    from starcal_ground.cli.into_folder import check_folder, failure_recorded
    from starcal_ground.images import night_sky
    from starcal_ground.outputs import make_folder
    from starcal_ros.pipeline.campaign import source_of

    params = list(filter(None, [args.params]))
    check_folder(args.output, [] if photographs else args.bags, (*photographs, *params))
    make_folder(args.output)
    lens = args.focal_length_mm, args.pixel_size_um
    with failure_recorded(args.output, args.bags, NotFromStars):
        sky, files = night_sky.from_images(
            args.bags, arguments.topics(args), values, folder, lens, arguments.print_notes
        )
    arguments.print_notes(sky.notes)
    return source_of(sky.bags, sky.setup, sky.topics, sky.through_air), (*files, *params)


@dataclass(frozen=True)
class Time:
    """Value of a time option: ``seconds`` since 1970 UTC, or since the first image of the bag."""

    seconds: float
    since_first_image: bool


def parse_time(text: str) -> Time:
    """
    A time as it is typed: UTC in ISO 8601, seconds since 1970, or +seconds since the first image.

    Raises argparse.ArgumentTypeError for another text.
    """
    try:
        seconds = float(text)
    except ValueError:
        try:
            read = datetime.fromisoformat(text.strip().replace('Z', '+00:00'))
        except ValueError as error:
            raise argparse.ArgumentTypeError(
                f'{text!r} is not a time: give 2026-05-15T07:20:00, seconds since 1970, or'
                ' +seconds after the first image'
            ) from error
        with_zone = read if read.tzinfo else read.replace(tzinfo=timezone.utc)
        return Time(with_zone.timestamp(), False)
    if not math.isfinite(seconds):
        raise argparse.ArgumentTypeError(f'{text!r} is not a finite number of seconds')
    return Time(seconds, text.strip().startswith('+'))


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


def print_calibration(calibration: Calibration, prior: CameraGeometry) -> None:
    """Print parameters, statistics and verdict; changes are relative to the prior."""
    import numpy as np

    from starcal_ground.report import verdict

    rows = verdict.parameter_rows(calibration, prior)
    angles = verdict.alignment_rows(calibration, prior)
    print_table(
        ('parameter', 'value', 'unit', '1-sigma', 'from prior', 'in sigmas'),
        [
            (f'{kind}{row.name}', row.value, row.unit, row.sigma, row.change, row.change_sigmas)
            for kind, of_kind in (('', rows), ('alignment ', angles))
            for row in of_kind
        ],
    )
    _print_budget(calibration)
    quaternion = calibration.geometry.star_tracker_from_camera_xyzw
    aligned = np.array2string(quaternion, precision=9, separator=', ')
    if not calibration.has_alignment:
        aligned = 'none: attitudes from the stars, the camera alone'
    refused = ', '.join(f'{n} {reason}' for reason, n in calibration.images_refused.items())
    print_text(f'alignment xyzw  {aligned}')
    print_text(f'images          {calibration.images_used} used, refused: {refused or "none"}')
    print_text(
        f'stars           {calibration.stars_used} used, {calibration.stars_rejected} rejected'
    )
    print_text(f'residual        {calibration.residual_rms_px:.4f} px rms per axis')
    print_text(f'method          {calibration.method}')
    print_text(f'solver          {calibration.iterations} iterations, {calibration.termination}')
    if calibration.temperature is not None:
        print_text(f'temperature     {verdict.thermal_summary(calibration.temperature)}')
    for tracker in calibration.star_trackers:
        print_text(f'star tracker    {verdict.alignment_summary(tracker)}')
    if calibration.accepted:
        print_verdict(True, 'verdict         accepted')
    else:
        print_verdict(False, f'verdict         refused: {"; ".join(calibration.reasons)}')
    for statement in calibration.statements[:1]:
        print_text(f'lower sigma     {statement}')


def _print_budget(calibration: Calibration) -> None:
    from starcal_ros.records import parts_that_matter

    parts = parts_that_matter(calibration.sigma_budget)
    columns = 4 if calibration.has_alignment else 3
    rows = [
        (
            part.cause,
            part.assumption,
            *(
                f'{significant(one, 3, least=0.001)}"'
                for one in (part.map_arcsec, part.pointing_arcsec)
            ),
        )
        for part in parts
    ]
    if rows:
        header = ('1-sigma of lines of sight', '', 'camera alone', 'with alignment')
        print_table(header[:columns], [row[:columns] for row in rows], left=2)
