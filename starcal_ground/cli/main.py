# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The `starcal` tool.

Exit status: 0 the command succeeded, and a calibration passed the gate; 3 the gate refused the
calibration, whose products are written, or a bag cannot be calibrated; 2 bad input, one line on
stderr; 130 interrupted.
"""

# PYTHON_ARGCOMPLETE_OK: the shell's global completion looks for this word.
from __future__ import annotations

import argparse
from collections.abc import Collection, Sequence
import importlib
import io
import os
import re
import shutil
import sys
import textwrap
from typing import NoReturn

from starcal_ground.cli import arguments, terminal
from starcal_ros.errors import missing_package, StarcalError

COMMANDS = (
    *('demo', 'calibrate', 'diagnose', 'compare', 'plan', 'report', 'lookup', 'undistort'),
    *('play', 'monitor', 'simulate', 'export', 'import', 'catalog', 'trend'),
)
_INTRODUCTION = 'In-flight star calibration of spacecraft cameras.'
_FIRST_STEPS = """\
first steps:
  # render a bag with known truth
  starcal simulate --scenario tiny -o tiny
  # calibrate: what is not stated is found or assumed, and listed
  starcal calibrate tiny -o out
  # compare with the truth
  starcal compare out tiny/truth.json
  # the same by the ROS nodes, where ROS 2 is installed
  starcal demo

starcal help COMMAND shows examples of each command. A file that starcal did not write, or that
was changed since, is never replaced.
exit status: 0 the command succeeded, and a calibration passed the gate; 3 the gate refused the
calibration; 2 bad input, named in one line; 130 interrupted."""


class _Parser(argparse.ArgumentParser):
    """Reports errors in one line; an option of a parameter file is named as ``--set`` takes it."""

    command = ''  # the command that the line names
    has_set = False  # whether it takes ``--set``

    def error(self, message: str) -> NoReturn:
        """Exit with status 2."""
        if "invalid choice: 'inspect'" in message:  # a command of development versions
            message = 'inspect: no such command: starcal diagnose lists the contents of a bag'
        unknown = re.search(r'unrecognized arguments: --([^ =]+)', message)
        name = unknown[1].replace('-', '_') if unknown else ''
        if self.has_set and name in _options():
            message += f' (did you mean --set {name}=VALUE?)'
        prog = ' '.join(filter(None, [self.prog, self.command]))
        self.exit(arguments.complain(f'{message} (see {prog} --help)'))


def _options() -> Collection[str]:
    """Names that ``--set`` takes."""
    from starcal_ros.options import names_of
    from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES

    return names_of(*OPTION_CLASSES, *NODE_OPTION_CLASSES)


class _TopFormatter(argparse.RawDescriptionHelpFormatter):
    """Aligns the summaries of the commands."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=15)
        self._action_max_length = 13  # argparse neglects the indent of the longest, calibrate


def parser(argv: Sequence[str] = ()) -> argparse.ArgumentParser:
    """
    Parser of the tool; of a command line that names a command, with the arguments of that alone.

    It stores the name of the command in ``command``, None without one, its function in ``run``,
    and a request for the version in ``version``.
    """
    top = _Parser(
        prog='starcal',
        description=_INTRODUCTION,
        epilog=_FIRST_STEPS,
        formatter_class=_TopFormatter,
    )
    top.add_argument('--version', action='store_true', help='show the version and exit')
    commands = top.add_subparsers(metavar='COMMAND', dest='command', title='commands')
    named = next((word for word in argv if word in COMMANDS), None)
    top.command = named if named and argv[0] == named else ''
    for name in COMMANDS:
        if named not in (None, name):
            commands.add_parser(name)
            continue
        file = 'import_' if name == 'import' else name  # a word of Python
        module = importlib.import_module(f'starcal_ground.cli.commands.{file}')
        summary, _, text = (module.__doc__ or '').strip().partition('\n\n')
        description, _, examples = text.partition('\n\n')
        command = commands.add_parser(
            name,
            help=f'{summary[:1].lower()}{summary[1:].rstrip(".")}',
            description=textwrap.fill(description, shutil.get_terminal_size().columns - 2),
            epilog=f'examples:\n{examples}',
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        top.has_set = '--set' in command._option_string_actions
        command.set_defaults(run=module.run)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the tool; returns the exit status."""
    try:
        terminal.open_missing_streams()
        if isinstance(sys.stdout, io.TextIOWrapper):  # the name of a file need not be UTF-8
            sys.stdout.reconfigure(errors='backslashreplace')
        words = list(sys.argv[1:] if argv is None else argv)
        if words[:1] == ['help']:
            words = [*words[1:], '--help']
        tool = parser(words)
        if '_ARGCOMPLETE' in os.environ:  # set by a shell that completes a command line
            import argcomplete

            argcomplete.autocomplete(tool)
        try:
            return _run(tool.parse_args(words), tool)
        finally:
            sys.stdout.flush()  # at the end of Python an error has no handler
    except StarcalError as error:
        from starcal_ground.file_kinds import explained

        return arguments.complain(explained(error))
    except BrokenPipeError:
        # The reader of our output has ended (starcal ... | head).
        terminal.discard_stdout()
        return arguments.EXIT_BAD_INPUT
    except OSError as error:
        terminal.discard_stdout()
        return arguments.complain(f'{error.filename or "input/output"}: {error.strerror or error}')
    except (KeyboardInterrupt, Exception) as error:
        if arguments.is_interrupt(error):
            arguments.complain('interrupted')
            return arguments.EXIT_INTERRUPTED
        if not isinstance(error, ModuleNotFoundError):
            raise
        return arguments.complain(missing_package(error, 'mission'))


def _run(args: argparse.Namespace, tool: argparse.ArgumentParser) -> int:
    """Run the command of a command line."""
    if args.version:
        from starcal_ros.constants import software_version

        terminal.print_text(f'starcal {software_version()}')
    elif args.command is None:
        tool.print_help()
    else:
        status: int = args.run(args)
        return status
    return arguments.EXIT_ACCEPTED


if __name__ == '__main__':
    sys.exit(main())
