# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
A step between two parts of the detector, as between two stitched ones or two amplifiers.

A score test as those of `model_checks`, for steps at many places along each axis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from starcal_ros.arrays import Floats, Indices
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.least_squares.linear_terms import Scalars
from starcal_ros.least_squares.normal_equations import Measurements
from starcal_ros.methods.assembly import score_of
from starcal_ros.methods.problem import scalar_terms_at
from starcal_ros.records import DetectorStep

_INNER = (0.1, 0.9)  # of the detector: beyond, too few stars lie on one side
_STEPS = 31  # places along each axis at which a step is looked for
# Half a pixel below and above the step (31) in each of the parts between the steps (32).
_SIDES = np.where(np.arange(_STEPS + 1) > np.arange(_STEPS)[:, None], 0.5, -0.5)


def detector_step(estimate: Estimate, measurements: Measurements) -> DetectorStep:
    """The most significant step of the detector between two parts, by the stars that were used."""
    problem, state = estimate.problem, estimate.state
    camera, prior = estimate.geometry.camera, problem.field_prior
    along = np.asarray(np.linspace(*_INNER, _STEPS), np.float64)
    places = _Places(along * camera.width - 0.5, along * camera.height - 0.5)
    information, between = _information(measurements, places, prior.polynomials if prior else None)
    terms = scalar_terms_at(problem, state, measurements, places.steps, information)
    size_px, sigma_px = score_of(
        problem,
        state,
        estimate.blocks,
        estimate.field_terms,
        terms,
        between @ prior.modes if prior else None,
    ).single()
    count = 2 * _STEPS
    k = int(np.argmax(np.abs(size_px) / sigma_px))
    significance = abs(float(size_px[k] / sigma_px[k]))
    p_value = min(1.0, 2.0 * 2 * count * float(ndtr(-significance)))
    axis, place = divmod(k % count, _STEPS)
    return DetectorStep(
        across='uv'[axis],
        place_px=float(places[axis][place]),
        moved='uv'[k // count],
        size_px=float(size_px[k]),
        p_value=p_value,
    )


class _Places(NamedTuple):
    """Where steps are looked for along u and along v, (31,) each, px."""

    u_px: Floats
    v_px: Floats

    def parts(self, pixels: Floats) -> Indices:
        """Part of the detector (2, n) along u and along v of pixels (2, n), from 0 to 31."""
        return np.stack([np.searchsorted(at, x) for at, x in zip(self, pixels, strict=True)])

    def steps(self, pixels: Floats) -> Floats:
        """Unit steps (62, n) at pixels (2, n), those along u first."""
        return np.concatenate([_SIDES[:, part] for part in self.parts(pixels)])


def _information(
    measurements: Measurements, places: _Places, polynomials: Scalars | None
) -> tuple[Floats, Floats]:
    """
    Information (124, 124) of the steps, and that (124, 2 t) which they share with polynomials.

    Rows and columns: of what moves u, then of what moves v.  A step is constant within the cells
    between the places, so the weights are summed over the stars of each cell first.
    """
    cells = np.zeros((3, (_STEPS + 1) ** 2))
    shared: list[Floats] = []
    for chunk in measurements.chunks:
        wuu, wuv, wvv = chunk.whitener
        weights = (wuu**2, wuu * wuv, wuv**2 + wvv**2)  # uu, uv, vv
        part = places.parts(chunk.measured_px)
        cell = part[0] * (_STEPS + 1) + part[1]
        cells += [np.bincount(cell, weight, cells.shape[1]) for weight in weights]
        if polynomials is not None:
            steps = places.steps(chunk.measured_px)
            phi = polynomials(chunk.measured_px)
            shared.append(np.stack([steps @ (phi * weight).T for weight in weights]))
    by_part = cells.reshape(3, _STEPS + 1, _STEPS + 1)
    across = _SIDES @ by_part @ _SIDES.T
    along_u, along_v = ((_SIDES * by_part.sum(axis=k)[:, None]) @ _SIDES.T for k in (2, 1))
    own = np.block([[along_u, across], [across.transpose(0, 2, 1), along_v]])
    between = np.sum(shared, axis=0) if shared else np.zeros((3, 2 * _STEPS, 0))
    return _by_axis(own), _by_axis(between)


def _by_axis(weighted: Floats) -> Floats:
    """Matrix (2 s, 2 t) of what moves u and v, from sums (3, s, t) with weights uu, uv, vv."""
    uu, uv, vv = weighted
    return np.block([[uu, uv], [uv, vv]])
