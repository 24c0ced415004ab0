# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Text for a reader: of unknown origin made safe to print; numbers with the digits they mean."""

from __future__ import annotations

import math
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
    return _UNSAFE.sub(lambda match: ascii(match[0])[1:-1], text)


def counted(count: int, noun: str) -> str:
    """
    A number of things in words.

    >>> counted(1, 'image'), counted(2, 'more image')
    ('1 image', '2 more images')
    """
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'


def shortened(text: str, most: int) -> str:
    """
    The first clauses of a text, which end with semicolons, of at most so many characters.

    >>> shortened('no stars; the lens cap is on; see the report', 40)
    'no stars; the lens cap is on; ...'
    """
    if len(text) <= most:
        return text
    kept = text[: most - len(_LEFT_OUT)]
    return (kept.rpartition('; ')[0] or kept) + _LEFT_OUT


_LEFT_OUT = '; ...'
_SMALLEST, _LARGEST = 1e-9, 1e15
"""Beyond these, zeros are harder to count than an exponent is to read."""

_LEAST_P_VALUE = 1e-6


def significant(value: float, digits: int, sign: str = '', least: float = 0.0) -> str:
    """
    A number with significant digits and no trailing zeros.

    A size below ``least``, except zero, is shown as less than that; ``sign`` is '+' or empty.
    """
    if 0.0 < abs(value) < least:
        return f'< {significant(least, 1)}'
    rounded = float(f'{value:.{digits - 1}e}')
    if not _SMALLEST <= abs(rounded) < _LARGEST:  # also zero and NaN
        return f'{value:{sign}.{digits}g}'
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(rounded))))
    text = f'{value:{sign}.{decimals}f}'
    return text.rstrip('0').rstrip('.') if decimals else text


def to_sigma(value: float, sigma: float, sign: str = '') -> str:
    """A number with two significant digits of its sigma; eight of its own without a sigma."""
    if not (math.isfinite(sigma) and sigma > 0 and math.isfinite(value)):
        return significant(value, 8, sign)
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f'{value:{sign}.{min(decimals, 12)}f}'


def p_value_text(p_value: float) -> str:
    """A p-value with two digits; the chance of less than one in a million is not told apart."""
    return significant(p_value, 2, least=_LEAST_P_VALUE)
