# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What an ensemble can tell, against the solve itself, brute force and Monte Carlo."""

import dataclasses
import functools

from geometries import turned  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import cramer_rao_covariance, true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.assessment.observability import (
    coverage,
    ensemble_status,
    image_information,
    keep_most_informative,
    map_sigma_px,
    predicted_sigma,
    weakest_direction,
)
from starcal_ros.camera import PARAMETER_NAMES
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions, estimated_parameters
from starcal_ros.records import Ensemble, MapCovariance

SCENARIO = scenario('tiny', seed=4)
PRIOR, TRUTH = SCENARIO.prior, SCENARIO.truth
# A prediction has no unknown velocity.
DEFAULT = CalibrationOptions(
    star_tracker_sigma_arcsec=SCENARIO.star_tracker_sigma_arcsec,
    star_tracker_slow_arcsec=0.1,
    velocity_sigma_m_s=10.0,
)
# Eight parameters without a prior, those of the Cramer-Rao bound.
OPTIONS = dataclasses.replace(DEFAULT, estimate=('fx', 'skew', 'fy', 'distortion'), lens_prior=0.0)
NAMES = estimated_parameters(OPTIONS, 'plumb_bob')
FREE = [k for k, name in enumerate(PARAMETER_NAMES) if name in NAMES]


@functools.cache
def ensemble() -> Ensemble:
    return true_observations(SCENARIO)


@functools.cache
def covariance(options: CalibrationOptions = OPTIONS) -> np.ndarray:
    return estimate_calibration(ensemble(), PRIOR, options).covariance


SLOW_NOT_STATED = dataclasses.replace(DEFAULT, star_tracker_slow_arcsec=0.0)


@pytest.mark.parametrize(
    'options', [OPTIONS, DEFAULT, SLOW_NOT_STATED], ids=['eight', 'default', 'slow not stated']
)
def test_predicted_sigma_is_that_of_the_solve(options: CalibrationOptions) -> None:
    # At the prior instead of the solution, with centroid variances as given: 20 % is promised.
    found = predicted_sigma(ensemble(), PRIOR, options)
    names = estimated_parameters(options, 'plumb_bob')
    estimated = [k for k, name in enumerate(PARAMETER_NAMES) if name in names] + [10, 11, 12]
    np.testing.assert_allclose(found, np.sqrt(np.diag(covariance(options)))[estimated], rtol=0.20)


@pytest.mark.parametrize('method', ['hierarchical', 'per_image'])
def test_priors_and_considered_parameters_are_in_the_prediction(method: str) -> None:
    sigma = dict.fromkeys(PARAMETER_NAMES, 0.0) | {'k3': 0.1, 'cx': 2.0}
    options = dataclasses.replace(
        OPTIONS, method=method, prior_sigma=tuple(sigma.values()), variance_components=False
    )
    solved = estimate_calibration(ensemble(), TRUTH, options).covariance
    expected = np.sqrt(np.diag(solved))[[*FREE, 10, 11, 12]]
    # The field, changes from image to image and finer structure, which are not in a prediction,
    # take a part; the sigma of the star tracker is that of ten images.
    np.testing.assert_allclose(predicted_sigma(ensemble(), TRUTH, options), expected, rtol=0.25)


def test_predicted_sigma_at_the_truth_is_the_cramer_rao_bound() -> None:
    # The attitudes are those of the tracker, 40 arcsec off: 2e-4 of a derivative.
    apart = dataclasses.replace(OPTIONS, method='per_image')
    found = predicted_sigma(ensemble(), TRUTH, apart)[:8]
    bound = np.sqrt(np.diag(cramer_rao_covariance(SCENARIO)))
    np.testing.assert_allclose(found, bound, rtol=0.01)


def of_stars(*counts: int) -> Ensemble:
    """Images of the first stars of one."""
    first = ensemble().images[0]
    return Ensemble(tuple(first.select(np.arange(len(first)) < count) for count in counts))


def test_what_cannot_be_known_is_infinite() -> None:
    for few in (Ensemble(), *map(of_stars, range(4))):
        assert np.isinf(predicted_sigma(few, PRIOR, OPTIONS)).all(), few
    # A wrong alignment by 180 degrees must not pass for a perfect calibration.
    behind = turned(PRIOR, Rotation.from_euler('x', 180, degrees=True))
    assert np.isinf(predicted_sigma(ensemble(), behind, OPTIONS)).all()
    # A first star tracker without images leaves the camera known.
    images = tuple(dataclasses.replace(one, star_tracker='second') for one in ensemble().images)
    assert np.isfinite(predicted_sigma(Ensemble(images), PRIOR, OPTIONS)[:-3]).all()


def test_images_of_fewer_than_three_stars_tell_nothing() -> None:
    images = of_stars(0, 2, 3, 50).images
    information = image_information(images, PRIOR, OPTIONS)
    assert not information[:2].any()
    assert (np.diag(information[2]) > 0).all()
    alone = image_information(images[3:], PRIOR, OPTIONS)[0]
    np.testing.assert_allclose(information[3], alone, rtol=1e-9, atol=1e-9 * np.abs(alone).max())


def test_the_status_says_what_was_collected() -> None:
    some = Ensemble(ensemble().images[:4], {'no_match': 2})
    status = ensemble_status(some, PRIOR, OPTIONS)
    assert (status.images, status.stars) == (4, sum(len(i) for i in some.images))
    assert (status.min_images, status.min_stars) == (OPTIONS.min_images, OPTIONS.min_stars)
    assert status.time_ns == some.images[-1].time_ns
    assert status.refused == {'no_match': 2}
    assert status.coverage.sum() == status.stars
    assert len(status.predicted_sigma) == len(status.parameter_names) == 11
    # Tracker errors of 10, 10 and 40 arcsec in four images, in the axes of the camera; stars and
    # camera add 3 arcsec or so.
    mounting = PRIOR.star_tracker_from_camera.as_matrix()
    tracker = mounting.T @ np.diag(np.square(SCENARIO.star_tracker_sigma_arcsec)) @ mounting
    arcsec = status.predicted_sigma[-3:] / ARCSECOND_RAD
    assert (arcsec**2 > np.diag(tracker) / 4).all()
    assert (arcsec**2 < np.diag(tracker) / 4 + 3.0**2).all()
    empty = ensemble_status(Ensemble(), PRIOR, OPTIONS)
    assert empty.images == 0 and np.isinf(empty.predicted_sigma).all()
    assert empty.coverage.shape == (8, 10) and not empty.coverage.any()


def test_coverage_equals_counting() -> None:
    """With a star in each corner of the detector."""
    camera = PRIOR.camera
    u, v = camera.width - 0.51, camera.height - 0.51
    corners = np.array([[-0.49, -0.49], [u, -0.49], [-0.49, v], [u, v]])
    (four,) = of_stars(4).images
    images = *ensemble().images, dataclasses.replace(four, measured_px=corners)
    expected = np.zeros((8, 10), int)
    for u, v in np.concatenate([image.measured_px for image in images]):
        expected[int((v + 0.5) / camera.height * 8), int((u + 0.5) / camera.width * 10)] += 1
    np.testing.assert_array_equal(coverage(Ensemble(images), camera), expected)


def test_the_map_does_not_mind_what_the_alignment_takes_up() -> None:
    # The principal point unknown by 20 px, the alignment turned so as to undo it.
    C = np.zeros((13, 13))
    C[3, 3] = 20.0**2
    fx = TRUTH.camera.parameters[0]
    left_px = map_sigma_px(TRUTH.camera, MapCovariance(C))
    # Off the axis by r a turn shears by r^2: what 20 px leave at the corner (r = 0.23) is 1 px.
    assert 0.1 < left_px.max() < 20.0 * 0.23**2 * 1.5
    C[11, 11] = (20.0 / fx) ** 2
    C[3, 11] = C[11, 3] = 20.0 * 20.0 / fx
    np.testing.assert_array_equal(map_sigma_px(TRUTH.camera, MapCovariance(C)), left_px)


def least_mean_variance(information: np.ndarray, count: int, unit: np.ndarray) -> float:
    """
    Lower bound of the mean variance from ``count`` of the images (m, k, k), in ``unit`` (k,)^2.

    A-optimal design, relaxed to weights: convex, so a tangent at any weights is a lower bound.
    Frank-Wolfe: the minimum of a tangent is a choice of ``count`` whole images.
    """
    scaled = information * unit[:, None] * unit[None, :]
    weight = np.full(len(scaled), count / len(scaled))
    best = 0.0
    for step in range(400):  # a gap of some 0.1 %
        inverse = np.linalg.inv(np.einsum('m,mij->ij', weight, scaled))
        gradient = -np.einsum('ij,mjk,ki->m', inverse, scaled, inverse)
        least = np.argsort(gradient)[:count]
        best = max(best, np.trace(inverse) - gradient @ weight + gradient[least].sum())
        vertex = np.isin(np.arange(len(scaled)), least)
        weight += (vertex - weight) * 2.0 / (step + 2.0 + count)
    return best / len(unit)


@pytest.mark.parametrize(
    ('m', 'count'),
    [(30, 8), pytest.param(200, 40, marks=[pytest.mark.slow, pytest.mark.packaging])],
)
def test_images_kept_from_a_stream_are_nearly_the_best_choice(m: int, count: int) -> None:
    """Within 5 % in sigma of what any choice reaches, and better than a random one."""
    night = dataclasses.replace(
        scenario('paper'), image_count=m, cadence_s=86000.0 / m, magnitude_limit=6.65
    )
    everything, prior = true_observations(night, 0.1), night.prior
    # All images share a slow error, which no choice makes smaller.
    options = CalibrationOptions(
        star_tracker_sigma_arcsec=(20.0,) * 3, star_tracker_slow_arcsec=1e-6, max_images=count
    )
    whole = predicted_sigma(everything, prior, options)
    information = image_information(everything.images, prior, options)
    best = np.sqrt(least_mean_variance(information, count, whole))

    def relative(sigma: np.ndarray) -> float:
        return float(np.sqrt(np.mean((sigma / whole) ** 2)))

    streamed = Ensemble()
    for image in everything.images:
        streamed = keep_most_informative(streamed.add(image), prior, options)
    kept = relative(predicted_sigma(streamed, prior, options))
    rng = np.random.default_rng(1)
    at_random = np.mean(
        [
            relative(np.sqrt(np.diag(np.linalg.inv(information[rows].sum(axis=0)))))
            for rows in (rng.choice(m, count, replace=False) for _ in range(200))
        ]
    )
    # A lower bound is under every choice; 1e-9 is its rounding.
    assert best * (1.0 - 1e-9) < kept < 1.05 * best
    at_once = predicted_sigma(keep_most_informative(everything, prior, options), prior, options)
    assert best * (1.0 - 1e-9) < relative(at_once)
    assert kept < at_random


def test_the_image_that_is_left_out_is_worth_least() -> None:
    """By the definition, in units in which all unknowns are of one size."""
    images = tuple(
        one.select(np.arange(len(one)) % step == 0)
        for one, step in zip(ensemble().images, (9, 6, 8, 5, 7, 9, 6, 5, 8, 7), strict=True)
    )
    information = image_information(images, PRIOR, OPTIONS)
    left = list(range(len(images)))
    while len(left) > 4:
        total = information[left].sum(axis=0)
        unit = 1.0 / np.sqrt(np.diag(total))
        scaled = information[left] * np.outer(unit, unit)
        worth = [np.trace(np.linalg.solve(scaled.sum(axis=0), one)) for one in scaled]
        del left[int(np.argmin(worth))]
    limit = dataclasses.replace(OPTIONS, max_images=4)
    kept = keep_most_informative(Ensemble(images, {'no_match': 1}), PRIOR, limit)
    assert kept.refused == {'no_match': 1}
    assert [one.time_ns for one in kept.images] == [images[k].time_ns for k in left]


def test_the_weakest_direction_is_named_with_its_loss() -> None:
    C = np.array([[4.0, -5.7, 0.0], [-5.7, 9.0, 0.0], [0.0, 0.0, 1.0]])  # correlation -0.95
    singular, text = weakest_direction(np.linalg.inv(C), ('fx', 'cx', 'k1'))
    np.testing.assert_allclose(singular, np.sqrt([1.95, 1.0, 0.05]))
    assert 'fx (' in text and 'cx (' in text and 'k1' not in text
    assert 'nearly indistinguishable: their combination has 4 times the sigma' in text
    _, alone = weakest_direction(np.diag([1.0, 2.0]), ('fx', 'cx'))
    assert alone.endswith('(+1.00), uncorrelated with the others')


def test_images_are_let_go_beyond_the_limit_before_anything_is_observable() -> None:
    kept = keep_most_informative(ensemble(), PRIOR, dataclasses.replace(OPTIONS, max_images=10))
    assert kept.images == ensemble().images
    limit = dataclasses.replace(OPTIONS, max_images=3)
    kept = keep_most_informative(of_stars(1, 0, 3, 1, 4), PRIOR, limit)
    assert [len(image) for image in kept.images][-1] == 4
    assert 3 in [len(image) for image in kept.images]
