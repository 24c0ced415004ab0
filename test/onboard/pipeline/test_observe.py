# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A sequence of images: what is measured, what is refused, and where it stands after."""

import dataclasses
import functools
from pathlib import Path

import erfa
from geometries import turn_between, turned  # type: ignore[import-not-found]
import numpy as np
import pytest
from sample_sky import errors_sigma  # type: ignore[import-not-found]
from scipy.spatial.transform import Rotation
from tiny_campaign import attitudes, image, SCENARIO, TRUTH, values, write_png  # type: ignore[import-not-found]

from starcal_ground.simulation.rendering import render, star_electrons
from starcal_ground.simulation.scenario import attitude_samples, Inertial, scene
from starcal_ros.camera import project
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.formats.bag.typestore import make_message
from starcal_ros.formats.messages.record_messages import (
    observations_from_message,
    observations_to_message,
)
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import AttitudeSample, Ensemble, Image, StarObservations
from starcal_ros.sky.astrometry import air_above, apparent_directions, through_the_air
from starcal_ros.sky.attitude import attitude_sample, AttitudeHistory, attitudes_at, Mounting

S = 1_000_000_000


@pytest.fixture(scope='module')
def setup(camera_yaml: Path) -> Setup:
    return load_setup(values(camera_yaml))


def observed(one: Image, setup: Setup, track: observe.Track | None = None) -> StarObservations:
    """Observations of an image with the attitudes about the usual one."""
    return observe.observe_next(one, attitudes(), setup, track)[0]


def test_stars_are_observed(setup: Setup) -> None:
    found = observed(image(), setup)
    assert found.refusal == '' and len(found) > 100
    assert (found.attitude_gap_s, found.time_ns) == (0.5, image().time_ns)
    # One error for all samples of an image, which do not move: the interpolation adds nothing.
    reported = scene(SCENARIO, 1).icrf_from_star_tracker_xyzw
    np.testing.assert_allclose(found.icrf_from_star_tracker_xyzw, reported, atol=1e-9)


def test_from_the_ground_stars_are_where_the_air_puts_them(camera_yaml: Path) -> None:
    drawn = scene(SCENARIO, 1)
    # A site that sees the middle of the image 20 degrees above its northern or southern horizon.
    _, _, ahead = drawn.camera_from_icrf
    sidereal_rad = erfa.era00(2440587.5, drawn.time_ns / (86400 * S))
    longitude = np.degrees(np.arctan2(ahead[1], ahead[0]) - sidereal_rad) % 360
    declination = np.degrees(np.arcsin(ahead[2]))
    ground = {
        'observer': 'ground',
        'latitude_deg': declination - np.copysign(70.0, declination),
        'longitude_deg': longitude,
        'height_m': 500.0,
    }

    def seen_from(made: Setup) -> tuple[np.ndarray, np.ndarray, np.ndarray, StarObservations]:
        """Directions (n, 3) through the air, elevations, pixels, and what is observed."""
        bent_icrf, elevation_rad = through_the_air(drawn.direction_icrf, drawn.time_ns, made.site)
        pixel_px = project(TRUTH.camera, bent_icrf @ drawn.camera_from_icrf.T)
        seen = render(SCENARIO, dataclasses.replace(drawn, pixel_px=pixel_px), 1)
        return bent_icrf, elevation_rad, pixel_px, observed(seen, made, observe.Track(TRUTH))

    made = load_setup(values(camera_yaml, **ground))
    bent_icrf, elevation_rad, pixel_px, found = seen_from(made)
    assert np.degrees(np.median(elevation_rad)) == pytest.approx(20.0, abs=2.0)
    moved_px = pixel_px - drawn.pixel_px
    assert np.linalg.norm(moved_px, axis=1).min() > 0.5 and np.ptp(moved_px, axis=0).max() > 1.0
    assert found.refusal == '' and len(found) > 100
    in_sigma = errors_sigma(dataclasses.replace(drawn, pixel_px=pixel_px), found)
    assert np.sqrt((in_sigma**2).mean()) < 1.2  # as of stars in space
    # What is recorded is the bent direction, so that a calibration from the record is the same.
    bent = dict(zip(drawn.catalog_id.tolist(), bent_icrf, strict=True))
    recorded = [bent[number] for number in found.catalog_id.tolist()]
    np.testing.assert_allclose(found.direction_icrf, recorded, rtol=0, atol=1e-12)
    zenith_icrf, refraction_arcsec = air_above(drawn.time_ns, made.site)
    np.testing.assert_array_equal(found.zenith_icrf, zenith_icrf)
    np.testing.assert_array_equal(found.refraction_arcsec, refraction_arcsec)
    # Ten degrees lower, half of the stars are too near to the horizon.
    ground['latitude_deg'] = declination - np.copysign(80.0, declination)
    _, elevation_rad, _, upper = seen_from(load_setup(values(camera_yaml, **ground)))
    used = np.isin(drawn.catalog_id, upper.catalog_id)
    assert 30 < len(upper) < len(found) and np.degrees(elevation_rad[used].min()) >= 10.0


def test_an_image_of_another_size_is_refused(setup: Setup) -> None:
    found = observed(Image(image().time_ns, image().pixels[:-2].copy()), setup)
    assert found.refusal == 'wrong_size'
    assert found.detail == 'image of 640 x 510, prior camera of 640 x 512'
    assert (found.width, found.height, len(found)) == (640, 510, 0)


def test_an_image_without_attitude_is_refused(setup: Setup) -> None:
    """By each reason of the history: test/onboard/sky/test_attitude.py."""
    spoilt = AttitudeHistory()
    spoilt.add(image().time_ns, None)
    found = observe.observe_next(image(), spoilt, setup)[0]
    assert found.refusal == 'bad_attitude' and found.detail
    assert np.isnan(found.attitude_gap_s)


def test_an_image_that_nothing_explains_keeps_its_attitude(setup: Setup) -> None:
    noise = np.random.default_rng(5).normal(40.0, 3.0, image().pixels.shape)
    found = observed(Image(image().time_ns, noise.astype(np.uint16)), setup)
    assert found.refusal == 'no_stars'
    assert found.attitude_gap_s == 0.5
    assert found.catalog_digest == setup.catalog.digest
    assert abs(found.icrf_from_star_tracker_xyzw[3]) < 1.0


@pytest.mark.parametrize(
    ('late_ns', 'words'),
    [
        (250_000_000, '0.250000 s before the last image used'),
        (0, 'the stamp of the last image used: two publishers on one topic?'),
    ],
)
def test_out_of_order_images_say_by_how_much(setup: Setup, late_ns: int, words: str) -> None:
    track = observe.Track(setup.prior, image().time_ns + late_ns)
    found, after = observe.observe_next(image(), attitudes(), setup, track)
    assert (found.refusal, found.detail) == ('out_of_order', words)
    assert (after.geometry, after.latest_ns) == (track.geometry, track.latest_ns)


def passed(setup: Setup, track: observe.Track, *offsets_s: int) -> list[str]:
    """Refusals of one image at several times about that of the last used; no attitudes come."""
    found = []
    for offset_s in offsets_s:
        one = dataclasses.replace(image(), time_ns=image().time_ns + offset_s * 10**9)
        observations, track = observe.observe_next(one, AttitudeHistory(), setup, track)
        found.append(observations.refusal)
    return found


def test_the_third_image_in_a_row_from_the_past_starts_anew(setup: Setup) -> None:
    """A clock set back costs two images; two that have changed places do not start anything."""
    late, taken = 'out_of_order', 'no_attitude'
    track = observe.Track(setup.prior, image().time_ns)
    assert passed(setup, track, -90, -80, -70, -60) == [late, late, taken, taken]
    assert passed(setup, track, -90, -80, -85, -70) == [late, late, late, late]
    assert passed(setup, track, -90, -80, 5, -70, -60, 6) == [late, late, taken, late, late, taken]


MS = 1_000_000
LATER = 1000 * S
SHOWN_AGAIN: dict[str, tuple[list[tuple[int, int]], dict[str, int]]] = {
    'the camera hangs': ([(1, 0), (2, 0), (2, S), (2, 2 * S)], {'frozen': 2}),
    'a recording again, with new stamps': (
        [(k, again * LATER) for again in range(3) for k in (1, 2)],
        {'duplicate': 4},
    ),
    'two publishers, in turn': ([(k, late) for k in (1, 2) for late in (0, MS)], {'frozen': 2}),
    'two publishers, one after the other': (
        [(k, late) for late in (0, MS) for k in (1, 2, 3, 4)],
        # The third image from the past starts anew.
        {'out_of_order': 2, 'duplicate': 2},
    ),
}
"""Numbers of images with their delay, and the reasons to refuse some."""


@pytest.mark.parametrize('name', SHOWN_AGAIN)
def test_an_image_counts_once_whatever_its_stamps(setup: Setup, name: str) -> None:
    """As it is observed, and as it is recorded."""
    shown, refused = SHOWN_AGAIN[name]
    live, recorded = Ensemble(), Ensemble()
    track, held = observe.Track(setup.prior), AttitudeHistory()
    for index, delay_ns in sorted(shown, key=lambda one: one[1]):
        for sample in attitude_samples(SCENARIO, index):
            time_ns = sample.time_ns + delay_ns
            held.add(time_ns, dataclasses.replace(sample, time_ns=time_ns))
    for index, delay_ns in shown:
        one = dataclasses.replace(image(index), time_ns=image(index).time_ns + delay_ns)
        found, track = observe.observe_next(one, held, setup, track)
        live = live.add(found)
        message = observations_to_message(found, 'camera', make_message)
        recorded = recorded.add(observations_from_message(message))
    for ensemble in (live, recorded):
        assert len(ensemble.images) == len({index for index, _ in shown})
        assert dict(ensemble.refused) == refused
    # Recordings of before had no digests: stamps tell images apart.
    older = [StarObservations.of_image(k, (640, 512)) for k in range(3)]
    assert len(functools.reduce(Ensemble.add, older, Ensemble()).images) == 3


def test_a_refused_image_does_not_put_those_after_it_out_of_order(setup) -> None:
    track = observe.Track(setup.prior)
    future = dataclasses.replace(image(2), time_ns=image().time_ns + 10**15)
    refused, track = observe.observe_next(future, attitudes(), setup, track)
    assert refused.refusal == 'no_attitude'
    found, track = observe.observe_next(image(), attitudes(), setup, track)
    assert found.refusal == '' and track.latest_ns == image().time_ns


@pytest.mark.parametrize('jump_deg', [1.0, 6.0])
def test_a_star_tracker_that_jumped_and_came_back(setup: Setup, jump_deg: float) -> None:
    off = turned(setup.prior, Rotation.from_euler('xyz', [0.7, -0.5, 3.0], degrees=True))
    jump = Rotation.from_rotvec(np.array([0.6, -0.8, 0.0]) * np.radians(jump_deg))
    track, seen = observe.Track(off), []
    for index in range(5):
        held = attitudes(index, turn=jump if index == 2 else None)
        before = track
        found, track = observe.observe_next(image(index), held, setup, track)
        seen.append(found.refusal)
        if not found.refusal:
            assert len(found) > 60
        else:
            assert track.geometry is before.geometry and track.trackers is before.trackers
            assert track.latest_ns == before.latest_ns
    # Beyond the search the jump is refused, within it the stars are still the right ones.
    assert seen == ['', '', '' if jump_deg < 1.5 else 'no_match', '', '']
    # What the first image found of the turned alignment has carried to the last.
    # One error of the tracker, (10, 10, 40) arcsec, and what the prior camera is off by.
    assert turn_between(TRUTH, track.geometry).magnitude() < 200 * ARCSECOND_RAD


def test_a_dark_frame_takes_a_pattern_away(camera_yaml: Path, tmp_path: Path) -> None:
    # Every second row 30 DN up, and hot pixels in many stars.
    rng = np.random.default_rng(9)
    pattern = np.full((512, 640), 40.0)
    pattern[::2] += 30.0
    pattern.flat[rng.choice(pattern.size, 3000, replace=False)] += 300.0
    one = scene(SCENARIO, 1)
    light = star_electrons(one.pixel_px, one.flux_electrons, 0.95, (512, 640)) / 8.0
    noise = rng.normal(0, 1.2, pattern.shape)
    pixels = np.clip(np.rint(pattern + light + noise), 0, 4095).astype(np.uint16)
    dark = np.rint(pattern).astype(np.uint16)
    one_image = Image(image().time_ns, pixels)
    without = load_setup(values(camera_yaml))
    url = write_png(tmp_path / 'dark.png', dark)
    with_dark = load_setup(values(camera_yaml, dark_frame='file://' + url))
    np.testing.assert_array_equal(with_dark.detector.dark, dark)
    spoilt = observed(one_image, without)
    found = observed(one_image, with_dark)
    assert found.refusal == '' and len(found) > max(150, 2 * len(spoilt))
    # The noise of the image alone is left, and nothing is cut off at zero below the dark level.
    assert found.noise_dn == pytest.approx(1.2, rel=0.1)
    assert found.background_dn == pytest.approx(np.median(dark), abs=0.3)
    assert np.sqrt(np.mean(errors_sigma(one, found) ** 2)) < 1.3


def test_a_dark_frame_of_a_byte(camera_yaml: Path, tmp_path: Path) -> None:
    url = write_png(tmp_path / 'dark.png', np.full((512, 640), 7, np.uint8))
    made = load_setup(values(camera_yaml, dark_frame=url))
    assert made.detector.dark is not None and made.detector.dark.dtype == np.uint8
    found = observed(image(), made)
    assert found.refusal == 'bad_encoding'
    assert found.detail == 'uint16 image, the dark frame is uint8'
    one = scene(SCENARIO, 1)
    light = star_electrons(one.pixel_px, one.flux_electrons, 0.95, (512, 640)) / 100.0
    noise = np.random.default_rng(1).normal(0, 1.0, light.shape)
    pixels = np.clip(np.rint(light + 7 + noise), 0, 255).astype(np.uint8)
    byte = observed(Image(image().time_ns, pixels), made)
    assert byte.refusal == '' and byte.background_dn == pytest.approx(7.0, abs=0.2)


def test_hot_pixels_found_in_a_sequence_are_not_measured_as_stars(setup) -> None:
    """One is put under a star of the third image: bright or dim, the star is left out for it."""
    track = observe.Track(setup.prior)
    held = attitudes(1, 2, 3)
    plain = observe.observe_next(image(3), held, setup)[0]
    star = np.argsort(plain.snr)[len(plain) // 2]
    u, v = np.rint(plain.measured_px[star] + [1.0, 0.0]).astype(int)
    for index in (1, 2, 3):
        pixels = image(index).pixels.copy()
        # 15 sigma, one pixel off the centre of a star, pull it by several of its own sigma.
        pixels[v, u] += round(15.0 * plain.noise_dn)
        found, track = observe.observe_next(
            dataclasses.replace(image(index), pixels=pixels), held, setup, track
        )
        assert found.refusal == ''
    assert plain.catalog_id[star] not in found.catalog_id
    assert why_refused(found, plain.catalog_id[star]) == 'hot_pixel'


def why_refused(found: StarObservations, star: int) -> str:
    (code,) = found.refused_reason[found.refused_catalog_id == star].tolist()
    return str(list(found.refused_stars)[code])


def test_a_saturated_star_is_known_as_such_under_a_dark_frame(camera_yaml, tmp_path) -> None:
    """What the dark frame takes away must not hide that the converter was at its end."""
    dark = np.random.default_rng(4).normal(32.0, 2.0, image().pixels.shape).astype(np.uint16)
    path = write_png(tmp_path / 'dark.png', dark)
    made = load_setup(values(camera_yaml, dark_frame=path, max_saturated_pixels=0))
    pixels = image().pixels.copy()
    plain = observed(image(), made)
    u, v = np.rint(plain.measured_px[plain.snr.argmax()]).astype(int)
    pixels[v - 1 : v + 2, u - 1 : u + 2] = 4095
    found = observed(dataclasses.replace(image(), pixels=pixels), made)
    assert why_refused(found, plain.catalog_id[plain.snr.argmax()]) == 'saturated'


def _observed(setup: Setup, step_arcsec: float, is_hung: bool) -> list[str]:
    """Refusals of five images, each turned by a step; the star tracker may hang at the first."""
    dec_deg = [20.0 + k * step_arcsec / 3600.0 for k in range(5)]
    fields = tuple((250.0, dec, 10.0) for dec in dec_deg)
    drift = dataclasses.replace(SCENARIO, pointing=Inertial(fields))
    hung = scene(drift, 0).icrf_from_star_tracker_xyzw
    history = AttitudeHistory()
    for k in range(5):
        for sample in attitude_samples(drift, k):
            xyzw = hung if is_hung else sample.icrf_from_star_tracker_xyzw
            history.add(sample.time_ns, AttitudeSample(sample.time_ns, xyzw))
    track, refusals = observe.Track(setup.prior), []
    for k in range(5):
        one = render(drift, scene(drift, k), k)
        found, track = observe.observe_next(one, history, setup, track)
        refusals.append(found.refusal)
    return refusals


def test_a_hung_star_tracker_is_refused_once_the_stars_have_turned(setup: Setup) -> None:
    """By twice the largest sigma of the star tracker and a tenth of a pixel: 91 arcsec."""
    ok, frozen = '', 'frozen_attitude'
    assert _observed(setup, 72.0, is_hung=True) == [ok, ok, frozen, frozen, frozen]
    assert _observed(setup, 72.0, is_hung=False) == [ok] * 5
    # A spacecraft that holds its attitude, with a star tracker without noise.
    assert _observed(setup, 0.0, is_hung=True) == [ok] * 5


def test_the_rate_of_the_star_tracker_is_recorded(setup: Setup) -> None:
    """Two samples half a second before and after the image, 0.02 degrees apart."""
    step = Rotation.from_rotvec(np.radians([0.0, 0.01, 0.0]))
    held = AttitudeHistory()
    middle = Rotation.from_quat(scene(SCENARIO, 1).icrf_from_star_tracker_xyzw)
    for time_s, reported in ((-0.5, middle * step.inv()), (0.5, middle * step)):
        time_ns = image().time_ns + round(time_s * S)
        held.add(time_ns, AttitudeSample(time_ns, reported.as_quat()))
    found = observe.observe_next(image(), held, setup)[0]
    assert not found.refusal
    expected = np.radians([0.0, 0.02, 0.0])
    np.testing.assert_allclose(found.star_tracker_rate_rad_s, expected, atol=1e-12)


def test_the_rate_of_a_further_star_tracker_is_about_the_axes_of_the_first() -> None:
    rate_rad_s = np.array([0.01, 0.0, 0.0])
    held = AttitudeHistory()
    for time_s in (0.0, 1.0):
        turned = Rotation.from_rotvec(time_s * rate_rad_s).as_quat()
        held.add(round(time_s * S), attitude_sample(round(time_s * S), turned, 'st_to_inertial'))
    mounted = Mounting('second', Rotation.from_euler('z', 90, degrees=True).as_quat())
    (found,) = attitudes_at(S // 2, AttitudeHistory(), [held], [mounted], 2.0, {}, np.ones(3))
    np.testing.assert_allclose(found.star_tracker_rate_rad_s, [0.0, 0.01, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ('others', 'measured_m_s', 'sigma_m_s'),
    [
        ({}, None, np.nan),
        ({}, [0.0, 3e4, 0.0], 10.0),
        ({}, [0.0, 7.6e3, 0.0], np.nan),
        ({'observer_velocity_m_s': [0.0, 0.0, 1.0]}, None, np.nan),
        ({'observer_velocity_m_s': [0.0, 3e4, 0.0]}, None, 10.0),
        ({'observer_velocity_m_s': [9e4, 0.0, 0.0]}, [0.0, 3e4, 0.0], 10.0),
        ({'observer': 'ground', 'latitude_deg': 30.0}, [0.0, 3e4, 0.0], 0.0),
        ({'observer': 'ground'}, [0.0, 3e4, 0.0], np.nan),
    ],
)
def test_the_sigma_of_the_velocity_is_recorded(
    camera_yaml, others, measured_m_s, sigma_m_s
) -> None:
    """Of used and of refused images; a message stands before the constant of the options."""
    setup = load_setup(values(camera_yaml, **others))
    given = None if measured_m_s is None else np.array(measured_m_s)
    blank = Image(image().time_ns, np.full_like(image().pixels, 32))
    for one in (blank, image()):
        found = observe.observe_next(one, attitudes(), setup, None, given)[0]
        np.testing.assert_equal(found.velocity_sigma_m_s, sigma_m_s)
    if sigma_m_s == 10.0:
        rows, _ = setup.catalog.rows_of(found.catalog_id)
        stated_m_s = np.array([0.0, 3e4, 0.0])
        expected = apparent_directions(setup.catalog, image().time_ns, stated_m_s, rows)
        np.testing.assert_allclose(found.direction_icrf, expected, rtol=0, atol=1e-15)
