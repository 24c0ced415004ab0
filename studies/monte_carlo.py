# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Monte Carlo studies of calibrations with known truth.

The random numbers of a trial depend only on (seed, study, trial), so the rows of a study do not
depend on the number of workers or the order of the trials.  All studies run the same trials and
summarise them in the same way; they differ in their cells and in what is shown.  Lengths are
pixels at the focal length (28 arcsec) unless the name has another unit.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import dataclasses
from dataclasses import dataclass
import itertools
import json
import math
import zlib

import numpy as np
from scipy.stats import chi2

from starcal_ground.comparison import map_error_px, parameter_difference
from starcal_ros.arrays import Floats
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.records import ALIGNMENT_NAMES
from studies import trials
from studies.trials import ESTIMATED, rms, StarField

Row = dict[str, 'int | float | str']

OUTLIER_SHARE = 0.02
CONFIDENCE = 0.99


@dataclass(frozen=True)
class Design:
    """
    Design of a study, which has one cell for each combination of the lists.

    ``assumed_arcsec`` is the star tracker sigma that the calibration assumes; None: the true one.
    """

    study: str
    trials: int
    images: tuple[int, ...]
    stars: tuple[int, ...]
    tracker_arcsec: tuple[float, ...]
    methods: tuple[str, ...]
    outlier_shares: tuple[float, ...] = (0.0,)
    assumed_arcsec: float | None = None
    seed: int = 1


_METHODS = ('per_image', 'single', 'hierarchical')  # in the order of the paper
_TWO = ('per_image', 'hierarchical')
STUDIES: Mapping[str, tuple[str, Design]] = {
    'table1': (
        'map error of each method against star tracker noise (Table 1)',
        Design('table1', 200, (16,), (8, 80), (0.0, 5.0, 10.0, 20.0, 40.0, 60.0), _METHODS),
    ),
    'coverage': (
        'errors relative to the reported covariance',
        Design('coverage', 200, (16,), (80,), (20.0,), _TWO, (0.0, OUTLIER_SHARE)),
    ),
}
"""Name -> title and default design."""

_KEY = ('images', 'stars', 'tracker_arcsec', 'outlier_share', 'method')
_ERRORS = ('trials', 'map_px', 'map_px_sigma', 'to_bound')
_SHOWN: Mapping[str, tuple[str, ...]] = {
    'table1': (
        *('to_own_bound', 'to_per_image_bound'),
        *('pointing_arcsec', 'pointing_to_bound', 'normalised'),
    ),
    'coverage': (
        *('to_reported', 'normalised', 'low', 'high', 'inside'),
        *('worst_bias', 'worst_bias_sigmas', 'widest', 'widest_rms_sigmas'),
    ),
}
"""Columns of the printed table beside `_KEY` and `_ERRORS`."""


def run_trial(design: Design, trial: int) -> tuple[Row, ...]:
    """Rows of one trial, one for each cell and method; none if no calibration was possible."""
    rng = np.random.default_rng([design.seed, zlib.crc32(design.study.encode()), trial])
    field = trials.draw_star_field(rng, max(design.images), max(design.stars))
    rows: list[Row] = []
    for images, stars in itertools.product(design.images, design.stars):
        part = field.part(images, stars)
        cell: Row = {'trial': trial, 'images': images, 'stars': stars}
        rows += [{**cell, **row} for row in _cell(design, part)]
    return tuple(rows)


def _cell(design: Design, part: StarField) -> Iterator[Row]:
    """Errors of each method at each star tracker noise, and the bounds of its assumptions."""
    camera, blocks = part.truth.camera, trials.information_blocks(part)
    own = {
        method: trials.map_bound_px(camera, trials.bound(method, blocks, 0.0))
        for method in ('per_image', 'single')
    }
    for tracker, share in itertools.product(design.tracker_arcsec, design.outlier_shares):
        least = trials.bound('hierarchical', blocks, tracker)
        own['hierarchical'] = trials.map_bound_px(camera, least)
        pointing_arcsec = trials.pointing_bound_arcsec(camera, least)
        ensemble = trials.observe(part, tracker, share)
        for method in design.methods:
            assumed = tracker if design.assumed_arcsec is None else design.assumed_arcsec
            options = trials.calibration_options(method, assumed)
            try:
                estimate = estimate_calibration(ensemble, part.prior, options)
            except TooFewObservations:
                continue
            yield {
                'tracker_arcsec': tracker,
                'outlier_share': share,
                'method': method,
                **_errors(estimate, part),
                'own_bound_px': own[method],
                'per_image_bound_px': own['per_image'],
                'bound_px': own['hierarchical'],
                'pointing_bound_arcsec': pointing_arcsec,
            }


def _errors(estimate: Estimate, part: StarField) -> Row:
    """Errors of an estimate, those of its parameters in units of their reported sigmas."""
    found, truth = estimate.geometry, part.truth
    sigma = np.sqrt(np.diag(estimate.covariance))[ESTIMATED]
    error = parameter_difference(found, truth)[ESTIMATED]
    names = found.camera.parameter_names + ALIGNMENT_NAMES
    return {
        'map_px': map_error_px(found.camera, truth.camera),
        'pointing_arcsec': trials.pointing_error_arcsec(found, truth),
        'normalised': trials.normalised_error_squared(estimate, truth),
        'converged': int(estimate.termination == 'converged'),
        'reported_px': trials.map_bound_px(found.camera, estimate.map_covariance),
        'rejected': int((~estimate.kept).sum()),
        **{
            f'{names[k]}_sigmas': float(e / s)
            for k, e, s in zip(ESTIMATED, error, sigma, strict=True)
        },
    }


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
    return StudyResult(design, ordered, tuple(_summary(ordered)))


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


def groups(rows: Sequence[Row], names: Sequence[str]) -> Iterator[tuple[Row, list[Row]]]:
    """Group rows by the named columns, in order of first appearance."""
    members: dict[tuple[int | float | str, ...], list[Row]] = {}
    for row in rows:
        members.setdefault(tuple(row[name] for name in names), []).append(row)
    for key, same in members.items():
        yield dict(zip(names, key, strict=True)), same


def column(rows: Sequence[Row], name: str) -> Floats:
    """Column of numbers of some rows."""
    return np.array([row[name] for row in rows], np.float64)


def _ratio(rows: Sequence[Row], name: str, to: str) -> float:
    return rms(column(rows, name)) / rms(column(rows, to))


def _summary(rows: Sequence[Row]) -> Iterator[Row]:
    """RMS errors of each cell and method over the trials, relative to bounds and covariances."""
    names = [name for name in rows[0] if name.endswith('_sigmas')]
    for key, cell in groups(rows, _KEY):
        n, squares = len(cell), column(cell, 'map_px') ** 2
        # 0 for a single trial.
        relative = 0.5 * squares.std(ddof=1) / squares.mean() / math.sqrt(n) if n > 1 else 0.0
        # Of the mean of n chi^2 variables.
        tail = (1 - CONFIDENCE) / 2
        low, high = (chi2.ppf([tail, 1 - tail], len(ESTIMATED) * n) / n).tolist()
        normalised = float(column(cell, 'normalised').mean())
        bias = {name: float(column(cell, name).mean()) for name in names}
        spread = {name: rms(column(cell, name)) for name in names}
        worst = max(names, key=lambda name: abs(bias[name]))
        widest = max(names, key=lambda name: spread[name])
        row = {
            **key,
            'trials': n,
            'map_px': rms(column(cell, 'map_px')),
            'map_px_sigma': math.sqrt(squares.mean()) * float(relative),
            'to_bound': _ratio(cell, 'map_px', 'bound_px'),
            'to_own_bound': _ratio(cell, 'map_px', 'own_bound_px'),
            'to_per_image_bound': _ratio(cell, 'map_px', 'per_image_bound_px'),
            'to_reported': _ratio(cell, 'map_px', 'reported_px'),
            'pointing_arcsec': rms(column(cell, 'pointing_arcsec')),
            'pointing_to_bound': _ratio(cell, 'pointing_arcsec', 'pointing_bound_arcsec'),
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
        yield row


def table(result: StudyResult) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the summary: what the study is about."""
    names = [*_KEY, *_ERRORS, *_SHOWN[result.design.study]]
    cells = ([row[name] for name in names] for row in result.summary)
    return names, [[f'{c:.4g}' if isinstance(c, float) else str(c) for c in row] for row in cells]
