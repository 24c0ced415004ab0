# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The attitude of the camera at each image, read back by SPICE, against the truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from export_calibrations import calibration  # type: ignore[import-not-found]
from mission_files import CLOCK_ID, ephemeris_time, FRAME_ID, write_lsk, write_sclk  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import spiceypy

from starcal_ground.mission.export.export_formats import export, Request
from starcal_ground.mission.export.exported import Content
from starcal_ground.mission.export.spice import SpiceNames
from starcal_ros.camera import line_of_sight
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.records import Calibration, refused_image, StarObservations

FIRST_NS = 1_778_829_600_123_456_789
NOISE_PX, STARS = 0.05, 60
MADE = calibration(with_field=True)
TRUTH = Rotation.random(4, random_state=5)  # icrf_from_camera of each image


def observed(k: int) -> StarObservations:
    """Stars of an image with noise, one of them a wrong identification; no attitude."""
    rng = np.random.default_rng(k)
    pixel = rng.uniform([0, 0], [1295, 1023], (STARS, 2))
    direction = TRUTH[k].apply(line_of_sight(MADE.geometry.camera, pixel))
    measured = pixel + rng.normal(0, NOISE_PX, pixel.shape)
    measured[7] += 5.0
    unknown = np.full(STARS, np.nan, np.float32)
    covariance = np.tile([NOISE_PX**2, 0.0, NOISE_PX**2], (STARS, 1))
    return StarObservations.of_image(
        FIRST_NS + k * 10**10, (1296, 1024),
        catalog_id=np.arange(STARS), direction_icrf=direction, magnitude=unknown,
        measured_px=measured, covariance_px2=covariance, flux_dn=unknown, snr=unknown,
    )  # fmt: skip


def written(
    folder: Path, made: Calibration, images: list[StarObservations], tracker: int
) -> Content:
    kernels = [write_lsk(folder / 'leap.tls'), write_sclk(folder / 'clock.tsc')]
    names = SpiceNames(CLOCK_ID, star_tracker_id=tracker)
    return export(made, 'ck', folder, Request(names, observations=images, kernels=kernels))


@pytest.mark.parametrize('tracker', [0, FRAME_ID])
def test_spice_has_the_attitude_of_each_image_and_none_between(
    tmp_path: Path, tracker: int
) -> None:
    refused = refused_image(FIRST_NS - 10**10, 1296, 1024, 'no_match', '')
    images = [refused, *map(observed, range(len(TRUTH)))]
    done = written(tmp_path, MADE, images, tracker)
    export(MADE, 'spice', tmp_path, Request(SpiceNames(CLOCK_ID, star_tracker_id=FRAME_ID)))
    spiceypy.kclear()
    for name in (*done.files, 'leap.tls', 'clock.tsc', 'camera.tf'):
        spiceypy.furnsh(str(tmp_path / name))
    # Two axes by all stars; about the boresight by their distance from the centre.
    across_px = NOISE_PX / np.sqrt(STARS)
    assert done.losses[0].cost_px == pytest.approx(across_px, rel=0.02)  # one star left out
    sigma_rad = across_px / 3642.0
    for k, truth in enumerate(TRUTH):
        et = ephemeris_time(FIRST_NS + k * 10**10)
        if tracker:
            matrix = spiceypy.pxform('CAMERA_OPTICAL_FRAME', 'J2000', et)
        else:
            ticks = spiceypy.sce2c(CLOCK_ID, et)
            matrix = spiceypy.ckgp(-999001, ticks, 0.0, 'J2000')[0].T
        error = (truth.inv() * Rotation.from_matrix(matrix)).as_rotvec()
        assert np.abs(error[:2]).max() < 4 * sigma_rad
        assert abs(error[2]) < 4 * sigma_rad / 0.12  # stars are 0.12 rad from the axis, rms
    handle = spiceypy.dafopr(str(tmp_path / 'camera.bc'))
    _, lines, is_whole = spiceypy.dafec(handle, 1000)
    spiceypy.dafcls(handle)
    comments = ' '.join(' '.join(lines).split())
    kernel = ' '.join((tmp_path / 'camera.tf').read_text().split())
    assert is_whole and max(map(len, lines)) <= 80
    assert f'(axes of the ICRF) to frame {tracker or -999001}, the ' in comments
    assert f'across the boresight: {done.losses[0].cost_px:.3g} px, ' in comments
    assert ('alignment about the camera axes' in comments) == bool(tracker)
    assert f'catalog: {MADE.provenance["catalog"]}' in comments  # digests are beside it
    for text in (comments, kernel):  # the rotation was made from apparent directions
        assert 'free of stellar aberration' in text and "'LT+S'" in text
    between = spiceypy.sce2c(CLOCK_ID, ephemeris_time(FIRST_NS + 5 * 10**9))
    with pytest.raises(spiceypy.NotFoundError):
        spiceypy.ckgp(tracker or -999001, between, 0.0, 'J2000')
    spiceypy.kclear()


def test_without_stars_or_clock_it_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(ProductError, match='no image with stars'):
        written(tmp_path, MADE, [], 0)
    with pytest.raises(OptionError, match='^--kernels: give the leap seconds kernel'):
        export(MADE, 'ck', tmp_path, Request(SpiceNames(-42), observations=[observed(0)]))
    other = SpiceNames(-42)
    kernels = [tmp_path / 'leap.tls', tmp_path / 'clock.tsc']
    with pytest.raises(ProductError, match=r'camera\.bc: .*SPICE'):
        export(MADE, 'ck', tmp_path, Request(other, observations=[observed(0)], kernels=kernels))
    assert not (tmp_path / 'camera.bc').exists()
    warmer = dataclasses.replace(observed(0), temperature_degc=30.0)
    assert written(tmp_path, MADE, [warmer], 0).worst_px == 0.0
