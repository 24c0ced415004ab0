# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images that --from and --to choose."""

from __future__ import annotations

import argparse

import pytest

from starcal_ground.cli.arguments import parse_time, Selection

STAMPS_NS = [(1_778_829_600 + 10 * k) * 1_000_000_000 for k in range(12)]


def chosen(start: str | None, end: str | None) -> list[int]:
    after, before = (None if text is None else parse_time(text) for text in (start, end))
    wanted = Selection(after, before)
    return [k for k, stamp in enumerate(STAMPS_NS) if wanted(stamp)]


def test_between_two_times() -> None:
    assert chosen('+20', '+50') == [2, 3, 4, 5]
    assert chosen('1778829680', None) == [8, 9, 10, 11]
    assert chosen('2026-05-15T07:20:20', '2026-05-15T07:20:40Z') == [2, 3, 4]


@pytest.mark.parametrize(('text', 'words'), [('noon', 'is not a time: give'), ('nan', 'finite')])
def test_texts_that_are_no_time(text, words) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=words):
        parse_time(text)
