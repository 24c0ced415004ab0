# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Rows of a table as series in time with their trends, what was active when, and an overview.

Model of a series of measurements with known sigmas: a constant, a drift with time, a coefficient
of temperature, and steps between two neighbouring measurements.  Terms enter one by one, the most
significant first, while its p-value is below a limit, and leave again where another term has made
them superfluous (stepwise regression).  Candidates are judged by an F-test whose variance is that
of the residuals, but at least that of the sigmas; the p-value of a step is multiplied by the
number of places that it could stand at (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import itertools
import math

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import fdtrc

from starcal_ground.comparison import alignment_difference_rad
from starcal_ground.mission.trend.trend_table import COMPUTED, Row
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import grid_lines_of_sight, movement
from starcal_ros.camera import INTRINSIC_NAMES, line_of_sight
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.records import CameraGeometry

FEWEST = 6  # measurements; with fewer, a step and a drift are one
MAX_P_VALUE = 1e-3  # with a dozen series on a page, one false finding in a hundred pages
_DRIFT, _TEMPERATURE, _STEP = 'drift', 'temperature', 'step'
_STEP_SIDE = 2  # measurements on each side of a step: one alone is an outlier
_MOST_PLACES = 1000  # places of a step that are tested: 0.3 s for as many measurements
SECONDS_PER_YEAR = 365.25 * 86400.0  # Julian year, IAU


@dataclass(frozen=True)
class Term:
    """
    A significant term of a series.

    ``kind`` is drift (per year), temperature (per degC) or step; ``after`` the index of the last
    measurement before a step, -1 for the others.
    """

    kind: str
    size: float
    sigma: float
    p_value: float
    after: int = -1


@dataclass(frozen=True)
class Trend:
    """
    The terms of a series, the fit (n,) at its measurements, and the scatter about it.

    ``scatter`` is the root of the reduced chi^2: over one where the sigmas are too small or
    something else changes; NaN where the series is too short to be tested.
    """

    terms: tuple[Term, ...]
    fit: Floats
    scatter: float


def trend_of(
    time_s: Floats,
    value: Floats,
    sigma: Floats,
    temperature_degc: Floats,
    max_p_value: float = MAX_P_VALUE,
) -> Trend:
    """
    Trend of a series (n,) in order of time.

    Temperatures that are not all known, or all equal, are no regressor.
    """
    n = len(value)
    if n < FEWEST or not (np.isfinite(sigma) & (sigma > 0)).all():
        return Trend((), np.full(n, float(np.mean(value))) if n else np.empty(0), np.nan)
    kinds, columns, trials = _candidates(time_s, temperature_degc)
    A, b = columns / sigma[:, None], value / sigma

    def beside(k: int, others: list[int]) -> float:
        return float(_p_values(A, b, [c for c in others if c != k], trials)[k])

    chosen = [0]
    while len(chosen) <= n // 3:
        p_values = _p_values(A, b, chosen, trials)
        best = int(np.argmin(p_values))
        if p_values[best] > max_p_value:
            break
        chosen.append(best)
        while len(chosen) > 2:  # without those that the others have made superfluous
            p, worst = max((beside(k, chosen), k) for k in chosen[1:])
            if p <= max_p_value:
                break
            chosen.remove(worst)
        if best not in chosen:
            break
    inverse = np.linalg.pinv(A[:, chosen].T @ A[:, chosen], rcond=1e-12, hermitian=True)
    x = inverse @ (A[:, chosen].T @ b)
    fit = columns[:, chosen] @ x
    scale = float(np.sum(((value - fit) / sigma) ** 2)) / (n - len(chosen))
    error = np.sqrt(np.diag(inverse) * max(scale, 1.0))
    terms = [
        Term(kinds[k][0], float(size), float(sigma), beside(k, chosen), kinds[k][1])
        for k, size, sigma in zip(chosen[1:], x[1:], error[1:], strict=True)
    ]
    terms.sort(key=lambda term: (term.after, term.kind))
    return Trend(tuple(terms), fit, math.sqrt(scale))


def _candidates(
    time_s: Floats, temperature_degc: Floats
) -> tuple[list[tuple[str, int]], Floats, Floats]:
    """Kinds of terms with the measurement before a step, regressors (n, m), and trials of each."""
    n = len(time_s)
    kinds, columns = [('', -1), (_DRIFT, -1)], [np.ones(n), (time_s - time_s.mean())]
    columns[1] = columns[1] / SECONDS_PER_YEAR
    if np.isfinite(temperature_degc).all() and np.ptp(temperature_degc) > 0:
        kinds.append((_TEMPERATURE, -1))
        columns.append(temperature_degc - temperature_degc.mean())
    # Long series are tested at each second place and so on: the memory grows with the square.
    places = range(_STEP_SIDE - 1, n - _STEP_SIDE, 1 + n // _MOST_PLACES)
    steps = np.arange(n)[:, None] > np.array(places)
    trials = np.repeat([1.0, len(places)], [len(kinds), len(places)])
    return [*kinds, *((_STEP, k) for k in places)], np.column_stack([*columns, steps]), trials


def _p_values(A: Floats, b: Floats, chosen: list[int], trials: Floats) -> Floats:
    """
    p-values (m,) of all terms, each beside the chosen ones; 1 for those.

    A term lowers chi^2 by the square of the residual along the part of its column that is
    orthogonal to the columns of the chosen ones, so all are judged by one factorisation.
    """
    Q, _ = np.linalg.qr(A[:, chosen])
    left, b = A - Q @ (Q.T @ A), b - Q @ (Q.T @ b)
    remaining = np.sum(left**2, axis=0)
    # A column that the chosen ones span lowers nothing.
    is_new = remaining > 1e-12 * np.sum(A**2, axis=0)
    gain = np.where(is_new, (b @ left) ** 2 / np.where(is_new, remaining, 1.0), 0.0)
    freedom = len(b) - len(chosen) - 1
    F = gain / np.maximum((b @ b - gain) / freedom, 1.0)
    return np.asarray(np.minimum(trials * fdtrc(1, freedom, np.maximum(F, 0.0)), 1.0))


_GRID = (15, 12)  # columns and rows of pixels that changes are taken over
# Series whose estimates trade with each other: one drift shows in several of them.
_TRADING = {
    name: group
    for group in (
        ('boresight about x', 'alignment_x', 'cy'),
        ('boresight about y', 'alignment_y', 'cx'),
    )
    for name in group
}


@dataclass(frozen=True)
class Series:
    """
    A number of n calibrations in order of time, with its trend.

    ``value`` and ``sigma`` are (n,) in ``unit``; ``row`` the indices of the calibrations.
    """

    name: str
    unit: str
    row: tuple[int, ...]
    value: Floats
    sigma: Floats
    trend: Trend


@dataclass(frozen=True)
class Active:
    """
    A calibration that was active from a stamp to another (0: still is).

    ``assumed``: nothing records an activation; each accepted calibration is taken as active from
    its last image.
    """

    row: int
    since_ns: int
    until_ns: int
    assumed: bool


@dataclass(frozen=True)
class Change:
    """
    Change by a calibration against another one, such as that which was active then.

    ``line_of_sight_px`` is the largest change of a line of sight in the star tracker frame,
    ``shape_px`` that with the common rotation removed; px at the focal length.
    """

    row: int
    against: int
    line_of_sight_px: float
    shape_px: float


def series_of(rows: Sequence[Row], max_p_value: float = MAX_P_VALUE) -> list[Series]:
    """Series of parameters, boresight and alignment of the calibrations of one lens model."""
    first = rows[0].geometry
    series = []
    for k, name in enumerate(rows[0].names):
        values = np.array([row.values[k] for row in rows])
        sigmas = np.array([row.sigmas[k] for row in rows])
        unit = 'px' if name in INTRINSIC_NAMES else ''
        series += _known(rows, name, unit, values, sigmas, max_p_value)
    boresight = _boresight_arcsec([row.geometry for row in rows])
    of_boresight = np.array([row.boresight_sigma_arcsec for row in rows])
    for k, axis in enumerate('xy'):
        name = f'boresight about {axis}'
        series += _known(rows, name, 'arcsec', boresight[:, k], of_boresight[:, k], max_p_value)
    alignment = np.array(
        [alignment_difference_rad(row.geometry, first) / ARCSECOND_RAD for row in rows]
    )
    sigmas = np.array([row.sigmas[-3:] for row in rows]) / ARCSECOND_RAD
    for k, axis in enumerate('xyz'):
        name = f'alignment_{axis}'
        series += _known(rows, name, 'arcsec', alignment[:, k], sigmas[:, k], max_p_value)
    return series


def findings(shown: Sequence[Series]) -> list[tuple[Series, Term]]:
    """Terms of series, a drift of several that trade with each other where it is clearest."""
    terms = [(series, term) for series in shown for term in series.trend.terms]
    clearest: dict[object, tuple[float, str]] = {}
    for series, term in terms:
        if term.kind == 'drift':
            group = _TRADING.get(series.name, series.name)
            best = (abs(term.size) / term.sigma, series.name)
            clearest[group] = max(best, clearest.get(group, best))
    names = {name for _, name in clearest.values()}
    return [
        (series, term) for series, term in terms if term.kind != 'drift' or series.name in names
    ]


def _known(
    rows: Sequence[Row],
    name: str,
    unit: str,
    value: Floats,
    sigma: Floats,
    max_p_value: float,
) -> list[Series]:
    """The series of the calibrations that estimated a number; none where none did."""
    known = np.flatnonzero(np.isfinite(sigma) & (sigma > 0) & np.isfinite(value))
    if not len(known):
        return []
    time_s = np.array([rows[k].time_ns for k in known], np.float64) / NANOSECONDS_PER_SECOND
    temperature = np.array([rows[k].temperature_degc for k in known])
    trend = trend_of(time_s, value[known], sigma[known], temperature, max_p_value)
    return [Series(name, unit, tuple(known.tolist()), value[known], sigma[known], trend)]


def _boresight_arcsec(geometries: Sequence[CameraGeometry]) -> Floats:
    """Rotations (n, 2) of the line of sight of the middle about x and y of the first camera."""
    camera = geometries[0].camera
    middle = np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])
    in_tracker = [
        geometry.star_tracker_from_camera.apply(line_of_sight(geometry.camera, middle))
        for geometry in geometries
    ]
    tracker_from_first = Rotation.from_quat(geometries[0].star_tracker_from_camera_xyzw)
    of_first = tracker_from_first.inv().apply(in_tracker)
    return np.asarray(np.cross(of_first[0], of_first)[:, :2] / ARCSECOND_RAD)


def activations(rows: Sequence[Row]) -> list[Active]:
    """Calibrations that were active, in order; recorded activations, else assumed ones."""
    recorded = sorted(
        (row.active_since_ns, k) for k, row in enumerate(rows) if row.active_since_ns > 0
    )
    # A calibration computed from a bag was never on board.
    on_board = [(row.last_ns, k) for k, row in enumerate(rows) if row.accepted]
    on_board = [(since, k) for since, k in on_board if rows[k].kind != COMPUTED] or on_board
    starts = recorded or sorted(on_board)
    return [
        Active(k, since, until, not recorded)
        for (since, k), (until, _) in itertools.pairwise([*starts, (0, -1)])
        if since != until
    ]


def changes(rows: Sequence[Row], active: Sequence[Active]) -> list[Change]:
    """Change by each calibration against the one active at its last image."""
    made = []
    for k, row in enumerate(rows):
        then = [period for period in active if period.since_ns <= row.last_ns and period.row != k]
        if then:
            made.append(_change(rows, k, then[-1].row))
    return made


def _change(rows: Sequence[Row], row: int, against: int) -> Change:
    before, after = rows[against].geometry, rows[row].geometry
    if (before.camera.width, before.camera.height) != (after.camera.width, after.camera.height):
        return Change(row, against, math.inf, math.inf)
    old, new = (grid_lines_of_sight(geometry, *_GRID) for geometry in (before, after))
    moved_rad = np.linalg.norm(new - old, axis=1).max()
    _, left_px = movement(before, after, *_GRID)
    total_px = float(moved_rad * after.camera.parameters[0])
    return Change(row, against, total_px, float(left_px.max()))


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Calibrations by spacecraft, camera, frame, size and lens model; the largest group first."""
    by_name: dict[str, list[Row]] = {}
    for row in rows:
        if row.error:
            continue
        size = f'{row.width} x {row.height}'
        parts = (row.spacecraft, row.camera, row.child_frame, size, row.lens_model)
        name = ', '.join(filter(None, parts))
        by_name.setdefault(name, []).append(row)
    return dict(sorted(by_name.items(), key=lambda item: (-len(item[1]), item[0])))


def distinct(rows: Sequence[Row]) -> list[Row]:
    """
    Rows of different calibrations, the first of each.

    A state folder has a calibration once more for each activation, and a folder may be copied.
    """
    first: dict[object, Row] = {}
    for row in rows:
        key = row.first_ns, row.last_ns, row.values, row.star_tracker_from_camera_xyzw
        first.setdefault(key, row)
    return list(first.values())
