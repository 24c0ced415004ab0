# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What a command of the tool answers, and the form of each refusal."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


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
