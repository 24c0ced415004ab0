# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The likelihood of a field: one component beside the other is the same as both at once."""

from __future__ import annotations

import numpy as np
import pytest

from starcal_ros.camera import pixel_grid
from starcal_ros.detector_field import basis
from starcal_ros.least_squares.linear_terms import Score
from starcal_ros.model_errors import field_kernel
from starcal_ros.model_errors.field_kernel import Wave
from starcal_ros.model_errors.field_likelihood import field_likelihood, FieldLikelihood
from starcal_ros.model_errors.wave_search import candidates
from starcal_ros.simulation.scenario import scenario

DEGREE = 12
LENGTH = 0.5
WAVES = (Wave(6.0, 1.5, 2.0), Wave(2.5, 5.0, 4.0))
AMPLITUDE_PX = 0.2
NOISE_PX = 0.1


def rippled(rng: np.random.Generator) -> FieldLikelihood:
    """What stars show of a field that is a pure wave in each component."""
    camera = scenario('small', 1).truth.camera
    pixels = pixel_grid(camera, 41, 41)
    along_u, along_v = 2.0 * pixels.T / camera.width
    phi = basis(pixels, camera.width, camera.height, DEGREE)
    ripples = [
        np.cos(wave.along_u * along_u + i) * np.cos(wave.along_v * along_v)
        for i, wave in enumerate(WAVES)
    ]
    field = np.linalg.lstsq(phi, AMPLITUDE_PX * np.stack(ripples, axis=-1), rcond=None)[0]
    A = rng.normal(size=(4 * field.size, field.size))
    information = A.T @ A / NOISE_PX**2
    gradient = information @ field.T.ravel() + A.T @ rng.normal(size=len(A)) / NOISE_PX
    return field_likelihood(Score(gradient, information), camera, np.arange(5), DEGREE)


@pytest.mark.parametrize('component', [0, 1])
def test_one_component_beside_the_other_is_both(component: int) -> None:
    shown = rippled(np.random.default_rng(1))
    size = shown.camera.width, shown.camera.height
    whole = shown.ratios(shown.root(LENGTH, WAVES), np.array([AMPLITUDE_PX]))[0]
    part = shown.of_component(component, LENGTH, WAVES[1 - component], AMPLITUDE_PX)
    own = part.ratio(field_kernel.covariance(*size, DEGREE, LENGTH, WAVES[component]))
    # A root leaves out 1e-8 of the variance.
    assert own == pytest.approx(whole, rel=1e-5)


def test_a_wave_is_found_in_each_component() -> None:
    shown = rippled(np.random.default_rng(1))
    mean = shown.posterior_mean(LENGTH, (None, None), AMPLITUDE_PX)
    *_, (u, v) = candidates(shown, LENGTH, (None, None), mean)
    assert u is not None
    assert v is not None
    for found, true in zip((u, v), WAVES, strict=True):
        # Noise and the smooth part move it within the line, whose width over 2 half lengths is 1.
        assert (found.along_u, found.along_v) == pytest.approx(
            (true.along_u, true.along_v), abs=0.5
        )
    better = shown.best_amplitude(LENGTH, (u, v))[0]
    assert better > shown.best_amplitude(LENGTH, (None, None))[0] + 20.0
