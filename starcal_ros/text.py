# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Text of unknown origin, made safe to print."""

from __future__ import annotations

import re

# Controls, marks that reverse the direction of writing, line separators, lone surrogates.
_UNSAFE = re.compile(
    '[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff\ud800-\udfff]'
)


def printable(text: str) -> str:
    r"""
    The text with an escape, such as ``\x1b``, for each character that acts on a terminal.

    Names of topics and files come from others: an escape sequence in one could clear the screen,
    change the lines above, or set the title of the window.
    """
    return _UNSAFE.sub(lambda found: ascii(found[0])[1:-1], text)
