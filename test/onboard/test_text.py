# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Text of unknown origin, made safe to print."""

from __future__ import annotations

import pytest

from starcal_ros.text import printable


@pytest.mark.parametrize(
    ('text', 'shown'),
    [
        ('/camera/image_raw', '/camera/image_raw'),
        ('Größe 3″', 'Größe 3″'),
        ('\x1b[2J', '\\x1b[2J'),
        ('a\nb\tc\r', 'a\\nb\\tc\\r'),
        ('\x9b31m\x7f\0', '\\x9b31m\\x7f\\x00'),
        ('\u202egnp', '\\u202egnp'),
        ('\ud800', '\\ud800'),
    ],
)
def test_characters_that_act_on_a_terminal_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
    printable(text).encode()
