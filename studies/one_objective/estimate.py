# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
`estimate_calibration` by one likelihood of the errors of centroids, with soft outliers.

Each round is a linearisation with its posterior, as in the package; the errors of centroids are
then those of `centroids`.  No observation is in or out: an outlier has the same density at all
places, which is that of a good one at ``outlier_sigma``, and the weight of an observation is the
probability that it is none.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import math

import numpy as np

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation import calibrate
from starcal_ros.estimation.calibrate import Estimate, residuals_px
from starcal_ros.estimation.equations import Linearisation, star_sums
from starcal_ros.estimation.options import (
    assumed_tracker_sigma_rad,
    CalibrationOptions,
    check_enough,
    check_options,
)
from starcal_ros.estimation.outliers import fitting_stars
from starcal_ros.estimation.posterior import LEAST_SHAPE_PX, Posterior, Weights
from starcal_ros.estimation.problem import Problem, State, supported_terms
from starcal_ros.estimation.search import moved_to_stars, problem_of, start_of
from starcal_ros.estimation.shared_errors import _factors, Groups, observation_groups, SharedError
from starcal_ros.estimation.star_equations import arrange, star_table, StarTable
from starcal_ros.estimation.tracker_errors import Attitudes, measured_rates
from starcal_ros.estimation.unknowns import IMAGE_ROTATION, moved, readout_rms_s, unknowns_of
from starcal_ros.estimation.weights import (
    CentroidVariance,
    Data,
    degrees_of_freedom,
    sky_rotations,
    tracker_attitudes,
    weighted_attitudes,
    Weighting,
)
from starcal_ros.records import CameraGeometry, Ensemble
from studies.one_objective.centroids import centroid_errors, CentroidErrors, halfway, Residuals
from studies.one_objective.linear import linear_posterior

_ROUNDS = 24
_STEP_SIGMA = 0.05
_HALVED = 3  # rounds after which errors change by half: few observations may answer to and fro
_NODES = 5  # of the factor by magnitude, which is exponential
_SURE = 1.5  # sigma beyond the limit of outliers, at which an observation counts for nothing
_LOOKS = 3  # at the probabilities of outliers before the first round; then one in each


@dataclass(frozen=True)
class SoftWeighting(Weighting):
    """Weights with the probability (n,) that each observation is no outlier."""

    part: Floats
    found: CentroidErrors

    def working_px2(self, table: StarTable) -> Floats:
        """Return the covariances (n, 3) whose inverses are the weights."""
        return np.asarray(super().working_px2(table) / self.part[:, None])


def estimate_calibration(
    ensemble: Ensemble,
    prior: CameraGeometry,
    options: CalibrationOptions,
    colours_of: Callable[[Indices], Floats] | None = None,
    has_own_amplitudes: bool = True,
) -> Estimate:
    """
    Return the estimate; as `starcal_ros.estimation.calibrate.estimate_calibration`.

    ``has_own_amplitudes``: those of field and shapes by `linear`; else as in the package.
    """
    check_options(options, prior.camera.model)
    check_enough(ensemble, options)
    table = star_table(ensemble.images)
    problem = problem_of(ensemble, prior, options)
    order, with_rate, _ = supported_terms(
        ensemble, options.focal_temperature_order, options.alignment_temperature
    )
    assumed = calibrate._assumed(ensemble, options)
    data = Data(
        table,
        np.array([image.time_ns for image in ensemble.images], np.int64),
        assumed_tracker_sigma_rad(options),
        prior,
        options,
        measured_rates(ensemble.images),
        dataclasses.replace(assumed, colour=calibrate._colours(table, colours_of)),
        observation_groups(table.measured_px, table.star, prior.camera.width)[:2],
    )
    start = start_of(problem, prior, order, with_rate)
    start = moved_to_stars(problem, start, table, prior.camera)
    return _estimate(data, problem, start, ensemble, has_own_amplitudes)


def _estimate(
    data: Data, problem: Problem, start: State, ensemble: Ensemble, has_own_amplitudes: bool
) -> Estimate:
    table = data.table
    floor_px2 = calibrate._START_FLOOR_PX**2
    wide = table.covariance_px2 + floor_px2 * np.array([1.0, 0.0, 1.0])
    all_stars = np.ones(len(table), bool)
    solution = calibrate._robust_search(problem, start, arrange(table, all_stars, wide))
    state, iterations = solution.state, solution.iterations
    calibrate._check_not_mirrored(state)
    residual_px = residuals_px(problem, state, table)
    from_sky = sky_rotations(state, table, data.prior.camera)
    judged = _weighting(data, from_sky, residual_px, np.full(len(table), 2.0), None, None, None)
    shape_px: Floats | float = LEAST_SHAPE_PX
    before: calibrate._Round | None = None
    theta: Floats | None = None
    termination = 'iteration_limit'
    for k in range(_ROUNDS):
        if has_own_amplitudes:
            last, theta = _round(data, problem, state, judged, residual_px, before, theta)
        else:
            given = judged, residual_px, shape_px, before, 1.0
            last = calibrate._round(data, problem, state, *given)
        after = _weighting(
            *(data, from_sky, last.residual_px, last.freedom, judged),
            *(last.posterior, last.attitudes),
        )
        residual_px, before = last.residual_px, last
        shape_px = np.maximum(last.posterior.shapes.sigma_px, LEAST_SHAPE_PX)
        iterations += 1
        step_sigma = np.abs(calibrate._step_sigma(last.posterior)).max(initial=0.0)
        if step_sigma < _STEP_SIGMA and _are_alike(judged, after, table):
            termination = 'converged'
            break
        if k >= _HALVED:
            found = halfway(judged.found, after.found)
            after = _weights_of(data, from_sky, last.residual_px, found, last.attitudes)
        if k < _ROUNDS - 1:
            state, judged = last.after, after
    weights = Weights(
        judged.covariance_px2(table)[:, [0, 2]].mean(axis=1) / judged.part,
        judged.inflation_px2(table) / judged.part,
        from_sky,
        judged.errors,
        last.attitudes.trackers,
    )
    return calibrate._result(data, ensemble, last, judged, weights, iterations, termination)


def _round(
    data: Data,
    problem: Problem,
    state: State,
    judged: SoftWeighting,
    residual_px: Floats,
    before: calibrate._Round | None,
    theta: Floats | None,
) -> tuple[calibrate._Round, Floats]:
    """Return a step from a state of residuals (n, 2), as in the package, and the amplitudes."""
    table, camera = data.table, data.prior.camera
    problem = weighted_attitudes(problem, data, judged.attitudes, state)
    size = camera.width, camera.height
    readout_s = math.hypot(*data.assumed.readout_s)
    if before:
        last = before.posterior
        readout_s = readout_rms_s(last.layout, last.mean, last.working, data.assumed)
    rates = data.rates.turned(state.camera_from_star_tracker, readout_s)
    layout = unknowns_of(problem, state, rates, size, data.assumed)
    measurements = arrange(table, judged.kept, judged.working_px2(table))
    linear = Linearisation(problem, state, layout, measurements, table.measured_px - residual_px)
    sums = star_sums(linear)
    found, theta = linear_posterior(sums, linear, theta)
    own = found.equations.own - found.equations.back @ found.mean
    after = moved(problem, state, layout, found.mean, own[:, IMAGE_ROTATION])
    left_px = residuals_px(problem, after, table, found, size)
    freedom = degrees_of_freedom(found, linear, table, judged.kept)
    attitudes = tracker_attitudes(data, linear, sums, found, after, judged.attitudes)
    return calibrate._Round(linear, sums, found, after, left_px, freedom, attitudes), theta


def _weighting(
    data: Data,
    from_sky: Floats,
    residual_px: Floats,
    freedom: Floats,
    before: SoftWeighting | None,
    found: Posterior | None,
    attitudes: Attitudes | None,
) -> SoftWeighting:
    """Return the weights that the residuals (n, 2) of a state ask for."""
    table, limit = data.table, data.options.outlier_sigma
    residual_px = np.where(np.isfinite(residual_px), residual_px, 1e6)
    own_px2, magnitude = _own_px2(table), _standard_magnitude(table)
    squared = (residual_px**2).sum(axis=1)
    on_sky = np.einsum('nba,nb->na', from_sky, residual_px)
    sightings = np.bincount(table.star)[table.star]
    if before is None:
        # The median of a squared length of two normal axes is ln 2 of its mean.
        scale = max(float(np.median(squared / own_px2)) / (2.0 * math.log(2.0)), 1e-12)
        errors = CentroidErrors(scale, 0.0, 0.0, 0.0, 0.0, 0.0)
    else:
        errors = before.found
    last_octave = found.last_octave if found else None
    for _ in range(_LOOKS if before is None else 1):
        variance_px2 = errors.variance_px2(own_px2, magnitude)
        part = _part(squared / variance_px2, limit)
        share_px2 = np.minimum(errors.share_px2(own_px2), variance_px2)
        working_px2 = variance_px2 + (sightings - 1.0) * share_px2
        some = part > 0.0
        stars, cells = (
            dataclasses.replace(
                kind,
                group=kind.group[some],
                of_one_star=None if kind.of_one_star is None else kind.of_one_star[some],
                together=np.broadcast_to(kind.together, len(table))[some],
            )
            for kind in data.groups
        )
        residuals = Residuals(
            residual_px=residual_px[some],
            on_sky_px=on_sky[some],
            own_px2=own_px2[some],
            working_px2=working_px2[some],
            magnitude=magnitude[some],
            part=part[some],
            freedom=freedom[some],
            stars=stars,
            cells=cells,
        )
        errors = centroid_errors(residuals, last_octave)
    return _weights_of(data, from_sky, residual_px, errors, attitudes)


def _weights_of(
    data: Data,
    from_sky: Floats,
    residual_px: Floats,
    errors: CentroidErrors,
    attitudes: Attitudes | None,
) -> SoftWeighting:
    """Return the weights of observations with residuals (n, 2) by the variances of errors."""
    table, limit = data.table, data.options.outlier_sigma
    residual_px = np.where(np.isfinite(residual_px), residual_px, 1e6)
    own_px2, magnitude = _own_px2(table), _standard_magnitude(table)
    variance_px2 = errors.variance_px2(own_px2, magnitude)
    part = _part((residual_px**2).sum(axis=1) / variance_px2, limit)
    share_px2 = np.minimum(errors.share_px2(own_px2), variance_px2)
    covariance_px2: Floats = np.asarray(np.outer(variance_px2, [1.0, 0.0, 1.0]))
    kept = fitting_stars(
        residual_px, covariance_px2, share_px2, table, data.groups[1], limit + _SURE
    )
    nodes = np.argsort(magnitude)[np.linspace(0, len(table) - 1, _NODES).astype(np.int64)]
    variance = CentroidVariance(
        errors.scale,
        errors.total_px2,
        tuple(table.magnitude[nodes].tolist()),
        tuple(np.exp(errors.slope * magnitude[nodes]).tolist()),
    )
    # A few blended stars have most of what stars share: each has a factor with Student's tails.
    on_sky = np.einsum('nba,nb->na', from_sky, residual_px)
    own_share_px2 = share_px2 * _factors(
        on_sky, kept * part / variance_px2, share_px2, data.groups[0].group
    )
    of_stars = _shared(data.groups[0], kept, variance_px2, own_share_px2)
    structure_px2 = np.full(len(table), errors.structure_px2)
    shared = (
        dataclasses.replace(of_stars, beyond_px2=own_share_px2 - share_px2),
        _shared(data.groups[1], kept, variance_px2, structure_px2),
    )
    part = np.maximum(part, 1e-6)
    return SoftWeighting(variance, shared, kept, attitudes, part, errors)


def _own_px2(table: StarTable) -> Floats:
    """Return the variance (n,) per axis as measured."""
    return np.asarray(0.5 * (table.covariance_px2[:, 0] + table.covariance_px2[:, 2]))


def _standard_magnitude(table: StarTable) -> Floats:
    """Return magnitudes (n,) of mean 0 and standard deviation 1."""
    magnitude = np.asarray(table.magnitude, np.float64)
    return np.asarray((magnitude - magnitude.mean()) / max(float(magnitude.std()), 1e-3))


def _part(length2: Floats, limit: float) -> Floats:
    """Return the probability (n,) of squared sigmas that they are of no outlier."""
    part = 1.0 / (1.0 + np.exp(np.minimum(0.5 * (length2 - limit**2), 50.0)))
    return np.where(length2 < (limit + _SURE) ** 2, part, 0.0)


def _shared(kind: Groups, kept: Mask, variance_px2: Floats, share_px2: Floats) -> SharedError:
    """Return the error that members of groups share, by its variance (n,)."""
    weight = kept / variance_px2
    common = np.bincount(kind.group, weight * np.sqrt(share_px2))
    effect = float((common**2).sum() / weight.sum())
    group = np.where(kept, kind.group, -1)
    is_star = kind.of_one_star is None
    return SharedError(kind.name, group, share_px2, 0.0, is_star, effect)


def _are_alike(one: SoftWeighting, other: SoftWeighting, table: StarTable) -> bool:
    if one.attitudes is None or other.attitudes is None:
        return False
    a, b = one.working_px2(table)[:, 0], other.working_px2(table)[:, 0]
    both = one.kept & other.kept & (one.part > 0.5) & (other.part > 0.5)
    trackers = zip(one.attitudes.trackers, other.attitudes.trackers, strict=False)
    return bool(
        np.sqrt(np.mean((a[both] / b[both] - 1.0) ** 2)) < 0.02
        and all(math.isclose(s.working, t.working, rel_tol=0.05) for s, t in trackers)
    )
