# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrations of observations whose truth is known: exact, unbiased, and true to their sigma."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from starcal_ground.simulation.centroids import (
    bound_names,
    cramer_rao_covariance,
    true_observations,
)
from starcal_ground.simulation.scenario import scenario
from starcal_ros.arrays import Indices, Mask
from starcal_ros.camera import line_of_sight, PARAMETER_NAMES, pixel_grid, project_jacobians
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation import calibrate, weights
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, check_enough, estimated_parameters
from starcal_ros.estimation.problem import METHODS
from starcal_ros.estimation.shared_errors import SharedError
from starcal_ros.estimation.star_equations import star_table
from starcal_ros.estimation.tracker_errors import Attitudes
from starcal_ros.estimation.weights import CentroidVariance
from starcal_ros.records import CameraGeometry, Ensemble, StarObservations
from studies import worlds

SCENARIO = scenario('tiny', seed=3)
TRUTH, PRIOR = SCENARIO.truth, SCENARIO.prior
TRACKER_ARCSEC = (10.0, 10.0, 40.0)
# The eight parameters of the Cramer-Rao bound, without a prior; what else is not known is small.
EIGHT = CalibrationOptions(
    estimate=('fx', 'skew', 'fy', 'distortion'),
    principal_point_prior=0.0,
    lens_prior=0.0,
    velocity_sigma_m_s=10.0,
    star_tracker_slow_arcsec=0.1,
)
NAMES = estimated_parameters(EIGHT, 'plumb_bob')
FREE = [PARAMETER_NAMES.index(name) for name in NAMES]
TRIALS = 60
each_method = pytest.mark.parametrize('method', METHODS)


@functools.cache
def clean() -> Ensemble:
    """Ten images, 3900 stars, at their true places."""
    return true_observations(SCENARIO, centroid_noise=False, attitude_noise=False)


def with_noise(
    ensemble: Ensemble,
    seed: int,
    tracker_arcsec: tuple[float, ...] = TRACKER_ARCSEC,
    centroid_scale: float = 1.0,
    floor_px: float = 0.0,
) -> Ensemble:
    """
    Centroids off by their own covariance and attitudes by the tracker's sigma.

    The centroid sigma is ``centroid_scale`` times what is reported, and ``floor_px`` comes to it.
    """
    rng = np.random.default_rng(seed)
    images = []
    for image in ensemble.images:
        uu, uv, vv = image.covariance_px2.T
        L = np.linalg.cholesky(np.array([[uu, uv], [uv, vv]]).transpose(2, 0, 1))
        n = centroid_scale * np.einsum('nij,nj->ni', L, rng.normal(size=(len(image), 2)))
        n += floor_px * rng.normal(size=n.shape)
        error = Rotation.from_rotvec(rng.normal(size=3) * tracker_arcsec * np.array(ARCSECOND_RAD))
        reported = Rotation.from_quat(image.icrf_from_star_tracker_xyzw) * error
        images.append(
            dataclasses.replace(
                image,
                measured_px=image.measured_px + n,
                icrf_from_star_tracker_xyzw=reported.as_quat(),
            )
        )
    return Ensemble(tuple(images))


def options(method: str, **other: object) -> CalibrationOptions:
    tracker_arcsec = (1e-3,) * 3 if method == 'single' else TRACKER_ARCSEC
    values: dict[str, object] = {'star_tracker_sigma_arcsec': tracker_arcsec, **other}
    return dataclasses.replace(EIGHT, method=method, **values)  # type: ignore[arg-type]


def error_of(estimate: Estimate, rows: list[int]) -> np.ndarray:
    """Estimate less truth: camera parameters, then the passive turn of the camera frame, rad."""
    found, true = (
        Rotation.from_quat(g.star_tracker_from_camera_xyzw) for g in (estimate.geometry, TRUTH)
    )
    turn = -(found.inv() * true).as_rotvec()
    parameters = estimate.geometry.camera.parameters - TRUTH.camera.parameters
    return np.asarray(np.r_[parameters, turn][rows])


def normalised(error: np.ndarray, covariance: np.ndarray) -> float:
    """Squared length of an error in the metric of its covariance."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    whitened = np.linalg.solve(np.linalg.cholesky(correlation), error / sigma)
    return float(whitened @ whitened)


def normalised_error(estimate: Estimate) -> float:
    rows = [*FREE, 10, 11, 12]
    return normalised(error_of(estimate, rows), estimate.covariance[np.ix_(rows, rows)])


def tracker_of(method: str) -> tuple[float, ...]:
    """Star-tracker sigma that the method assumes: zero, or the option."""
    return (0.0, 0.0, 0.0) if method == 'single' else TRACKER_ARCSEC


@functools.cache
def trial(method: str, k: int) -> Estimate:
    return estimate_calibration(with_noise(clean(), k, tracker_of(method)), PRIOR, options(method))


def trials(method: str) -> tuple[Estimate, ...]:
    return tuple(trial(method, k) for k in range(TRIALS))


def assert_true_to_its_covariance(errors: list[float], parameters: int) -> None:
    """The sum of normalised squared errors lies within the 99 % interval of chi squared."""
    low, high = chi2.ppf([0.005, 0.995], parameters * len(errors)) / len(errors)
    assert low < np.mean(errors) < high, f'{np.mean(errors):.2f} of {parameters}'


@each_method
@pytest.mark.parametrize('with_principal_point', [False, True])
def test_without_noise_the_truth_comes_back(method: str, with_principal_point: bool) -> None:
    # A far prior: focal length 20 % off, mounting 0.3 degrees, principal point 100 px.
    prior_camera = TRUTH.camera.replace(
        fx=1.2 * TRUTH.camera.parameters[0], fy=1.2 * TRUTH.camera.parameters[2],
        skew=0.0, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0,
    )  # fmt: skip
    estimate = NAMES
    if with_principal_point:
        cx, cy = TRUTH.camera.parameters[3:5]
        prior_camera = prior_camera.replace(cx=cx + 80.0, cy=cy - 60.0)
        estimate = PARAMETER_NAMES
    off = Rotation.from_euler('xyz', [0.2, -0.2, 0.1], degrees=True)
    mounting = Rotation.from_quat(TRUTH.star_tracker_from_camera_xyzw) * off
    prior = CameraGeometry(prior_camera, mounting.as_quat())
    found = estimate_calibration(clean(), prior, options(method, estimate=estimate))
    assert found.termination == 'converged' and found.kept.all()
    error = error_of(found, list(range(13)))
    # 1e-9 of each term at the edge of the field (r = 0.23, f = 1800 px) and of a radian.
    fx, r = TRUTH.camera.parameters[0], 0.23
    effect_px = np.array(
        [r, r, r, 1, 1, fx * r**3, fx * r**5, fx * r**7, fx * r**2, fx * r**2, fx, fx, fx]
    )
    assert np.abs(error * effect_px).max() < 1e-9 * fx
    assert np.abs(found.residual_px).max() < 1e-8


@each_method
def test_what_is_held_does_not_change_by_a_bit(method: str) -> None:
    chosen = ('fx', 'fy', 'k1')
    found = estimate_calibration(with_noise(clean(), 1), PRIOR, options(method, estimate=chosen))
    before, after = PRIOR.camera.parameters, found.geometry.camera.parameters
    for k, name in enumerate(PARAMETER_NAMES):
        if name in chosen:
            assert after[k] != before[k] and found.covariance[k, k] > 0
        else:
            assert after[k].tobytes() == before[k].tobytes(), name
            assert not found.covariance[k].any() and not found.covariance[:, k].any()


@each_method
def test_the_order_of_the_names_does_not_matter(method: str) -> None:
    noisy = with_noise(clean(), 1)
    names = NAMES
    one, other = (
        estimate_calibration(noisy, PRIOR, options(method, estimate=order))
        for order in (names, names[::-1])
    )
    np.testing.assert_array_equal(one.geometry.camera.parameters, other.geometry.camera.parameters)
    np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.slow
@each_method
def test_the_reported_covariance_is_true(method: str) -> None:
    estimates = trials(method)
    assert {e.termination for e in estimates} == {'converged'}
    assert_true_to_its_covariance([normalised_error(e) for e in estimates], 11)
    # Normal noise loses next to no star: 4.5 sigma of two dimensions is passed by 4e-5 of them.
    rejected = np.mean([np.count_nonzero(~e.kept) for e in estimates])
    assert rejected < 3.0


@pytest.mark.slow
def test_the_covariance_holds_for_each_group_alone() -> None:
    for method in ('per_image', 'hierarchical'):
        for rows in (FREE, [10, 11, 12]):
            errors = [
                normalised(error_of(e, rows), e.covariance[np.ix_(rows, rows)])
                for e in trials(method)
            ]
            assert_true_to_its_covariance(errors, len(rows))


@pytest.mark.slow
def test_the_variance_of_the_centroids_is_found_again() -> None:
    for method in METHODS:
        ratio = [
            np.median(
                e.variance.of(e.table.covariance_px2, e.table.magnitude)[:, 0]
                / e.table.covariance_px2[:, 0]
            )
            for e in trials(method)
        ]
        # Groups by variance hold unlike stars, whose median is lower than that of like ones: it
        # is 3 % low.  The mean of 60 trials is known to 0.3 %.
        assert 0.95 < np.mean(ratio) < 1.02
        factor = np.mean([e.variance_factor for e in trials(method)])
        # 60 times 7700 residuals: known to 0.2 %.
        assert factor == pytest.approx(1.0, abs=0.008)


@pytest.mark.slow
def test_the_line_of_sight_reaches_the_cramer_rao_bound() -> None:
    assert tuple(PARAMETER_NAMES[k] for k in FREE) == bound_names(TRUTH.camera)
    bound = cramer_rao_covariance(SCENARIO)
    directions = line_of_sight(TRUTH.camera, pixel_grid(TRUTH.camera, 9, 7))
    _, J, J_rotation = project_jacobians(TRUTH.camera, directions)
    J, turn = J[..., FREE].reshape(-1, 8), J_rotation.reshape(-1, 3)
    # A turn common to all pixels is the alignment's; what is left is the shape of the map.
    J = J - turn @ np.linalg.lstsq(turn, J, rcond=None)[0]
    expected_px2 = np.einsum('ni,ij,nj->', J, bound, J) / len(J)
    for method in ('per_image', 'hierarchical'):
        errors = np.array([error_of(e, FREE) for e in trials(method)])
        found_px2 = ((errors @ J.T) ** 2).mean()
        # Some 8 independent modes in 60 trials: the ratio is known to 4 %.
        assert 0.9 < np.sqrt(found_px2 / expected_px2) < 1.1
        in_sigma = [normalised(error, bound) for error in errors]
        assert_true_to_its_covariance(in_sigma, 8)


@pytest.mark.slow
def test_hierarchical_is_no_worse_than_the_better_of_the_others() -> None:
    # With a useless tracker it is per-image, with a perfect one it is single.
    noisy = with_noise(clean(), 1)
    loose = {'star_tracker_sigma_arcsec': (3600.0, 3600.0, 3600.0)}
    tight = {'star_tracker_sigma_arcsec': (1e-3, 1e-3, 1e-3)}
    one, other = (
        estimate_calibration(noisy, PRIOR, options(m, **loose))
        for m in ('hierarchical', 'per_image')
    )
    sigma = np.sqrt(np.diag(other.covariance))[FREE]
    # 50 arcsec of disagreement in 3600: the prior pulls by 1e-4 of a sigma or so.
    assert np.abs(error_of(one, FREE) - error_of(other, FREE)).max() < 0.01 * sigma.max()
    np.testing.assert_allclose(np.sqrt(np.diag(one.covariance))[FREE], sigma, rtol=0.01)
    perfect = with_noise(clean(), 1, (0.0, 0.0, 0.0))
    one, other = (
        estimate_calibration(perfect, PRIOR, options(m, **tight))
        for m in ('hierarchical', 'single')
    )
    rows = [*FREE, 10, 11, 12]
    sigma = np.sqrt(np.diag(other.covariance))[rows]
    # The errors that the stars show of a perfect star tracker are their own noise, which its
    # sigma takes in: hierarchical does not trust it as single does.
    assert (np.abs(error_of(one, rows) - error_of(other, rows)) / sigma).max() < 1.0
    assert (np.sqrt(np.diag(one.covariance))[FREE] < 2.0 * sigma[: len(FREE)]).all()


@pytest.mark.slow
@each_method
def test_the_errors_of_single_and_hierarchical_in_order(method: str) -> None:
    # Predicted from the same noise: knowing more of the attitudes never makes sigma larger.
    sigma = {m: np.sqrt(np.diag(trial(m, 0).covariance)) for m in METHODS}
    rows = [*FREE, 10, 11, 12]
    assert (sigma['hierarchical'][rows] <= 1.02 * sigma['per_image'][rows]).all()
    assert (sigma['single'][rows] <= 1.02 * sigma[method][rows]).all()


@pytest.mark.slow
@each_method
@pytest.mark.parametrize('fraction', [0.02, 0.10])
def test_gross_outliers_are_left_out(method: str, fraction: float) -> None:
    noisy = with_noise(clean(), 1, tracker_of(method))
    reference = trial(method, 1)
    rng = np.random.default_rng(2)
    images, bad = [], []
    for image in noisy.images:
        moved = rng.uniform(size=len(image)) < fraction
        angle = rng.uniform(0, 2 * np.pi, len(image))
        far = rng.uniform(5, 50, len(image)) * moved
        shift = far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        images.append(dataclasses.replace(image, measured_px=image.measured_px + shift))
        bad.append(moved)
    spoilt = np.concatenate(bad)
    found = estimate_calibration(Ensemble(tuple(images)), PRIOR, options(method))
    assert not found.kept[spoilt].any()
    assert np.count_nonzero(~found.kept[~spoilt]) <= 4
    rows = [*FREE, 10, 11, 12]
    sigma = np.sqrt(np.diag(reference.covariance))[rows]
    apart = np.abs(error_of(found, rows) - error_of(reference, rows)) / sigma
    # The stars that are gone carried that fraction of the information: its root, in sigma, is by
    # how much two such estimates differ, 0.14 or 0.32; the largest of eleven within four times.
    assert apart.max() < 4 * np.sqrt(fraction)
    # Against the minimum without those stars there is nothing left to excuse.
    without = Ensemble(
        tuple(image.select(~moved) for image, moved in zip(noisy.images, bad, strict=True))
    )
    clean_minimum = estimate_calibration(without, PRIOR, options(method))
    apart = np.abs(error_of(found, rows) - error_of(clean_minimum, rows)) / sigma
    assert apart.max() < 0.05


@each_method
def test_outliers_that_all_lean_one_way_are_left_out(method: str) -> None:
    # Two of five stars, all 15 px to the right: a mean is dragged along, a robust loss is not.
    noisy = with_noise(clean(), 1, tracker_of(method))
    images, bad = [], []
    for k, image in enumerate(noisy.images):
        moved = np.random.default_rng([5, k]).uniform(size=len(image)) < 0.4
        shift = moved[:, None] * np.array([15.0, 0.0])
        images.append(dataclasses.replace(image, measured_px=image.measured_px + shift))
        bad.append(moved)
    found = estimate_calibration(Ensemble(tuple(images)), PRIOR, options(method))
    assert not found.kept[np.concatenate(bad)].any()
    rows = [*FREE, 10, 11, 12]
    sigma = np.sqrt(np.diag(found.covariance))[rows]
    assert np.abs(error_of(found, rows) / sigma).max() < 5.0


@pytest.mark.slow
@each_method
@pytest.mark.parametrize('centroid_scale', [2.0, 0.5])
def test_centroid_covariances_wrong_by_four_do_no_harm(method: str, centroid_scale: float) -> None:
    errors, factors = [], []
    for k in range(10):
        noisy = with_noise(clean(), 100 + k, tracker_of(method), centroid_scale)
        found = estimate_calibration(noisy, PRIOR, options(method))
        errors.append(normalised_error(found))
        factors.append(found.variance_factor)
    assert_true_to_its_covariance(errors, 11)
    # chi^2 per degree of freedom as given says it, to 0.6 % in 10 trials.
    assert np.mean(factors) == pytest.approx(centroid_scale**2, rel=0.02)


@pytest.mark.slow
def test_a_floor_that_no_centroid_knows_of_is_found() -> None:
    errors, floors = [], []
    for k in range(TRIALS):
        noisy = with_noise(clean(), 200 + k, floor_px=0.1)
        found = estimate_calibration(noisy, PRIOR, options('per_image'))
        errors.append(normalised_error(found))
        floors.append(found.variance.floor_px2)
    assert_true_to_its_covariance(errors, 11)
    assert np.sqrt(np.mean(floors)) == pytest.approx(0.1, rel=0.05)


@pytest.mark.slow
@each_method
def test_images_of_very_unlike_star_counts(method: str) -> None:
    sizes = (3, 4, 8, 15, 30, 60, 120, 250, 300, 5)
    images = tuple(
        image.select(np.arange(len(image)) % max(len(image) // n, 1) == 0)
        for image, n in zip(clean().images, sizes, strict=True)
    )
    errors = [
        normalised_error(
            estimate_calibration(
                with_noise(Ensemble(images), k, tracker_of(method)), PRIOR, options(method)
            )
        )
        for k in range(20)
    ]
    # 800 stars: their variance is known to 5 %, so chi squared is a little wider; 99 % all same.
    assert_true_to_its_covariance(errors, 11)


@pytest.mark.parametrize('method', METHODS)
def test_an_image_that_loses_all_its_stars_spoils_nothing(method: str) -> None:
    noisy = with_noise(clean(), 1, tracker_of(method))
    wrong = noisy.images[4]
    rng = np.random.default_rng(3)
    scattered = dataclasses.replace(
        wrong.select(np.arange(len(wrong)) < 12),
        measured_px=rng.uniform(0, [639, 511], (12, 2)),
    )
    images = (*noisy.images[:4], scattered, *noisy.images[5:])
    found = estimate_calibration(Ensemble(images), PRIOR, options(method))
    left_out = Ensemble((*noisy.images[:4], *noisy.images[5:]))
    reference = estimate_calibration(left_out, PRIOR, options(method))
    rows = [*FREE, 10, 11, 12]
    sigma = np.sqrt(np.diag(reference.covariance))[rows]
    apart = np.abs(error_of(found, rows) - error_of(reference, rows)) / sigma
    assert apart.max() < 0.3
    assert np.isfinite(found.covariance).all()


def test_too_few_are_counted_for_a_person() -> None:
    two = Ensemble(tuple(image.select(np.arange(len(image)) < 7) for image in clean().images[:2]))
    with pytest.raises(TooFewObservations) as refused:
        check_enough(two, CalibrationOptions())
    assert str(refused.value) == (
        'too few observations: 1 more image (2 of 3 collected) and '
        '46 more stars (14 of 60 collected) needed; take more images, or find fainter stars '
        '(magnitude_limit, catalog)'
    )
    refused_too = Ensemble(clean().images[:2], {'no_match': 3, 'no_stars': 1})
    with pytest.raises(TooFewObservations) as refused:
        estimate_calibration(refused_too, PRIOR, CalibrationOptions())
    assert str(refused.value) == (
        'too few observations: 1 more image (2 of 3 collected) needed; 4 images refused; '
        'take more images'
    )
    check_enough(clean(), CalibrationOptions())


@each_method
def test_one_star_many_times_determines_nothing(method: str) -> None:
    first = clean().images[0]
    star = first.select(np.arange(len(first)) == 0)
    with pytest.raises(TooFewObservations, match='do not determine fx, skew, fy, ' + '.{,166}$'):
        estimate_calibration(Ensemble((star,) * 70), PRIOR, options(method))


@each_method
def test_stars_in_one_spot_leave_an_honest_uncertainty(method: str) -> None:
    def middle(image: StarObservations) -> StarObservations:
        return image.select(np.hypot(*(image.measured_px - [320, 256]).T) < 40)

    spot = with_noise(Ensemble(tuple(middle(image) for image in clean().images)), 1)
    # All ten parameters.
    chosen = CalibrationOptions(
        method=method, star_tracker_sigma_arcsec=TRACKER_ARCSEC, min_stars=10
    )
    found = estimate_calibration(spot, PRIOR, chosen)
    sigma = np.sqrt(np.diag(found.covariance))
    # 0.022 rad from the axis k1 moves nothing by 0.1 px before it is 5: nobody knows it.
    assert sigma[PARAMETER_NAMES.index('k1')] > 1.0
    assert np.abs(error_of(found, FREE) / sigma[FREE]).max() < 5


def test_fewer_residuals_than_unknowns() -> None:
    few = Ensemble(tuple(image.select(np.arange(len(image)) < 1) for image in clean().images))
    with pytest.raises(TooFewObservations, match='the stars do not determine'):
        estimate_calibration(few, PRIOR, options('per_image', min_stars=10))


def test_a_variance_that_moves_no_weight_holds_nothing_up() -> None:
    """Places of stars that are seen once: their variance creeps to zero for twenty rounds."""
    table = star_table(clean().images)
    kept = np.ones(len(table), bool)
    seen: Mask = np.ones(table.image_count, bool)
    none = np.zeros((table.image_count, 3))
    attitudes = Attitudes(none, np.zeros((len(none), 3, 3)), seen, ~seen, ())

    def judged(variance_px2: float, stars: Indices) -> weights.Weighting:
        share_px2 = np.full(len(stars), variance_px2)
        error = SharedError('star places', stars, share_px2, 0.0, True, 1.0)
        return weights.Weighting(CentroidVariance(1.0, 0.0), (error,), kept, attitudes)

    once = dataclasses.replace(table, star=np.arange(len(table)))
    assert weights.has_converged(judged(4e-6, once.star), judged(2e-6, once.star), once)
    often = dataclasses.replace(table, star=np.zeros(len(table), np.int64))
    assert not weights.has_converged(judged(4e-6, often.star), judged(2e-6, often.star), often)


class EnoughRounds(Exception):
    """The rounds of an estimate that a test looks at are done."""


def test_images_follow_a_velocity_in_a_partial_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A velocity is not in the state: it is at its mean though the state moves by a quarter."""
    whole: Callable[..., Any] = calibrate._round
    off_px: list[float] = []

    def partial(*arguments: Any) -> Any:
        last = whole(*arguments[:-1], 0.25)
        data, kept = arguments[0], arguments[3].kept
        image, residual_px = data.table.image[kept], last.residual_px[kept]
        means = [np.bincount(image, one) / np.bincount(image) for one in residual_px.T]
        off_px.append(float(np.abs(means).max()))
        if len(off_px) == 3:
            raise EnoughRounds
        return last

    monkeypatch.setattr(calibrate, '_round', partial)
    bright: dict[str, Any] = {'magnitude_limit': 6.0, 'zero_point_dn': 1.2e7}
    world = worlds.World(6, 'side_level', velocity_m_s=30000.0, **bright)
    made = worlds.simulate(world, 1)
    options = CalibrationOptions(star_tracker_sigma_arcsec=(20.0,) * 3, shutter='global')
    with pytest.raises(EnoughRounds):
        estimate_calibration(made.ensemble, made.scenario.prior, options)
    assert max(off_px) < 0.01
