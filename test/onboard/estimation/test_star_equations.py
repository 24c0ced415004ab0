# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Normal matrices and cost against the dense Jacobian."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.camera import CameraModel, project, project_jacobians
from starcal_ros.camera.lens import LENSES
from starcal_ros.estimation.star_equations import (
    arrange,
    normal_blocks,
    ROTATION,
    squared_sigmas,
    star_table,
    StarTable,
    whitening,
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
    table: StarTable, keep: np.ndarray, camera: CameraModel, rotations: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whitened squared residuals (n,) of the kept stars, and J' W J (m, p + 4, p + 4)."""
    size = len(camera.parameters) + 4
    blocks, squared = np.zeros((table.image_count, size, size)), []
    for k in np.nonzero(keep)[0]:
        R = rotations[table.image[k]]
        pixel, J_parameters, J_rotation = project_jacobians(camera, R @ table.direction_icrf[k])
        r = table.measured_px[k] - pixel
        uu, uv, vv = table.covariance_px2[k]
        W = np.linalg.inv(np.array([[uu, uv], [uv, vv]]))
        J = np.concatenate([J_parameters, J_rotation, r[:, None]], axis=1)
        blocks[table.image[k]] += J.T @ W @ J
        squared.append(r @ W @ r)
    return np.array(squared), blocks


RATIONAL = [-0.05, 0.1, 0.2, 4e-4, -3e-4, 0.35, 0.1, 0.02]
COEFFICIENTS = {
    'plumb_bob': RATIONAL[:5],
    'rational_polynomial': RATIONAL,
    'thin_prism': [*RATIONAL, 2e-3, -1e-3, -1.5e-3, 5e-4],
    'tilted': [*RATIONAL, 2e-3, -1e-3, -1.5e-3, 5e-4, 0.02, -0.03],
    'equidistant': [-0.02, 0.01, -0.004, 5e-4],
}


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


def test_images_spread_over_many_chunks_come_back_to_their_places() -> None:
    sizes = tuple(int(n) for n in np.random.default_rng(3).integers(0, 700, 30))
    table, rotations = made(sizes, seed=3)
    everything = np.ones(len(table), bool)
    measurements = arrange(table, everything, table.covariance_px2)
    assert len(measurements.chunks) > 3
    together = normal_blocks(measurements, 'plumb_bob', CAMERA_MODEL.parameters, rotations)
    cost = 0.0
    for k in range(len(sizes)):
        alone, blocks = normal_blocks(
            arrange(table, table.image == k, table.covariance_px2),
            'plumb_bob',
            CAMERA_MODEL.parameters,
            rotations,
        )
        cost += alone
        np.testing.assert_allclose(together[1][k], blocks[k], rtol=1e-9, atol=1e-6)
    assert together[0] == pytest.approx(cost, rel=1e-12)


def test_no_star_at_all() -> None:
    table, rotations = made((0, 0))
    cost, blocks = normal_blocks(
        arrange(table, np.zeros(0, bool), table.covariance_px2),
        'plumb_bob',
        CAMERA_MODEL.parameters,
        rotations,
    )
    assert cost == 0.0 and blocks.shape == (2, 14, 14) and not blocks.any()


@pytest.mark.parametrize('loss_scale', [np.inf, 3.0, 0.5])
def test_the_gradient_is_that_of_the_cost(loss_scale: float) -> None:
    table, rotations = made()
    measurements = arrange(table, np.ones(len(table), bool), table.covariance_px2)

    def cost(parameters: np.ndarray, turn: np.ndarray) -> float:
        turned = Rotation.from_rotvec(-turn).as_matrix() @ rotations  # passive (Eq. 11)
        return normal_blocks(measurements, 'plumb_bob', parameters, turned, loss_scale)[0]

    beta = CAMERA_MODEL.parameters
    still = np.zeros((len(SIZES), 3))
    _, blocks = normal_blocks(measurements, 'plumb_bob', beta, rotations, loss_scale)
    downhill = blocks[:, :-4, -1].sum(axis=0)
    N = np.einsum('mii->i', blocks)
    for k in range(10):
        h = 0.01 / np.sqrt(N[k])  # a hundredth of the sigma of one parameter alone
        step = h * np.eye(10)[k]
        slope = (cost(beta + step, still) - cost(beta - step, still)) / (2 * h)
        # In units of sigma the gradient is of order 100; h^2 of its third derivative is left out.
        assert -slope * h == pytest.approx(downhill[k] * h, abs=3e-6)
    for k in (0, 2, 4):
        for axis in range(3):
            h = 0.01 / np.sqrt(blocks[k, 10 + axis, 10 + axis])
            step = np.zeros_like(still)
            step[k, axis] = h
            slope = (cost(beta, step) - cost(beta, -step)) / (2 * h)
            assert -slope * h == pytest.approx(blocks[k, ROTATION, -1][axis] * h, abs=3e-6)


def test_the_robust_loss_is_cauchys() -> None:
    table, rotations = made()
    everything = np.ones(len(table), bool)
    squared, _ = dense_blocks(table, everything, CAMERA_MODEL, rotations)
    measurements = arrange(table, everything, table.covariance_px2)
    cost, blocks = normal_blocks(
        measurements, 'plumb_bob', CAMERA_MODEL.parameters, rotations, 2.0
    )
    assert cost == pytest.approx(0.5 * (4 * np.log(1 + squared / 4)).sum(), rel=1e-12)
    # Weights of stars: 1 / (1 + s / c^2), the derivative of the loss by s.
    image_of_one = int(np.nonzero(np.bincount(table.image, minlength=len(SIZES)) == 1)[0][0])
    weight = 1 / (1 + squared[table.image == image_of_one][0] / 4)
    _, plain = normal_blocks(measurements, 'plumb_bob', CAMERA_MODEL.parameters, rotations)
    np.testing.assert_allclose(blocks[image_of_one], weight * plain[image_of_one], rtol=1e-12)
    # Far below its scale it is least squares: s / 2 c^2 = 1e-7 is left out at most.
    scale = np.sqrt(0.5e7 * squared.max())
    soft, _ = normal_blocks(measurements, 'plumb_bob', CAMERA_MODEL.parameters, rotations, scale)
    assert soft == pytest.approx(0.5 * squared.sum(), rel=1e-7)


def test_a_star_behind_the_camera_has_no_finite_cost() -> None:
    table, rotations = made()
    rotations[4] = np.diag([1.0, -1.0, -1.0]) @ rotations[4]
    cost, _ = normal_blocks(
        arrange(table, np.ones(len(table), bool), table.covariance_px2),
        'plumb_bob',
        CAMERA_MODEL.parameters,
        rotations,
    )
    assert cost == np.inf


def test_whitening_is_the_inverse_root_of_the_covariance() -> None:
    table, _ = made()
    wuu, wuv, wvv = whitening(table.covariance_px2)
    zero = np.zeros_like(wuu)
    W = np.stack([np.stack([wuu, wuv], axis=-1), np.stack([zero, wvv], axis=-1)], axis=-2)
    uu, uv, vv = table.covariance_px2.T
    C = np.stack([np.stack([uu, uv], axis=-1), np.stack([uv, vv], axis=-1)], axis=-2)
    identity = W @ C @ W.transpose(0, 2, 1)
    # The thinnest of these covariances have a condition of some hundreds.
    np.testing.assert_allclose(
        identity, np.broadcast_to(np.eye(2), identity.shape), rtol=0, atol=1e-11
    )
    r = np.random.default_rng(5).normal(size=(len(table), 2))
    expected = np.einsum('ni,nij,nj->n', r, np.linalg.inv(C), r)
    np.testing.assert_allclose(squared_sigmas(r, table.covariance_px2), expected, rtol=1e-9)
