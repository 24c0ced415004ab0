"""The difference of two calibrations over the detector, drawn."""

from __future__ import annotations

import io
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np

from starcal_ros.assessment.comparison import Comparison, DifferenceMap, GRID
from starcal_ros.camera import pixel_grid
from starcal_ros.errors import OptionError, ProductError

FORMATS = ('.png', '.svg', '.pdf')


def write(comparison: Comparison, path: Path) -> None:
    """
    Draw arrows in pixels and lengths in sigmas, with and without the common rotation.

    Raises
    ------
    OptionError
        For an ending that is none of `FORMATS`.
    ProductError
        When the file cannot be written.
    """
    if path.suffix not in FORMATS:
        raise OptionError(f'{path}: the name must end in {", ".join(FORMATS)}')
    camera = comparison.a.geometry.camera
    grid_px = pixel_grid(camera, GRID, GRID).reshape(GRID, GRID, 2)
    figure = Figure(figsize=(11.0, 4.6), layout='constrained')
    for axes, found, title in zip(
        figure.subplots(1, 2),
        (comparison.before, comparison.after),
        ('lines of sight, B less A', 'common rotation removed'),
        strict=True,
    ):
        worst_px = float(found.length_px.max())
        levels = axes.contourf(
            grid_px[..., 0], grid_px[..., 1], _levels(found), 12, cmap='viridis'
        )
        few = slice(None, None, 2)
        if worst_px > 0:  # arrows without length have no scale
            axes.quiver(
                *np.moveaxis(grid_px[few, few], -1, 0),
                *np.moveaxis(found.difference_px[few, few], -1, 0),
                angles='xy', color='white', edgecolor='black', linewidth=0.4, width=0.004,
            )  # fmt: skip
        unit = 'px' if np.isnan(found.sigmas).all() else 'sigma'
        figure.colorbar(levels, ax=axes, shrink=0.8, label=f'length ({unit})')
        axes.set_title(f'{title}: {worst_px:.3g} px at worst', fontsize=10)
        axes.set_xlabel('u (px)')
        axes.set_ylabel('v (px)')
        axes.set_xlim(0, camera.width - 1)
        axes.set_ylim(camera.height - 1, 0)
        axes.set_aspect('equal')
    memory = io.BytesIO()
    figure.savefig(memory, format=path.suffix[1:], dpi=130)
    try:
        path.write_bytes(memory.getvalue())
    except OSError as error:
        raise ProductError(f'{path}: cannot be written: {error.strerror}') from error


def _levels(found: DifferenceMap) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Lengths in sigmas; in pixels where nothing was estimated."""
    return found.length_px if np.isnan(found.sigmas).all() else np.nan_to_num(found.sigmas)
