# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Progress bars, tables and verdicts: drawn on a terminal, plain lines in a pipe or a file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
import contextlib
import os
import shutil
import sys
import textwrap
from typing import TextIO

from starcal_ros.text import printable


def open_missing_streams() -> None:
    """
    Open standard streams that the caller has closed; they then discard what is written.

    Otherwise the next file that is opened would take the place of one, and what a library prints
    would go into that file.
    """
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:  # a new file takes the lowest number that is free
            setattr(sys, name, os.fdopen(os.open(os.devnull, os.O_RDWR), mode))


def discard_stdout() -> None:
    """Discard unwritten output on stdout, whose reader has ended."""
    with contextlib.suppress(OSError, ValueError):  # in tests it is no file
        devnull = os.open(os.devnull, os.O_WRONLY)
        os.dup2(devnull, sys.stdout.fileno())
        os.close(devnull)


def print_text(text: str = '', file: TextIO | None = None) -> None:
    """Print lines with characters that act on a terminal escaped (`printable`)."""
    print('\n'.join(map(printable, text.split('\n'))), file=file)


def print_wrapped(text: str, indent: int = 2, file: TextIO | None = None) -> None:
    """Print a text in lines of the terminal's width, those after the first indented."""
    width = max(shutil.get_terminal_size().columns, 2 * indent + 20)
    lines = textwrap.wrap(
        text, width, subsequent_indent=indent * ' ', break_on_hyphens=False, break_long_words=False
    )
    print_text('\n'.join(lines), file=file)


@contextlib.contextmanager
def progress_bar(total: int | None, label: str) -> Iterator[Callable[[], None]]:
    """
    Progress bar on a terminal, nothing elsewhere; yields a function that advances it by one.

    ``total`` is None where it is not known.
    """
    if not sys.stderr.isatty():
        yield lambda: None
        return
    from rich import console, progress

    columns = (
        *('{task.description}', progress.BarColumn(), progress.MofNCompleteColumn()),
        *(progress.TimeElapsedColumn(), 'left', progress.TimeRemainingColumn()),
    )
    screen = console.Console(stderr=True)
    with progress.Progress(*columns, console=screen, transient=True) as bar:
        task = bar.add_task(label, total=total)
        yield lambda: bar.advance(task)


def print_table(header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> None:
    """
    Print a table in aligned columns; on a terminal its header is bold, over a line.

    The first ``left`` columns are left-aligned, the others right-aligned.
    """
    first, *lines = table_lines(header, [tuple(map(printable, row)) for row in rows], left)
    _print_styled(first, 'bold')
    if sys.stdout.isatty():
        print('─' * max(map(len, (first, *lines))))
    for line in lines:
        print(line)


def table_lines(header: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> list[str]:
    """Lines of a table in aligned columns, two spaces between them."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    return [
        '  '.join(
            cell.ljust(width) if k < left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (header, *rows)
    ]


def print_verdict(good: bool, text: str) -> None:
    """Print a verdict, in colour on a terminal."""
    _print_styled(text, 'bold green' if good else 'bold red')


def _print_styled(text: str, style: str) -> None:
    """Print a text in a style of rich on a terminal, plain elsewhere."""
    if not sys.stdout.isatty():
        print_text(text)
        return
    from rich.console import Console
    from rich.text import Text

    Console().print(Text(printable(text), style), soft_wrap=True)
