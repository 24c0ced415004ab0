# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""SPICE kernels, read back by spiceypy: lines of sight and attitudes of the camera."""

import dataclasses
from pathlib import Path

from export_calibrations import calibration  # type: ignore[import-not-found]
from mission_files import CLOCK_ID, ephemeris_time, FRAME_ID, write_lsk, write_sclk  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import spiceypy

from starcal_ground.mission.export.export_formats import export
from starcal_ground.mission.export.exported import Content
from starcal_ground.mission.export.request import Request, SpiceNames
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.camera.lens import LENSES
from starcal_ros.errors import OptionError, ProductError
from starcal_ros.records import Calibration, refused_image, StarObservations

NAMES = SpiceNames(-999, star_tracker_id=-999100)
# The rounding of double precision over some ten operations, at 1e-16 each; the bar is 1e-9.
SAME_RAD = 1e-12


@pytest.fixture
def load(tmp_path: Path):

    def loaded(made: Calibration, names: SpiceNames = NAMES) -> tuple[str, str]:
        paths = [tmp_path / name for name in export(made, 'spice', tmp_path, Request(names)).files]
        for path in paths:
            spiceypy.furnsh(str(path))
        fk, ik = (path.read_text('ascii') for path in paths)
        return fk, ik

    spiceypy.kclear()
    yield loaded
    spiceypy.kclear()


def pool(name: str) -> np.ndarray:
    return np.asarray(spiceypy.gdpool(f'INS-999001_{name}', 0, 1000))


def seen_at(direction: np.ndarray) -> np.ndarray:
    """Pixel of a direction by the numbers and the equations of the IK alone."""
    model = spiceypy.gcpool('INS-999001_LENS_MODEL', 0, 1)[0]
    terms = spiceypy.gcpool('INS-999001_LENS_TERMS', 0, 20)
    term = dict.fromkeys(LENSES['tilted'].coefficients, 0.0)
    term |= dict(zip(terms, pool('LENS_COEFFICIENTS'), strict=True))
    k1, k2, k3, p1, p2, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y = term.values()
    X, Y, Z = direction
    x, y = X / Z, Y / Z
    if model == 'equidistant':
        theta = np.arctan2(np.hypot(X, Y), Z)
        x, y = theta * np.array([X, Y]) / np.hypot(X, Y)
        r2 = x * x + y * y
        xd, yd = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4) * np.array([x, y])
    else:
        r2 = x * x + y * y
        g = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        xd = g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2
        yd = g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
        # OpenCV's tilted sensor: R(tau) and the projection that keeps its plane.
        R = Rotation.from_euler('xy', [-tau_x, -tau_y]).as_matrix()
        P = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]])
        tilted = P @ R @ [xd, yd, 1.0]
        xd, yd = tilted[:2] / tilted[2]
    fx, fy = pool('FOCAL_LENGTH_PX')
    cx, cy = pool('CCD_CENTER')
    return np.array([fx * xd + pool('SKEW_PX')[0] * yd + cx, fy * yd + cy])


def field_at(pixel: np.ndarray) -> np.ndarray:
    """The field of the IK by its comment, with its cosines."""
    a = (2 * pixel[0] + 1) / pool('PIXEL_SAMPLES')[0] - 1
    b = (2 * pixel[1] + 1) / pool('PIXEL_LINES')[0] - 1

    def P(n: int, x: float) -> float:
        return float(np.sqrt(2.0) * np.cos(np.pi * n * (x / 2.7 + 0.5))) if n else 1.0

    orders = zip(pool('FIELD_ORDERS_U'), pool('FIELD_ORDERS_V'), strict=True)
    terms = [P(int(i), a) * P(int(j), b) for i, j in orders]
    return np.array([pool('FIELD_U_PX') @ terms, pool('FIELD_V_PX') @ terms])


@pytest.mark.parametrize('with_field', [False, True])
@pytest.mark.parametrize('model', LENSES)
def test_a_direction_is_seen_at_its_pixel_by_the_kernels_alone(load, model, with_field) -> None:
    made = calibration(model, with_field=with_field)
    load(made)
    camera = made.geometry.camera
    pixels = pixel_grid(camera, 5, 4)
    tracker_from_camera = spiceypy.pxform('CAMERA_OPTICAL_FRAME', 'STAR_TRACKER', 0.0)
    expected = Rotation.from_quat(made.geometry.star_tracker_from_camera_xyzw)
    assert np.abs(tracker_from_camera - expected.as_matrix()).max() < SAME_RAD
    for pixel, direction in zip(pixels, line_of_sight(camera, pixels), strict=True):
        in_tracker = expected.apply(direction)
        in_camera = tracker_from_camera.T @ in_tracker
        seen = seen_at(in_camera)
        if with_field:
            seen = seen + field_at(pixel)
        assert np.abs(seen - pixel).max() / camera.parameters[0] < 1e-9


def test_the_field_of_view_is_the_edge_of_the_detector(load) -> None:
    made = calibration(with_field=True)
    load(made)
    shape, frame, boresight, count, corners = spiceypy.getfov(-999001, 100)
    assert (shape, frame, count) == ('POLYGON', 'CAMERA_OPTICAL_FRAME', 16)
    camera = made.geometry.camera
    middle = line_of_sight(camera, np.array([647.5, 511.5]))
    assert np.abs(boresight - middle).max() < SAME_RAD
    of_corners = line_of_sight(camera, np.array([[-0.5, -0.5], [1295.5, -0.5], [1295.5, 1023.5]]))
    assert np.abs(corners[[0, 4, 8]] - of_corners).max() < SAME_RAD
    # SPICE finds the instrument by its name, and what it sees.
    assert spiceypy.bodn2c('CAMERA_OPTICAL_FRAME') == -999001


# SPICE's own reader of decimals may be off by two in the last bit of a double.
LAST_BITS = 4.5e-16


def test_numbers_read_back_but_for_two_last_bits(load) -> None:
    made = calibration(temperature=True)
    load(made, dataclasses.replace(NAMES, pixel_size_um=5.5))
    camera = made.geometry.camera
    np.testing.assert_allclose(pool('LENS_COEFFICIENTS'), camera.distortion, LAST_BITS, 0)
    np.testing.assert_allclose(pool('PARAMETER_SIGMAS'), made.sigma, LAST_BITS, 0)
    np.testing.assert_allclose(pool('FOCAL_PER_DEGC'), [4e-5, -6e-7], LAST_BITS, 0)
    assert pool('FOCAL_LENGTH')[0] == pytest.approx(3641.9 * 5.5e-3, rel=1e-6)
    q = spiceypy.gdpool('TKFRAME_-999001_Q', 0, 4)
    xyzw = made.geometry.star_tracker_from_camera_xyzw
    np.testing.assert_allclose(q[[1, 2, 3, 0]], xyzw, LAST_BITS, 0)


def test_the_kernel_of_the_mission_may_define_the_star_tracker(load, tmp_path) -> None:
    made = calibration()
    names = SpiceNames(-123, -123400, 0, 'ABC_NAC', 'ABC_ST1')
    fk, _ = load(made, names)
    assert 'FRAME_ABC_ST1' not in fk
    mission = tmp_path / 'mission.tf'
    mission.write_text(
        "KPL/FK\n\\begindata\nFRAME_ABC_ST1 = -123001\nFRAME_-123001_NAME = 'ABC_ST1'\n"
        'FRAME_-123001_CLASS = 3\nFRAME_-123001_CLASS_ID = -123001\n'
        'FRAME_-123001_CENTER = -123\nCK_-123001_SCLK = -123\nCK_-123001_SPK = -123\n\\begintext\n'
    )
    spiceypy.furnsh(str(mission))
    matrix = spiceypy.pxform('ABC_NAC', 'ABC_ST1', 0.0)
    expected = Rotation.from_quat(made.geometry.star_tracker_from_camera_xyzw).as_matrix()
    assert np.abs(matrix - expected).max() < SAME_RAD


@pytest.mark.parametrize(
    ('names', 'words'),
    [
        (SpiceNames(-999, instrument_id=5), '--instrument-id'),
        (SpiceNames(-999, star_tracker_id=-999001), '--star-tracker-id'),
        (SpiceNames(-999, camera_frame='µ'), '--camera-frame'),
        (SpiceNames(-999, camera_frame='star tracker'), 'is the star tracker frame too'),
        (SpiceNames(-999, pixel_size_um=-1.0), '--pixel-size-um'),
        (SpiceNames(-99999999), 'shorter NAIF ID'),
    ],
)
def test_names_that_spice_does_not_take_are_refused(names, words, tmp_path) -> None:
    with pytest.raises(OptionError, match=words):
        export(calibration(), 'spice', tmp_path / 'new', Request(names))
    assert not (tmp_path / 'new').exists()


def test_a_field_of_view_wider_than_a_half_space_is_left_out(tmp_path) -> None:
    made = calibration('equidistant')
    camera = made.geometry.camera.replace(fx=400.0, fy=400.0)
    wide = dataclasses.replace(made, geometry=dataclasses.replace(made.geometry, camera=camera))
    done = export(wide, 'spice', tmp_path, Request(NAMES))
    assert '_FOV_' not in (tmp_path / 'camera.ti').read_text().split('begindata')[1]
    assert 'half space' in done.losses[-1].part


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
def test_spice_has_the_attitude_of_each_image_and_none_between(tmp_path, tracker) -> None:
    refused = refused_image(FIRST_NS - 10**10, 1296, 1024, 'no_match', '')
    images = [refused, *map(observed, range(len(TRUTH)))]
    done = written(tmp_path, MADE, images, tracker)
    export(MADE, 'spice', tmp_path, Request(SpiceNames(CLOCK_ID, star_tracker_id=FRAME_ID)))
    spiceypy.kclear()
    for name in (*done.files, 'leap.tls', 'clock.tsc', 'camera.tf'):
        spiceypy.furnsh(str(tmp_path / name))
    # Two axes by all stars; about the boresight by their distance from the centre.
    across_px = NOISE_PX / np.sqrt(STARS)
    # One star is left out, and by chance the others seem to show more than their noise.
    assert 0.98 * across_px < done.losses[0].cost_px < 1.15 * across_px
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


def test_without_stars_or_clock_it_is_refused_and_nothing_is_written(tmp_path) -> None:
    with pytest.raises(ProductError, match='no image with stars'):
        written(tmp_path, MADE, [], 0)
    with pytest.raises(OptionError, match='^--kernels: give the leap seconds kernel'):
        export(MADE, 'ck', tmp_path, Request(SpiceNames(-42), observations=[observed(0)]))
    kernels = [tmp_path / 'leap.tls', tmp_path / 'clock.tsc']
    asked = Request(SpiceNames(-42), observations=[observed(0)], kernels=kernels)
    with pytest.raises(ProductError, match=r'camera\.bc: .*SPICE'):
        export(MADE, 'ck', tmp_path, asked)
    assert not (tmp_path / 'camera.bc').exists()
    warmer = dataclasses.replace(observed(0), temperature_degc=30.0)
    assert written(tmp_path, MADE, [warmer], 0).worst_px == 0.0
