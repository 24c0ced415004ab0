# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Charts as SVG: scales, ticks, and that marks are where the data are."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from starcal_ros.report import svg
from starcal_ros.report.svg import in_digits, Panel, round_step, Scale


def panel() -> Panel:
    return Panel(Scale(0.0, 10.0, 50.0, 450.0), Scale(-1.0, 1.0, 300.0, 20.0))


@given(least=st.floats(1e-9, 1e9))
def test_steps_are_one_two_or_five_times_a_power_of_ten(least: float) -> None:
    step = round_step(least)
    assert least * (1 - 1e-9) <= step <= 2.5 * least * (1 + 1e-9)
    assert f'{step:.0e}'[0] in '125'


@given(low=st.floats(-1e6, 1e6), width=st.floats(1e-3, 1e6), most=st.integers(3, 9))
def test_ticks_are_inside_and_not_too_many(low: float, width: float, most: int) -> None:
    ticks = Scale(low, low + width, 0, 1).ticks(most)
    assert 1 <= len(ticks) <= most + 1
    slack = 1e-6 * (width + abs(low))
    assert low - slack <= ticks[0] and ticks[-1] <= low + width + slack


def test_a_logarithmic_scale() -> None:
    scale = Scale(0.01, 100.0, 0.0, 400.0, is_log=True)
    assert scale.ticks(6) == pytest.approx([0.01, 0.1, 1.0, 10.0, 100.0])
    assert scale(np.array([0.01, 1.0, 100.0])).tolist() == pytest.approx([0.0, 200.0, 400.0])


def test_numbers_are_short_and_have_a_minus_sign() -> None:
    assert [in_digits(x) for x in (-0.25, 1e-17, 1200.0)] == ['\N{MINUS SIGN}0.25', '0', '1200']


def test_marks_stand_at_their_values_and_text_is_escaped() -> None:
    drawn = panel()
    drawn.axes('x <&>', 'y')
    drawn.marks(np.array([5.0, np.nan]), np.array([0.0, 0.0]), svg.SERIES[0], titles=['<a>', 'b'])
    drawn.line(np.array([0.0, 5.0, np.nan, 10.0]), np.array([0.0, 1.0, 0.0, 0.0]), svg.INK)
    drawn.bars(np.array([5.0]), np.array([0.0]), np.array([0.5]), svg.INK)
    drawn.legend(('one & two', svg.INK, 'dash'), ('b', svg.INK, 'cross'))
    text = str(svg.chart([drawn], 340))
    root = ElementTree.fromstring(text)  # of our own making, and well-formed
    assert root.get('viewBox') == '0 0 480 340'
    assert 'translate(250.0 160.0)' in text and text.count('<title>') == 1
    assert '<title>&lt;a&gt;</title>' in text and 'x &lt;&amp;&gt;' in text
    assert 'd="M50.0,160.0L250.0,20.0M450.0,160.0"' in text  # broken at the gap
    assert 'M250.0,230.0L250.0,90.0' in text


def test_a_cloud_is_a_picture_with_points_where_they_are() -> None:
    drawn = panel()
    drawn.cloud(np.array([5.0, 50.0]), np.array([0.0, 0.0]), 1.0, 0.5)
    assert re.findall(r'<image x="50.0" y="20.0" width="400.0" height="280.0"', drawn.parts[0])


def test_an_arrow_ends_where_it_points() -> None:
    assert 'M40.0,50.0L' in svg.arrow(np.array([10.0, 10.0]), np.array([30.0, 40.0]), svg.INK)
    assert svg.arrow(np.zeros(2), np.array([0.1, 0.0]), svg.INK).startswith('<circle')
    assert svg.arrow(np.zeros(2), np.array([np.nan, 0.0]), svg.INK) == ''


def test_long_numbers_beside_an_axis_become_thousandths() -> None:
    """At the usual size they would reach the label of the axis."""
    small = svg.Panel(svg.Scale(0.0, 1.0, 50.0, 450.0), svg.Scale(0.0, 0.0012, 300.0, 20.0))
    small.axes('x', 'residual (px), rms')
    text = ''.join(small.parts)
    assert 'residual (0.001 px), rms' in text
    assert '>0.6<' in text and '0.0006' not in text
    large = svg.Panel(svg.Scale(0.0, 1.0, 50.0, 450.0), svg.Scale(0.0, 0.4, 300.0, 20.0))
    large.axes('x', 'residual (px), rms')
    assert 'residual (px), rms' in ''.join(large.parts)
