# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tracking: the same stars as a search, or a lost track; streaks are measured at their middle."""

import dataclasses
import functools
import itertools

from geometries import turn_between  # type: ignore[import-not-found]
import numpy as np
import pytest
from sample_sky import errors_sigma, exposure_of, started, with_planets  # type: ignore[import-not-found]
from sample_sky import tracked as tracked_campaign
from scipy.spatial.transform import Rotation

from bench import narrow
from bench.frames import load_set_up, observed, render_frame
from starcal_ground.simulation.rendering import render
from starcal_ground.simulation.scenario import Detector, scenario, Scene
from starcal_ros.camera import line_of_sight, pixel_grid, project
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.star_finder import Exposure, observe_stars, StarSearch
from starcal_ros.identification.tracking import start_tracking, track_stars, TrackedCamera
from starcal_ros.records import Image, StarObservations
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.stars.image_model import CentroidOptions

SCENARIO = scenario('tiny', seed=8)
PRIOR = SCENARIO.prior
CATALOG = load_catalog(None, 9.0)
SEARCH = StarSearch(CATALOG, CentroidOptions(max_saturated_pixels=0))


@functools.cache
def shown(index: int) -> tuple[Scene, Image]:
    one, exposed = exposure_of(SCENARIO, index)
    return one, exposed.image


def exposure(index: int, turn_rad: float = 0.0) -> Exposure:
    """Image with its reported attitude rotated about an axis."""
    one, image = shown(index)
    turn = Rotation.from_rotvec(turn_rad * np.array([0.6, -0.8, 0.0]))
    reported = Rotation.from_quat(one.icrf_from_star_tracker_xyzw) * turn
    return Exposure(image, reported.as_quat(), 0.5)


@functools.cache
def searched(index: int) -> tuple[StarObservations, TrackedCamera]:
    return started(exposure(index), PRIOR, SEARCH)  # type: ignore[no-any-return]


followed = functools.partial(track_stars, search=SEARCH)


@pytest.mark.parametrize('index', [1, 2, 5])
def test_tracking_gives_the_stars_of_a_search(index: int) -> None:
    _, known = searched(0)
    tracked, _ = followed(exposure(index), known)
    whole, _ = searched(index)
    assert tracked.refusal == ''
    both, a, b = np.intersect1d(tracked.catalog_id, whole.catalog_id, return_indices=True)
    # The noise that one image finds for itself moves the limit of faint stars by a tenth of them.
    assert len(both) > 0.97 * min(len(tracked), len(whole))
    assert len(both) > 0.8 * max(len(tracked), len(whole))
    apart = tracked.measured_px[a] - whole.measured_px[b]
    sigma = np.sqrt(whole.covariance_px2[b][:, [0, 2]])
    # The same pixels; width and noise are known a little otherwise.  A star whose neighbour is at
    # the limit of being measured itself moves by what that pulls, which is in its covariance.
    off2 = np.sort(((apart / sigma) ** 2).mean(axis=1))
    assert np.sqrt(off2[:-1].mean()) < 0.05 and off2[-1] < 9.0
    assert tracked.noise_dn == pytest.approx(whole.noise_dn, rel=0.1)
    assert tracked.background_dn == pytest.approx(whole.background_dn, abs=0.5)


def test_an_ensemble_knows_its_light_better_than_an_image() -> None:
    _, known = searched(0)
    for index in range(1, 10):
        _, known = followed(exposure(index), known)
    noise = known.instrument.noise.pixel_noise()
    detector = SCENARIO.detector
    # Some 500 bright stars tell: the gain to 3 %, the width to 0.2 %.
    assert noise.gain_e_per_dn == pytest.approx(detector.electrons_per_dn, rel=0.10)
    assert noise.background == pytest.approx(1.0, abs=0.1) and noise.psf_error < 0.03
    width = known.instrument.psf_width()
    assert width.sigma_px == pytest.approx(detector.psf_sigma_px, rel=0.006)
    assert not width.coefficients[1:].any()  # the same all over the field


@pytest.mark.slow
def test_a_background_cut_off_at_zero_makes_no_star_look_certain() -> None:
    errors = []
    for seed in (8, 9):
        given = scenario('tiny', seed=seed)
        detector = dataclasses.replace(
            given.detector, zero_point_electrons=2.5e4, psf_sigma_px=0.55, offset_dn=0.0
        )
        dark = dataclasses.replace(given, detector=detector)
        for one, observations, _ in tracked_campaign(dark, range(10), StarSearch(CATALOG)):
            errors.append(errors_sigma(one, observations))
    of_sigma = np.concatenate(errors)
    # 1,500 errors tell their RMS to 0.018.  A Gaussian for a PSF of half a pixel costs 0.04; with
    # the small scatter of the pixels at 0 DN it was 1.13.
    assert float(np.sqrt((of_sigma**2).mean())) < 1.09


def test_stars_left_out_as_too_faint_are_listed_as_refused(monkeypatch) -> None:
    whole, _ = searched(1)
    used = np.flatnonzero(np.isin(CATALOG.id, whole.catalog_id))
    refused = np.flatnonzero(np.isin(CATALOG.id, whole.refused_catalog_id))
    # All that were used, and half of those that are fainter: the catalog is sorted by magnitude.
    fainter = int((refused > used.max()).sum())
    count = len(used) + len(refused) - fainter // 2
    assert fainter > 100
    monkeypatch.setattr('starcal_ros.stars.detection.detectable_count', lambda *_: count)
    part, _ = started(exposure(1), PRIOR, SEARCH)
    assert part.catalog_id.tolist() == whole.catalog_id.tolist()
    assert set(part.refused_catalog_id) == set(whole.refused_catalog_id)
    # Light of the faint ones that the fits found is no longer subtracted.
    sigma_px = np.sqrt(whole.covariance_px2[:, [0, 2]])
    assert np.median(np.abs(part.measured_px - whole.measured_px) / sigma_px) < 1e-3


def test_a_width_that_changes_over_the_field_is_learnt() -> None:
    detector = dataclasses.replace(SCENARIO.detector, psf_growth=0.3)
    soft = dataclasses.replace(SCENARIO, detector=detector)
    *_, (one, observations, known) = tracked_campaign(soft, range(5), SEARCH)
    camera = PRIOR.camera
    grid = pixel_grid(camera, 7, 5)
    true_px = detector.psf_sigma_at(grid, (camera.height, camera.width))
    width = known.instrument.psf_width()
    found_px = width.at(grid)
    # 30 % wider in the corners; some 250 bright stars tell it to a few percent there.
    assert np.abs(found_px / true_px - 1.0).max() < 0.06
    mean_px2 = np.mean(width.at(pixel_grid(camera, 400, 400)) ** 2)
    assert width.sigma_px**2 == pytest.approx(mean_px2, rel=2e-3)  # the edges count
    # And no star's error is larger than it says.
    # 300 stars, two axes: known to 3 %, and some have companions fainter than the catalog.
    assert 0.85 < np.sqrt(np.mean(errors_sigma(one, observations) ** 2)) < 1.15
    assert observations.refused_stars.get('elongated', 0) < 0.3 * len(observations)


@pytest.mark.parametrize(('scale', 'k1'), [(1.02, 0.0), (1.0, 0.05)])
def test_the_camera_that_predicts_is_corrected(scale: float, k1: float) -> None:
    camera = PRIOR.camera
    fx, _, fy, *_ = scale * camera.intrinsics
    wrong = camera.replace(fx=fx, fy=fy, k1=camera.distortion[0] + k1)
    _, known = started(exposure(0), dataclasses.replace(PRIOR, camera=wrong), SEARCH)
    tracked, known = followed(exposure(1), known)
    assert len(tracked) > 0.95 * len(searched(1)[0])
    grid = pixel_grid(camera, 9, 7)
    true = line_of_sight(SCENARIO.truth.camera, grid)
    turn, _ = Rotation.align_vectors(line_of_sight(known.geometry.camera, grid), true)
    off = project(known.geometry.camera, turn.apply(true))
    # What stars of one image tell of the corners, where it was 7 px off.
    assert np.abs(off - grid).max() < 1.0


def test_noise_of_the_star_tracker_is_tracked() -> None:
    _, known = searched(0)
    quiet, _ = followed(exposure(1), known)
    # 8 px, where the window reaches 12.
    jumped, after = followed(exposure(1, np.radians(0.25)), known)
    _, before = followed(exposure(1, np.radians(-0.25)), known)
    np.testing.assert_array_equal(jumped.catalog_id, quiet.catalog_id)
    # Fits that start from elsewhere end within what their last step leaves: 0.1 sigma.
    sigma_px = np.sqrt(quiet.covariance_px2[:, [0, 2]])
    assert np.abs((jumped.measured_px - quiet.measured_px) / sigma_px).max() < 0.1
    turn = turn_between(before.geometry, after.geometry)
    assert turn.magnitude() == pytest.approx(np.radians(0.5), rel=0.001)


def test_a_drifting_alignment_is_tracked() -> None:
    _, known = searched(0)
    first = known.geometry
    focal_px = PRIOR.camera.intrinsics[0]
    least = 0.95 * len(searched(1)[0])
    for turned_px in np.arange(0.0, 4.0, 0.4):
        observations, known = followed(exposure(1, turned_px / focal_px), known)
        assert len(observations) > least
    # The star tracker's noise has turned the first image by 0.9 px.
    assert abs(turn_between(first, known.geometry).magnitude() * focal_px - 3.6) < 1.0


@pytest.mark.parametrize('turn_deg', [0.6, 1.5, 40.0])
def test_a_jump_loses_the_track(turn_deg: float) -> None:
    _, known = searched(0)
    with pytest.raises(ImageRefused, match='brightest stars'):
        followed(exposure(1, np.radians(turn_deg)), known)


def test_no_window_of_another_sky_is_believed() -> None:
    _, known = searched(0)
    for index, other in itertools.permutations(range(10), 2):
        with pytest.raises(ImageRefused):
            followed(dataclasses.replace(exposure(index), image=shown(other)[1]), known)


@pytest.mark.parametrize('index', [1, 5, 9])
def test_planets_are_no_stars(index: int) -> None:
    _, known = searched(0)
    one = shown(index)[0]
    image = render(SCENARIO, with_planets(SCENARIO, one, index), index)
    found, _ = followed(dataclasses.replace(exposure(index), image=image), known)
    # The brightest of them raise the noise over some percent of this small field.
    assert found.refusal == '' and len(found) > 0.8 * len(followed(exposure(index), known)[0])
    off = errors_sigma(one, found)
    # Several hundred normal deviates; a wrong star is some hundred sigma off.
    assert np.abs(off).max() < 6.0 and np.sqrt((off**2).mean()) < 1.2


def test_an_image_without_psf_starts_no_track() -> None:
    observations, known = searched(0)
    assert start_tracking(PRIOR, observations, None) is None
    refused = dataclasses.replace(observations, refusal='no_match')
    assert start_tracking(PRIOR, refused, known.instrument) is None


@pytest.mark.parametrize(('plateau', 'refused'), [(1.0, 1), (0.9, 0)])
def test_the_saturation_that_images_before_have_shown(plateau: float, refused: int) -> None:
    _, known = searched(0)
    tracked, _ = followed(exposure(1), known)
    u, v = np.rint(tracked.measured_px[tracked.flux_dn.argmax()]).astype(int)
    peak = float(shown(1)[1].pixels[v - 1 : v + 2, u - 1 : u + 2].max())
    # One pixel at the level is no plateau of its own; one above it shows that it was none.
    instrument = dataclasses.replace(known.instrument, saturation_dn=0.98 * plateau * peak)
    again, _ = followed(exposure(1), dataclasses.replace(known, instrument=instrument))
    assert again.refused_stars.get('saturated', 0) == refused


FOCAL_PX = float(SCENARIO.truth.camera.parameters[0])
CORNER_PX = 410.0
Turn = tuple[float, float, float]  # rad, of an exposure
SHARP: Turn = (0.0, 0.0, 0.0)
LEAST = 0.45  # of the stars of a sharp image: streaks lie over each other and in their noise


def turned(u_px: float, v_px: float, roll_px: float) -> Turn:
    """Turn that moves stars by pixels in the middle and, by roll, in the corners."""
    return v_px / FOCAL_PX, u_px / FOCAL_PX, roll_px / CORNER_PX


@functools.cache
def exposed(
    turn_rad: Turn, index: int = 1, detector: Detector = SCENARIO.detector
) -> tuple[Scene, Exposure]:
    """Scene and image of a camera that turns during its exposure."""
    moving = dataclasses.replace(SCENARIO, turn_rad=turn_rad, detector=detector)
    return exposure_of(moving, index)  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ('turn_rad', 'tracked'),
    [
        (turned(3.0, 0.0, 0.0), False),
        (turned(4.5, -4.5, 0.0), True),
        (turned(9.5, 0.0, 0.0), False),
        (turned(0.0, 0.0, 8.0), True),
        (turned(3.0, 3.0, 6.0), False),
        (turned(3.0, 3.0, 6.0), True),
    ],
    ids=['3 px', 'diagonal', '9.5 px', 'roll', 'turn and roll', 'turn and roll tracked'],
)
def test_streaks_are_measured_at_their_middle(turn_rad: Turn, tracked: bool) -> None:
    before, track = searched(1)
    one, image = exposed(turn_rad)
    if tracked:
        observations, after = followed(image, track)
        # The next image may be sharp again.
        assert after.instrument is track.instrument
    else:
        observations, _ = observe_stars(image, PRIOR, SEARCH)
    assert len(observations) > LEAST * len(before)
    error = errors_sigma(one, observations)
    assert 0.85 < np.sqrt(np.mean(error**2)) < 1.15
    # A bent path is no bias: the mean of some 100 stars is good to 0.1 sigma per axis.
    assert np.abs(error.mean(axis=0)).max() < 0.35


def test_few_bright_stars_show_the_streaks_of_a_tracked_image() -> None:
    """Measured as sharp stars, most were refused as elongated."""
    given = narrow.scenario_of(5.0, 1, 6.0)
    set_up = load_set_up(given, prior_alignment_sigma_deg=0.01, magnitude_limit=9.0)
    frames = (render_frame(given, index) for index in range(2))
    image = observed(frames, set_up).images[1]
    # Four stars are brighter than 15 sigma, twelve than 8.  As sharp ones: 8 used, 11 elongated.
    assert len(image) > 20 and image.refused_stars.get('elongated', 0) < 3


def test_a_longer_streak_is_refused_with_its_length() -> None:
    _, image = exposed(turned(14.0, 0.0, 0.0))
    with pytest.raises(ImageRefused, match=r'^smeared: .*streaks of \d+ px, up to 10'):
        observe_stars(image, PRIOR, SEARCH)


@pytest.mark.parametrize('psf_sigma_px', [0.8, 1.4])
def test_sharp_images_stay_tracked_whatever_their_focus(psf_sigma_px: float) -> None:
    _, track = searched(1)
    detector = dataclasses.replace(SCENARIO.detector, psf_sigma_px=psf_sigma_px)
    for index in (2, 3, 4):
        _, track = followed(exposed(SHARP, index, detector)[1], track)


def test_streaks_of_which_too_few_are_alone_are_searched_again(monkeypatch) -> None:
    _, track = searched(1)
    monkeypatch.setattr('starcal_ros.stars.image_model._ISOLATED_PX', 1000.0)
    with pytest.raises(ImageRefused, match='^no_match: .*too few of them are alone'):
        followed(exposed(turned(6.0, 0.0, 0.0))[1], track)
