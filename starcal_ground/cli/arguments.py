# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Command-line arguments of the `starcal` tool: commands, their options, and examples of each."""

from __future__ import annotations

import argparse
from collections.abc import Callable
import contextlib
from dataclasses import dataclass
from datetime import datetime, timezone
import difflib
import math
from pathlib import Path
import re
import shutil
import sys
import textwrap
from types import FrameType
from typing import Any, NoReturn

from starcal_ground.cli.command_help import HELP
from starcal_ros.text import printable

EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_INTERRUPTED = 0, 2, 3, 130

_EXIT_STATUS = """\
exit status: 0 the command succeeded, and a calibration passed the gate; 3 the gate refused the
calibration; 2 bad input, named in one line; 130 interrupted."""

TOPICS = ('image', 'attitude', 'velocity', 'temperature', 'observations')
MOST_POINTS = 2000  # pixels a side of a table of lines of sight: 1.8 GB of memory
_BAGS = 'an .mcap file or a bag folder'
_BAGS_OR_IMAGES = 'an .mcap file, a bag folder, or images: files, a folder, or a pattern in quotes'
_INTRODUCTION = 'In-flight star calibration of spacecraft cameras.'
_FIRST_STEPS = f"""\
first steps:
  # render a bag with known truth
  starcal simulate --scenario tiny -o tiny
  # calibrate
  starcal calibrate tiny --params tiny/params.yaml -o out
  # compare with the truth
  starcal compare out tiny/truth.json
  # the same by the ROS nodes, where ROS 2 is installed
  starcal demo

starcal COMMAND --help shows examples of each command. A file that starcal did not write, or that
was changed since, is never replaced.
{_EXIT_STATUS}"""


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


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError('empty path')  # Path('') means the current folder
    return Path(text)


def _number(kind: type[int] | type[float], low: float, high: float = math.inf) -> Any:
    """Type of an argument that is a number from ``low`` to ``high``."""

    def read(text: str) -> float:
        value = kind(text)
        if not low <= value <= high:  # nor is NaN
            raise argparse.ArgumentTypeError(f'{text} is not within {low:g} to {high:g}')
        return value

    read.__name__ = kind.__name__  # argparse names it where the text is no number
    return read


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


def _remap(text: str) -> str:
    if not all(text.partition(':=')[::2]):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form A:=B')
    return text


class _Parser(argparse.ArgumentParser):
    """Reports errors in one line and suggests the nearest known word."""

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        bad = re.search(r"(?:invalid choice: '?|unrecognized arguments: )([^' ]+)", message)
        if bad:
            near = difflib.get_close_matches(bad[1].partition('=')[0], _words(self), 1)
            message += f' (did you mean {near[0]}?)' if near else ''
        self.exit(complain(f'{message} (see {self.prog} --help)'))


def _words(parser: argparse.ArgumentParser) -> list[str]:
    """Every command, option and choice of a parser and its commands."""
    words: list[str] = []
    for action in parser._actions:
        words += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                words += [name, *_words(command)]
        else:
            words += map(str, action.choices or ())
    return words


class _TopFormatter(argparse.RawDescriptionHelpFormatter):
    """Aligns the summaries of the commands."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=15)
        self._action_max_length = 13  # argparse neglects the indent of the longest, calibrate


def parser() -> argparse.ArgumentParser:
    """
    Parser of the tool.

    It stores the name of the command in ``command``, None without one, and a request for the
    version in ``version``.
    """
    top = _Parser(
        prog='starcal',
        description=_INTRODUCTION,
        epilog=_FIRST_STEPS,
        formatter_class=_TopFormatter,
    )
    top.add_argument('--version', action='store_true', help='show the version and exit')
    commands = top.add_subparsers(metavar='COMMAND', dest='command', title='commands')
    for name, text in HELP.items():
        summary, description, examples = text.split('\n\n', 2)
        command = commands.add_parser(
            name,
            help=summary,
            description=textwrap.fill(description, shutil.get_terminal_size().columns - 2),
            epilog=f'examples:\n{examples}',
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        _ARGUMENTS[name](command)
    return top


def _output(command: argparse.ArgumentParser, metavar: str, what: str, **settings: Any) -> None:
    command.add_argument('-o', '--output', type=_path, metavar=metavar, help=what, **settings)


def _bags(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument('bags', type=_path, metavar='BAG', nargs='+', help=what)


def _params(command: argparse.ArgumentParser, what: str = '') -> None:
    """Parameter file, needed where no other meaning is given."""
    text = what or 'ROS parameter file: prior camera, mounting and options'
    command.add_argument('--params', type=_path, metavar='FILE', help=text, required=not what)


def _json(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        '--json', action='store_true', help='print one JSON object instead of tables'
    )


def _topics(command: argparse.ArgumentParser) -> None:
    for kind in TOPICS:
        what = f'{kind} topic (default: the only one of its type in the bag)'
        command.add_argument(f'--{kind}-topic', default='', metavar='T', help=what)


def _demo(command: argparse.ArgumentParser) -> None:
    what = 'folder for products and log files, created if absent (default: starcal_demo)'
    _output(command, 'DIR', what, default=Path('starcal_demo'))


def _init(command: argparse.ArgumentParser) -> None:
    _bags(command, _BAGS_OR_IMAGES)
    what = 'folder for params.yaml and camera.yaml, created if absent'
    _output(command, 'DIR', what, required=True)
    _lens(command)
    _topics(command)


def _lens(command: argparse.ArgumentParser) -> None:
    what = (
        'focal length of the lens, mm, with --pixel-size-um (default: from EXIF or FITS, else '
        'estimated)'
    )
    command.add_argument('--focal-length-mm', type=float, default=0.0, metavar='MM', help=what)
    what = 'size of a pixel of the images, micrometres'
    command.add_argument('--pixel-size-um', type=float, default=0.0, metavar='UM', help=what)


def _camera_alone(command: argparse.ArgumentParser) -> None:
    what = 'estimate the camera by its stars, without attitudes and alignment, in the bag or not'
    command.add_argument('--camera-alone', action='store_true', help=what)


def _inspect(command: argparse.ArgumentParser) -> None:
    _bags(command, _BAGS)
    _params(command, 'ROS parameter file; with it the stars are measured too')
    _camera_alone(command)
    _topics(command)
    _json(command)


def _diagnose(command: argparse.ArgumentParser) -> None:
    _bags(command, _BAGS)
    _params(command)
    _topics(command)
    _json(command)


def _calibrate(command: argparse.ArgumentParser) -> None:
    _bags(command, _BAGS_OR_IMAGES)
    what = 'ROS parameter file: prior camera, mounting and options; images need none'
    _params(command, what)
    what = 'folder for the products, created if absent'
    _output(command, 'DIR', what, required=True)
    command.add_argument(
        '--no-report', action='store_true',
        help='write no report; starcal report DIR writes it later',
    )  # fmt: skip
    _camera_alone(command)
    _lens(command)
    _topics(command)
    when = 'UTC in ISO 8601, seconds since 1970, or +seconds after the first image'
    what = f'use images from T on: {when}'
    command.add_argument('--from', dest='from_time', type=parse_time, metavar='T', help=what)
    command.add_argument(
        '--to', dest='to_time', type=parse_time, metavar='T', help='use images up to T'
    )


def _plan(command: argparse.ArgumentParser) -> None:
    what = 'images or observations so far: an .mcap file or a bag folder'
    _bags(command, what)
    _params(command)
    what = 'images that may be taken (default: 10)'
    command.add_argument(
        '--images', type=_number(int, 1, 1000), default=10, metavar='N', help=what
    )
    what = 'sigma to lower: line_of_sight (default), map, or a parameter such as fx or k1'
    command.add_argument('--minimise', default='line_of_sight', metavar='NAME', help=what)
    allowed = command.add_mutually_exclusive_group()
    what = 'CSV of the allowed pointings, with the columns ra_deg, dec_deg and, if fixed, roll_deg'
    allowed.add_argument('--pointings', type=_path, metavar='FILE', help=what)
    cone = ('RA', 'DEC', 'DEG')
    what = 'allow boresights within DEG degrees of a direction, ICRF (default: the whole sky)'
    whole = (0.0, 0.0, 180.0)
    allowed.add_argument('--within', type=float, nargs=3, default=whole, metavar=cone, help=what)
    what = 'no boresight within DEG degrees of a direction: Sun, Moon, Earth; may be repeated'
    command.add_argument('--avoid', type=float, nargs=3, action='append', default=[], metavar=cone,
         help=what)  # fmt: skip
    what = 'largest angle between the boresights of an image and the next (default: 180)'
    command.add_argument(
        '--slew', type=_number(float, 0.001, 180), default=180.0, metavar='DEG', help=what
    )
    _output(command, 'FILE', 'write the pointings as CSV too')
    _topics(command)
    _json(command)


def _report(command: argparse.ArgumentParser) -> None:
    what = 'folder with the products of starcal calibrate, or the state_dir of a calibrator'
    command.add_argument('folder', type=_path, metavar='DIR', help=what)
    command.add_argument(
        '--pdf', action='store_true', help='write report.pdf too, to print and sign'
    )


def _compare(command: argparse.ArgumentParser) -> None:
    for name, which in (('a', 'reference calibration'), ('b', 'calibration to compare')):
        what = f'{which}: calibration.json or its folder'
        command.add_argument(name, type=_path, metavar=name.upper(), help=what)
    _output(command, 'FILE', 'plot of the difference over the detector (.svg)')
    _json(command)


def _lookup(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        'calibration', type=_path, metavar='DIR', help='calibration.json or its folder'
    )
    what = 'table to write: .csv, .npz or .fits'
    _output(command, 'FILE', what, required=True)
    grid = command.add_mutually_exclusive_group()
    what = 'N x N pixels from corner to corner of the detector, u fastest (default: 25)'
    grid.add_argument(
        '--points', type=_number(int, 2, MOST_POINTS), default=25, metavar='N', help=what
    )
    what = 'a pixel every PX pixels along both axes, in place of --points'
    grid.add_argument('--step', type=float, metavar='PX', help=what)


def _remaps(command: argparse.ArgumentParser, what: str) -> None:
    command.add_argument(
        '--remap', type=_remap, action='append', default=[], metavar='A:=B', help=what
    )


def _play(command: argparse.ArgumentParser) -> None:
    command.add_argument('bag', type=_path, metavar='BAG', help=_BAGS)
    what = 'playback speed; 1 is real time, 0 is as fast as stars are observed (default: 1)'
    command.add_argument(
        '--rate', type=_number(float, 0, 1e6), default=1.0, metavar='R', help=what
    )
    _remaps(command, 'publish topic A of the bag as B; may be repeated')


def _monitor(command: argparse.ArgumentParser) -> None:
    what = 'print one view after S seconds and end; needed where the output is not a terminal'
    command.add_argument('--once', type=_number(float, 0, 3600), metavar='S', help=what)
    _remaps(command, 'read topic A of the nodes from B; may be repeated')


def _seed(command: argparse.ArgumentParser, what: str) -> None:
    seed = _number(int, 0, 2**63 - 1)
    command.add_argument('--seed', type=seed, default=1, metavar='N', help=f'{what} (default: 1)')


def _simulate(command: argparse.ArgumentParser) -> None:
    what = 'bag folder or .mcap file to write'
    _output(command, 'BAG', what, required=True)
    what, names = 'scenario: tiny, small or paper', ('tiny', 'small', 'paper')
    command.add_argument('--scenario', required=True, choices=names, metavar='NAME', help=what)
    _seed(command, 'seed of the truth and the noise')
    what = (
        'seed of the camera and its mounting: the same camera with other noise (default: --seed)'
    )
    command.add_argument('--camera-seed', type=_number(int, 0), metavar='N', help=what)
    what = 'number of images (default: from the scenario)'
    command.add_argument('--images', type=_number(int, 1), metavar='N', help=what)
    what = 'draw only the N brightest stars of each image'
    command.add_argument('--stars-per-image', type=_number(int, 1), metavar='N', help=what)
    _mistakes(command)


def _mistakes(command: argparse.ArgumentParser) -> None:
    mistakes = command.add_argument_group('mistakes to rehearse, see "starcal diagnose"')
    what = 'mirror the images (default where no side is given: left-right)'
    mistakes.add_argument(
        '--flip', nargs='?', const='left-right', choices=('left-right', 'top-bottom'), help=what
    )
    what = 'angle of a counterclockwise rotation of the images, degrees'
    mistakes.add_argument('--rotate', type=int, choices=(0, 90, 180, 270), default=0, help=what)
    what = 'direction of the attitudes in the bag; the parameter file has st_to_inertial'
    directions = ('st_to_inertial', 'inertial_to_st')
    mistakes.add_argument(
        '--attitude-direction', choices=directions, default=directions[0], help=what
    )
    what = 'order of the numbers of the quaternions in the bag'
    mistakes.add_argument(
        '--quaternion-order', choices=('xyzw', 'wxyz'), default='xyzw', help=what
    )
    for name, low, high, metavar, what in (
        ('alignment-error', -180, 180, 'DEG', 'error of the prior alignment, degrees'),
        ('focal-error', -90, 400, 'PERCENT', 'error of the prior focal length, percent'),
        ('clock-error', -1e9, 1e9, 'S', 'delay of the image stamps, s, over 0.75'),
    ):
        kind = _number(float, low, high)
        mistakes.add_argument(f'--{name}', type=kind, default=0.0, metavar=metavar, help=what)
    what = 'length of the streak of a star, px'
    mistakes.add_argument('--smear', type=_number(int, 1, 200), default=1, metavar='PX', help=what)
    what = 'tone curve: pixel values grow with light to the power 1/G'
    gamma = _number(float, 0.2, 5)
    mistakes.add_argument('--gamma', type=gamma, default=1.0, metavar='G', help=what)


def _export(command: argparse.ArgumentParser) -> None:
    what = 'calibration.json or its folder'
    command.add_argument('calibration', type=Path, metavar='DIR', help=what)
    what = 'format: spice, ck, isd, opencv, kalibr, ros, giant, mrcal, csv or c'
    command.add_argument('--to', required=True, metavar='FORMAT', help=what)
    what = 'folder for the files, created if absent'
    command.add_argument('-o', '--output', type=Path, required=True, metavar='OUT', help=what)
    spice = command.add_argument_group('SPICE')
    what = 'NAIF ID of the spacecraft, negative'
    spice.add_argument('--spacecraft-id', type=int, metavar='ID', help=what)
    what = 'NAIF ID of the camera (default: 1000 times the spacecraft ID, minus 1)'
    spice.add_argument('--instrument-id', type=int, default=0, metavar='ID', help=what)
    what = (
        'frame ID of the star tracker; the kernel then defines its frame as a CK frame (default: '
        'the frame kernel of the mission does)'
    )
    spice.add_argument('--star-tracker-id', type=int, default=0, metavar='ID', help=what)
    for name in ('camera', 'star-tracker'):
        what = f'name of the {name.replace("-", " ")} frame (default: from the calibration)'
        spice.add_argument(f'--{name}-frame', default='', metavar='NAME', help=what)
    what = 'pixel size, micrometres, for a focal length in mm (default: pixels only)'
    spice.add_argument('--pixel-size-um', type=float, default=0.0, metavar='UM', help=what)
    what = 'LSK and SCLK of the spacecraft, for ck'
    spice.add_argument('--kernels', nargs='+', type=Path, default=(), metavar='FILE', help=what)
    command.add_argument('--image-topic', default='', metavar='T', help='image topic, for kalibr')
    what = 'only the binary table, for compiled C code'
    command.add_argument('--table', action='store_true', help=what)


def _import(command: argparse.ArgumentParser) -> None:
    what = 'image files; a pattern in quotes is expanded here'
    command.add_argument('--images', nargs='+', required=True, metavar='FILE', help=what)
    what = (
        'AEM, CSV, SPICE kernels (CK, SCLK, LSK and, for a frame by name, FK), or FITS with the'
        ' WCS of each image: the images, or files with the same names'
    )
    command.add_argument('--attitude', nargs='+', required=True, metavar='FILE', help=what)
    what = 'OEM, CSV, or SPICE kernels (SPK with the Earth or the Sun, LSK); default: the Earth'
    command.add_argument('--velocity', nargs='+', type=Path, metavar='FILE', help=what)
    what = 'bag folder or .mcap file to write'
    command.add_argument('-o', '--output', type=Path, required=True, metavar='BAG', help=what)
    what = 'star tracker frame: a body frame of the AEM, or a frame name or number of the CK'
    command.add_argument('--star-tracker', default='', metavar='FRAME', help=what)
    what = 'frames of further star trackers in the same files'
    command.add_argument('--more-star-trackers', nargs='+', default=(), metavar='FRAME', help=what)
    what = 'name or NAIF ID of the spacecraft in the SPK'
    command.add_argument('--spacecraft', default='', metavar='BODY', help=what)
    what = 'FITS keyword of the middle of the exposure (default: DATE-AVG, else from DATE-BEG)'
    command.add_argument('--time-key', default='', metavar='KEY', help=what)
    what = 'CSV with columns file and time_utc (or time_tai, time_tdb, time_gps, time_ns)'
    command.add_argument('--times', type=Path, metavar='FILE', help=what)
    what = 'FITS keyword of the camera temperature, degC, e.g. CCD-TEMP'
    command.add_argument('--temperature-key', default='', metavar='KEY', help=what)
    what = 'FITS extension by number or name (default: the first image)'
    command.add_argument('--hdu', default='', metavar='N', help=what)
    what = 'colour to take from an RGB image or a mosaic'
    command.add_argument('--channel', default='', choices=('red', 'green', 'blue'), help=what)
    what = 'Bayer pattern of a mosaic; the image then has half the width and height'
    command.add_argument(
        '--bayer', default='', choices=('rggb', 'bggr', 'gbrg', 'grbg'), help=what
    )
    what = 'range of pixel values that is mapped to 16 bit (default: the range of all images)'
    command.add_argument('--value-range', nargs=2, type=float, metavar=('LOW', 'HIGH'), help=what)
    what = 'prior camera, ROS YAML or .cameramodel of mrcal; params.yaml is written then'
    command.add_argument('--camera', type=Path, metavar='FILE', help=what)
    what = (
        'prior orientation x y z w of the camera in the star tracker frame, then in the frame of'
        ' each further star tracker; of a single star tracker it may be left out: it is then found'
        ' from the first images'
    )
    command.add_argument('--alignment', nargs='+', type=float, default=(), metavar='Q', help=what)


def _catalog(command: argparse.ArgumentParser) -> None:
    what = 'table of Gaia DR3 by the Gaia archive or VizieR: VOTable, FITS, CSV or Parquet'
    command.add_argument('table', type=_path, metavar='GAIA_FILE', help=what)
    what = 'catalog file to write (.npz), for the option catalog'
    _output(command, 'FILE', what, required=True)


def _trend(command: argparse.ArgumentParser) -> None:
    what = 'folder tree with calibrations and bags, or its URL, e.g. s3://bucket/fleet'
    command.add_argument('root', metavar='ROOT', help=what)
    what = 'folder for trend.html, the table trend.sqlite and the calibrations of bags'
    command.add_argument('-o', '--output', required=True, metavar='DIR', help=what)
    what = (
        'ROS parameter file for bags without a calibration beside them; {spacecraft} and {camera} '
        'in its path are replaced'
    )
    command.add_argument('--params', default='', metavar='FILE', help=what)
    what = (
        "names of spacecraft and cameras: a pattern, e.g. '{spacecraft}/{camera}/*.mcap', or a "
        'CSV file with columns path, spacecraft, camera, params'
    )
    command.add_argument('--cameras', default='', metavar='PATTERN', help=what)
    what = 'write the table as trend.parquet too, for other tools'
    command.add_argument('--parquet', action='store_true', help=what)
    where = command.add_mutually_exclusive_group()
    what = 'worker processes (default: 0, in-process)'
    where.add_argument('--workers', type=_number(int, 0, 1024), default=0, metavar='N', help=what)
    what = 'address of a Dask scheduler, e.g. tcp://host:8786'
    where.add_argument('--scheduler', default='', metavar='ADDRESS', help=what)


_ARGUMENTS: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    'demo': _demo,
    'init': _init,
    'inspect': _inspect,
    'diagnose': _diagnose,
    'calibrate': _calibrate,
    'plan': _plan,
    'report': _report,
    'compare': _compare,
    'lookup': _lookup,
    'play': _play,
    'monitor': _monitor,
    'simulate': _simulate,
    'export': _export,
    'import': _import,
    'catalog': _catalog,
    'trend': _trend,
}
