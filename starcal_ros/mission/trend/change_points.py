# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Steps and drifts of a series of measurements with known sigmas.

Model: a constant, a drift with time, a coefficient of temperature, and steps between two
neighbouring measurements.  Terms enter one by one, the most significant first, while its p-value
is below a limit, and leave again where another term has made them superfluous (stepwise
regression).  Candidates are judged by an F-test whose variance is that of the residuals, but at
least that of the sigmas; the p-value of a step is multiplied by the number of places that it could
stand at (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from starcal_ros.arrays import Floats

FEWEST = 6  # measurements; with fewer, a step and a drift are one
MAX_P_VALUE = 1e-3  # with a dozen series on a page, one false finding in a hundred pages
_DRIFT, _TEMPERATURE = 'drift', 'temperature'
_STEP_SIDE = 2  # measurements on each side of a step: one alone is an outlier
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
    sigma = np.where(sigma > 0, sigma, np.nan)
    if n < FEWEST or not np.isfinite(sigma).all():
        return Trend((), np.full(n, float(np.mean(value))) if n else np.empty(0), np.nan)
    columns = _columns(time_s, temperature_degc)
    chosen: list[str] = []
    while True:
        p_values = _p_values(columns, chosen, value, sigma)
        p, best = min((p, name) for name, p in p_values.items() if name not in chosen)
        if p > max_p_value or len(chosen) >= n // 3:
            break
        chosen = _still_needed(columns, [*chosen, best], value, sigma, max_p_value)
        if best not in chosen:
            break
    return _fitted(columns, chosen, value, sigma)


def _columns(time_s: Floats, temperature_degc: Floats) -> dict[str, Floats]:
    """Regressors (n,) by name, '' the constant; those of steps are made when they are needed."""
    years = (time_s - time_s.mean()) / SECONDS_PER_YEAR
    columns = {'': np.ones(len(time_s)), _DRIFT: years}
    if np.isfinite(temperature_degc).all() and np.ptp(temperature_degc) > 0:
        columns[_TEMPERATURE] = temperature_degc - temperature_degc.mean()
    return columns


def _matrix(columns: dict[str, Floats], chosen: Sequence[str]) -> Floats:
    """Regressors (n, 1 + c) of the constant and the chosen terms; a step is named ``step 7``."""
    measurement, found = np.arange(len(columns[''])), [columns['']]
    for name in chosen:
        kind, _, after = name.partition(' ')
        found.append(np.asarray(measurement > int(after), np.float64) if after else columns[kind])
    return np.stack(found, axis=1)


def _solve(
    columns: dict[str, Floats], chosen: Sequence[str], value: Floats, sigma: Floats
) -> tuple[Floats, Floats, float]:
    """Coefficients of the constant and the chosen terms, their covariance, and chi^2."""
    A = _matrix(columns, chosen) / sigma[:, None]
    b = value / sigma
    inverse = np.asarray(np.linalg.pinv(A.T @ A, rcond=1e-12, hermitian=True), np.float64)
    x = inverse @ (A.T @ b)
    return x, inverse, float(np.sum((b - A @ x) ** 2))


def _p_values(
    columns: dict[str, Floats], chosen: Sequence[str], value: Floats, sigma: Floats
) -> dict[str, float]:
    """
    p-values of all terms, each beside the chosen ones; 1 for those.

    A term lowers chi^2 by the square of the residual along the part of its column that is
    orthogonal to the columns of the chosen ones, so all are judged by one factorisation.  The
    sums of a step are those over the measurements after it: time and memory grow with n.
    """
    n, w = len(value), 1.0 / sigma[:, None]
    Q, _ = np.linalg.qr(_matrix(columns, chosen) * w)
    b = value / sigma
    b = b - Q @ (Q.T @ b)
    names = [name for name in columns if name]
    places = range(_STEP_SIDE - 1, n - _STEP_SIDE)
    terms = np.hstack([w, b[:, None], Q]) * w  # times a column, for the sums below
    C = np.stack([columns[name] for name in names], axis=1)
    sums = np.vstack([C.T @ terms, np.cumsum(terms[::-1], axis=0)[::-1][places.start + 1 :]])
    sums = sums[: len(names) + len(places)]
    sums[: len(names), 0] = np.sum((C * w) ** 2, axis=0)
    squares, along_b, along_Q = sums[:, 0], sums[:, 1], sums[:, 2:]
    left = squares - np.sum(along_Q**2, axis=1)
    # A column that the chosen ones span lowers nothing.
    gain = np.where(left > 1e-12 * squares, along_b**2 / np.maximum(left, 1e-300), 0.0)
    freedom = n - len(chosen) - 2
    F = gain / np.maximum((b @ b - gain) / freedom, 1.0)
    p_values = fdtrc(1, freedom, np.maximum(F, 0.0))
    p_values[len(names) :] *= len(places)
    names += [f'step {k}' for k in places]
    return dict(zip(names, np.minimum(p_values, 1.0).tolist(), strict=True))


def _still_needed(
    columns: dict[str, Floats],
    chosen: list[str],
    value: Floats,
    sigma: Floats,
    max_p_value: float,
) -> list[str]:
    """The chosen terms without those that the others have made superfluous."""
    while len(chosen) > 1:
        p_values = {
            name: _p_values(columns, [c for c in chosen if c != name], value, sigma)[name]
            for name in chosen
        }
        worst = max(p_values, key=lambda name: p_values[name])
        if p_values[worst] <= max_p_value:
            break
        chosen = [name for name in chosen if name != worst]
    return chosen


def _fitted(columns: dict[str, Floats], chosen: list[str], value: Floats, sigma: Floats) -> Trend:
    x, inverse, chi2 = _solve(columns, chosen, value, sigma)
    scale = max(chi2 / (len(value) - len(chosen) - 1), 0.0)
    error = np.sqrt(np.diag(inverse) * max(scale, 1.0))
    terms = []
    for k, name in enumerate(chosen, start=1):
        others = [other for other in chosen if other != name]
        p = _p_values(columns, others, value, sigma)[name]
        kind, _, after = name.partition(' ')
        terms.append(Term(kind, float(x[k]), float(error[k]), p, int(after) if after else -1))
    fit = _matrix(columns, chosen) @ x
    terms.sort(key=lambda term: (term.after, term.kind))
    return Trend(tuple(terms), np.asarray(fit), float(np.sqrt(scale)))
