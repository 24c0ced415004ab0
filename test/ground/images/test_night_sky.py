# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Calibration from images alone, against the truth of the simulated bag in the repository."""

from collections.abc import Callable, Sequence
import dataclasses
import functools
import json
import os

from astropy.io import fits
import cv2
from mission_files import frames_of, TINY, write_fits, write_pngs, write_tiny  # type: ignore[import-not-found]
from mission_files import images as tiny_images
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from starcal_tool import assert_refused  # type: ignore[import-not-found]

from bench.night_sky import calibrated, camera_of, off_arcsec
from starcal_ground.api import calibrate_bag, calibrate_images
from starcal_ground.bags.topics import Topics
from starcal_ground.blind.bright_sources import bright_sources
from starcal_ground.blind.search import SkyMatch
from starcal_ground.cli.main import main
from starcal_ground.images.from_stars import (
    _of_one_lens,
    count_of_stars,
    from_stars,
    FromStars,
    ideal_camera,
)
from starcal_ground.images.night_sky import (
    _set_up,
    _through_air,
    _tone_curve,
    from_photographs,
    photographs_of,
)
from starcal_ground.simulation.rendering import images
from starcal_ros.arrays import Pixels
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid, project
from starcal_ros.errors import NotFromStars, OptionError
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.records import Image, PIXELS_OF, refused_image, TIMES
from starcal_ros.sky.astrometry import SiteOptions
from starcal_ros.sky.catalog import load_catalog

TRUTH = json.loads((TINY / 'truth.json').read_text())
TRUE_CAMERA = CameraModel(640, 512, np.array([*TRUTH['k_true'], *TRUTH['d_true']]))
LENS = ('--focal-length-mm', '18', '--pixel-size-um', '10')  # of the small bag, within 1 %
CAMERA_FILE = str(TINY / 'camera.yaml')  # with it no search over all fields is made


@pytest.mark.slow
def test_a_bag_without_attitudes_is_calibrated_and_states_that_it_has_no_alignment(
    tmp_path, starcal
) -> None:
    bag = write_tiny(tmp_path / 'bag.mcap', tiny_images()[:3], ())
    params = tmp_path / 'params.yaml'
    params.write_text('/**:\n  ros__parameters:\n    observer: space\n')
    status, said, _ = starcal('calibrate', bag, '--params', params, '-o', tmp_path / 'out')
    assert status in (0, 3)
    calibration = read_calibration(tmp_path / 'out' / 'calibration.json')
    difference, sigma = off_arcsec(calibration, TRUE_CAMERA)
    assert difference < 2 * sigma
    assert not calibration.has_alignment
    assert 'none: attitudes from the stars' in said
    # No star tracker is a cause of its sigma, no column is of an alignment or of a first solution.
    assert 'star tracker' not in said and 'with alignment' not in said and 'prior' not in said
    page = (tmp_path / 'out' / 'report.html').read_text()
    assert 'No alignment' in page and '<title>Star calibration of a camera from its stars' in page
    causes = (f'star tracker {cause}' for cause in ('slow', 'frame', 'reported'))
    for words in (*causes, 'by the star tracker', 'id="figure-change"', 'camera_optical_frame on'):
        assert words not in page
    table = tmp_path / 'table.csv'
    assert starcal('lookup', tmp_path / 'out', '-o', table).status == 0
    assert table.read_text().splitlines()[0] == 'u_px,v_px,x,y,z,shape_sigma_arcsec'
    # From Python it is the same camera; JSON keeps all digits.
    found = calibrate_images(bag, observer='space')
    assert not found.has_alignment and found.images_used == calibration.images_used
    for one, same in (
        (found.geometry.camera.parameters, calibration.geometry.camera.parameters),
        (found.sigma, calibration.sigma),
    ):
        np.testing.assert_allclose(one, same, rtol=1e-9)
    with pytest.raises(OptionError, match='starcal_ground.calibrate_images'):
        calibrate_bag(bag, params)


@pytest.mark.slow
def test_mirrored_pictures_without_focal_length_and_clock_give_the_camera(tmp_path) -> None:
    mirrored = [pixels[:, ::-1] for pixels in frames_of(4)]
    calibration = calibrate_images(write_pngs(tmp_path / 'night', mirrored))
    difference, sigma = off_arcsec(calibration, TRUE_CAMERA)
    assert not calibration.has_alignment
    assert difference < 2 * sigma
    assert calibration.provenance[TIMES] == 'of the file: 4 of 4 images state none'


@pytest.mark.slow
def test_stated_times_and_a_stated_flip_are_those_of_the_calibration(tmp_path, starcal) -> None:
    folder, table, out = tmp_path / 'night', tmp_path / 'times.csv', tmp_path / 'out'
    shown = tiny_images()[:3]
    files = sorted(write_pngs(folder, [one.pixels[::-1] for one in shown]).iterdir())
    rows = (f'{path.name},{one.time_ns}' for path, one in zip(files, shown, strict=True))
    table.write_text('\n'.join(['file,time_ns', *rows]))
    stated = ['calibrate', folder, *LENS, '-o', out, '--times', table, '--flip']
    assert starcal(*stated, 'top-bottom').status in (0, 3)
    calibration = read_calibration(out / 'calibration.json')
    assert TIMES not in calibration.provenance
    span_ns = (calibration.first_image_ns, calibration.time_ns)
    assert span_ns == (shown[0].time_ns, shown[-1].time_ns)
    assert calibration.provenance[PIXELS_OF] == 'mirrored top to bottom (--flip)'
    off = calibration.geometry.camera.parameters[3:5] - TRUTH['k_true'][3:5]
    assert np.abs(off / calibration.sigma[3:5]).max() < 4.0  # one in 8,000 good ones is beyond
    # A side that the stars contradict is refused.
    for path, one in zip(files, shown, strict=True):
        cv2.imwrite(str(path), one.pixels)
    words = '--flip left-right: the stars show a mirror image with it: leave it out'
    assert_refused(starcal(*stated, 'left-right'), words)
    # A bag has the times and the pixels that it was made with.
    of_bag = starcal('calibrate', TINY, '-o', out, '--flip', 'top-bottom')
    assert_refused(of_bag, '--times, --flip: only of image files')


@pytest.mark.slow
@pytest.mark.parametrize(
    ('kind', 'words'),
    [
        ('rows of unknown order', 'mirrored top to bottom: the stars of 3 of 3 images show that'),
        ('mirrored PNG', 'mirrored left to right: the stars of 3 of 3 images show a mirror'),
    ],
)
def test_the_axis_of_a_mirror_image_is_that_of_the_file_and_is_in_the_products(
    tmp_path, kind, words, starcal
) -> None:
    """The principal point, 60 and 50 px off the middle, is that of the pixels named."""
    folder, out = tmp_path / 'night', tmp_path / 'out'
    cut = [pixels[:-50, 60:] for pixels in frames_of(3)]
    if kind == 'mirrored PNG':
        write_pngs(folder, [pixels[:, ::-1] for pixels in cut])
    else:
        folder.mkdir()
        for image, pixels in zip(tiny_images(), cut, strict=False):
            upside_down = Image(image.time_ns, pixels[::-1].copy())
            write_fits(folder / f'{image.time_ns}.fits', upside_down)
    starcal('calibrate', folder, *LENS, '-o', out, '--quiet')
    calibration = read_calibration(out / 'calibration.json')
    truth = np.array(TRUTH['k_true'])[3:5] - [60.0, 0.0]
    off = (calibration.geometry.camera.parameters[3:5] - truth) / calibration.sigma[3:5]
    assert np.abs(off).max() < 4.0  # one in 8,000 good ones is beyond
    assert calibration.provenance[PIXELS_OF].startswith(words)
    assert (out / 'camera_info.yaml').read_text().startswith(f'# {PIXELS_OF}: {words}')
    assert (out / 'camera.yaml').read_text().startswith(f'# {PIXELS_OF}: {words}')
    assert words in (out / 'report.html').read_text()


@pytest.mark.slow
@pytest.mark.parametrize('camera', [44, 59])
def test_an_equidistant_lens_is_not_taken_for_a_pinhole(camera) -> None:
    """As a pinhole, which the first resembles, its corners without stars were off by 22 sigmas."""
    given, _ = camera_of(camera)
    found = from_stars(images(dataclasses.replace(given, image_count=3)), load_catalog())
    true = given.truth.camera
    assert found.camera.model == true.model == 'equidistant'
    assert len(found.icrf_from_camera) == 3
    assert found.camera.parameters[0] == pytest.approx(true.parameters[0], rel=2e-3)


@pytest.mark.slow
def test_a_camera_found_as_a_pinhole_gets_the_lens_that_its_stars_need(tmp_path) -> None:
    """The stars hardly separate the coefficients of this lens, nor without a prior anything."""
    given, _ = camera_of(137)
    found = calibrated(dataclasses.replace(given, image_count=6), tmp_path, {}).calibration
    error_arcsec, sigma_arcsec = off_arcsec(found, given.truth.camera)
    assert found.accepted and found.geometry.camera.model == given.truth.camera.model
    assert error_arcsec < 5.0 * sigma_arcsec


def zoomed(pixels: Pixels, factor: float) -> Pixels:
    height, width = pixels.shape
    middle = (np.array([width, height]) - 1) / 2
    turn = np.column_stack([np.eye(2) * factor, (1 - factor) * middle])
    found = cv2.warpAffine(pixels, turn, (width, height), flags=cv2.INTER_CUBIC)
    return found.astype(np.uint16)


def lights(seed: int, count: int = 60) -> Pixels:
    """Lights in random places: a city, or a hall."""
    rng = np.random.default_rng(seed)
    light = np.zeros((512, 640))
    places = rng.integers(5, 500, count), rng.integers(5, 630, count)
    light[places] = rng.uniform(1e3, 2e4, count)
    seen = cv2.GaussianBlur(light, (0, 0), 1.0) + rng.normal(200.0, 5.0, light.shape)
    return seen.clip(0, 65535).astype(np.uint16)


@pytest.mark.slow
def test_a_zoom_is_named_and_a_change_of_focus_is_refused_by_the_gate(tmp_path) -> None:
    frames = frames_of(4)
    frames[2:] = [zoomed(pixels, 1.1) for pixels in frames[2:]]
    folder = write_pngs(tmp_path / 'night', frames)
    with pytest.raises(NotFromStars, match='focal lengths of 180. to 198. px: .* zoom .*take 20'):
        calibrate_images(folder, camera_info_url=CAMERA_FILE)
    frames = frames_of(4)
    frames[2:] = [zoomed(pixels, 1.005) for pixels in frames[2:]]
    folder = write_pngs(tmp_path / 'focus', frames)
    calibration = calibrate_images(folder, camera_info_url=CAMERA_FILE)
    assert not calibration.accepted
    assert '(max_image_variation_px)' in ' '.join(calibration.reasons)


@pytest.mark.slow
def test_an_image_with_another_focal_length_is_left_out_and_named() -> None:
    """As a picture of a planetarium on a screen among images of the sky."""
    *others, last = tiny_images()[:6]
    frames = [*others, Image(last.time_ns, zoomed(last.pixels, 1.1))]
    found = from_stars(frames, load_catalog(), [ideal_camera((640, 512), 1800.0)])
    assert found.icrf_from_camera.keys() == {one.time_ns for one in others}
    (focal_px,) = found.other_focal_px
    assert focal_px == pytest.approx(1.1 * found.camera.parameters[0], rel=5e-3)
    assert f'left out, with another focal length: {focal_px:.0f} px' in found.in_a_sentence()


@pytest.mark.slow
def test_bad_files_among_photographs_cost_a_line_for_each_reason(tmp_path, capfd) -> None:
    nights = frames_of(3)
    folder = write_pngs(tmp_path / 'night', [*nights, lights(0, 15)])
    os.mkfifo(folder / 'pipe.png')
    (folder / 'zero.png').symlink_to('/dev/zero')
    (folder / 'loop.png').symlink_to('loop.png')
    (folder / 'folder.png').mkdir()
    whole = (folder / '0.png').read_bytes()
    for k in range(12):  # the header is sound, the pixels are not
        (folder / f'half{k}.png').write_bytes(whole[:9000])
        (folder / f'a{k}.jpg').write_bytes(b'\xff\xd8\xff' + bytes(200))
    cut = cv2.imencode('.jpg', (tiny_images()[0].pixels / 256).astype(np.uint8))[1].tobytes()
    (folder / 'cut.jpg').write_bytes(cut[: len(cut) // 2])
    assert main(['calibrate', str(folder), *LENS, '-o', str(tmp_path / 'out')]) in (0, 3)
    said = capfd.readouterr().err
    assert 'left out: 12 files (half0.png, half1.png, half10.png, ...): a PNG, not r' in said
    assert 'left out: 12 files (a0.jpg, a1.jpg, a10.jpg, ...): a JPEG, not readable' in said
    assert 'left out: 2 files (pipe.png, zero.png): not a regular file' in said
    assert 'left out: 1 file (cut.jpg): damaged' in said
    assert len(said.splitlines()) < 12
    calibration = read_calibration(tmp_path / 'out' / 'calibration.json')
    assert calibration.images_used == len(nights)
    # In the words of photographs, which have no attitudes.
    assert calibration.images_refused == {'no_match': 1}


def daylight(seed: int, size: tuple[int, int] = (512, 640)) -> Pixels:
    """A picture with detail of all sizes, evenly lit: leaves, clouds, walls."""
    rng = np.random.default_rng(seed)
    light = np.full(size, 9000.0)
    for blur_px in (1.0, 3.0, 9.0, 30.0):
        noise = cv2.GaussianBlur(rng.normal(size=size), (0, 0), blur_px)
        light += 2000.0 * noise / noise.std()
    return light.clip(0, 65535).astype(np.uint16)


def dark(seed: int) -> Pixels:
    rng = np.random.default_rng(seed)
    pixels = rng.normal(200.0, 5.0, (512, 640))
    pixels[rng.integers(0, 512, 300), rng.integers(0, 640, 300)] += rng.uniform(200, 9000, 300)
    return pixels.astype(np.uint16)


def test_the_group_with_stars_is_taken_not_the_largest(tmp_path) -> None:
    folder = write_pngs(tmp_path / 'card', [daylight(k, (400, 500)) for k in range(8)])
    for k, image in enumerate(tiny_images()[:3]):
        cv2.imwrite(str(folder / f'night{k}.png'), image.pixels)
    chosen, notes = photographs_of([folder])
    assert [one.path.name for one in chosen] == ['night0.png', 'night1.png', 'night2.png']
    assert notes == [
        '3 images of 640 x 512 are used; left out: 8 of 500 x 400, which show no stars'
    ]


@pytest.mark.slow
@pytest.mark.parametrize('other', [daylight, dark])
def test_many_images_of_no_stars_do_not_hide_a_few_of_stars(other) -> None:
    nights = tiny_images()[:3]
    others = [Image(nights[0].time_ns - 10**9 * (k + 1), other(k)) for k in range(7)]
    found = from_stars([*others, *nights], load_catalog())
    assert found.icrf_from_camera.keys() == {one.time_ns for one in nights}


@pytest.mark.parametrize('kind', ['a slope', 'a glow', 'leaves and clouds'])
def test_stars_on_a_bright_uneven_sky_are_counted(kind) -> None:
    """Over a daylight sky, whose levels differ by more than the stars are above it; no others."""
    v, u = np.mgrid[:512, :640]
    rng = np.random.default_rng(3)
    sky = {
        'a slope': 3000.0 + 10.0 * u + 4.0 * v,
        'a glow': 3000.0 + 9e6 / ((u - 900.0) ** 2 + (v - 200.0) ** 2 + 300.0**2) * 30.0,
        'leaves and clouds': daylight(2).astype(np.float64),
    }[kind]
    stars = np.zeros(sky.shape)
    stars[rng.integers(20, 490, 27), rng.integers(20, 620, 27)] = rng.uniform(5e3, 4e4, 27)
    seen = sky + cv2.GaussianBlur(stars, (0, 0), 1.2) + rng.normal(0.0, 60.0, sky.shape)
    pixels = np.rint(seen).clip(0, 65535).astype(np.uint16)
    count = count_of_stars(pixels, bright_sources(pixels))
    assert count == 0 if kind == 'leaves and clouds' else count >= 20


@functools.cache
def found_stars() -> FromStars:
    return from_stars(tiny_images()[:3], load_catalog(), [ideal_camera((640, 512), 1800.0)])


@pytest.mark.parametrize(
    ('is_rendered', 'is_colour', 'is_mirrored'),
    [(False, False, False), (False, True, True), (True, False, True), (True, True, False)],
)
def test_the_brightnesses_of_the_stars_show_a_tone_curve(
    tmp_path, is_rendered, is_colour, is_mirrored
) -> None:
    frames = []
    for image in tiny_images()[:3]:
        light = (image.pixels / 600.0).clip(0, 1)
        curved = 1.055 * light ** (1 / 2.4) - 0.055
        value = np.where(light <= 0.0031308, 12.92 * light, curved) if is_rendered else light
        eight = np.rint(255.0 * value).astype(np.uint8)
        eight = eight[:, ::-1] if is_mirrored else eight
        frames.append(np.stack([eight] * 3, axis=-1) if is_colour else eight)
    chosen, _ = photographs_of([write_pngs(tmp_path / 'night', frames)])
    by_name = sorted(chosen, key=lambda one: one.path.name)
    times = [image.time_ns for image in tiny_images()[:3]]
    photographs = [
        dataclasses.replace(one, time_ns=t) for one, t in zip(by_name, times, strict=True)
    ]
    stars = dataclasses.replace(found_stars(), mirrored=is_mirrored)
    decision, notes = _tone_curve(photographs, stars, load_catalog(), '')
    # What is assumed of colour, and of images without, needs no word.
    assert decision == (None if is_rendered == is_colour else is_rendered)
    assert bool(notes) == (decision is not None)


@pytest.mark.parametrize('kind', ['Dark Frame', 'FLAT', 'Bias Frame', 'Master Dark'])
def test_frames_of_the_detector_are_left_out_by_their_headers(tmp_path, kind) -> None:
    for name, value in (('light', 'Light Frame'), ('other', kind)):
        hdu = fits.PrimaryHDU(np.ones((30, 40), np.float32))
        hdu.header['IMAGETYP'] = value
        hdu.writeto(tmp_path / f'{name}.fits')
    chosen, notes = photographs_of([tmp_path])
    assert [one.path.name for one in chosen] == ['light.fits']
    assert notes == [
        'left out: 1 file (other.fits): no image of the sky: IMAGETYP is ' + repr(kind.lower())
    ]


def noise(side: int) -> list[Pixels]:
    rng = np.random.default_rng(side)
    return [rng.integers(0, 255, (side, side + 3), np.uint8) for _ in range(4)]


TOO_FEW: dict[str, tuple[Callable[[], Sequence[Pixels]], str]] = {
    'two': (lambda: frames_of(2), '^2 different images, 3 are needed: take 20 frames'),
    'one, four times': (
        lambda: frames_of(1) * 4,
        r'1 different image \(3 more are copies, the first since its pixels are .*\), 3 are need',
    ),
    'no sky': (
        lambda: [*frames_of(2), lights(0, 15)],
        '2 of 3 images match the sky, 3 are needed: take 20 frames.*no frames of anything else',
    ),
    'no stars': (
        lambda: list(np.random.default_rng(1).normal(100, 3, (3, 300, 400)).astype(np.uint8)),
        'no stars: .* take 20 frames',
    ),
    **{
        f'smaller than a star, {side} px': (functools.partial(noise, side), 'no stars')
        for side in (3, 8, 17)
    },
}  # fmt: skip


@pytest.mark.parametrize(
    'name', [pytest.param(name, marks=[pytest.mark.slow] * (name == 'no sky')) for name in TOO_FEW]
)
def test_frames_that_show_too_few_stars_are_counted_with_the_remedy(name, tmp_path) -> None:
    frames, words = TOO_FEW[name]
    with pytest.raises(NotFromStars, match=words):
        calibrate_images(write_pngs(tmp_path / 'night', frames()))


@pytest.mark.parametrize(('focal_px', 'others_px'), [
    ([], ()),
    ([2659.0] * 10 + [2100.0], (2100.0,)),
    ([2659.0] * 9 + [2100.0, 2598.0], (2100.0, 2598.0)),  # two screens with a planetarium
    ([1800.0] * 3 + [1980.0] * 3, None),
    ([1800.0, 1800.0, 1980.0], None),
    (np.linspace(1764.0, 1836.0, 11), None),  # a focus that drifts
])  # fmt: skip
def test_a_few_images_of_another_focal_length_are_left_out_and_named(focal_px, others_px) -> None:
    shown = (np.empty(0, np.int64), np.empty((0, 2)), False, -9.0, 0.3)
    matches = {
        time_ns: SkyMatch(Rotation.identity(), ideal_camera((640, 512), px), *shown)
        for time_ns, px in enumerate(focal_px)
    }
    if others_px is None:
        with pytest.raises(NotFromStars, match='several lenses, a zoom or a change of focus'):
            _of_one_lens(matches)
        return
    kept, left_out_px = _of_one_lens(matches)
    assert len(kept) == len(matches) - len(others_px)
    assert left_out_px == pytest.approx(others_px)


@pytest.mark.parametrize('model', ['equidistant', 'rational_polynomial', 'tilted', 'auto'])
def test_a_stated_lens_model_is_that_of_the_camera_found(tmp_path, model) -> None:
    source = _set_up(found_stars(), [], {'lens_model': model}, tmp_path, False, Topics())
    camera, found = source.setup.prior.camera, found_stars().camera
    assert camera.model == ('plumb_bob' if model == 'auto' else model)
    pixels = pixel_grid(found, 9, 9)
    # The series of two models differ by 0.14 px in a corner.
    again_px = project(camera, line_of_sight(found, pixels))
    np.testing.assert_allclose(again_px, pixels, rtol=0, atol=0.2)


@pytest.mark.slow
def test_a_site_counts_where_times_are_known_and_the_ground_alone_is_not_stated(tmp_path) -> None:
    frames = write_pngs(tmp_path / 'night', frames_of(3))
    photographs, _ = photographs_of([frames], 18.0, 10.0)  # of the small bag, within 1 %
    # Files have the time of this run; at those of the bag its fields are 66 degrees high here.
    place = (37.2, -68.0, 600.0)
    photographs = [
        dataclasses.replace(one, time_ns=image.time_ns)
        for one, image in zip(photographs, tiny_images(), strict=False)
    ]
    stated = {'observer': 'ground', 'latitude_deg': place[0], 'longitude_deg': place[1]}
    known: dict[str, object] = {'dated': True, 'utc': True}
    for values, of_files, is_known in (
        (stated, {'dated': False}, False),
        (stated, known, True),
        ({}, {**known, 'site': place}, True),
        ({'observer': 'ground'}, {**known, 'site': place}, False),
    ):
        given = [dataclasses.replace(one, **of_files) for one in photographs]
        source = from_photographs(given, values, tmp_path)
        site, air = source.setup.site, source.through_air
        assert isinstance(air, functools.partial)
        is_located = air.args[-1]
        assert (site.observer, site.is_known, is_located) == ('ground', is_known, is_known)
        words = 'the site is not used: the images have no date: state it (--times)'
        is_named = words in source.notes
        assert is_named == (of_files == {'dated': False})


@pytest.mark.parametrize(
    ('reason', 'detail'),
    [('no_match', 'stars match in one part of the image only'), ('smeared', 'streaks of 30 px')],
)
def test_images_identified_and_then_refused_are_counted_with_their_reason(reason, detail) -> None:
    identified = dict.fromkeys((1, 2), Rotation.identity())
    stars = FromStars(ideal_camera((640, 512), 1800.0), False, identified, 3)
    images = [refused_image(time_ns, 640, 512, reason, detail) for time_ns in (1, 2, 3)]
    _, note = _through_air(stars, SiteOptions(), True, images)
    assert note == (
        f'2 of 3 images, identified by their brightest stars, are refused as {reason}: {detail}'
    )
    assert _through_air(stars, SiteOptions(), True, images[2:])[1] == ''
