# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The arrow of normal equations, and each derivative, are those of the dense problem."""

import dataclasses

from four_images import Dense, dense, IMAGES, OWN, prior_precision, SHAPE, Small  # type: ignore[import-not-found]
import numpy as np
from numpy.typing import NDArray
import pytest

from starcal_ros.arrays import Floats
from starcal_ros.estimation.equations import (
    equations,
    information_of_images,
    star_sums,
    stars_alone,
)
from starcal_ros.estimation.levenberg_marquardt import Equations, NotObservable
from starcal_ros.estimation.unknowns import unknowns_in_state

# Finite differences leave 1e-10 of a derivative, and attitude errors of 20 arcsec, which enter the
# derivatives of the star trackers to first order, 1e-8.
EXACT = 5e-8


@pytest.fixture(scope='module')
def arrow(given: Small) -> Equations:
    return equations(given.sums(), given.linear(), SHAPE)


def scaled(difference: Floats, matrix: NDArray[np.floating]) -> float:
    """Largest element of a difference in units of the diagonal of a matrix."""
    size = np.sqrt(np.diag(matrix))
    return float(np.abs(difference / np.outer(size, size)).max())


def dense_arrow(given: Small, truth: Dense) -> tuple[Floats, Floats]:
    """Information of all unknowns with the prior of the shapes only, and gradient."""
    X = np.concatenate([truth.stars, truth.trackers])
    r = np.concatenate([truth.residual, -truth.error])
    N = X.T @ X
    of_image = prior_precision(given, SHAPE, None)[given.layout.count :]
    own = np.arange(given.layout.count, len(N))
    N[own, own] += of_image
    return N, X.T @ r


def test_information_is_the_dense_one_with_the_images_eliminated(given, truth, arrow) -> None:
    N, g = dense_arrow(given, truth)
    P = given.layout.count
    C = N[P:, P:]
    information = N[:P, :P] - N[:P, P:] @ np.linalg.solve(C, N[P:, :P])
    gradient = g[:P] - N[:P, P:] @ np.linalg.solve(C, g[P:])
    size = np.sqrt(np.diag(N)[:P])
    off = np.abs(arrow.information - information) / np.outer(size, size)
    wrong = np.abs(arrow.gradient - gradient) / size / np.linalg.norm(truth.residual)
    for entry in given.layout.shared:  # the one whose derivative is wrong is named
        assert np.diag(off)[given.layout.places[entry.name]].max() < EXACT, entry.name
    assert off.max() < EXACT and wrong.max() < EXACT
    assert np.array_equal(arrow.information, arrow.information.T)


def test_unknowns_of_the_images_follow_the_shared_ones(given, truth, arrow) -> None:
    N, g = dense_arrow(given, truth)
    P = given.layout.count
    rng = np.random.default_rng(1)
    x = rng.normal(size=P) / np.sqrt(np.diag(N)[:P])
    C = N[P:, P:]
    y = np.linalg.solve(C, g[P:] - N[P:, :P] @ x)
    sigma = 1.0 / np.sqrt(np.diag(C))
    assert (arrow.own - arrow.back @ x).ravel() / sigma == pytest.approx(y / sigma, abs=1e-5)
    covariance = np.linalg.inv(C)
    for k in range(IMAGES):
        own = slice(OWN * k, OWN * k + OWN)
        expected = covariance[own, own]
        assert scaled(arrow.covariance[k] - expected, expected) < EXACT


def test_an_image_that_nothing_holds_stays_and_adds_nothing(given: Small) -> None:
    keep = given.keep & (given.table.image != 2)
    sigma = given.problem.star_tracker_sigma_rad.copy()
    sigma[2] = np.inf
    problem = dataclasses.replace(given.problem, star_tracker_sigma_rad=sigma)
    without = dataclasses.replace(given, keep=keep, problem=problem)
    linear = dataclasses.replace(without.linear(), problem=problem)
    arrow = equations(without.sums(), linear, SHAPE)
    assert not arrow.own[2].any() and not arrow.back[2].any()
    assert arrow.covariance[2] == pytest.approx(np.diag(np.r_[np.ones(3), SHAPE**2, np.ones(3)]))
    assert arrow.back[1].any()
    # The images are independent: the others give what they give together with it, less its part.
    whole = dense(without)
    N, _ = dense_arrow(without, whole)
    P = given.layout.count
    others = np.r_[P : P + 2 * OWN, P + 3 * OWN : P + 4 * OWN]
    cross = N[:P, others]
    information = N[:P, :P] - cross @ np.linalg.solve(N[np.ix_(others, others)], cross.T)
    assert scaled(arrow.information - information, N[:P, :P] + np.eye(P) * 1e-300) < EXACT


def test_a_star_behind_the_camera_is_named(given: Small) -> None:
    direction = given.table.direction_icrf.copy()
    direction[3] *= -1.0
    table = dataclasses.replace(given.table, direction_icrf=direction)
    behind = dataclasses.replace(given, table=table)
    with pytest.raises(NotObservable, match='a star has no image'):
        star_sums(behind.linear())


def test_the_information_of_the_images_without_field_and_shapes_is_the_dense_one(
    given: Small, truth: Dense
) -> None:
    layout = unknowns_in_state(given.problem, given.state)
    _, sums = stars_alone(given.problem, given.state, layout, given.measurements())
    each = information_of_images(sums, given.problem, given.state, layout)
    P = given.layout.count
    at = given.layout.of([e.name for e in layout.shared])
    for k in range(IMAGES):
        stars = np.repeat(given.table.image == k, 2)
        X = np.concatenate([truth.stars[stars], truth.trackers[3 * k : 3 * k + 3]])
        N = X.T @ X
        own = P + OWN * k + np.arange(3)
        cross = N[np.ix_(at, own)]
        expected = N[np.ix_(at, at)] - cross @ np.linalg.solve(N[np.ix_(own, own)], cross.T)
        # In units of all images: one star tracker shows no error of the mounting of another.
        size = np.sqrt(np.diag(truth.stars.T @ truth.stars + truth.trackers.T @ truth.trackers))
        difference = (each[k] - expected) / np.outer(size[at], size[at])
        assert np.abs(difference).max() < EXACT
    # The same arrow, from the sums of the whole list.
    linear = dataclasses.replace(given.linear(), layout=layout)
    arrow = equations(sums, linear, SHAPE)
    size = np.diag(each.sum(axis=0))
    assert arrow.information / np.sqrt(np.outer(size, size)) == pytest.approx(
        each.sum(axis=0) / np.sqrt(np.outer(size, size)), abs=1e-9
    )
