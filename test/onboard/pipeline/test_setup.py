# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The setup: what it holds of the parameters and frames of the detector, and what it refuses."""

import dataclasses
from pathlib import Path

from astropy.io import fits
import cv2
import numpy as np
import pytest
from tiny_campaign import attitudes, image, SCENARIO, values, write_png  # type: ignore[import-not-found]

from bench.narrow import scenario_of
from starcal_ground.parameter_files import read_setup
from starcal_ground.products import write_camera_info
from starcal_ros.camera import CameraModel
from starcal_ros.errors import CatalogError, OptionError, ProductError
from starcal_ros.pipeline import observe
from starcal_ros.pipeline.detector_frames import DetectorFrames
from starcal_ros.pipeline.setup import check_field_of_stars, load_setup, Setup
from starcal_ros.records import Image, StarObservations
from starcal_ros.sky.catalog import load_catalog
from starcal_ros.stars.image_model import CentroidOptions


def test_a_deep_catalog_need_not_cover_the_sky() -> None:
    given = scenario_of(0.3, 3)
    assert given.sky is not None
    check_field_of_stars(given.sky, 14.7, given.prior.camera)
    with pytest.raises(OptionError, match=r'magnitude_limit: 9 leaves \d+ stars in the catalog'):
        check_field_of_stars(load_catalog(None, 9.0), 9.0, given.prior.camera)


def test_a_setup_holds_what_the_parameters_say(camera_yaml: Path) -> None:
    stated: dict[str, object] = {
        'centroid': 'moment',
        'method': 'single',
        'estimate': ('fx', 'fy'),
        'max_attitude_gap_s': 7.0,
        'magnitude_limit': 6.0,
        'max_change_px': 0.3,
        'camera_frame': 'left_eye',
    }
    # Parameters of a node are known, and left to it.
    made = load_setup(values(camera_yaml, **stated, use_sim_time=True, autostart=False))
    assert stated.items() <= made.options().items()
    assert made.catalog.magnitude.max() <= 6.0
    assert made.detector.dark is None
    np.testing.assert_array_equal(made.prior.camera.parameters, SCENARIO.prior.camera.parameters)


def test_another_lens_model_starts_from_the_prior_camera(camera_yaml, tmp_path) -> None:
    wide = load_setup(values(camera_yaml, lens_model='rational_polynomial'))
    prior = wide.prior.camera
    assert prior.model == 'rational_polynomial'
    np.testing.assert_array_equal(prior.parameters[:10], SCENARIO.prior.camera.parameters)
    fisheye = CameraModel(
        640, 480, np.array([160, 0, 155, 322, 236, -0.02, 0.01, -0.004, 5e-4]), 'equidistant'
    )
    write_camera_info(fisheye, tmp_path / 'fisheye.yaml')
    with pytest.raises(OptionError, match='lens_model: plumb_bob does not cover the field'):
        load_setup(values(tmp_path / 'fisheye.yaml', lens_model='plumb_bob'))


def test_an_override_of_ros_in_a_parameter_file_is_not_an_option(camera_yaml, tmp_path) -> None:
    """The nodes' QoS override, nested as ROS reads it, in the file that the tool reads too."""
    params = tmp_path / 'params.yaml'
    params.write_text(
        f'/**:\n  ros__parameters:\n    camera_info_url: {camera_yaml}\n'
        '    qos_overrides: {/image: {subscription: {reliability: best_effort}}}\n'
    )
    assert read_setup(params).prior.camera.width > 0


@pytest.mark.parametrize(
    ('wrong', 'says'),
    [
        ({'shutter': 'rolling'}, 'readout_s: not set, which shutter: rolling needs'),
        ({'readout_s': 0.03}, 'readout_s: 0.03 s, but shutter is unknown; set rolling'),
        ({'observer_velocity_m_s': [0, 0, 3e8]}, r'observer_velocity_m_s\[2\]: .* is not within'),
        ({'latitude_deg': 41.0}, 'a site counts with observer: ground alone'),
        (
            {'observer': 'ground', 'observer_velocity_m_s': [0, 0, 3e4]},
            'the site gives the velocity: leave it out',
        ),
        ({'max_residual_rms': 1.0}, 'max_residual_rms: no such parameter'),
        ({'camera_info_url': ''}, 'camera_info_url: not set'),
        ({'prior_alignment': [0.0, 0.0, 0.0, 1e-4]}, 'prior_alignment: .* not a unit quaternion'),
        ({'prior_alignment': [0.0, 0.0, 0.0, 1.1]}, r'prior_alignment: .* its norm is 1\.1$'),
        (
            {'prior_alignment': [90.0, 0.0, 10.0, 1.0]},
            r'norm is 90\.559.*angles in degrees are not a quat',
        ),
        (
            {'method': 'per_image', 'alignment_temperature': True},
            'alignment_temperature: the method per_image',
        ),
        (
            {'lens_model': 'rational_polynomial', 'estimate': ['fx', 's1']},
            'estimate: .* the lens model rational_polynomial',
        ),
        (
            {'lens_model': 'rational_polynomial', 'prior_sigma': [0.0] * 10},
            'prior_sigma: .* the lens model rational_polynomial',
        ),
        ({'autstart': False}, 'autstart: no such parameter .did you mean autostart'),
    ],
)
def test_a_wrong_parameter_is_named(camera_yaml, wrong, says) -> None:
    with pytest.raises(OptionError, match=says):
        load_setup(values(camera_yaml, **wrong))


def test_a_wrong_file_is_named(camera_yaml: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match='camera_info_url: .*missing.yaml: no such file'):
        load_setup(values(tmp_path / 'missing.yaml'))
    (tmp_path / 'stars.csv').write_text('these are no stars')
    for name, kind in (('stars.csv', CatalogError), ('missing.csv', OptionError)):
        with pytest.raises(kind, match=name):
            load_setup(values(camera_yaml, catalog=str(tmp_path / name)))


def test_zeros_stand_for_an_alignment_not_given(camera_yaml: Path) -> None:
    given = values(camera_yaml)
    assert load_setup(given).is_aligned
    for missing in (
        {**given, 'prior_alignment': [0.0] * 4},
        {'camera_info_url': str(camera_yaml)},
    ):
        assert not load_setup(missing).is_aligned
    assert load_setup({}, prior=SCENARIO.prior).is_aligned
    # A rounded one is made unit.
    q = np.round(SCENARIO.prior.star_tracker_from_camera_xyzw, 4)
    made = load_setup(values(camera_yaml, prior_alignment=q.tolist()))
    assert np.linalg.norm(made.prior.star_tracker_from_camera_xyzw) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'fx': 0.035, 'fy': 0.035}, 'fx: 0.035 px is under 96 px'),
        ({'fx': 35e4, 'fy': 35e4}, 'focal length of 350000 px .* in micrometres'),
        ({'cx': 1.54, 'cy': 1.23}, r'principal point \(1.54, 1.23\) is in the first corner'),
        ({'fx': 4000.0}, 'fx = 4000 and fy = .* differ by a factor of two'),
    ],
)
def test_a_camera_that_no_lens_makes(tmp_path: Path, changes: dict[str, float], text: str) -> None:
    path = tmp_path / 'camera.yaml'
    write_camera_info(SCENARIO.prior.camera.replace(**changes), path)
    with pytest.raises((OptionError, ProductError), match=text) as refused:
        load_setup(values(path))
    assert str(refused.value).startswith(str(path)) and '\n' not in str(refused.value)


@pytest.mark.parametrize(
    'option', ['camera_info_url', 'catalog', 'dark_frame', 'flat_field', 'bad_pixel_map']
)
def test_a_relative_path_that_leads_nowhere_names_folder_and_remedy(
    camera_yaml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str
) -> None:
    """The nodes run in a folder that their caller need not have in mind."""
    monkeypatch.chdir(tmp_path)
    given = {**values(camera_yaml), option: 'here/file'}
    expected = f'{option}: here/file: no such file in {tmp_path}; in a parameter file, paths'
    with pytest.raises(OptionError, match=expected):
        load_setup(given)
    given = {**values(camera_yaml), 'camera_info_url': camera_yaml.name}
    monkeypatch.chdir(camera_yaml.parent)
    assert load_setup(given).prior.camera.width > 0


HEIGHT, WIDTH = 512, 640


def response() -> np.ndarray:
    """A response that falls to 60 % in a corner and varies by 3 % from pixel to pixel."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    smooth = 1.0 - 0.4 * (u / WIDTH) * (v / HEIGHT)
    return np.asarray(smooth * np.random.default_rng(6).normal(1.0, 0.03, (HEIGHT, WIDTH)))


def observed(pixels: np.ndarray, setup: Setup) -> StarObservations:
    return observe.observe_next(Image(image().time_ns, pixels), attitudes(), setup)[0]


def test_a_flat_field_restores_the_flux_of_the_stars(camera_yaml: Path, tmp_path: Path) -> None:
    flat = response()
    fits.PrimaryHDU(flat.astype('f4') * 30000).writeto(tmp_path / 'flat.fits')
    offset = SCENARIO.detector.offset_dn
    dimmed = np.rint((image().pixels - offset) * flat + offset).clip(0, 4095).astype(np.uint16)
    setup = load_setup(values(camera_yaml, flat_field=str(tmp_path / 'flat.fits')))
    # The pedestal of a dark frame: the offset is no signal.
    detector = dataclasses.replace(setup.detector, pedestal_dn=round(offset))
    setup = dataclasses.replace(setup, detector=detector)
    plain = load_setup(values(camera_yaml))
    ideal = observed(image().pixels, plain)

    def worst(found: StarObservations) -> tuple[float, float]:
        """Median relative error of the flux and of the position, px, of bright stars."""
        _, a, b = np.intersect1d(ideal.catalog_id, found.catalog_id, return_indices=True)
        bright = ideal.snr[a] > 30
        assert bright.sum() > 20
        ratio = (found.flux_dn[b] / ideal.flux_dn[a])[bright]
        moved = np.linalg.norm(found.measured_px[b] - ideal.measured_px[a], axis=1)[bright]
        return float(np.median(np.abs(ratio / np.median(ratio) - 1))), float(np.median(moved))

    flux_without, moved_without = worst(observed(dimmed, plain))
    flux_with, moved_with = worst(observed(dimmed, setup))
    assert flux_with < 0.3 * flux_without and moved_with < moved_without


def test_a_bad_pixel_is_left_out_of_the_stars(camera_yaml: Path, tmp_path: Path) -> None:
    plain = load_setup(values(camera_yaml))
    before = observed(image().pixels, plain)
    star = int(np.argmax(before.snr))
    u, v = np.rint(before.measured_px[star]).astype(int)
    bad = np.zeros((HEIGHT, WIDTH), np.uint8)
    bad[v, u] = 1
    setup = load_setup(values(camera_yaml, bad_pixel_map=write_png(tmp_path / 'bad.png', bad)))
    assert setup.detector.hot.index.tolist() == [v * WIDTH + u]
    after = observed(image().pixels, setup)
    assert before.catalog_id[star] not in after.catalog_id
    assert after.refused_stars['hot_pixel'] == before.refused_stars.get('hot_pixel', 0) + 1


@pytest.mark.parametrize(
    ('option', 'usual', 'bad'), [('flat_field', 1000, 50), ('dark_frame', 32, 60)]
)
def test_pixels_without_response_or_with_a_current_are_bad(
    camera_yaml: Path, tmp_path: Path, option: str, usual: int, bad: int
) -> None:
    frame = np.full((HEIGHT, WIDTH), usual, np.uint16)
    frame[7, 9] = bad
    path = write_png(tmp_path / 'frame.png', frame)
    setup = load_setup(values(camera_yaml, **{option: path}))
    assert setup.detector.hot.index.tolist() == [7 * WIDTH + 9]
    corrected, _ = DetectorFrames(flat=setup.detector.flat).corrected(image(), setup.centroid)
    assert (corrected.pixels == image().pixels).all()


def test_the_dust_and_noise_of_a_flat_field_are_no_stars(camera_yaml, tmp_path) -> None:
    """Specks of dust, rows of other gain and vignetting, with the noise of the photons."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    flat = response()
    for place in np.random.default_rng(8).uniform(0, [WIDTH, HEIGHT], (40, 2)):
        flat *= 1.0 - 0.2 * np.exp(-(np.hypot(u - place[0], v - place[1]) ** 2) / 8.0)
    flat[:, 100:110] *= 1.3
    counts = np.random.default_rng(9).poisson(20000.0 * flat).astype(np.uint16)
    path = write_png(tmp_path / 'flat.png', counts)
    setup = load_setup(values(camera_yaml, flat_field=path))
    assert setup.detector.flat is not None


@pytest.mark.parametrize(
    ('raw', 'stated_dn', 'expected', 'level_dn'),
    [
        ([4095, 2000, 1000, 4095], 0.0, [8001, 8000, 2000, 8001], 8001.0),
        ([4095, 1000, 1000, 4095], 0.0, [4095, 4000, 2000, 4095], 4095.0),
        ([2010, 1000, 1000, 1990], 1900.0, [4001, 4000, 2000, 4001], 4001.0),  # a full well
        ([1800, 1000, 1000, 300], 1900.0, [1200, 4000, 2000, 600], 4001.0),  # none is saturated
        ([1800, 1000, 1000, 300], 0.0, [1200, 4000, 2000, 600], 0.0),
        ([65535, 30000, 1000, 300], 0.0, [65535, 65535, 2000, 600], 65535.0),
    ],
)
@pytest.mark.parametrize('has_dark', [False, True])
def test_the_raw_pixels_show_which_are_saturated(
    raw: list[int], stated_dn: float, expected: list[int], level_dn: float, has_dark: bool
) -> None:
    """The others are divided by the flat field, also the brightest, and none reaches the level."""
    pixels, flat = np.array([raw], np.uint16), np.array([[1.5, 0.25, 0.5, 0.5]])
    dark = np.zeros_like(pixels) if has_dark else None
    found, options = DetectorFrames(dark=dark, flat=flat).corrected(
        Image(1, pixels), CentroidOptions(saturation_dn=stated_dn)
    )
    assert found.pixels.tolist() == [expected]
    assert options.saturation_dn == level_dn


@pytest.mark.parametrize(
    ('name', 'content', 'words'),
    [
        ('dark_frame', np.zeros((HEIGHT, WIDTH - 1), np.uint16), 'one channel of 640 x 512'),
        ('dark_frame', np.zeros((HEIGHT, WIDTH, 3), np.uint8), 'one channel of 640 x 512'),
        ('dark_frame', np.zeros((HEIGHT, WIDTH), np.float32), 'one channel of 640 x 512'),
        ('flat_field', np.ones((HEIGHT, WIDTH - 1), np.uint8), 'one channel of 640 x 512'),
        ('flat_field', np.zeros((HEIGHT, WIDTH), np.uint8), 'median is .*not positive'),
        ('flat_field', image().pixels, 'shows [0-9]+ stars: it is a frame of the sky'),
        ('bad_pixel_map', np.zeros((3, 4), np.uint8), 'one channel of 640 x 512'),
        ('bad_pixel_map', np.ones((HEIGHT, WIDTH), np.uint8), 'marks 100% .* 0 for good pixels'),
    ],
)
def test_a_file_that_does_not_fit_is_named(camera_yaml, tmp_path, name, content, words) -> None:
    path = tmp_path / ('map.tiff' if content.dtype == np.float32 else 'map.png')
    cv2.imwrite(str(path), content)
    with pytest.raises(OptionError, match=words):
        load_setup(values(camera_yaml, **{name: str(path)}))
