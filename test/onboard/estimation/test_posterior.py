# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The posterior is the dense least-squares solution with priors, exactly."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from typing import Any

from four_images import (  # type: ignore[import-not-found]
    Dense,
    dense,
    HEIGHT,
    IMAGES,
    lens_term,
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

from starcal_ros.arrays import Floats
from starcal_ros.estimation import posterior as module
from starcal_ros.estimation.amplitudes import (
    _shape_likelihood,
    Amplitudes,
    averaged_field,
    Shapes,
    shapes,
    ShapeSums,
)
from starcal_ros.estimation.limits import NEGLIGIBLE
from starcal_ros.estimation.posterior import (
    common_shape,
    Posterior,
    posterior,
    TRACKER_NOISE,
    TRACKER_SLOW,
    Weights,
    with_shared_errors,
)
from starcal_ros.estimation.shared_errors import SharedError
from starcal_ros.estimation.tracker_errors import TrackerErrors

# In sigma: finite differences leave 1e-10 of a derivative, first-order attitude errors 1e-8.
EXACT = 2e-7
# Amplitudes of the next term of the lens: none, and two that the stars may show.
OF_TERM = np.array([-2.0, 1.5, 2.2])
OCTAVES_PX = np.array([0.03, 0.02, 0.01])


def solved(given: Small) -> Posterior:
    return posterior(given.sums(), given.linear(), SHAPE)


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let all amplitudes be known: those of octaves and shapes; the term of the lens is absent."""
    field, shape = (Amplitudes(np.log(one), 0.0) for one in (OCTAVES_PX, SHAPE))
    monkeypatch.setattr(module, 'field_amplitudes', lambda *_: field)
    monkeypatch.setattr(module, 'shapes', lambda *_: Shapes(SHAPE, shape, None))

    at_amplitudes = partial(averaged_field, shifts=np.zeros(1), log_term=np.array([-1e3]))
    monkeypatch.setattr(module, 'averaged_field', at_amplitudes)


def assert_same(found: Posterior, mean: Floats, covariance: Floats) -> None:
    """Compare a posterior with dense mean and covariance of shared and image unknowns."""
    P = len(found.mean)
    sigma = np.sqrt(np.diag(covariance))
    estimated = np.flatnonzero(sigma[:P])
    assert np.array_equal(np.sort(found.estimated), estimated)
    held = np.setdiff1d(np.arange(P), estimated)
    assert not found.mean[held].any()
    assert not found.covariance[held].any() and not found.covariance[:, held].any()
    off = (found.mean - mean[:P])[estimated] / sigma[estimated]
    assert np.abs(off).max() < EXACT
    part = np.ix_(estimated, estimated)
    size = np.outer(sigma[:P], sigma[:P])[part]
    assert np.abs((found.covariance - covariance[:P, :P])[part] / size).max() < EXACT
    assert np.abs((found.of_images.ravel() - mean[P:]) / sigma[P:]).max() < EXACT
    back = found.equations.back
    whole = found.equations.covariance + back @ found.covariance @ back.transpose(0, 2, 1)
    for k in range(IMAGES):
        own = slice(P + OWN * k, P + OWN * k + OWN)
        size = np.outer(sigma[own], sigma[own])
        assert np.abs((whole[k] - covariance[own, own]) / size).max() < EXACT


@pytest.mark.usefixtures('known')
def test_at_known_amplitudes_it_is_the_dense_solution(given: Small, truth: Dense) -> None:
    found = solved(given)
    precision, offset = prior_precision(given, SHAPE, OCTAVES_PX), prior_offset(given)
    mean, covariance, _ = solution(truth, precision, offset)
    assert_same(found, mean, covariance)
    assert np.array_equal(found.shapes.sigma_px, SHAPE)
    # The number of unknowns that the data determine: trace of data over all information.
    free = np.flatnonzero(np.isfinite(precision[: given.layout.count]))
    prior = np.trace(covariance[np.ix_(free, free)] * precision[free])
    assert found.resolved == pytest.approx(len(free) - prior, rel=1e-7)


@pytest.mark.slow
@pytest.mark.usefixtures('known')
def test_one_star_tracker_without_terms_is_the_dense_solution() -> None:
    plain = small(5, terms=False, two_trackers=False)
    mean, covariance, _ = solution(
        dense(plain), prior_precision(plain, SHAPE, OCTAVES_PX), prior_offset(plain)
    )
    assert_same(solved(plain), mean, covariance)


@dataclass(frozen=True)
class Varied:
    """Four images whose scales differ by pixels; what the search of shapes was given and found."""

    made: Small
    truth: Dense
    found: Posterior
    field_px: Floats
    sums: ShapeSums
    result: Shapes


@pytest.fixture(scope='module')
def varied() -> Varied:
    scales = np.zeros((IMAGES, len(SHAPE)))
    scales[:, 0] = [6.0, 5.0, 4.5, -3.0]
    scales[:, 1] = [1.0, -1.5, 0.3, 0.8]
    made = small(3, shapes_px=scales)
    calls: list[tuple[ShapeSums, Shapes]] = []
    fields: list[Floats] = []
    to_sums = module._shape_sums

    def recorded(sums: ShapeSums, near: Amplitudes | None) -> Shapes:
        assert near is None
        result = shapes(sums)
        calls.append((sums, result))
        return result

    def of_field(*args: Any) -> ShapeSums:
        fields.append(args[-1])
        return to_sums(*args)

    with pytest.MonkeyPatch.context() as patch:
        terms = np.log(1e-5) + 4.0 * OF_TERM
        patch.setattr(module, 'averaged_field', partial(averaged_field, log_term=terms))
        patch.setattr(module, 'shapes', recorded)
        patch.setattr(module, '_shape_sums', of_field)
        found = solved(made)
    return Varied(made, dense(made), found, fields[0], *calls[0])


def mixture(
    made: Small, truth: Dense, mode_px: Floats, shifts: Floats, shape_px: Floats
) -> tuple[Floats, Floats, Floats]:
    """Mean, covariance and weights of dense posteriors over a factor of the field's amplitudes."""
    offset, parts = prior_offset(made), []
    for shift in shifts:
        log_px = mode_px + shift
        precision = prior_precision(made, shape_px, np.exp(log_px))
        *_, evidence = solution(truth, precision, offset)
        # The prior of the logarithms: N(ln 1e-5, 4), and each octave e^-0.7 of the one before.
        steps = np.diff(log_px) + 0.7
        evidence -= 0.5 * (((log_px[0] - np.log(1e-5)) / 4.0) ** 2 + steps @ steps)
        with_term = []
        for off in OF_TERM:
            term = lens_term(made, np.exp(np.log(1e-5) + 4.0 * off))
            mean, covariance, own = solution(truth, precision, offset, term)
            with_term.append((own - 0.5 * off**2, mean, covariance))
        parts.append((evidence, *mixed(with_term)[:2]))
    return mixed(parts)


def mixed(parts: list[tuple[float, Floats, Floats]]) -> tuple[Floats, Floats, Floats]:
    """Mean, covariance and weights of a mixture of some log evidences, means and covariances."""
    logs = np.array([log for log, _, _ in parts])
    weight = np.exp(logs - logs.max())
    weight /= weight.sum()
    means = np.array([mean for _, mean, _ in parts])
    mean = weight @ means
    apart = means - mean
    covariance = np.einsum('s,sij->ij', weight, np.array([c for _, _, c in parts]))
    return mean, covariance + (apart.T * weight) @ apart, weight


def test_the_whole_is_the_mixture_over_the_amplitude_of_the_field(varied: Varied) -> None:
    made, truth, found, result = varied.made, varied.truth, varied.found, varied.result
    assert np.array_equal(found.shapes.sigma_px, result.sigma_px)
    mode_px = found.field.log_px
    shifts = found.last_octave[0] - mode_px[-1]
    assert shifts.min() == pytest.approx(-8.0)
    assert shifts.max() <= np.log(0.5) - mode_px.max() + 1e-9
    mean, covariance, weight = mixture(made, truth, mode_px, shifts, result.sigma_px)
    # Evidences are rounded by 1e-6: the smallest prior of the field is 1e-9 px.
    assert found.last_octave[1] == pytest.approx(weight, abs=1e-5)
    # Scale, stretch and shear that all images share are changes of fx and fy; skew is held.
    assert result.common_px2[0] > 0
    scale, stretch, _, *decentring = result.common_px2
    half_px = 0.5 * np.hypot(WIDTH, HEIGHT)
    covariance[[8, 9], [8, 9]] += (
        np.array(decentring) * (made.state.parameters[0] / half_px**2) ** 2
    )
    covariance[0, 0] += scale + stretch
    covariance[2, 2] += scale + stretch
    covariance[0, 2] += scale - stretch
    covariance[2, 0] += scale - stretch
    P = made.layout.count
    sigma = np.sqrt(np.diag(covariance))[:P]
    free = np.flatnonzero(sigma)
    assert np.array_equal(np.sort(found.estimated), free)
    assert np.abs((found.mean - mean[:P])[free] / sigma[free]).max() < 1e-5
    part = np.ix_(free, free)
    difference = (found.covariance - covariance[:P, :P])[part]
    assert np.abs(difference / np.outer(sigma[free], sigma[free])).max() < 1e-5
    added = common_shape(made.layout, result.common_px2)
    assert np.allclose(found.working + added, found.covariance, rtol=1e-12, atol=0.0)
    assert np.array_equal(found.shapes.common_px2, result.common_px2)
    size = np.sqrt(np.diag(covariance)[P:])
    assert np.abs((found.of_images.ravel() - mean[P:]) / size).max() < 1e-5


def test_shapes_are_sought_beside_the_field_of_the_amplitudes_before(varied: Varied) -> None:
    made, octaves_px = varied.made, np.exp(varied.found.field.log_px)
    precision = prior_precision(made, SHAPE, octaves_px)
    mean, covariance, _ = solution(varied.truth, precision, prior_offset(made))
    field = made.layout.of(['field'])
    sigma = np.sqrt(np.diag(covariance)[field])
    assert np.abs((varied.field_px - mean[field]) / sigma).max() < 1e-5


def test_sums_of_the_shapes_have_the_likelihood_of_contrasts_free_of_everything_else(
    varied: Varied,
) -> None:
    made, sums, whole = varied.made, varied.sums, varied.truth
    P = made.layout.count
    precision, offset = prior_precision(made, SHAPE, None), prior_offset(made)
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
    field = made.layout.of(['field'])
    left = whole.residual[rows] - X[:, field] @ varied.field_px
    r = K.T @ (left + X[:, proper] @ offset[proper])

    def log_likelihood(log_px: Floats) -> float:
        variance = np.tile(np.exp(2 * log_px), IMAGES)
        A = K.T @ X[:, shape]
        B = K.T @ X[:, proper]
        V = np.eye(len(r)) + (A * variance) @ A.T + (B / precision[proper]) @ B.T
        lower = np.linalg.cholesky(V)
        white = np.linalg.solve(lower, r)
        return float(-0.5 * white @ white - np.log(np.diag(lower)).sum())

    def with_prior(log_px: Floats) -> float:
        off = (log_px - np.log(1e-5)) / 4.0
        return log_likelihood(log_px) - 0.5 * float(off @ off)

    sizes_px = ([1e-4] * 5, [4.0, 1.0, 0.1, 0.1, 0.1], [0.3, 3.0, 2.0, 0.5, 1.0])
    at = [np.log(np.array(px)) for px in sizes_px]
    expected = np.array([with_prior(one) for one in at])
    likelihood = _shape_likelihood(sums)
    values = likelihood(np.array(at))
    # Rotations are held to 0.1 rad, a thousandth of the prior of cx and cy, which they can do.
    assert np.abs(np.diff(expected)).max() > 3.0
    assert np.diff(values) == pytest.approx(np.diff(expected), abs=3e-3)


def shared(given: Small, place_px: float, cell_px: float) -> tuple[Weights, dict[str, Floats]]:
    """
    Random shared errors, and their dense covariances (2 n, 2 n) by name.

    With that of independent errors beyond the working weights.
    """
    rng = np.random.default_rng(4)
    n = len(given.table)
    angle = rng.uniform(0.0, 6.0, n)
    cos, sin = np.cos(angle), np.sin(angle)
    from_sky = np.stack([np.stack([cos, -sin], 1), np.stack([sin, cos], 1)], 1)
    used = given.keep
    cells = np.where(used, rng.integers(0, 9, n), -1)
    star = np.where(used, given.table.star, -1)
    errors = (
        SharedError('star places', star, np.full(n, place_px**2), 0.0, True, 1.0),
        SharedError('cells', cells, np.full(n, cell_px**2), 0.0, False, 1.0),
        SharedError('rows', rng.integers(0, 5, n), np.full(n, 0.5), 0.0, False, 0.0),
    )
    inflation = rng.uniform(0.0, 0.002, n)
    variance = (place_px**2 + cell_px**2) * rng.uniform(0.5, 2.0, n)
    trackers = []
    for rows, group in (
        (np.array([0, 2]), np.array([0, 1])),
        (np.array([1, 3]), np.zeros(2, int)),
    ):
        half = rng.normal(size=(group.max() + 1, 2))
        covariance = half @ half.T + 0.2 * np.eye(len(half))
        errors_of = TrackerErrors(1.0, 1.0, covariance, group, 1.0, 0.0, '', 0.15)
        sigma_rad = given.problem.star_tracker_sigma_rad[rows[0], 0]
        trackers.append(dataclasses.replace(errors_of, sigma_rad=sigma_rad, images=rows))
    several = np.bincount(star[used], minlength=50)[star] > 1
    total = cell_px**2 + place_px**2 * several
    share = np.sqrt(np.minimum(variance / total, 1.0))
    V = {name: np.zeros((n, 2, n, 2)) for name in ('star places', 'cells', 'independent')}
    for i in np.flatnonzero(used):
        V['independent'][i, :, i] = -(inflation[i] + share[i] ** 2 * total[i]) * np.eye(2)
        for j in np.flatnonzero(used):
            common = share[i] * share[j] * np.eye(2)
            if star[i] == star[j] and several[i]:
                V['star places'][i, :, j] = place_px**2 * common @ from_sky[i] @ from_sky[j].T
            if cells[i] == cells[j]:
                V['cells'][i, :, j] = cell_px**2 * common
    weights = Weights(variance, inflation, from_sky, errors, tuple(trackers))
    return weights, {name: one.reshape(2 * n, 2 * n) for name, one in V.items()}


def widened(
    given: Small, found: Posterior, weights: Weights, negligible: float = 1e-13
) -> Posterior:
    return with_shared_errors(found, given.sums(), given.linear(), weights, negligible)


def propagated(
    given: Small, truth: Dense, gain: Floats, weights: Weights, V: dict[str, Floats]
) -> dict[str, Floats]:
    """``A V A'`` of each error; the gain A is by the whitened observations and attitudes."""
    white = whitener(given.table.covariance_px2)
    count = len(truth.residual)
    A = gain[:, :count] @ white
    parts = {name: A @ one @ A.T for name, one in V.items()}
    noise, slow, working = np.zeros((3, len(gain), len(gain)))
    for one in weights.trackers:
        of_groups = one.covariance - one.independent * np.eye(len(one.covariance))
        for axis in one.axes:
            B = gain[:, count + 3 * one.images + axis]
            noise += one.independent * B @ B.T
            slow += B @ of_groups[np.ix_(one.group, one.group)] @ B.T
            working += B @ B.T
    parts[TRACKER_NOISE], parts[TRACKER_SLOW] = noise, slow
    parts['independent'] -= working
    return parts


@pytest.mark.usefixtures('known')
def test_shared_errors_at_known_amplitudes_propagate_as_the_dense_covariance(
    given: Small, truth: Dense
) -> None:
    weights, V = shared(given, 0.11, 0.07)
    found = solved(given)
    after = widened(given, found, weights)
    _, covariance, _ = solution(
        truth, prior_precision(given, SHAPE, OCTAVES_PX), prior_offset(given)
    )
    X = np.concatenate([truth.stars, truth.trackers])
    P = given.layout.count
    gain = (covariance @ X.T)[:P]
    parts = propagated(given, truth, gain, weights, V)
    expected = covariance[:P, :P] + sum(parts.values())
    sigma = np.sqrt(np.diag(covariance)[:P])
    free = np.flatnonzero(sigma)
    part = np.ix_(free, free)
    difference = (after.covariance - expected)[part] / np.outer(sigma[free], sigma[free])
    assert np.abs(difference).max() < EXACT
    # The test means something: shared errors are large.
    changed = np.diag(after.covariance - found.covariance)[free] / sigma[free] ** 2
    assert changed.max() > 0.3 and np.abs(changed).min() > 1e-6
    assert np.array_equal(after.mean, found.mean)
    assert np.array_equal(after.working, found.covariance)
    errors = after.errors
    assert errors is not None
    whole = errors.root @ (np.eye(len(errors.excess)) + errors.excess) @ errors.root.T
    assert np.abs((whole - after.covariance)[part] / np.outer(sigma, sigma)[part]).max() < EXACT
    del parts['independent']
    assert set(errors.shared) == set(parts)
    for name, one in errors.shared.items():
        off = (errors.root @ one @ errors.root.T - parts[name])[part]
        assert np.abs(off / np.outer(sigma[free], sigma[free])).max() < EXACT


# By default modes of the field that hardly move are left out; here also with all of them.
@pytest.mark.parametrize(('negligible', 'tolerance'), [(1e-13, 1e-4), (NEGLIGIBLE, 0.03)])
def test_shared_errors_with_a_field_widen_lines_of_sight_as_the_dense_covariance(
    negligible: float, tolerance: float
) -> None:
    given = small(2, field_px=0.2)
    truth = dense(given)
    # Far larger than centroid errors, which are mostly hidden by the field of 150 coefficients.
    weights, V = shared(given, 2.0, 1.5)
    found = solved(given)
    after = widened(given, found, weights, negligible)
    P = given.layout.count
    # The gain of the averaged estimator: its covariance times what the images leave of X.
    own = np.arange(P, len(truth.stars.T))
    X = np.concatenate([truth.stars, truth.trackers])
    N = X[:, own].T @ X[:, own]
    N += np.diag(prior_precision(given, found.shapes.sigma_px, None)[own])
    left = X[:, :P] - X[:, own] @ np.linalg.solve(N, X[:, own].T @ X[:, :P])
    plain = found.covariance - common_shape(given.layout, found.shapes.common_px2)
    parts = propagated(given, truth, plain @ left.T, weights, V)
    expected = found.covariance + sum(parts.values())
    rows = truth.stars[::7, :P]
    one, other, plain = (
        np.einsum('ni,ij,nj->n', rows, C, rows)
        for C in (after.covariance, expected, found.covariance)
    )
    seen = plain > 0
    assert seen.sum() > 15
    assert np.abs(one[seen] / other[seen] - 1.0).max() < tolerance
    assert np.abs(other[seen] / plain[seen] - 1.0).max() > 0.1
    field = given.layout.places['field']
    of_field = np.einsum('ni,ij,nj->n', rows[:, field], expected[field, field], rows[:, field])
    assert (of_field[seen] > 0.1 * other[seen]).any()


def _exact(given: Small, covariance: Floats) -> TrackerErrors:
    images, sigma_rad = np.arange(IMAGES), given.problem.star_tracker_sigma_rad[0, 0]
    known = TrackerErrors(1.0, 0.0, covariance, images, 1.0, 0.0, '', 1.0)
    return dataclasses.replace(known, sigma_rad=sigma_rad, images=images)


@pytest.mark.usefixtures('known')
def test_independent_errors_of_the_working_weights_change_nothing(given: Small) -> None:
    n = len(given.table)
    weights = Weights(
        np.ones(n),
        np.zeros(n),
        np.tile(np.eye(2), (n, 1, 1)),
        (SharedError('alone', np.arange(n), np.ones(n), 0.0, False, 1.0),),
        (_exact(given, np.eye(IMAGES)),),
    )
    found = solved(given)
    after = widened(given, found, weights)
    sigma = np.sqrt(np.diag(found.covariance).clip(1e-300))
    free = found.estimated
    off = (after.covariance - found.covariance) / np.outer(sigma, sigma)
    assert np.abs(off[np.ix_(free, free)]).max() < 1e-9


@pytest.mark.usefixtures('known')
def test_star_trackers_beyond_the_stars_only_enter_the_alignment(given: Small) -> None:
    # Attitude errors that all images of a star tracker share are an error of the alignment.
    plain = small(6, terms=False, two_trackers=False)
    n = len(plain.table)
    shared_all = 50.0 * np.ones((IMAGES, IMAGES)) + np.eye(IMAGES)
    weights = Weights(
        np.ones(n),
        np.zeros(n),
        np.tile(np.eye(2), (n, 1, 1)),
        (),
        (_exact(plain, shared_all),),
    )
    found = solved(plain)
    after = widened(plain, found, weights)
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
