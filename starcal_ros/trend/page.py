# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of a trend, ``trend.html``: one file that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from pathlib import Path

import jinja2
import numpy as np

from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.products.files import write_atomically
from starcal_ros.report.charts import Chart
from starcal_ros.text import printable
from starcal_ros.trend.change_points import MAX_P_VALUE, SECONDS_PER_YEAR, Term
from starcal_ros.trend.charts import change_figure, series_figure
from starcal_ros.trend.rows import Row
from starcal_ros.trend.series import (
    activations,
    Active,
    Change,
    changes,
    groups,
    newest_of_each,
    Series,
    series_of,
    versions,
)

TREND_FILE = 'trend.html'
_LISTED = 200
_RECALIBRATE_PX = 0.1  # change from which a new calibration is worth its upload, on the figure


@dataclass(frozen=True)
class Finding:
    """A row of the table of findings."""

    series: str
    kind: str
    size: str
    p_value: str
    when: str


@dataclass(frozen=True)
class Camera:
    """The part of the page on one camera."""

    name: str
    rows: Sequence[Row]
    findings: Sequence[Finding]
    charts: Sequence[Chart]
    active: Sequence[tuple[str, str, str, str]]
    versions: Sequence[tuple[str, str, str, str]]
    assumed: bool


def write_page(rows: Sequence[Row], folder: Path, root: str) -> Path:
    """
    Write ``trend.html`` and return its path.

    Raises
    ------
    ProductError
        When it cannot be written.
    """
    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader('starcal_ros.trend'), jinja2.PackageLoader('starcal_ros.report')]
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    failures = [row for row in rows if row.error]
    cameras = [_camera(name, group) for name, group in groups(rows).items()]
    text = environment.get_template('trend.html').render(
        root=printable(root),
        cameras=cameras,
        failures=[(row.path, row.error) for row in failures[:_LISTED]],
        failure_count=len(failures),
        count=len(rows) - len(failures),
        max_p_value=f'{MAX_P_VALUE:g}',
    )
    path = folder / TREND_FILE
    write_atomically(path, text)
    return path


@np.errstate(all='ignore')  # a refused camera may be wild: no line of sight is not drawn
def _camera(name: str, group: Sequence[Row]) -> Camera:
    rows = newest_of_each(group)
    active = activations(group)
    shown = series_of(rows)
    new = changes(group, active)
    charts = [_change_chart(group, new)] if new else []
    charts += [_chart(one, rows) for one in shown]
    return Camera(
        name=name,
        rows=rows,
        findings=[_finding(one, term, rows) for one in shown for term in one.trend.terms],
        charts=charts,
        active=[_active(one, group, new) for one in active],
        versions=[
            (
                utc_text(group[v.recorded].time_ns)[:10],
                group[v.recorded].software,
                group[v.computed].software,
                f'{v.line_of_sight_px:.3f}',
            )
            for v in versions(group)
        ],
        assumed=any(one.assumed for one in active),
    )


def _finding(series: Series, term: Term, rows: Sequence[Row]) -> Finding:
    unit = series.unit and f' {series.unit}'
    per = {'drift': ' per year', 'temperature': ' per degC', 'step': ''}[term.kind]
    when = 'throughout'
    if term.kind == 'step':
        last, first = (rows[series.row[k]].time_ns for k in (term.after, term.after + 1))
        when = f'between {utc_text(last)[:10]} and {utc_text(first)[:10]}'
    sign = '\N{MINUS SIGN}' if term.size < 0 else '+'
    size = f'{sign}{abs(term.size):.3g} ± {term.sigma:.2g}{unit}{per}'
    p_value = f'{term.p_value:.1e}' if term.p_value > 1e-12 else 'below 1e-12'
    return Finding(series.name, term.kind, size, p_value, when)


def _active(one: Active, rows: Sequence[Row], new: Sequence[Change]) -> tuple[str, str, str, str]:
    """Times of a calibration, its name, and the largest change that was missed meanwhile."""
    row = rows[one.row]
    missed = [c.line_of_sight_px for c in new if c.against == one.row]
    until = utc_text(one.until_ns)[:16] if one.until_ns else 'now'
    name = f'{row.number}' if row.number else Path(row.path).parent.name
    worst = f'{max(missed):.3f}' if missed else 'none made'
    return utc_text(one.since_ns)[:16], until, name, worst


def _chart(series: Series, rows: Sequence[Row]) -> Chart:
    words = ', '.join(_words(term, series) for term in series.trend.terms) or 'no change found'
    scatter = series.trend.scatter
    about = '' if math.isnan(scatter) else f' Scatter about the fit: {scatter:.2f} of the sigmas.'
    text = f'{words[0].upper()}{words[1:]}.{about}'
    return Chart(series.name, series_figure(series, rows), text)


def _words(term: Term, series: Series) -> str:
    unit = series.unit and f' {series.unit}'
    size = f'{term.size:.3g}'.replace('-', '\N{MINUS SIGN}')
    if term.kind == 'step':
        return f'step of {size}{unit}'
    per = 'year' if term.kind == 'drift' else 'degC'
    return f'{term.kind} of {size}{unit} per {per}'


def _change_chart(rows: Sequence[Row], new: Sequence[Change]) -> Chart:
    worst = max(change.line_of_sight_px for change in new)
    over = sum(change.line_of_sight_px > _RECALIBRATE_PX for change in new)
    text = (
        f'Largest change of a line of sight that each calibration would have made: up to '
        f'{worst:.3g} px, {over} of {len(new)} over {_RECALIBRATE_PX:g} px (dashed).'
    )
    return Chart('Change by a recalibration', change_figure(new, rows, _RECALIBRATE_PX), text)


def span_years(rows: Sequence[Row]) -> float:
    """Time from the first to the last calibration, years."""
    times = [row.time_ns for row in rows if not row.error]
    if not times:
        return 0.0
    return (max(times) - min(times)) / NANOSECONDS_PER_SECOND / SECONDS_PER_YEAR
