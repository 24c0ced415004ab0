# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""What a calibration leaves over: truth from the simulation, the file both ways, bad files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.products import read_residuals, write_residuals
from starcal_ground.simulation import centroids as simulated_centroids
from starcal_ground.simulation import scenario
from starcal_ros.assessment.predictions import Residuals, residuals_of
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ProductError
from starcal_ros.estimation.calibrate import estimate_calibration
from starcal_ros.estimation.options import CalibrationOptions

SCENARIO = dataclasses.replace(scenario.scenario('small', seed=4), image_count=8)


@pytest.fixture(scope='module', params=['hierarchical', 'per_image', 'single'])
def left(request: pytest.FixtureRequest) -> Residuals:
    ensemble = simulated_centroids.true_observations(SCENARIO)
    options = CalibrationOptions(
        method=request.param,
        star_tracker_sigma_arcsec=SCENARIO.star_tracker_sigma_arcsec,
        velocity_sigma_m_s=10.0,
    )
    estimate = estimate_calibration(ensemble, SCENARIO.prior, options)
    return residuals_of(estimate, ensemble, np.full(len(estimate.table), np.nan))


def test_attitude_errors_are_those_of_the_star_tracker(left: Residuals) -> None:
    """Whatever the method: the stars show the errors that the simulation has put in."""
    put_in = []
    for index in range(SCENARIO.image_count):
        exact, reported = (
            Rotation.from_quat(
                scenario.scene(SCENARIO, index, attitude_noise=noise).icrf_from_star_tracker_xyzw
            )
            for noise in (False, True)
        )
        put_in.append((exact.inv() * reported).as_rotvec() / ARCSECOND_RAD)
    off = left.attitude_error_arcsec - np.array(put_in)
    # What is common to all images went into the alignment.
    off -= off.mean(axis=0)
    # Distortion that is not known exactly turns all images alike: 5 sigma covers the stars' noise.
    assert (np.abs(off) < 5 * left.attitude_sigma_arcsec).all()
    # Around every axis what is left is a small part of the errors.  The sigma of the method single
    # does not show it: the errors are in its residuals, which give the centroids their variance.
    varied = np.array(put_in) - np.mean(put_in, axis=0)
    assert (np.sqrt((off**2).mean(axis=0)) < 0.25 * np.sqrt((varied**2).mean(axis=0))).all()


def test_rms_of_images(left: Residuals) -> None:
    for k, rms in enumerate(left.image_rms_px()):
        here = left.residual_px[(left.image == k) & left.used]
        assert rms == pytest.approx(np.sqrt(np.mean(here**2)), rel=1e-12)  # rounding
    nothing = dataclasses.replace(left, used=np.zeros_like(left.used))
    assert np.isnan(nothing.image_rms_px()).all()


def test_written_and_read_is_equal(left: Residuals, tmp_path: Path) -> None:
    path = tmp_path / 'residuals.npz'
    write_residuals(left, path)
    again = read_residuals(path)
    for field in dataclasses.fields(left):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(left, field.name))
    first = path.read_bytes()
    write_residuals(left, path)
    assert path.read_bytes() == first


def test_bad_files_are_named(left: Residuals, tmp_path: Path) -> None:
    path = tmp_path / 'residuals.npz'
    with pytest.raises(ProductError, match='cannot be read'):
        read_residuals(path)
    write_residuals(left, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ProductError, match=str(path)):
        read_residuals(path)
    path.write_text('not an archive')
    with pytest.raises(ProductError, match='not a NumPy archive'):
        read_residuals(path)
    write_residuals(dataclasses.replace(left, image=left.image + 100), path)
    with pytest.raises(ProductError, match='images that are not there'):
        read_residuals(path)
    write_residuals(dataclasses.replace(left, measured_px=left.measured_px[1:]), path)
    with pytest.raises(ProductError, match='measured_px'):
        read_residuals(path)
    write_residuals(left, path)
    with np.load(path) as archive:
        columns = {name: archive[name] for name in archive.files if name != 'used'}
    np.savez(path, **columns)
    with pytest.raises(ProductError, match="key 'used' is missing"):
        read_residuals(path)
