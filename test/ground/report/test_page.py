# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The report: what it says, that it needs nothing else, and how a real browser shows it."""

import contextlib
import dataclasses
import json
import math
from pathlib import Path
import re
import shutil
import subprocess
from typing import Any

from attacks import CHANGES, drawn, with_changes  # type: ignore[import-not-found]
from hypothesis import given
from markupsafe import Markup
import numpy as np
import pytest

from starcal_ground import products
from starcal_ground.bags.reader import read_observations
from starcal_ground.cli import main
from starcal_ground.cli.arguments import EXIT_ACCEPTED, EXIT_BAD_INPUT
from starcal_ground.products import NotCalibrated, prior_of, REPORT_FILE
from starcal_ground.report import page as report
from starcal_ground.report import svg
from starcal_ground.report.page import write_failure_page
from starcal_ground.report.svg import light
from starcal_ground.written_files import write_calibration
from starcal_ros.formats.products.product_files import CALIBRATION_FILE
from starcal_ros.records import Activation, Calibration, Ensemble, TIMES
from starcal_ros.ros.archive import Archive
from starcal_ros.text import significant

FIGURES = (
    *('cells', 'vectors', 'change', 'sky', 'before', 'images', 'histogram', 'lens_field'),
    *('field', 'magnitude', 'colour', 'phase', 'budget', 'line_of_sight', 'shape'),
    'alignment',
)


@pytest.fixture(scope='module')
def folder(tiny_products: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `starcal calibrate` writes of the small bag; this module writes into it."""
    path = tmp_path_factory.mktemp('report') / 'out'
    shutil.copytree(tiny_products, path)
    return path


@pytest.fixture(scope='module')
def page(folder: Path) -> str:
    return (folder / REPORT_FILE).read_text()


def page_of(calibration: Calibration, folder: Path, **changes: Any) -> str:
    """Page of a calibration with some fields changed, beside whatever a folder has."""
    changed = dataclasses.replace(calibration, **changes)
    write_calibration(changed, folder / CALIBRATION_FILE)
    return report.write_report(folder).read_text()


def test_of_a_state_folder_the_last_calibration_with_images(tiny, tiny_products, tmp_path) -> None:
    images = tuple(read_observations([tiny_products / 'observations.mcap'], '/observations'))
    later = dataclasses.replace(images[-1], time_ns=images[-1].time_ns + 10**9)
    older, last = (dataclasses.replace(tiny, number=number) for number in (1, 2))
    with contextlib.closing(Archive(tmp_path, 'camera')) as archive:
        events = (Activation(8, 0, older), Activation(9, 8, last))
        archive.keep(Ensemble((*images, later)), events)
        assert main.main(['report', str(tmp_path)]) == EXIT_ACCEPTED  # while it is in use
    page = (tmp_path / REPORT_FILE).read_text()
    assert 'by the gate: calibration 2' in page
    assert len(report._read_folder(tmp_path).observations or ()) == len(images)
    assert '<svg' in page and 'no residuals of single stars (residuals.npz)' in page


def test_the_page_shows_what_the_calibration_holds(tiny, page) -> None:
    assert '✓ Accepted' in page and '″, at most 300″ required: met.' in page  # one sign
    fx, sigma = tiny.geometry.camera.parameters[0], tiny.sigma[0]
    assert f'<td>{fx:.3f}</td>' in page  # to a hundredth of the sigma of 0.05 px
    assert f'<td>{sigma:.2g}</td>' in page
    prior = prior_of(tiny)
    assert prior is not None and prior.camera.field is None  # which the calibration found
    change = fx - prior.camera.parameters[0]
    assert f'<td>{change / sigma:+.1f}</td>' in page
    assert f'{tiny.residual_rms_px:.3f} px' in page
    assert f'{tiny.stars_used:,}' in page
    assert tiny.weakest_direction in page
    total, *causes = tiny.sigma_budget
    assert f'<th scope="row">total</th><td>{total.map_arcsec:.3g}</td>' in page
    for part in causes:
        assert str(Markup.escape(part.assumption)) in page
    for name in FIGURES:
        assert page.count(f'id="figure-{name}"') == 1
    assert tiny.provenance['observations_sha256'] in page
    checks = tiny.model_checks
    assert checks is not None and len(checks.amplitudes) >= 3
    for one in checks.amplitudes:
        assert f'<th scope="row">{one.name}</th><td>{significant(one.value, 2)}</td>' in page


def test_the_page_needs_nothing_else(page) -> None:
    links = re.findall(r'(?:src|href)="((?!data:|#)[^"]*)"', page)
    products = ['calibration.json', 'camera_info.yaml', 'residuals.npz', 'observations.mcap']
    assert links == products  # beside the page; it shows itself without them
    assert not re.findall(r'url\((?!#|"?data:)[^)]*\)|@import', page)
    assert "default-src 'none'" in page
    identifiers = re.findall(r'\bid="([^"]+)"', page)
    assert len(identifiers) == len(set(identifiers))
    assert len(page) < 2_000_000
    in_light = light(page)
    assert 'stroke="#0b62a8"' in in_light and '"var(--' not in in_light


def test_report_rebuilds_the_same_page(folder, page) -> None:
    """`starcal calibrate` draws what it holds, `starcal report` what it reads."""
    assert main.main(['report', str(folder)]) == EXIT_ACCEPTED
    assert (folder / REPORT_FILE).read_text() == page


def test_a_refused_calibration_alone_says_why_and_what_is_missing(tiny, tmp_path) -> None:
    """Also that no checks of the gate are in it, as before they were recorded."""
    reasons = ('residual 2 px & more is over the limit',)
    text = page_of(tiny, tmp_path, accepted=False, reasons=reasons, gate=())
    assert 'no residuals of single stars (residuals.npz)' in text
    assert 'without access to the images' in text
    assert 'id="figure-vectors"' in text and 'id="figure-images"' not in text
    assert '✕ Refused' in text and '✓ Accepted' not in text
    assert 'Residual 2 px &amp; more is over the limit.' in text
    assert 'does not record the gate checks' in text
    assert 'The gate checks are not recorded' in text


def test_of_the_camera_alone_nothing_is_said_of_an_alignment(folder, tiny, tmp_path) -> None:
    times = 'of the file: 10 of 10 images state none'
    provenance = {**tiny.provenance, TIMES: times}
    shutil.copy(folder / products.RESIDUALS_FILE, tmp_path)
    text = page_of(tiny, tmp_path, parent_frame='', provenance=provenance)
    for words in ('Orientation of', 'x, y, z, w', 'href="#alignment"',
                  'Alignment: small rotation', ' on <code></code>', ' on </td>'):  # fmt: skip
        assert words not in text, words
    assert 'No alignment: the attitudes come from the stars' in text
    assert text.count(times) == 2  # of the header and of the table to sign


def test_the_gate_is_shown_as_the_calibration_holds_it(tiny, tmp_path) -> None:
    assert len(tiny.gate) >= 15  # nine limits, and each unknown with a prior
    checks = {check.option: check for check in tiny.gate}
    failed = dataclasses.replace(checks['max_rejected_fraction'], found=8.125, passed=False)
    not_checked = dataclasses.replace(
        checks['max_rotation_deg'], found=math.nan, passed=None, note='nothing to compare with'
    )
    text = page_of(tiny, tmp_path, gate=(failed, not_checked))
    table = re.findall(
        r'<section id="gate">.*?<table class="limits">.*?</table>', text, re.DOTALL
    )[0]
    rows = [re.findall(r'<t[hd][^>]*>(.*?)</t[hd]>', row) for row in table.split('<tr>')[2:]]
    limit = f'at most {not_checked.limit_text}'
    names = [
        f'{check.name} <code>{check.option.replace("_", "_<wbr>")}</code>'
        for check in (failed, not_checked)
    ]
    assert rows == [
        [names[0], 'failed', '8.125', 'at most 0.25', ''],
        [names[1], 'not checked', '', limit, not_checked.note],
    ]


def test_names_are_text_and_never_markup(folder, tiny, tmp_path) -> None:
    evil = '</script><script>alert(1)</script><img src=x onerror=alert(1)>'
    shutil.copy(folder / products.RESIDUALS_FILE, tmp_path)
    text = page_of(
        tiny,
        tmp_path,
        child_frame=evil,
        weakest_direction=evil,
        provenance={**tiny.provenance, evil: evil, 'options': 'no JSON', 'prior': '[1]'},
        images_refused={evil: 1},
    )
    assert '<script>alert' not in text and '<img src=x' not in text
    assert '<th scope="col">prior</th>' not in text  # not known: no empty columns


def test_numbers_that_are_none_do_no_harm(folder, tiny, tmp_path) -> None:
    """A calibration with nothing finite in it, and residuals of which none was used."""
    left = products.read_residuals(folder / products.RESIDUALS_FILE)
    nothing = dataclasses.replace(
        left,
        used=np.zeros_like(left.used),
        attitude_error_arcsec=np.full_like(left.attitude_error_arcsec, np.nan),
    )
    products.write_residuals(nothing, tmp_path / products.RESIDUALS_FILE)
    none = {'maps': None, 'correlation': None, 'time_ns': 0}
    nan = {'residual_rms_px': np.nan, 'variance_factor': np.nan}
    covariance = np.full((13, 13), np.nan)
    assert '<html' in page_of(tiny, tmp_path, covariance=covariance, **none, **nan)


@pytest.mark.slow
@drawn(5)
@given(CHANGES)
def test_a_report_of_an_odd_calibration(folder, changes) -> None:
    content = json.loads((folder / CALIBRATION_FILE).read_text())
    changed = folder.with_name('changed')
    shutil.copytree(folder, changed, dirs_exist_ok=True)
    (changed / CALIBRATION_FILE).write_text(json.dumps(with_changes(content, changes)))
    assert main.main(['report', str(changed)]) in (EXIT_ACCEPTED, EXIT_BAD_INPUT)


BROWSER = next(
    filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), ''
)
# Put first in the page: what goes wrong is kept from the start.
_WATCH = """<script>
window.wrong = [];
addEventListener('error', (e) => wrong.push(e.message || 'a resource did not load'), true);
document.addEventListener('securitypolicyviolation', (e) => wrong.push(e.blockedURI));
</script>"""
# Put last: writes down what the page looks like.
_MEASURE = """<script>
addEventListener('load', () => {
  const figures = {};
  for (const figure of document.querySelectorAll('figure[id]')) {
    const svg = figure.querySelector('svg'), box = svg.getBoundingClientRect();
    const words = [...figure.querySelectorAll('text')];
    const texts = words.map((t) => t.getBoundingClientRect());
    const letters = words.map((t) => parseFloat(getComputedStyle(t).fontSize));
    figures[figure.id] = [
      box.width, box.height, Math.max(...texts.map((t) => t.right)),
      Math.min(...letters) * box.width / svg.viewBox.baseVal.width,
    ];
  }
  const result = {
    wrong, figures, inner: innerWidth, scroll: document.documentElement.scrollWidth,
    paper: getComputedStyle(document.body).backgroundColor,
    unnamed: document.querySelectorAll('img:not([alt]), [role=img]:not([aria-label])').length,
    titles: document.querySelectorAll('#figure-images title').length,
    contents: getComputedStyle(document.querySelector('nav')).position,
    rows: new Set(
      [...document.querySelectorAll('.charts.first figure')].map((f) => f.offsetTop)
    ).size,
    loaded: [...document.images].every((image) => image.complete && image.naturalWidth > 0),
  };
  parent.postMessage(JSON.stringify(result), '*');
});
</script>"""


def shown(page: str, folder: Path, width: int, dark: bool) -> tuple[dict[str, Any], str]:
    """What a real browser makes of the page, and what it says on its console."""
    watched = page.replace('<head>', f'<head>{_WATCH}', 1).replace('</body>', f'{_MEASURE}</body>')
    (folder / 'watched.html').write_text(watched)
    # No window of the browser is as narrow as a phone: a frame is.
    frame = folder / 'frame.html'
    frame.write_text(
        '<script>addEventListener("message", (e) => document.body.dataset.measured = e.data)'
        f'</script><iframe src="watched.html" style="width:{width}px;height:900px;border:0">'
    )
    done = subprocess.run(
        [
            BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--disable-quic',
            '--no-first-run', '--disable-background-networking', '--disable-component-update',
            '--disable-sync', '--disable-dev-shm-usage', f'--user-data-dir={folder / "profile"}',
            '--enable-logging=stderr', '--window-size=1700,1000',
            f'--blink-settings=preferredColorScheme={0 if dark else 1}',
            '--dump-dom', frame.as_uri(),
        ],
        capture_output=True, text=True, check=True, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    found = re.search(r'data-measured="([^"]*)"', done.stdout)
    assert found is not None, done.stderr[-2000:]
    console = '\n'.join(line for line in done.stderr.splitlines() if 'CONSOLE' in line)
    return json.loads(found[1].replace('&quot;', '"')), console


@pytest.mark.packaging
@pytest.mark.slow
@pytest.mark.skipif(not BROWSER, reason='no Chromium on this machine')
@pytest.mark.parametrize(('width', 'dark'), [(400, False), (1280, False), (1600, True)])
def test_a_browser_shows_it(page, tmp_path, width, dark) -> None:
    measured, console = shown(page, tmp_path, width, dark)
    assert console == ''
    assert measured['wrong'] == []
    assert measured['inner'] == width
    assert measured['scroll'] <= width
    assert measured['paper'] == ('rgb(16, 21, 27)' if dark else 'rgb(255, 255, 255)')
    assert set(measured['figures']) == {f'figure-{name}' for name in FIGURES}
    for name, (wide, high, right, smallest) in measured['figures'].items():
        assert wide > 300 and high > 200, name
        assert right <= width, name
        assert smallest >= 9, name  # px, from which print on a screen is readable
    assert measured['loaded'] and measured['unnamed'] == 0
    assert measured['titles'] == 10  # one for each image
    assert measured['contents'] == 'sticky' and measured['rows'] == (3 if width == 400 else 1)


def test_a_remedy_is_a_sentence_and_only_a_parameter_is_code(tmp_path) -> None:
    mend = ('# no parameter mends this: record RAW images', 'search_radius_px: 40')
    record = NotCalibrated('no image matched', ('bag',), {'no_match': 3}, mend=mend)
    text = write_failure_page(record, tmp_path).read_text()
    assert '<li>No parameter mends this: record RAW images</li>' in text
    assert '<li><code>search_radius_px: 40</code></li>' in text


def test_letters_of_printed_figures_have_six_points() -> None:
    css = (Path(svg.__file__).parent / 'templates' / 'report.css').read_text()
    rule = re.search(r'\.charts > figure \{ display: inline-block;[^}]*width: (\d+)%', css)
    margins = re.search(r'size: A4; margin: \S+ (\d+)mm', css)
    assert rule is not None and margins is not None
    line_pt = (210 - 2 * int(margins[1])) / 25.4 * 72
    assert line_pt * int(rule[1]) / 100 * svg.LETTER / svg.WIDTH >= 6
