# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each mistake of a set-up, made on rendered images and on real ones, is named."""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from starcal_ros.bag import reader
from starcal_ros.camera import CameraModel
from starcal_ros.messages.telemetry import attitude_from_message
from starcal_ros.pipeline.attitude_reading import SetUp, WireAttitudes
from starcal_ros.pipeline.diagnose import CAUSES, diagnose, Diagnosis
from starcal_ros.records import Image
from starcal_ros.simulation import images as simulated_images
from starcal_ros.simulation import scenario as synthetic
from starcal_ros.sky.catalog import load_catalog, StarCatalog

GRANASAT = Path('/work/shared/realsky/granasat')
START_NS = 1778829600_000000000


@dataclass(frozen=True)
class Night:
    """Images, attitudes and a set-up that fit each other."""

    images: tuple[Image, ...]
    attitudes: WireAttitudes
    setup: SetUp


def set_up(camera: CameraModel, star_tracker_from_camera_xyzw: Any) -> SetUp:
    return SetUp(
        camera=camera,
        star_tracker_from_camera=Rotation.from_quat(star_tracker_from_camera_xyzw),
        attitude_direction='st_to_inertial',
        stamp_offset_s=0.0,
        max_attitude_gap_s=2.0,
        acquisition_rad=math.radians(1.5),
        acquisition_roll_rad=math.radians(5.0),
    )


def slewing_night() -> Night:
    """
    Four images, 20 s apart, of a spacecraft that slews 1 to 3 degrees a second about no one axis.

    The attitude is reported each half second for 100 s before and after, without noise.
    """
    rng = np.random.default_rng(7)
    step_s, around_s, count = 20.0, 100.0, 4
    knots_s = np.arange(-around_s - step_s, (count - 1) * step_s + around_s + 2 * step_s, step_s)
    turns = Rotation.from_rotvec(rng.normal(size=(len(knots_s), 3)) * math.radians(25.0))
    icrf_from_camera = [Rotation.random(random_state=rng)]
    for turn in turns[1:]:
        icrf_from_camera.append(icrf_from_camera[-1] * turn)
    path = Slerp(knots_s, Rotation.concatenate(icrf_from_camera))
    at_s = np.arange(count) * step_s + 3.0
    fields = []
    for z in path(at_s).as_matrix():
        ra = math.degrees(math.atan2(z[1, 2], z[0, 2])) % 360
        dec = math.degrees(math.asin(z[2, 2]))
        upright = Rotation.from_euler('ZXZ', np.radians([ra + 90, 90 - dec, 0.0])).as_matrix()
        rolled = upright.T @ z
        fields.append((ra, dec, math.degrees(math.atan2(rolled[1, 0], rolled[0, 0]))))
    scenario = dataclasses.replace(
        synthetic.scenario('tiny', seed=3),
        pointing=synthetic.Inertial(tuple(fields)),
        image_count=count,
        cadence_s=step_s,
        start_ns=START_NS + 3_000000000,
    )
    camera_from_tracker = Rotation.from_quat(scenario.truth.star_tracker_from_camera_xyzw).inv()
    reported_s = np.arange(-around_s, (count - 1) * step_s + around_s, 0.5)
    stamps_ns = START_NS + np.rint(reported_s * 1e9).astype(np.int64)
    sent = (path(reported_s) * camera_from_tracker).as_quat()
    prior = scenario.prior
    return Night(
        tuple(simulated_images.images(scenario)),
        WireAttitudes(stamps_ns, sent),
        set_up(prior.camera, prior.star_tracker_from_camera_xyzw),
    )


def granasat_night() -> Night:
    if not GRANASAT.exists():
        pytest.skip('the real sky is not here')
    paths = [GRANASAT]
    images = [i for i in reader.read_images(paths, '/opnav/image_raw') if isinstance(i, Image)]
    sent = [
        attitude_from_message(reader.decode(raw))
        for raw in reader.read_raw(paths, ['/star_tracker/attitude'])
    ]
    prior = json.loads(GRANASAT.with_name('granasat.prior.json').read_text())
    camera = CameraModel(
        prior['width'], prior['height'], np.array([*prior['k_prior'], *prior['d_prior']])
    )
    stamps_ns = np.array([stamp for stamp, _ in sent])
    order = np.argsort(stamps_ns)
    quaternions = np.array([quaternion for _, quaternion in sent])[order]
    return Night(
        tuple(images[2:6]),  # the first two carry an attitude of something else
        WireAttitudes(stamps_ns[order], quaternions),
        set_up(camera, prior['align_prior_xyzw']),
    )


@pytest.fixture(scope='module', params=[slewing_night, granasat_night])
def night(request: pytest.FixtureRequest) -> Any:
    return request.param()


@pytest.fixture(scope='module')
def catalog() -> StarCatalog:
    return load_catalog(None, 9.0)


def with_quaternions(night: Night, change: Callable[[Any], Any]) -> Night:
    attitudes = WireAttitudes(night.attitudes.time_ns, change(night.attitudes.quaternion))
    return dataclasses.replace(night, attitudes=attitudes)


def with_pixels(night: Night, change: Callable[[Any], Any]) -> Night:
    images = tuple(Image(i.time_ns, np.ascontiguousarray(change(i.pixels))) for i in night.images)
    return dataclasses.replace(night, images=images)


def with_alignment(night: Night, turn: Rotation) -> Night:
    prior = night.setup.star_tracker_from_camera
    assert prior is not None
    setup = dataclasses.replace(night.setup, star_tracker_from_camera=prior * turn)
    return dataclasses.replace(night, setup=setup)


def with_setup(night: Night, **changes: Any) -> Night:
    return dataclasses.replace(night, setup=dataclasses.replace(night.setup, **changes))


def found_in(night: Night, catalog: StarCatalog) -> Diagnosis:
    found = diagnose(night.images, night.attitudes, night.setup, catalog)
    assert found.cause in CAUSES and found.sentence.endswith('.')
    return found


def test_nothing_is_wrong(night: Night, catalog: StarCatalog) -> None:
    assert found_in(night, catalog).cause == 'none'


def test_w_first(night: Night, catalog: StarCatalog) -> None:
    found = found_in(with_quaternions(night, lambda q: q[:, [3, 0, 1, 2]]), catalog)
    assert (found.cause, found.found) == ('quaternion_order', 'wxyz')


def test_conjugated(night: Night, catalog: StarCatalog) -> None:
    found = found_in(with_quaternions(night, lambda q: q * [-1, -1, -1, 1]), catalog)
    assert (found.cause, found.found) == ('attitude_direction', 'inertial_to_st')
    assert found.mend[0] == 'attitude_direction: inertial_to_st'


def test_wrong_attitude_direction(night: Night, catalog: StarCatalog) -> None:
    found = found_in(with_setup(night, attitude_direction='inertial_to_st'), catalog)
    assert (found.cause, found.found) == ('attitude_direction', 'st_to_inertial')


@pytest.mark.parametrize('missing', [False, True])
def test_alignment(night: Night, catalog: StarCatalog, missing: bool) -> None:
    right = night.setup.star_tracker_from_camera
    assert right is not None
    if missing:
        wrong = with_setup(night, star_tracker_from_camera=None)
    else:
        wrong = with_alignment(night, Rotation.from_euler('x', 10.0, degrees=True))
    found = found_in(wrong, catalog)
    assert found.cause == 'prior_alignment'
    # The prior of the rendered night is off by 150 arcsec an axis; a lost principal point of 1 px
    # would be 100 arcsec. Within the degree and a half that is searched, it will do.
    assert isinstance(found.found, list)
    assert (Rotation.from_quat(found.found).inv() * right).magnitude() < math.radians(1.0)


@pytest.mark.parametrize('degrees', [90.0, 180.0])
def test_rolled_alignment(night: Night, catalog: StarCatalog, degrees: float) -> None:
    wrong = with_alignment(night, Rotation.from_euler('z', -degrees, degrees=True))
    found = found_in(wrong, catalog)
    assert (found.cause, found.found) == ('rotated', degrees)


@pytest.mark.parametrize(
    ('how', 'change'),
    [('left to right', lambda p: p[:, ::-1]), ('top to bottom', lambda p: p[::-1])],
)
def test_mirrored(night: Night, catalog: StarCatalog, how: str, change: Any) -> None:
    found = found_in(with_pixels(night, change), catalog)
    assert (found.cause, found.found) == ('mirrored', how)


def test_rotated_image(night: Night, catalog: StarCatalog) -> None:
    found = found_in(with_pixels(night, lambda p: p[::-1, ::-1]), catalog)
    assert (found.cause, found.found) == ('rotated', 180.0)


@pytest.mark.parametrize('share', [0.8, 1.2])
def test_focal_length(night: Night, catalog: StarCatalog, share: float) -> None:
    camera = night.setup.camera
    fx, _, fy = camera.intrinsics[:3]
    wrong = with_setup(night, camera=camera.replace(fx=share * float(fx), fy=share * float(fy)))
    found = found_in(wrong, catalog)
    assert found.cause == 'focal_length'
    # One image tells it to a few parts in a thousand, its distortion being unknown.
    assert found.found == pytest.approx(float(fx), rel=0.01)


@pytest.mark.parametrize('late_s', [-47.0, -1.5, 3.0, 58.0])
def test_clock(catalog: StarCatalog, late_s: float) -> None:
    night = slewing_night()
    images = tuple(
        Image(image.time_ns + round(late_s * 1e9), image.pixels) for image in night.images
    )
    found = found_in(dataclasses.replace(night, images=images), catalog)
    assert found.cause == 'clock'
    # A tenth of a second of 2 degrees a second is what the star tracker's mounting would hide.
    assert found.found == pytest.approx(-late_s, abs=0.1)


def test_no_stars(catalog: StarCatalog) -> None:
    night = slewing_night()
    rng = np.random.default_rng(1)
    dark = with_pixels(night, lambda p: rng.poisson(50, p.shape).astype(p.dtype))
    assert found_in(dark, catalog).cause == 'no_stars'


def test_smear(catalog: StarCatalog) -> None:
    def smeared(pixels: Any) -> Any:
        level = np.median(pixels)
        light = np.stack([np.roll(pixels, k, axis=1) for k in range(40)]).astype(float) - level
        return (level + light.sum(axis=0) / 6).clip(0, 4095).astype(pixels.dtype)

    found = found_in(with_pixels(slewing_night(), smeared), catalog)
    assert found.cause == 'smear'


def test_tone_curve(catalog: StarCatalog) -> None:
    def curved(pixels: Any) -> Any:
        light = np.maximum(pixels.astype(float) - np.median(pixels), 0.0)
        return (100 + 3000 * (light / 4095) ** (1 / 2.2)).astype(pixels.dtype)

    found = found_in(with_pixels(slewing_night(), curved), catalog)
    assert found.cause == 'not_linear'
