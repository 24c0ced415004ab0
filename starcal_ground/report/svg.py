# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Drawings as SVG text: shapes, panels with scales, and plots of curves with axes and a legend.

Colours are variables of report.css, so one drawing serves light, dark and print; letters are those
of the page.  Lengths are in units of the view box, `WIDTH` across a drawing, y down.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import html
import math
from pathlib import Path
import re

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcal_ros.arrays import Floats

WIDTH = 480.0
LETTER = 12.4  # at least 9 px on a screen of 400 px
INK, MUTED, GRID, PAPER = (f'var(--{name})' for name in ('ink', 'muted', 'grid', 'paper'))
SERIES = tuple(f'var(--series-{k})' for k in (1, 2, 3))

CHARACTER = 0.6 * LETTER  # width
_POINTS_BGR = (212, 139, 61)  # clouds of points are bitmaps: readable on white and on black
_PER_UNIT = 2  # pixels of a bitmap
_MARKS = {
    'circle': 'M{r},0A{r},{r} 0 1 1 -{r},0A{r},{r} 0 1 1 {r},0Z',
    'square': 'M-{r},-{r}H{r}V{r}H-{r}Z',
    'cross': 'M-{r},-{r}L{r},{r}M-{r},{r}L{r},-{r}',
}
_PALETTE = re.compile(r':root \{(.*?)\}', re.DOTALL)
_VARIABLE = re.compile(r'--([\w-]+): (#[0-9a-f]+)')


@dataclass(frozen=True)
class Drawing:
    """Elements of SVG in a view box of a height."""

    body: str
    height: float
    width: float = WIDTH

    def __html__(self) -> str:
        """SVG element in a page; hidden from screen readers, which get a caption."""
        return (
            f'<svg viewBox="0 0 {self.width:g} {self.height:g}" aria-hidden="true"'
            f' font-size="{LETTER:g}" fill="{INK}">{self.body}</svg>'
        )

    def document(self) -> str:
        """Text of an SVG file: the light palette on paper."""
        size = f'width="{self.width:g}" height="{self.height:g}"'
        return light(
            f'<svg xmlns="http://www.w3.org/2000/svg" {size}'
            f' viewBox="0 0 {self.width:g} {self.height:g}"'
            f' font-family="DejaVu Sans, Arial, sans-serif" font-size="{LETTER:g}" fill="{INK}">'
            f'<rect {size} fill="{PAPER}"/>{self.body}</svg>\n'
        )


@dataclass(frozen=True)
class Chart:
    """A drawing with title and caption; the caption also describes it to screen readers."""

    title: str
    svg: Drawing
    text: str

    def _repr_svg_(self) -> str:
        """Return the drawing, for notebooks."""
        return self.svg.document()


@dataclass(frozen=True)
class Curve:
    """
    Points (n,) of a plot: joined by a line of a width unless 0, marked if it has a mark.

    With a name it is in the legend.  ``sigma`` (n,) is drawn as bars; ``titles`` (n,) are shown by
    a browser on hover.
    """

    x: ArrayLike
    y: ArrayLike
    colour: str = INK
    name: str = ''
    mark: str = ''
    width: float = 1.5
    dash: str = ''
    size: float = 3.2
    sigma: Floats | None = None
    titles: Sequence[str] = ()


@dataclass(frozen=True)
class Scale:
    """Map from the values ``low`` to ``high`` onto the view box, ``start`` to ``end``."""

    low: float
    high: float
    start: float
    end: float
    is_log: bool = False

    def __call__(self, values: ArrayLike) -> Floats:
        """Place of values in the view box."""
        x = np.asarray(values, np.float64)
        low, high = self.low, self.high
        if self.is_log:
            x, low, high = np.log10(np.maximum(x, 1e-300)), math.log10(low), math.log10(high)
        return np.asarray(self.start + (x - low) / (high - low) * (self.end - self.start))

    def ticks(self, most: int = 6) -> list[float]:
        """Round values within the scale."""
        if self.is_log:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            for digits in ((1.0, 2.0, 5.0), (1.0,)):
                values = [k * 10.0**power for power in range(first, last + 1) for k in digits]
                values = [x for x in values if self.low <= x <= self.high]
                if len(values) <= most:
                    return values
            return values[:: -(-len(values) // most)]
        step = round_step((self.high - self.low) / most)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def round_step(least: float) -> float:
    """Smallest 1, 2 or 5 times a power of ten that is not less than a positive number."""
    power = 10.0 ** math.floor(math.log10(least))
    return float(next(k * power for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-9)))


def in_digits(value: float) -> str:
    """A number with a minus sign, not a hyphen, and without trailing digits."""
    return f'{0.0 if abs(value) < 1e-12 else value:.9g}'.replace('-', '\N{MINUS SIGN}')


def named(scale: Scale, most: int = 6) -> list[tuple[float, str]]:
    """Round values within a scale and their names."""
    return [(value, in_digits(value)) for value in scale.ticks(most)]


def light(text: str) -> str:
    """Text with the colours of the light palette in place of the variables of its drawings."""
    css = (Path(__file__).parent / 'templates' / 'report.css').read_text()
    match = _PALETTE.search(css)
    palette = dict(_VARIABLE.findall(match[1])) if match else {}
    return re.sub(r'(?<=")var\(--([\w-]+)\)(?=")', lambda name: palette[name[1]], text)


def sheet(rows: Sequence[Sequence[Drawing]], title: str = '') -> Drawing:
    """Drawings beside and below each other as one, under a title."""
    top, parts = (26.0 if title else 0.0), [words(8, 18, title, 'start')]
    for row in rows:
        left = 0.0
        for one in row:
            parts.append(
                f'<svg x="{left:g}" y="{top:g}" width="{one.width:g}" height="{one.height:g}"'
                f' viewBox="0 0 {one.width:g} {one.height:g}">{one.body}</svg>'
            )
            left += one.width
        top += max(one.height for one in row)
    width = max(sum(one.width for one in row) for row in rows)
    return Drawing(''.join(parts), top, width)


class Panel:
    """A rectangle of a drawing with two scales; its methods draw in the units of its data."""

    def __init__(self, x: Scale, y: Scale) -> None:
        self.x, self.y = x, y
        self.grid: list[str] = []
        self.inside: list[str] = []  # shown within the panel alone
        self.outside: list[str] = []
        self._left, self._right = sorted((x.start, x.end))
        self._top, self._bottom = sorted((y.start, y.end))

    def drawing(self, height: float, *others: Panel) -> Drawing:
        """The drawing of a panel and of others beside it."""
        body = []
        for panel in (self, *others):
            left, top = panel._left - 4, panel._top - 4  # marks on an end are whole
            wide, high = panel._right - left + 4, panel._bottom - top + 4
            clipped = (
                f'<svg x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{high:.1f}"'
                f' viewBox="{left:.1f} {top:.1f} {wide:.1f} {high:.1f}">'
            )
            body += [*panel.grid, clipped, *panel.inside, '</svg>', *panel.outside]
        return Drawing(''.join(body), height)

    def axes(
        self,
        x_label: str,
        y_label: str,
        x_ticks: Sequence[tuple[float, str]],
        y_ticks: Sequence[tuple[float, str]],
        is_framed: bool = False,
        is_turned: bool = False,
    ) -> None:
        """Ticks, values with their names, and labels of the axes; a grid unless framed."""
        left, right, top, bottom = self._left, self._right, self._top, self._bottom
        write, draw = self.outside.append, self.grid.append
        for value, name in x_ticks:
            x = float(self.x(value))
            draw('' if is_framed else _line(x, top, x, bottom, GRID, 0.7))
            write(words(x, bottom + 15, name, 'end' if is_turned else 'middle',
                        turn_deg=-40.0 * is_turned))  # fmt: skip
        for value, name in y_ticks:
            y = float(self.y(value))
            draw('' if is_framed else _line(left, y, right, y, GRID, 0.7))
            write(words(left - 6, y + 4, name, 'end'))
        frame = f'M{left:.1f},{top:.1f}V{bottom:.1f}H{right:.1f}'
        frame += f'V{top:.1f}Z' if is_framed else ''
        write(f'<path d="{frame}" fill="none" stroke="{MUTED}" stroke-width=".8"/>')
        write(words((left + right) / 2, bottom + (58 if is_turned else 32), x_label))
        write(words(13, (top + bottom) / 2, y_label, turn_deg=-90))

    def curve(self, curve: Curve) -> None:
        """Line, bars and marks of a curve; it is broken where a number is not finite."""
        places = np.stack([self.x(curve.x), self.y(curve.y)], axis=-1)
        if curve.sigma is not None:
            y, sigma = np.asarray(curve.y), curve.sigma
            ends = np.c_[places[:, 0], self.y(y - sigma), self.y(y + sigma)]
            bars = [f'M{u:.1f},{a:.1f}V{b:.1f}M{u - 2:.1f},{a:.1f}h4M{u - 2:.1f},{b:.1f}h4'
                    for u, a, b in ends[np.isfinite(ends).all(axis=1)]]  # fmt: skip
            self.inside.append(_stroke(''.join(bars), curve.colour, 1.2))
        if curve.width:
            self.path(places, curve.colour, curve.width, curve.dash)
        if curve.mark:
            for k, (u, v) in enumerate(places):
                if math.isfinite(u) and math.isfinite(v):
                    title = curve.titles[k] if curve.titles else ''
                    self.inside.append(_mark(u, v, curve.colour, curve.mark, curve.size, title))

    def path(self, places: Floats, colour: str, width: float = 1.5, dash: str = '') -> None:
        """A line through places (n, 2) of the view box, broken where one is not finite."""
        known = np.asarray(np.isfinite(places).all(axis=1))
        pens = np.where(np.r_[False, known[:-1]], 'L', 'M')
        steps = [f'{pen}{u:.1f},{v:.1f}' for pen, (u, v) in zip(pens[known], places[known])]  # noqa: B905
        self.inside.append(_stroke(''.join(steps), colour, width, dash))

    def band(self, low: float, high: float) -> None:
        """A pale band between two values of y."""
        top, bottom = sorted(self.y(np.array([low, high])).tolist())
        self.inside.append(
            f'<rect x="{self._left:.1f}" y="{top:.1f}" width="{self._right - self._left:.1f}"'
            f' height="{bottom - top:.1f}" fill="{GRID}" fill-opacity="0.6"/>'
        )

    def upright(self, x: float, colour: str = GRID, width: float = 1.5, dash: str = '') -> None:
        """A line at a value of x, from bottom to top."""
        self.curve(Curve([x, x], [self.y.low, self.y.high], colour, width=width, dash=dash))

    def cloud(self, points: Floats, radius: float, opacity: float) -> None:
        """Many points (n, 2) as a bitmap; where they overlap they add up."""
        columns = round((self._right - self._left) * _PER_UNIT)
        rows = round((self._bottom - self._top) * _PER_UNIT)
        u = np.floor((self.x(points[:, 0]) - self._left) * _PER_UNIT)
        v = np.floor((self.y(points[:, 1]) - self._top) * _PER_UNIT)
        inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        index = (v[inside] * columns + u[inside]).astype(np.int64)
        hits = np.bincount(index, minlength=rows * columns).reshape(rows, columns)
        reach = max(1, round(radius * _PER_UNIT))
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        covered = cv2.filter2D(
            hits.astype(np.float32), -1, disc.astype(np.float32), borderType=cv2.BORDER_CONSTANT
        )
        bgra = np.empty((rows, columns, 4), np.uint8)
        bgra[..., :3] = _POINTS_BGR
        # Rounded: large discs are applied by Fourier transforms.
        count = np.maximum(np.rint(covered), 0).astype(np.int64)
        of_count = np.rint(255 * (1 - (1 - opacity) ** np.arange(count.max() + 1)))
        bgra[..., 3] = of_count.astype(np.uint8)[count]
        self.picture(bgra)

    def picture(self, pixels: NDArray[np.uint8]) -> None:
        """A picture, BGR or BGRA, that fills the panel."""
        _, encoded = cv2.imencode('.png', pixels)
        data = base64.b64encode(encoded.tobytes()).decode('ascii')
        self.inside.append(
            f'<image x="{self._left:.1f}" y="{self._top:.1f}"'
            f' width="{self._right - self._left:.1f}" height="{self._bottom - self._top:.1f}"'
            f' preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'
        )

    def text(self, x: float, y: float, text: str, colour: str = INK, edge: str = PAPER,
             size: float = LETTER) -> None:  # fmt: skip
        """Words in the middle of a place of the data, on an edge of another colour."""
        u, v = float(self.x(x)), float(self.y(y)) + 0.35 * size
        self.outside.append(words(u, v, text, colour=colour, edge=edge, size=size))

    def note(self, text: str, colour: str = MUTED, edge: str = PAPER) -> None:
        """Words in the middle of the panel, where there is nothing to draw."""
        middle = (self._left + self._right) / 2, (self._top + self._bottom) / 2
        self.outside.append(words(*middle, text, colour=colour, edge=edge))

    def legend(self, curves: Sequence[Curve], is_left: bool = False) -> None:
        """Names of curves, each with its mark or line, in an upper corner."""
        widest = max((len(curve.name) for curve in curves), default=0) * CHARACTER
        left = self._left + 10 if is_left else self._right - widest - 28
        for k, curve in enumerate(curves):
            y = self._top + 12 + 16 * k
            if curve.width:
                ends, width = (left, y, left + 20, y), max(curve.width, 1.8)
                self.outside.append(_line(*ends, curve.colour, width, curve.dash))
            if curve.mark:
                self.outside.append(_mark(left + 10, y, curve.colour, curve.mark, curve.size, ''))
            self.outside.append(words(left + 26, y + 4, curve.name, 'start', edge=PAPER))


def arrow(start: Floats, along: Floats, colour: str) -> str:
    """An arrow in units of the view box; a dot where it is shorter than one."""
    length = float(np.hypot(*along))
    if not math.isfinite(length):
        return ''
    x, y = start
    if length < 1.0:
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r=".8" fill="{colour}"/>'
    e = along / length
    head = min(6.0, 0.5 * length)
    tip, neck = start + along, start + along - head * e
    side = 0.4 * head * np.array([-e[1], e[0]])
    (a, b), (c, d) = neck + side, neck - side
    return (
        _line(x, y, neck[0], neck[1], colour, 1.3)
        + f'<path d="M{tip[0]:.1f},{tip[1]:.1f}L{a:.1f},{b:.1f}L{c:.1f},{d:.1f}Z"'
        f' fill="{colour}"/>'
    )


def words(
    x: float, y: float, text: str, anchor: str = 'middle', colour: str = INK,
    size: float = LETTER, turn_deg: float = 0.0, edge: str = '',
) -> str:  # fmt: skip
    """Words at a place of the view box, on an edge of a colour if one is given."""
    if not text:
        return ''
    turned = f' transform="rotate({turn_deg:.0f} {x:.1f} {y:.1f})"' if turn_deg else ''
    sized = f' font-size="{size:g}"' if size != LETTER else ''
    opening = f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{sized}{turned}'
    closing = f'>{html.escape(text)}</text>'
    # Drawn twice: not all that draw SVG paint the edge of a letter below its face.
    below = f'{opening} fill="none" stroke="{edge}" stroke-width="3"{closing}' if edge else ''
    return f'{below}{opening} fill="{colour}"{closing}'


def _stroke(path: str, colour: str, width: float, dash: str = '') -> str:
    dashes = f' stroke-dasharray="{dash}"' if dash else ''
    style = f'fill="none" stroke="{colour}" stroke-width="{width:g}"{dashes}'
    return f'<path d="{path}" {style} stroke-linejoin="round"/>' if path else ''


def _line(
    x1: float, y1: float, x2: float, y2: float, colour: str, width: float, dash: str = ''
) -> str:
    return _stroke(f'M{x1:.1f},{y1:.1f}L{x2:.1f},{y2:.1f}', colour, width, dash)


def _mark(x: float, y: float, colour: str, shape: str, size: float, title: str) -> str:
    path = _MARKS[shape].replace('{r}', f'{size:g}')
    style = f'fill="{colour}"'
    if shape == 'cross':
        style = f'fill="none" stroke="{colour}" stroke-width="1.5"'
    inside = f'<title>{html.escape(title)}</title>' if title else ''
    return f'<path transform="translate({x:.1f} {y:.1f})" d="{path}" {style}>{inside}</path>'


HEIGHT = 340.0

Range = tuple[float | None, float | None]
"""Limits of an axis; None: the range of the data."""

_MARGIN = 0.04  # free part of an axis at each end, in ranges of the data


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
        replace(scale_x, start=left, end=WIDTH - 12),
        replace(scale_y, start=height - below, end=top),
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
