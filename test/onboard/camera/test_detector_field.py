# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The field of a detector: its basis, and a camera with one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from worlds import HEIGHT, WIDTH  # type: ignore[import-not-found]

from starcal_ground.simulation.scenario import scenario
from starcal_ros.camera import detector_field, line_of_sight, pixel_grid, project
from starcal_ros.camera.detector_field import (
    basis,
    COSINE_DOMAIN,
    cosine_terms,
    DetectorField,
    term_count,
)


def test_cosines_are_orthonormal_over_a_domain_a_third_longer() -> None:
    count = 60
    places = COSINE_DOMAIN * ((np.arange(count) + 0.5) / count - 0.5) + 0.5
    u, v = np.meshgrid(places * WIDTH - 0.5, places * HEIGHT - 0.5)
    phi = basis(np.stack([u.ravel(), v.ravel()], -1), WIDTH, HEIGHT, 3)
    # The midpoint rule is exact for cosines: rounding is left.
    np.testing.assert_allclose(phi.T @ phi / count**2, np.eye(phi.shape[1]), atol=1e-12)


def test_an_octave_of_cosines_ends_at_half_its_longest_wave() -> None:
    terms, octave = cosine_terms(WIDTH, HEIGHT, 3)
    length_px = 2.0 * COSINE_DOMAIN / np.hypot(terms[:, 0] / WIDTH, terms[:, 1] / HEIGHT)
    for k in range(3):
        assert length_px[octave == k].min() >= 0.5**k * WIDTH * (1 - 1e-12)
    for k in (1, 2):
        assert length_px[octave == k].max() < 0.5 ** (k - 1) * WIDTH


@pytest.mark.parametrize(('width', 'height', 'octaves'), [(640, 512, 3), (300, 900, 2), (8, 8, 1)])
def test_products_of_the_cosines_are_those_of_their_values(
    width: int, height: int, octaves: int
) -> None:
    """Sums and differences of angles give the weighted Gram matrix to rounding."""
    generator = np.random.default_rng(3)
    pixels = generator.uniform(-0.5, [width - 0.5, height - 0.5], (500, 2))
    weights = generator.normal(1.0, 1.0, (3, 500))
    phi = basis(pixels, width, height, octaves)
    products = detector_field.basis_products(pixels, weights, width, height, octaves)
    for row, found in zip(weights, products, strict=True):
        np.testing.assert_allclose(found, (phi.T * row) @ phi, rtol=0, atol=1e-10)


@pytest.mark.parametrize('size_px', [1e-4, 1e-2, 0.2])
def test_a_camera_with_a_field_projects_what_it_sees(size_px: float) -> None:
    given = scenario('small', 1).truth.camera
    rng = np.random.default_rng(2)
    coefficients = size_px * rng.normal(size=(2, term_count(WIDTH, HEIGHT, 2)))
    field = DetectorField(WIDTH, HEIGHT, 2, coefficients)
    camera = dataclasses.replace(given, field=field)
    pixels = pixel_grid(camera, 9, 7)
    # Twelve steps of a contraction by 0.05 and less leave under 1e-9 px.
    back_px = project(camera, line_of_sight(camera, pixels))
    np.testing.assert_allclose(back_px, pixels, rtol=0, atol=1e-9)
