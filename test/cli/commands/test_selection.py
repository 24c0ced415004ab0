# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images that --from, --to, --first and --every choose."""

from __future__ import annotations

import argparse

import pytest

from starcal_ros.cli.commands.selection import parse_time, selection

STAMPS_NS = [(1_778_829_600 + 10 * k) * 1_000_000_000 for k in range(12)]


def chosen(start: str | None, end: str | None, first: int | None, every: int | None) -> list[int]:
    after, before = (None if text is None else parse_time(text) for text in (start, end))
    wanted = selection(after, before, first, every)
    assert wanted is not None
    return [k for k, stamp in enumerate(STAMPS_NS) if wanted(stamp)]


def test_between_two_times() -> None:
    assert chosen('+20', '+50', None, None) == [2, 3, 4, 5]
    assert chosen('1778829680', None, None, None) == [8, 9, 10, 11]
    assert chosen('2026-05-15T07:20:20', '2026-05-15T07:20:40Z', None, None) == [2, 3, 4]


def test_every_and_first_count_what_the_times_leave() -> None:
    assert chosen('+20', None, None, 3) == [2, 5, 8, 11]
    assert chosen('+20', None, 2, 3) == [2, 5]
    assert chosen(None, None, 4, None) == [0, 1, 2, 3]


def test_a_stamp_asked_again_has_its_answer() -> None:
    wanted = selection(None, None, 2, None)
    assert wanted is not None
    assert [wanted(STAMPS_NS[0]) for _ in range(3)] == [True] * 3
    assert wanted(STAMPS_NS[1]) and not wanted(STAMPS_NS[2])


@pytest.mark.parametrize(('text', 'words'), [('noon', 'is not a time: give'), ('nan', 'finite')])
def test_texts_that_are_no_time(text: str, words: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=words):
        parse_time(text)


def test_all_images_by_default() -> None:
    assert selection(None, None, None, None) is None
