# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Figures 5 to 8 of the paper, from a simulated night."""

from __future__ import annotations

from collections.abc import Mapping
import io

from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
import numpy as np
from scipy.stats import norm

from starcal_ros.camera import CameraModel, distortion_px, PARAMETER_NAMES, pixel_grid
from starcal_ros.studies.paper import CALIBRATED_WITH, PaperStudy
from starcal_ros.studies.term_removal_figure import curves_of, plot_curves, plot_removed

_BLUE, _RED = '#0b62a8', '#c4501b'


def pngs(found: PaperStudy) -> Mapping[str, bytes]:
    """PNG of each figure, by name."""
    drawn = {
        'figure_5': _coverage(found),
        'figure_6': _distortion(found),
        'figure_7': _residuals(found),
        'figure_8': _terms(found),
    }
    return {name: _png(figure) for name, figure in drawn.items()}


def _png(figure: Figure) -> bytes:
    memory = io.BytesIO()
    figure.savefig(memory, format='png', dpi=100, metadata={'Software': None})
    return memory.getvalue()


def _detector(axes: Axes, camera: CameraModel) -> None:
    axes.set(
        xlim=(0, camera.width - 1), ylim=(camera.height - 1, 0), aspect='equal',
        xlabel='column (px)', ylabel='row (px)',
    )  # fmt: skip


def _coverage(found: PaperStudy) -> Figure:
    figure = Figure(figsize=(6.4, 5.2), layout='constrained')
    axes = figure.subplots()
    axes.plot(*found.judged.measured_px.T, ',', color=_BLUE, alpha=0.5)
    _detector(axes, found.camera)
    axes.set_title(f'{found.stars:,} star centroids in {found.images - found.refused} images')
    return figure


def _distortion(found: PaperStudy) -> Figure:
    figure = Figure(figsize=(11, 4.4), layout='constrained')
    left, right = figure.subplots(1, 2)
    camera = found.camera
    coarse = pixel_grid(camera, 20, 16)
    vectors_px = distortion_px(camera, coarse)
    arrows = left.quiver(*coarse.T, *vectors_px.T, angles='xy', color=_BLUE, width=0.003)
    scale_px = float(f'{np.hypot(*vectors_px.T).max() / 2:.0e}')
    left.quiverkey(
        arrows, 0.93, 1.04, scale_px, f'{scale_px:g} px', labelpos='W', color=_RED, labelcolor='k'
    )
    left.set_title('distortion vectors, enlarged', loc='left')
    grid = pixel_grid(camera, 60, 48)
    u, v, length = (a.reshape(48, 60) for a in (*grid.T, np.hypot(*distortion_px(camera, grid).T)))
    lines = right.contour(u, v, length, levels=8, cmap='viridis')
    for label in right.clabel(lines, fmt='%g'):
        label.set(clip_on=False, bbox={'color': 'w', 'pad': 0.5})
    right.set_title('distortion magnitude (px)')
    for axes in (left, right):
        _detector(axes, camera)
    return figure


def _residuals(found: PaperStudy) -> Figure:
    figure = Figure(figsize=(11, 6.6), layout='constrained')
    (images, field), (histogram, counts) = figure.subplots(2, 2)
    judged, spread = found.judged, found.judged.std_of_images_px()
    for k, (colour, name) in enumerate(((_BLUE, 'u'), (_RED, 'v'))):
        images.plot(np.arange(1, len(spread) + 1), spread[:, k], '.', color=colour, markersize=3,
                    label=name)  # fmt: skip
        residual = judged.residual_px[judged.fits, k]
        histogram.hist(
            residual, np.linspace(-1, 1, 101).tolist(), density=True, histtype='step',
            color=colour, label=f'{name}: std {residual.std():.3f} px',
        )  # fmt: skip
    for k, at in enumerate(found.used):
        images.axvline(at + 1, color='0.85', linewidth=1.5, zorder=0,
                       label=f'{len(found.used)} images used' if k == 0 else None)  # fmt: skip
    x = np.linspace(-1, 1, 201)
    std = float(judged.residual_px[judged.fits].std())
    histogram.plot(x, norm.pdf(x, scale=std), 'k--', linewidth=1, label='normal distribution')
    images.set(xlabel='image', ylabel='standard deviation (px)', ylim=(0, 1.3 * spread.max()))
    histogram.set(xlabel='residual (px)', ylabel='density', xlim=(-1, 1))
    field.hist2d(
        *judged.residual_px[judged.fits].T, bins=np.linspace(-3.5 * std, 3.5 * std, 71).tolist(),
        cmap='Blues', norm=PowerNorm(0.4),
    )  # fmt: skip
    # Half of the stars lie in a few bins about zero: a linear scale would show only these.
    field.set(xlabel='residual of u (px)', ylabel='residual of v (px)', aspect='equal')
    number = [float(row['images']) for row in found.counts]
    for name, colour, words in (
        ('others_px', _BLUE, 'residual of the other images'),
        ('map_error_px', _RED, 'map error'),
    ):
        counts.plot(number, [float(row[name]) for row in found.counts], 'o-', color=colour,
                    markersize=4, label=words)  # fmt: skip
    counts.axhline(found.noise_rms_px, color='k', linestyle='--', linewidth=1,
                   label='with the true camera')  # fmt: skip
    counts.axvline(CALIBRATED_WITH, color='0.85', linewidth=4, zorder=0)
    counts.set(xscale='log', yscale='log', xlabel='images used', ylabel='rms (px)')
    counts.set_xticks([2, 5, 10, 15, 30, 60, 120], ['2', '5', '10', '15', '30', '60', '120'])
    counts.minorticks_off()
    for axes in (images, histogram, counts):
        axes.legend(frameon=False, fontsize=8)
        axes.grid(color='0.92')
        axes.set_axisbelow(True)
    return figure


def _terms(found: PaperStudy) -> Figure:
    figure = Figure(figsize=(11, 4.2), layout='constrained')
    left, right = figure.subplots(1, 2)
    gone = [removal.removed for removal in found.removals[1:]]
    order = [*gone, *(name for name in PARAMETER_NAMES if name not in gone)]
    share = [[float(name in gone[:step]) for name in order] for step in range(len(gone) + 1)]
    plot_removed(left, np.array(share), order)
    left.set_title('red: removed from the calibration')
    plot_curves(right, *curves_of(found.removals))
    right.grid(color='0.92')
    return figure
