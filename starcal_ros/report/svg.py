# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Charts as SVG text.

Colours are variables of report.css, so one drawing serves light, dark and print; letters are those
of the page.  Lengths are in units of the view box, `WIDTH` across a chart, y down.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import html
import math
import re

import cv2
from markupsafe import Markup
import numpy as np
from numpy.typing import ArrayLike, NDArray

from starcal_ros.arrays import Floats

WIDTH = 480.0
LETTER = 12.4  # at least 9 px on a screen of 400 px
INK, MUTED, GRID, PAPER, BAD = (
    f'var(--{name})' for name in ('ink', 'muted', 'grid', 'paper', 'bad')
)
SERIES = tuple(f'var(--series-{k})' for k in (1, 2, 3))

_POINTS_BGR = (212, 139, 61)  # of clouds, which are bitmaps: readable on white and on black
_TICK_CHARACTERS = 5  # beside the axis; more reach its label
_UNIT = re.compile(r'\(([^\s()]+)\)')
_PER_UNIT = 2  # pixels of a bitmap
_MARKS = {
    'circle': 'M{r},0A{r},{r} 0 1 1 -{r},0A{r},{r} 0 1 1 {r},0Z',
    'square': 'M-{r},-{r}H{r}V{r}H-{r}Z',
    'triangle': 'M0,-{r}L{r},{r}H-{r}Z',
    'cross': 'M-{r},-{r}L{r},{r}M-{r},{r}L{r},-{r}',
}


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

    def ticks(self, most: int) -> list[float]:
        """Round values within the scale."""
        if self.is_log:
            powers = range(math.ceil(math.log10(self.low)), math.floor(math.log10(self.high)) + 1)
            every = -(-len(powers) // most)
            return [10.0**power for power in powers[::every]]
        step = round_step((self.high - self.low) / most)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        return [k * step for k in range(first, last + 1)]


def round_step(least: float) -> float:
    """Smallest 1, 2 or 5 times a power of ten that is not less than a positive number."""
    power = 10.0 ** math.floor(math.log10(least))
    return float(next(k * power for k in (1, 2, 5, 10) if k * power >= least * (1 - 1e-9)))


def in_digits(value: float) -> str:
    """A number with a minus sign, not a hyphen, and without trailing digits."""
    return f'{0.0 if abs(value) < 1e-12 else value:.6g}'.replace('-', '\N{MINUS SIGN}')


def chart(panels: Iterable[Panel], height: float) -> Markup:
    """SVG element of panels below each other; hidden from screen readers, which get a caption."""
    # Safe as markup: all text in it has been escaped.
    return Markup(
        f'<svg viewBox="0 0 {WIDTH:g} {height:g}" aria-hidden="true" font-size="{LETTER:g}"'
        f' fill="{INK}">{"".join(part for panel in panels for part in panel.parts)}</svg>'
    )


class Panel:
    """A rectangle of a chart with two scales; its methods draw in the units of its data."""

    def __init__(self, x: Scale, y: Scale) -> None:
        self.x, self.y = x, y
        self.parts: list[str] = []
        self._left, self._right = sorted((x.start, x.end))
        self._top, self._bottom = sorted((y.start, y.end))

    def axes(
        self,
        x_label: str,
        y_label: str,
        is_framed: bool = False,
        most: int = 6,
        x_ticks: Sequence[tuple[float, str]] | None = None,
    ) -> None:
        """
        Lines, ticks and labels of the axes; a grid unless framed.  Without a label no axis.

        ``x_ticks`` are values and their names; None: round numbers.
        """
        draw = self.parts.append
        left, right, top, bottom = self._left, self._right, self._top, self._bottom
        if x_ticks is None:
            x_ticks = [(value, in_digits(value)) for value in self.x.ticks(6) if x_label]
        for value, name in x_ticks:
            x = float(self.x(value))
            if not is_framed:
                draw(_line(x, top, x, bottom, GRID, 0.7))
            draw(_text(x, bottom + 15, name, 'middle'))
        y_ticks = self.y.ticks(most) if y_label else []
        names, y_label = _short(y_ticks, y_label)
        for name, y in zip(names, self.y(np.array(y_ticks)), strict=True):
            if not is_framed:
                draw(_line(left, y, right, y, GRID, 0.7))
            draw(_text(left - 6, y + 4, name, 'end'))
        if is_framed:
            draw(
                f'<rect x="{left:.1f}" y="{top:.1f}" width="{right - left:.1f}"'
                f' height="{bottom - top:.1f}" fill="none" stroke="{MUTED}" stroke-width=".8"/>'
            )
        else:
            draw(_line(left, top, left, bottom, MUTED, 0.8))
            draw(_line(left, bottom, right, bottom, MUTED, 0.8))
        draw(_text((left + right) / 2, bottom + 32, x_label, 'middle'))
        middle = (top + bottom) / 2
        draw(_text(13, middle, y_label, 'middle', turn_deg=-90))

    def line(
        self, x: ArrayLike, y: ArrayLike, colour: str, width: float = 1.5, dash: str = ''
    ) -> None:
        """A line through points (n,); it is broken where a number is not finite."""
        places = np.stack([self.x(x), self.y(y)], axis=-1)
        steps, pen = [], 'M'
        for u, v in places:
            if not (math.isfinite(u) and math.isfinite(v)):
                pen = 'M'
                continue
            steps.append(f'{pen}{u:.1f},{v:.1f}')
            pen = 'L'
        self._clipped(
            f'<path d="{"".join(steps)}" fill="none" stroke="{colour}" stroke-width="{width:g}"'
            f' stroke-dasharray="{dash}" stroke-linejoin="round"/>'
        )

    def marks(
        self,
        x: ArrayLike,
        y: ArrayLike,
        colour: str,
        shape: str = 'circle',
        size: float = 3.2,
        titles: Sequence[str] = (),
    ) -> None:
        """Marks at points (n,), with titles (n,) that a browser shows on hover."""
        for k, (u, v) in enumerate(zip(self.x(x), self.y(y), strict=True)):
            if math.isfinite(u) and math.isfinite(v):
                self._clipped(_mark(u, v, colour, shape, size, titles[k] if titles else ''))

    def bars(self, x: Floats, y: Floats, sigma: Floats, colour: str) -> None:
        """Vertical bars (n,) of 1-sigma about points."""
        ends = zip(self.x(x), self.y(y - sigma), self.y(y + sigma), strict=True)
        for u, low, high in ends:
            if math.isfinite(low) and math.isfinite(high):
                self._clipped(
                    _line(u, low, u, high, colour, 1.2)
                    + _line(u - 2, low, u + 2, low, colour, 1.2)
                    + _line(u - 2, high, u + 2, high, colour, 1.2)
                )

    def band(self, low: float, high: float, is_vertical: bool = False) -> None:
        """A pale band between two values."""
        a, b = sorted((self.x if is_vertical else self.y)(np.array([low, high])).tolist())
        box = (a, self._top, b, self._bottom) if is_vertical else (self._left, a, self._right, b)
        self._clipped(
            f'<rect x="{box[0]:.1f}" y="{box[1]:.1f}" width="{box[2] - box[0]:.1f}"'
            f' height="{box[3] - box[1]:.1f}" fill="{GRID}" fill-opacity=".6"/>'
        )

    def cloud(self, x: Floats, y: Floats, radius: float, opacity: float) -> None:
        """Many points (n,) as a bitmap; where they overlap they add up."""
        columns = round((self._right - self._left) * _PER_UNIT)
        rows = round((self._bottom - self._top) * _PER_UNIT)
        u = np.floor((self.x(x) - self._left) * _PER_UNIT)
        v = np.floor((self.y(y) - self._top) * _PER_UNIT)
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
        self.parts.append(
            f'<image x="{self._left:.1f}" y="{self._top:.1f}"'
            f' width="{self._right - self._left:.1f}" height="{self._bottom - self._top:.1f}"'
            f' preserveAspectRatio="none" href="data:image/png;base64,{data}"/>'
        )

    def arrows(self, places: Floats, units: Floats, colour: str) -> None:
        """Arrows (n, 2) from places (n, 2), their lengths in units of the view box."""
        starts = np.stack([self.x(places[:, 0]), self.y(places[:, 1])], axis=-1)
        for start, along in zip(starts, units, strict=True):
            self.parts.append(arrow(start, along, colour))

    def text(
        self, x: float, y: float, words: str, anchor: str = 'middle', colour: str = INK,
        size: float = LETTER,
    ) -> None:  # fmt: skip
        """Words at a place of the data, on an edge of the colour of the page."""
        u, v = float(self.x(x)), float(self.y(y))
        self.parts.append(_text(u, v + 0.35 * size, words, anchor, colour, size, has_edge=True))

    def legend(self, *entries: tuple[str, str, str], is_left: bool = False) -> None:
        """Entries of label, colour and mark ('line', 'dash' or a shape) in an upper corner."""
        widest = max(len(label) for label, _, _ in entries) * 0.53 * LETTER
        left = self._left + 10 if is_left else self._right - widest - 30
        for k, (label, colour, shape) in enumerate(entries):
            y = self._top + 12 + 16 * k
            if shape in ('line', 'dash'):
                dash = '5 3' if shape == 'dash' else ''
                self.parts.append(_line(left, y, left + 20, y, colour, 1.8, dash))
            else:
                self.parts.append(_mark(left + 10, y, colour, shape, 3.2, ''))
            self.parts.append(_text(left + 26, y + 4, label, 'start', has_edge=True))

    def note(self, words: str) -> None:
        """Words in the middle of the panel, where there is nothing to draw."""
        x, y = (self._left + self._right) / 2, (self._top + self._bottom) / 2
        self.parts.append(_text(x, y, words, 'middle', MUTED, has_edge=True))

    def _clipped(self, part: str) -> None:
        """Draw without what reaches out of the panel."""
        left, top = self._left - 4, self._top - 4
        wide, high = self._right - left + 4, self._bottom - top + 4
        box = f'{left:.1f} {top:.1f} {wide:.1f} {high:.1f}'
        opening = (
            f'<svg x="{left:.1f}" y="{top:.1f}" width="{wide:.1f}" height="{high:.1f}"'
            f' viewBox="{box}">'
        )
        # Neighbours share one clip.
        if self.parts and self.parts[-1].startswith(opening):
            self.parts[-1] = self.parts[-1].removesuffix('</svg>') + part + '</svg>'
        else:
            self.parts.append(f'{opening}{part}</svg>')


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


def words_at(x: float, y: float, words: str, anchor: str = 'middle', colour: str = INK) -> str:
    """Words at a place of the view box."""
    return _text(x, y, words, anchor, colour)


def _line(
    x1: float, y1: float, x2: float, y2: float, colour: str, width: float, dash: str = ''
) -> str:
    dashes = f' stroke-dasharray="{dash}"' if dash else ''
    return (
        f'<path d="M{x1:.1f},{y1:.1f}L{x2:.1f},{y2:.1f}" stroke="{colour}"'
        f' stroke-width="{width:g}"{dashes}/>'
    )


def _mark(x: float, y: float, colour: str, shape: str, size: float, title: str) -> str:
    path = _MARKS[shape].replace('{r}', f'{size:g}')
    style = (
        f'fill="none" stroke="{colour}" stroke-width="1.5"'
        if shape == 'cross'
        else (f'fill="{colour}"')
    )
    inside = f'<title>{html.escape(title)}</title>' if title else ''
    return f'<path transform="translate({x:.1f} {y:.1f})" d="{path}" {style}>{inside}</path>'


def _short(values: Sequence[float], label: str) -> tuple[list[str], str]:
    """Names of the ticks of an axis and its label, in thousandths where they would meet."""
    names = [in_digits(value) for value in values]
    unit = _UNIT.search(label)
    if unit is None or max(map(len, names), default=0) <= _TICK_CHARACTERS:
        return names, label
    thousandths = [in_digits(1000.0 * value) for value in values]
    if max(map(len, thousandths)) > _TICK_CHARACTERS:
        return names, label
    return thousandths, f'{label[: unit.start(1)]}0.001 {label[unit.start(1) :]}'


def _text(
    x: float, y: float, words: str, anchor: str = 'middle', colour: str = INK,
    size: float = LETTER, turn_deg: float = 0.0, has_edge: bool = False,
) -> str:  # fmt: skip
    if not words:
        return ''
    turned = f' transform="rotate({turn_deg:.0f} {x:.1f} {y:.1f})"' if turn_deg else ''
    edge = f' stroke="{PAPER}" stroke-width="3" paint-order="stroke"' if has_edge else ''
    sized = f' font-size="{size:g}"' if size != LETTER else ''
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}"{sized}{edge}'
        f'{turned}>{html.escape(words)}</text>'
    )
