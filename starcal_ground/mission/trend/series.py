# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Rows of a table as series in time with their trends, and the change by each calibration.

Model of a series of measurements with known sigmas: a constant, a drift with time, a coefficient
of temperature, and steps between two neighbouring measurements.  Terms enter one by one, the most
significant first, while its p-value is below a limit, and leave again where another term has made
them superfluous (stepwise regression).  A candidate is judged by its fall of chi^2, twice: against
the sigmas, and against the scatter of the residuals alone (F-test).  The larger p-value counts, so
neither sigmas that are too small nor a few residuals that happen to be small make a finding.  The
p-value of a step is multiplied by the number of places that it could stand at (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from scipy.special import chdtrc, fdtrc

from starcal_ground.comparison import alignment_difference_rad
from starcal_ground.mission.trend.trend_table import COMPUTED, Row
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import Derivatives, grid_lines_of_sight
from starcal_ros.camera import INTRINSIC_NAMES, line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SECONDS_PER_YEAR
from starcal_ros.records import Calibration

FEWEST = 6  # measurements; with fewer, a step and a drift are one
MAX_P_VALUE = 1e-3  # with a dozen series on a page, one false finding in a hundred pages
STEP, DRIFT, TEMPERATURE = 'step', 'drift', 'temperature'
_STEP_SIDE = 2  # measurements on each side of a step: one alone is an outlier
_MOST_PLACES = 1000  # places of a step that are tested: 0.3 s for as many measurements
_GRID = (15, 12)  # columns and rows of pixels that changes are taken over
_LEAST, _MOST = 1e-30, 1e15  # sigmas in use: their squares and inverses must stay finite


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
    if n < FEWEST:
        return Trend((), np.full(n, np.mean(value)), math.nan)
    candidates = _candidates(time_s, temperature_degc)
    kinds = [kind for kind, _, _ in candidates]
    trials = np.array([count for _, _, count in candidates])
    A = np.column_stack([regressor for _, regressor, _ in candidates]) / sigma[:, None]
    b = value / sigma

    def p_value(k: int) -> float:
        return float(_p_values(A, b, [c for c in chosen if c != k], trials)[k])

    chosen = [0]
    while len(chosen) <= n // 3:
        p_values = _p_values(A, b, chosen, trials)
        best = int(np.argmin(p_values))
        if p_values[best] > max_p_value:
            break
        chosen.append(best)
        # Without those that the others have made superfluous.
        while len(chosen) > 2 and p_value(worst := max(chosen[1:], key=p_value)) > max_p_value:
            chosen.remove(worst)
        if best not in chosen:
            break
    inverse = np.linalg.pinv(A[:, chosen].T @ A[:, chosen], rcond=1e-12, hermitian=True)
    size = inverse @ (A[:, chosen].T @ b)
    fit = A[:, chosen] @ size
    scatter = math.sqrt(np.sum((b - fit) ** 2) / (n - len(chosen)))
    error = np.sqrt(np.diag(inverse)) * max(scatter, 1.0)
    made = [
        Term(kinds[k][0], float(size[j]), float(error[j]), p_value(k), kinds[k][1])
        for j, k in enumerate(chosen)
        if j
    ]
    return Trend(tuple(sorted(made, key=lambda term: term.after)), fit * sigma, scatter)


def _candidates(
    time_s: Floats, temperature_degc: Floats
) -> list[tuple[tuple[str, int], Floats, float]]:
    """Kind of each term with the measurement before a step, its regressor (n,), and its trials."""
    n, drift = len(time_s), (time_s - time_s.mean()) / SECONDS_PER_YEAR
    terms: list[tuple[tuple[str, int], Floats, float]] = []
    terms += (('', -1), np.ones(n), 1.0), ((DRIFT, -1), drift, 1.0)
    if np.isfinite(temperature_degc).all() and np.ptp(temperature_degc) > 0:
        terms.append(((TEMPERATURE, -1), temperature_degc - temperature_degc.mean(), 1.0))
    # Long series are tested at each second place and so on: the memory grows with the square.
    places = range(_STEP_SIDE - 1, n - _STEP_SIDE, 1 + n // _MOST_PLACES)
    after = np.arange(n)
    terms += [((STEP, k), (after > k).astype(np.float64), len(places)) for k in places]
    return terms


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
    left_over = np.maximum(b @ b - gain, np.finfo(float).tiny)
    by_scatter = fdtrc(1, freedom, gain * freedom / left_over)
    return np.asarray(np.minimum(trials * np.maximum(by_scatter, chdtrc(1, gain)), 1.0))


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


def series_of(rows: Sequence[Row], max_p_value: float = MAX_P_VALUE) -> list[Series]:
    """
    Series of the parameters, boresight and alignment of the calibrations of one lens model.

    A number has those of the calibrations that estimated it; boresight and alignment are relative
    to the first one.
    """
    made = calibrations(rows)
    first = made[0].geometry
    middle = np.array([[first.camera.width - 1, first.camera.height - 1]]) / 2
    # The derivatives of all cameras of a group are those of one, to the change of its parameters.
    of_all = Derivatives.at(first.camera, middle)
    found = [_boresight(one, middle, of_all) for one in made]
    sights, sight_sigmas_rad = map(np.array, zip(*found, strict=True))
    of_first = first.star_tracker_from_camera.inv().apply(sights)
    turned_rad = [alignment_difference_rad(one.geometry, first) for one in made]
    angles = np.column_stack([np.cross(of_first[0], of_first)[:, :2], turned_rad]) / ARCSECOND_RAD
    sigmas = np.array([one.sigma for one in made])
    aligned = np.array([[one.has_alignment / ARCSECOND_RAD] for one in made])
    angle_sigmas = np.column_stack([sight_sigmas_rad, sigmas[:, -3:]]) * aligned
    values = np.column_stack([[one.geometry.camera.parameters for one in made], angles])
    sigmas = np.column_stack([sigmas[:, :-3], angle_sigmas])
    names = first.camera.parameter_names
    units = ['px' if name in INTRINSIC_NAMES else '' for name in names] + ['arcsec'] * 5
    names += 'boresight about x', 'boresight about y', 'alignment_x', 'alignment_y', 'alignment_z'
    time_s = np.array([row.time_ns for row in rows], np.float64) / NANOSECONDS_PER_SECOND
    degc = np.array([row.temperature_degc for row in rows])
    shown = []
    for name, unit, value, sigma in zip(names, units, values.T, sigmas.T, strict=True):
        k = np.flatnonzero((sigma > _LEAST) & (sigma < _MOST) & np.isfinite(value))
        if len(k):
            trend = trend_of(time_s[k], value[k], sigma[k], degc[k], max_p_value)
            shown.append(Series(name, unit, tuple(k.tolist()), value[k], sigma[k], trend))
    return shown


def calibrations(rows: Sequence[Row]) -> list[Calibration]:
    """The calibrations of rows that are no failures."""
    return [row.calibration for row in rows if row.calibration is not None]


def _boresight(one: Calibration, middle: Floats, of_all: Derivatives) -> tuple[Floats, Floats]:
    """
    Line of sight (3,) of the middle (1, 2) of the detector, star tracker frame, and its sigma.

    The sigma (2,), rad, is about the x and y axes of the camera.
    """
    if of_all.J.shape[-1] == len(one.map_covariance.matrix):
        (direction,) = line_of_sight(one.geometry.camera, middle)
        (covariance,) = of_all.covariance_rad2(one.map_covariance, of_all.J)
    else:  # with a field, and the first one without, or the reverse
        direction, covariance = _sight(one, middle)
    in_tracker = one.geometry.star_tracker_from_camera.apply(direction)
    # A small rotation about x moves the direction along y, one about y along x.
    return in_tracker, np.sqrt(np.diag(covariance)[[1, 0]])


def _sight(one: Calibration, pixel: Floats) -> tuple[Floats, Floats]:
    """Direction (3,) of a pixel (1, 2) and its covariance (3, 3), rad^2, camera frame."""
    derivatives = Derivatives.at(one.geometry.camera, pixel)
    (covariance,) = derivatives.covariance_rad2(one.map_covariance, derivatives.J)
    return derivatives.directions[0], covariance


@dataclass(frozen=True)
class Change:
    """
    Change by calibration ``row`` against calibration ``against``, that which was active then.

    ``px`` is the largest change of a line of sight in the star tracker frame, px at the focal
    length; ``sigmas`` the same in the 1-sigma of both, NaN where that is not known.
    """

    row: int
    against: int
    px: float
    sigmas: float


def activations(rows: Sequence[Row]) -> list[tuple[int, int]]:
    """
    Times since which calibrations were active, ns, and the indices of these, in order.

    Where nothing records an activation, each accepted calibration counts as active from its last
    image; those that were computed from a bag were never on board, if there are others.
    """
    made = list(enumerate(calibrations(rows)))
    recorded = [(one.active_since_ns, k) for k, one in made if one.active_since_ns > 0]
    accepted = [(one.time_ns, k) for k, one in made if one.accepted]
    on_board = [(since_ns, k) for since_ns, k in accepted if rows[k].kind != COMPUTED]
    return sorted(recorded or on_board or accepted)


def pairs(rows: Sequence[Row], active: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Indices of each calibration and of the one that was active at its last image."""
    return [
        (k, against)
        for k, one in enumerate(calibrations(rows))
        for against in [i for since_ns, i in active if since_ns <= one.time_ns and i != k][-1:]
    ]


def change(rows: Sequence[Row], row: int, against: int) -> Change:
    """Change between two calibrations; infinite where they do not compare."""
    both = calibrations([rows[against], rows[row]])
    cameras = [one.geometry.camera for one in both]
    if len({(camera.width, camera.height) for camera in cameras}) > 1:
        return Change(row, against, math.inf, math.nan)
    old, new = (grid_lines_of_sight(one.geometry, *_GRID) for one in both)
    moved_rad = np.linalg.norm(new - old, axis=1)
    worst = int(np.argmax(moved_rad))
    pixel = pixel_grid(cameras[1], *_GRID)[worst : worst + 1]
    variance_rad2 = sum(float(np.trace(_sight(one, pixel)[1])) for one in both)
    sigmas = float(moved_rad[worst]) / math.sqrt(variance_rad2) if variance_rad2 > 0 else math.nan
    return Change(row, against, float(moved_rad[worst] * cameras[1].parameters[0]), sigmas)


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Calibrations by spacecraft, camera, frame, size and lens model; the largest group first."""
    by_name: dict[str, list[Row]] = {}
    for row, one in ((row, row.calibration) for row in rows):
        if one is not None:
            camera = one.geometry.camera
            size = f'{camera.width} x {camera.height}'
            parts = (row.spacecraft, row.camera, one.child_frame, size, camera.model)
            by_name.setdefault(', '.join(filter(None, parts)), []).append(row)
    return dict(sorted(by_name.items(), key=lambda item: (-len(item[1]), item[0])))


def distinct(rows: Sequence[Row]) -> list[Row]:
    """
    Rows of different calibrations, the first of each.

    A state folder has a calibration once more for each activation, and a folder may be copied.
    """
    first: dict[object, Row] = {}
    for row, one in zip(rows, calibrations(rows), strict=True):
        numbers = one.geometry.camera.parameters, one.geometry.star_tracker_from_camera_xyzw
        key = one.first_image_ns, one.time_ns, *(array.tobytes() for array in numbers)
        first.setdefault(key, row)
    return list(first.values())
