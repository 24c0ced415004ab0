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
        names = [name for name in columns if name and name not in chosen]
        p_values = _p_values(columns, chosen, names, value, sigma)
        p, best = min(zip(p_values, names, strict=True), default=(1.0, ''))
        if p > max_p_value or len(chosen) >= n // 3:
            break
        chosen = _still_needed(columns, [*chosen, best], value, sigma, max_p_value)
        if best not in chosen:
            break
    return _fitted(columns, chosen, value, sigma)


def _columns(time_s: Floats, temperature_degc: Floats) -> dict[str, Floats]:
    """Regressors (n,) by name: '' the constant, steps as ``step 7``."""
    n = len(time_s)
    years = (time_s - time_s.mean()) / SECONDS_PER_YEAR
    columns = {'': np.ones(n), _DRIFT: years}
    if np.isfinite(temperature_degc).all() and np.ptp(temperature_degc) > 0:
        columns[_TEMPERATURE] = temperature_degc - temperature_degc.mean()
    for k in range(_STEP_SIDE - 1, n - _STEP_SIDE):
        columns[f'step {k}'] = (np.arange(n) > k).astype(np.float64)
    return columns


def _solve(
    columns: dict[str, Floats], chosen: Sequence[str], value: Floats, sigma: Floats
) -> tuple[Floats, Floats, float]:
    """Coefficients of the constant and the chosen terms, their covariance, and chi^2."""
    A = np.stack([columns[name] for name in ('', *chosen)], axis=1) / sigma[:, None]
    b = value / sigma
    inverse = np.asarray(np.linalg.pinv(A.T @ A, rcond=1e-12, hermitian=True), np.float64)
    x = inverse @ (A.T @ b)
    return x, inverse, float(np.sum((b - A @ x) ** 2))


def _p_values(
    columns: dict[str, Floats],
    chosen: Sequence[str],
    names: Sequence[str],
    value: Floats,
    sigma: Floats,
) -> list[float]:
    """
    p-values of terms, each beside the chosen ones.

    A term lowers chi^2 by the square of the residual along the part of its column that is
    orthogonal to the columns of the chosen ones, so all are judged by one factorisation.
    """
    if not names:
        return []
    Q, _ = np.linalg.qr(
        np.stack([columns[name] for name in ('', *chosen)], axis=1) / sigma[:, None]
    )
    b = value / sigma
    b = b - Q @ (Q.T @ b)
    C = np.stack([columns[name] for name in names], axis=1) / sigma[:, None]
    squares = np.sum(C**2, axis=0)
    C -= Q @ (Q.T @ C)
    left = np.sum(C**2, axis=0)
    # A column that the chosen ones span lowers nothing.
    gain = np.where(left > 1e-12 * squares, (C.T @ b) ** 2 / np.maximum(left, 1e-300), 0.0)
    freedom = len(value) - len(chosen) - 2
    F = gain / np.maximum((b @ b - gain) / freedom, 1.0)
    places = sum(other.startswith('step') for other in columns)
    counts = [places if name.startswith('step') else 1 for name in names]
    p_values = fdtrc(1, freedom, np.maximum(F, 0.0)) * counts
    return [min(1.0, float(p)) for p in p_values]


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
            name: _p_values(columns, [c for c in chosen if c != name], [name], value, sigma)[0]
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
        (p,) = _p_values(columns, others, [name], value, sigma)
        kind, _, after = name.partition(' ')
        terms.append(Term(kind, float(x[k]), float(error[k]), p, int(after) if after else -1))
    fit = np.stack([columns[name] for name in ('', *chosen)], axis=1) @ x
    terms.sort(key=lambda term: (term.after, term.kind))
    return Trend(tuple(terms), np.asarray(fit), float(np.sqrt(scale)))
