# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Search for a dominant wave in each component of a field, from the spectrum of its mean."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel
from starcal_ros.detector_field import basis
from starcal_ros.model_errors.field_kernel import covariance, Wave, Waves
from starcal_ros.model_errors.field_likelihood import ComponentLikelihood, FieldLikelihood

_ENVELOPES = (1.0, 2.0, 4.0, 8.0)  # lengths in half lengths of the longer side
_FASTEST = 16.0  # rad per half length: 2.5 waves across the longer side
_STEP = 0.8  # rad per half length, at first: half the width of a line over the detector
_REFINEMENTS = 3
_GRID = 41  # pixels a side at which the spectrum is taken


def candidates(
    shown: FieldLikelihood, length: float, known: Waves, mean: Floats
) -> tuple[Waves, ...]:
    """
    Waves of one component or of both, near known ones or by the mean field (2 t,).

    ``length`` is that of the smooth part of the kernel.
    """
    # The amplitude is that of both components: each wave is looked for beside one of the other.
    u, v = (
        wave or Wave(*_dominant_wave(shown.camera, shown.degree, component), _ENVELOPES[1])
        for wave, component in zip(known, np.split(mean, 2), strict=True)
    )
    u, _ = _refined(shown, length, (u, v), 0)
    u, v = _refined(shown, length, (u, v), 1)
    return (u, None), (None, v), (u, v)


def _refined(
    shown: FieldLikelihood, length: float, waves: tuple[Wave, Wave], component: int
) -> tuple[Wave, Wave]:
    """Waves with the most likely one in a component, near the one that it has."""
    wave, other = waves[component], waves[1 - component]
    found = []
    # A long envelope has a narrow line: it is looked for where a shorter one has found it.
    for envelope in _ENVELOPES:
        wave, step = dataclasses.replace(wave, envelope=envelope), _STEP / envelope
        _, amplitude_px = shown.best_amplitude(length, _in_order(wave, other, component))
        likelihood = shown.of_component(component, length, other, amplitude_px)

        @functools.cache
        def ratio(one: Wave, likelihood: ComponentLikelihood = likelihood) -> float:
            size = shown.camera.width, shown.camera.height
            return likelihood.ratio(covariance(*size, shown.degree, length, one))

        for _ in range(_REFINEMENTS):
            around = [
                Wave(abs(wave.along_u + i * step), abs(wave.along_v + j * step), envelope)
                for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))
            ]
            best = max(around, key=ratio)
            if ratio(best) > ratio(wave):
                wave = best
            else:
                step *= 0.5
        found.append((ratio(wave), envelope, wave))
    return _in_order(max(found)[2], other, component)


def _in_order(own: Wave, other: Wave, component: int) -> tuple[Wave, Wave]:
    """The waves of u and v from those of a component and of the other one."""
    return (own, other) if component == 0 else (other, own)


def _dominant_wave(camera: CameraModel, degree: int, coefficients: Floats) -> tuple[float, float]:
    """Wave numbers along u and v of the largest power of a component of a field."""
    longer = max(camera.width, camera.height)
    u = np.linspace(0.0, camera.width - 1.0, _GRID)
    v = np.linspace(0.0, camera.height - 1.0, _GRID)
    pixels = np.stack([grid.ravel() for grid in np.meshgrid(u, v)], axis=-1)
    values = basis(pixels, camera.width, camera.height, degree) @ coefficients
    numbers = np.arange(0.0, _FASTEST, _STEP)
    along_u = np.exp(1j * np.outer(numbers, 2.0 * u / longer))
    along_v = np.exp(1j * np.outer(numbers, 2.0 * v / longer))
    image = values.reshape(_GRID, _GRID)
    power = sum(np.abs(one @ image @ along_u.T) ** 2 for one in (along_v, along_v.conj()))
    j, i = np.unravel_index(int(np.argmax(power)), (len(numbers), len(numbers)))
    return float(numbers[i]), float(numbers[j])
