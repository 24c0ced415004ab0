"""Text of SPICE kernels: comments, and assignments for the kernel pool."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import re
import textwrap

from starcal_ros.errors import OptionError
from starcal_ros.export.provenance import ascii_line

_LONGEST_NAME = 32  # of a pool variable or a frame: SPICE Required Reading, kernel.req, frames.req
_COMMENT_COLUMNS = 78  # longer lines are read, but NAIF asks for no more than 80
_STRING_COLUMNS = 80  # longest string value of a pool variable

Value = int | str | Sequence[float] | Sequence[str]


def kernel(kind: str, title: str, comments: Iterable[str], data: Iterable[str]) -> str:
    """Text of a kernel of a kind (``FK``, ``IK``): title, comments, assignments."""
    lines = [f'KPL/{kind}', '', title, '-' * len(title), '']
    lines += [line for text in comments for line in _wrapped(text)]
    lines += ['', r'\begindata', '', *data, '', r'\begintext', '']
    return '\n'.join(lines)


def assignment(name: str, value: Value) -> list[str]:
    """
    Lines that give a pool variable a whole number, a string, or a list of numbers or strings.

    Floating-point numbers have all digits; SPICE's reader may be off by two in the last bit.

    Raises
    ------
    OptionError
        When the name is longer than SPICE allows: the identifier in it has too many digits.
    """
    if len(name) > _LONGEST_NAME:
        raise OptionError(f'{name}: over {_LONGEST_NAME} characters, use a shorter NAIF ID')
    if isinstance(value, int):
        return [f'   {name} = {value}']
    if isinstance(value, str):
        return [f'   {name} = {_quoted(value)}']
    items = [_quoted(item) if isinstance(item, str) else repr(float(item)) for item in value]
    return [f'   {name} = (', *(f'      {item}' for item in items), '   )']


def frame_name(text: str, option: str) -> str:
    """
    A frame name as SPICE takes it: upper case, letters, digits and underscores.

    Raises
    ------
    OptionError
        When nothing is left, or more than SPICE allows; the text names the option.
    """
    name = re.sub(r'[^A-Z0-9_]+', '_', text.upper()).strip('_')
    if not name or len(name) > _LONGEST_NAME:
        raise OptionError(
            f'{option}: {text!r} makes no frame name of 1 to {_LONGEST_NAME} characters'
        )
    return name


def _quoted(text: str) -> str:
    return "'" + ascii_line(text)[:_STRING_COLUMNS].replace("'", "''") + "'"


def _wrapped(text: str) -> list[str]:
    # Only the first blanks of a line are its indent; a backslash would open a data block.
    text = text.replace('\\', '/').encode('ascii', 'replace').decode()
    indent = ' ' * (len(text) - len(text.lstrip()))
    return textwrap.wrap(
        text,
        _COMMENT_COLUMNS,
        subsequent_indent=indent + '  ',
        break_on_hyphens=False,
        drop_whitespace=True,
    ) or ['']
