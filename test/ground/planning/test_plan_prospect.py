# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What candidate images add to an estimate, against the estimator with these images."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from starcal_ground.planning.plan import expected_noise_px2, prospect, target
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario
from starcal_ros.assessment.requirements import MAP
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import OptionError
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import ALIGNMENT_NAMES, Ensemble

_OPTIONS = CalibrationOptions()


@pytest.fixture(scope='module')
def whole() -> Ensemble:
    return true_observations(scenario('tiny'))


def _estimate(images: Ensemble) -> Estimate:
    return estimate_calibration(images, scenario('tiny').prior, _OPTIONS)


@pytest.fixture(scope='module')
def first(whole: Ensemble) -> Estimate:
    return _estimate(dataclasses.replace(whole, images=whole.images[:8]))


def test_added_images_lower_the_sigma_as_the_estimator_says(
    whole: Ensemble, first: Estimate
) -> None:
    """Two more images of the same noise, but for amplitudes, which the estimator finds again."""
    found = prospect(first, whole.images[8:], _OPTIONS)
    after = _estimate(whole)
    for name in ('fx', 'k1', 'p1'):
        wanted = target(first, name)
        sigma = np.sqrt(found.variances([0, 1], wanted.squares))
        assert sigma[0] == pytest.approx(wanted.sigma(first.posterior.covariance))
        assert (np.diff(sigma) < 0).all()
        reported = target(after, name).sigma(after.posterior.covariance)
        assert sigma[2] == pytest.approx(reported, rel=0.15)  # noise and amplitudes found again


def test_the_turn_of_a_camera_without_rates_stays_in_the_sigma(whole: Ensemble) -> None:
    """All images share it: more of them do not take it away, as was promised before."""
    nowhere = np.full(3, np.nan)
    images = tuple(dataclasses.replace(o, star_tracker_rate_rad_s=nowhere) for o in whole.images)
    few = _estimate(dataclasses.replace(whole, images=images[:8]))
    found, wanted = prospect(few, images[8:], _OPTIONS), target(few, 'fy')
    after = _estimate(dataclasses.replace(whole, images=images))
    reported = target(after, 'fy').sigma(after.posterior.covariance)
    expected = np.sqrt(found.variances([0, 1], wanted.squares))[2]
    assert expected == pytest.approx(reported, rel=0.15)  # as above


def test_the_best_candidate_is_the_one_whose_variance_is_least(
    whole: Ensemble, first: Estimate
) -> None:
    found = prospect(first, whole.images, _OPTIONS)
    wanted = target(first, MAP)
    every = np.ones(10, bool)
    each = [float(found.variances([k], wanted.squares)[-1]) for k in range(10)]
    best = found.best([], every, wanted.squares)
    assert best == int(np.argmin(each))
    without = every.copy()
    without[best] = False
    assert found.best([], without, wanted.squares) == int(np.argsort(each)[1])


def test_information_does_not_depend_on_the_order_of_the_candidates(
    whole: Ensemble, first: Estimate
) -> None:
    """Also of images with other numbers of stars, which share chunks."""
    ahead = prospect(first, whole.images, _OPTIONS).information
    back = prospect(first, whole.images[::-1], _OPTIONS).information
    np.testing.assert_allclose(ahead, back[::-1], atol=1e-9 * ahead.max())  # order of sums


def test_sigmas_have_the_names_and_units_of_requirements(first: Estimate) -> None:
    """The map has a smaller one than lines of sight, which have the alignment."""
    covariance = first.posterior.covariance

    def planned(name: str, unit: str) -> float:
        wanted = target(first, name)
        assert wanted.name == name + unit
        return wanted.sigma(covariance)

    assert planned('map', '_arcsec') < planned('line_of_sight', '_arcsec')
    assert planned('pointing', '_arcsec') == planned('line_of_sight', '_arcsec')
    names = (*first.geometry.camera.parameter_names, *ALIGNMENT_NAMES)
    sigma = dict(zip(names, np.sqrt(np.diag(first.covariance)), strict=True))
    for name, unit, expected in (
        ('k1', '', sigma['k1']),
        ('fx', '_px', sigma['fx']),
        ('f', '_px', np.hypot(sigma['fx'], sigma['fy']) / np.sqrt(2.0)),
        ('alignment_y', '_arcsec', sigma['alignment_y'] / ARCSECOND_RAD),
    ):
        assert planned(name, unit) == pytest.approx(expected, rel=1e-9)  # rounding
    allowed = 'one of: line_of_sight, map, pointing, f, fx, .*, alignment_z, k1, k2, k3, p1, p2$'
    with pytest.raises(OptionError, match=f"^'k9' is not estimated; .* is {allowed}"):
        target(first, 'k9')


def test_expected_noise_is_that_of_stars_of_about_the_magnitude(first: Estimate) -> None:
    table = first.table
    expected = expected_noise_px2(first, table.magnitude.astype(float))
    real = first.covariance_px2[:, [0, 2]].mean(axis=1)
    # Their information in all, which decides: to 5 %, of the steps between the groups.
    assert (1.0 / expected).sum() == pytest.approx((1.0 / real).sum(), rel=0.05)
    faint_first = expected_noise_px2(first, np.array([9.0, 6.0, 4.0]))
    assert (np.diff(faint_first) < 0).all()
