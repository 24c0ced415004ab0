# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The report as pages to print."""

from __future__ import annotations

from pathlib import Path
import re
import shutil

from starcal_ground.report import svg
from starcal_ground.report.page import write_report
from starcal_ground.report.svg import light


def test_colours_are_those_of_the_light_palette(tiny_products: Path, tmp_path: Path) -> None:
    shutil.copytree(tiny_products, tmp_path / 'out')
    text = light(write_report(tmp_path / 'out').read_text())
    assert 'stroke="#0b62a8"' in text and '"var(--' not in text


def test_letters_of_printed_figures_have_six_points() -> None:
    css = (Path(svg.__file__).parent / 'templates' / 'report.css').read_text()
    rule = re.search(r'\.charts > figure \{ display: inline-block;[^}]*width: (\d+)%', css)
    margins = re.search(r'size: A4; margin: \S+ (\d+)mm', css)
    assert rule is not None and margins is not None
    line_pt = (210 - 2 * int(margins[1])) / 25.4 * 72
    assert line_pt * int(rule[1]) / 100 * svg.LETTER / svg.WIDTH >= 6
