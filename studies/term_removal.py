# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Significance of each term of the camera: calibrations with fewer and fewer terms (paper, Fig. 8).

After each removal the rest is solved again from the last solution, with the stars and weights of
the calibration with all terms, so that the rise of chi^2 is due to the removal alone.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from starcal_ground.comparison import map_error_px
from starcal_ros.arrays import Floats
from starcal_ros.estimation.calibrate import Estimate, residuals_px
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.problem import Problem, State
from starcal_ros.estimation.search import minimise, Minimum
from starcal_ros.estimation.star_equations import arrange
from starcal_ros.estimation.unknowns import IMAGE_ROTATION, moved
from studies.trials import shared_covariance

_HELD_AT_PRIOR = ('fx', 'fy', 'cx', 'cy')  # skew and distortion terms are held at zero
_LEAST_GAIN = 1e-9  # a step of 0.00005 sigma
_SIGNIFICANT = 0.01  # p-value below which a rise of chi^2 shows that a term is needed


@dataclass(frozen=True)
class TermRemoval:
    """
    A calibration after one more term was removed; terms removed before stay removed.

    Attributes
    ----------
    residual_rms_px : float
        Per axis, over the stars of the calibration with all terms.
    residual_std_px : (float, float)
        Standard deviation along u and along v.
    map_change_px : float
        RMS change over the detector against the calibration with all terms, common rotation
        removed.
    removed : str
        The term; empty for the calibration with all of them.
    significance : float
        Distance of the term, with all terms estimated, from the value it is held at when removed,
        in its sigma.
    wald : float
        Rise of chi^2 that the covariance before the removal predicts.
    chi2_rise : float
        Rise of chi^2 against the calibration with all terms, over its stars, with its weights.
    negligible : bool
        Whether this term and all removed before it may be dropped: the p-value of the rise is over
        1 %.
    """

    residual_rms_px: float
    residual_std_px: tuple[float, float]
    map_change_px: float
    removed: str = ''
    significance: float = 0.0
    wald: float = 0.0
    chi2_rise: float = 0.0
    negligible: bool = True


def removal_study(estimate: Estimate) -> tuple[TermRemoval, ...]:
    """
    One row for the calibration with all terms, and one for each term in the order of removal.

    Removed skew and distortion are held at zero, a removed focal length or principal point at the
    prior.  The next term is the one whose removal raises chi^2 least by the covariance (Wald test:
    squared distance to the value that it is then held at, over its variance); then all is solved
    again.  The study ends early where the solver fails without a term.
    """
    # Unknowns outside of the search (field, shapes, velocity) keep their estimates.
    estimate = _with_search_alone(estimate)
    problem, state = estimate.linear.problem, estimate.linear.state
    measurements = arrange(estimate.table, estimate.kept, estimate.weights.covariance_px2)
    solution = minimise(problem, state, measurements, least_gain=_LEAST_GAIN)
    cost = solution.normal.cost
    names = estimate.geometry.camera.parameter_names
    sigmas = _sigmas(problem, solution)
    variance = np.diag(estimate.covariance)[problem.free]
    alone = _distances(problem, estimate.geometry.camera.parameters, variance)
    removals = [_residuals(estimate, problem, solution.state)]
    while sigmas:
        least = min(sigmas, key=lambda name: abs(sigmas[name]))
        k = names.index(least)
        problem = dataclasses.replace(problem, free=problem.free[problem.free != k])
        state = dataclasses.replace(solution.state, parameters=solution.state.parameters.copy())
        state.parameters[k] = _held_at(names, k, problem)
        try:
            solution = minimise(problem, state, measurements, least_gain=_LEAST_GAIN)
        except NotObservable:
            break
        if not solution.converged:
            break
        rise = 2.0 * (solution.normal.cost - cost)
        rise += _of_prior(names, estimate.linear.problem, problem)
        removals.append(
            dataclasses.replace(
                _residuals(estimate, problem, solution.state),
                removed=least,
                significance=alone[least],
                wald=sigmas[least] ** 2,
                chi2_rise=rise,
                negligible=bool(chdtrc(len(removals), rise) > _SIGNIFICANT),
            )
        )
        sigmas = _sigmas(problem, solution)
    return tuple(removals)


def _with_search_alone(estimate: Estimate) -> Estimate:
    """Return the estimate whose stars are where camera and rotations of the state put them."""
    linear, found = estimate.linear, estimate.posterior
    problem, own = linear.problem, found.of_images[:, IMAGE_ROTATION]
    state = moved(problem, linear.state, linear.layout, found.mean, own)
    table = estimate.table
    explained = residuals_px(problem, state, table)
    camera = dataclasses.replace(estimate.geometry.camera, field=None)
    measured_px = table.measured_px - explained + estimate.residual_px
    return dataclasses.replace(
        estimate,
        geometry=dataclasses.replace(estimate.geometry, camera=camera),
        table=dataclasses.replace(table, measured_px=measured_px),
        linear=dataclasses.replace(linear, state=state),
    )


def _held_at(names: tuple[str, ...], k: int, problem: Problem) -> float:
    """Value of the k-th parameter after its removal."""
    return float(problem.prior_parameters[k]) if names[k] in _HELD_AT_PRIOR else 0.0


def _distances(problem: Problem, parameters: Floats, variance: Floats) -> dict[str, float]:
    """Distance of each free parameter from the value it would be held at, in sigmas."""
    names = problem.parameter_names
    return {
        names[k]: float((parameters[k] - _held_at(names, k, problem)) / np.sqrt(v))
        for k, v in zip(problem.free, variance, strict=False)
    }


def _sigmas(problem: Problem, solution: Minimum) -> dict[str, float]:
    """Distances of the parameters of a solution in its sigmas, the field and others known."""
    variance = np.diag(shared_covariance(solution.normal))
    return _distances(problem, solution.state.parameters, variance)


def _of_prior(names: tuple[str, ...], before: Problem, after: Problem) -> float:
    """Chi^2 of the prior of the removed parameters, which is no longer in the cost."""
    removed = np.setdiff1d(before.free, after.free)
    off = [_held_at(names, k, before) - before.prior_parameters[k] for k in removed]
    return float(np.sum(np.square(np.array(off) / before.prior_sigma[removed])))


def _residuals(estimate: Estimate, problem: Problem, state: State) -> TermRemoval:
    """Residuals and map of a state; of which term, the caller adds."""
    residual_px = residuals_px(problem, state, estimate.table)[estimate.kept]
    std_u, std_v = residual_px.std(axis=0)
    camera = estimate.geometry.camera
    changed = dataclasses.replace(camera, parameters=state.parameters)
    return TermRemoval(
        residual_rms_px=float(np.sqrt(np.mean(residual_px**2))),
        residual_std_px=(float(std_u), float(std_v)),
        map_change_px=map_error_px(changed, camera),
    )
