# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated centroids and their bounds against statistics and least squares."""

import dataclasses
import math

import numpy as np
import pytest
from sample_sky import QUIET  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.centroids import (
    bound_names,
    centroid_bound,
    cramer_rao_covariance,
    true_observations,
)
from starcal_ground.simulation.rendering import expose, star_electrons
from starcal_ground.simulation.scenario import camera_from_icrf, scenario
from starcal_ros.camera import project, project_jacobians
from starcal_ros.sky.catalog import load_catalog


def test_observations_are_exact_without_noise() -> None:
    tiny = dataclasses.replace(scenario('tiny'), image_count=3)
    ensemble = true_observations(tiny, centroid_noise=False, attitude_noise=False)
    assert len(ensemble.images) == 3 and ensemble.star_count > 100
    camera_from_tracker = Rotation.from_quat(tiny.truth.star_tracker_from_camera_xyzw).inv()
    for image in ensemble.images:
        attitude = Rotation.from_quat(image.icrf_from_star_tracker_xyzw).inv()
        in_camera = (camera_from_tracker * attitude).apply(image.direction_icrf)
        assert np.allclose(project(tiny.truth.camera, in_camera), image.measured_px, atol=1e-9)
        assert image.snr.min() > 5
        assert image.catalog_digest == load_catalog().digest


def test_observations_have_the_noise_they_report() -> None:
    tiny = scenario('tiny')
    exact = true_observations(tiny, centroid_noise=False)
    for sigma_px in (None, 0.2):
        noisy = true_observations(tiny, sigma_px)
        chi2 = count = 0.0
        for a, b in zip(noisy.images, exact.images, strict=True):
            assert np.array_equal(a.catalog_id, b.catalog_id)
            uu, uv, vv = a.covariance_px2.T
            du, dv = (a.measured_px - b.measured_px).T
            chi2 += float(((vv * du**2 - 2 * uv * du * dv + uu * dv**2) / (uu * vv - uv**2)).sum())
            count += 2 * len(a)
        assert abs(chi2 / count - 1) < 5 * math.sqrt(2 / count)  # 5 standard errors of chi^2
        if sigma_px:
            assert np.allclose(noisy.images[0].covariance_px2, [0.04, 0.0, 0.04])


@pytest.mark.parametrize(('electrons', 'phase'), [(300.0, 0.0), (3000.0, 0.5), (30000.0, 0.23)])
def test_the_bound_is_the_scatter_of_fits_to_noisy_stars(electrons, phase) -> None:
    """Least-squares steps are efficient: they scatter by it if derivatives and noise are right."""
    side, count = 13, 3000
    place = np.array([[6.0 + phase, 6.0 - phase]])
    flux = np.array([electrons])

    def mean_of(u: float, v: float, f: float) -> np.ndarray:
        star = star_electrons(np.array([[u, v]]), np.array([f]), QUIET.psf_sigma_px, (side, side))
        return np.asarray(star + QUIET.background_electrons)

    (u, v), h = place[0], 1e-4
    mean = mean_of(u, v, electrons)
    J = np.stack(
        [
            (mean_of(u + h, v, electrons) - mean_of(u - h, v, electrons)) / (2 * h),
            (mean_of(u, v + h, electrons) - mean_of(u, v - h, electrons)) / (2 * h),
            (mean - QUIET.background_electrons) / electrons,
        ],
        axis=-1,
    ).reshape(-1, 3)
    stack = expose(np.broadcast_to(mean, (count, side, side)), QUIET, np.random.default_rng(9))
    data = (stack.astype(np.float64) - QUIET.offset_dn) * QUIET.electrons_per_dn - mean
    weight = 1 / (mean.ravel() + QUIET.noise_electrons**2 - QUIET.background_electrons)
    N = J.T @ (weight[:, None] * J)
    errors = data.reshape(count, -1) @ (weight[:, None] * J) @ np.linalg.inv(N)
    covariance, snr = centroid_bound(place, flux, QUIET, (side, side))
    scatter = np.cov(errors, rowvar=False)
    # 5 standard errors of a variance over 3000 draws: 13 per cent.
    assert np.allclose(np.diag(scatter)[:2], np.diag(covariance[0]), rtol=5 * math.sqrt(2 / count))
    assert electrons / math.sqrt(scatter[2, 2]) == pytest.approx(
        snr[0], rel=5 / math.sqrt(2 * count)
    )


def test_saturated_and_absent_stars_have_no_use() -> None:
    place = np.array([[20.0, 20.0], [20.0, 20.0], [-30.0, 20.0], [-0.5, 20.0]])
    flux = np.array([1e4, 1e8, 1e4, 1e4])
    covariance, snr = centroid_bound(place, flux, QUIET, (40, 40))
    normal, saturated, absent, at_border = covariance[:, 0, 0]
    assert normal < 1e-2 < normal * 1e2
    assert saturated > normal / 1e4  # its wings still tell something, its core nothing
    assert absent > 1e3 and snr[2] < 0.01
    assert at_border > 1.5 * normal  # half of its light


def test_parameter_bound_is_the_inverse_of_the_dense_information_matrix() -> None:
    tiny = dataclasses.replace(scenario('tiny'), image_count=3)
    N = np.zeros((17, 17))  # eight parameters of the camera, and the rotation of each image
    for index, image in enumerate(true_observations(tiny).images):
        in_camera = image.direction_icrf @ camera_from_icrf(tiny, index).T
        _, J_parameters, J_rotation = project_jacobians(tiny.truth.camera, in_camera)
        J = np.zeros((len(image), 2, 17))
        J[..., :8] = J_parameters[..., [0, 1, 2, 5, 6, 7, 8, 9]]
        J[..., 8 + 3 * index : 11 + 3 * index] = J_rotation
        weight = np.linalg.inv(image.covariance_px2[:, [0, 1, 1, 2]].reshape(-1, 2, 2))
        N += np.einsum('nip,nij,njq->pq', J, weight, J)
    scale = 1 / np.sqrt(np.diag(N))
    dense = np.linalg.inv(N * np.outer(scale, scale)) * np.outer(scale, scale)
    bound = cramer_rao_covariance(tiny)
    # The scaled matrix has a condition of about 1e6: 1e-16 of rounding becomes 1e-10.
    assert np.allclose(bound, dense[:8, :8], rtol=1e-7, atol=0)
    assert len(bound_names(tiny.truth.camera)) == len(bound)
