# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The solver against dense algebra and SciPy, on problems without cameras."""

from collections.abc import Callable
import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares

from starcal_ros.estimation.levenberg_marquardt import (
    levenberg_marquardt,
    NormalEquations,
    NotObservable,
    solve_arrow,
)
from starcal_ros.estimation.limits import MOST_ROUNDS

Move = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def arrow(J_shared: np.ndarray, J_blocks: np.ndarray, r: np.ndarray) -> NormalEquations:
    """Normal equations from J_shared (m, n, p), J_blocks (m, n, q) and residuals (m, n)."""
    m, _, q = J_blocks.shape
    return NormalEquations(
        cost=0.5 * float((r**2).sum()),
        A=np.einsum('mni,mnj->ij', J_shared, J_shared),
        a=-np.einsum('mni,mn->i', J_shared, r),
        B=np.einsum('mni,mnj->mij', J_blocks, J_shared).reshape(m, q, -1),
        C=np.einsum('mni,mnj->mij', J_blocks, J_blocks),
        c=-np.einsum('mni,mn->mi', J_blocks, r),
    )


def plain(J: np.ndarray, r: np.ndarray) -> NormalEquations:
    """Normal equations without blocks from J (n, p) and residuals (n,)."""
    p = J.shape[1]
    empty = np.empty((0, 3, p)), np.empty((0, 3, 3)), np.empty((0, 3))
    return NormalEquations(0.5 * float(r @ r), J.T @ J, -J.T @ r, *empty)


def add(x: np.ndarray, shared: np.ndarray, _: np.ndarray) -> np.ndarray:
    return np.asarray(x + shared)


def random_arrow(m: int) -> tuple[NormalEquations, np.ndarray, np.ndarray]:
    """Normal equations with columns of very different scales, and their dense form (N, n)."""
    rng, p, q = np.random.default_rng(m), 7, 3
    J_shared = rng.normal(size=(m, 20, p)) * 10.0 ** rng.uniform(-4, 4, p)
    J_blocks = rng.normal(size=(m, 20, q)) * 10.0 ** rng.uniform(-4, 4, q)
    r = rng.normal(size=(m, 20))
    dense = np.zeros((20 * m, p + q * m))
    for k in range(m):
        dense[20 * k : 20 * k + 20, :p] = J_shared[k]
        dense[20 * k : 20 * k + 20, p + q * k : p + q * k + q] = J_blocks[k]
    return arrow(J_shared, J_blocks, r), dense.T @ dense, -dense.T @ r.ravel()


@pytest.mark.parametrize('m', [1, 2, 9])
@pytest.mark.parametrize('damping', [0.0, 1e-3, 10.0])
def test_a_step_equals_the_dense_one(m: int, damping: float) -> None:
    normal, N, n = random_arrow(m)
    shared, blocks = solve_arrow(normal, damping)
    unit = np.sqrt(np.diag(N))
    expected = np.linalg.solve(N / np.outer(unit, unit) + damping * np.eye(len(n)), n / unit)
    # Condition numbers below 1e4 once scaled: a dozen digits are left.
    step = np.r_[shared, blocks.ravel()]
    np.testing.assert_allclose(step * unit, expected, rtol=0, atol=1e-10)


def decays(
    unit: np.ndarray,
) -> tuple[Callable[[np.ndarray], NormalEquations], Move, Callable[[np.ndarray], np.ndarray]]:
    """Twelve decays ``c exp(-a t) + d exp(-b t)`` with noise; a, b shared; in ``unit`` (4,)."""
    rng = np.random.default_rng(2)
    t = np.linspace(0, 4, 25)
    own = rng.uniform(1, 5, (12, 2))
    y = own[:, :1] * np.exp(-0.6 * t) + own[:, 1:] * np.exp(-2.5 * t)
    y += 0.05 * rng.normal(size=y.shape)

    def unknowns(x: np.ndarray) -> tuple[np.ndarray, ...]:
        return *(x[:2] * unit[:2]), *(x[2:].reshape(12, 2) * unit[2:]).T[:, :, None]

    def residuals(x: np.ndarray) -> np.ndarray:
        a, b, c, d = unknowns(x)
        return np.asarray((c * np.exp(-a * t) + d * np.exp(-b * t) - y) * 20.0)

    def evaluate(x: np.ndarray) -> NormalEquations:
        a, b, c, d = unknowns(x)
        slow, fast = np.exp(-a * t), np.exp(-b * t)
        J_shared = np.stack([-c * t * slow * unit[0], -d * t * fast * unit[1]], axis=-1)
        J_blocks = np.stack([slow * unit[2], fast * unit[3]], axis=-1)
        return arrow(20 * J_shared, 20 * np.broadcast_to(J_blocks, (12, 25, 2)), residuals(x))

    def move(x: np.ndarray, shared: np.ndarray, blocks: np.ndarray) -> np.ndarray:
        return np.asarray(x + np.r_[shared, blocks.ravel()])

    return evaluate, move, residuals


START = np.r_[0.2, 6.0, np.ones(24)]


def test_it_finds_the_minimum_that_scipy_finds() -> None:
    evaluate, move, residuals = decays(np.ones(4))
    solution = levenberg_marquardt(START, evaluate, move)
    assert solution.converged and solution.termination == 'converged'
    reference = least_squares(
        lambda x: residuals(x).ravel(), START, method='lm', xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    sigma = np.sqrt(np.diag(np.linalg.inv(reference.jac.T @ reference.jac)))
    # Exchanging the two rates of all decays changes nothing: some versions of SciPy end there.
    slow_first = np.argsort(reference.x[:2])
    found, sigma = (x.reshape(-1, 2)[:, slow_first].ravel() for x in (reference.x, sigma))
    # SciPy's numerical derivatives carry it to 1e-6 sigma or so.
    assert np.abs((solution.state - found) / sigma).max() < 1e-4
    assert solution.normal.cost == pytest.approx(reference.cost, rel=1e-11)
    # The gradient is gone, in units in which 1-sigma steps change the cost by one half: a step
    # that promises less than 1e-13 of the cost, here 5e-6 sigma, is not taken any more.
    assert np.abs(solution.normal.a * sigma[:2]).max() < 1e-5


def test_the_units_of_the_unknowns_do_not_matter() -> None:
    # Powers of four have exact square roots: every number is the same but for its exponent.
    unit = np.array([4.0**9, 4.0**-7, 4.0**3, 4.0**-12])
    one = levenberg_marquardt(START, *decays(np.ones(4))[:2])
    units = np.r_[unit[:2], np.tile(unit[2:], 12)]
    other = levenberg_marquardt(START / units, *decays(unit)[:2])
    assert other.iterations == one.iterations
    np.testing.assert_allclose(other.state * units, one.state, rtol=1e-13)


@pytest.mark.parametrize(
    ('factor', 'words'),
    [
        (np.zeros(20), 'an unknown has no data'),
        (np.full(20, 1e6), 'cannot be separated'),
        # Alike to 1e-9: positive definite by luck of rounding at best, and refused all the same.
        (1e6 * (1 + 1e-9 * np.arange(20)), 'cannot be separated'),
    ],
    ids=['without data', 'alike', 'alike but for rounding'],
)
def test_a_column_that_says_nothing_of_its_own_is_not_observable(factor, words) -> None:
    J = np.random.default_rng(5).normal(size=(20, 3))
    J[:, 2] = J[:, 1] * factor
    with pytest.raises(NotObservable, match=words):
        solve_arrow(plain(J, J[:, 0]), 0.0)


def test_a_shared_column_that_the_blocks_explain_is_not_observable() -> None:
    # Elimination leaves zero but for rounding, whose sign is a toss-up: many seeds.
    for seed in range(20):
        rng = np.random.default_rng(seed)
        J_blocks = rng.normal(size=(4, 20, 3))
        J_shared = rng.normal(size=(4, 20, 5))
        J_shared[:, :, 2] = J_blocks[:, :, 0]
        with pytest.raises(NotObservable):
            solve_arrow(arrow(J_shared, J_blocks, rng.normal(size=(4, 20))), 0.0)


@pytest.mark.parametrize('bad', [np.nan, np.inf])
def test_a_start_without_a_cost_is_refused(bad: float) -> None:
    normal = dataclasses.replace(plain(np.eye(2), np.ones(2)), cost=bad)
    with pytest.raises(NotObservable, match='the cost at the start is not finite'):
        levenberg_marquardt(np.zeros(2), lambda _: normal, add)


def falling_line(x: np.ndarray) -> NormalEquations:
    """Cost 1e4 - x without a minimum, with the right gradient and some curvature."""
    return dataclasses.replace(plain(np.eye(1), -np.ones(1)), cost=1e4 - float(x[0]))


def test_a_search_without_end_or_against_a_wall_says_so() -> None:
    solution = levenberg_marquardt(np.zeros(1), falling_line, add)
    assert not solution.converged and solution.iterations == MOST_ROUNDS
    assert solution.termination == 'iteration_limit'

    # Downhill leads out of the domain: no step is ever allowed, however short.
    def walled(x: np.ndarray) -> NormalEquations:
        normal = falling_line(x)
        return normal if x[0] <= 0 else dataclasses.replace(normal, cost=np.inf)

    solution = levenberg_marquardt(np.zeros(1), walled, add)
    assert solution.state[0] == 0.0 and solution.termination == 'no_descent'


def test_a_step_to_no_cost_is_taken_back() -> None:
    # log(x) fitted to -5 from 1: the first full step, to -4, is outside the domain.
    tried: list[float] = []

    def evaluate(x: np.ndarray) -> NormalEquations:
        tried.append(float(x[0]))
        if x[0] <= 0:
            return dataclasses.replace(plain(np.ones((1, 1)), np.ones(1)), cost=np.inf)
        return plain(1 / x[:, None], np.log(x) + 5.0)

    solution = levenberg_marquardt(np.ones(1), evaluate, add)
    assert solution.converged and min(tried) <= 0
    # It ends at a step of a millionth of a sigma, which is x.
    assert solution.state[0] == pytest.approx(np.exp(-5), rel=2e-6)
