# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Unknowns of a moving camera: velocity of the observer, time of read-out, offset of stamps."""

from collections.abc import Callable
import dataclasses
import math

from geometries import turn_between  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from worlds import campaign, each_image, estimate_of, solved  # type: ignore[import-not-found]

from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.tracker_errors import measured_rates
from starcal_ros.records import StarObservations
from studies.worlds import Campaign, simulate, World

ROLLING = World(rate_deg_s=0.42, row_s=20e-6, tracker_arcsec=5.0)
READOUT_S = 20e-6 * 1024


def of_focal(found: Estimate, made: Campaign) -> tuple[np.ndarray, np.ndarray]:
    """Errors of fx, skew and fy and their sigmas, px."""
    error_px = found.geometry.camera.parameters[:3] - made.scenario.truth.camera.parameters[:3]
    return error_px, np.sqrt(np.diag(found.covariance)[:3])


def test_a_known_time_of_readout_is_corrected() -> None:
    made = campaign(ROLLING, 2)
    known = solved(ROLLING, 2, shutter='rolling', readout_s=READOUT_S)
    error_px, sigma_px = of_focal(known, made)
    assert (np.abs(error_px) < 3.0 * sigma_px).all() and sigma_px.max() < 0.06
    for wrong in ({'shutter': 'global'}, {'shutter': 'rolling', 'readout_s': -READOUT_S}):
        error_px, sigma_px = of_focal(estimate_of(made, **wrong), made)
        assert np.abs(error_px / sigma_px).max() > 30.0
    # Unknown, it is in the sigma.
    error_px, sigma_px = of_focal(solved(ROLLING, 2), made)
    assert (np.abs(error_px) < 3.0 * sigma_px).all() and sigma_px.max() > 0.4


@pytest.mark.slow
def test_the_noise_of_the_centroids_is_no_time_of_readout() -> None:
    """With derivatives at the measured pixels the rms was 1.7."""
    in_sigma = []
    for seed in range(8):
        found = estimate_of(simulate(dataclasses.replace(ROLLING, row_s=0.0), seed))
        (at,) = np.arange(found.linear.layout.count)[found.linear.layout.places['readout']]
        in_sigma.append(found.posterior.mean[at] / math.sqrt(found.posterior.covariance[at, at]))
    assert np.sqrt(np.mean(np.square(in_sigma))) < 1.3


def test_an_offset_of_the_stamps_is_in_the_sigma_of_the_pointing() -> None:
    """18 arcsec at 0.1 degrees/s, of which the stars show nothing."""
    made = simulate(World(rate_deg_s=0.1, stamp_s=0.05, tracker_arcsec=5.0), 1)
    held = {'estimate': ('fx', 'skew', 'fy', 'distortion'), 'shutter': 'global'}
    for stamp_sigma_s, is_covered in ((0.0, False), (0.05, True)):
        found = estimate_of(made, stamp_sigma_s=stamp_sigma_s, **held)
        error_rad = turn_between(found.geometry, made.scenario.truth).as_rotvec()
        chi2 = error_rad @ np.linalg.solve(found.covariance[10:, 10:], error_rad)
        assert bool(chi2 < 16.0) is is_covered
        assert np.linalg.norm(error_rad) > 12.0 * ARCSECOND_RAD


def with_fields(made: Campaign, change: Callable[[int], dict[str, object]]) -> Campaign:
    """Return a campaign whose images have other fields, by their number."""
    ensemble = each_image(made.ensemble, lambda k, _: change(k))
    return dataclasses.replace(made, ensemble=ensemble)


UNKNOWN = np.full(3, np.nan)


@pytest.mark.parametrize('stated', [{}, {'shutter': 'rolling', 'readout_s': READOUT_S}])
def test_without_any_rate_the_turn_of_a_low_orbit_is_in_the_sigma(stated) -> None:
    """Left out where the shutter is unknown, focal lengths were 9 to 16 sigma off."""
    made = simulate(dataclasses.replace(ROLLING, rate_deg_s=0.055), 2)
    made = with_fields(made, lambda _: {'star_tracker_rate_rad_s': UNKNOWN})
    found = estimate_of(made, **stated)
    layout = found.linear.layout
    assert {'readout', 'stamps'} < set(layout.places) and 'rates' not in layout
    error_px, sigma_px = of_focal(found, made)
    assert (np.abs(error_px) < 3.0 * sigma_px).all() and np.abs(error_px).max() > 0.1
    error_px, sigma_px = of_focal(estimate_of(made, shutter='global'), made)
    assert np.abs(error_px / sigma_px).max() > 8.0
    # A global shutter shows no turn: as good as with a rate of zero.
    still = simulate(dataclasses.replace(ROLLING, rate_deg_s=0.0), 2)
    _, known_px = of_focal(estimate_of(still, shutter='global'), still)
    assert sigma_px == pytest.approx(known_px, rel=0.1)


@pytest.mark.parametrize(
    ('step_s', 'rate_rad_s', 'assumed_rad_s'),
    [
        (60.0, 7e-5, 7e-5),  # fixed to the Earth
        (60.0, 0.0, 0.0),
        (60.0, 0.03, 6.4e-4),  # pointed anew
        (6000.0, 7e-5, 6.4e-4),  # a low orbit apart
    ],
)
def test_without_any_rate_a_camera_turns_as_its_images_do_or_as_an_orbit(
    step_s: float, rate_rad_s: float, assumed_rad_s: float
) -> None:
    images = []
    for late_s in step_s * np.array([2.0, 0.0, 1.0, 1.0, 3.0]):
        xyzw = Rotation.from_rotvec([0.0, late_s * rate_rad_s, 0.0]).as_quat()
        image = StarObservations.of_image(round(late_s * 1e9), (640, 512))
        images.append(dataclasses.replace(image, icrf_from_star_tracker_xyzw=xyzw))
    found = measured_rates(images)
    assert np.isnan(found.rad_s).all()
    assert found.root_rad_s == pytest.approx(np.tile(assumed_rad_s * np.eye(3), (5, 1, 1)))


@pytest.mark.parametrize('stated', [{}, {'shutter': 'rolling', 'readout_s': READOUT_S}])
def test_an_image_without_a_rate_turns_as_the_others_do(stated: dict[str, object]) -> None:
    """One of them left out the read-out of all: the sigma was too small by 30."""
    made = campaign(ROLLING, 2)
    error_px, sigma_px = of_focal(solved(ROLLING, 2, **stated), made)
    without: dict[str, object] = {'star_tracker_rate_rad_s': UNKNOWN}
    partly = with_fields(made, lambda k: without if k % 3 == 0 else {})
    found = estimate_of(partly, **stated)
    error_px, partly_px = of_focal(found, partly)
    assert 'readout' in found.linear.layout and 'rates' in found.linear.layout
    assert (np.abs(error_px) < 3.0 * partly_px).all()
    # Two thirds of the images have all that they had; the others still have their columns.
    assert (partly_px < 1.3 * sigma_px).all()
    root = found.linear.layout['rates']
    assert root.of_image and root.labels == ('rate_error_x', 'rate_error_y', 'rate_error_z')


NOISY = World(rate_deg_s=0.05, row_s=20e-3 / 1024, tracker_arcsec=20.0, tracker_hz=4.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('stated', 'filter_s'), [({}, 0.5), ({'shutter': 'rolling', 'readout_s': 0.02}, 0.0)]
)
def test_rates_by_samples_with_errors_of_their_own_show_no_absent_readout(
    stated: dict[str, object], filter_s: float
) -> None:
    """Rates that stars do not tell apart were 2.0 sigma off by slopes, over 10 by differences."""
    in_sigma = []
    for seed in range(4):
        made = simulate(dataclasses.replace(NOISY, filter_s=filter_s), seed)
        found = estimate_of(made, **stated)
        error_px, sigma_px = of_focal(found, made)
        in_sigma.append(error_px / sigma_px)
    assert np.sqrt(np.mean(np.square(in_sigma))) < 1.5 and np.abs(in_sigma).max() < 3.0


@pytest.mark.slow
def test_rates_whose_sender_states_no_sigma_show_no_absent_readout() -> None:
    """With a sigma by a data sheet that states half of the true noise the rms was 13."""
    world = World(rate_deg_s=0.1, row_s=20e-3 / 1024, tracker_arcsec=20.0, tracker_claim=0.5)
    in_sigma = []
    for seed in range(5):
        made = simulate(world, seed)
        # Two samples 0.1 s apart.
        noise = math.sqrt(2.0) * 20.0 * ARCSECOND_RAD / 0.1
        errors = noise * np.random.default_rng(seed).normal(size=(18, 3))
        rates = errors + [one.star_tracker_rate_rad_s for one in made.ensemble.images]
        fields: list[dict[str, object]] = [
            {'star_tracker_rate_rad_s': rate, 'attitude_gap_s': 0.1} for rate in rates
        ]
        made = with_fields(made, fields.__getitem__)
        error_px, sigma_px = of_focal(estimate_of(made), made)
        in_sigma.append(error_px / sigma_px)
    # 15 errors of which about half are independent: an rms of 1 to a quarter.
    assert np.sqrt(np.mean(np.square(in_sigma))) < 1.5 and np.abs(in_sigma).max() < 3.5


def test_a_rate_without_a_sigma_is_as_good_as_the_rates_agree() -> None:
    rng = np.random.default_rng(5)
    image = StarObservations.of_image(0, (640, 512))
    rates = np.radians([0.1, 0.0, 0.0]) + 1e-4 * rng.normal(size=(40, 3))
    images = [dataclasses.replace(image, star_tracker_rate_rad_s=rate) for rate in rates]
    found = measured_rates(images)
    sigma = np.sqrt(np.einsum('mij,mij->mi', found.root_rad_s, found.root_rad_s))
    assert sigma == pytest.approx(np.full((40, 3), 1e-4), rel=0.3)  # of 40: to a tenth
    left = found.rad_s - rates.mean(axis=0)
    assert np.sqrt(np.mean(left**2)) < 0.3e-4  # their differences are errors
    few = measured_rates(images[:2])
    assert few.root_rad_s == pytest.approx(np.tile(6.4e-4 * np.eye(3), (2, 1, 1)))  # a low orbit
    stated = [
        dataclasses.replace(one, star_tracker_rate_sigma_rad_s=np.full(3, 3e-5)) for one in images
    ]
    found = measured_rates(stated)
    # Their scatter is more than their errors: the rates stay as they are, but for a tenth.
    assert np.abs(found.rad_s - rates).max() < 0.15 * np.abs(rates - rates.mean(axis=0)).max()
    assert np.diagonal(found.root_rad_s, axis1=1, axis2=2) == pytest.approx(3e-5, rel=1e-3)


@pytest.mark.parametrize(
    ('recorded', 'asked', 'sigma_m_s'),
    [
        ((10.0, 10.0), -1.0, 10.0),
        ((0.0, 30.0), -1.0, 30.0),
        ((10.0, math.nan), -1.0, 20000.0),
        ((math.nan, math.nan), 2.0, 2.0),
        ((0.0, 0.0), -1.0, 0.0),
        ((math.nan, math.nan), 0.0, 0.0),
    ],
)
def test_the_velocity_is_as_uncertain_as_the_least_certain_image(
    recorded: tuple[float, float], asked: float, sigma_m_s: float
) -> None:
    made = simulate(World(images=6), 0)
    made = with_fields(made, lambda k: {'velocity_sigma_m_s': recorded[k == 5]})
    found = estimate_of(made, velocity_sigma_m_s=asked)
    assert ('velocity' in found.linear.layout) == (sigma_m_s > 0)
    if sigma_m_s:
        np.testing.assert_array_equal(found.linear.layout['velocity'].sigma, sigma_m_s)
