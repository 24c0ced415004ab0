"""The flow as one: what it is set up with, what it refuses, and what it says of its result."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path

import cv2
import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ros import bag, pipeline
from starcal_ros.astrometry import through_the_air
from starcal_ros.attitude import attitude_sample, AttitudeHistory
from starcal_ros.calibration import CalibrationOptions
from starcal_ros.camera import PARAMETER_NAMES, project
from starcal_ros.camera_info import write_camera_info
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import CatalogError, OptionError, ProductError, TooFewObservations
from starcal_ros.node_options import NODE_OPTION_CLASSES
from starcal_ros.options import holds_options, names_of
from starcal_ros.records import (
    ALIGNMENT_NAMES,
    CALIBRATION_PARAMETER_NAMES,
    CameraGeometry,
    Ensemble,
    Image,
    refused_image,
)
from starcal_ros.synthetic import attitude_samples, Detector, scenario, scene
from starcal_ros.synthetic_centroids import true_observations
from starcal_ros.synthetic_images import render, star_electrons

SCENARIO = scenario('tiny', seed=7)
TRUTH = SCENARIO.truth
S = 1_000_000_000


@pytest.fixture(scope='module')
def camera_yaml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp('prior') / 'camera.yaml'
    write_camera_info(SCENARIO.prior.camera, path)
    return path


def values(camera_yaml: Path, **others: object) -> dict[str, object]:
    """A parameter file's content that is complete."""
    return {
        'camera_info_url': str(camera_yaml),
        'prior_alignment': SCENARIO.prior.star_tracker_from_camera_xyzw.tolist(),
        'star_tracker_sigma_arcsec': [10.0, 10.0, 40.0],
        **others,
    }


@pytest.fixture(scope='module')
def setup(camera_yaml: Path) -> pipeline.Setup:
    return pipeline.load_setup(values(camera_yaml))


@functools.cache
def ensemble() -> Ensemble:
    return true_observations(SCENARIO)


@functools.cache
def image(index: int = 1) -> Image:
    return render(SCENARIO, scene(SCENARIO, index), index)


def attitudes(index: int = 1) -> AttitudeHistory:
    held = AttitudeHistory()
    for sample in attitude_samples(SCENARIO, index):
        held.add(sample.time_ns, sample)
    return held


def test_a_setup_holds_what_the_parameters_say(camera_yaml: Path) -> None:
    made = pipeline.load_setup(
        values(
            camera_yaml,
            centroid='moment',
            method='single',
            estimate=['fx', 'fy'],
            max_attitude_gap_s=7,
            magnitude_limit=6.0,
            max_residual_rms_px=0.3,
            camera_frame='left_eye',
            use_sim_time=True,
        )
    )
    assert made.centroid.centroid == 'moment'
    assert made.calibration.method == 'single'
    assert made.calibration.estimate == ('fx', 'fy')
    assert made.attitude.max_attitude_gap_s == 7.0
    assert made.gate.max_residual_rms_px == 0.3
    assert made.frames.camera_frame == 'left_eye'
    assert made.catalog.magnitude.max() <= 6.0
    assert made.dark is None
    np.testing.assert_array_equal(made.prior.camera.parameters, SCENARIO.prior.camera.parameters)


def test_a_rounded_alignment_is_made_unit(camera_yaml: Path) -> None:
    q = np.round(SCENARIO.prior.star_tracker_from_camera_xyzw, 4)
    made = pipeline.load_setup(values(camera_yaml, prior_alignment=q.tolist()))
    assert np.linalg.norm(made.prior.star_tracker_from_camera_xyzw) == pytest.approx(1, abs=1e-15)


def test_the_parameters_of_a_node_are_known_where_it_asks(camera_yaml: Path) -> None:
    both = values(camera_yaml, autostart=False)
    pipeline.load_setup(both, NODE_OPTION_CLASSES)
    with pytest.raises(OptionError, match='autostart: no such parameter'):
        pipeline.load_setup(both)


@pytest.mark.parametrize(
    ('wrong', 'says'),
    [
        ({'max_residual_rms': 1.0}, 'max_residual_rms: no such parameter'),
        ({'camera_info_url': ''}, 'camera_info_url: the prior camera must be given'),
        (
            {'prior_alignment': [0.0, 0.0, 0.0, 0.9]},
            'prior_alignment: .* is not a unit quaternion',
        ),
        (
            {'prior_alignment': [0.0, 0.0, 0.0, 0.0]},
            'prior_alignment: .* is not a unit quaternion',
        ),
        ({'prior_alignment': [0.0, 0.0, 1.0]}, 'prior_alignment: .* is not a list of 4'),
        ({'method': 'best'}, "method: 'best' is not one of hierarchical, per_image, single"),
        ({'estimate': ['fx', 'fz']}, 'estimate: .* is not one of fx, skew'),
        ({'min_images': 2.5}, 'min_images: 2.5 is not a whole number'),
        (
            {'dark_frame': '/no/such/dark.png'},
            'dark_frame: /no/such/dark.png is not an image file',
        ),
    ],
)
def test_a_wrong_parameter_is_named(
    camera_yaml: Path, wrong: dict[str, object], says: str
) -> None:
    with pytest.raises(OptionError, match=says):
        pipeline.load_setup(values(camera_yaml, **wrong))


def test_a_wrong_file_is_named(camera_yaml: Path, tmp_path: Path) -> None:
    with pytest.raises(ProductError, match='missing.yaml'):
        pipeline.load_setup(values(tmp_path / 'missing.yaml'))
    (tmp_path / 'stars.csv').write_text('these are no stars')
    for name in ('stars.csv', 'missing.csv'):
        with pytest.raises(CatalogError, match=name):
            pipeline.load_setup(values(camera_yaml, catalog=str(tmp_path / name)))


def test_stars_are_observed(setup: pipeline.Setup) -> None:
    found = pipeline.observe(image(), attitudes(), setup, setup.prior)
    assert found.refusal == '' and len(found) > 100
    assert found.attitude_gap_s == 0.5
    assert found.time_ns == image().time_ns
    one = scene(SCENARIO, 1)
    attitude_error = (
        Rotation.from_quat(found.icrf_from_star_tracker_xyzw).inv()
        * Rotation.from_quat(one.icrf_from_star_tracker_xyzw)
    ).magnitude()
    # One error for all samples of an image, which do not move: the interpolation adds nothing.
    assert attitude_error < 1e-9


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
    made = pipeline.load_setup(values(camera_yaml, **ground))
    bent_icrf, elevation_rad = through_the_air(drawn.direction_icrf, drawn.time_ns, made.site)
    assert np.degrees(np.median(elevation_rad)) == pytest.approx(20.0, abs=2.0)
    pixel_px = project(TRUTH.camera, bent_icrf @ drawn.camera_from_icrf.T)
    moved_px = pixel_px - drawn.pixel_px
    assert np.linalg.norm(moved_px, axis=1).min() > 0.5 and np.ptp(moved_px, axis=0).max() > 1.0
    seen = render(SCENARIO, dataclasses.replace(drawn, pixel_px=pixel_px), 1)
    found = pipeline.observe(seen, attitudes(), made, TRUTH)
    place = {
        number: (pixel, direction)
        for number, pixel, direction in zip(
            drawn.catalog_id.tolist(), pixel_px, bent_icrf, strict=True
        )
    }
    assert found.refusal == '' and len(found) > 100
    uu, _, vv = found.covariance_px2.T
    off_px = found.measured_px - [place[number][0] for number in found.catalog_id.tolist()]
    in_sigma = off_px / np.sqrt(np.stack([uu, vv], axis=-1))
    assert np.sqrt((in_sigma**2).mean()) < 1.2  # as of stars in space
    # What is recorded is the bent direction, so that a calibration from the record is the same.
    recorded = [place[number][1] for number in found.catalog_id.tolist()]
    np.testing.assert_allclose(found.direction_icrf, recorded, rtol=0, atol=1e-12)
    higher = pipeline.load_setup(values(camera_yaml, **ground, min_elevation_deg=20.0))
    upper = pipeline.observe(seen, attitudes(), higher, TRUTH)
    _, elevation_rad = through_the_air(
        drawn.direction_icrf[np.isin(drawn.catalog_id, upper.catalog_id)],
        drawn.time_ns,
        made.site,
    )
    assert 30 < len(upper) < len(found) and np.degrees(elevation_rad.min()) >= 20.0


def test_an_image_of_another_size_is_refused(setup: pipeline.Setup) -> None:
    small = Image(image().time_ns, image().pixels[:-2].copy())
    found = pipeline.observe(small, attitudes(), setup, setup.prior)
    assert (found.refusal, found.detail) == ('wrong_size', '640 x 510, the camera has 640 x 512')
    assert (found.width, found.height) == (640, 510)
    assert len(found) == 0


def test_an_image_without_attitude_is_refused(setup: pipeline.Setup) -> None:
    samples = attitude_samples(SCENARIO, 1)
    wide = AttitudeHistory()
    for sign in (-5, 5):
        time_ns = image().time_ns + sign * S
        wide.add(time_ns, attitude_sample(time_ns, np.array([0, 0, 0, 1.0]), 'st_to_inertial'))
    half = AttitudeHistory()
    half.add(samples[0].time_ns, samples[0])
    spoilt = AttitudeHistory()
    spoilt.add(image().time_ns, None)
    for held, reason in (
        (AttitudeHistory(), 'no_attitude'),
        (half, 'no_attitude'),
        (wide, 'attitude_gap'),
        (spoilt, 'bad_attitude'),
    ):
        found = pipeline.observe(image(), held, setup, setup.prior)
        assert found.refusal == reason and found.detail
        assert found.attitude_gap_s == -1.0


def test_an_image_that_nothing_explains_keeps_its_attitude(setup: pipeline.Setup) -> None:
    noise = np.random.default_rng(5).normal(40.0, 3.0, image().pixels.shape)
    found = pipeline.observe(
        Image(image().time_ns, noise.astype(np.uint16)), attitudes(), setup, setup.prior
    )
    assert found.refusal == 'no_stars'
    assert found.attitude_gap_s == 0.5
    assert found.catalog_digest == setup.catalog.digest
    assert abs(found.icrf_from_star_tracker_xyzw[3]) < 1.0


def test_out_of_order_images_say_by_how_much(setup: pipeline.Setup) -> None:
    track = pipeline.Track(setup.prior, image().time_ns + 250_000_000)
    found, after = pipeline.observe_next(image(), attitudes(), setup, track)
    assert found.refusal == 'out_of_order'
    assert found.detail == '0.250000 s before the last image used'
    assert (after.geometry, after.latest_ns) == (track.geometry, track.latest_ns)


def passed(setup: pipeline.Setup, track: pipeline.Track, *offsets_s: int) -> list[str]:
    """Refusals of one image at several times about that of the last used; no attitudes come."""
    found = []
    for offset_s in offsets_s:
        one = dataclasses.replace(image(), time_ns=image().time_ns + offset_s * 10**9)
        observations, track = pipeline.observe_next(one, AttitudeHistory(), setup, track)
        found.append(observations.refusal)
    return found


def test_the_third_image_in_a_row_from_the_past_starts_anew(setup: pipeline.Setup) -> None:
    """A clock set back costs two images; two that have changed places do not start anything."""
    late, taken = 'out_of_order', 'no_attitude'
    track = pipeline.Track(setup.prior, image().time_ns)
    assert passed(setup, track, -90, -80, -70, -60) == [late, late, taken, taken]
    assert passed(setup, track, -90, -80, -85, -70) == [late, late, late, late]
    assert passed(setup, track, -90, -80, 5, -70, -60, 6) == [late, late, taken, late, late, taken]


def test_a_recording_that_plays_twice_counts_once(setup: pipeline.Setup) -> None:
    first, _ = pipeline.observe_next(image(), attitudes(), setup, pipeline.Track(setup.prior))
    assert not first.refusal
    later = dataclasses.replace(first, time_ns=first.time_ns + 1)
    ensemble = Ensemble().add(first).add(later)
    again = dataclasses.replace(first, attitude_gap_s=0.125)
    ensemble = ensemble.add(again)
    assert ensemble.images == (first, later) and dict(ensemble.refused) == {'duplicate': 1}


def test_a_refused_image_does_not_put_those_after_it_out_of_order(setup: pipeline.Setup) -> None:
    track = pipeline.Track(setup.prior)
    future = dataclasses.replace(image(2), time_ns=image().time_ns + 10**15)
    refused, track = pipeline.observe_next(future, attitudes(), setup, track)
    assert refused.refusal == 'no_attitude'
    found, track = pipeline.observe_next(image(), attitudes(), setup, track)
    assert found.refusal == '' and track.latest_ns == image().time_ns


@pytest.mark.parametrize('jump_deg', [1.0, 6.0])
def test_a_star_tracker_that_jumped_and_came_back(setup: pipeline.Setup, jump_deg: float) -> None:
    turned = CameraGeometry(
        setup.prior.camera,
        (
            Rotation.from_quat(setup.prior.star_tracker_from_camera_xyzw)
            * Rotation.from_euler('xyz', [0.7, -0.5, 3.0], degrees=True)
        ).as_quat(),
    )
    off = np.array([0.6, -0.8, 0.0]) * np.radians(jump_deg)
    track, lengths, seen = pipeline.Track(turned), [], []
    for index in range(5):
        held = AttitudeHistory()
        for sample in attitude_samples(SCENARIO, index):
            right = Rotation.from_quat(sample.icrf_from_star_tracker_xyzw)
            reported = right * Rotation.from_rotvec(off) if index == 2 else right
            held.add(
                sample.time_ns,
                attitude_sample(sample.time_ns, reported.as_quat(), 'st_to_inertial'),
            )
        before = track
        found, track = pipeline.observe_next(image(index), held, setup, track)
        lengths.append(len(found))
        seen.append(found.refusal)
        if found.refusal:
            assert track.geometry is before.geometry and track.followed is before.followed
            assert track.latest_ns == before.latest_ns
    # Beyond the search the jump is refused, within it the stars are still the right ones.
    assert seen == ['', '', '' if jump_deg < 1.5 else 'no_match', '', '']
    used = [length for length, refusal in zip(lengths, seen, strict=True) if not refusal]
    assert min(used) > 60
    # What the first image found of the turned alignment has carried to the last.
    left = Rotation.from_quat(TRUTH.star_tracker_from_camera_xyzw).inv() * Rotation.from_quat(
        track.geometry.star_tracker_from_camera_xyzw
    )
    # One error of the tracker, (10, 10, 40) arcsec, and what the prior camera is off by.
    assert left.magnitude() < 200 * ARCSECOND_RAD


def test_the_last_sample_at_or_before_an_image_counts() -> None:
    samples = [(10, 'a'), (20, 'b'), (30, 'c')]
    for time_ns, sample in ((5, 'a'), (10, 'a'), (29, 'b'), (30, 'c'), (99, 'c')):
        assert pipeline.latest_at(samples, time_ns, 'none') == sample
    assert pipeline.latest_at([], 5, 'none') == 'none'


def test_a_bag_with_temperatures_to_a_calibration_with_terms(
    camera_yaml: Path, tmp_path: Path
) -> None:
    with bag.BagWriter(tmp_path / 'warm') as writer:
        for index in range(4):
            for sample in attitude_samples(SCENARIO, index):
                quaternion = sample.icrf_from_star_tracker_xyzw
                writer.write_attitude('/attitude', sample.time_ns, quaternion, 'icrf')
            one = image(index)
            writer.write_temperature('/box', one.time_ns - S, 10.0 + 5.0 * index, 'camera')
            writer.write_temperature('/box', one.time_ns + 1, 99.0, 'camera')
            writer.write_image('/image', one, 'camera')
    warm = pipeline.load_setup(
        values(camera_yaml, focal_temperature_order=1, alignment_temperature=True)
    )
    paths = [tmp_path / 'warm']
    found = list(pipeline.observe_bag(paths, '/image', '/attitude', warm, '', '/box'))
    assert [one.temperature_degc for one in found] == [10.0, 15.0, 20.0, 25.0]
    plain = list(pipeline.observe_bag(paths, '/image', '/attitude', warm))
    assert all(np.isnan(one.temperature_degc) for one in plain)
    # The simulated camera does not change with temperature, and that is what is found.
    terms = pipeline.solve(Ensemble(tuple(found)), warm).thermal
    assert terms is not None and terms.reference_degc == 20.0
    assert 'within chance' in terms.note
    terms = pipeline.solve(Ensemble(tuple(plain)), warm).thermal
    assert terms is not None and terms.note == 'left out: 4 of 4 images have no temperature'


def test_options_that_do_not_go_together(camera_yaml: Path) -> None:
    with pytest.raises(OptionError, match='alignment_temperature: the method per_image'):
        pipeline.load_setup(values(camera_yaml, method='per_image', alignment_temperature=True))


def write_png(path: Path, pixels: np.ndarray) -> str:
    assert cv2.imwrite(str(path), pixels)
    return str(path)


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
    without = pipeline.load_setup(values(camera_yaml))
    url = write_png(tmp_path / 'dark.png', dark)
    with_dark = pipeline.load_setup(values(camera_yaml, dark_frame='file://' + url))
    np.testing.assert_array_equal(with_dark.dark, dark)
    spoilt = pipeline.observe(one_image, attitudes(), without, without.prior)
    found = pipeline.observe(one_image, attitudes(), with_dark, with_dark.prior)
    assert found.refusal == '' and len(found) > max(150, 2 * len(spoilt))
    # The noise of the image alone is left, and nothing is cut off at zero below the dark level.
    assert found.noise_dn == pytest.approx(1.2, rel=0.1)
    assert found.background_dn == pytest.approx(np.median(dark), abs=0.3)
    place = dict(zip(one.catalog_id.tolist(), one.pixel_px, strict=True))
    off_px = found.measured_px - np.array([place[number] for number in found.catalog_id])
    sigma_px = np.sqrt(found.covariance_px2[:, [0, 2]])
    assert np.sqrt(np.mean((off_px / sigma_px) ** 2)) < 1.3


def test_a_dark_frame_of_a_byte(camera_yaml: Path, tmp_path: Path) -> None:
    url = write_png(tmp_path / 'dark.png', np.full((512, 640), 7, np.uint8))
    made = pipeline.load_setup(values(camera_yaml, dark_frame=url))
    assert made.dark is not None and made.dark.dtype == np.uint8
    found = pipeline.observe(image(), attitudes(), made, made.prior)
    assert found.refusal == 'bad_encoding'
    assert found.detail == 'uint16 image, the dark frame is uint8'
    one = scene(SCENARIO, 1)
    light = star_electrons(one.pixel_px, one.flux_electrons, 0.95, (512, 640)) / 100.0
    noise = np.random.default_rng(1).normal(0, 1.0, light.shape)
    pixels = np.clip(np.rint(light + 7 + noise), 0, 255).astype(np.uint8)
    byte = pipeline.observe(Image(image().time_ns, pixels), attitudes(), made, made.prior)
    assert byte.refusal == '' and byte.background_dn == pytest.approx(7.0, abs=0.2)


@pytest.mark.parametrize(
    'pixels',
    [
        np.zeros((512, 639), np.uint16),
        np.zeros((512, 640, 3), np.uint8),
        np.zeros((512, 640), np.float32),
    ],
)
def test_a_dark_frame_that_does_not_fit(
    camera_yaml: Path, tmp_path: Path, pixels: np.ndarray
) -> None:
    suffix = 'tiff' if pixels.dtype == np.float32 else 'png'
    url = write_png(tmp_path / f'dark.{suffix}', pixels)
    with pytest.raises(OptionError, match='not one channel of 640 x 512'):
        pipeline.load_setup(values(camera_yaml, dark_frame=url))


def test_refused_images_are_counted(setup: pipeline.Setup) -> None:
    collected = Ensemble()
    for observations in (
        ensemble().images[0],
        refused_image(image().time_ns, 640, 512, 'out_of_order', ''),
        ensemble().images[1],
        refused_image(image().time_ns, 640, 512, 'out_of_order', ''),
    ):
        collected = pipeline.add_to_ensemble(collected, observations, setup)
    assert collected.images == ensemble().images[:2]
    assert collected.refused == {'out_of_order': 2}
    status = pipeline.ensemble_status(collected, setup)
    assert (status.images, status.refused) == (2, {'out_of_order': 2})


def test_at_the_limit_an_image_goes_for_each_that_comes(camera_yaml: Path) -> None:
    limited = pipeline.load_setup(values(camera_yaml, max_images=4))
    collected = Ensemble()
    for observations in ensemble().images:
        collected = pipeline.add_to_ensemble(collected, observations, limited)
    assert len(collected.images) == 4
    stars = sorted(len(i) for i in ensemble().images)
    assert min(len(i) for i in collected.images) > stars[2]


def test_a_solution_with_its_statistics(setup: pipeline.Setup) -> None:
    found = pipeline.solve(ensemble(), setup)
    assert found.accepted and found.reasons == ()
    assert found.termination == 'converged'
    assert found.method == CalibrationOptions().method
    assert found.estimated == CalibrationOptions().estimate
    assert found.images_used == 10 and found.stars_rejected <= 4
    assert found.stars_used + found.stars_rejected == ensemble().star_count
    assert found.time_ns == ensemble().images[-1].time_ns
    assert found.variance_factor == pytest.approx(1.0, abs=0.1)
    assert (found.parent_frame, found.child_frame) == ('star_tracker', 'camera')
    # Skew of 0.1 px or so, sheared over half the height.
    assert 0 < found.zero_skew_cost_px < 0.2
    error = found.geometry.camera.parameters - TRUTH.camera.parameters
    free = [PARAMETER_NAMES.index(name) for name in found.estimated]
    assert np.abs(error[free] / found.sigma[free]).max() < 5
    turn = (
        Rotation.from_quat(found.geometry.star_tracker_from_camera_xyzw).inv()
        * Rotation.from_quat(TRUTH.star_tracker_from_camera_xyzw)
    ).magnitude()
    # Ten images of 10, 10 and 40 arcsec: 13 in the mean, and 50 for a principal point that is
    # held at its nominal place, where it is in truth too.
    assert turn / ARCSECOND_RAD < 50


def test_a_solution_is_mapped_over_the_detector(setup: pipeline.Setup) -> None:
    found = pipeline.solve(ensemble(), setup)
    maps, correlation = found.maps, found.correlation
    assert maps is not None and correlation is not None
    assert maps.stars.shape == (8, 10) and maps.stars.sum() == found.stars_used
    whole, shape = maps.line_of_sight_sigma_arcsec, maps.shape_sigma_arcsec
    assert whole.shape == shape.shape == (16, 20)
    # The centre is as good as the alignment: pitch and yaw of the 13 x 13 covariance; the two
    # middle rows and columns are half a cell off it.
    pitch_yaw_arcsec = np.hypot(*found.sigma[10:12]) / ARCSECOND_RAD
    np.testing.assert_allclose(whole[7:9, 9:11], pitch_yaw_arcsec, rtol=0.05)
    assert (shape < whole).all() and whole.argmin() not in (0, 19, 300, 319)
    assert correlation.names == (*found.estimated, *ALIGNMENT_NAMES)
    np.testing.assert_allclose(np.diag(correlation.matrix), 1.0, rtol=1e-12)
    rows = [CALIBRATION_PARAMETER_NAMES.index(name) for name in correlation.names]
    np.testing.assert_allclose(
        correlation.matrix * np.outer(found.sigma[rows], found.sigma[rows]),
        found.covariance[np.ix_(rows, rows)],
        rtol=1e-9,
    )


def test_a_solution_says_what_each_term_is_worth(setup: pipeline.Setup) -> None:
    found = pipeline.solve(ensemble(), setup)
    first, *removals = found.removals
    assert first.residual_rms_px == pytest.approx(found.residual_rms_px, rel=1e-9)
    assert {removal.removed for removal in removals} == set(found.estimated)
    for removal in removals:
        if removal.removed in ('fx', 'fy'):
            continue
        k = PARAMETER_NAMES.index(removal.removed)
        expected = found.geometry.camera.parameters[k] / found.sigma[k]
        assert removal.significance == pytest.approx(expected, rel=1e-6)


def test_method_and_names_can_be_said_for_one_solution(setup: pipeline.Setup) -> None:
    found = pipeline.solve(ensemble(), setup, method='single', estimate=['fx', 'fy', 'k1'])
    assert (found.method, found.estimated) == ('single', ('fx', 'fy', 'k1'))
    prior, after = setup.prior.camera.parameters, found.geometry.camera.parameters
    changed = [n for n, a, b in zip(PARAMETER_NAMES, prior, after, strict=True) if a != b]
    assert changed == ['fx', 'fy', 'k1']
    options = json.loads(found.provenance['options'])
    assert options['method'] == 'single' and options['estimate'] == ['fx', 'fy', 'k1']
    assert setup.calibration.method == CalibrationOptions().method
    with pytest.raises(OptionError, match="method: 'best' is not one of"):
        pipeline.solve(ensemble(), setup, method='best')
    with pytest.raises(OptionError, match='estimate: .* is not one of fx, skew'):
        pipeline.solve(ensemble(), setup, estimate=['fz'])


def test_too_few_images_cannot_be_solved(setup: pipeline.Setup) -> None:
    with pytest.raises(TooFewObservations, match='1 more images are needed'):
        pipeline.solve(Ensemble(ensemble().images[:2]), setup)


def test_a_bad_solution_is_refused_and_says_why(camera_yaml: Path) -> None:
    strict = pipeline.load_setup(values(camera_yaml, max_map_sigma_px=1e-6))
    found = pipeline.solve(ensemble(), strict)
    assert not found.accepted
    assert len(found.reasons) == 1 and 'max_map_sigma_px' in found.reasons[0]
    refused = [check for check in found.gate if check.kept is False]
    assert [check.option for check in refused] == ['max_map_sigma_px']
    assert refused[0].limit == 1e-6 and found.reasons[0].startswith(refused[0].name)


def test_the_gate_counts_the_stars_that_were_used(setup: pipeline.Setup) -> None:
    """Those left out as outliers cover nothing."""
    found = pipeline.solve(ensemble(), setup)
    assert found.maps is not None
    covered = next(check for check in found.gate if check.option == 'min_coverage')
    assert covered.found == (found.maps.stars > 0).mean()


def test_a_setup_holds_the_options_of_every_stage(setup: pipeline.Setup) -> None:
    """None that one of its fields has is missing where parameters are declared and told."""
    held = [value for value in vars(setup).values() if holds_options(type(value))]
    assert tuple(map(type, held)) == pipeline.OPTION_CLASSES and len(held) == 9
    for group in held:
        assert dataclasses.asdict(group).items() <= setup.options().items()


def test_provenance_tells_all_that_went_in(setup: pipeline.Setup, camera_yaml: Path) -> None:
    first = pipeline.solve(ensemble(), setup, inputs={'bag': 'abc'}).provenance
    assert first['software'].startswith('starcal ')
    assert first['catalog'] == setup.catalog.digest
    assert first['input bag'] == 'abc'
    prior = json.loads(first['prior'])
    assert prior[:10] == setup.prior.camera.parameters.tolist()
    assert prior[10:] == setup.prior.star_tracker_from_camera_xyzw.tolist()
    # From the options in it the setup can be made again.
    options = json.loads(first['options'])
    assert set(options) == names_of(*pipeline.OPTION_CLASSES)
    again = pipeline.load_setup(options)
    second = pipeline.solve(ensemble(), again, inputs={'bag': 'abc'})
    assert second.provenance == first
    other = Ensemble(ensemble().images[::-1])
    digest = pipeline.solve(other, setup).provenance['observations_sha256']
    assert digest != first['observations_sha256']


def test_equal_inputs_give_equal_numbers(setup: pipeline.Setup) -> None:
    one, other = (pipeline.solve(ensemble(), setup) for _ in range(2))
    np.testing.assert_array_equal(one.covariance, other.covariance)
    np.testing.assert_array_equal(one.geometry.camera.parameters, other.geometry.camera.parameters)
    assert one.provenance == other.provenance


def test_from_pixels_to_a_calibration_that_is_true(setup: pipeline.Setup) -> None:
    held = AttitudeHistory()
    for index in range(10):
        for sample in attitude_samples(SCENARIO, index):
            held.add(sample.time_ns, sample)
    collected = Ensemble()
    for index in range(10):
        found = pipeline.observe(image(index), held, setup, setup.prior)
        collected = pipeline.add_to_ensemble(collected, found, setup)
    assert len(collected.images) == 10
    calibration = pipeline.solve(collected, setup)
    assert calibration.accepted
    free = [PARAMETER_NAMES.index(name) for name in calibration.estimated]
    error = (calibration.geometry.camera.parameters - TRUTH.camera.parameters)[free]
    assert np.abs(error / calibration.sigma[free]).max() < 4.5
    assert calibration.residual_rms_px < 0.25
    assert Detector().psf_sigma_px == pytest.approx(collected.images[0].psf_sigma_px, rel=0.02)


def test_a_frame_that_is_shown_again_is_refused_once_its_stamp_is_new(
    setup: pipeline.Setup,
) -> None:
    held = attitudes(1)
    for sample in attitude_samples(SCENARIO, 2):
        held.add(sample.time_ns, sample)
    first, track = pipeline.observe_next(image(1), held, setup, pipeline.Track(setup.prior))
    stuck = Image(image(2).time_ns, image(1).pixels)
    again, track = pipeline.observe_next(stuck, held, setup, track)
    assert (first.refusal, again.refusal) == ('', 'frozen')
    assert again.attitude_gap_s == 0.5
    next_one, _ = pipeline.observe_next(image(2), held, setup, track)
    assert next_one.refusal == ''


def test_hot_pixels_found_in_a_sequence_are_not_measured_as_stars(setup: pipeline.Setup) -> None:
    """One is put under a star of the third image: bright or dim, the star is left out for it."""
    track = pipeline.Track(setup.prior)
    held = AttitudeHistory()
    for index in range(1, 4):
        for sample in attitude_samples(SCENARIO, index):
            held.add(sample.time_ns, sample)
    plain = pipeline.observe(image(3), held, setup, setup.prior)
    star = np.argsort(plain.snr)[len(plain) // 2]
    u, v = np.rint(plain.measured_px[star] + [1.0, 0.0]).astype(int)
    for index in (1, 2, 3):
        pixels = image(index).pixels.copy()
        # 15 sigma, one pixel off the centre of a star, pull it by several of its own sigma.
        pixels[v, u] += round(15.0 * plain.noise_dn)
        found, track = pipeline.observe_next(
            dataclasses.replace(image(index), pixels=pixels), held, setup, track
        )
        assert found.refusal == ''
    assert plain.catalog_id[star] not in found.catalog_id
    reason = found.refused_reason[found.refused_catalog_id == plain.catalog_id[star]]
    assert [list(found.refused_stars)[code] for code in reason] == ['hot_pixel']


def test_hot_pixels_of_the_dark_frame_are_known_from_the_first_image(
    camera_yaml: Path, tmp_path: Path, setup: pipeline.Setup
) -> None:
    plain = pipeline.observe(image(), attitudes(), setup, setup.prior)
    u, v = np.rint(plain.measured_px[0]).astype(int)
    dark = np.full(image().pixels.shape, 32, np.uint16)
    dark[v, u] = 60
    cv2.imwrite(str(tmp_path / 'dark.png'), dark)
    made = pipeline.load_setup(values(camera_yaml, dark_frame=str(tmp_path / 'dark.png')))
    found = pipeline.observe(image(), attitudes(), made, made.prior)
    assert found.refused_stars['hot_pixel'] == 1
    assert plain.catalog_id[0] not in found.catalog_id


def test_a_saturated_star_is_known_as_such_under_a_dark_frame(
    camera_yaml: Path, tmp_path: Path
) -> None:
    """What the dark frame takes away must not hide that the converter was at its end."""
    dark = np.random.default_rng(4).normal(32.0, 2.0, image().pixels.shape).astype(np.uint16)
    path = write_png(tmp_path / 'dark.png', dark)
    made = pipeline.load_setup(values(camera_yaml, dark_frame=path, max_saturated_pixels=0))
    pixels = image().pixels.copy()
    plain = pipeline.observe(image(), attitudes(), made, made.prior)
    u, v = np.rint(plain.measured_px[plain.snr.argmax()]).astype(int)
    pixels[v - 1 : v + 2, u - 1 : u + 2] = 4095
    found = pipeline.observe(
        dataclasses.replace(image(), pixels=pixels), attitudes(), made, made.prior
    )
    brightest = plain.catalog_id[plain.snr.argmax()]
    reason = found.refused_reason[found.refused_catalog_id == brightest]
    assert [list(found.refused_stars)[code] for code in reason] == ['saturated']
