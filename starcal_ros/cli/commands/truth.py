# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A calibration beside the truth of a simulated bag."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from starcal_ros.cli.commands.demo import compare, TruthTable
from starcal_ros.errors import ProductError
from starcal_ros.products.calibration_json import prior_of
from starcal_ros.products.files import read_text
from starcal_ros.records import Calibration
from starcal_ros.simulation.bag import true_geometry
from starcal_ros.untrusted import json_value, PRODUCT_BYTES


def is_truth(path: Path) -> bool:
    """Whether a file is the truth of a simulated bag, as ``starcal simulate`` writes it."""
    try:
        content = json_value(read_text(path, PRODUCT_BYTES))
    except (ProductError, ValueError):
        return False
    return isinstance(content, dict) and 'k_true' in content


def compare_with(calibration: Calibration, path: Path) -> TruthTable:
    """
    The table of a calibration beside the truth.

    Raises
    ------
    ProductError
        When the truth is of another lens model or damaged.
    """
    try:
        truth = true_geometry(json_value(read_text(path, PRODUCT_BYTES)))
    except (ValueError, KeyError, TypeError) as error:
        raise ProductError(f'{path}: not the truth of a simulated bag: {error}') from error
    model = calibration.geometry.camera.model
    if truth.camera.model != model:
        raise ProductError(f'{path}: of lens model {truth.camera.model}, calibrated was {model}')
    return compare(calibration, truth, prior_of(calibration) or calibration.geometry)


def content(table: TruthTable) -> dict[str, object]:
    """A table as a JSON object."""
    worst = table.worst_sigmas
    return {'lines': list(table.lines), 'worst_sigmas': worst if np.isfinite(worst) else None}
