# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Plots of the removal of camera parameters (paper, Fig. 8) for studies."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.records import TermRemoval

_COLOURS = ('#2f6bb0', '#c0532f', '0.4')


def curves_of(removals: Sequence[TermRemoval]) -> tuple[Floats, Floats]:
    """Standard deviations (n, 2) of the residuals and changes (n,) of the map, px."""
    std_px = np.array([removal.residual_std_px for removal in removals])
    return std_px, np.array([removal.map_change_px for removal in removals])


def plot_curves(axes: Axes, std_px: Floats, map_change_px: Floats) -> None:
    """
    Residuals and change of the map against the number of terms removed.

    Parameters
    ----------
    std_px : (n, 2)
        Standard deviations of the residuals along u and v, first with all terms.
    map_change_px : (n,)
        RMS change of the distortion map; that of no term removed is 0 and not shown.
    """
    steps = np.arange(len(map_change_px))
    for values, name, colour in zip(std_px.T, 'uv', _COLOURS, strict=False):
        axes.plot(steps, values, 'o-', color=colour, markersize=4, linewidth=1.3,
                  label=f'residual, std of {name}')  # fmt: skip
    axes.plot(steps[1:], map_change_px[1:], '^:', color=_COLOURS[2], markersize=5, linewidth=1.3,
              label='change of the map, rms')  # fmt: skip
    axes.set(yscale='log', xlabel='terms removed', ylabel='px')
    axes.set_xticks(steps)
    axes.legend(frameon=False, fontsize=9)


def plot_removed(axes: Axes, share: Floats, names: Sequence[str]) -> None:
    """
    Removed terms in red after each step.

    Parameters
    ----------
    share : (n, k)
        Share of the calibrations without the k-th term after each step, 0 to 1; written as a
        percentage where the calibrations differ.
    """
    axes.imshow(share, cmap='Reds', vmin=0.0, vmax=1.25, aspect='auto')
    for (row, column), part in np.ndenumerate(share):
        if 0.005 < part < 0.995:
            axes.text(column, row, f'{100 * part:.0f}', ha='center', va='center', fontsize=7,
                      color='w' if part > 0.5 else 'k')  # fmt: skip
    axes.set_xticks(range(len(names)), names, fontsize=8)
    axes.set_yticks(range(len(share)))
    axes.grid(False)
    axes.set_xticks(np.arange(len(names) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(share) + 1) - 0.5, minor=True)
    axes.grid(True, which='minor', color='w', linewidth=1.5)
    axes.tick_params(which='minor', length=0)
    axes.set_ylabel('terms removed')
