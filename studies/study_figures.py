# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures of the Monte Carlo studies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from scipy.stats import chi2

from starcal_ground.report.figures import outline
from starcal_ground.report.svg import Curve, Drawing, INK, Panel, plot, SERIES, sheet
from studies.monte_carlo import column, ENOUGH, groups, Row, StudyResult
from studies.trials import ESTIMATED

# Colour, mark, and width that keeps coinciding lines visible.
_LOOKS: Mapping[str, tuple[str, str, float]] = {
    'per_image': ('#56b4e9', 'circle', 4.0),
    'single': (SERIES[1], 'square', 1.3),
    'hierarchical': (SERIES[2], 'triangle', 1.3),
}
_MILLI = 1000.0
Rows = Sequence[Sequence[Drawing]]


def svg(result: StudyResult) -> str:
    """Text of the SVG file of a study."""
    design = result.design
    title = f'{design.study}: {design.trials} trials, seed {design.seed}'
    return sheet(_FIGURES[design.study](result), title).document()


def _where(rows: Sequence[Row], **values: object) -> list[Row]:
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def _cells(result: StudyResult, *names: str) -> Iterator[tuple[Row, list[Row], list[Row]]]:
    """Distinct values of columns of the summary, its rows with them, and the trials with them."""
    for key, cell in groups(result.summary, names):
        yield key, cell, _where(result.rows, **key)


def _by_method(
    rows: Sequence[Row], x: str, name: str, scale: float = 1.0, less: float = 0.0, sigma: str = ''
) -> list[Curve]:
    """A curve of each method against a column, scaled and less a constant, with 2-sigma bars."""
    curves = []
    for method in dict.fromkeys(str(row['method']) for row in rows):
        colour, mark, width = _LOOKS[method]
        own = _where(rows, method=method)
        bars = 2 * scale * column(own, sigma) if sigma else None
        size = 2.0 + width / 2
        y = scale * (column(own, name) - less)
        curves.append(Curve(column(own, x), y, colour, method, mark, width, '', size, bars))
    return curves


def _bound(trials: Sequence[Row], x: str, name: str, scale: float) -> Curve:
    """Cramér-Rao bound, rms over the trials, against a column."""
    at = list(dict.fromkeys(float(row[x]) for row in trials))
    rms = [np.sqrt(np.mean(column(_where(trials, **{x: one}), name) ** 2)) for one in at]
    return Curve(at, scale * np.array(rms), INK, 'Cramér-Rao bound', width=1.0, dash='5 3')


def _table1(result: StudyResult) -> Rows:
    """Map and pointing error against star tracker noise, one column per cell of images."""
    above, below = [], []
    tracker, label = 'tracker_arcsec', 'star tracker noise per axis (arcsec)'
    for key, cell, trials in _cells(result, 'images', 'stars'):
        curves = _by_method(cell, tracker, 'map_px', _MILLI, sigma='map_px_sigma')
        title = f'{key["images"]} images of {key["stars"]} stars'
        curves.append(_bound(trials, tracker, 'bound_px', _MILLI))
        above.append(plot(curves, label, 'map error, rms (0.001 px)', log='y', title=title))
        curves = _by_method(cell, tracker, 'pointing_arcsec')
        curves.append(_bound(trials, tracker, 'pointing_bound_arcsec', 1.0))
        below.append(plot(curves, label, 'pointing error, rms (arcsec)', log='y'))
    return [above, below]


def _images(result: StudyResult) -> Rows:
    """Map error and residual of unused images against the number of images."""
    rows = []
    for key, cell, trials in _cells(result, 'stars', 'tracker_arcsec'):
        left = _by_method(cell, 'images', 'map_px', _MILLI)
        right = _by_method(cell, 'images', 'unused_to_true', 100, less=1)
        left.append(_bound(trials, 'images', 'bound_px', _MILLI))
        enough, ends = 100 * (ENOUGH - 1), column(cell, 'images')[[0, -1]]
        right.append(Curve(ends, [enough, enough], INK, f'{enough:.0f} %', width=1.0, dash='2 3'))
        title = f'{key["stars"]} stars per image, star tracker {key["tracker_arcsec"]:g}″'
        rows.append(
            [
                plot(curves, 'images used (band: 15, as the paper)', label, log='xy', title=words,
                     under=lambda panel: panel.upright(15.0, width=6.0))
                for curves, label, words in (
                    (left, 'map error, rms (0.001 px)', title),
                    (right, 'above that of the true camera (%)',
                     f'residual of {result.design.unused} unused images'),
                )
            ]
        )  # fmt: skip
    return rows


def _coverage(result: StudyResult) -> Rows:
    """Distribution of the normalised squared error, and bias and spread of each parameter."""
    names = [n.removeprefix('bias_') for n in result.summary[0] if n.startswith('bias_')]
    short = [n.removesuffix('_sigmas').replace('alignment_', 'align ') for n in names]
    rows = []
    for key, cell, trials in _cells(result, 'images', 'stars', 'tracker_arcsec', 'outlier_share'):
        most = float(np.percentile(column(trials, 'normalised'), 99.5)) * 1.1 + 5
        x, edges = np.linspace(0, most, 300), np.linspace(0, most, 26, dtype=np.float64)
        expected = chi2.pdf(x, len(ESTIMATED))
        left = [Curve(x, expected, INK, 'chi squared, 11', width=1.0, dash='5 3')]
        right = []
        for shift, row in enumerate(cell):
            method = str(row['method'])
            colour, mark, width = _LOOKS[method]
            verdict = 'within' if row['inside'] else 'outside'
            name = f'{method}: mean {row["normalised"]:.2f}, {verdict} {row["low"]:.2f}'
            values = column(_where(trials, method=method), 'normalised')
            left.append(
                outline(
                    values[values < most], edges, colour, f'{name} to {row["high"]:.2f}', width
                )
            )
            at = np.arange(len(names)) + 0.15 * (shift - 0.5 * (len(cell) - 1))
            for statistic, shape, size in (('bias', mark, 3.2), ('rms', 'ring', 3.0)):
                y = [float(row[f'{statistic}_{name}']) for name in names]
                right.append(Curve(at, y, colour, '', shape, 0.0, '', size))
        share = 100 * float(key['outlier_share'])
        title = (
            f'{key["images"]} images of {key["stars"]} stars, star tracker'
            f' {key["tracker_arcsec"]:g}″, outliers {share:.0f} %'
        )
        count = float(cell[0]['trials'])

        def bands(panel: Panel, count: float = count) -> None:
            # Three sigma of the mean and of the standard deviation over the trials.
            for level, error in ((0.0, 3 / np.sqrt(count)), (1.0, 3 / np.sqrt(2 * count))):
                panel.band(level - error, level + error)

        rows.append(
            [
                plot(left, 'normalised squared error', 'density', y=(0.0, None), title=title),
                plot(right, '', 'mean (filled) and rms (open), sigmas',
                     x_ticks=list(enumerate(short)), under=bands),
            ]
        )  # fmt: skip
    return rows


_FIGURES: Mapping[str, Callable[[StudyResult], Rows]] = {
    'table1': _table1,
    'images': _images,
    'coverage': _coverage,
}
