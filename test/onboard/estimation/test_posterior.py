# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The posterior is the dense least-squares solution with priors, exactly."""

import dataclasses
import functools

from four_images import (  # type: ignore[import-not-found]
    CAMERA,
    Dense,
    dense,
    HEIGHT,
    IMAGES,
    OWN,
    prior_offset,
    prior_precision,
    SHAPE,
    Small,
    small,
    solution,
    whitener,
    WIDTH,
)
import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.estimation.amplitudes import LARGEST_FIELD_PX, log_amplitudes
from starcal_ros.estimation.centroid_variance import CentroidVariance
from starcal_ros.estimation.posterior import (
    common_shape,
    Posterior,
    posterior,
    TRACKER_NOISE,
    TRACKER_SLOW,
    Weighting,
    with_shared_errors,
)
from starcal_ros.estimation.shared_errors import SharedError
from starcal_ros.estimation.tracker_errors import TrackerErrors

OF_WORKING = 1.3  # unit of the errors of a star tracker over its working sigma


def solved(given: Small) -> Posterior:
    return posterior(given.sums(), given.linear(), SHAPE)


@functools.cache
def varied() -> tuple[Small, Dense, Posterior]:
    """Four images whose scales differ by pixels, and their posterior."""
    scales = np.zeros((IMAGES, len(SHAPE)))
    scales[:, 0] = [6.0, 5.0, 4.5, -3.0]
    scales[:, 1] = [1.0, -1.5, 0.3, 0.8]
    made = small(3, shapes_px=scales)
    return made, dense(made), solved(made)


def mixture(shifts: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean, covariance and weights of dense posteriors over a factor of the field's amplitudes."""
    (made, truth, found), parts = varied(), []
    offset = prior_offset(made)
    for log_px in found.field.log_px + shifts[:, None]:
        precision = prior_precision(made, found.shapes.sigma_px, np.exp(log_px))
        mean, covariance, evidence = solution(truth, precision, offset)
        # The prior of the logarithms: N(ln 1e-5, 4), and each octave e^-0.7 of the one before.
        steps = np.diff(log_px) + 0.7
        evidence -= 0.5 * (((log_px[0] - np.log(1e-5)) / 4.0) ** 2 + steps @ steps)
        parts.append((evidence, *with_lens_term(made, precision, mean, covariance)))
    weight = normalised(np.array([evidence for evidence, _, _ in parts]))
    means = np.array([mean for _, mean, _ in parts])
    mean = weight @ means
    apart = means - mean
    covariance = np.einsum('s,sij->ij', weight, np.array([c for _, _, c in parts]))
    return mean, covariance + (apart.T * weight) @ apart, weight


def normalised(log: Floats) -> Floats:
    weight = np.exp(log - log.max())
    return np.asarray(weight / weight.sum())


def with_lens_term(
    made: Small, precision: Floats, mean: Floats, covariance: Floats
) -> tuple[Floats, Floats]:
    """Mixture over the amplitude of the next lens term: rank-one updates of Sherman-Morrison."""
    term = np.zeros(len(mean))
    term[made.layout.of(['field'])] = made.layout['field'].term
    pull = np.where(np.isfinite(precision), precision, 0.0) * term
    along, size = covariance @ pull, term @ pull
    seen = pull @ along
    log_term = log_amplitudes(LARGEST_FIELD_PX)
    square = np.exp(2.0 * log_term)
    less = square / (1.0 + square * size)  # of the information along the pull
    more = less / (1.0 - less * seen)
    change = 0.5 * (more * (pull @ mean) ** 2 - np.log1p(-less * seen) - np.log1p(square * size))
    weight = normalised(change - 0.5 * ((log_term - np.log(1e-5)) / 4.0) ** 2)
    first, second = weight @ more, weight @ more**2
    spread = first + (second - first**2) * (pull @ mean) ** 2
    return mean + first * (pull @ mean) * along, covariance + spread * np.outer(along, along)


def test_the_whole_is_the_mixture_over_the_amplitude_of_the_field() -> None:
    made, truth, found = varied()
    result, mode_px = found.shapes, found.field.log_px
    shifts = found.last_octave[0] - mode_px[-1]
    assert shifts.min() == pytest.approx(-8.0)
    assert shifts.max() <= np.log(LARGEST_FIELD_PX) - mode_px.max() + 1e-9
    mean, covariance, weight = mixture(shifts)
    # Evidences are rounded by 1e-6: the smallest prior of the field is 1e-9 px.
    assert found.last_octave[1] == pytest.approx(weight, abs=1e-5)
    P = made.layout.count
    working = covariance[:P, :P].copy()
    # Scale, stretch and shear that all images share are changes of fx and fy; skew is held.
    assert result.common_px2[0] > 0
    scale, stretch, _, *decentring = result.common_px2
    half_px = 0.5 * np.hypot(WIDTH, HEIGHT)
    covariance[[8, 9], [8, 9]] += np.array(decentring) * (CAMERA.parameters[0] / half_px**2) ** 2
    covariance[[0, 2], [0, 2]] += scale + stretch
    covariance[[0, 2], [2, 0]] += scale - stretch
    sigma = np.sqrt(np.diag(covariance))[:P]
    free = np.flatnonzero(sigma)
    assert np.array_equal(np.sort(found.estimated), free)
    assert np.abs((found.mean - mean[:P])[free] / sigma[free]).max() < 1e-5
    held = np.setdiff1d(np.arange(P), free)
    assert not found.mean[held].any()
    assert not found.covariance[held].any() and not found.covariance[:, held].any()
    part = np.ix_(free, free)
    difference = (found.covariance - covariance[:P, :P])[part]
    assert np.abs(difference / np.outer(sigma[free], sigma[free])).max() < 1e-5
    added = common_shape(made.layout, result.common_px2)
    assert np.allclose(found.working + added, found.covariance, rtol=1e-12, atol=0.0)
    size = np.sqrt(np.diag(covariance)[P:])
    assert np.abs((found.of_images.ravel() - mean[P:]) / size).max() < 1e-5
    # The number of unknowns that the data determine, without those of the images.
    X = np.concatenate([truth.stars, truth.trackers])
    N = X.T @ X
    N[P:, P:] += np.diag(prior_precision(made, result.sigma_px, None)[P:])
    information = N[:P, :P] - N[:P, P:] @ np.linalg.solve(N[P:, P:], N[P:, :P])
    assert found.resolved == pytest.approx(np.trace(information[part] @ working[part]), rel=1e-5)


def test_shapes_have_the_likelihood_of_contrasts_free_of_everything_else() -> None:
    """Beside the field at the amplitudes and shapes before."""
    made, whole, found = varied()
    P = made.layout.count
    precision, offset = prior_precision(made, SHAPE, None), prior_offset(made)
    before = prior_precision(made, SHAPE, np.exp(found.field.log_px))
    field = made.layout.of(['field'])
    field_px = solution(whole, before, offset)[0][field]
    # The stars alone: rotations are free, star trackers show no shape.
    common = made.layout.of(['camera', 'focal', 'velocity', 'colour', 'readout'])
    common = common[np.isfinite(precision[common])]
    own = P + np.arange(OWN * IMAGES).reshape(IMAGES, OWN)
    shape, rates = own[:, 3:8].ravel(), own[:, 8:].ravel()
    proper = np.concatenate([common[precision[common] > 0], rates])
    # Unknowns without a prior are removed by contrasts, those with one are random.
    improper = np.concatenate([common[precision[common] == 0], own[:, :3].ravel()])
    rows = np.flatnonzero(np.repeat(made.keep, 2))
    nuisance = whole.stars[np.ix_(rows, improper)]
    K = null_space((nuisance / np.linalg.norm(nuisance, axis=0)).T, rcond=1e-11)
    X = whole.stars[rows]
    left = whole.residual[rows] - X[:, field] @ field_px
    r = K.T @ (left + X[:, proper] @ offset[proper])

    def log_likelihood(sigma_px: Floats) -> float:
        A = K.T @ X[:, shape] * np.tile(sigma_px, IMAGES)
        B = K.T @ X[:, proper]
        V = np.eye(len(r)) + A @ A.T + (B / precision[proper]) @ B.T
        lower = np.linalg.cholesky(V)
        white = np.linalg.solve(lower, r)
        return float(-0.5 * white @ white - np.log(np.diag(lower)).sum())

    best = found.shapes.amplitudes
    best_px = np.exp(best.log_px)
    ratio = 2.0 * (log_likelihood(best_px) - log_likelihood(0.0 * best_px))
    # Rotations are held to 0.1 rad, a thousandth of the prior of cx and cy, which they can do.
    assert best.likelihood_ratio == pytest.approx(ratio, abs=0.01)
    assert ratio > 15.0
    # The prior of the logarithms is wide: nearby amplitudes are no likelier by more than its pull.
    for k in range(len(best_px)):
        for factor in (0.7, 1.4):
            near_px = best_px * np.where(np.arange(len(best_px)) == k, factor, 1.0)
            assert log_likelihood(near_px) < log_likelihood(best_px) + 0.3


def test_what_a_star_lacks_leaves_no_variance_of_a_smear_negative(given: Small) -> None:
    smear_px2 = np.tile([0.01, 0.0, 0.81], (len(given.table), 1))
    table = dataclasses.replace(given.table, covariance_px2=smear_px2)
    from_sky, n = np.tile(np.eye(2), (len(table), 1, 1)), len(table)
    lacks = SharedError('star places', table.star, np.full(n, 0.4), 9.0, True, 1.0, -0.3)
    more = dataclasses.replace(lacks, beyond_px2=0.3)
    mean_px2, variance = smear_px2[:, [0, 2]].mean(axis=1), CentroidVariance(1.0, 0.0)
    for error, px2 in ((lacks, -0.3), (more, 0.3)):
        one = Weighting(table, from_sky, variance, (error,), given.keep, None)
        np.testing.assert_allclose(one.variance_px2, mean_px2 + px2, rtol=1e-12)
        assert (one.covariance_px2[:, [0, 2]] > 0).all()
    assert one.covariance_px2[0] == pytest.approx([0.31, 0.0, 1.11])


Shared = tuple[Weighting, tuple[TrackerErrors, ...]]
"""Errors that observations and attitudes share."""


def weighted(
    given: Small, from_sky: Floats, variance_px2: Floats, *errors: SharedError
) -> Weighting:
    """Weights of observations of these variances (n,) per axis."""
    covariance_px2 = np.outer(variance_px2, [1.0, 0.0, 1.0])
    table = dataclasses.replace(given.table, covariance_px2=covariance_px2)
    return Weighting(table, from_sky, CentroidVariance(1.0, 0.0), errors, given.keep, None)


def shared(given: Small, place_px: float, cell_px: float) -> tuple[Shared, dict[str, Floats]]:
    """Random shared errors; dense covariances (2 n, 2 n) by name, one of errors beyond weights."""
    rng = np.random.default_rng(4)
    n = len(given.table)
    from_sky = Rotation.from_euler('z', rng.uniform(0.0, 6.0, (n, 1))).as_matrix()[:, :2, :2]
    used = given.keep
    cells = np.where(used, rng.integers(0, 9, n), -1)
    star = np.where(used, given.table.star, -1)
    errors = (
        SharedError('star places', star, np.full(n, place_px**2), 0.0, True, 1.0),
        SharedError('cells', cells, np.full(n, cell_px**2), 0.0, False, 1.0),
        SharedError('rows', rng.integers(0, 5, n), np.full(n, 0.5), 0.0, False, 0.0),
    )
    # Some observations have less variance than they share, and some more.
    variance = (place_px**2 + cell_px**2) * rng.uniform(0.5, 2.0, n)
    weights = weighted(given, from_sky, variance, *errors)
    trackers = []
    for rows, group in (([0, 2], np.array([0, 1])), ([1, 3], np.zeros(2, int))):
        half = rng.normal(size=(group.max() + 1, 2))
        covariance = half @ half.T + 0.2 * np.eye(len(half))
        errors_of = TrackerErrors(1.0, 1.0, covariance, group, 1.0, 0.0, '', 0.15)
        sigma_rad = OF_WORKING * given.problem.star_tracker_sigma_rad[rows[0], 0]
        trackers.append(dataclasses.replace(errors_of, sigma_rad=sigma_rad, images=np.array(rows)))
    several = np.bincount(star[used], minlength=50)[star] > 1
    total = cell_px**2 + place_px**2 * several
    share = np.sqrt(np.minimum(variance / total, 1.0))
    V = {name: np.zeros((n, 2, n, 2)) for name in ('star places', 'cells', 'independent')}
    for i in np.flatnonzero(used):
        V['independent'][i, :, i] = -(
            weights.inflation_px2[i] + share[i] ** 2 * total[i]
        ) * np.eye(2)
        for j in np.flatnonzero(used):
            common = share[i] * share[j] * np.eye(2)
            if star[i] == star[j] and several[i]:
                V['star places'][i, :, j] = place_px**2 * common @ from_sky[i] @ from_sky[j].T
            if cells[i] == cells[j]:
                V['cells'][i, :, j] = cell_px**2 * common
    return (weights, tuple(trackers)), {name: one.reshape(2 * n, 2 * n) for name, one in V.items()}


def widened(given: Small, found: Posterior, errors: Shared) -> Posterior:
    return with_shared_errors(found, given.sums(), given.linear(), *errors, negligible=1e-13)


def in_pixels(rows: Floats, covariance: Floats) -> Floats:
    """Variances of predicted pixels by their derivatives (n, p)."""
    return np.asarray(np.einsum('ni,ij,nj->n', rows, covariance, rows))


def propagated(
    given: Small, truth: Dense, gain: Floats, errors: Shared, V: dict[str, Floats]
) -> dict[str, Floats]:
    """``A V A'`` of each error; the gain A is by the whitened observations and attitudes."""
    white = whitener(given.table.covariance_px2)
    count = len(truth.residual)
    A = gain[:, :count] @ white
    parts = {name: A @ one @ A.T for name, one in V.items()}
    noise, slow, working = np.zeros((3, len(gain), len(gain)))
    for one in errors[1]:
        of_groups = one.covariance - one.independent * np.eye(len(one.covariance))
        for axis in one.axes:
            B = gain[:, count + 3 * one.images + axis]
            noise += OF_WORKING**2 * one.independent * B @ B.T
            slow += OF_WORKING**2 * B @ of_groups[np.ix_(one.group, one.group)] @ B.T
            working += B @ B.T
    parts[TRACKER_NOISE], parts[TRACKER_SLOW] = noise, slow
    parts['independent'] -= working
    return parts


def test_shared_errors_widen_lines_of_sight_as_the_dense_covariance() -> None:
    given = small(2, field_px=0.2)
    truth = dense(given)
    # Far larger than centroid errors, which are mostly hidden by the field of 150 coefficients.
    errors, V = shared(given, 2.0, 1.5)
    found = solved(given)
    after = widened(given, found, errors)
    assert np.array_equal(after.mean, found.mean)
    P = given.layout.count
    # The gain of the averaged estimator: its covariance times what the images leave of X.
    own = np.arange(P, len(truth.stars.T))
    X = np.concatenate([truth.stars, truth.trackers])
    N = X[:, own].T @ X[:, own]
    N += np.diag(prior_precision(given, found.shapes.sigma_px, None)[own])
    left = X[:, :P] - X[:, own] @ np.linalg.solve(N, X[:, own].T @ X[:, :P])
    plain = found.covariance - common_shape(given.layout, found.shapes.common_px2)
    parts = propagated(given, truth, plain @ left.T, errors, V)
    rows, widened_to = truth.stars[::7, :P], found.covariance + sum(parts.values())
    before, expected = in_pixels(rows, found.covariance), in_pixels(rows, widened_to)
    seen = before > 0
    assert seen.sum() > 15
    # Modes of the field below a twentieth are left out.
    assert np.abs(in_pixels(rows, after.covariance)[seen] / expected[seen] - 1.0).max() < 0.03
    assert np.abs(expected[seen] / before[seen] - 1.0).max() > 0.1
    del parts['independent']
    widening = after.errors
    assert widening is not None and set(widening.shared) == set(parts)
    for name, one in widening.shared.items():
        off = in_pixels(rows, widening.root @ one @ widening.root.T - parts[name])
        assert np.abs(off[seen] / expected[seen]).max() < 0.03, name
    field = given.layout.places['field']
    of_field = in_pixels(rows[:, field], after.covariance[field, field])
    assert (of_field[seen] > 0.1 * expected[seen]).any()


def _exact(given: Small, covariance: Floats) -> TrackerErrors:
    images, sigma_rad = np.arange(IMAGES), given.problem.star_tracker_sigma_rad[0, 0]
    known = TrackerErrors(1.0, 0.0, covariance, images, 1.0, 0.0, '', 1.0)
    return dataclasses.replace(known, sigma_rad=sigma_rad, images=images)


def test_independent_errors_of_the_working_weights_change_nothing(given: Small) -> None:
    n = len(given.table)
    alone = SharedError('alone', np.arange(n), np.ones(n), 0.0, False, 1.0)
    weights = weighted(given, np.tile(np.eye(2), (n, 1, 1)), np.ones(n), alone)
    found = solved(given)
    after = widened(given, found, (weights, (_exact(given, np.eye(IMAGES)),)))
    sigma = np.sqrt(np.diag(found.covariance).clip(1e-300))
    free = found.estimated
    off = (after.covariance - found.covariance) / np.outer(sigma, sigma)
    assert np.abs(off[np.ix_(free, free)]).max() < 1e-9


def test_star_trackers_beyond_the_stars_only_enter_the_alignment(given: Small) -> None:
    # Attitude errors that all images of a star tracker share are an error of the alignment.
    plain = small(6, terms=False, two_trackers=False)
    n = len(plain.table)
    shared_all = 50.0 * np.ones((IMAGES, IMAGES)) + np.eye(IMAGES)
    weights = weighted(plain, np.tile(np.eye(2), (n, 1, 1)), np.ones(n))
    found = solved(plain)
    after = widened(plain, found, (weights, (_exact(plain, shared_all),)))
    added = after.covariance - found.covariance
    at = plain.layout.of(['alignment'])
    # Its axes are those of the star tracker: turned into the camera frame.
    R = plain.state.camera_from_star_tracker.as_matrix()
    expected = 50.0 * (R * plain.problem.star_tracker_sigma_rad[0] ** 2) @ R.T
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((added[np.ix_(at, at)] - expected) / size).max() < 1e-3
    camera = plain.layout.of(['camera', 'velocity'])
    sigma2 = np.diag(found.covariance)[camera]
    free = sigma2 > 0
    assert (np.diag(added)[camera][free] / sigma2[free]).max() < 1e-3
