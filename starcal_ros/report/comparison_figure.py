# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The figure of a comparison of two calibrations, as a file."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from starcal_ros.assessment import comparison
from starcal_ros.assessment.comparison import Comparison, DifferenceMap
from starcal_ros.camera import CameraModel, pixel_grid
from starcal_ros.errors import OptionError
from starcal_ros.products.files import write_atomically
from starcal_ros.report.svg import round_step

COMPARISON_FORMATS = ('.png', '.svg', '.pdf')
_ROUNDING_PX = 1e-9  # differences below are of the arithmetic


def write_comparison(found: Comparison, path: Path) -> None:
    """
    Draw the difference of two calibrations over the detector, with and without common rotation.

    Colours and arrows are in pixels; the title has the largest length, in sigmas too if estimated.

    Raises
    ------
    OptionError
        For an ending that is none of `COMPARISON_FORMATS`.
    ProductError
        When the file cannot be written.
    """
    if path.suffix not in COMPARISON_FORMATS:
        raise OptionError(f'{path}: the name must end in {", ".join(COMPARISON_FORMATS)}')
    figure = Figure(figsize=(11.0, 4.6), layout='constrained')
    left, right = figure.subplots(1, 2)
    camera = found.a.geometry.camera
    _difference(left, camera, found.before, 'lines of sight, B minus A')
    _difference(right, camera, found.after, 'common rotation removed')
    memory = io.BytesIO()
    figure.savefig(memory, format=path.suffix[1:], dpi=130)
    write_atomically(path, memory.getvalue())


def _difference(axes: Axes, camera: CameraModel, found: DifferenceMap, title: str) -> None:
    """Length in pixels as colours from zero, direction as arrows with a scale."""
    n = comparison.GRID
    grid_px = pixel_grid(camera, n, n).reshape(n, n, 2)
    worst_px = float(found.length_px.max())
    axes.set(xlabel='u (px)', ylabel='v (px)', aspect='equal')
    axes.set(xlim=(0, camera.width - 1), ylim=(camera.height - 1, 0))
    if not worst_px > _ROUNDING_PX:
        axes.set_title(f'{title}: no difference', fontsize=10)
        axes.text(camera.width / 2, camera.height / 2, f'under {_ROUNDING_PX:g} px', ha='center')
        return
    levels = np.linspace(0.0, worst_px, 13)
    filled = axes.contourf(*np.moveaxis(grid_px, -1, 0), found.length_px, levels, cmap='viridis')
    axes.figure.colorbar(filled, ax=axes, shrink=0.8, label='length (px)')
    every_other = slice(None, None, 2)
    arrows = axes.quiver(
        *np.moveaxis(grid_px[every_other, every_other], -1, 0),
        *np.moveaxis(found.difference_px[every_other, every_other], -1, 0),
        angles='xy', color='white', edgecolor='black', linewidth=0.4, width=0.004,
    )  # fmt: skip
    scale_px = round_step(worst_px / 2)
    axes.quiverkey(arrows, 0.93, 1.03, scale_px, f'{scale_px:g} px', labelpos='W')
    known = found.sigmas[np.isfinite(found.sigmas)]
    in_sigmas = f', {known.max():.2g} sigma' if known.size else ''
    axes.set_title(f'{title}: at most {worst_px:.3g} px{in_sigmas}', fontsize=10, loc='left')
