# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The page of a trend, ``trend.html``: one file that needs no network."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np

from starcal_ground.mission.trend import series as trends
from starcal_ground.mission.trend.series import Change, Series, Term
from starcal_ground.mission.trend.trend_table import Row
from starcal_ground.report import page, svg
from starcal_ground.written_files import write_marked
from starcal_ros.arrays import Floats
from starcal_ros.assessment.requirements import requirement_answers
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.text import printable, significant

TREND_FILE = 'trend.html'
_LISTED = 200
_DRAWN = 10  # cameras with figures, 0.1 MB each, those that need attention first
_POINTS = 400  # calibrations in a figure; of more, each second one and so on: 200 bytes a point
_RECALIBRATE_PX = 0.1  # change from which a new calibration is worth its upload, on the figure
_LEAST_PX = 1e-4  # a smaller change is drawn as this one on the logarithmic axis
_HEIGHT = 270.0
_MARGIN_S = 30 * 86400.0  # one calibration alone has dates about it
_TICKS = 6
_STEPS_MONTHS = (1, 2, 3, 6, 12, 24, 60, 120, 240)
_FOUND = {  # words of a verdict on terms, and what they ask for; temperature asks for nothing
    trends.STEP: ('steps of', 'stepped'),
    trends.DRIFT: ('drifts of', 'drifting'),
    trends.TEMPERATURE: ('effects of temperature on', ''),
}
_PER = {trends.DRIFT: ' per year', trends.TEMPERATURE: ' per degC', trends.STEP: ''}


@dataclass(frozen=True)
class Verdict:
    """
    Verdict on a camera.

    ``is_stable`` is True while the active calibration holds, None if too few tell; ``attention``
    why the camera needs attention, empty if it needs none; ``px`` the change of the newest
    calibration against the active one, NaN without one; ``found`` the sentence on steps and
    drifts, one of ``sentences``.
    """

    name: str
    count: int
    newest: str
    is_stable: bool | None
    px: float
    attention: str
    found: str
    sentences: tuple[str, ...]

    @property
    def word(self) -> str:
        """The verdict in a few words."""
        return self.attention or ('too few to tell' if self.is_stable is None else 'sound')

    @property
    def headline(self) -> tuple[str, str]:
        """Class and headline on the page: the word, with a tick where nothing needs attention."""
        if self.attention:
            return ' refused', f'✕ Needs attention: {self.word}'
        word = f'{self.word[0].upper()}{self.word[1:]}'
        return (' open', word) if self.is_stable is None else ('', f'✓ {word}')


@dataclass(frozen=True)
class Page:
    """
    Path of a page, how many calibrations are on it, and the first failures.

    ``verdicts`` are those of the cameras, those that need attention first.
    """

    path: Path
    calibrations: int
    failures: tuple[Row, ...]
    verdicts: tuple[Verdict, ...]


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
    drawn: list[tuple[Verdict, Sequence[Row], Sequence[Series]]] = []
    verdicts: list[Verdict] = []
    failed = count = 0
    for rows in cameras:
        bad = [row for row in rows if row.error]
        failures += bad[: _LISTED - len(failures)]
        failed, count = failed + len(bad), count + len(rows) - len(bad)
        for name, group in trends.groups(rows).items():
            # A refused camera may be wild: no line of sight is not drawn.
            with np.errstate(all='ignore'):
                shown = trends.series_of(trends.distinct(group), max_p_value)
                verdict = verdict_of(name, group, shown)
            verdicts.append(verdict)
            drawn.append((verdict, group, shown))
            drawn.sort(key=lambda one: (not one[0].attention, -len(one[1]), one[0].name))
            del drawn[_DRAWN:]
    verdicts.sort(key=lambda one: (not one.attention, -np.nan_to_num(one.px)))
    text = page.page_template('trend.html').render(
        root=printable(root),
        verdicts=verdicts,
        attention=sum(bool(verdict.attention) for verdict in verdicts),
        cameras=[_camera(*camera) for camera in drawn],
        failures=failures,
        failure_count=failed,
        count=count,
        max_p_value=f'{max_p_value:.2g}',
    )
    path = folder / TREND_FILE
    write_marked(path, text)
    return Page(path, count, tuple(failures), tuple(verdicts))


def verdict_of(name: str, group: Sequence[Row], shown: Sequence[Series]) -> Verdict:
    """Verdict on a camera by its calibrations and by the series of those that differ."""
    rows, active = trends.distinct(group), trends.activations(group)
    later = [trends.change(group, *pair) for pair in trends.pairs(group, active[-1:])[-1:]]
    terms = [(series, term) for series in shown for term in series.trend.terms]
    found, reasons = [], []
    for kind, (words, reason) in _FOUND.items():
        if names := dict.fromkeys(series.name for series, term in terms if term.kind == kind):
            found.append(f'{words} {", ".join(names)}')
            reasons.append(reason)
    text = f'Found: {"; ".join(found)}.' if found else 'No step or drift was found.'
    if len(rows) < trends.FEWEST:
        text = f'Steps and drifts need {trends.FEWEST} calibrations; there are {len(rows)}.'
    is_stable, px = True if active and len(rows) > 1 else None, math.nan
    judged = 'The active calibration is the newest one.'
    if not active:
        judged = 'None is active: the gate accepted none.'
    elif len(rows) < 2:
        judged = 'There is none to compare the active calibration with.'
    elif later:
        px = later[0].px
        is_stable = px <= _RECALIBRATE_PX
        judged = (
            f'The newest calibration changes lines of sight by up to {px:.2g}'
            f' px{_in_sigmas(later[0])}, '
            + (
                f'within {_RECALIBRATE_PX:g} px: the active one holds.'
                if is_stable
                else f'not within {_RECALIBRATE_PX:g} px: consider activating it.'
            )
        )
    (newest,) = trends.calibrations(rows[-1:])
    missed = [text for text in requirement_answers(newest) if not text.endswith(': met')]
    reasons += ['changed'] * (is_stable is False) + ['misses a requirement'] * bool(missed)
    sentences = (judged, text, *(f'Missed by the newest: {text}.' for text in missed))
    date, attention = utc_text(rows[-1].time_ns)[:10], ', '.join(filter(None, reasons))
    return Verdict(name, len(rows), date, is_stable, px, attention, text, sentences)


def _in_sigmas(change: Change) -> str:
    """The size of a change in its 1-sigma, as a remark; nothing where that is not known."""
    known = math.isfinite(change.sigmas)
    return f' ({significant(change.sigmas, 2)} sigma)' if known else ''


@np.errstate(all='ignore')
def _camera(verdict: Verdict, group: Sequence[Row], shown: Sequence[Series]) -> dict[str, object]:
    """The part of the page on one camera."""
    rows, active = trends.distinct(group), trends.activations(group)
    new = [trends.change(group, *pair) for pair in trends.pairs(group, active)]
    charts = [_change_chart(group, new)] if new else []
    return {
        'verdict': verdict,
        'findings': [
            (series.name, term.kind, _size(series, term), *_when(series, term, rows))
            for series in shown
            for term in series.trend.terms
        ],
        'charts': charts + [_chart(series, rows) for series in shown],
        'assumed': active and not any(one.active_since_ns for one in trends.calibrations(group)),
    }


def _size(series: Series, term: Term) -> str:
    unit, sign = series.unit and f' {series.unit}', '\N{MINUS SIGN}' if term.size < 0 else '+'
    return f'{sign}{abs(term.size):.3g} ± {term.sigma:.2g}{unit}{_PER[term.kind]}'


def _when(series: Series, term: Term, rows: Sequence[Row]) -> tuple[str, str]:
    """The p-value of a term, and the dates about a step."""
    p_value = f'{term.p_value:.1e}' if term.p_value > 1e-12 else 'below 1e-12'
    if term.kind != trends.STEP:
        return p_value, 'throughout'
    about = (rows[series.row[k]].time_ns for k in (term.after, term.after + 1))
    last, first = (utc_text(time_ns)[:10] for time_ns in about)
    return p_value, f'between {last} and {first}'


def _chart(series: Series, rows: Sequence[Row]) -> svg.Chart:
    scatter = series.trend.scatter
    terms = (f'{term.kind} of {_size(series, term)}' for term in series.trend.terms)
    words = ', '.join(terms) or 'no change found'
    text = f'{words[0].upper()}{words[1:]}. Scatter about the fit: {scatter:.2f} of the sigmas.'
    if math.isnan(scatter):
        text = f'Not tested: {len(series.row)} of the {trends.FEWEST} calibrations that it needs.'
    return svg.Chart(series.name, _series_figure(series, rows), text)


def _series_figure(series: Series, rows: Sequence[Row]) -> svg.Drawing:
    """A number of calibrations over time with 1-sigma, its fit, and a line at each step."""
    at = _times([rows[index] for index in series.row])
    drawn = slice(None, None, -(-len(at) // _POINTS))
    value, sigma = series.value[drawn], series.sigma[drawn]
    titles = [
        f'{utc_text(rows[index].time_ns)[:10]}: {v:.9g} ± {s:.2g} {series.unit}'
        for index, v, s in zip(series.row[drawn], value, sigma, strict=True)
    ]
    curves = [
        svg.Curve(at[drawn], value, svg.SERIES[0], 'calibration, 1-sigma', 'circle',
                  width=0, sigma=sigma, titles=titles)
    ]  # fmt: skip
    steps = [term.after for term in series.trend.terms if term.kind == trends.STEP]
    if series.trend.terms:
        gaps = [step + 1 for step in steps]
        x, y = (np.insert(column, gaps, np.nan) for column in (at, series.trend.fit))
        curves.append(svg.Curve(x, y, svg.SERIES[1], 'fit'))

    def lines_at_steps(panel: svg.Panel) -> None:
        for step in steps:
            panel.upright(at[step : step + 2].mean(), svg.MUTED, 1.0, '5 3')

    name = f'{series.name} ({series.unit})' if series.unit else series.name
    ends = _date_ends(at)
    return svg.plot(curves, 'date', name, x=ends, x_ticks=_date_ticks(*ends),
                    under=lines_at_steps, height=_HEIGHT)  # fmt: skip


def _change_chart(rows: Sequence[Row], new: Sequence[Change]) -> svg.Chart:
    """Largest change that each calibration would have made, px, over time; logarithmic."""
    at, px = _times([rows[change.row] for change in new]), np.array([one.px for one in new])
    ends = _date_ends(at)
    titles = [f'{change.px:.3g} px{_in_sigmas(change)}' for change in new]
    curves = [
        svg.Curve(at, np.maximum(px, _LEAST_PX), svg.SERIES[0], 'line of sight', 'circle',
                  width=0.9, titles=titles),
        svg.Curve(ends, [_RECALIBRATE_PX, _RECALIBRATE_PX], svg.MUTED, dash='5 3'),
    ]  # fmt: skip
    worst = max(new, key=lambda change: change.px)
    text = (
        f'Largest change of a line of sight that each calibration would have made: up to '
        f'{worst.px:.3g} px{_in_sigmas(worst)}, {(px > _RECALIBRATE_PX).sum()} of {len(new)} over'
        f' {_RECALIBRATE_PX:g} px (dashed).'
    )
    drawing = svg.plot(curves, 'date', 'change against the active one (px)', x=ends,
                       x_ticks=_date_ticks(*ends), log='y', height=_HEIGHT)  # fmt: skip
    return svg.Chart('Change by a recalibration', drawing, text)


def _times(rows: Sequence[Row]) -> Floats:
    """Middle times (n,), seconds since 1970."""
    return np.array([row.time_ns for row in rows], np.float64) / NANOSECONDS_PER_SECOND


def _date_ends(at: Floats) -> tuple[float, float]:
    return float(at.min()) - _MARGIN_S, float(at.max()) + _MARGIN_S


def _date_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Places, seconds since 1970, of the first days of months or years, and their names."""
    first, last = (np.datetime64(int(end), 's').astype('datetime64[M]') for end in (low, high))
    months = np.arange(first + 1, last + 1)
    every = next((n for n in _STEPS_MONTHS if len(months) <= _TICKS * n), _STEPS_MONTHS[-1])
    shown = months[months.astype(np.int64) % every == 0]
    names = shown.astype('datetime64[Y]' if every >= 12 else 'datetime64[M]').astype(str)
    seconds = shown.astype('datetime64[s]').astype(np.float64)
    return list(zip(seconds.tolist(), names.tolist(), strict=True))
