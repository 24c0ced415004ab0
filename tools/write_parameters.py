"""Write config/starcal.yaml, every parameter with its default, from the options dataclasses."""

from __future__ import annotations

import dataclasses
from pathlib import Path
import textwrap
from typing import Any

from starcal_ros.pipeline.node_options import CalibratorOptions, NodeOptions, ObserverOptions
from starcal_ros.pipeline.setup import OPTION_CLASSES

FILE = Path(__file__).parents[1] / 'config' / 'starcal.yaml'
HEAD = """\
# Every parameter of starcal with its default: copy what you change, what you leave out keeps its
# default. The nodes and the tool `starcal` read the same file: /** applies to all, the sections
# below it to one node, in any namespace. A bad value is refused by name.
#
# camera_info_url has no default that works: name your prior camera.
# Written by tools/write_parameters.py: change the options dataclasses, then run it.
"""
INDENT = ' ' * 4


def main() -> None:
    """Write the file."""
    FILE.write_text(parameter_file())


def parameter_file() -> str:
    """Return the whole file."""
    sections = {
        '/**': (*OPTION_CLASSES, NodeOptions),
        '/**/star_observer': (ObserverOptions,),
        '/**/calibrator': (CalibratorOptions,),
    }
    parts = [
        f'{name}:\n  ros__parameters:\n' + '\n'.join(group(options) for options in classes)
        for name, classes in sections.items()
    ]
    return '\n'.join([HEAD, *parts])


def group(options: type[Any]) -> str:
    """The parameters of one dataclass, under the first line of its docstring."""
    title = (options.__doc__ or '').strip().splitlines()[0]
    lines = [f'{INDENT}# --- {title}']
    for field in dataclasses.fields(options):
        comment = field.metadata['description'] + allowed(field)
        lines += textwrap.wrap(
            comment, 99, initial_indent=f'{INDENT}# ', subsequent_indent=f'{INDENT}# '
        )
        lines.append(f'{INDENT}{field.name}: {as_yaml(field.default)}')
    return '\n'.join(lines) + '\n'


def allowed(field: dataclasses.Field[Any]) -> str:
    """The choices or the inclusive range of a parameter, in words."""
    low, high = field.metadata['low'], field.metadata['high']
    if field.metadata['choices']:
        each = 'each one of ' if isinstance(field.default, tuple) else ''
        return '; ' + each + ' | '.join(field.metadata['choices'])
    if low is not None and high is not None:
        return f'; {low:g} to {high:g}'
    if low is not None or high is not None:
        return f'; at least {low:g}' if high is None else f'; at most {high:g}'
    return ''


def as_yaml(value: object) -> str:
    """Return a default as a person would write it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return '[' + ', '.join(as_yaml(item) for item in value) + ']'
    if isinstance(value, str):
        return value if value.isidentifier() else f"'{value}'"
    return repr(value)


if __name__ == '__main__':
    main()
