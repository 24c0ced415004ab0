# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures of the Monte Carlo studies."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import io
import itertools
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
import numpy as np
from scipy.stats import chi2

from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.studies.monte_carlo import ENOUGH, Row, SAME_SIGMAS, UNUSED_IMAGES
from starcal_ros.studies.summary import column, StudyResult
from starcal_ros.studies.term_removal_figure import plot_curves, plot_removed
from starcal_ros.studies.trials import ESTIMATED

# Colour-blind-safe colours (Okabe and Ito), marker, and width that keeps coinciding lines visible.
_LOOKS: Mapping[str, tuple[str, str, float]] = {
    'per_image': ('#56b4e9', 'o', 4.0),
    'single': ('#d55e00', 's', 1.3),
    'hierarchical': ('#004d40', '^', 1.3),
}
_MILLI = 1000.0


def png(result: StudyResult) -> bytes:
    """PNG of the figure of a study."""
    figure = _FIGURES[result.design.study](result)
    design = result.design
    figure.suptitle(
        f'{design.study}: {design.trials} trials, seed {design.seed}',
        fontsize=10,
        x=0.01,
        ha='left',
    )
    memory = io.BytesIO()
    figure.savefig(memory, format='png', dpi=130)
    return memory.getvalue()


def _where(rows: Sequence[Row], **values: object) -> list[Row]:
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def _values(rows: Sequence[Row], name: str) -> list[int | float | str]:
    """Distinct values of a column, in order of appearance."""
    return list(dict.fromkeys(row[name] for row in rows))


def _look(method: object) -> dict[str, Any]:
    """Plot settings of a method."""
    colour, marker, width = _LOOKS[str(method)]
    return {
        'color': colour, 'marker': marker, 'markersize': width + 3, 'linewidth': width,
        'label': method,
    }  # fmt: skip


def _log_axis(axes: Axes, which: str) -> None:
    """Logarithmic with plain numbers at 1, 2, 5."""
    axis = axes.xaxis if which == 'x' else axes.yaxis
    (axes.set_xscale if which == 'x' else axes.set_yscale)('log')
    axis.set_major_locator(LogLocator(10, (1.0, 2.0, 5.0), numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axis.set_minor_formatter(NullFormatter())


def _panels(
    rows: int, columns: int, width: float, height: float
) -> tuple[Figure, list[list[Axes]]]:
    figure = Figure(figsize=(width * columns, height * rows + 0.3), layout='constrained')
    axes = figure.subplots(rows, columns, squeeze=False)
    for one in axes.ravel():
        one.grid(True, which='major', color='0.9', linewidth=0.7)
        one.set_axisbelow(True)
        one.spines[['top', 'right']].set_visible(False)
    return figure, axes.tolist()


def _table1(result: StudyResult) -> Figure:
    """Map and pointing error against star tracker noise, one column per cell of images."""
    cells = list(itertools.product(result.design.images, result.design.stars))
    figure, axes = _panels(2, len(cells), 4.6, 3.2)
    for k, (images, stars) in enumerate(cells):
        cell = _where(result.summary, images=images, stars=stars)
        every = _where(result.rows, images=images, stars=stars)
        above, below = axes[0][k], axes[1][k]
        for method in _values(cell, 'method'):
            look = _look(method)
            rows = _where(cell, method=method)
            x = column(rows, 'tracker_arcsec')
            above.errorbar(
                x, _MILLI * column(rows, 'map_px'), 2 * _MILLI * column(rows, 'map_px_sigma'),
                elinewidth=1, capsize=2, **look,
            )  # fmt: skip
            below.plot(x, column(rows, 'pointing_arcsec'), **look)
        x = np.array(_values(cell, 'tracker_arcsec'), np.float64)
        for axis, name, scale in (
            (above, 'bound_px', _MILLI),
            (below, 'pointing_bound_arcsec', 1.0),
        ):
            bound = [
                np.sqrt(np.mean(column(_where(every, tracker_arcsec=t), name) ** 2)) for t in x
            ]
            axis.plot(x, scale * np.array(bound), 'k--', linewidth=1, label='Cramér-Rao bound')
            axis.set_xlabel('star tracker noise per axis (arcsec)')
            _log_axis(axis, 'y')
        above.set_title(f'{images} images of {stars} stars', fontsize=10)
        above.set_ylabel('map error, rms (0.001 px)')
        below.set_ylabel('pointing error, rms (arcsec)')
        above.legend(frameon=False, fontsize=8)
    return figure


def _images(result: StudyResult) -> Figure:
    """Map error and residual of unused images against the number of images."""
    cells = list(itertools.product(result.design.stars, result.design.tracker_arcsec))
    figure, axes = _panels(len(cells), 2, 4.8, 3.4)
    for (stars, tracker), (left, right) in zip(cells, axes, strict=True):
        cell = _where(result.summary, stars=stars, tracker_arcsec=tracker)
        every = _where(result.rows, stars=stars, tracker_arcsec=tracker)
        for method in _values(cell, 'method'):
            rows = _where(cell, method=method)
            x = column(rows, 'images')
            for axis, y in (
                (left, _MILLI * column(rows, 'map_px')),
                (right, 100 * (column(rows, 'unused_to_true') - 1)),
            ):
                axis.plot(x, y, **_look(method))
        x = np.array(_values(cell, 'images'), np.float64)
        bound = [np.sqrt(np.mean(column(_where(every, images=m), 'bound_px') ** 2)) for m in x]
        left.plot(x, _MILLI * np.array(bound), 'k--', linewidth=1, label='Cramér-Rao bound')
        words = f'{100 * (ENOUGH - 1):.0f} %'
        right.axhline(100 * (ENOUGH - 1), color='k', linewidth=1, linestyle=':', label=words)
        left.set_ylabel('map error, rms (0.001 px)')
        right.set_ylabel(
            f'residual of {UNUSED_IMAGES} unused images\nabove that of the true camera (%)'
        )
        left.set_title(f'{stars} stars per image, star tracker {tracker:g}"', fontsize=10)
        for axis in (left, right):
            axis.set_xlabel('images used')
            _log_axis(axis, 'x')
            _log_axis(axis, 'y')
            if len(x) > 1:
                axis.axvline(
                    15, color='0.75', linewidth=4, alpha=0.4, zorder=0, label='15 images (paper)'
                )
            axis.legend(frameon=False, fontsize=8)
    return figure


def _terms(result: StudyResult) -> Figure:
    """Terms removed after each step (as the paper's Fig. 8), and the residual."""
    cells = list(
        itertools.product(
            result.design.images, result.design.tracker_arcsec, result.design.methods
        )
    )
    figure, axes = _panels(len(cells), 2, 4.8, 3.8)
    for (images, tracker, method), (left, right) in zip(cells, axes, strict=True):
        key = {'images': images, 'tracker_arcsec': tracker, 'method': method}
        cell, every = _where(result.summary, **key), _where(result.rows, **key)
        steps = [int(row['step']) for row in cell]
        gone = np.array(
            [
                [
                    np.mean([row['removed'] == name for row in every if int(row['step']) <= step])
                    * (step + 1)
                    for name in PARAMETER_NAMES
                ]
                for step in steps
            ]
        )
        order = np.argsort(-gone.sum(axis=0), kind='stable')
        plot_removed(left, gone[:, order], [PARAMETER_NAMES[k] for k in order])
        left.set_title(f'removed terms red (% of nights); {method}, {images} images', fontsize=9)
        std_px = [column(cell, f'residual_std_{axis}_px') for axis in 'uv']
        plot_curves(right, np.stack(std_px, axis=-1), column(cell, 'map_change_px'))
    return figure


def _coverage(result: StudyResult) -> Figure:
    """Distribution of the normalised squared error, and bias and spread of each parameter."""
    keys = [
        {k: row[k] for k in ('images', 'stars', 'tracker_arcsec', 'outlier_share')}
        for row in result.summary
    ]
    cells = [key for k, key in enumerate(keys) if key not in keys[:k]]
    figure, axes = _panels(len(cells), 2, 4.8, 3.0)
    names = [n.removeprefix('bias_') for n in result.summary[0] if n.startswith('bias_')]
    for key, (left, right) in zip(cells, axes, strict=True):
        cell, every = _where(result.summary, **key), _where(result.rows, **key)
        most = float(np.percentile(column(every, 'normalised'), 99.5)) * 1.1 + 5
        x = np.linspace(0, most, 300)
        left.plot(x, chi2.pdf(x, len(ESTIMATED)), 'k--', linewidth=1, label='chi squared, 11')
        for shift, row in enumerate(cell):
            method = str(row['method'])
            colour, marker, width = _LOOKS[method]
            values = column(_where(every, method=method), 'normalised')
            verdict = 'within' if row['inside'] else 'outside'
            left.hist(
                values, bins=np.linspace(0, most, 26).tolist(), density=True, histtype='step',
                color=colour, linewidth=width,
                label=f'{method}: mean {row["normalised"]:.2f}, {verdict}'
                f' {row["low"]:.2f} to {row["high"]:.2f}',
            )  # fmt: skip
            at = np.arange(len(names)) + 0.15 * (shift - 0.5 * (len(cell) - 1))
            for statistic, face in (('bias', colour), ('rms', 'w')):
                right.plot(
                    at, [float(row[f'{statistic}_{name}']) for name in names],
                    marker, color=colour, markerfacecolor=face, markersize=5,
                )  # fmt: skip
        # Three sigma of the mean and of the standard deviation over the trials.
        count = float(cell[0]['trials'])
        for level, error in ((0.0, 3 / np.sqrt(count)), (1.0, 3 / np.sqrt(2 * count))):
            right.axhspan(level - error, level + error, color='0.88', zorder=0)
            right.axhline(level, color='k', linewidth=0.8, linestyle=':')
        words = [n.removesuffix('_sigmas').replace('alignment_', 'align ') for n in names]
        right.set_xticks(range(len(names)), words, fontsize=8, rotation=45)
        right.set_ylabel('mean (filled) and rms (open)\nof the errors, in sigmas')
        share = 100 * float(key['outlier_share'])
        left.set_title(
            f'{key["images"]} images of {key["stars"]} stars, star tracker'
            f' {key["tracker_arcsec"]:g}", outliers {share:.0f} %', fontsize=9,
        )  # fmt: skip
        left.set_xlabel('normalised squared error')
        left.set_yticks([])
        left.set_ylim(0, left.get_ylim()[1] * 1.45)
        left.legend(frameon=False, fontsize=7, loc='upper right')
    return figure


def _start(result: StudyResult) -> Figure:
    """Difference of the estimates from a near and a distant prior, sorted."""
    shares = _values(result.rows, 'outlier_share')
    figure, axes = _panels(1, len(shares), 4.8, 3.2)
    for axis, share in zip(axes[0], shares, strict=True):
        every = _where(result.rows, outlier_share=share)
        for method in _values(every, 'method'):
            colour, marker, width = _LOOKS[str(method)]
            apart = np.sort(column(_where(every, method=method), 'apart_sigmas'))
            axis.plot(
                np.linspace(0, 100, len(apart)), np.maximum(apart, 1e-12),
                color=colour, marker=marker, markersize=3, linewidth=width, label=method,
            )  # fmt: skip
        axis.axhline(SAME_SIGMAS, color='k', linewidth=1, linestyle=':', label='same minimum')
        axis.set_yscale('log')
        axis.set_title(f'outliers {100 * float(share):.0f} %', fontsize=10)
        axis.set_xlabel('share of the trials (%)')
        axis.set_ylabel('difference of near and distant prior,\nworst parameter (sigmas)')
        axis.legend(frameon=False, fontsize=8)
    return figure


_FIGURES: Mapping[str, Callable[[StudyResult], Figure]] = {
    'table1': _table1,
    'images': _images,
    'terms': _terms,
    'coverage': _coverage,
    'start': _start,
}
