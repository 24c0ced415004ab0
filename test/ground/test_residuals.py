# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Residuals of a calibration, as they are left, written and read."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import estimated  # type: ignore[import-not-found]

from starcal_ground.products import read_residuals, write_residuals
from starcal_ground.residuals import Residuals, residuals_of
from starcal_ground.simulation.centroids import true_observations
from starcal_ground.simulation.scenario import scenario, scene
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import ProductError
from starcal_ros.estimation.problem import METHODS

SCENARIO = dataclasses.replace(scenario('small', seed=4), image_count=8)


@functools.cache
def residuals(method: str = 'hierarchical') -> Residuals:
    ensemble = true_observations(SCENARIO)
    found = estimated(SCENARIO, ensemble, method=method)
    return residuals_of(found, ensemble, np.full(len(found.table), np.nan))


@pytest.mark.parametrize('method', METHODS)
def test_attitude_errors_are_those_of_the_star_tracker(method) -> None:
    left, put_in = residuals(method), []
    for index in range(SCENARIO.image_count):
        exact, reported = (
            Rotation.from_quat(
                scene(SCENARIO, index, attitude_noise=noise).icrf_from_star_tracker_xyzw
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


def test_rms_of_images_and_residuals_written_and_read(tmp_path) -> None:
    left, path = residuals(), tmp_path / 'residuals.npz'
    for k, rms in enumerate(left.image_rms_px()):
        here = left.residual_px[(left.image == k) & left.used]
        assert rms == pytest.approx(np.sqrt(np.mean(here**2)), rel=1e-12)  # rounding
    nothing = dataclasses.replace(left, used=np.zeros_like(left.used))
    assert np.isnan(nothing.image_rms_px()).all()
    write_residuals(left, path)
    again = read_residuals(path)
    for field in dataclasses.fields(left):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(left, field.name))
    first = path.read_bytes()
    write_residuals(left, path)
    assert path.read_bytes() == first


def test_columns_that_do_not_fit_are_named(tmp_path) -> None:
    """Files that are no archives are those of any reader: test_untrusted_files.py."""
    left, path = residuals(), tmp_path / 'residuals.npz'
    for wrong, words in (
        ({'image': left.image + 100}, 'images that are not there'),
        ({'measured_px': left.measured_px[1:]}, 'measured_px'),
    ):
        write_residuals(dataclasses.replace(left, **wrong), path)
        with pytest.raises(ProductError, match=words):
            read_residuals(path)
    np.savez(path, format=1)
    with pytest.raises(ProductError, match="key '.*' is missing"):
        read_residuals(path)
