# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parts that commands share: exit statuses, errors in one line, and common arguments."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
import contextlib
import dataclasses
from datetime import datetime, timezone
import json
import math
from pathlib import Path
import sys
from types import FrameType
from typing import Any, NoReturn, TYPE_CHECKING, TypeVar

from starcal_ground.cli.terminal import print_text, print_wrapped
from starcal_ground.mirror import MIRRORED
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.text import printable

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from starcal_ground.bags.topics import Topics
    from starcal_ground.images.first_setup import Given
    from starcal_ground.images.image_series import FileFacts

Record = TypeVar('Record', bound='DataclassInstance')
EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_INTERRUPTED = 0, 2, 3, 130
BAGS = 'an .mcap file or a bag folder'
_BAGS_OR_IMAGES = 'an .mcap file, a bag folder, or images: files, a folder, or a pattern in quotes'
_TOPICS = ('image', 'attitude', 'velocity', 'temperature', 'observations')


def complain(text: str) -> int:
    """Print an input error on stderr in one line and return the exit status for it."""
    with contextlib.suppress(OSError):  # nobody reads stderr; the exit status remains
        print(f'starcal: {printable(" ".join(text.split()))}', file=sys.stderr, flush=True)
    return EXIT_BAD_INPUT


_interrupts: list[int] = []  # the signals that came


def on_interrupt(number: int, _frame: FrameType | None) -> NoReturn:
    """Handle SIGINT as Python does, and remember it for `is_interrupt`."""
    _interrupts.append(number)
    raise KeyboardInterrupt


def is_interrupt(error: BaseException) -> bool:
    """
    Return True for a Ctrl-C, and for an error that one became.

    A module in C that is interrupted while it is loaded raises ImportError or SystemError.
    """
    return bool(_interrupts) or isinstance(error, KeyboardInterrupt)


def path(text: str) -> Path:
    """Type of an argument that is a path."""
    if not text:
        raise argparse.ArgumentTypeError('empty path')  # Path('') means the current folder
    return Path(text)


def number(
    kind: type[int] | type[float], low: float, high: float = math.inf
) -> Callable[[str], float]:
    """Type of an argument that is a number from ``low`` to ``high``."""

    def read(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:  # nor is NaN
            raise argparse.ArgumentTypeError(f'{text} is not within {low:g} to {high:g}')
        return value

    read.__name__ = kind.__name__  # argparse names it where the text is no number
    return read


def _remap(text: str) -> str:
    if not all(text.partition(':=')[::2]):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form A:=B')
    return text


def add_output(command: argparse.ArgumentParser, metavar: str, what: str, **settings: Any) -> None:
    """Add the option -o."""
    command.add_argument('-o', '--output', type=path, metavar=metavar, help=what, **settings)


def _setting(text: str) -> tuple[str, object]:
    from starcal_ros.untrusted import yaml_value

    name, equals, value = text.partition('=')
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form NAME=VALUE')
    try:
        return name.strip(), yaml_value(value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f'{text!r}: {error}') from error


def add_inputs(command: argparse.ArgumentParser) -> None:
    """Add bags or images, and the options that state what is known of them, for `given`."""
    command.add_argument('bags', type=path, metavar='BAG', nargs='+', help=_BAGS_OR_IMAGES)
    what = 'ROS parameter file: prior camera, mounting and options (default: found or assumed)'
    command.add_argument('--params', type=path, metavar='FILE', help=what)
    what = 'state an option of a parameter file, such as observer=ground; may be repeated'
    command.add_argument(
        '--set', type=_setting, action='append', default=[], metavar='NAME=VALUE', help=what
    )
    what = 'estimate the camera by its stars, without attitudes and alignment, in the bag or not'
    command.add_argument('--camera-alone', action='store_true', help=what)
    what = (
        'focal length of the lens, mm, with --pixel-size-um (default: from EXIF or FITS, else '
        'estimated)'
    )
    positive = number(float, 1e-3, 1e6)
    command.add_argument('--focal-length-mm', type=positive, default=0.0, metavar='MM', help=what)
    what = 'size of a pixel of the images, micrometres'
    command.add_argument('--pixel-size-um', type=positive, default=0.0, metavar='UM', help=what)
    add_file_facts(command)
    add_topics(command)


def add_file_facts(command: argparse.ArgumentParser) -> None:
    """Add the options that state facts of image files, for `file_facts`."""
    what = (
        'middle of the exposure of each image file: CSV with columns file and time_utc (or'
        ' time_tai, time_tdb, time_gps, time_ns)'
    )
    command.add_argument('--times', type=path, metavar='FILE', help=what)
    what = 'the image files are mirrored: mirror them back'
    command.add_argument('--flip', choices=tuple(MIRRORED), default='', help=what)


def file_facts(args: argparse.Namespace) -> FileFacts:
    """Facts that `add_file_facts` asked for; raises IngestError for a bad table of times."""
    from starcal_ground.images.image_series import FileFacts
    from starcal_ground.mission.ingest.mission_records import Guard, read_times

    if not args.times:
        return FileFacts(None, args.flip)
    with Guard() as guard:
        return FileFacts(guard.call(args.times, read_times, args.times), args.flip)


def given(args: argparse.Namespace, **options: object) -> Given:
    """Inputs that `add_inputs` asked for and further options; raises OptionError for bad ones."""
    from starcal_ground.images.first_setup import Given
    from starcal_ground.parameter_files import read_values

    settings = dict(args.set) | options
    values = read_values(args.params) if args.params else {}
    lens = args.focal_length_mm, args.pixel_size_um
    return Given(
        args.bags,
        topics(args),
        values | settings,
        args.params,
        tuple(dict(args.set)),
        args.camera_alone,
        lens,
        file_facts(args),
    )


def add_topics(command: argparse.ArgumentParser) -> None:
    """Add the options that choose topics of a bag, for `topics`."""
    for kind in _TOPICS:
        what = f'{kind} topic (default: the only one of its type in the bag)'
        command.add_argument(f'--{kind}-topic', default='', metavar='T', help=what)


def topics(args: argparse.Namespace) -> Topics:
    """Topics that `add_topics` asked for."""
    from starcal_ground.bags.topics import Topics

    return Topics(**{kind: vars(args)[f'{kind}_topic'] for kind in _TOPICS})


def add_remaps(command: argparse.ArgumentParser, what: str) -> None:
    """Add the option that renames topics."""
    command.add_argument(
        '--remap', type=_remap, action='append', default=[], metavar='A:=B', help=what
    )


def record_of(kind: type[Record], args: argparse.Namespace) -> Record:
    """The record whose fields are the arguments of their names."""
    return kind(**{field.name: vars(args)[field.name] for field in dataclasses.fields(kind)})


def add_json(command: argparse._ActionsContainer) -> None:
    """Add the option for `print_json`."""
    what = 'print one JSON object instead of tables'
    command.add_argument('--json', action='store_true', help=what)


def print_json(record: object) -> None:
    """Print a record as a JSON object."""
    from starcal_ros.record_fields import json_object

    print_text(json.dumps(json_object(record), indent=1, allow_nan=False))


def print_notes(notes: Sequence[str]) -> None:
    """Print what a user should know of a result on stderr."""
    show = print_wrapped if sys.stderr.isatty() else print_text
    for note in notes:
        show(note, file=sys.stderr)


def check_file(output: Path, inputs: Sequence[Path]) -> None:
    """`check_outputs` of one file, which is no product beside an input either."""
    from starcal_ground.products import check_outputs, PRODUCT_FILES

    beside = [file.with_name(name) for file in inputs for name in PRODUCT_FILES]
    check_outputs([output], [*inputs, *beside])


def parse_time(text: str) -> Callable[[int], int]:
    """
    A time as it is typed: UTC in ISO 8601, seconds since 1970, or +seconds since the first image.

    Returns a function that gives it, ns since 1970, from the stamp of the first image.  Raises
    argparse.ArgumentTypeError for another text.
    """
    is_relative = text.strip().startswith('+')
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
        seconds = (read if read.tzinfo else read.replace(tzinfo=timezone.utc)).timestamp()
    if not math.isfinite(seconds):
        raise argparse.ArgumentTypeError(f'{text!r} is not a finite number of seconds')
    after_ns = round(seconds * NANOSECONDS_PER_SECOND)
    return lambda first_ns: after_ns + is_relative * first_ns


@dataclasses.dataclass
class Selection:
    """
    Selection of the images between two times, both included, queried in the order of the bag.

    The times are those of `parse_time`; None: from the first image, to the last one.
    """

    start: Callable[[int], int] | None
    end: Callable[[int], int] | None
    _first_ns: int | None = None
    _last_ns: int = 0

    def __call__(self, time_ns: int) -> bool:
        """True if the image of a stamp is taken."""
        if self._first_ns is None:
            self._first_ns = time_ns
        self._last_ns = max(self._last_ns, time_ns)
        is_before = self.start is not None and time_ns < self.start(self._first_ns)
        return not (is_before or (self.end is not None and time_ns > self.end(self._first_ns)))

    def without_images(self) -> str:
        """Error message for a selection without images."""
        if self._first_ns is None:
            return '--from, --to: the bag has no images'
        first, last = (utc_text(time_ns) for time_ns in (self._first_ns, self._last_ns))
        return (
            f'--from, --to: no image is between these times: the images span {first} to {last},'
            f' +0 to +{(self._last_ns - self._first_ns) / NANOSECONDS_PER_SECOND:g} s'
        )
