# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Command-line arguments of the `starcal` tool: commands, their options, and examples of each."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
import contextlib
import difflib
from pathlib import Path
import re
import sys
from types import FrameType
from typing import Any, NoReturn

from starcal_ros.cli import mission_arguments
from starcal_ros.cli.command_help import HELP
from starcal_ros.text import printable

EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_INTERRUPTED = 0, 2, 3, 130

_EXIT_STATUS = """\
exit status: 0 the command succeeded, and a calibration passed the gate; 3 the gate refused the
calibration; 2 bad input, named in one line; 130 interrupted."""

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

starcal COMMAND --help shows examples of each command.
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

    A module in C that is interrupted while it is loaded raises ImportError or SystemError, not
    always with the KeyboardInterrupt as its cause; a dataclass RuntimeError, up to Python 3.11.
    """
    if _interrupts:
        return True
    seen: BaseException | None = error
    while seen is not None and not isinstance(seen, KeyboardInterrupt):
        seen = seen.__cause__ or seen.__context__
    return seen is not None


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError('empty path')  # Path('') means the current folder
    return Path(text)


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
    """Every command and option of a parser and its commands."""
    words: list[str] = []
    for action in parser._actions:
        words += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                words += [name, *_words(command)]
    return words


class _Formatter(argparse.HelpFormatter):
    """Fills paragraphs, but leaves examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith('examples:'):
            return ''.join(indent + line for line in text.splitlines(keepends=True))
        return super()._fill_text(text, width, indent)


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
    for name, (summary, description, examples) in HELP.items():
        command = commands.add_parser(
            name,
            help=summary,
            description=description,
            epilog=f'examples:\n{examples}',
            formatter_class=_Formatter,
        )
        _ARGUMENTS[name](command)
    return top


def _add(
    command: argparse.ArgumentParser, *names: str, completer: Any = None, **settings: Any
) -> None:
    """Add an argument; argcomplete looks for the completer of its value on the action."""
    action = command.add_argument(*names, **settings)
    if completer is not None:
        action.completer = completer  # type: ignore[attr-defined]


def _files_of(*endings: str) -> Any:
    """Completer of folders and of files with these endings."""

    def complete(prefix: str, **_: object) -> Iterable[str]:
        from argcomplete.completers import FilesCompleter

        return FilesCompleter(endings)(prefix)

    return complete


def _scenarios(**_: object) -> Iterable[str]:
    from starcal_ros.simulation.scenario import SCENARIOS

    return SCENARIOS


def _studies(**_: object) -> Iterable[str]:
    from starcal_ros.studies.monte_carlo import STUDIES

    return (*STUDIES, 'paper')


def _output(command: argparse.ArgumentParser, metavar: str, what: str, **settings: Any) -> None:
    _add(command, '-o', '--output', type=_path, metavar=metavar, help=what, **settings)


def _bags(command: argparse.ArgumentParser, name: str, **settings: Any) -> None:
    what = 'an .mcap file or a bag folder'
    completer = _files_of('.mcap')
    _add(command, name, type=_path, metavar='BAG', help=what, completer=completer, **settings)


def _params(command: argparse.ArgumentParser, what: str, required: bool) -> None:
    completer = _files_of('.yaml', '.yml')
    _add(command, '--params', type=_path, metavar='FILE', help=what, required=required,
         completer=completer)  # fmt: skip


def _json(command: argparse.ArgumentParser) -> None:
    _add(command, '--json', action='store_true', help='print one JSON object instead of tables')


def _topics(command: argparse.ArgumentParser) -> None:
    for kind in ('image', 'attitude', 'velocity', 'temperature', 'observations'):
        what = f'{kind} topic (default: the only one of its type in the bag)'
        _add(command, f'--{kind}-topic', default='', metavar='T', help=what)


def _demo(command: argparse.ArgumentParser) -> None:
    what = 'folder for products and log files, created if absent (default: starcal_demo)'
    _output(command, 'DIR', what, default=Path('starcal_demo'))


def _inspect(command: argparse.ArgumentParser) -> None:
    _bags(command, 'bags', nargs='+')
    _params(command, 'ROS parameter file; with it the stars are measured too', required=False)
    _topics(command)
    _json(command)


def _diagnose(command: argparse.ArgumentParser) -> None:
    _bags(command, 'bags', nargs='+')
    _params(command, 'ROS parameter file: prior camera, mounting and options', required=True)
    _topics(command)
    _json(command)


def _calibrate(command: argparse.ArgumentParser) -> None:
    _bags(command, 'bags', nargs='+')
    _params(command, 'ROS parameter file: prior camera, mounting and options', required=True)
    what = 'folder for the products, created if absent; existing products are replaced'
    _output(command, 'DIR', what, required=True)
    _add(
        command, '--no-report', action='store_true',
        help='write no report; starcal report DIR writes it later',
    )  # fmt: skip
    _topics(command)
    when = 'UTC in ISO 8601, seconds since 1970, or +seconds after the first image'
    _add(command, '--from', dest='from_time', metavar='T', help=f'use images from T on: {when}')
    _add(command, '--to', dest='to_time', metavar='T', help='use images up to T')
    _add(command, '--first', type=int, metavar='N', help='use only the first N of these images')
    _add(command, '--every', type=int, metavar='K', help='use only every K-th of these images')
    what = 'compare calibrations of the images of odd and of even number, DIR/odd and DIR/even'
    _add(command, '--split-half', action='store_true', help=what)


def _report(command: argparse.ArgumentParser) -> None:
    what = 'folder with the products of starcal calibrate'
    _add(command, 'folder', type=_path, metavar='DIR', help=what)


def _compare(command: argparse.ArgumentParser) -> None:
    for name, which in (('a', 'reference calibration'), ('b', 'calibration to compare')):
        what = f'{which}: calibration.json or its folder'
        completer = _files_of('.json')
        _add(command, name, type=_path, metavar=name.upper(), help=what, completer=completer)
    _output(command, 'FILE', 'plot of the difference over the detector: .png, .svg or .pdf')
    _json(command)


def _lookup(command: argparse.ArgumentParser) -> None:
    what = 'calibration.json or its folder'
    _add(command, 'calibration', type=_path, metavar='DIR', help=what)
    what = 'table to write: .csv, .npz or .fits'
    _output(command, 'FILE', what, required=True)
    grid = command.add_mutually_exclusive_group()
    what = 'N x N pixels from corner to corner of the detector, u fastest (default: 25)'
    grid.add_argument('--points', type=int, default=25, metavar='N', help=what)
    what = 'a pixel every PX pixels along both axes, in place of --points'
    grid.add_argument('--step', type=float, metavar='PX', help=what)


def _play(command: argparse.ArgumentParser) -> None:
    _bags(command, 'bag')
    what = 'playback speed; 1 is real time, 0 is as fast as stars are observed (default: 1)'
    _add(command, '--rate', type=float, default=1.0, metavar='R', help=what)
    what = 'publish topic A of the bag as B; may be repeated'
    _add(command, '--remap', action='append', default=[], metavar='A:=B', help=what)


def _monitor(command: argparse.ArgumentParser) -> None:
    what = 'print one view after S seconds and end; needed where the output is not a terminal'
    _add(command, '--once', type=float, metavar='S', help=what)
    what = 'read topic A of the nodes from B; may be repeated'
    _add(command, '--remap', action='append', default=[], metavar='A:=B', help=what)


def _seed(command: argparse.ArgumentParser, what: str) -> None:
    _add(command, '--seed', type=int, default=1, metavar='N', help=f'{what} (default: 1)')


def _simulate(command: argparse.ArgumentParser) -> None:
    what = 'bag folder or .mcap file to write; an existing one is replaced'
    _output(command, 'BAG', what, required=True)
    what = 'scenario: tiny, small or paper'
    _add(command, '--scenario', required=True, metavar='NAME', help=what, completer=_scenarios)
    _seed(command, 'seed of the truth and the noise')
    what = (
        'seed of the camera and its mounting: the same camera with other noise (default: --seed)'
    )
    _add(command, '--camera-seed', type=int, metavar='N', help=what)
    what = 'number of images (default: that of the scenario)'
    _add(command, '--images', type=int, metavar='N', help=what)
    what = 'draw only the N brightest stars of each image'
    _add(command, '--stars-per-image', type=int, metavar='N', help=what)
    _mistakes(command)


def _mistakes(command: argparse.ArgumentParser) -> None:
    mistakes = command.add_argument_group('mistakes to rehearse, see "starcal diagnose"')
    what = 'mirror the images (default where no side is given: left-right)'
    mistakes.add_argument(
        '--flip', nargs='?', const='left-right', choices=('left-right', 'top-bottom'), help=what
    )
    what = 'turn the images counterclockwise by so many degrees'
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
    for name, metavar, what in (
        ('alignment-error', 'DEG', 'error of the prior alignment, degrees'),
        ('focal-error', 'PERCENT', 'error of the prior focal length, percent'),
        ('clock-error', 'S', 'stamps of the images late by so many seconds, more than 0.75'),
    ):
        mistakes.add_argument(f'--{name}', type=float, default=0.0, metavar=metavar, help=what)
    what = 'length of the streak that a star becomes, px'
    mistakes.add_argument('--smear', type=int, default=1, metavar='PX', help=what)
    what = 'tone curve: pixel values grow with light to the power 1/G'
    mistakes.add_argument('--gamma', type=float, default=1.0, metavar='G', help=what)


def _campaign(command: argparse.ArgumentParser) -> None:
    what = 'study: table1, images, terms, coverage, start or paper'
    _add(command, 'study', metavar='STUDY', help=what, completer=_studies)
    _output(command, 'DIR', 'folder for STUDY.json and STUDY.png', required=True)
    what = 'number of trials (default: depends on the study)'
    _add(command, '--trials', type=int, metavar='N', help=what)
    _seed(command, 'seed of all trials')
    for name, kind, metavar, what in (
        ('images', int, 'M', 'numbers of images in a calibration'),
        ('stars', int, 'N', 'numbers of stars in an image'),
        ('tracker', float, 'ARCSEC', 'true star tracker 1-sigma values about each axis, arcsec'),
        ('methods', str, 'METHOD', 'methods to compare: per_image, single, hierarchical'),
    ):
        _add(command, f'--{name}', type=kind, nargs='+', metavar=metavar, help=what)
    what = 'star tracker 1-sigma assumed by the calibration, arcsec (default: the true one)'
    _add(command, '--tracker-assumed', type=float, metavar='ARCSEC', help=what)
    where = command.add_mutually_exclusive_group()
    what = 'worker processes; 0 runs in-process (default: one per CPU)'
    where.add_argument('--workers', type=int, metavar='N', help=what)
    what = 'address of a Dask scheduler, e.g. tcp://host:8786'
    where.add_argument('--scheduler', default='', metavar='ADDRESS', help=what)


_ARGUMENTS: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    'demo': _demo,
    'inspect': _inspect,
    'diagnose': _diagnose,
    'calibrate': _calibrate,
    'report': _report,
    'compare': _compare,
    'lookup': _lookup,
    'play': _play,
    'monitor': _monitor,
    'simulate': _simulate,
    'campaign': _campaign,
    **mission_arguments.ARGUMENTS,
}
