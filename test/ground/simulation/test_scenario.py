# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated scenarios, scenes and drifts against analytic truth."""

import dataclasses
from datetime import datetime, timezone
import json
import math

import erfa
from geometries import turn_between  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.mission.ingest.deep_catalog import write_deep_catalog
from starcal_ground.simulation.deep_sky import deep_sky, disc, log10_density
from starcal_ground.simulation.scenario import (
    at_date,
    attitude_samples,
    camera_from_icrf,
    Inertial,
    scenario,
    SCENARIOS,
    scene,
)
from starcal_ground.simulation.simulated_bag import true_geometry
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SECONDS_PER_YEAR
from starcal_ros.sky.catalog import BUNDLED_MAGNITUDE, cone, load_catalog


def test_the_seed_draws_the_truth_but_not_the_prior() -> None:
    for name in SCENARIOS:
        a, b, again = scenario(name, 1), scenario(name, 2), scenario(name, 1)
        assert np.array_equal(a.truth.camera.parameters, again.truth.camera.parameters)
        assert not np.array_equal(a.truth.camera.parameters, b.truth.camera.parameters)
        assert np.array_equal(a.prior.camera.parameters, b.prior.camera.parameters)
        # The principal point cannot be told from the alignment: it is as the prior has it.
        assert np.array_equal(a.truth.camera.parameters[3:5], a.prior.camera.parameters[3:5])
    with pytest.raises(ValueError, match="'huge' is not one of tiny, small, paper"):
        scenario('huge')


def test_an_inertial_camera_looks_where_it_is_told() -> None:
    tiny = scenario('tiny')
    assert isinstance(tiny.pointing, Inertial)
    for index, (ra, dec, roll) in enumerate(tiny.pointing.attitudes_deg):
        R = camera_from_icrf(tiny, index)
        assert np.allclose(R @ R.T, np.eye(3), atol=1e-14)
        assert np.allclose(R[2], erfa.s2c(math.radians(ra), math.radians(dec)), atol=1e-14)
        east = erfa.s2c(math.radians(ra + 90), 0.0)
        # The roll turns +x from east: the angle between them is the roll itself.
        assert R[0] @ east == pytest.approx(math.cos(math.radians(roll)), abs=1e-14)


def test_an_earth_fixed_camera_looks_at_the_zenith() -> None:
    paper = scenario('paper')
    for index in (0, 358):
        utc = 2440587.5, paper.time_ns(index) / 86400e9
        ra, dec = erfa.atoc13(
            'A', 0.0, 0.0, *utc, 0.0, math.radians(-95.37), math.radians(29.76),
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip
        boresight = camera_from_icrf(paper, index)[2]
        # ERFA takes off the aberration, 20.5" at most, which a camera's attitude does not have.
        assert erfa.sepp(boresight, erfa.s2c(ra, dec)) < 30 * ARCSECOND_RAD
    # Hercules: 16 h to 18 h, about 30 degrees north.
    ra, dec = erfa.c2s(camera_from_icrf(paper, 180)[2])
    assert 16 < math.degrees(ra % (2 * math.pi)) / 15 < 18
    assert 25 < math.degrees(dec) < 35


def test_star_tracker_errors_have_their_sigma_about_their_axes() -> None:
    paper = dataclasses.replace(
        scenario('paper'), star_tracker_sigma_arcsec=(5.0, 10.0, 40.0), image_count=300
    )
    camera_from_tracker = Rotation.from_quat(paper.truth.star_tracker_from_camera_xyzw).inv()
    errors = []
    for index in range(paper.image_count):
        before, _, after, last = attitude_samples(paper, index)
        tracker_from_icrf = camera_from_tracker.inv() * Rotation.from_matrix(
            camera_from_icrf(paper, index, -0.75)
        )
        reported = Rotation.from_quat(before.icrf_from_star_tracker_xyzw)
        errors.append((tracker_from_icrf * reported).as_rotvec() / ARCSECOND_RAD)
        # One error per image: between two samples the tracker turns as the Earth does.
        turned = reported.inv() * Rotation.from_quat(last.icrf_from_star_tracker_xyzw)
        assert turned.magnitude() == pytest.approx(1.5 * 7.292115e-5, rel=1e-6)
        assert after.time_ns - before.time_ns == 1_000_000_000
    sigma = np.std(errors, axis=0)
    assert np.allclose(sigma, [5.0, 10.0, 40.0], rtol=5 / math.sqrt(2 * 300))  # 5 standard errors


def test_only_the_brightest_stars() -> None:
    few = dataclasses.replace(scenario('tiny', seed=2), stars_per_image=9)
    every, nine = scene(scenario('tiny', seed=2), 1), scene(few, 1)
    size = np.array([few.truth.camera.width, few.truth.camera.height])
    inside = ((every.pixel_px >= 0) & (every.pixel_px <= size - 1)).all(axis=1)
    assert sorted(nine.magnitude) == sorted(every.magnitude[inside])[:9]


def test_samples_may_have_errors_of_their_own() -> None:
    """The attitude at the image is between two of them: their errors average to sqrt(2)."""
    own = dataclasses.replace(
        scenario('small'), star_tracker_hz=10.0, star_tracker_sigma_arcsec=(20.0,) * 3
    )
    camera_from_tracker = own.truth.star_tracker_from_camera.inv()
    errors, at_image = [], []
    for index in range(own.image_count):
        samples = attitude_samples(own, index)
        late_s = np.array([sample.time_ns - own.time_ns(index) for sample in samples]) / 1e9
        assert np.allclose(np.diff(late_s), 0.1) and late_s.max() == pytest.approx(1.45)
        for sample, offset_s in zip(samples, late_s, strict=True):
            true = Rotation.from_matrix(camera_from_icrf(own, index, float(offset_s)))
            reported = Rotation.from_quat(sample.icrf_from_star_tracker_xyzw)
            errors.append((camera_from_tracker.inv() * true * reported).as_rotvec())
        true = Rotation.from_matrix(camera_from_icrf(own, index))
        reported = Rotation.from_quat(scene(own, index).icrf_from_star_tracker_xyzw)
        at_image.append((camera_from_tracker.inv() * true * reported).as_rotvec())
    sigma = np.array(errors) / ARCSECOND_RAD
    assert sigma.std() == pytest.approx(20.0, rel=0.1)  # of 2160 numbers, 6 standard errors
    assert np.abs(np.corrcoef(sigma[:-1].ravel(), sigma[1:].ravel())[0, 1]) < 0.1
    expected = 20.0 / math.sqrt(2.0)
    assert np.std(at_image) / ARCSECOND_RAD == pytest.approx(expected, rel=0.35)  # of 72


YEAR_NS = round(SECONDS_PER_YEAR) * NANOSECONDS_PER_SECOND
FOCAL_PPM, TURN_ARCSEC = 200.0, 30.0  # a year


def test_a_drift_is_linear_from_the_date_of_the_scenario() -> None:
    made = scenario('tiny')
    assert at_date(made, made.start_ns, FOCAL_PPM, TURN_ARCSEC).time_ns(3) == made.time_ns(3)
    for years in (-1, 0, 3):
        later = at_date(made, made.start_ns + years * YEAR_NS, FOCAL_PPM, TURN_ARCSEC)
        before, after = made.truth, later.truth
        grown = after.camera.parameters[[0, 2]] / before.camera.parameters[[0, 2]] - 1.0
        # Roundings of a focal length of 1800 px, which is about 1.
        np.testing.assert_allclose(grown, 1e-6 * FOCAL_PPM * years, rtol=0, atol=1e-15)
        expected = [TURN_ARCSEC * ARCSECOND_RAD * years, 0.0, 0.0]
        turn = turn_between(before, after).as_rotvec()
        np.testing.assert_allclose(turn, expected, rtol=0, atol=1e-15)  # rounding
        assert later.prior is made.prior


@pytest.mark.slow
def test_a_bag_of_a_later_date_has_the_truth_of_that_date(tmp_path, starcal) -> None:
    """What a trend finds of a drift: test/ground/mission/trend/test_trend_page.py."""
    stated = ['--focal-drift', FOCAL_PPM, '--alignment-drift', TURN_ARCSEC, '--images', 2]
    stated += ['--seed', 5, '--camera-seed', 1, '--date', '2029-05-15T07:20:00']
    assert starcal('simulate', '-o', tmp_path / 'bag', '--scenario', 'tiny', *stated).status == 0
    truth = json.loads((tmp_path / 'bag' / 'truth.json').read_text())
    start = datetime.fromtimestamp(truth['t0'], timezone.utc)
    assert f'{start:%Y-%m-%dT%H:%M}' == '2029-05-15T07:20' and truth['seed'] == 5
    start_ns = round(truth['t0'] * NANOSECONDS_PER_SECOND)
    expected = at_date(scenario('tiny', 1), start_ns, FOCAL_PPM, TURN_ARCSEC).truth
    found = true_geometry(truth)
    # Seconds since 1970 in a double are off by 0.1 us.
    assert turn_between(found, expected).magnitude() < 1e-12
    off = np.abs(found.camera.parameters - expected.camera.parameters)
    assert (off / np.abs(expected.camera.parameters).clip(1.0)).max() < 1e-12


AXIS = erfa.s2c(1.0, -0.9)


def test_the_sky_has_the_mean_density_and_the_bundled_stars_and_a_disc_is_even() -> None:
    sky = deep_sky(AXIS, math.radians(3.0), 13.0, np.random.default_rng(2), spread=0.0)
    assert (np.diff(sky.magnitude) >= 0).all()
    assert len(sky.select(sky.magnitude < BUNDLED_MAGNITUDE)) == len(load_catalog())
    faint = sky.select(sky.magnitude >= BUNDLED_MAGNITUDE)
    expected = 28.26 * np.diff(10 ** log10_density(np.array([BUNDLED_MAGNITUDE, 13.0])))
    assert len(faint) == pytest.approx(expected[0], rel=0.05)  # 5 sigma of 2,700 stars
    assert len(cone(sky, AXIS, math.radians(3.0))) >= len(faint)
    # A disc is even.
    direction = disc(AXIS, 10_000, 0.5, np.random.default_rng(1))
    inside = np.count_nonzero(direction @ AXIS > math.cos(0.25)) / 10_000
    assert inside == pytest.approx((1 - math.cos(0.25)) / (1 - math.cos(0.5)), abs=0.02)


@pytest.mark.slow
def test_the_table_of_a_scenario_gives_its_sky(tmp_path) -> None:
    narrow = scenario('narrow')
    assert narrow.sky is not None and narrow.table is not None
    (tmp_path / 'gaia.csv').write_text(narrow.table)
    made = write_deep_catalog(tmp_path / 'gaia.csv', tmp_path / 'gaia.npz')
    assert made.source == 'Gaia, archive' and made.checked > 50 and made.unmoved == 0
    read = load_catalog(tmp_path / 'gaia.npz')
    _, ours, theirs = np.intersect1d(narrow.sky.id, read.id, return_indices=True)
    assert len(ours) == len(narrow.sky) == len(read)
    sky, read = narrow.sky.select(ours), read.select(theirs)
    off_rad = np.linalg.norm(sky.direction_icrs - read.direction_icrs, axis=1)
    assert off_rad.max() < 1e-3 * ARCSECOND_RAD
    assert np.abs(sky.magnitude - read.magnitude).max() < 2e-3
