# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Text of unknown origin made safe to print, and numbers as a reader sees them."""

import math

import pytest

from starcal_ros.constants import utc_text
from starcal_ros.text import p_value_text, printable, significant, to_sigma


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


@pytest.mark.parametrize(
    ('value', 'digits', 'text'),
    [
        (4e-05, 2, '0.00004'),
        (0.0100, 3, '0.01'),
        (9.996, 3, '10'),
        (0.09996, 3, '0.1'),
        (123456.0, 4, '123456'),
        (-3.941e-06, 4, '-0.000003941'),
        (0.0, 3, '0'),
        (math.nan, 3, 'nan'),
        (math.inf, 3, 'inf'),
        (2e-12, 2, '2e-12'),
        (3e20, 3, '3e+20'),
    ],
)
def test_significant_digits_come_without_an_exponent(value: float, digits: int, text: str) -> None:
    assert significant(value, digits) == text


def test_a_size_below_the_least_one_shown_is_less_than_that() -> None:
    assert significant(7.2e-4, 3, least=0.001) == significant(-7.2e-4, 3, least=0.001) == '< 0.001'
    assert significant(0.0, 3, least=0.001) == '0'
    assert p_value_text(1e-9) == '< 0.000001' and p_value_text(0.1849) == '0.18'


def test_a_value_has_two_digits_of_its_sigma() -> None:
    assert to_sigma(0.075857993, 0.014) == '0.076'
    assert to_sigma(0.00019383623, 4e-05, '+') == '+0.000194'
    assert to_sigma(2000.123456, 0.0) == to_sigma(2000.123456, math.nan) == '2000.1235'


@pytest.mark.parametrize(
    ('time_ns', 'text'),
    [
        (1_778_829_600_012_999_999, '2026-05-15 07:20:00.012 UTC'),
        (-1, '1969-12-31 23:59:59.999 UTC'),
        (10**30, f'{10**30} ns'),
    ],
)
def test_a_stamp_is_a_date_where_the_calendar_has_it(time_ns: int, text: str) -> None:
    assert utc_text(time_ns) == text
