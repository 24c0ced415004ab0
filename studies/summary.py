# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Summaries of Monte Carlo studies: errors relative to bounds and to reported covariances."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import json
import math

import numpy as np
from scipy.stats import chi2

from starcal_ros.arrays import Floats
from starcal_ros.errors import TooFewObservations
from studies.monte_carlo import Design, Row
from studies.trials import ESTIMATED, rms

CONFIDENCE = 0.99


@dataclass(frozen=True)
class StudyResult:
    """Result of a study: rows of its trials in order, and their summary."""

    design: Design
    rows: tuple[Row, ...]
    summary: tuple[Row, ...]


def conclude(design: Design, rows: Iterable[Row]) -> StudyResult:
    """
    Result of a study from the rows of all its trials, in any order.

    Raises TooFewObservations when no calibration was possible in any cell.
    """
    ordered = tuple(sorted(rows, key=lambda row: row['trial']))
    if not ordered:
        raise TooFewObservations(
            f'no calibration was possible in {design.trials} trials of {design.study}: '
            'increase --images or --stars'
        )
    return StudyResult(design, ordered, tuple(_SUMMARIES[design.study](ordered)))


def content(result: StudyResult, software: str) -> str:
    """JSON text of a result: design, summary rows, and all trials as columns."""
    columns = dict.fromkeys(name for row in result.rows for name in row)
    parameters = dataclasses.asdict(result.design)
    content = {
        'software': software,
        'study': parameters.pop('study'),
        'seed': parameters.pop('seed'),
        'parameters': parameters,
        'summary': result.summary,
        'trials': {name: [row.get(name) for row in result.rows] for name in columns},
    }
    return json.dumps(content, indent=1, allow_nan=False) + '\n'


def _groups(rows: Sequence[Row], *names: str) -> Iterable[tuple[Row, list[Row]]]:
    """Group rows by the named columns, in order of first appearance."""
    groups: dict[tuple[int | float | str, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    for key, members in groups.items():
        yield dict(zip(names, key, strict=True)), members


def column(rows: Sequence[Row], name: str) -> Floats:
    """Column of numbers of some rows."""
    return np.array([row[name] for row in rows], np.float64)


def _ratio(rows: Sequence[Row], name: str, to: str) -> float:
    return rms(column(rows, name)) / rms(column(rows, to))


def _interval(parameters: int, trials: int) -> tuple[float, float]:
    """Interval of the mean of ``trials`` chi^2 variables with probability `CONFIDENCE`."""
    tail = (1 - CONFIDENCE) / 2
    low, high = chi2.ppf([tail, 1 - tail], parameters * trials) / trials
    return float(low), float(high)


def _common(rows: Sequence[Row]) -> Row:
    """Number of trials, and RMS of the map error with its 1-sigma; 0 for a single trial."""
    n, rms_px = len(rows), rms(column(rows, 'map_px'))
    squares = column(rows, 'map_px') ** 2
    relative = 0.5 * squares.std(ddof=1) / squares.mean() / math.sqrt(n) if n > 1 else 0.0
    return {'trials': n, 'map_px': rms_px, 'map_px_sigma': rms_px * float(relative)}


def _table1_summary(rows: Sequence[Row]) -> Iterable[Row]:
    for key, cell in _groups(rows, 'images', 'stars', 'tracker_arcsec', 'method'):
        yield {
            **key,
            **_common(cell),
            'to_own_bound': _ratio(cell, 'map_px', 'own_bound_px'),
            'to_per_image_bound': _ratio(cell, 'map_px', 'per_image_bound_px'),
            'to_bound': _ratio(cell, 'map_px', 'bound_px'),
            'pointing_arcsec': rms(column(cell, 'pointing_arcsec')),
            'pointing_to_bound': _ratio(cell, 'pointing_arcsec', 'pointing_bound_arcsec'),
            'normalised': float(column(cell, 'normalised').mean()),
        }


def _images_summary(rows: Sequence[Row]) -> Iterable[Row]:
    for key, cell in _groups(rows, 'images', 'stars', 'tracker_arcsec', 'method'):
        yield {
            **key,
            **_common(cell),
            'to_bound': _ratio(cell, 'map_px', 'bound_px'),
            'unused_px': rms(column(cell, 'unused_px')),
            'unused_to_true': _ratio(cell, 'unused_px', 'unused_true_px'),
        }


def _terms_summary(rows: Sequence[Row]) -> Iterable[Row]:
    for key, cell in _groups(rows, 'images', 'tracker_arcsec', 'method', 'step'):
        removed = [str(row['removed']) for row in cell]
        usual = max(sorted(set(removed)), key=removed.count)
        yield {
            **key,
            'trials': len(cell),
            'usual': usual or 'none',
            'share': removed.count(usual) / len(cell),
            'residual_std_u_px': rms(column(cell, 'residual_std_u_px')),
            'residual_std_v_px': rms(column(cell, 'residual_std_v_px')),
            'map_change_px': rms(column(cell, 'map_change_px')),
        }


def _coverage_summary(rows: Sequence[Row]) -> Iterable[Row]:
    names = [name for name in rows[0] if name.endswith('_sigmas')]
    for key, cell in _groups(rows, 'images', 'stars', 'tracker_arcsec', 'outlier_share', 'method'):
        low, high = _interval(len(ESTIMATED), len(cell))
        normalised = float(column(cell, 'normalised').mean())
        bias = {name: float(column(cell, name).mean()) for name in names}
        spread = {name: rms(column(cell, name)) for name in names}
        worst = max(names, key=lambda name: abs(bias[name]))
        widest = max(names, key=lambda name: spread[name])
        yield {
            **key,
            **_common(cell),
            'to_bound': _ratio(cell, 'map_px', 'bound_px'),
            'to_reported': _ratio(cell, 'map_px', 'reported_px'),
            'normalised': normalised,
            'low': low,
            'high': high,
            'inside': int(low <= normalised <= high),
            'worst_bias': worst.removesuffix('_sigmas'),
            'worst_bias_sigmas': bias[worst],
            'widest': widest.removesuffix('_sigmas'),
            'widest_rms_sigmas': spread[widest],
            **{f'bias_{name}': value for name, value in bias.items()},
            **{f'rms_{name}': value for name, value in spread.items()},
        }


_SUMMARIES: Mapping[str, Callable[[Sequence[Row]], Iterable[Row]]] = {
    'table1': _table1_summary,
    'images': _images_summary,
    'terms': _terms_summary,
    'coverage': _coverage_summary,
}


def table(result: StudyResult) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the summary, without bias and spread of single parameters."""
    names = [n for n in result.summary[0] if not n.startswith(('bias_', 'rms_'))]
    return names, [[_words(row[name]) for name in names] for row in result.summary]


def _words(value: int | float | str) -> str:
    return f'{value:.4g}' if isinstance(value, float) else str(value)
