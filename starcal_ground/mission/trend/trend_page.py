# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of a trend, ``trend.html``: one file that needs no network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
import math
from pathlib import Path

import numpy as np

from starcal_ground.mission.trend import series as trends
from starcal_ground.mission.trend.trend_table import Row
from starcal_ground.report import page, svg
from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.formats.products.product_files import write_atomically
from starcal_ros.text import printable

TREND_FILE = 'trend.html'
_LISTED = 200
_DRAWN = 10  # cameras with figures, 0.1 MB each, those that need attention first
_POINTS = 400  # calibrations in a figure; of more, each second one and so on: 200 bytes a point
_RECALIBRATE_PX = 0.1  # change from which a new calibration is worth its upload, on the figure
_HEIGHT = 270.0
_MARGIN_NS = 30 * 86400 * NANOSECONDS_PER_SECOND  # one calibration alone has dates about it
_TICKS = 6
_STEPS_MONTHS = (1, 2, 3, 6, 12, 24, 60, 120, 240)
_ATTENTION = {'drift': 'drifting', 'step': 'stepped'}
_PER = {'drift': ' per year', 'temperature': ' per degC', 'step': ''}
_LEAST_PX = 1e-4  # a smaller change is drawn as this one on the logarithmic axis


@dataclass(frozen=True)
class Page:
    """Path of a page, how many calibrations are on it, and the first failures."""

    path: Path
    calibrations: int
    failures: tuple[Row, ...]


@dataclass(frozen=True)
class _Judged:
    """
    A camera with its calibrations, those that differ, series, and its verdict.

    ``px`` is the change of the newest calibration against the active one; NaN without one.
    """

    name: str
    group: Sequence[Row]
    rows: Sequence[Row]
    shown: Sequence[trends.Series]
    px: float
    is_stable: bool | None
    verdict: tuple[str, ...]
    attention: str


def write_page(
    cameras: Iterable[Sequence[Row]], camera_count: int, folder: Path, root: str
) -> Page:
    """
    Write ``trend.html`` from the rows of one camera after the other.

    p-values are corrected for the number of cameras.  Raises ProductError when the page cannot be
    written.
    """
    max_p_value = trends.MAX_P_VALUE / max(camera_count, 1)
    failures: list[Row] = []
    drawn: list[_Judged] = []
    lines: list[tuple[str, str, str, int, str, float, str]] = []
    failed = count = 0
    for rows in cameras:
        bad = [row for row in rows if row.error]
        failures += bad[: _LISTED - len(failures)]
        failed, count = failed + len(bad), count + len(rows) - len(bad)
        for name, group in trends.groups(rows).items():
            one = _judged(name, group, max_p_value)
            calm = 'too few to tell' if one.is_stable is None else 'sound'
            newest = utc_text(one.rows[-1].time_ns)[:10]
            found = one.verdict[1]
            lines.append((name, one.attention, calm, len(one.rows), newest, one.px, found))
            drawn = sorted(
                [*drawn, one], key=lambda one: (not one.attention, -len(one.group), one.name)
            )[:_DRAWN]
    lines.sort(key=lambda line: (not line[1], -np.nan_to_num(line[5])))
    text = page.page_template('trend.html').render(
        root=printable(root),
        lines=lines if len(lines) > 1 else (),
        attention=sum(bool(attention) for _, attention, *_ in lines),
        cameras=[_camera(camera) for camera in drawn],
        failures=[(row.path, row.error) for row in failures],
        failure_count=failed,
        count=count,
        max_p_value=f'{max_p_value:.2g}',
    )
    path = folder / TREND_FILE
    write_atomically(path, text)
    return Page(path, count, tuple(failures))


@np.errstate(all='ignore')  # a refused camera may be wild: no line of sight is not drawn
def _judged(name: str, group: Sequence[Row], max_p_value: float) -> _Judged:
    rows, active = trends.distinct(group), trends.activations(group)
    shown, new = trends.series_of(rows, max_p_value), trends.changes(group, active[-1:])
    is_stable, verdict = verdict_of(rows, group, active, new, shown)
    px = new[-1].line_of_sight_px if new else math.nan
    missed = tuple(text for text in rows[-1].requirements if not text.endswith(': met'))
    attention = attention_of(shown, is_stable, missed)
    sentences = *verdict, *(f'Missed by the newest: {text}.' for text in missed)
    return _Judged(name, group, rows, shown, px, is_stable, sentences, attention)


def attention_of(
    shown: Sequence[trends.Series], is_stable: bool | None, missed: Sequence[str] = ()
) -> str:
    """
    Why a camera needs attention: drifting, stepped, changed, misses a requirement.

    Empty if it needs none.  Temperature asks for nothing to be done.
    """
    kinds = {term.kind for series in shown for term in series.trend.terms}
    reasons = [word for kind, word in _ATTENTION.items() if kind in kinds]
    reasons += ['changed'] * (is_stable is False)
    return ', '.join(reasons + ['misses a requirement'] * bool(missed))


@np.errstate(all='ignore')
def _camera(judged: _Judged) -> dict[str, object]:
    """The part of the page on one camera."""
    group, rows, shown = judged.group, judged.rows, judged.shown
    active = trends.activations(group)
    new = trends.changes(group, active)
    charts = [_change_chart(group, new)] if new else []
    charts += [_chart(series, rows) for series in shown]
    return {
        'name': judged.name,
        'headline': _HEADLINES[judged.is_stable],
        'verdict': judged.verdict,
        'rows': rows,
        'findings': [_finding(series, term, rows) for series, term in trends.findings(shown)],
        'charts': charts,
        'active': [_active(period, group, new) for period in active],
        'assumed': any(period.assumed for period in active),
    }


_HEADLINES = {
    True: ('', '✓ The active calibration holds'),
    False: (' refused', '✕ The newest calibration differs'),
    None: (' open', 'Too few calibrations to tell'),
}
"""Class and headline of a verdict."""


def verdict_of(
    rows: Sequence[Row],
    group: Sequence[Row],
    active: Sequence[trends.Active],
    new: Sequence[trends.Change],
    shown: Sequence[trends.Series],
) -> tuple[bool | None, tuple[str, str]]:
    """
    True while the active calibration holds, None if too few tell; with sentences on the changes.

    ``rows`` are the different calibrations of a group.
    """
    words = {'step': 'steps of', 'drift': 'drifts of', 'temperature': 'effects of temperature on'}
    terms, changes = trends.findings(shown), []
    for kind, word in words.items():
        names = dict.fromkeys(series.name for series, term in terms if term.kind == kind)
        changes += [f'{word} {", ".join(names)}'] if names else []
    text = f'Found: {"; ".join(changes)}.' if changes else 'No step or drift was found.'
    if len(rows) < trends.FEWEST:
        text = f'Steps and drifts need {trends.FEWEST} calibrations; there are {len(rows)}.'
    if not active:
        return None, ('None is active: the gate accepted none.', text)
    if len(rows) < 2:
        return None, ('There is none to compare the active calibration with.', text)
    later = [change for change in new if change.against == active[-1].row]
    if not later:
        return True, ('The active calibration is the newest one.', text)
    px = max(later, key=lambda change: group[change.row].time_ns).line_of_sight_px
    if px <= _RECALIBRATE_PX:
        judged = f'within {_RECALIBRATE_PX:g} px: the active one holds'
    else:
        judged = f'not within {_RECALIBRATE_PX:g} px: consider activating it'
    newest = f'The newest calibration changes lines of sight by up to {px:.2g} px, {judged}.'
    return px <= _RECALIBRATE_PX, (newest, text)


def _finding(series: trends.Series, term: trends.Term, rows: Sequence[Row]) -> dict[str, str]:
    """A row of the table of findings."""
    unit = series.unit and f' {series.unit}'
    when = 'throughout'
    if term.kind == 'step':
        last, first = (rows[series.row[k]].time_ns for k in (term.after, term.after + 1))
        when = f'between {utc_text(last)[:10]} and {utc_text(first)[:10]}'
    sign = '\N{MINUS SIGN}' if term.size < 0 else '+'
    size = f'{sign}{abs(term.size):.3g} ± {term.sigma:.2g}{unit}{_PER[term.kind]}'
    p_value = f'{term.p_value:.1e}' if term.p_value > 1e-12 else 'below 1e-12'
    return {
        'series': series.name,
        'kind': term.kind,
        'size': size,
        'p_value': p_value,
        'when': when,
    }


def _active(
    period: trends.Active, rows: Sequence[Row], new: Sequence[trends.Change]
) -> tuple[str, str, str, str]:
    """Times of a calibration, its name, and the largest change that was missed meanwhile."""
    row = rows[period.row]
    missed = [c.line_of_sight_px for c in new if c.against == period.row]
    until = utc_text(period.until_ns)[:16] if period.until_ns else 'now'
    name = f'{row.number}' if row.number else Path(row.path).parent.name
    worst = f'{max(missed):.3f}' if missed else 'none made'
    return utc_text(period.since_ns)[:16], until, name, worst


def _chart(series: trends.Series, rows: Sequence[Row]) -> svg.Chart:
    words = ', '.join(_words(term, series) for term in series.trend.terms) or 'no change found'
    scatter = series.trend.scatter
    about = '' if math.isnan(scatter) else f' Scatter about the fit: {scatter:.2f} of the sigmas.'
    every = _every(series.row)
    about += f' One in {every} calibrations is drawn.' if every > 1 else ''
    text = f'{words[0].upper()}{words[1:]}.{about}'
    return svg.Chart(series.name, series_figure(series, rows), text)


def _every(numbers: Sequence[object]) -> int:
    """Distance of those that are drawn; 1 for up to 400."""
    return -(-len(numbers) // _POINTS)


def _words(term: trends.Term, series: trends.Series) -> str:
    unit = series.unit and f' {series.unit}'
    size = f'{term.size:.3g}'.replace('-', '\N{MINUS SIGN}')
    return f'{term.kind} of {size}{unit}{_PER[term.kind]}'


def _change_chart(rows: Sequence[Row], new: Sequence[trends.Change]) -> svg.Chart:
    worst = max(change.line_of_sight_px for change in new)
    over = sum(change.line_of_sight_px > _RECALIBRATE_PX for change in new)
    text = (
        f'Largest change of a line of sight that each calibration would have made: up to '
        f'{worst:.3g} px, {over} of {len(new)} over {_RECALIBRATE_PX:g} px (dashed).'
    )
    return svg.Chart('Change by a recalibration', change_figure(new, rows), text)


def series_figure(series: trends.Series, rows: Sequence[Row]) -> svg.Drawing:
    """A number of calibrations over time with 1-sigma, its fit, and a line at each step."""
    at = _times([rows[index] for index in series.row])
    drawn = slice(None, None, _every(series.row))
    value, sigma = series.value[drawn], series.sigma[drawn]
    titles = [
        f'{utc_text(rows[index].time_ns)[:10]}: {v:.9g} ± {s:.2g} {series.unit}'
        for index, v, s in zip(series.row[drawn], value, sigma, strict=True)
    ]
    curves = [
        svg.Curve(at[drawn], value, svg.SERIES[0], 'calibration, 1-sigma', 'circle',
                  width=0, sigma=sigma, titles=titles)
    ]  # fmt: skip
    steps = sorted(term.after for term in series.trend.terms if term.kind == 'step')
    if series.trend.terms:
        fit, gaps = series.trend.fit, [step + 1 for step in steps]
        curves.append(
            svg.Curve(
                np.insert(at, gaps, np.nan), np.insert(fit, gaps, np.nan), svg.SERIES[1], 'fit'
            )
        )

    def lines_at_steps(panel: svg.Panel) -> None:
        for step in steps:
            panel.upright(at[step : step + 2].mean(), svg.MUTED, 1.0, '5 3')

    name = f'{series.name} ({series.unit})' if series.unit else series.name
    return _over_dates(at, curves, name, '', lines_at_steps)


def change_figure(new: Sequence[trends.Change], rows: Sequence[Row]) -> svg.Drawing:
    """Largest change that each calibration would have made, px, over time; logarithmic."""
    at = _times([rows[change.row] for change in new])
    curves = [
        svg.Curve(at, np.maximum(sizes, _LEAST_PX), colour, name, mark, width=0.9)
        for name, mark, colour, sizes in zip(
            ('line of sight', 'common rotation removed'),
            ('circle', 'square'),
            svg.SERIES[:2],
            ([change.line_of_sight_px for change in new], [change.shape_px for change in new]),
            strict=True,
        )
    ]
    curves.append(
        svg.Curve(_date_ends(at), [_RECALIBRATE_PX, _RECALIBRATE_PX], svg.MUTED, dash='5 3')
    )
    return _over_dates(at, curves, 'change against the active one (px)', 'y')


def _over_dates(
    at: Floats,
    curves: Sequence[svg.Curve],
    y_label: str,
    log: str = '',
    under: Callable[[svg.Panel], None] | None = None,
) -> svg.Drawing:
    ends = _date_ends(at)
    return svg.plot(curves, 'date', y_label, x=ends, x_ticks=_date_ticks(*ends), log=log,
                    under=under, height=_HEIGHT)  # fmt: skip


def _times(rows: Sequence[Row]) -> Floats:
    """Middle times (n,), seconds since 1970."""
    return np.array([row.time_ns for row in rows], np.float64) / NANOSECONDS_PER_SECOND


def _date_ends(at: Floats) -> tuple[float, float]:
    margin = _MARGIN_NS / NANOSECONDS_PER_SECOND
    return float(at.min()) - margin, float(at.max()) + margin


def _date_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Places, seconds since 1970, of the first days of months or years, and their names."""
    first = datetime.fromtimestamp(low, timezone.utc)
    last = datetime.fromtimestamp(high, timezone.utc)
    begin, end = (12 * date.year + date.month - 1 for date in (first, last))
    every = next((n for n in _STEPS_MONTHS if end - begin <= _TICKS * n), _STEPS_MONTHS[-1])
    ticks = []
    for month in range(-(-(begin + 1) // every) * every, end + 1, every):
        year, of_year = divmod(month, 12)
        date = datetime(year, of_year + 1, 1, tzinfo=timezone.utc)
        ticks.append((date.timestamp(), f'{year}' if every >= 12 else f'{year}-{of_year + 1:02d}'))
    return ticks
