# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What commands answer, and the form of each refusal of the tool."""

from collections.abc import Callable
import subprocess
import sys
from typing import Any, NamedTuple


class Answer(NamedTuple):
    """Exit status, standard output and standard error of a command."""

    status: int
    out: str
    err: str

    @property
    def words(self) -> str:
        """The output without the line ends that the width of the terminal made."""
        return ' '.join(self.out.split())


def assert_refused(answer: Answer, *words: str) -> None:
    """Assert status 2 and one line on stderr that has all the words."""
    assert answer.status == 2 and answer.err.startswith('starcal: '), answer
    assert answer.err.count('\n') == 1 and answer.err.endswith('\n'), answer.err
    for word in words:
        assert word in answer.err


Starcal = Callable[..., Answer]


def run(*command: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """A program that has run to its end, with its output as text."""
    return subprocess.run([*map(str, command)], capture_output=True, text=True, **options)


def run_python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """The same for the Python of the tests."""
    return run(sys.executable, *words, **options)
