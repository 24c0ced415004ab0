# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Residuals of images that the others predict, against calibrations without those images."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from random_pointings import estimated, of_random_pointings  # type: ignore[import-not-found]
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.assessment.cross_validation import cross_validation, predicted_residuals
from starcal_ros.camera import project
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.least_squares.normal_equations import arrange, whitening
from starcal_ros.records import Ensemble, ResidualBin
from starcal_ros.simulation.centroids import true_observations
from starcal_ros.simulation.scenario import Scenario


def bins_of(found: Estimate) -> tuple[ResidualBin, ...]:
    covariance = found.variance.of(found.table.covariance_px2, found.table.magnitude)
    measurements = arrange(found.table, found.kept, covariance)
    return cross_validation(found, measurements)


def without_image(given: Scenario, ensemble: Ensemble, k: int) -> Floats:
    """Whitened residuals (2, n) of image k under a calibration of the others."""
    others = Ensemble(tuple(one for i, one in enumerate(ensemble.images) if i != k))
    camera = estimated(given, others, variance_components=False).geometry.camera
    image = ensemble.images[k]
    wuu, wuv, wvv = whitening(image.covariance_px2)
    start = Rotation.from_quat(given.truth.star_tracker_from_camera_xyzw).inv() * (
        Rotation.from_quat(image.icrf_from_star_tracker_xyzw).inv()
    )

    def whitened(rotvec: Floats) -> Floats:
        seen = (Rotation.from_rotvec(rotvec) * start).apply(image.direction_icrf)
        u, v = (image.measured_px - project(camera, seen)).T
        return np.concatenate([wuu * u + wuv * v, wvv * v])

    return np.asarray(whitened(least_squares(whitened, np.zeros(3), xtol=1e-14).x).reshape(2, -1))


def test_the_linear_step_is_the_calibration_without_the_image() -> None:
    given = of_random_pointings(12, images=5)
    ensemble = true_observations(given)
    found = estimated(
        given, ensemble, variance_components=False, outlier_sigma=20.0, residual_field=False
    )
    measurements = arrange(found.table, found.kept, found.table.covariance_px2)
    squared, expected = predicted_residuals(found, measurements)
    for k in (0, 3):
        inside = (found.table.image == k) & found.kept
        assert inside.sum() == len(ensemble.images[k].measured_px)
        exact = (without_image(given, ensemble, k) ** 2).sum(axis=0)
        # The star tracker holds the rotation a little, which the step leaves free: 1e-3 sigma.
        np.testing.assert_allclose(np.sqrt(squared[inside]), np.sqrt(exact), atol=0.02)
    # Two a star, less the own rotation of five images, more the calibration of four.
    assert abs(expected[found.kept].mean() - 2.0) < 0.03


def test_a_sound_camera_is_as_predicted_in_every_part() -> None:
    bins = bins_of(estimated(given := of_random_pointings(13, images=6), true_observations(given)))
    assert {one.by for one in bins} == {'radius', 'magnitude', 'image'}
    for one in bins:
        # Twelve parts: one exceeds 3.5 sigma in 1 of 200 campaigns.
        assert abs(one.normalised - 1.0) < 3.5 * one.sigma, one


@pytest.mark.parametrize('by', ['radius', 'image'])
def test_a_part_that_scatters_more_is_named(by: str) -> None:
    given = of_random_pointings(14, images=8)
    rng = np.random.default_rng(14)
    images = []
    for k, image in enumerate(true_observations(given).images):
        radius_px = np.linalg.norm(image.measured_px - [647.5, 511.5], axis=1)
        worse = radius_px > 560.0 if by == 'radius' else np.full(len(radius_px), k >= 6)
        sigma_px = np.sqrt(image.covariance_px2[:, [0, 2]]) * 2.0 * worse[:, None]
        images.append(
            dataclasses.replace(
                image, measured_px=image.measured_px + sigma_px * rng.normal(size=sigma_px.shape)
            )
        )
    bins = [one for one in bins_of(estimated(given, Ensemble(tuple(images)))) if one.by == by]
    assert max(bins, key=lambda one: one.normalised) is bins[-1]
    assert bins[-1].normalised > 1.2 > 1.0 > bins[0].normalised
