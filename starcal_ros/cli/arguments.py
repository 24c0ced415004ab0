"""What the `starcal` tool can be told: its commands, their options, and examples of each."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
import difflib
from pathlib import Path
import re
import sys
from typing import Any, NoReturn

EXIT_ACCEPTED, EXIT_BAD_INPUT, EXIT_REFUSED, EXIT_INTERRUPTED = 0, 2, 3, 130

_EXIT_STATUS = """\
exit status: 0 done, and a calibration passed the gate; 3 solved, but the gate refused it; 2 bad
input, said in one line; 130 interrupted."""

# Command -> what it is for, what it does, and examples: a comment, then the line to type.
_HELP: dict[str, tuple[str, str, str]] = {
    'demo': (
        'calibrate the small bag with the real ROS nodes',
        (
            'Starts the nodes, plays them ten simulated images, asks for a calibration through '
            'the service and prints it beside the truth.'
        ),
        """\
  # into the folder starcal_demo
  starcal demo
  # elsewhere
  starcal demo -o /tmp/first_look""",
    ),
    'inspect': (
        'say what a bag holds, and which of its images would be refused',
        (
            'Lists topics, rates, stamps, encodings and gaps. Each image is held against the '
            'attitudes as a calibration would hold it; with --params its stars are measured too.'
        ),
        """\
  # a quick look
  starcal inspect bags/tiny
  # measure the stars as well, as "starcal calibrate" would
  starcal inspect bags/tiny --params bags/tiny/params.yaml
  # for a program
  starcal inspect bags/tiny --json

exit status: 0 a calibration could use the bag; 3 it could not, and why is said; 2 bad input.""",
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
            'Measures the stars of all images, solves for camera and alignment, holds the result '
            'against the limits of the gate and writes report.html, calibration.json, '
            'camera_info.yaml and observations.mcap into DIR.'
        ),
        """\
  # the bag in the repository
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out
  # two bags together, where there are several cameras
  starcal calibrate night1 night2.mcap --params camera1.yaml -o out --image-topic /camera1/image
  # again, from the stars measured before: other options, no images
  starcal calibrate out/observations.mcap --params bags/tiny/params.yaml -o again""",
    ),
    'compare': (
        'say how far two calibrations are apart, in pixels and sigmas',
        (
            'Each of A and B is a calibration.json or a folder with one. The lines of sight are '
            'compared in the star tracker frame, before and after the turn common to all pixels '
            'is taken off. Differences are B less A; their sigmas take A and B as independent.'
        ),
        """\
  # two runs
  starcal compare out again
  # with a map of the difference over the detector
  starcal compare out again -o difference.png
  # for a program
  starcal compare out/calibration.json again/calibration.json --json""",
    ),
    'report': (
        'write report.html of a calibration anew',
        (
            'Makes one page from the files of a folder: verdict, parameters, residuals, how well '
            'the camera is known, what was refused. It opens without a network.'
        ),
        """\
  # of an earlier calibration, with this version of starcal
  starcal report out""",
    ),
    'play': (
        'play a bag on the ROS graph',
        'Publishes the messages of a bag with their own stamps, for the nodes to calibrate from.',
        """\
  # in real time
  starcal play bags/tiny
  # as fast as the stars are observed
  starcal play bags/tiny --rate 0
  # on other topics
  starcal play bags/tiny --remap /opnav/image_raw:=/camera/image_raw""",
    ),
    'simulate': (
        'render a bag with known truth',
        (
            'Renders images of real stars as a camera would see them, with the truth, a prior '
            'camera and a parameter file beside them.'
        ),
        """\
  # 24 images of 1296 x 1024: some seconds
  starcal simulate -o sim --scenario small
  # and calibrate them
  starcal calibrate sim --params sim/params.yaml -o out
  # another camera of the kind, with other noise
  starcal simulate -o sim2 --scenario small --seed 2""",
    ),
    'campaign': (
        'Monte Carlo studies of calibrations',
        'Calibrates many simulated campaigns and says how far from the truth they end.',
        """\
  # star tracker noise against method, as in Table 1 of the paper
  starcal campaign table1 -o studies
  # smaller: two noises, twenty trials
  starcal campaign table1 -o studies --trials 20 --tracker 0 20
  # the whole night of the paper from pixels, with its figures: some minutes
  starcal campaign paper -o paper""",
    ),
}

_INTRODUCTION = 'In-flight star calibration of spacecraft cameras.'
_FIRST_STEPS = f"""\
first steps:
  # does it work here?
  starcal demo
  # what is in the bag?
  starcal inspect bags/tiny
  # calibrate
  starcal calibrate bags/tiny --params bags/tiny/params.yaml -o out

starcal COMMAND --help shows examples of each.
{_EXIT_STATUS}"""


def complain(text: str) -> int:
    """Say on stderr, in one line, what is wrong with the input; returns the exit status for it."""
    print(f'starcal: {" ".join(text.split())}', file=sys.stderr)
    return EXIT_BAD_INPUT


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError('an empty name')  # Path would take it for this folder
    return Path(text)


class _Parser(argparse.ArgumentParser):
    """Complains in one line, like everything else here, and says what may have been meant."""

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        said = re.search(r"(?:invalid choice: '?|unrecognized arguments: )([^' ]+)", message)
        if said:
            near = difflib.get_close_matches(said[1].partition('=')[0], _words(self), 1)
            message += f' (did you mean {near[0]}?)' if near else ''
        self.exit(complain(f'{message} (see {self.prog} --help)'))


def _words(parser: argparse.ArgumentParser) -> list[str]:
    """Every command and option that a parser and its commands know."""
    words: list[str] = []
    for action in parser._actions:
        words += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                words += [name, *_words(command)]
    return words


def parser() -> argparse.ArgumentParser:
    """The parser of the tool; it leaves the command's name in ``command``."""
    top = _Parser(
        prog='starcal',
        description=_INTRODUCTION,
        epilog=_FIRST_STEPS,
        formatter_class=_TopFormatter,
    )
    commands = top.add_subparsers(
        required=True, metavar='COMMAND', dest='command', title='commands'
    )
    for name, add in (
        ('demo', _demo),
        ('inspect', _inspect),
        ('diagnose', _diagnose),
        ('calibrate', _calibrate),
        ('report', _report),
        ('compare', _compare),
        ('play', _play),
        ('simulate', _simulate),
        ('campaign', _campaign),
    ):
        short, long, examples = _HELP[name]
        add(
            commands.add_parser(
                name,
                help=short,
                description=long,
                epilog=f'examples:\n{examples}',
                formatter_class=_Formatter,
            )
        )
    return top


class _Formatter(argparse.HelpFormatter):
    """Fills paragraphs, but leaves examples as they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if text.startswith('examples:'):
            return ''.join(indent + line for line in text.splitlines(keepends=True))
        return super()._fill_text(text, width, indent)


class _TopFormatter(argparse.RawDescriptionHelpFormatter):
    """Leaves room for the names of the commands beside what they are for."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=14)


def _completed(action: argparse.Action, completer: Any) -> None:
    action.completer = completer  # type: ignore[attr-defined]  # where argcomplete looks for it


def _bags(command: argparse.ArgumentParser, **how: Any) -> None:
    action = command.add_argument(
        'bags' if how else 'bag',
        type=_path,
        metavar='BAG',
        help='an .mcap file or the folder of a bag',
        **how,
    )
    _completed(action, _files_of('.mcap'))


def _files_of(*endings: str) -> Any:
    """Complete the names of folders and of such files."""

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


def _topics(command: argparse.ArgumentParser) -> None:
    for what in ('image', 'attitude', 'velocity', 'temperature', 'observations'):
        command.add_argument(
            f'--{what}-topic',
            default='',
            metavar='T',
            help=f'topic of {what}; left out: the only one of its type in the bag',
        )


def _params(command: argparse.ArgumentParser, what: str, required: bool) -> None:
    action = command.add_argument(
        '--params', type=_path, required=required, metavar='FILE', help=what
    )
    _completed(action, _files_of('.yaml', '.yml'))


def _demo(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        '-o',
        '--output',
        type=_path,
        default=Path('starcal_demo'),
        metavar='DIR',
        help='folder of products and log files; made if it is not there (starcal_demo)',
    )


def _inspect(command: argparse.ArgumentParser) -> None:
    _bags(command, nargs='+')
    _params(command, 'ROS parameter file: measure the stars with it as well', required=False)
    _topics(command)
    command.add_argument('--json', action='store_true', help='print one JSON object instead')


def _diagnose(command: argparse.ArgumentParser) -> None:
    _bags(command, nargs='+')
    _params(command, 'ROS parameter file: prior camera, mounting and options', required=True)
    _topics(command)
    command.add_argument('--json', action='store_true', help='print one JSON object instead')


def _calibrate(command: argparse.ArgumentParser) -> None:
    _bags(command, nargs='+')
    _params(command, 'ROS parameter file: prior camera, mounting and options', required=True)
    command.add_argument(
        '-o',
        '--output',
        type=_path,
        required=True,
        metavar='DIR',
        help='folder of the products; made if it is not there, replaced file by file if it is',
    )
    _topics(command)


def _compare(command: argparse.ArgumentParser) -> None:
    for name, what in (('a', 'the one before'), ('b', 'the one after')):
        action = command.add_argument(
            name, type=_path, metavar=name.upper(), help=f'{what}: calibration.json or its folder'
        )
        _completed(action, _files_of('.json'))
    command.add_argument(
        '-o',
        '--output',
        type=_path,
        metavar='FILE',
        help='draw the difference over the detector: .png, .svg or .pdf',
    )
    command.add_argument('--json', action='store_true', help='print one JSON object instead')


def _play(command: argparse.ArgumentParser) -> None:
    _bags(command)
    command.add_argument(
        '--rate',
        type=float,
        default=1.0,
        metavar='R',
        help='times real time; 0: as fast as stars are observed (1)',
    )
    command.add_argument(
        '--remap',
        action='append',
        default=[],
        metavar='A:=B',
        help='publish on B what the bag has on A; may be given again',
    )


def _report(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        'folder', type=_path, metavar='DIR', help='folder that starcal calibrate has written'
    )


def _simulate(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        '-o',
        '--output',
        type=_path,
        required=True,
        metavar='BAG',
        help='folder of the bag, or an .mcap file; one of that name is replaced',
    )
    scenario = command.add_argument(
        '--scenario', required=True, metavar='NAME', help='tiny, small or paper'
    )
    _completed(scenario, _scenarios)
    command.add_argument(
        '--seed', type=int, default=1, metavar='N', help='draws the truth and the noise (1)'
    )


def _campaign(command: argparse.ArgumentParser) -> None:
    study = command.add_argument(
        'study', metavar='STUDY', help='table1, images, terms, coverage or paper'
    )
    _completed(study, _studies)
    command.add_argument(
        '-o', '--output', type=_path, required=True, metavar='DIR', help='for STUDY.json and .png'
    )
    command.add_argument('--trials', type=int, metavar='N', help="campaigns; the study's own")
    command.add_argument('--seed', type=int, default=1, metavar='N', help='of the first (1)')
    for name, kind, metavar, what in (
        ('images', int, 'M', 'images of a calibration'),
        ('stars', int, 'N', 'stars of an image'),
        ('tracker', float, 'ARCSEC', 'star tracker noise about each axis'),
        ('methods', str, 'METHOD', 'per_image, single, hierarchical'),
    ):
        command.add_argument(f'--{name}', type=kind, nargs='+', metavar=metavar, help=what)
    command.add_argument(
        '--tracker-told', type=float, metavar='ARCSEC', help='what the calibration takes it for'
    )
    where = command.add_mutually_exclusive_group()
    where.add_argument(
        '--workers', type=int, metavar='N', help='processes; 0: none but this; all processors'
    )
    where.add_argument('--scheduler', default='', metavar='ADDRESS', help='of a Dask cluster')
