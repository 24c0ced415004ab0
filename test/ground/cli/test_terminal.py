# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What a person sees: on a terminal of its own, and in a pipe."""

import os
import pty
import re
import subprocess
import sys

from starcal_ground.cli.terminal import print_table, print_verdict, progress_bar, table_lines

SHOW = """
from starcal_ground.cli.terminal import print_table, print_verdict, progress_bar
with progress_bar(3, 'images') as advance:
    for _ in range(3):
        advance()
print_table(('name', 'value'), [('fx [px]', '1801.03')])
print_verdict(False, 'refused')
"""


def on_terminal(**environment: str) -> str:
    ours, theirs = pty.openpty()
    plain = {k: v for k, v in os.environ.items() if k not in ('NO_COLOR', 'TERM', 'COLUMNS')}
    with subprocess.Popen(
        [sys.executable, '-c', SHOW],
        stdout=theirs,
        stderr=theirs,
        env={**plain, 'TERM': 'xterm', **environment},
    ) as process:
        os.close(theirs)
        said = b''
        while True:
            try:
                read = os.read(ours, 4096)
            except OSError:  # Linux: the other side has closed
                break
            if not read:
                break
            said += read
    os.close(ours)
    assert process.returncode == 0, said
    return said.decode()


COLOUR = re.compile(r'\x1b\[(?:\d+;)*3[0-7]m')


def test_a_terminal_shows_bar_table_and_colour_but_for_no_color() -> None:
    said = on_terminal()
    assert '3/3' in said and 'images' in said
    assert 'fx [px]' in said and '─' in said  # brackets are no markup
    assert COLOUR.search(said.partition('fx')[2])
    said = on_terminal(NO_COLOR='1')
    assert 'refused' in said and not COLOUR.search(said)


def test_a_pipe_shows_plain_lines_and_no_bar(capsys) -> None:
    with progress_bar(2, 'images') as advance:
        advance()
        advance()
    print_table(('name', 'value'), [('fx', '1801.03'), ('skew', '0')])
    print_verdict(True, 'accepted')
    out, err = capsys.readouterr()
    assert err == ''
    assert out == 'name    value\nfx    1801.03\nskew        0\naccepted\n'
    # Columns are as wide as their widest cell.
    lines = table_lines(('a', 'b', 'c'), [('long name', 'x', '1'), ('n', 'word', '10')], left=2)
    assert lines == ['a          b      c', 'long name  x      1', 'n          word  10']
