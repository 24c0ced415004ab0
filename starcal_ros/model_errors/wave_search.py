# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Search for a dominant wave in each component of a field, from the spectrum of its mean."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, pixel_grid
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
        wave = dataclasses.replace(wave, envelope=envelope)
        _, amplitude_px = shown.best_amplitude(length, _in_order(wave, other, component))
        likelihood = shown.of_component(component, length, other, amplitude_px)
        ratio, wave = _likeliest(likelihood, shown, length, wave)
        found.append((ratio, envelope, wave))
    return _in_order(max(found)[2], other, component)


def _likeliest(
    likelihood: ComponentLikelihood, shown: FieldLikelihood, length: float, wave: Wave
) -> tuple[float, Wave]:
    """The wave of most likely numbers near a given one, its envelope held, and its ratio."""

    @functools.cache
    def ratio(one: Wave) -> float:
        size = shown.camera.width, shown.camera.height
        return likelihood.ratio(covariance(*size, shown.degree, length, one))

    step = _STEP / wave.envelope
    for _ in range(_REFINEMENTS):
        around = [
            Wave(abs(wave.along_u + i * step), abs(wave.along_v + j * step), wave.envelope)
            for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))
        ]
        best = max(around, key=ratio)
        if ratio(best) > ratio(wave):
            wave = best
        else:
            step *= 0.5
    return ratio(wave), wave


def _in_order(own: Wave, other: Wave, component: int) -> tuple[Wave, Wave]:
    """The waves of u and v from those of a component and of the other one."""
    return (own, other) if component == 0 else (other, own)


def _dominant_wave(camera: CameraModel, degree: int, coefficients: Floats) -> tuple[float, float]:
    """Wave numbers along u and v of the largest power of a component of a field."""
    pixels = pixel_grid(camera, _GRID, _GRID)
    values = basis(pixels, camera.width, camera.height, degree) @ coefficients
    image, u, v = (one.reshape(_GRID, _GRID) for one in (values, *pixels.T))
    half = 0.5 * max(camera.width, camera.height)
    numbers = np.arange(0.0, _FASTEST, _STEP)
    along_u = np.exp(1j * np.outer(numbers, u[0] / half))
    along_v = np.exp(1j * np.outer(numbers, v[:, 0] / half))
    power = sum(np.abs(one @ image @ along_u.T) ** 2 for one in (along_v, along_v.conj()))
    j, i = np.unravel_index(int(np.argmax(power)), (len(numbers), len(numbers)))
    return float(numbers[i]), float(numbers[j])
