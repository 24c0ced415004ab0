# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Curves with axes and a legend, as SVG."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike

from starcal_ground.report.svg import CHARACTER, Curve, Drawing, named, Panel, Scale, WIDTH, words

HEIGHT = 340.0

Range = tuple[float | None, float | None]
"""Limits of an axis; None: the range of the data."""

_MARGIN = 0.04  # of the range of the data, at each end of an axis


def plot(
    curves: Sequence[Curve],
    x_label: str,
    y_label: str,
    *,
    x: Range = (None, None),
    y: Range = (None, None),
    log: str = '',
    x_ticks: Sequence[tuple[float, str]] | None = None,
    y_ticks: Sequence[tuple[float, str]] | None = None,
    title: str = '',
    height: float = HEIGHT,
    is_left: bool = False,
    letters: int = 0,
    under: Callable[[Panel], None] | None = None,
) -> Drawing:
    """
    Curves with axes and a legend.  The y axis leaves room for it unless its top is given.

    ``log`` holds the letters of the logarithmic axes.  ``x_ticks`` and ``y_ticks`` are values and
    labels (default: round numbers).  ``is_left`` puts the legend on the left; ``letters`` is the
    least room for the labels of ``y_ticks``, so that plots below each other agree; ``under`` draws
    below the curves.
    """
    top = 28.0 if title else 10.0
    entries = sum(bool(curve.name) for curve in curves)
    ends_x = _ends([curve.x for curve in curves], x, 'x' in log)
    reach = [np.asarray(c.y) + side * (0 if c.sigma is None else c.sigma)
             for c in curves for side in (-1, 1)]  # fmt: skip
    room = 16.0 * entries / (height - top - 50.0)
    ends_y = _ends(reach, y, 'y' in log, room)
    scale_x, scale_y = Scale(*ends_x, 0, 1, 'x' in log), Scale(*ends_y, 0, 1, 'y' in log)
    most = max(3, min(6, round(height / 45)))
    x_names = x_ticks if x_ticks is not None else named(scale_x) if x_label else ()
    y_names = y_ticks if y_ticks is not None else named(scale_y, most)
    left = 30.0 + CHARACTER * max((len(name) for _, name in y_names), default=0)
    left = max(left, 30.0 + CHARACTER * letters)
    widest = CHARACTER * max((len(name) + 1 for _, name in x_names), default=0)
    is_turned = widest * len(x_names) > WIDTH - left
    below = (24.0 if x_names else 6.0) + (18.0 if x_label else 0.0) + (26.0 if is_turned else 0.0)
    panel = Panel(
        dataclasses.replace(scale_x, start=left, end=WIDTH - 12),
        dataclasses.replace(scale_y, start=height - below, end=top),
    )
    if under is not None:
        under(panel)
    panel.axes(x_label, y_label, x_names, y_names, is_turned=is_turned)
    panel.outside.append(words(left, 16, title, 'start'))
    for curve in curves:
        panel.curve(curve)
    panel.legend([curve for curve in curves if curve.name], is_left)
    return panel.drawing(height)


def _ends(
    data: Sequence[ArrayLike], given: Range, is_log: bool, room: float = 0.0
) -> tuple[float, float]:
    """Given limits of an axis, or those of the finite data with a margin and room above."""
    values = np.concatenate([np.ravel(one).astype(np.float64) for one in data] or [np.empty(0)])
    values = values[np.isfinite(values) & ((values > 0) | (not is_log))]
    low, high = (
        end if end is not None else float(of(values)) if len(values) else default
        for end, of, default in zip(given, (np.min, np.max), (0.1 * is_log, 1.0), strict=True)
    )
    if is_log:
        low, high = math.log10(low), math.log10(high)
    # A range below rounding errors counts as zero.
    if not high - low > 1e-12 * max(abs(low), abs(high)):
        low, high = low - 0.5 * (given[0] is None), high + 0.5
    span = high - low
    low -= _MARGIN * span * (given[0] is None)
    high += (_MARGIN * span + room * span / max(1 - room, 0.3)) * (given[1] is None)
    return (10.0**low, 10.0**high) if is_log else (low, high)
