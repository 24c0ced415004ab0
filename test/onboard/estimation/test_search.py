# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The search against the dense problem of four images: state, cost and covariance at its end."""

import dataclasses

from four_images import dense, IMAGES, OWN, prior_offset, prior_precision, SHAPE, small, solution  # type: ignore[import-not-found]
import numpy as np
import pytest

from starcal_ros.estimation.search import minimise
from starcal_ros.estimation.unknowns import unknowns_in_state
from studies.trials import shared_covariance


@pytest.mark.parametrize('terms', [False, True], ids=['one temperature', 'terms of temperature'])
def test_the_search_ends_at_the_minimum_of_the_dense_problem(terms) -> None:
    given = small(terms=terms)
    # A focal length 2 % off moves the corners by 14 px.
    far = given.state.parameters * np.r_[1.02, 1.0, 1.02, np.ones(7)]
    start = dataclasses.replace(given.state, parameters=far)
    minimum = minimise(given.problem, start, given.measurements())
    assert minimum.converged
    at = dataclasses.replace(given, state=minimum.state)
    truth, P = dense(at), at.layout.count
    layout = unknowns_in_state(at.problem, at.state)
    rotations = P + OWN * np.arange(IMAGES)[:, None] + np.arange(3)
    searched = np.r_[at.layout.of([e.name for e in layout.shared]), rotations.ravel()]
    precision, offset = np.full(P + OWN * IMAGES, np.inf), prior_offset(at)
    precision[searched] = prior_precision(at, SHAPE, None)[searched]
    # One Gauss-Newton step of the dense problem goes nowhere.
    mean, covariance, _ = solution(truth, precision, offset)
    free = np.flatnonzero(np.isfinite(precision))
    assert np.abs(mean[free] / np.sqrt(np.diag(covariance)[free])).max() < 1e-4
    squares = truth.residual @ truth.residual + truth.error @ truth.error
    squares += precision[free] @ offset[free] ** 2
    assert minimum.normal.cost == pytest.approx(0.5 * squares, rel=1e-9)
    shared = free[free < P]
    expected, sigma = covariance[np.ix_(shared, shared)], np.sqrt(np.diag(covariance)[shared])
    off = (shared_covariance(minimum.normal) - expected) / np.outer(sigma, sigma)
    assert np.abs(off).max() < 1e-7
