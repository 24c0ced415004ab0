# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Simulated worlds: the noise is as stated, the departures are those of the recorded truth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.simulation import scenario as synthetic
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import GRID
from starcal_ros.camera import line_of_sight, pixel_grid, project, rotation_jacobian
from starcal_ros.constants import ARCSECOND_RAD
from studies import worlds
from studies.missions import drawn
from studies.worlds import Campaign


def residuals(made: Campaign, index: int) -> tuple[Floats, Floats]:
    """Residuals (n, 2) of an image by the true camera and its best rotation; sigma (n,), px."""
    image, camera = made.ensemble.images[index], made.scenario.truth.camera
    seen = line_of_sight(camera, image.measured_px)
    sigma_px = np.sqrt(image.covariance_px2[:, 0])
    rotation, _ = Rotation.align_vectors(seen, image.direction_icrf, weights=sigma_px**-2)
    in_camera = rotation.apply(image.direction_icrf)
    for _ in range(2):
        left = (image.measured_px - project(camera, in_camera)) / sigma_px[:, None]
        J = rotation_jacobian(camera, in_camera) / sigma_px[:, None, None]
        step, *_ = np.linalg.lstsq(J.reshape(-1, 3), left.ravel(), rcond=None)
        in_camera = Rotation.from_rotvec(-step).apply(in_camera)
    return image.measured_px - project(camera, in_camera), sigma_px


def chi2_per_number(made: Campaign) -> float:
    """Mean squared residual over its variance, each image with a rotation of its own."""
    found = [residuals(made, k) for k in range(len(made.ensemble.images))]
    whole = sum(float(((r / s[:, None]) ** 2).sum()) for r, s in found)
    return whole / sum(r.size - 3 for r, _ in found)


@pytest.mark.parametrize('name', ['plain', 'bright24', 'vel_leo_ram', 'stamp_50ms'])
def test_centroids_scatter_by_their_stated_covariance(name: str) -> None:
    # A velocity of 7.6 km/s moves stars by 0.04 px within an image; a late stamp moves none.
    low, high = (0.9, 1.1) if name != 'vel_leo_ram' else (1.0, 1.5)
    assert low < chi2_per_number(worlds.campaign(name, 1)) < high


@pytest.mark.parametrize('name', ['rolling_fast', 'breath6', 'out5', 'fields4_cat'])
def test_a_departure_shows_in_the_residuals(name: str) -> None:
    assert chi2_per_number(worlds.campaign(name, 1)) > 1.1


def test_a_campaign_is_determined_by_its_seed() -> None:
    one, same, other = (worlds.campaign('plain', seed, 3) for seed in (1, 1, 2))
    measured = [made.ensemble.images[2].measured_px for made in (one, same, other)]
    assert np.array_equal(measured[0], measured[1])
    assert len(measured[2]) != len(measured[0]) or not np.allclose(measured[2], measured[0])


@pytest.mark.parametrize('name', ['wave11_050', 'radial8_10'])
def test_true_directions_have_the_displacement_of_the_stars(name: str) -> None:
    made = worlds.campaign(name, 1)
    camera = made.scenario.truth.camera
    grid = pixel_grid(camera, GRID, GRID)
    moved_px = grid - project(camera, made.true_directions[0])
    shown, left = [], []
    for index, image in enumerate(made.ensemble.images):
        residual_px, sigma_px = residuals(made, index)
        distance2 = ((image.measured_px[:, None] - grid) ** 2).sum(axis=2)
        near = (sigma_px < 0.03) & (distance2.min(axis=1) < 10.0**2)
        shown.append(residual_px[near])
        left.append(residual_px[near] - moved_px[distance2[near].argmin(axis=1)])
    rms_shown, rms_left = (np.sqrt(np.mean(np.concatenate(r) ** 2)) for r in (shown, left))
    assert rms_left < 0.7 * rms_shown


def test_the_rate_is_that_of_the_attitudes() -> None:
    made, base = worlds.campaign('small24', 1), synthetic.scenario('small', 1)
    attitudes = [synthetic.camera_from_icrf(base, 5, s) for s in (-10.0, 10.0)]
    before, after = Rotation.from_matrix(np.array(attitudes))
    rate_rad_s = (before * after.inv()).as_rotvec() / 20.0
    # The pole of today is 0.15 degrees from that of the ICRF.
    assert np.allclose(made.rate_rad_s[5], rate_rad_s, atol=3e-7)


def test_a_late_stamp_turns_the_reported_attitude_by_the_rate() -> None:
    early, late = (worlds.campaign(name, 1) for name in ('plain', 'stamp_50ms'))
    to_camera = late.scenario.truth.star_tracker_from_camera.inv()
    reported = [
        to_camera * Rotation.from_quat(m.ensemble.images[3].icrf_from_star_tracker_xyzw).inv()
        for m in (early, late)
    ]
    turned_rad = (reported[0] * reported[1].inv()).as_rotvec()
    assert np.allclose(turned_rad, 0.05 * late.rate_rad_s[3], atol=0.05 * ARCSECOND_RAD)


@pytest.mark.parametrize('mission', range(6))
def test_a_drawn_mission_is_within_the_priors_that_the_documents_promise(mission: int) -> None:
    sound, departing = (drawn(3, mission, is_sound) for is_sound in (True, False))
    same = ('images', 'pointing', 'model', 'field_deg', 'corner', 'magnitude_limit', 'shutter')
    assert [getattr(sound, name) for name in same] == [getattr(departing, name) for name in same]
    made = worlds.simulate(sound, 3, images=4)
    truth, prior = made.scenario.truth.camera, made.scenario.prior.camera
    assert truth.model == prior.model == sound.model
    centre_px = np.linalg.norm(truth.intrinsics[3:] - prior.intrinsics[3:])
    assert centre_px <= 0.03 * truth.width
    assert prior.intrinsics[0] == pytest.approx(truth.intrinsics[0], rel=0.021)
    assert np.isfinite(made.true_directions[0]).all()
    if all(len(image) > 30 for image in made.ensemble.images) and not sound.velocity_m_s:
        assert 0.75 < chi2_per_number(made) < 1.25


@pytest.mark.parametrize('samples', [0, 2])
def test_rates_by_samples_of_a_star_tracker_scatter_by_their_sigma(samples: int) -> None:
    world = worlds.World(images=60, rate_deg_s=0.1, tracker_hz=5.0, tracker_samples=samples)
    made = worlds.simulate(world, 1)
    to_tracker = made.scenario.truth.star_tracker_from_camera
    images = made.ensemble.images
    rate_rad_s = np.array([image.star_tracker_rate_rad_s for image in images])
    off_rad_s = rate_rad_s - to_tracker.apply(made.rate_rad_s)
    sigma_rad_s = np.array([image.star_tracker_rate_sigma_rad_s for image in images])
    # 180 numbers give their rms to 5 %.  Errors of a stream may be correlated, so that its sigma
    # is that of the worst correlation.
    low, high = (0.8, 1.2) if samples else (0.2, 1.2)
    assert low < np.sqrt(np.mean((off_rad_s / sigma_rad_s) ** 2)) < high
    if samples:
        expected = np.sqrt(2.0) * 20.0 * ARCSECOND_RAD * 5.0  # 5 samples a second
        assert np.allclose(sigma_rad_s, expected, rtol=0.01)
