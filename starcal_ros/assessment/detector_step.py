# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Steps of the detector: lost or shifted columns and rows.

The field is smooth, so a step is left in the residuals near its place: on both sides of it they
differ by its size within a strip that is narrower than the field's shortest wave.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from starcal_ros.arrays import Floats
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.records import DetectorStep

_INNER = (0.1, 0.9)  # of the detector: beyond, too few stars lie on one side
_STEPS = 97  # places along each axis at which a step is looked for
_STRIP = 1 / 24  # of the width: a quarter of the shortest wave of the field


def detector_step(estimate: Estimate) -> DetectorStep:
    """Return the most significant step between two parts of the detector."""
    kept = estimate.kept
    camera, strip_px = estimate.geometry.camera, _STRIP * estimate.geometry.camera.width
    residual_px = estimate.residual_px[kept]
    weight = 2.0 / (estimate.covariance_px2[kept, 0] + estimate.covariance_px2[kept, 2])
    best, best_significance = ('u', 0.0, 'u', 0.0), 0.0
    for axis, size in enumerate((camera.width, camera.height)):
        place_px: Floats = np.asarray(np.linspace(*_INNER, _STEPS), np.float64) * size - 0.5
        pixels = estimate.table.measured_px[kept, axis]
        before, variance_before = _means(
            pixels, residual_px, weight, place_px - strip_px, place_px
        )
        after, variance_after = _means(pixels, residual_px, weight, place_px, place_px + strip_px)
        step, sigma = after - before, np.sqrt(variance_before + variance_after)[:, None]
        significance = np.abs(step) / sigma
        k, moved = np.unravel_index(int(np.argmax(significance)), significance.shape)
        if significance[k, moved] > best_significance:
            best_significance = float(significance[k, moved])
            best = ('uv'[axis], float(place_px[k]), 'uv'[moved], float(step[k, moved]))
    # Twice two axes, and places that do not overlap.
    trials = 4 * min(_STEPS, round((_INNER[1] - _INNER[0]) / _STRIP))
    p_value = min(1.0, 2.0 * trials * float(ndtr(-best_significance)))
    return DetectorStep(*best, p_value)


def _means(
    pixels: Floats, residual_px: Floats, weight: Floats, low_px: Floats, high_px: Floats
) -> tuple[Floats, Floats]:
    """Weighted means (k, 2) of residuals between pixels (k,) and (k,), and their variances."""
    order = np.argsort(pixels)
    ends = np.searchsorted(pixels[order], np.stack([low_px, high_px]))
    columns = np.column_stack([weight, weight[:, None] * residual_px])[order]
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(columns, axis=0)])
    total = summed[ends[1]] - summed[ends[0]]
    with np.errstate(divide='ignore', invalid='ignore'):
        means = np.nan_to_num(total[:, 1:] / total[:, :1])
        return means, 1.0 / total[:, 0]
