"""Command-line arguments of the `starcal` tool: commands, their options, and examples of each."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
import difflib
from pathlib import Path
import re
import sys
from typing import Any, NoReturn

from starcal_ros.cli import mission_arguments

EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_INTERRUPTED = 0, 2, 3, 130

_EXIT_STATUS = """\
exit status: 0 the command succeeded, and a calibration passed the gate; 3 the gate refused the
calibration; 2 bad input, named in one line; 130 interrupted."""

# Command -> summary, description, and examples: a comment, then the line to type.
_HELP: dict[str, tuple[str, str, str]] = {
    'demo': (
        'calibrate a small bag with the real ROS nodes',
        (
            'Starts the nodes, plays ten simulated images to them, requests a calibration through '
            'the service and prints the result beside the truth.'
        ),
        """\
  # write to the folder starcal_demo
  starcal demo
  # write to another folder
  starcal demo -o /tmp/first_look""",
    ),
    'inspect': (
        'list the contents of a bag and the images a calibration would refuse',
        (
            'Lists topics, rates, stamps, encodings and gaps, and checks each image against the '
            'attitudes as a calibration does. With --params the stars are measured as well.'
        ),
        """\
  # check stamps and attitudes
  starcal inspect bags/tiny
  # also measure the stars, as "starcal calibrate" does
  starcal inspect bags/tiny --params bags/tiny/params.yaml
  # machine-readable output
  starcal inspect bags/tiny --json

exit status: 0 the bag can be calibrated; 3 it cannot, and the reasons are listed; 2 bad input.""",
    ),
    'diagnose': (
        'find out why the images of a bag match no star',
        (
            'Identifies some of the first images without attitude or alignment, holds attitudes, '
            'alignment and camera against them, and prints what is wrong, how that is known, and '
            'the lines of the parameter file that mend it.'
        ),
        """\
  # no image matches: why?
  starcal diagnose bags/tiny --params bags/tiny/params.yaml
  # for a program
  starcal diagnose bags/tiny --params bags/tiny/params.yaml --json

exit status: 0 nothing is wrong; 3 a cause was found, or none could be; 2 bad input.""",
    ),
    'calibrate': (
        'calibrate from bags, without a ROS graph',
        (
            'Measures the stars of all images, estimates camera and alignment, checks the result '
            'against the limits of the gate and writes report.html, calibration.json, '
            'camera_info.yaml and observations.mcap to DIR.'
        ),
        """\
  # the bag in the repository
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out
  # two bags together, with several cameras in them
  starcal calibrate night1 night2.mcap --params camera1.yaml -o out --image-topic /camera1/image
  # repeat from the recorded observations, with other options and without images
  starcal calibrate out/observations.mcap --params bags/tiny/params.yaml -o again""",
    ),
    'compare': (
        'compare two calibrations in pixels and sigmas',
        (
            'A and B are each a calibration.json or a folder that holds one. Lines of sight are '
            'compared in the star tracker frame, before and after removing their common rotation. '
            'Differences are B minus A; their sigmas assume that A and B are independent.'
        ),
        """\
  # two runs
  starcal compare out again
  # with a map of the difference over the detector
  starcal compare out again -o difference.png
  # machine-readable output
  starcal compare out/calibration.json again/calibration.json --json""",
    ),
    'report': (
        'rewrite report.html of a calibration',
        (
            'Makes one page from the files of a folder: gate verdict, parameters, residuals, '
            'uncertainties, refused images and stars. The page needs no network.'
        ),
        """\
  # from the files of an earlier calibration
  starcal report out""",
    ),
    'lookup': (
        'write a table of lines of sight and their sigma by pixel',
        (
            'Writes u_px, v_px, the unit vector x, y, z in the camera frame, shape_sigma_arcsec '
            '(1-sigma of the direction, common rotation removed) and sigma_arcsec (in the star '
            'tracker frame), with the field beside the lens model if there is one.'
        ),
        """\
  # 25 x 25 pixels over the detector
  starcal lookup out -o lines_of_sight.csv
  # every 16 pixels, for interpolation
  starcal lookup out -o lines_of_sight.npz --step 16""",
    ),
    'play': (
        'play a bag on the ROS graph',
        'Publishes the messages of a bag with their own stamps, for the nodes to calibrate from.',
        """\
  # in real time
  starcal play bags/tiny
  # as fast as the stars are observed
  starcal play bags/tiny --rate 0
  # on another topic
  starcal play bags/tiny --remap /opnav/image_raw:=/camera/image_raw""",
    ),
    'simulate': (
        'render a bag with known truth',
        (
            'Renders images of real stars with a simulated camera and writes the truth, a prior '
            'camera and a parameter file beside the bag.'
        ),
        """\
  # 24 images of 1296 x 1024, in a few seconds
  starcal simulate -o sim --scenario small
  # calibrate them
  starcal calibrate sim --params sim/params.yaml -o out
  # another draw of the camera and the noise
  starcal simulate -o sim2 --scenario small --seed 2""",
    ),
    'campaign': (
        'run a Monte Carlo study of the calibration',
        'Calibrates many simulated campaigns and compares the estimates with the truth.',
        """\
  # method against star tracker noise, as in Table 1 of the paper
  starcal campaign table1 -o studies
  # a shorter run: two noise levels, twenty trials
  starcal campaign table1 -o studies --trials 20 --tracker 0 20
  # the whole night of the paper from pixels, with its figures, in some minutes
  starcal campaign paper -o paper""",
    ),
    **mission_arguments.HELP,
}

_INTRODUCTION = 'In-flight star calibration of spacecraft cameras.'
_FIRST_STEPS = f"""\
first steps:
  # check the installation
  starcal demo
  # list the contents of a bag
  starcal inspect bags/tiny
  # calibrate
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out

starcal COMMAND --help shows examples of each command.
{_EXIT_STATUS}"""


def complain(text: str) -> int:
    """Print an input error on stderr in one line and return the exit status for it."""
    print(f'starcal: {" ".join(text.split())}', file=sys.stderr)
    return EXIT_BAD_INPUT


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
    for name, (summary, description, examples) in _HELP.items():
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
    _topics(command)


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


def _seed(command: argparse.ArgumentParser, what: str) -> None:
    _add(command, '--seed', type=int, default=1, metavar='N', help=f'{what} (default: 1)')


def _simulate(command: argparse.ArgumentParser) -> None:
    what = 'bag folder or .mcap file to write; an existing one is replaced'
    _output(command, 'BAG', what, required=True)
    what = 'scenario: tiny, small or paper'
    _add(command, '--scenario', required=True, metavar='NAME', help=what, completer=_scenarios)
    _seed(command, 'seed of the truth and the noise')


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
    'simulate': _simulate,
    'campaign': _campaign,
    **mission_arguments.ARGUMENTS,
}
