# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The search of a calibration.

Robust from the prior, then least squares on the stars that fit, with the variances of centroids
and star tracker estimated again and the misfits left out, until nothing changes; then, where the
stars show one, with a field beside the lens model.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.detector_field import in_degree
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation.options import assumed_tracker_sigma_rad, CalibrationOptions
from starcal_ros.estimation.verdict import arranged, judge_residuals, Verdict, Weighted
from starcal_ros.least_squares.levenberg_marquardt import NotObservable
from starcal_ros.least_squares.linear_terms import LinearTerms, Score
from starcal_ros.least_squares.normal_equations import Measurements, StarTable
from starcal_ros.methods.assembly import score_of
from starcal_ros.methods.attitude_errors import attitude_errors
from starcal_ros.methods.minimise import image_equations, minimise, Minimum
from starcal_ros.methods.problem import (
    image_alignment,
    image_blocks,
    image_field,
    Problem,
    scalar_terms_at,
    State,
)
from starcal_ros.model_errors.field_kernel import degree_for, NO_WAVES, TEST_DEGREE, Waves
from starcal_ros.model_errors.field_likelihood import (
    field_likelihood,
    FieldLikelihood,
    polynomials,
    sees_detector,
)
from starcal_ros.model_errors.image_variation import ImageVariation, shape_modes
from starcal_ros.model_errors.residual_field import best_prior, FieldPrior, unseen_prior
from starcal_ros.model_errors.variance_components import CentroidVariance

_ROBUST_SCALE = 3.0  # of the Cauchy loss, in sigma: of normal noise 5 % of the weight is lost
_ROBUST_GAIN = 1e-3  # a step of 0.04 sigma: least squares goes on from there
_START_FLOOR_PX = 0.05  # until the residuals tell: of the order of what is left in good images
_FIELD_ROUNDS = 6  # its prior and the variances settle in two or three
_ROUNDS = 10  # the set of rejected stars settles in two or three


def search(
    problem: Problem,
    start: State,
    table: StarTable,
    camera: CameraModel,
    options: CalibrationOptions,
) -> Found:
    """
    Return where the search ends: robust, then least squares with snooping, with a field if needed.

    ``camera`` is the prior camera.

    Raises
    ------
    NotObservable
        When the stars do not determine all unknowns.
    TooFewObservations
        When the images are mirrored.
    """
    everything = np.ones(len(table), bool)
    given_rad = problem.star_tracker_sigma_rad[0]
    verdict = Verdict(
        CentroidVariance(1.0, _START_FLOOR_PX**2),
        given_rad,
        np.zeros(table.image_count, bool),
        everything,
        np.ones(len(table)),
        ImageVariation(),
    )
    measurements = arranged(table, verdict)
    solution = _robust_search(problem, start, measurements)
    _, blocks = image_blocks(problem, solution.state, measurements)
    del measurements  # before the next: they are as large as the table
    verdict, weighted = judge_residuals(
        problem, solution.state, blocks, None, table, verdict, given_rad, options
    )
    found = _settle(
        Found(problem, solution, verdict, solution.iterations), weighted, table, options
    )
    del weighted
    return _with_field(found, table, camera, options)


@dataclass(frozen=True)
class Found:
    """Where a search stands: its problem, its minimum, and the verdict that it was made with."""

    problem: Problem
    solution: Minimum
    verdict: Verdict
    iterations: int
    field_test: FieldPrior | None = None


def _settle(
    found: Found, weighted: Weighted, table: StarTable, options: CalibrationOptions
) -> Found:
    """
    Least squares and judgement of its residuals in turns, until the judgement stands.

    Raises
    ------
    NotObservable
        When the stars do not determine all unknowns.
    TooFewObservations
        For a focal length below zero, which no camera has.
    """
    problem, solution = found.problem, found.solution
    given_rad = assumed_tracker_sigma_rad(options)
    iterations, after = found.iterations, found.verdict
    for _ in range(_ROUNDS):
        verdict = after
        problem, state = _with_shapes(problem, solution.state, verdict.variation)
        problem = dataclasses.replace(
            problem,
            star_tracker_sigma_rad=np.where(
                verdict.misfit[:, None], np.inf, verdict.tracker_sigma_rad
            ),
        )
        solution = minimise(problem, state, weighted.measurements, at_start=weighted.at(state))
        iterations += solution.iterations
        blocks, terms = solution.normal.blocks, solution.normal.terms
        after, weighted = judge_residuals(
            problem, solution.state, blocks, terms, table, verdict, given_rad, options
        )
        if after.agrees_with(verdict):
            break
    focal_px = solution.state.parameters[[0, 2]]
    if not (focal_px > 0).all():
        raise TooFewObservations(
            'the stars are those of a mirrored image: fx and fy would be '
            f'{focal_px.round(1).tolist()} px; flip the images along one axis, or set up the '
            'driver of the camera not to'
        )
    return dataclasses.replace(
        found, problem=problem, solution=solution, verdict=verdict, iterations=iterations
    )


def _with_shapes(
    problem: Problem, state: State, variation: ImageVariation
) -> tuple[Problem, State]:
    """Problem and state with a shape of each image where the images differ, without elsewhere."""
    if not variation.amplitude_sigma_px and not state.shapes.size:
        return problem, state
    sigma_px = np.array(variation.amplitude_sigma_px)
    modes: Floats = np.empty((0, 0))
    shapes: Floats = np.empty((0, 0))
    if len(sigma_px):
        modes, shapes = shape_modes(problem.camera_count), state.shapes
        if not shapes.size:
            shapes = np.zeros((len(state.camera_from_icrf), len(sigma_px)))
    return (
        dataclasses.replace(problem, shape_modes=modes, shape_sigma_px=sigma_px),
        dataclasses.replace(state, shapes=shapes),
    )


def _with_field(
    found: Found, table: StarTable, camera: CameraModel, options: CalibrationOptions
) -> Found:
    """The search with a field beside the lens model, where the stars show one."""
    plain = found
    if options.max_field_p_value == 0.0:
        return plain
    shown = _shown(found, table, camera, TEST_DEGREE)
    if shown is None:
        return plain
    test = best_prior(shown.likelihood)
    found = plain = dataclasses.replace(found, field_test=test)
    if not options.residual_field:
        return plain
    if test.p_value > options.max_field_p_value:
        return _considering(plain, shown, test)
    degree = degree_for(test.length, test.waves)
    best = _field_prior(found, table, camera, degree, looks_for_waves=True)
    for k in range(_FIELD_ROUNDS):
        if best is None:
            return plain
        weighted = Weighted(arranged(table, found.verdict))
        found = _settle(_started(found, best), weighted, table, options)
        del weighted
        # A smoother kernel of a larger amplitude needs the same degree.
        degree = max(degree, degree_for(best.length, best.waves))
        # The first search was among residuals whose variance held the field.
        again = _field_prior(found, table, camera, degree, best.waves, looks_for_waves=k == 0)
        if again is not None and k and again.is_close_to(best):
            break
        best = again
    return found if best is not None else plain


def _considering(found: Found, shown: _Shown, test: FieldPrior) -> Found:
    """
    The search with a field of zero whose prior is what the stars do not exclude.

    So its modes are in the covariance, and no line of sight moves by what no star shows.
    """
    prior = unseen_prior(shown.likelihood, test)
    problem = dataclasses.replace(found.problem, field_prior=prior)
    state = dataclasses.replace(found.solution.state, modes=np.zeros(prior.modes.shape[1]))
    normal = image_equations(
        problem,
        state,
        found.solution.normal.cost,
        found.solution.normal.blocks,
        shown.terms.in_modes(prior.modes),
    )
    solution = dataclasses.replace(found.solution, state=state, normal=normal)
    return dataclasses.replace(found, field_test=test, problem=problem, solution=solution)


def _started(found: Found, prior: FieldPrior) -> Found:
    """The search with another prior of the field, from the field that there is."""
    before, state = image_field(found.problem, found.solution.state), found.solution.state
    modes: Floats = np.zeros(prior.modes.shape[1])
    if before is not None:
        coefficients = in_degree(before, prior.degree)
        modes = np.asarray(np.linalg.lstsq(prior.modes, coefficients, rcond=1e-9)[0])
    return dataclasses.replace(
        found,
        problem=dataclasses.replace(found.problem, field_prior=prior),
        solution=dataclasses.replace(
            found.solution, state=dataclasses.replace(state, modes=modes)
        ),
    )


def _field_prior(
    found: Found,
    table: StarTable,
    camera: CameraModel,
    degree: int,
    waves: Waves = NO_WAVES,
    looks_for_waves: bool = False,
) -> FieldPrior | None:
    """
    The prior of a field that the residuals at a minimum ask for, in polynomials of a degree.

    None where the lens model has lines of sight for a small part of the detector only.
    """
    shown = _shown(found, table, camera, degree)
    return best_prior(shown.likelihood, waves, looks_for_waves) if shown else None


@dataclass(frozen=True)
class _Shown:
    """What the residuals at a minimum show of the polynomials of a degree, all else free."""

    terms: LinearTerms
    likelihood: FieldLikelihood


def _shown(found: Found, table: StarTable, camera: CameraModel, degree: int) -> _Shown | None:
    """None where the lens model has lines of sight for a small part of the detector only."""
    problem, state = found.problem, found.solution.state
    camera = dataclasses.replace(camera, parameters=state.parameters, field=None)
    if not sees_detector(camera):
        return None
    measurements = arranged(table, found.verdict)
    terms = scalar_terms_at(
        problem, state, measurements, polynomials(camera.width, camera.height, degree)
    )
    # The field that there is, if any, is part of what the residuals are asked for.
    without = dataclasses.replace(problem, field_prior=None)
    shown = score_of(without, state, found.solution.normal.blocks, None, terms)
    now = image_field(problem, state)
    if now is not None:
        coefficients = in_degree(now, degree)
        gradient = shown.gradient + shown.information @ coefficients
        shown = Score(gradient, shown.information)
    return _Shown(terms, field_likelihood(shown, camera, problem.free, degree))


def _robust_search(problem: Problem, start: State, measurements: Measurements) -> Minimum:
    """
    Search with the robust loss, every image free of the star tracker.

    A star tracker that is said to be better than it is would bend the camera to its attitudes, and
    then seem to be right.
    """
    if problem.method == 'hierarchical':
        try:
            free = dataclasses.replace(problem, method='per_image')
            solution = minimise(free, start, measurements, _ROBUST_SCALE, least_gain=_ROBUST_GAIN)
            state = _with_slope(problem, _with_mountings(problem, solution.state))
            return dataclasses.replace(solution, state=state)
        except NotObservable:
            pass  # so few stars that they need the star tracker
    return minimise(problem, start, measurements, _ROBUST_SCALE, least_gain=_ROBUST_GAIN)


def _with_mountings(problem: Problem, state: State) -> State:
    """
    The state with the errors of the mountings that its rotations show.

    Differences of medians to the first star tracker, or to the next one that has images.
    """
    if len(state.mountings) == 0:
        return state
    eta_rad = attitude_errors(problem, state, state.camera_from_icrf)
    turned = image_alignment(problem, state).apply(eta_rad)
    there = np.unique(problem.star_tracker)
    medians = {k: np.median(turned[problem.star_tracker == k], axis=0) for k in there}
    mountings = state.mountings.reshape(-1, 3).copy()
    for k in there[1:]:
        mountings[k - 1] += medians[k] - medians[there[0]]
    return dataclasses.replace(state, mountings=mountings.ravel())


def _with_slope(problem: Problem, state: State) -> State:
    """
    The state with an alignment rate that its rotations show, where one is estimated.

    Median of the slopes between images: left in, a drift would look like scatter or misfits.
    """
    if len(state.rate) == 0:
        return state
    eta_rad = attitude_errors(problem, state, state.camera_from_icrf)
    # The frame turns by what is missing from the star tracker's side.
    turned = state.camera_from_star_tracker.apply(eta_rad)
    one, other = np.triu_indices(len(turned), 1)
    apart_k = problem.above_reference_k[other] - problem.above_reference_k[one]
    differ = apart_k != 0
    slopes = (turned[other] - turned[one])[differ] / apart_k[differ, None]
    return dataclasses.replace(state, rate=state.rate + np.median(slopes, axis=0))
