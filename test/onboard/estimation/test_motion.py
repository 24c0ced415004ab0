# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Unknowns of a moving camera: velocity of the observer, time of read-out, offset of stamps."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate, estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.records import Ensemble
from studies.worlds import Campaign, simulate, World

ROLLING = World(rate_deg_s=0.42, row_s=20e-6, tracker_arcsec=5.0)
READOUT_S = 20e-6 * 1024


def estimated(made: Campaign, **options: object) -> Estimate:
    sigma = made.scenario.star_tracker_sigma_arcsec
    chosen = CalibrationOptions(star_tracker_sigma_arcsec=sigma, **options)  # type: ignore[arg-type]
    return estimate_calibration(made.ensemble, made.scenario.prior, chosen)


def of_focal(found: Estimate, made: Campaign) -> tuple[np.ndarray, np.ndarray]:
    """Errors of fx, skew and fy and their sigmas, px."""
    error_px = found.geometry.camera.parameters[:3] - made.scenario.truth.camera.parameters[:3]
    return error_px, np.sqrt(np.diag(found.covariance)[:3])


def test_a_known_time_of_readout_is_corrected() -> None:
    made = simulate(ROLLING, 2)
    error_px, sigma_px = of_focal(estimated(made, shutter='rolling', readout_s=READOUT_S), made)
    assert (np.abs(error_px) < 3.0 * sigma_px).all() and sigma_px.max() < 0.06
    error_px, sigma_px = of_focal(estimated(made, shutter='global'), made)
    assert np.abs(error_px / sigma_px).max() > 30.0
    backwards = estimated(made, shutter='rolling', readout_s=-READOUT_S)
    error_px, sigma_px = of_focal(backwards, made)
    assert np.abs(error_px / sigma_px).max() > 30.0


def test_an_unknown_time_of_readout_is_in_the_sigma() -> None:
    made = simulate(ROLLING, 2)
    error_px, sigma_px = of_focal(estimated(made), made)
    assert (np.abs(error_px) < 3.0 * sigma_px).all() and sigma_px.max() > 0.4


@pytest.mark.slow
def test_the_noise_of_the_centroids_is_no_time_of_readout() -> None:
    """With derivatives at the measured pixels the rms was 1.7."""
    in_sigma = []
    for seed in range(8):
        found = estimated(simulate(dataclasses.replace(ROLLING, row_s=0.0), seed))
        (at,) = np.arange(found.linear.layout.count)[found.linear.layout.places['readout']]
        in_sigma.append(found.posterior.mean[at] / math.sqrt(found.posterior.covariance[at, at]))
    assert np.sqrt(np.mean(np.square(in_sigma))) < 1.3


def test_an_offset_of_the_stamps_is_in_the_sigma_of_the_pointing() -> None:
    """18 arcsec at 0.1 degrees/s, of which the stars show nothing."""
    made = simulate(World(rate_deg_s=0.1, stamp_s=0.05, tracker_arcsec=5.0), 1)
    true = Rotation.from_quat(made.scenario.truth.star_tracker_from_camera_xyzw)
    held = {'estimate': ('fx', 'skew', 'fy', 'distortion'), 'shutter': 'global'}
    for stamp_sigma_s, is_covered in ((0.0, False), (0.05, True)):
        found = estimated(made, stamp_sigma_s=stamp_sigma_s, **held)
        q = Rotation.from_quat(found.geometry.star_tracker_from_camera_xyzw)
        error_rad = (q.inv() * true).as_rotvec()
        chi2 = error_rad @ np.linalg.solve(found.covariance[10:, 10:], error_rad)
        assert bool(chi2 < 16.0) is is_covered
        assert np.linalg.norm(error_rad) > 12.0 * ARCSECOND_RAD


@pytest.mark.parametrize('missing', [slice(None), slice(1)])
def test_without_a_rate_of_every_image_neither_is_unknown(missing: slice) -> None:
    made = simulate(ROLLING, 2)
    images = list(made.ensemble.images)
    unknown = np.full(3, np.nan)
    images[missing] = [
        dataclasses.replace(one, star_tracker_rate_rad_s=unknown) for one in images[missing]
    ]
    found = estimated(dataclasses.replace(made, ensemble=Ensemble(tuple(images))))
    assert 'readout' not in found.linear.layout and 'stamps' not in found.linear.layout


@pytest.mark.parametrize(
    ('recorded', 'asked', 'sigma_m_s'),
    [
        ((10.0, 10.0), -1.0, 10.0),
        ((0.0, 30.0), -1.0, 30.0),
        ((10.0, math.nan), -1.0, 8000.0),
        ((math.nan, math.nan), 2.0, 2.0),
        ((0.0, 0.0), -1.0, 0.0),
        ((math.nan, math.nan), 0.0, 0.0),
    ],
)
def test_the_velocity_is_as_uncertain_as_the_least_certain_image(
    recorded: tuple[float, float], asked: float, sigma_m_s: float
) -> None:
    made = simulate(World(images=6), 0)
    images = [
        dataclasses.replace(one, velocity_sigma_m_s=recorded[k == 5])
        for k, one in enumerate(made.ensemble.images)
    ]
    made = dataclasses.replace(made, ensemble=Ensemble(tuple(images)))
    found = estimated(made, velocity_sigma_m_s=asked)
    assert ('velocity' in found.linear.layout) == (sigma_m_s > 0)
    if sigma_m_s:
        np.testing.assert_array_equal(found.linear.layout['velocity'].sigma, sigma_m_s)
