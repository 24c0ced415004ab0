# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Images that differ in shape: found, estimated, and carried in the covariance."""

from __future__ import annotations

import dataclasses

import numpy as np
from random_pointings import (  # type: ignore[import-not-found]
    estimated,
    HEIGHT,
    honesty,
    of_random_pointings,
    WIDTH,
)

from starcal_ros.arrays import Floats
from starcal_ros.records import Ensemble
from starcal_ros.simulation.centroids import true_observations

MIDDLE = np.array([WIDTH - 1, HEIGHT - 1]) / 2.0


def unmoved(pixels: Floats) -> Floats:
    return np.zeros_like(pixels)


def reshaped(ensemble: Ensemble, matrices: Floats) -> Ensemble:
    """The ensemble with each image deformed about its middle by a matrix of (m, 2, 2)."""
    return Ensemble(
        tuple(
            dataclasses.replace(
                image, measured_px=image.measured_px + (image.measured_px - MIDDLE) @ matrix.T
            )
            for image, matrix in zip(ensemble.images, matrices, strict=True)
        )
    )


def test_a_focal_length_that_breathes_is_estimated_image_by_image() -> None:
    given = of_random_pointings(9)
    rng = np.random.default_rng(9)
    scales = rng.normal(size=12) * 3e-4  # a quarter of a pixel in a corner
    still = estimated(given, true_observations(given))
    found = estimated(given, reshaped(true_observations(given), scales[:, None, None] * np.eye(2)))
    assert still.variation.p_value > 1e-3 and found.variation.p_value < 1e-6
    focal_px = float(found.state.parameters[0])
    assert 0.1 < found.variation.corner_sigma_px(focal_px, float(np.hypot(*MIDDLE))) < 0.5
    # The shapes are those that were made, but for what the mean of twelve takes.
    shown = found.state.shapes[:, 0] / focal_px
    np.testing.assert_allclose(shown - shown.mean(), scales - scales.mean(), atol=3e-5)
    # Of the three shapes only the scale varies, and stars at one side do not mix them: their own
    # noise leaves a few percent of it.
    scale_px, stretch_px, shear_px = found.variation.amplitude_sigma_px
    assert max(stretch_px, shear_px) < 0.1 * scale_px
    # The camera of one image scatters by that about the mean, which adds 1 in 12 of the variance.
    assert 1.0 < found.covariance[0, 0] / scale_px**2 < 1.2
    # What is left of the stars is their noise again.
    np.testing.assert_allclose(
        found.residual_px[found.kept].std(), still.residual_px[still.kept].std(), rtol=0.02
    )
    assert honesty(given, found, unmoved)[0] < 1.5


def test_air_that_flattens_each_image_leaves_an_honest_sigma() -> None:
    """Refraction without a site: all images are flattened, and their mean with them."""
    given = of_random_pointings(11)
    rng = np.random.default_rng(11)
    matrices = []
    for secant2 in 1.0 / np.cos(rng.uniform(0.2, 1.1, 12)) ** 2:
        angle = rng.uniform(0.0, np.pi)
        up = np.array([np.cos(angle), np.sin(angle)])
        matrices.append(-2.8e-4 * (np.eye(2) + (secant2 - 1.0) * np.outer(up, up)))
    found = estimated(given, reshaped(true_observations(given), np.array(matrices)))
    assert found.variation.p_value < 1e-6
    ratio, error_arcsec = honesty(given, found, unmoved)
    assert error_arcsec > 5.0  # the mean of the air, which nothing here tells from the lens
    assert ratio < 2.0
