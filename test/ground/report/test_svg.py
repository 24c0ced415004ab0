# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Drawings as SVG: scales, ticks, and that marks are where the data are."""

import base64
import re
import xml.etree.ElementTree as ElementTree

import cv2
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

from starcal_ground.report import svg
from starcal_ground.report.svg import Curve, in_digits, Panel, plot, round_step, Scale


def panel() -> Panel:
    return Panel(Scale(0.0, 10.0, 50.0, 450.0), Scale(-1.0, 1.0, 300.0, 20.0))


@given(least=st.floats(1e-9, 1e9))
def test_steps_are_one_two_or_five_times_a_power_of_ten(least) -> None:
    step = round_step(least)
    assert least * (1 - 1e-9) <= step <= 2.5 * least * (1 + 1e-9)
    assert f'{step:.0e}'[0] in '125'


@given(low=st.floats(-1e6, 1e6), width=st.floats(1e-3, 1e6), most=st.integers(3, 9))
def test_ticks_are_inside_and_not_too_many(low, width, most) -> None:
    ticks = Scale(low, low + width, 0, 1).ticks(most)
    assert 1 <= len(ticks) <= most + 1
    slack = 1e-6 * (width + abs(low))
    assert low - slack <= ticks[0] and ticks[-1] <= low + width + slack


def test_a_logarithmic_scale_and_its_numbers() -> None:
    """Numbers are short and have a minus sign."""
    assert [in_digits(x) for x in (-0.25, 1e-17, 1200.0)] == ['\N{MINUS SIGN}0.25', '0', '1200']
    scale = Scale(0.01, 100.0, 0.0, 400.0, is_log=True)
    assert scale.ticks(6) == pytest.approx([0.01, 0.1, 1.0, 10.0, 100.0])
    assert scale(np.array([0.01, 1.0, 100.0])).tolist() == pytest.approx([0.0, 200.0, 400.0])
    near = Scale(0.3, 4.0, 0.0, 1.0, is_log=True)
    assert near.ticks(6) == pytest.approx([0.5, 1.0, 2.0])


def test_marks_stand_at_their_values_and_text_is_escaped() -> None:
    drawn = panel()
    drawn.axes('x <&>', 'y', svg.named(drawn.x), svg.named(drawn.y))
    gap = Curve([0.0, 5.0, np.nan, 10.0], [0.0, 1.0, 0.0, 0.0], svg.INK, 'one & two', dash='5 3')
    marks = Curve([5.0, np.nan], [0.0, 0.0], svg.SERIES[0], 'b', 'circle', width=0,
                  sigma=np.array([0.5, 0.5]), titles=['<a>', 'b'])  # fmt: skip
    for curve in (gap, marks):
        drawn.curve(curve)
    drawn.legend([gap, marks])
    whole = drawn.drawing(340)
    text = whole.__html__()
    assert ElementTree.fromstring(text).get('viewBox') == '0 0 480 340'
    assert 'translate(250.0 160.0)' in text and text.count('<title>') == 1
    assert '<title>&lt;a&gt;</title>' in text and 'x &lt;&amp;&gt;' in text
    assert 'one &amp; two' in text
    assert 'd="M50.0,160.0L250.0,20.0M450.0,160.0"' in text  # broken at the gap
    assert 'M250.0,230.0V90.0' in text
    pair = svg.sheet([[whole, whole]], 'title')
    document = pair.document()
    root = ElementTree.fromstring(document)
    assert (root.get('width'), root.get('height')) == ('960', '366')
    assert 'var(--' not in document and svg.light(f'"{svg.SERIES[0]}"') == '"#0b62a8"'


def test_a_cloud_is_a_picture_with_points_where_they_are() -> None:
    drawn = panel()
    drawn.cloud(np.array([[5.0, 0.0], [50.0, 0.0]]), 1.0, 0.5)
    data = re.findall(r'x="50.0" y="20.0" width="400.0" .*base64,([^"]*)"', drawn.inside[0])
    png = np.frombuffer(base64.b64decode(data[0]), np.uint8)
    alpha = np.asarray(cv2.imdecode(png, cv2.IMREAD_UNCHANGED))[..., 3]
    v, u = np.nonzero(alpha)
    assert alpha.shape == (560, 800) and (v.mean(), u.mean()) == pytest.approx((280, 400))


def test_an_arrow_ends_where_it_points() -> None:
    assert 'M40.0,50.0L' in svg.arrow(np.array([10.0, 10.0]), np.array([30.0, 40.0]), svg.INK)
    assert svg.arrow(np.zeros(2), np.array([0.1, 0.0]), svg.INK).startswith('<circle')
    assert svg.arrow(np.zeros(2), np.array([np.nan, 0.0]), svg.INK) == ''


def places(drawn: svg.Drawing) -> np.ndarray:
    found = re.findall(r'translate\(([\d.-]+) ([\d.-]+)\)', drawn.body)
    return np.array(found, np.float64)


@given(
    values=st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=9),
    log=st.sampled_from(['', 'y', 'xy']),
)
def test_the_axes_hold_all_values_below_the_legend(values, log) -> None:
    x = np.arange(1.0, len(values) + 1)
    drawn = plot([Curve(x, values, name='a', mark='circle')], 'x', 'y', log=log)
    # The last mark is that of the legend, whose text ends at 26.
    *marks, in_legend = places(drawn)
    u, v = np.array(marks).T
    assert (u > 30).all() and (u < 480).all() and (v < 300).all()
    assert (v > in_legend[1]).all()


def test_an_axis_has_the_ends_and_names_that_are_given_also_without_a_number() -> None:
    empty = Curve([1.0, 2.0], [np.nan, -1.0], mark='circle', sigma=np.array([np.nan, 1.0]))
    drawn = plot([empty], 'x', 'y', log='y')
    assert 'nan' not in drawn.body and 'inf' not in drawn.body
    curve = Curve([0.0, 1.0, 2.0], [1.0, 3.0, np.nan], mark='circle')
    long = [(float(k), f'a long name, indeed {k}') for k in range(3)]
    drawn = plot([curve], '', 'y (px)', x=(-1.0, 3.0), y=(0.0, 4.0), x_ticks=long)
    assert 'rotate(-40' in drawn.body and all(f'>{name}<' in drawn.body for _, name in long)
    (u0, v0), (u1, v1) = places(drawn)
    bottom, top = 290.0, 10.0
    assert [v0, v1] == pytest.approx([bottom - (bottom - top) * k / 4 for k in (1, 3)])
    assert 468.0 - u1 == pytest.approx(2 * (u1 - u0), abs=0.2)
