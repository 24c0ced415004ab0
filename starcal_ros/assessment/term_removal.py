"""
What each term of the camera is worth: calibrations with fewer and fewer of them (paper, Fig. 8).

Solved again after each removal, from where it stood, with the stars and weights of the calibration
with all terms: chi^2 rises by what the term was worth and by nothing else.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from starcal_ros.assessment.observability import map_error_px
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.levenberg_marquardt import inverse, NotObservable
from starcal_ros.estimation.normal_equations import arrange, Measurements, residuals_px
from starcal_ros.estimation.problem import (
    image_blocks,
    image_parameters,
    minimise,
    Problem,
    reduced_information,
    State,
)
from starcal_ros.records import Removal

Floats = NDArray[np.float64]

_HELD_AT_ZERO = ('skew', 'k1', 'k2', 'k3', 'p1', 'p2')
_CHANCE = 0.01  # that terms which are none raise chi^2 by as much


def removal_study(estimate: Estimate) -> tuple[Removal, ...]:
    """
    One row for the calibration as it is, and one for each term in the order in which they go.

    Removed skew and distortion are zero, a removed focal length or principal point is the prior's.
    The next to go is the one whose removal raises chi^2 least by the covariance (Wald: squared
    distance to the value that it is then held at, over its variance); then all is solved again.
    Ends early where the stars cannot be explained without a term.
    """
    problem, state = estimate.problem, estimate.state
    covariance_px2 = estimate.variance.of(estimate.table.covariance_px2, estimate.table.magnitude)
    measurements = arrange(estimate.table, estimate.kept, covariance_px2)
    solution = minimise(problem, state, measurements)
    cost = solution.normal.cost
    alone = sigmas = _sigmas(problem, solution.state, measurements)
    removals = [_removal(estimate, problem, solution.state, '', 0.0, 0.0, 0.0, within=True)]
    while sigmas:
        least = min(sigmas, key=lambda name: abs(sigmas[name]))
        problem, state = _without(least, problem, solution.state)
        try:
            solution = minimise(problem, state, measurements)
        except NotObservable:
            break
        if not solution.converged:
            break
        rise = 2.0 * (solution.normal.cost - cost) + _of_prior(estimate.problem, problem)
        removals.append(
            _removal(
                estimate,
                problem,
                solution.state,
                least,
                alone[least],
                sigmas[least] ** 2,
                rise,
                within=bool(chdtrc(len(removals), rise) > _CHANCE),
            )
        )
        sigmas = _sigmas(problem, solution.state, measurements)
    return tuple(removals)


def _held_at(name: str, problem: Problem) -> float:
    if name in _HELD_AT_ZERO:
        return 0.0
    return float(problem.prior_parameters[PARAMETER_NAMES.index(name)])


def _sigmas(problem: Problem, state: State, measurements: Measurements) -> dict[str, float]:
    """How far each free parameter is from what it would be held at, in its sigma."""
    _, blocks = image_blocks(problem, state, measurements)
    information = reduced_information(problem, state, blocks)
    estimated = np.concatenate([problem.free, np.arange(10, len(information))])
    variance = np.diag(inverse(information[np.ix_(estimated, estimated)]))
    names = [PARAMETER_NAMES[i] for i in problem.free]
    return {
        name: float((state.parameters[i] - _held_at(name, problem)) / np.sqrt(v))
        for name, i, v in zip(names, problem.free, variance, strict=False)
    }


def _without(name: str, problem: Problem, state: State) -> tuple[Problem, State]:
    """The problem without a parameter, and the state with it where it is held."""
    k = PARAMETER_NAMES.index(name)
    parameters = state.parameters.copy()
    parameters[k] = _held_at(name, problem)
    return (
        dataclasses.replace(problem, free=problem.free[problem.free != k]),
        dataclasses.replace(state, parameters=parameters),
    )


def _of_prior(before: Problem, after: Problem) -> float:
    """Chi^2 of the prior of the removed, which are no longer in the cost."""
    removed = np.setdiff1d(before.free, after.free)
    off = [_held_at(PARAMETER_NAMES[k], before) - before.prior_parameters[k] for k in removed]
    return float(np.sum(np.square(np.array(off) / before.prior_sigma[removed])))


def _removal(
    estimate: Estimate,
    problem: Problem,
    state: State,
    removed: str,
    significance: float,
    wald: float,
    rise: float,
    within: bool,
) -> Removal:
    rotations = state.camera_from_icrf.as_matrix()
    residual_px = residuals_px(estimate.table, image_parameters(problem, state), rotations)
    residual_px = residual_px[estimate.kept]
    std_u, std_v = residual_px.std(axis=0)
    camera = estimate.geometry.camera
    return Removal(
        removed=removed,
        significance=significance,
        wald=wald,
        chi2_rise=rise,
        within_chance=within,
        residual_rms_px=float(np.sqrt(np.mean(residual_px**2))),
        residual_std_px=(float(std_u), float(std_v)),
        map_change_px=map_error_px(
            dataclasses.replace(camera, parameters=state.parameters), camera
        ),
    )
