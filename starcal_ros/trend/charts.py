# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Charts of a trend over dates, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone

from markupsafe import Markup
import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.constants import NANOSECONDS_PER_SECOND, utc_text
from starcal_ros.report import svg
from starcal_ros.report.svg import in_digits, MUTED, Panel, round_step, Scale, SERIES
from starcal_ros.trend.rows import Row
from starcal_ros.trend.series import Change, Series

_LEFT, _RIGHT, _TOP, _BELOW, _HEIGHT = 84.0, 468.0, 10.0, 42.0, 270.0
_MARGIN_NS = 30 * 86400 * NANOSECONDS_PER_SECOND  # one calibration alone has dates about it
_LOG_ROOM = 1.5  # factor above and below the numbers of a logarithmic axis
_HEADROOM = 0.22  # of the height, for the legend
_TICKS = 6
_DIGITS = 1e4  # a number with more of them than a label holds is drawn as a difference
_STEPS_MONTHS = (1, 2, 3, 6, 12, 24, 60, 120, 240)
_LEAST_PX = 1e-4  # a smaller change is drawn as this one on the logarithmic axis


def series_figure(series: Series, rows: Sequence[Row]) -> Markup:
    """A number of calibrations over time with 1-sigma, its fit, and a line at each step."""
    at = _times([rows[index] for index in series.row])
    low = float((series.value - series.sigma).min())
    high = float((series.value + series.sigma).max())
    # A sigma below the last digit of its value leaves no range.
    room = 0.06 * max(high - low, 1e-12 * max(abs(low), abs(high)))
    low, high = low - room, high + room + _HEADROOM * (high - low)
    offset = _offset(low, high)
    panel = Panel(_dates(at), Scale(low - offset, high - offset, _HEIGHT - _BELOW, _TOP))
    name = series.name
    if offset:
        sign = '\N{MINUS SIGN}' if offset > 0 else '+'
        name = f'{series.name} {sign} {in_digits(abs(offset))}'
    label = f'{name} ({series.unit})' if series.unit else name
    panel.axes('date', label, x_ticks=_date_ticks(panel.x))
    steps = sorted(term.after for term in series.trend.terms if term.kind == 'step')
    for step in steps:
        date = at[step : step + 2].mean()
        panel.line([date, date], [panel.y.low, panel.y.high], MUTED, 1.0, '5 3')
    value = series.value - offset
    panel.bars(at, value, series.sigma, SERIES[0])
    titles = [
        f'{utc_text(rows[index].time_ns)[:10]}: {v:.9g} ± {s:.2g} {series.unit}'
        for index, v, s in zip(series.row, series.value, series.sigma, strict=True)
    ]
    panel.marks(at, value, SERIES[0], titles=titles)
    legend = [('calibration, 1-sigma', SERIES[0], 'circle')]
    if series.trend.terms:
        for start, end in zip([0, *(s + 1 for s in steps)], [*steps, len(at) - 1], strict=True):
            part = slice(start, end + 1)
            panel.line(at[part], series.trend.fit[part] - offset, SERIES[1], 1.6)
        legend.append(('fit', SERIES[1], 'line'))
    panel.legend(*legend)
    return svg.chart([panel], _HEIGHT)


def change_figure(new: Sequence[Change], rows: Sequence[Row], limit_px: float) -> Markup:
    """Largest change that each calibration would have made, px, over time; logarithmic."""
    at = _times([rows[change.row] for change in new])
    sizes = [
        np.maximum([change.line_of_sight_px for change in new], _LEAST_PX),
        np.maximum([change.shape_px for change in new], _LEAST_PX),
    ]
    finite = np.concatenate(sizes)
    finite = finite[np.isfinite(finite)]
    low = float(finite.min(initial=limit_px)) / _LOG_ROOM
    high = float(finite.max(initial=limit_px)) * _LOG_ROOM
    high *= (high / low) ** _HEADROOM
    panel = Panel(_dates(at), Scale(low, high, _HEIGHT - _BELOW, _TOP, is_log=True))
    panel.axes('date', 'change against the active one (px)', x_ticks=_date_ticks(panel.x))
    panel.line([panel.x.low, panel.x.high], [limit_px, limit_px], MUTED, 1.0, '5 3')
    names = ('line of sight', 'common rotation removed')
    shapes = ('circle', 'square')
    for values, colour, shape in zip(sizes, SERIES, shapes, strict=False):
        panel.line(at, values, colour, 0.9)
        panel.marks(at, values, colour, shape)
    panel.legend(*zip(names, SERIES, shapes, strict=False))
    return svg.chart([panel], _HEIGHT)


def _times(rows: Sequence[Row]) -> Floats:
    """Middle times (n,), seconds since 1970."""
    return np.array([row.time_ns for row in rows], np.float64) / NANOSECONDS_PER_SECOND


def _dates(at: Floats) -> Scale:
    margin = _MARGIN_NS / NANOSECONDS_PER_SECOND
    return Scale(float(at.min()) - margin, float(at.max()) + margin, _LEFT, _RIGHT)


def _offset(low: float, high: float) -> float:
    """Round number to draw values from ``low`` to ``high`` as differences to; 0: not needed."""
    step = round_step((high - low) / _TICKS)
    if max(abs(low), abs(high)) < _DIGITS * step:
        return 0.0
    coarse = round_step(50 * step)
    return round(0.5 * (low + high) / coarse) * coarse


def _date_ticks(x: Scale) -> list[tuple[float, str]]:
    """Places, seconds since 1970, of the first days of months or years, and their names."""
    first = datetime.fromtimestamp(x.low, timezone.utc)
    last = datetime.fromtimestamp(x.high, timezone.utc)
    begin, end = (12 * date.year + date.month - 1 for date in (first, last))
    every = next((n for n in _STEPS_MONTHS if end - begin <= _TICKS * n), _STEPS_MONTHS[-1])
    ticks = []
    for month in range(-(-(begin + 1) // every) * every, end + 1, every):
        year, of_year = divmod(month, 12)
        date = datetime(year, of_year + 1, 1, tzinfo=timezone.utc)
        ticks.append((date.timestamp(), f'{year}' if every >= 12 else f'{year}-{of_year + 1:02d}'))
    return ticks
