# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Normal matrices, gradient and cost against the dense Jacobian."""

import dataclasses

from geometries import COEFFICIENTS  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.camera import CameraModel, project, project_jacobians
from starcal_ros.camera.lens import LENSES
from starcal_ros.estimation.star_equations import (
    arrange,
    normal_blocks,
    squared_sigmas,
    star_table,
    StarTable,
)
from starcal_ros.records import StarObservations

CAMERA_MODEL = CameraModel(
    1296, 1024, np.array([3640, 0.7, 3630, 640, 515, -0.05, 0.1, 0.2, 4e-4, -3e-4])
)
SIZES = (30, 0, 7, 1, 120, 0, 8, 30)  # stars of each image


def made(sizes: tuple[int, ...] = SIZES, seed: int = 1) -> tuple[StarTable, np.ndarray]:
    """Stars of some images with 1 px errors and correlated covariances, and rotations."""
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(len(sizes), random_state=seed)
    images: list[StarObservations] = []
    for n, rotation in zip(sizes, rotations, strict=True):
        xy = rng.uniform(-0.18, 0.18, (n, 2))
        e = np.concatenate([xy, np.ones((n, 1))], axis=1)
        e /= np.linalg.norm(e, axis=1)[:, None]
        L = np.tril(rng.normal(0, 0.05, (n, 2, 2))) + 0.1 * np.eye(2)
        C = L @ L.transpose(0, 2, 1)
        images.append(
            dataclasses.replace(
                StarObservations.of_image(0, (1296, 1024)),
                catalog_id=np.arange(n),
                direction_icrf=rotation.inv().apply(e).reshape(n, 3),
                measured_px=project(CAMERA_MODEL, e) + rng.normal(0, 1, (n, 2)),
                covariance_px2=np.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]], axis=-1),
            )
        )
    return star_table(images), rotations.as_matrix()


def dense_blocks(
    table: StarTable,
    keep: np.ndarray,
    camera: CameraModel,
    rotations: np.ndarray,
    loss_scale: float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Whitened squares (n,) and J' W J (m, p + 4, p + 4), weight 1 / (1 + s / c^2) by Cauchy."""
    size = len(camera.parameters) + 4
    blocks, squared = np.zeros((table.image_count, size, size)), []
    for k in np.nonzero(keep)[0]:
        R = rotations[table.image[k]]
        pixel, J_parameters, J_rotation = project_jacobians(camera, R @ table.direction_icrf[k])
        r = table.measured_px[k] - pixel
        W = np.linalg.inv(table.covariance_px2[k, [0, 1, 1, 2]].reshape(2, 2))
        J = np.concatenate([J_parameters, J_rotation, r[:, None]], axis=1)
        squared.append(r @ W @ r)
        blocks[table.image[k]] += J.T @ W @ J / (1.0 + squared[-1] / loss_scale**2)
    return np.array(squared), blocks


@pytest.mark.parametrize('model', LENSES)
def test_blocks_equal_the_dense_normal_matrices(model: str) -> None:
    table, rotations = made()
    parameters = np.r_[CAMERA_MODEL.parameters[:5], COEFFICIENTS[model]]
    camera = CameraModel(CAMERA_MODEL.width, CAMERA_MODEL.height, parameters, model)
    keep = np.random.default_rng(2).uniform(size=len(table)) < 0.8
    squared, expected = dense_blocks(table, keep, camera, rotations)
    measurements = arrange(table, keep, table.covariance_px2)
    # Parameters of each image, as where temperature changes them, are the same numbers.
    own = np.tile(parameters, (len(rotations), 1))
    unit = 1 / np.sqrt(np.einsum('mii->i', expected))
    for of_camera in (parameters, own):
        cost, blocks = normal_blocks(measurements, model, of_camera, rotations)
        assert cost == pytest.approx(0.5 * squared.sum(), rel=1e-12)
        # Sums of 120 products in another order: a few roundings of the diagonal.
        scaled = (blocks - expected) * np.outer(unit, unit)
        np.testing.assert_allclose(scaled, 0.0, rtol=0, atol=1e-11)
    for k, n in enumerate(np.bincount(table.image[keep], minlength=len(SIZES))):
        assert blocks[k].any() == (n > 0)


def of_stars(
    table: StarTable, keep: np.ndarray, rotations: np.ndarray
) -> tuple[float, np.ndarray]:
    """Cost and blocks of the kept stars in the usual camera."""
    measurements = arrange(table, keep, table.covariance_px2)
    return normal_blocks(measurements, 'plumb_bob', CAMERA_MODEL.parameters, rotations)


def test_images_spread_over_many_chunks_come_back_to_their_places() -> None:
    sizes = tuple(int(n) for n in np.random.default_rng(3).integers(0, 700, 30))
    table, rotations = made(sizes, seed=3)
    everything = np.ones(len(table), bool)
    assert len(arrange(table, everything, table.covariance_px2).chunks) > 3
    cost, together = of_stars(table, everything, rotations)
    alone = [of_stars(table, table.image == k, rotations) for k in range(len(sizes))]
    for k, (_, blocks) in enumerate(alone):
        np.testing.assert_allclose(together[k], blocks[k], rtol=1e-9, atol=1e-6)
    assert cost == pytest.approx(sum(one for one, _ in alone), rel=1e-12)


@pytest.mark.parametrize('loss_scale', [2.0, 0.5])
def test_the_robust_loss_is_cauchys(loss_scale: float) -> None:
    table, rotations = made()
    everything = np.ones(len(table), bool)
    squared, expected = dense_blocks(table, everything, CAMERA_MODEL, rotations, loss_scale)
    measurements = arrange(table, everything, table.covariance_px2)
    given = measurements, 'plumb_bob', CAMERA_MODEL.parameters, rotations
    cost, blocks = normal_blocks(*given, loss_scale)
    loss = loss_scale**2 * np.log(1 + squared / loss_scale**2)
    assert cost == pytest.approx(0.5 * loss.sum(), rel=1e-12)
    # With the residuals in the last column: its gradient too.  A few roundings of the diagonal.
    unit = 1 / np.sqrt(np.einsum('mii->i', expected))
    scaled = (blocks - expected) * np.outer(unit, unit)
    np.testing.assert_allclose(scaled, 0.0, rtol=0, atol=1e-11)
    # Far below its scale it is least squares: s / 2 c^2 = 1e-7 is left out at most.
    soft, _ = normal_blocks(*given, np.sqrt(0.5e7 * squared.max()))
    assert soft == pytest.approx(0.5 * squared.sum(), rel=1e-7)


def test_no_star_has_no_cost_and_one_behind_the_camera_no_finite_one() -> None:
    table, rotations = made((0, 0))
    cost, blocks = of_stars(table, np.zeros(0, bool), rotations)
    assert cost == 0.0 and blocks.shape == (2, 14, 14) and not blocks.any()
    table, rotations = made()
    rotations[4] = np.diag([1.0, -1.0, -1.0]) @ rotations[4]
    assert of_stars(table, np.ones(len(table), bool), rotations)[0] == np.inf


def test_lengths_in_sigma_are_those_of_the_inverse_covariances() -> None:
    table, _ = made()
    r = np.random.default_rng(5).normal(size=(len(table), 2))
    C = table.covariance_px2[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    expected = np.einsum('ni,nij,nj->n', r, np.linalg.inv(C), r)
    # The thinnest of these covariances have a condition of some hundreds.
    np.testing.assert_allclose(squared_sigmas(r, table.covariance_px2), expected, rtol=1e-9)
