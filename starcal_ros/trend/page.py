"""The page of a trend, ``trend.html``: one file that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
import math
from pathlib import Path

import jinja2
from markupsafe import Markup
import matplotlib
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure
import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.products.files import write_atomically
from starcal_ros.report import figures
from starcal_ros.trend.change_points import MAX_P_VALUE, SECONDS_PER_YEAR, Term
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
_SIZE = (6.4, 2.9)
_MARGIN_DAYS = 30.0
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
    charts: Sequence[tuple[str, Markup, str]]
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
    with matplotlib.rc_context(figures.STYLE):
        cameras = [_camera(k, name, group) for k, (name, group) in enumerate(groups(rows).items())]
    text = environment.get_template('trend.html').render(
        root=root,
        cameras=cameras,
        failures=[(row.path, row.error) for row in failures[:_LISTED]],
        failure_count=len(failures),
        count=len(rows) - len(failures),
        max_p_value=f'{MAX_P_VALUE:g}',
    )
    path = folder / TREND_FILE
    write_atomically(path, text)
    return path


def _camera(number: int, name: str, group: Sequence[Row]) -> Camera:
    rows = newest_of_each(group)
    active = activations(group)
    shown = series_of(rows)
    new = changes(group, active)
    charts = [_change_chart(number, group, new)] if new else []
    charts += [_chart(number, k, one, rows) for k, one in enumerate(shown)]
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
    name = f'calibration {row.number}' if row.number else Path(row.path).parent.name
    worst = f'{max(missed):.3f}' if missed else 'none made'
    return utc_text(one.since_ns)[:16], until, name, worst


def _dates(rows: Sequence[Row]) -> Floats:
    return np.asarray(
        date2num(
            [
                datetime.fromtimestamp(row.time_ns / NANOSECONDS_PER_SECOND, timezone.utc)
                for row in rows
            ]
        )
    )


def _chart(number: int, k: int, series: Series, rows: Sequence[Row]) -> tuple[str, Markup, str]:
    here = [rows[index] for index in series.row]
    figure = Figure(figsize=_SIZE, layout='constrained')
    axes = figure.subplots()
    at = _dates(here)
    axes.errorbar(
        at, series.value, series.sigma, fmt='o', markersize=3.2, color=figures.SERIES[0],
        elinewidth=0.9, label='calibration, 1-sigma',
    )  # fmt: skip
    steps = sorted(term.after for term in series.trend.terms if term.kind == 'step')
    if series.trend.terms:
        for start, end in zip([0, *(s + 1 for s in steps)], [*steps, len(at) - 1], strict=True):
            part = slice(start, end + 1)
            label = 'fit' if start == 0 else None
            axes.plot(
                at[part], series.trend.fit[part], color=figures.SERIES[1], lw=1.3, label=label
            )
        for step in steps:
            axes.axvline(at[step : step + 2].mean(), color=figures.INK, lw=0.9, ls='--')
        axes.legend(loc='best', ncols=2)
    _date_axis(axes, at)
    axes.set_ylabel(f'{series.name} ({series.unit})' if series.unit else series.name)
    words = ', '.join(_words(term, series) for term in series.trend.terms) or 'no change found'
    scatter = series.trend.scatter
    about = '' if math.isnan(scatter) else f' Scatter about the fit: {scatter:.2f} of the sigmas.'
    return series.name, figures.inline_svg(figure, f'trend-{number}-{k}'), f'{words}.{about}'


def _words(term: Term, series: Series) -> str:
    unit = series.unit and f' {series.unit}'
    if term.kind == 'step':
        return f'step of {term.size:.3g}{unit}'
    per = 'year' if term.kind == 'drift' else 'degC'
    return f'{term.kind} of {term.size:.3g}{unit} per {per}'


def _change_chart(
    number: int, rows: Sequence[Row], new: Sequence[Change]
) -> tuple[str, Markup, str]:
    figure = Figure(figsize=_SIZE, layout='constrained')
    axes = figure.subplots()
    at = _dates([rows[change.row] for change in new])
    for values, colour, label in (
        ([c.line_of_sight_px for c in new], figures.SERIES[0], 'line of sight'),
        ([c.shape_px for c in new], figures.SERIES[1], 'common rotation removed'),
    ):
        axes.plot(at, values, 'o-', markersize=3.2, lw=0.8, color=colour, label=label)
    axes.axhline(_RECALIBRATE_PX, color=figures.MUTED, lw=0.9, ls='--')
    axes.set_yscale('log')
    axes.set_ylabel('change against the active one (px)')
    axes.legend(loc='best', ncols=2)
    _date_axis(axes, at)
    worst = max(change.line_of_sight_px for change in new)
    over = sum(change.line_of_sight_px > _RECALIBRATE_PX for change in new)
    text = (
        f'Largest change of a line of sight that each calibration would have made: up to '
        f'{worst:.3g} px, {over} of {len(new)} over {_RECALIBRATE_PX:g} px (dashed).'
    )
    return 'A recalibration would have changed', figures.inline_svg(figure, f'new-{number}'), text


def _date_axis(axes: matplotlib.axes.Axes, at: Floats) -> None:
    # A span of seconds would be labelled by fractions of them.
    axes.set_xlim(at.min() - _MARGIN_DAYS, at.max() + _MARGIN_DAYS)
    locator = AutoDateLocator()
    axes.xaxis_date()
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))


def span_years(rows: Sequence[Row]) -> float:
    """Time from the first to the last calibration, years."""
    times = [row.time_ns for row in rows if not row.error]
    if not times:
        return 0.0
    return (max(times) - min(times)) / NANOSECONDS_PER_SECOND / SECONDS_PER_YEAR
