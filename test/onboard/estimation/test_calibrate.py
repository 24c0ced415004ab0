# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibrations of observations whose truth is known: exact, unbiased, and true to their sigma."""

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import functools
from typing import Any

from geometries import turned  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from worlds import each_image, errors_of, normalised, normalised_error, options_of, with_noise  # type: ignore[import-not-found]

from starcal_ground.simulation.centroids import (
    bound_names,
    cramer_rao_covariance,
    true_observations,
)
from starcal_ground.simulation.scenario import scenario
from starcal_ros.arrays import Floats
from starcal_ros.camera import line_of_sight, PARAMETER_NAMES, pixel_grid, project_jacobians
from starcal_ros.errors import TooFewObservations
from starcal_ros.estimation import calibrate
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, check_enough, estimated_parameters
from starcal_ros.estimation.posterior import still_to_move
from starcal_ros.estimation.problem import METHODS
from starcal_ros.records import CameraGeometry, Ensemble, StarObservations
from starcal_ros.sky.catalog import load_catalog
from studies import missions, worlds

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
ESTIMATED = [*FREE, 10, 11, 12]
# Number of trials of a method, and the true sigma of the centroids over the stated one.
TRIALS = {'hierarchical': (24, 1.0), 'single': (16, 0.5), 'per_image': (8, 2.0)}
each_method = pytest.mark.parametrize('method', METHODS)


@functools.cache
def clean() -> Ensemble:
    """Ten images, 3900 stars, at their true places."""
    return true_observations(SCENARIO, centroid_noise=False, attitude_noise=False)


def options(method: str, **other: object) -> CalibrationOptions:
    tracker_arcsec = (1e-3,) * 3 if method == 'single' else TRACKER_ARCSEC
    values: dict[str, object] = {'star_tracker_sigma_arcsec': tracker_arcsec, **other}
    return dataclasses.replace(EIGHT, method=method, **values)  # type: ignore[arg-type]


def estimated(ensemble: Ensemble, method: str, **other: object) -> Estimate:
    return estimate_calibration(ensemble, PRIOR, options(method, **other))


def apart_sigma(one: Estimate, other: Estimate) -> float:
    """Largest difference of two estimates, in sigma of the second."""
    difference = errors_of(one, TRUTH) - errors_of(other, TRUTH)
    sigma = np.sqrt(np.diag(other.covariance))
    return float(np.abs(difference[ESTIMATED] / sigma[ESTIMATED]).max())


def tracker_of(method: str) -> tuple[float, ...]:
    """Star-tracker sigma that the method assumes: zero, or the option."""
    return (0.0, 0.0, 0.0) if method == 'single' else TRACKER_ARCSEC


@dataclass(frozen=True)
class Trial:
    """The numbers of an estimate that tests look at: the whole has ten megabytes."""

    geometry: CameraGeometry
    covariance: Floats
    termination: str
    rejected: int
    variance_factor: float


@functools.cache
def trials(method: str) -> tuple[Trial, ...]:
    count, centroid_scale = TRIALS[method]
    made = []
    for k in range(count):
        found = estimated(with_noise(clean(), k, tracker_of(method), centroid_scale), method)
        numbers = found.termination, int((~found.kept).sum()), found.variance_factor
        made.append(Trial(found.geometry, found.covariance, *numbers))
    return tuple(made)


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
    prior = dataclasses.replace(turned(TRUTH, off), camera=prior_camera)
    found = estimate_calibration(clean(), prior, options(method, estimate=estimate))
    assert found.termination == 'converged' and found.kept.all()
    error = errors_of(found, TRUTH)
    # 1e-9 of each term at the edge of the field (r = 0.23, f = 1800 px) and of a radian.
    fx, r = TRUTH.camera.parameters[0], 0.23
    effect_px = np.array(
        [r, r, r, 1, 1, fx * r**3, fx * r**5, fx * r**7, fx * r**2, fx * r**2, fx, fx, fx]
    )
    assert np.abs(error * effect_px).max() < 1e-9 * fx
    assert np.abs(found.residual_px).max() < 1e-8


def test_the_order_of_the_names_does_not_matter() -> None:
    noisy = with_noise(clean(), 1, TRACKER_ARCSEC)
    one, other = (estimated(noisy, 'hierarchical', estimate=o) for o in (NAMES, NAMES[::-1]))
    np.testing.assert_array_equal(one.geometry.camera.parameters, other.geometry.camera.parameters)
    np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.slow
@pytest.mark.parametrize('method', TRIALS)
def test_the_reported_covariance_is_true(method: str) -> None:
    """For all, the camera and the alignment; centroid covariances wrong by four are rescaled."""
    estimates = trials(method)
    assert {e.termination for e in estimates} == {'converged'}
    for rows in (ESTIMATED, FREE, [10, 11, 12]):
        errors = [normalised_error(e, TRUTH, rows) for e in estimates]
        assert_true_to_its_covariance(errors, len(rows))
    # Normal noise loses next to no star: 4.5 sigma of two dimensions is passed by 4e-5 of them.
    assert np.mean([e.rejected for e in estimates]) < 3.0
    # 7,800 residuals give the scale to 1.6 %, 8 trials to 0.6 %; three of those.
    factor, centroid_scale = np.mean([e.variance_factor for e in estimates]), TRIALS[method][1]
    assert factor == pytest.approx(centroid_scale**2, rel=0.02)


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
    errors = np.array([errors_of(e, TRUTH)[FREE] for e in trials('hierarchical')])
    found_px2 = ((errors @ J.T) ** 2).mean()
    # Some 8 independent modes in 24 trials: the ratio is known to 5 %, and the interval is that
    # of 99 % of chi squared, as below.
    low, high = chi2.ppf([0.005, 0.995], 8 * len(errors)) / (8 * len(errors))
    assert low < found_px2 / expected_px2 < high
    assert_true_to_its_covariance([normalised(error, bound) for error in errors], 8)
    # What is reported has no such chance: the field that stars cannot exclude adds a few percent.
    reported_px2 = [
        np.einsum('ni,ij,nj->', J, e.covariance[np.ix_(FREE, FREE)], J) / len(J)
        for e in trials('hierarchical')
    ]
    assert 1.0 < np.sqrt(np.median(reported_px2) / expected_px2) < 1.1


def anywhere(k: int, n: int) -> Floats:
    """One of ten stars, by 5 to 50 px."""
    rng = np.random.default_rng([2, k])
    far = rng.uniform(5, 50, n) * (rng.uniform(size=n) < 0.1)
    angle = rng.uniform(0, 2 * np.pi, n)
    return np.asarray(far[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1))


def to_the_right(k: int, n: int) -> Floats:
    """Two of five stars, all by 15 px: a mean is dragged along, a robust loss is not."""
    moved = np.random.default_rng([5, k]).uniform(size=n) < 0.4
    return np.asarray(np.outer(moved, [15.0, 0.0]))


@pytest.mark.parametrize(
    ('method', 'shift'),
    [('single', anywhere), ('hierarchical', to_the_right), ('per_image', to_the_right)],
)
def test_gross_outliers_are_left_out(method: str, shift: Callable[[int, int], Floats]) -> None:
    noisy = with_noise(clean(), 1, tracker_of(method))
    shifts = [shift(k, len(image)) for k, image in enumerate(noisy.images)]
    images = each_image(noisy, lambda k, image: {'measured_px': image.measured_px + shifts[k]})
    bad = [one.any(axis=1) for one in shifts]
    found, moved = estimated(images, method), np.concatenate(bad)
    assert not found.kept[moved].any()
    assert np.count_nonzero(~found.kept[~moved]) <= 4
    # Against the minimum without those stars there is nothing left to excuse.
    without = tuple(one.select(~gone) for one, gone in zip(noisy.images, bad, strict=True))
    assert apart_sigma(found, estimated(Ensemble(without), method)) < 0.05


@pytest.mark.parametrize('method', ['hierarchical', 'single'])
def test_an_image_that_loses_all_its_stars_spoils_nothing(method: str) -> None:
    noisy = with_noise(clean(), 1, tracker_of(method))
    wrong = noisy.images[4]
    rng = np.random.default_rng(3)
    few = wrong.select(np.arange(len(wrong)) < 12)
    scattered = dataclasses.replace(few, measured_px=rng.uniform(0, [639, 511], (12, 2)))
    images = (*noisy.images[:4], scattered, *noisy.images[5:])
    found = estimated(Ensemble(images), method)
    left_out = Ensemble((*noisy.images[:4], *noisy.images[5:]))
    assert apart_sigma(found, estimated(left_out, method)) < 0.3
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
    words = r'1 more image \(2 of 3 collected\) needed; 4 images refused; take more images$'
    with pytest.raises(TooFewObservations, match=words):
        estimate_calibration(refused_too, PRIOR, CalibrationOptions())
    check_enough(clean(), CalibrationOptions())


@each_method
def test_one_star_many_times_determines_nothing(method: str) -> None:
    first = clean().images[0]
    star = first.select(np.arange(len(first)) == 0)
    with pytest.raises(TooFewObservations, match='do not determine fx, skew, fy, ' + '.{,166}$'):
        estimated(Ensemble((star,) * 70), method)


@each_method
def test_stars_in_one_spot_leave_an_honest_uncertainty(method: str) -> None:
    def middle(image: StarObservations) -> StarObservations:
        return image.select(np.hypot(*(image.measured_px - [320, 256]).T) < 40)

    spot = with_noise(Ensemble(tuple(map(middle, clean().images))), 1, TRACKER_ARCSEC)
    tracker: dict[str, Any] = {'star_tracker_sigma_arcsec': TRACKER_ARCSEC}
    # All ten parameters.
    chosen = CalibrationOptions(method=method, min_stars=10, **tracker)
    found = estimate_calibration(spot, PRIOR, chosen)
    sigma = np.sqrt(np.diag(found.covariance))
    # 0.022 rad from the axis k1 moves nothing by 0.1 px before it is 5: nobody knows it.
    assert sigma[PARAMETER_NAMES.index('k1')] > 1.0
    assert np.abs(errors_of(found, TRUTH)[FREE] / sigma[FREE]).max() < 5


def test_an_estimate_is_settled_where_neither_unknowns_nor_sigmas_move() -> None:
    found = estimate_calibration(clean(), PRIOR, EIGHT).posterior
    sigma = np.sqrt(np.diag(found.covariance))
    still = dataclasses.replace(found, mean=0.01 * sigma)
    assert still_to_move(still, found, None)[1].max() < 1.0
    stepping = dataclasses.replace(found, mean=0.1 * sigma)
    last, left = still_to_move(stepping, found, None)
    assert left.max() == pytest.approx(2.0)
    # After changes ten times as large, a ninth of these is to come.
    assert still_to_move(stepping, found, 10.0 * last)[1].max() == pytest.approx(2.0 / 9.0)
    wider = dataclasses.replace(still, working=1.1 * found.working)
    assert still_to_move(wider, found, None)[1].max() > 4.0


def test_weights_follow_the_state_that_is_taken() -> None:
    """By the weights of whole steps, the damped steps of this campaign alternate for ever."""
    world = missions.drawn(seed=1, mission=118, sound=False)
    made = worlds.simulate(world, 1118)
    chosen = options_of(made.scenario, shutter=world.shutter)
    colours_of = load_catalog().colours_bp_rp
    found = estimate_calibration(made.ensemble, made.scenario.prior, chosen, colours_of)
    assert found.termination == 'converged'


def test_images_follow_a_velocity_in_a_partial_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A velocity is not in the state: it is at its mean though the state moves by a quarter."""
    whole: Callable[..., Any] = calibrate._round
    off_px: list[float] = []

    def partial(*arguments: Any) -> Any:
        last = whole(*arguments[:-1], 0.25)
        kept = arguments[3].kept
        image, residual_px = arguments[0].table.image[kept], last.residual_px[kept]
        means = [np.bincount(image, one) / np.bincount(image) for one in residual_px.T]
        off_px.append(float(np.abs(means).max()))
        return last

    monkeypatch.setattr(calibrate, '_round', partial)
    bright: dict[str, Any] = {'magnitude_limit': 6.0, 'zero_point_dn': 1.2e7}
    world = worlds.World(6, 'side_level', velocity_m_s=30000.0, **bright)
    made = worlds.simulate(world, 1)
    options = CalibrationOptions(star_tracker_sigma_arcsec=(20.0,) * 3, shutter='global')
    estimate_calibration(made.ensemble, made.scenario.prior, options)
    assert max(off_px) < 0.01
