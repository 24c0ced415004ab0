# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The report as pages to print."""

from __future__ import annotations

from ctypes.util import find_library
from pathlib import Path
import re
import shutil
import sys

import pytest

from starcal_ground.cli import main
from starcal_ground.cli.arguments import EXIT_BAD_INPUT
from starcal_ground.report import svg
from starcal_ground.report.page import PDF_FILE, write_report
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


@pytest.mark.packaging
@pytest.mark.slow
@pytest.mark.skipif(not find_library('pango-1.0'), reason='Pango is not installed')
def test_the_pages_are_written_beside_the_report(tiny_products: Path, tmp_path: Path) -> None:
    pytest.importorskip('weasyprint')
    shutil.copytree(tiny_products, tmp_path / 'out')
    assert main.main(['report', str(tmp_path / 'out'), '--pdf']) == 0
    written = (tmp_path / 'out' / PDF_FILE).read_bytes()
    assert written.startswith(b'%PDF-') and len(written) > 100_000


@pytest.mark.parametrize(
    ('module', 'words'),
    [
        ('raise ModuleNotFoundError(name="weasyprint")', "pip install '.[pdf]'"),
        ("raise OSError('cannot load library libpango-1.0-0')", 'apt install libpango-1.0-0'),
    ],
)
def test_without_a_library_one_line_names_its_packages(
    module: str, words: str, tiny_products: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    shutil.copytree(tiny_products, tmp_path / 'out')
    (tmp_path / 'weasyprint.py').write_text(module)
    monkeypatch.delitem(sys.modules, 'weasyprint', raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert main.main(['report', str(tmp_path / 'out'), '--pdf']) == EXIT_BAD_INPUT
    said = capsys.readouterr().err
    assert said.count('\n') == 1 and words in said
    assert (tmp_path / 'out' / 'report.html').is_file()
