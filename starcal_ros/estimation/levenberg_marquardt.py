# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Levenberg-Marquardt on bordered block-diagonal normal equations (Eqs. 20-26).

Independent of cameras and stars.  The unknowns are p shared ones s and m blocks b_k of q each, and
the normal matrix is an arrow::

    N = [ A    B_1' ... B_m' ]        A (p, p)
        [ B_1  C_1           ]        B (m, q, p)
        [ ...        ...     ]        C (m, q, q)
        [ B_m            C_m ]

so a step takes one pass over the blocks (Schur complement) and memory is linear in m:
with C~ and A~ damped, ``S = A~ - sum B_k' C~_k^-1 B_k``.  With m = 0 it is plain
Levenberg-Marquardt.  A step is accepted by the same cost whose gradient gave the step.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import functools
from typing import Generic, TypeVar

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.limits import MOST_ROUNDS, ROUNDING

StateT = TypeVar('StateT')

# The paper starts at 1e-3 (step 4), which slows weak directions: 6 passes instead of 3.
_LAMBDA_START = 1e-6


@dataclass(frozen=True)
class NormalEquations:
    """
    Cost ``F = sum of squares / 2`` (or robust), its normal matrix and negative gradient.

    ``A`` (p, p), ``a`` (p,); ``B`` (m, q, p); ``C`` (m, q, q), ``c`` (m, q); the gradient of the
    cost is ``-[a; c]``.
    """

    cost: float
    A: Floats
    a: Floats
    B: Floats
    C: Floats
    c: Floats


@dataclass(frozen=True)
class Equations:
    """
    An arrow with its blocks eliminated.

    Attributes
    ----------
    information : (p, p)
        S on the shared unknowns.
    gradient : (p,)
    cross : (m, q, p)
        ``B_k``.
    own : (m, q)
        ``C_k^-1 c_k``.
    covariance : (m, q, q)
        ``C_k^-1``: of the unknowns of a block, the shared ones known.
    """

    information: Floats
    gradient: Floats
    cross: Floats
    own: Floats
    covariance: Floats

    @functools.cached_property
    def back(self) -> Floats:
        """``C_k^-1 B_k`` (m, q, p): unknowns of a block follow the shared by ``own - back s``."""
        return np.asarray(self.covariance @ self.cross)


@dataclass(frozen=True)
class Solution(Generic[StateT]):
    """
    Final state of the search, its normal equations, and the reason of its termination.

    ``termination`` is ``converged``, ``no_descent`` (no lower cost up to the largest damping) or
    ``iteration_limit``; only the first is success.
    """

    state: StateT
    normal: NormalEquations
    iterations: int
    termination: str

    @property
    def converged(self) -> bool:
        """True if a minimum was reached."""
        return self.termination == 'converged'


class NotObservable(TooFewObservations):
    """The normal matrix is singular: the data do not determine all unknowns."""


def inverse(matrix: Floats) -> Floats:
    """
    Inverse of positive definite matrices (..., n, n), scaled to a unit diagonal for the solution.

    Raises
    ------
    NotObservable
        If one is not positive definite beyond rounding.
    """
    diagonal = np.einsum('...ii->...i', matrix)
    if not (diagonal > 0).all():
        raise NotObservable('an unknown has no data')
    scale = 1.0 / np.sqrt(diagonal)
    scaled = matrix * scale[..., :, None] * scale[..., None, :]
    try:
        # The factorisation fails if the matrix is not positive definite.
        lower = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError as error:
        raise NotObservable('the unknowns cannot be separated') from error
    if np.einsum('...ii->...i', lower).min(initial=1.0) < 1e-7:
        raise NotObservable('the unknowns cannot be separated')
    lower_inverse = np.linalg.inv(lower)
    scaled = np.swapaxes(lower_inverse, -1, -2) @ lower_inverse
    return np.asarray(scale[..., :, None] * scaled * scale[..., None, :])


def eliminated(normal: NormalEquations) -> Equations:
    """
    Return the normal equations with the blocks eliminated.

    Raises
    ------
    NotObservable
        If a block is not positive definite.
    """
    m, q, p = normal.B.shape
    covariance = inverse(normal.C)
    # The product of a matrix and its transpose takes half the time of that of any two.
    root = (np.linalg.cholesky(covariance).transpose(0, 2, 1) @ normal.B).reshape(m * q, p)
    own = np.einsum('mij,mj->mi', covariance, normal.c)
    gradient = normal.a - normal.B.reshape(m * q, p).T @ own.ravel()
    information = normal.A - root.T @ root
    return Equations(0.5 * (information + information.T), gradient, normal.B, own, covariance)


def solve_arrow(normal: NormalEquations, damping: float) -> tuple[Floats, Floats]:
    """
    Step (p,) and (m, q) of ``(N + damping diag N) step = [a; c]`` by block elimination (Eq. 25).

    Raises
    ------
    NotObservable
        When the matrix is not positive definite, or the elimination of the blocks leaves less
        information on a shared unknown than rounding.
    """
    A, C = (one * (1.0 + damping * np.eye(one.shape[-1])) for one in (normal.A, normal.C))
    left = eliminated(dataclasses.replace(normal, A=A, C=C))
    if (np.diag(left.information) < ROUNDING * np.diag(A)).any():
        raise NotObservable('a shared unknown cannot be separated from the blocks')
    shared = inverse(left.information) @ left.gradient
    return shared, left.own - left.back @ shared


def levenberg_marquardt(
    state: StateT,
    evaluate: Callable[[StateT], NormalEquations],
    move: Callable[[StateT, Floats, Floats], StateT],
    least_gain: float = 0.0,
) -> Solution[StateT]:
    """
    Minimum of the cost from a start.

    Parameters
    ----------
    state
        Start; any type.
    evaluate
        Cost and normal equations at a state; a state with a non-finite cost is rejected.
    move
        New state from a state, a shared step (p,) and block steps (m, q).
    least_gain : float
        A step that would lower the cost by less is not taken: half of its square in 1-sigma.

    Notes
    -----
    Marquardt's damping in the paper's form (Eq. 25), scaled by the diagonal.  A step is judged by
    the actual over the predicted reduction of the cost (Nielsen's rule for the damping).
    The search has converged when the undamped step lowers the cost by less than ``least_gain`` or
    its rounding: a step of a millionth of the 1-sigma scale.

    Raises
    ------
    NotObservable
        When the data do not determine all unknowns.
    """
    normal = evaluate(state)
    if not np.isfinite(normal.cost):
        raise NotObservable('the cost at the start is not finite')
    damping, growth = _LAMBDA_START, 2.0
    for iteration in range(1, MOST_ROUNDS + 1):
        shared, blocks = solve_arrow(normal, damping)
        # Predicted reduction of the cost: step' (damping D step + [a; c]) / 2.
        predicted = 0.5 * (
            shared @ (damping * np.diag(normal.A) * shared + normal.a)
            + (blocks * (damping * np.einsum('mii->mi', normal.C) * blocks + normal.c)).sum()
        )
        # The criteria apply to the undamped step.
        reach = 1.0 + damping
        # Residuals of an image round alike, by 1e-13 px: a cost of 30,000 by 5e-9.
        least = max(least_gain, ROUNDING * max(normal.cost, 1.0))
        if predicted * reach < least:
            return Solution(state, normal, iteration, 'converged')
        candidate = move(state, shared, blocks)
        candidate_normal = evaluate(candidate)
        gain = (normal.cost - candidate_normal.cost) / predicted
        if np.isfinite(candidate_normal.cost) and gain > 1e-4:
            state, normal = candidate, candidate_normal
            damping *= max(0.1, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
            damping, growth = max(damping, 1e-15), 2.0
        else:
            damping, growth = damping * growth, growth * 2.0
            if damping > 1.0 / ROUNDING:  # no step lowers the cost
                return Solution(state, normal, iteration, 'no_descent')
    return Solution(state, normal, MOST_ROUNDS, 'iteration_limit')
