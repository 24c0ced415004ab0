# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Each mistake of a set-up, made on rendered images and on real ones, is named."""

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass
import functools
import json
import math
from pathlib import Path
from typing import Any

import cv2
import erfa
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from starcal_ground.bags import reader
from starcal_ground.blind.images import identify_images
from starcal_ground.diagnosis.attitude_readings import WireAttitudes
from starcal_ground.diagnosis.diagnose import CAUSES, diagnose, Diagnosis
from starcal_ground.parameter_files import read_setup
from starcal_ground.simulation import rendering
from starcal_ground.simulation import scenario as synthetic
from starcal_ros.camera import CameraModel
from starcal_ros.formats.messages.sensor_messages import attitude_from_message
from starcal_ros.pipeline.setup import load_setup, Setup
from starcal_ros.records import CameraGeometry, Image
from starcal_ros.sky.attitude import AttitudeOptions
from starcal_ros.sky.catalog import load_catalog, StarCatalog

pytestmark = pytest.mark.slow

GRANASAT = Path(__file__).parents[4] / 'shared' / 'realsky' / 'granasat'
START_NS = 1778829600_000000000
NO_ATTITUDES = WireAttitudes(np.empty(0, np.int64), np.empty((0, 4)))


@dataclass(frozen=True)
class Night:
    """Images, attitudes and a set-up that fit each other; why a measurement refuses most."""

    images: tuple[Image, ...]
    attitudes: WireAttitudes
    setup: Setup
    refused: str = ''


def night_of(scenario: synthetic.Scenario, stamps_ns: Any, sent: Any) -> Night:
    setup = load_setup({}, prior=scenario.prior)
    return Night(tuple(rendering.images(scenario)), WireAttitudes(stamps_ns, sent), setup)


@functools.cache
def slewing_night(images: int = 3) -> Night:
    """Up to four images, 20 s apart, that slew 1 to 3 deg/s about no one axis; exact attitudes."""
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
        image_count=images,
        cadence_s=step_s,
        start_ns=START_NS + 3_000000000,
    )
    camera_from_tracker = scenario.truth.star_tracker_from_camera.inv()
    reported_s = np.arange(-around_s, (count - 1) * step_s + around_s, 0.5)
    stamps_ns = START_NS + np.rint(reported_s * 1e9).astype(np.int64)
    sent = (path(reported_s) * camera_from_tracker).as_quat()
    return night_of(scenario, stamps_ns, sent)


@functools.cache
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
        tuple(images[2:5]),  # the first two carry an attitude of something else
        WireAttitudes(stamps_ns[order], quaternions),
        load_setup({}, prior=CameraGeometry(camera, np.array(prior['align_prior_xyzw']))),
    )


@pytest.fixture(scope='module', params=[slewing_night, granasat_night])
def night(request: pytest.FixtureRequest) -> Any:
    return request.param()


@pytest.fixture(scope='module')
def catalog() -> StarCatalog:
    return load_catalog(None, 9.0)


Change = Callable[[Night], Night]


def of_quaternions(change: Callable[[Any], Any]) -> Change:
    return lambda night: dataclasses.replace(
        night, attitudes=WireAttitudes(night.attitudes.time_ns, change(night.attitudes.quaternion))
    )


def of_images(change: Callable[[Image], Image]) -> Change:
    return lambda night: dataclasses.replace(night, images=tuple(map(change, night.images)))


def of_pixels(change: Callable[[Any], Any]) -> Change:
    return of_images(lambda i: Image(i.time_ns, np.ascontiguousarray(change(i.pixels))))


def late(seconds: float) -> Change:
    return of_images(lambda i: Image(i.time_ns + round(seconds * 1e9), i.pixels))


def with_setup(night: Night, **changes: Any) -> Night:
    return dataclasses.replace(night, setup=dataclasses.replace(night.setup, **changes))


def with_alignment(night: Night, star_tracker_from_camera: Rotation) -> Night:
    prior = CameraGeometry(night.setup.prior.camera, star_tracker_from_camera.as_quat())
    return with_setup(night, prior=prior)


def turned(turn: Rotation) -> Change:
    """State an alignment that is turned by a rotation of the camera."""
    return lambda n: with_alignment(n, n.setup.prior.star_tracker_from_camera * turn)


def found_in(night: Night, catalog: StarCatalog) -> Diagnosis:
    setup = dataclasses.replace(night.setup, catalog=catalog)
    found = diagnose(night.images, night.attitudes, setup, refused=night.refused)
    assert found.cause in CAUSES and found.sentence.endswith('.')
    return found


DATE_JD = (2440587.5, START_NS / 86400e9)


def sent_as(order: list[int], signs: tuple[int, ...] = (1, 1, 1, 1)) -> Change:
    return of_quaternions(lambda q: (q * np.array(signs))[:, order])


w_first = sent_as([3, 0, 1, 2])
conjugated = sent_as([0, 1, 2, 3], (-1, -1, -1, 1))


def unaligned(night: Night) -> Night:
    return with_setup(night, is_aligned=False)


def inverse_direction(night: Night) -> Night:
    return with_setup(night, attitude=AttitudeOptions(attitude_direction='inertial_to_st'))


def off(degrees: float) -> Change:
    return turned(Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, -0.64, 0.48])))


def rolled(degrees: float) -> Change:
    return turned(Rotation.from_euler('z', degrees, degrees=True))


half_turned = rolled(180.0)
mirrored = of_pixels(lambda pixels: pixels[:, ::-1])


def with_all_images(night: Night) -> Night:
    """Add the fourth image, where three do not show the mistake."""
    return dataclasses.replace(night, images=slewing_night(4).images)


@of_pixels
def dark(pixels: Any) -> Any:
    return np.random.default_rng(1).poisson(50, pixels.shape).astype(pixels.dtype)


def capped_at_first(night: Night) -> Night:
    cap_on = tuple(
        Image(night.images[0].time_ns - 1000 * (k + 1), np.zeros_like(night.images[0].pixels))
        for k in range(12)
    )
    return dataclasses.replace(night, images=cap_on + night.images)


@of_pixels
def curved(pixels: Any) -> Any:
    light = np.maximum(pixels.astype(float) - np.median(pixels), 0.0) / pixels.max()
    return (10 + 0.8 * pixels.max() * light ** (1 / 2.2)).astype(pixels.dtype)


def smeared(length: int) -> Change:
    def change(pixels: Any) -> Any:
        level = np.median(pixels)
        light = np.stack([np.roll(pixels, k, axis=1) for k in range(length)]).astype(float)
        streaks = level + (light - level).sum(axis=0) / 6
        most = np.iinfo(pixels.dtype).max if pixels.itemsize == 1 else 4095
        return streaks.clip(0, most).astype(pixels.dtype)

    return of_pixels(change)


def with_camera(change: Callable[[Night, CameraModel], CameraModel]) -> Change:
    """State another camera matrix, or another size."""

    def changed(night: Night) -> Night:
        prior = night.setup.prior
        camera = change(night, prior.camera)
        return with_setup(night, prior=dataclasses.replace(prior, camera=camera))

    return changed


def with_focal_length(share: float) -> Change:
    return with_camera(
        lambda _, camera: camera.replace(
            fx=share * float(camera.parameters[0]), fy=share * float(camera.parameters[2])
        )
    )


@of_quaternions
def of_something_else(quaternions: Any) -> Any:
    return Rotation.random(len(quaternions), random_state=np.random.default_rng(3)).as_quat()


def in_axes(matrix: Any) -> Change:
    turn = Rotation.from_matrix(matrix)
    return of_quaternions(lambda q: (turn * Rotation.from_quat(q)).as_quat())


@of_quaternions
def frozen(quaternions: Any) -> Any:
    return np.tile(quaternions[:1], (len(quaternions), 1))


def with_centre(right: float, down: float) -> Change:
    """State a principal point that is off by parts of the width."""
    return with_camera(
        lambda _, camera: camera.replace(
            cx=float(camera.parameters[3]) + right * camera.width,
            cy=float(camera.parameters[4]) + down * camera.width,
        )
    )


@with_camera
def with_size(night: Night, camera: CameraModel) -> CameraModel:
    """State the size of the images in the camera file, which has another camera matrix."""
    height, width = night.images[0].pixels.shape
    return dataclasses.replace(camera, width=width, height=height)


def region(left: float, right: float, top: float, bottom: float) -> Change:
    def cut(pixels: Any) -> Any:
        height, width = pixels.shape
        rows = slice(int(top * height), int(bottom * height))
        return pixels[rows, int(left * width) : int(right * width)]

    return of_pixels(cut)


@of_pixels
def binned(pixels: Any) -> Any:
    height, width = pixels.shape
    bins = pixels.reshape(height // 2, 2, width // 2, 2)
    return bins.mean(axis=(1, 3)).astype(pixels.dtype)


def inverse_alignment(night: Night) -> Night:
    return with_alignment(night, night.setup.prior.star_tracker_from_camera.inv())


def of_camera(night: Night) -> Night:
    """Send the attitudes of the camera, and state the alignment of the star tracker."""
    alignment = night.setup.prior.star_tracker_from_camera
    return of_quaternions(lambda q: (Rotation.from_quat(q) * alignment).as_quat())(night)


def without_tracker(night: Night) -> Night:
    """Take the attitudes for those of the stars, as in bags that are made of photographs."""
    frames = dataclasses.replace(night.setup.frames, star_tracker_frame='')
    return with_setup(night, frames=frames)


def blurred(light: Callable[[Any, Any], Any], refused: str = 'too_few_stars') -> Any:
    """Spread each star over the pixels (u, v) about its own where a function is positive."""
    v, u = np.mgrid[-15:16, -15:16].astype(float)
    kernel = np.maximum(light(u, v), 0.0)
    kernel /= kernel.sum()

    def spread(pixels: Any) -> Any:
        level = np.median(pixels)
        noise = 1.48 * np.median(np.abs(pixels - level))
        stars = cv2.filter2D(pixels - level, -1, kernel[::-1, ::-1])
        # The filter averages the noise, which does not depend on the lens.
        made = level + stars + np.random.default_rng(0).normal(0.0, noise, pixels.shape)
        return made.clip(0, 65535).astype(pixels.dtype)

    def change(night: Night) -> Night:
        return dataclasses.replace(of_pixels(spread)(night), refused=refused)

    return change


def disc(outer_px: float, inner_px: float = -1.0) -> Callable[[Any, Any], Any]:
    def light(u: Any, v: Any) -> Any:
        radius_px = np.hypot(u, v)
        return (radius_px <= outer_px) & (radius_px > inner_px)

    return light


def comet(u: Any, v: Any) -> Any:
    """A head with a tail of 12 px towards +u that becomes wider and fainter."""
    along = np.maximum(u, 0.0)
    across = np.hypot(np.minimum(u, 0.0), v) / (0.7 + 0.3 * along)
    return np.exp(-0.5 * across**2 - along / 6.0) * (u < 12)


def together(*changes: Change) -> Change:
    return lambda night: functools.reduce(lambda made, change: change(made), changes, night)


def with_the_earth(night: Night) -> Night:
    """Send attitudes in axes that turn with the Earth."""
    earth_from_icrf = [
        erfa.rz(erfa.gst06a(DATE_JD[0], day, DATE_JD[0], day), erfa.pnm06a(DATE_JD[0], day))
        for day in night.attitudes.time_ns / 86400e9
    ]
    turns = Rotation.from_matrix(np.array(earth_from_icrf))
    return of_quaternions(lambda q: (turns * Rotation.from_quat(q)).as_quat())(night)


@of_pixels
def expanded(pixels: Any) -> Any:
    """Undo the curve of sRGB in linear pixels of 8 bits, with stars that stand out."""
    light = np.clip((pixels.astype(float) - np.median(pixels)) / pixels.max(), 0.0, 1.0)
    noise = np.random.default_rng(0).normal(100.0, 2.0, pixels.shape)
    return (noise + 60000.0 * light**2.2).clip(0, 65535).astype(np.uint16)


@pytest.mark.parametrize(
    ('changes', 'causes', 'value', 'words'),
    [
        ([], 'none', None, ''),
        ([w_first], 'quaternion_order', 'wxyz', ''),
        ([conjugated], 'attitude_direction', 'inertial_to_st', 'on: inertial_to_st'),
        ([inverse_direction], 'attitude_direction', 'st_to_inertial', ''),
        ([rolled(-90.0)], 'rotated', 90.0, ''),
        ([mirrored], 'mirrored', 'left to right', ''),
        ([of_pixels(lambda p: p[::-1])], 'mirrored', 'top to bottom', ''),
        ([of_pixels(lambda p: p[::-1, ::-1])], 'rotated', 180.0, ''),
        ([of_pixels(np.rot90)], 'rotated', 90.0, 'degrees counterclockwise.'),
        ([of_pixels(lambda p: np.rot90(p, -1))], 'rotated', 90.0, 'degrees clockwise.'),
        # One image shows it to a few parts in a thousand, its distortion being unknown.
        ([with_focal_length(0.8)], 'focal_length', 'fx to 0.01', '% too short'),
        ([with_focal_length(1.2)], 'focal_length', 'fx to 0.01', '% too long'),
        ([dark], 'no_stars', None, ''),
        ([capped_at_first], 'none', None, ''),
        # Up to 10 px they are measured; one longer than the window of 13 px is cut.
        ([smeared(12)], 'smear', pytest.approx(12, abs=2), 'about'),
        ([smeared(40)], 'smear', pytest.approx(13, abs=2), 'at least'),
        ([curved], 'not_linear', None, ''),
        ([of_something_else], 'unknown', None, ''),
        ([conjugated, half_turned], 'attitude_direction rotated', None, ''),
    ],
)
def test_mistakes_of_a_rendered_and_of_a_real_night(
    night, catalog, changes, causes, value, words
) -> None:
    found = found_in(together(*changes)(night), catalog)
    assert [found.cause, *found.also] == causes.split()
    assert words in ' '.join([found.sentence, *found.mend])
    if value == 'fx to 0.01':
        value = pytest.approx(float(night.setup.prior.camera.parameters[0]), rel=0.01)
    assert value is None or found.found == value


@pytest.mark.parametrize('missing', [False, True])
def test_alignment(night, catalog, missing) -> None:
    right = night.setup.prior.star_tracker_from_camera
    tilted = turned(Rotation.from_euler('x', 10.0, degrees=True))
    found = found_in((unaligned if missing else tilted)(night), catalog)
    assert found.cause == 'prior_alignment'
    # The prior of the rendered night is off by 150 arcsec an axis; a lost principal point of 1 px
    # would be 100 arcsec. Within the degree and a half that is searched, it will do.
    assert isinstance(found.found, list)
    # It goes with the principal point stated: that of the real night is off by 49 of 2656 px.
    assert (Rotation.from_quat(found.found).inv() * right).magnitude() < math.radians(1.2)


def test_alignment_by_stars_among_the_structure_of_a_corona(catalog) -> None:
    """Eighty wide spots, most of them brighter than the stars: the compact sources are known."""
    rng = np.random.default_rng(5)

    def with_corona(pixels: Any) -> Any:
        v, u = map(np.arange, pixels.shape)
        light = np.zeros(pixels.shape)
        for _ in range(80):
            u0, v0 = rng.uniform((0.0, 0.0), pixels.shape[::-1])
            along_u, along_v = (np.exp(-(x**2) / (2 * 3.0**2)) for x in (u - u0, v - v0))
            light += 10 ** rng.uniform(1.5, 2.3) * np.outer(along_v, along_u)
        return np.minimum(pixels + light, 4095.0).astype(pixels.dtype)

    change = together(of_pixels(with_corona), turned(Rotation.from_rotvec([0.4, 0.3, 1.0])))
    found = found_in(change(slewing_night(4)), catalog)
    assert (found.cause, found.images) == ('prior_alignment', 3)


@pytest.mark.parametrize(
    ('night_of', 'late_s'),
    [
        *[(slewing_night, late_s) for late_s in (-47.0, -1.5, 58.0)],
        (granasat_night, 33.0),
    ],
)
def test_clock(catalog, night_of, late_s) -> None:
    found = found_in(late(late_s)(night_of()), catalog)
    assert found.cause == 'clock'
    # A tenth of a second of 2 degrees a second is what the star tracker's mounting would hide.
    # At rest, the attitudes are known for half a second before and after each image: the middle.
    assert found.found == pytest.approx(-late_s, abs=0.1)


def at_rest(count: int) -> Night:
    """Images of one attitude, which all ways to read the quaternions fit."""
    scenario = dataclasses.replace(
        synthetic.scenario('tiny', seed=3),
        pointing=synthetic.Inertial(((250.0, 32.0, 10.0),)),
        image_count=count,
    )
    samples = [s for k in range(count) for s in synthetic.attitude_samples(scenario, k)]
    stamps_ns = np.array([sample.time_ns for sample in samples])
    sent = np.array([sample.icrf_from_star_tracker_xyzw for sample in samples])
    return night_of(scenario, stamps_ns, sent)


@pytest.mark.parametrize('count', [1, 3])
def test_images_that_do_not_turn(catalog, count) -> None:
    resting = at_rest(count)
    assert found_in(resting, catalog).cause == 'none'
    assert found_in(conjugated(resting), catalog).cause == 'attitude_direction'
    assert found_in(off(10)(resting), catalog).cause == 'prior_alignment'
    # Which of the two is wrong cannot be seen: neither is blamed.
    assert found_in(off(30)(conjugated(resting)), catalog).cause == 'unknown'


GALACTIC = np.array(
    [erfa.s2c(*erfa.g2icrs(*lb)) for lb in ((0, 0), (np.pi / 2, 0), (0, np.pi / 2))]
)
ECLIPTIC = Rotation.from_euler('x', -84381.406 / 3600, degrees=True).as_matrix()
REVERSED = Rotation.from_euler('x', 180.0, degrees=True).as_matrix()
OWN = Rotation.from_rotvec([0.5, 1.0, -0.7]).as_matrix()
LEFT_HANDED = sent_as([0, 1, 2, 3], (-1, -1, 1, 1))
ONE_SIGN = sent_as([0, 1, 2, 3], (1, 1, -1, 1))


@pytest.mark.parametrize(
    ('changes', 'causes', 'words'),
    [
        # Two mistakes.
        ([conjugated, off(40)], 'attitude_direction prior_alignment', 'inertial_to_st'),
        ([conjugated, unaligned], 'attitude_direction prior_alignment', 'inertial_to_st'),
        ([conjugated, w_first], 'quaternion_order attitude_direction', 'sent with w first'),
        ([w_first, off(6)], 'quaternion_order prior_alignment', 'sent with w first'),
        ([half_turned, off(12)], 'prior_alignment', 'prior_alignment'),
        ([late(20.0), conjugated], 'attitude_direction clock', 'stamp_offset_s: -20'),
        ([late(20.0), unaligned], 'clock prior_alignment', 'stamp_offset_s: -20'),
        ([conjugated, mirrored], 'mirrored attitude_direction', 'mirrored left to right'),
        # Inertial axes: those with a name, two reversed, any fixed ones.
        ([in_axes(GALACTIC)], 'axes', 'in axes of the galactic system, not of the ICRF'),
        ([with_the_earth], 'axes', 'in axes of the rotating Earth, not of the ICRF'),
        ([in_axes(erfa.pmat06(*DATE_JD))], 'axes', 'the mean equator and equinox of date'),
        ([in_axes(ECLIPTIC)], 'axes', 'send attitudes in axes of the ICRF (J2000)'),
        ([in_axes(erfa.ecm06(*DATE_JD))], 'axes', 'in axes of the ecliptic of date'),
        ([in_axes(erfa.pmat76(2433282.423, 0.0))], 'axes', 'mean equator and equinox of B1950'),
        ([in_axes(REVERSED)], 'axes', 'a frame whose x, y, z are x, -y, -z of the ICRF'),
        ([in_axes(OWN)], 'axes', 'a frame turned by 75.6 degrees about RA 63, Dec -32'),
        ([in_axes(ECLIPTIC), conjugated], 'attitude_direction axes', 'ecliptic of J2'),
        # Orders and signs of the numbers: reversed order, one sign, left-handed axes, exchanged.
        ([sent_as([3, 2, 1, 0])], 'quaternion_order', 'of the attitudes hold w, z, y, x.'),
        ([ONE_SIGN], 'quaternion_order', 'hold x, y, -z, w.'),
        ([LEFT_HANDED], 'quaternion_order', 'hold -x, -y, z, w.'),
        ([sent_as([1, 0, 2, 3])], 'quaternion_order', 'hold y, x, z, w.'),
        ([LEFT_HANDED, mirrored], 'mirrored quaternion_order', 'mirrored left to right'),
        # Without an alignment two explain the stars equally, and both are named.
        (
            [ONE_SIGN, unaligned],
            'quaternion_order',
            'hold x, y, -z, w, or are inertial_to_st (x, y, z, w) in axes of a frame whose x',
        ),
        ([frozen], 'frozen_attitude', 'The attitudes stay the same while the stars turn by'),
        ([inverse_alignment], 'prior_alignment', 'the inverse of it: camera from star tracker'),
        ([of_camera], 'prior_alignment', 'the attitudes are those of the camera itself'),
        # The camera matrix.
        (
            [with_centre(0.3, 0.2), off(40)],
            'principal_point prior_alignment',
            'prior_alignment points',
        ),
        (
            [with_centre(0.1, -0.05), conjugated],
            'attitude_direction principal_point',
            'The principal point',
        ),
        (
            [region(0.25, 0.95, 0.1, 0.8), with_size],
            'principal_point',
            'a camera matrix of the whole detector with the size of a region looks so',
        ),
        ([region(0.25, 0.95, 0.1, 0.8)], 'wrong_size', 'a region of the detector (roi of'),
        # Half as wide and high, but no bins: the stars tell.
        ([region(0.35, 0.85, 0.2, 0.7)], 'wrong_size', 'a region of the detector (roi of'),
        ([binned, off(40)], 'wrong_size prior_alignment', 'prior_alignment points'),
        ([of_pixels(lambda p: p.T)], 'mirrored rotated', 'sides are those'),
        ([expanded], 'not_linear', 'a tone curve that they never had'),
        # One shape of all stars: discs and rings of a lens out of focus, and comets. None where
        # they are measured.
        ([blurred(disc(4.0, 2.0))], 'one_shape', 'All stars are wide discs or rings alike'),
        ([blurred(disc(5.0))], 'one_shape', 'focus the lens'),
        ([with_all_images, blurred(comet)], 'one_shape', 'All stars are elongated alike, '),
        ([blurred(disc(4.0, 2.0)), conjugated], 'attitude_direction', 'quaternions are'),
        ([blurred(disc(3.0), '')], 'none', 'Attitudes, alignment and camera fit the images.'),
        # What a calibration can take up is nobody's mistake.
        ([with_centre(0.03, 0.0)], 'none', 'Attitudes, alignment and camera fit the images.'),
        (
            [without_tracker],
            'none',
            'The images show stars of the catalog; no camera and no attitudes are stated.',
        ),
    ],
)
def test_a_mistake_is_named_and_nothing_else(changes, causes, words, catalog) -> None:
    found = found_in(together(*changes)(slewing_night()), catalog)
    assert [found.cause, *found.also] == causes.split()
    assert words in ' '.join([found.sentence, *found.evidence, *found.mend])
    assert bool(found.mend) == (causes != 'none')


def test_stars_as_wide_as_rings_are_identified_in_bins_of_pixels(catalog, monkeypatch) -> None:
    """Of one image, for which nothing is searched with single pixels: it takes long, in vain."""

    def in_bins(images, camera, catalog, guesses, most=0.0):
        return identify_images(images, camera, catalog, guesses, most)

    monkeypatch.setattr('starcal_ground.diagnosis.diagnose.identify_images', in_bins)
    night = dataclasses.replace(slewing_night(), images=slewing_night().images[1:2])
    found = found_in(blurred(disc(9.0, 5.0), 'no_match')(night), catalog)
    assert (found.cause, found.also) == ('one_shape', ()) and found.mend
    assert 'in bins of 4 x 4 pixels only' in ' '.join(found.evidence)


def test_the_numbers_of_a_camera_matrix(catalog) -> None:
    """Those that go into the camera file are right."""
    night = slewing_night()
    fx, cx, cy = (float(night.setup.prior.camera.parameters[k]) for k in (0, 3, 4))
    found = found_in(with_centre(0.3, 0.2)(night), catalog)
    assert found.cause == 'principal_point' and isinstance(found.found, list)
    assert found.sentence.startswith('The principal point of the prior camera')
    # The prior is off by 4 px, which the stars show to 1.
    assert found.found == pytest.approx([cx, cy], abs=7.0)
    assert found.mend == (
        f'# in the file of camera_info_url: cx = {found.found[0]}, cy = {found.found[1]}',
    )
    for change, cause, words in (
        (binned, 'wrong_size', 'binned 2 x 2 (binning_x, binning_y of CameraInfo)'),
        (together(binned, with_size), 'focal_length', 'is of pixels before 2 x 2 binning'),
    ):
        found = found_in(change(night), catalog)
        assert (found.cause, found.also) == (cause, ())
        assert words in ' '.join([found.sentence, *found.evidence, *found.mend])
        numbers = [float(n) for n in found.mend[0].rpartition('= ')[2].split(', ')]
        # Pixel 0 of 2 x 2 is at 0.5 of the detector.
        expected = [fx / 2, fx / 2, (cx + 0.5) / 2 - 0.5, (cy + 0.5) / 2 - 0.5]
        assert numbers == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    ('late_s', 'words'),
    [
        (37.0, '37 s is TAI - UTC'),
        (-18.0, '18 s is GPS time - UTC'),
        (-12600.0, '3.5 h is the difference of two time zones'),
    ],
)
def test_a_clock_of_another_scale_or_zone(late_s, words, catalog) -> None:
    """Attitudes of a whole day, in which the images are somewhere."""
    night = slewing_night()
    steady = np.arange(-50_000, 50_000, 10, dtype=np.int64) * 1_000_000_000 + START_NS
    around = (steady < night.attitudes.time_ns[0]) | (steady > night.attitudes.time_ns[-1])
    time_ns = np.concatenate([night.attitudes.time_ns, steady[around]])
    turns = Rotation.random(int(around.sum()), random_state=1).as_quat()
    order = np.argsort(time_ns)
    quaternions = np.concatenate([night.attitudes.quaternion, turns])[order]
    of_a_day = dataclasses.replace(night, attitudes=WireAttitudes(time_ns[order], quaternions))
    found = found_in(late(late_s)(of_a_day), catalog)
    assert found.cause == 'clock' and words in ' '.join(found.evidence)
    assert found.found == pytest.approx(-late_s, abs=0.1)  # as in `test_clock`


@pytest.mark.parametrize(
    ('shape', 'remedies'),
    [
        ((256, 320), ['if they are binned 2 x 2', 'if they are a region of the detector']),
        ((400, 600), ['cx = 319.50 - x_offset']),
        ((1024, 1280), ['the focal length in their pixels']),
    ],
)
def test_a_size_without_known_stars_has_the_remedies_of_all_it_can_be(shape, remedies) -> None:
    setup = read_setup(Path(__file__).parents[3] / 'bags' / 'tiny' / 'params.yaml')
    pixels = np.random.default_rng(0).integers(90, 110, shape, np.uint16)
    found = diagnose([Image(k, pixels) for k in range(3)], NO_ATTITUDES, setup)
    assert found.cause == 'wrong_size' and 'the prior camera is of 640 x 512.' in found.sentence
    assert f'image_width: {shape[1]}, image_height: {shape[0]}' in found.mend[0]
    for remedy in remedies:
        assert remedy in found.mend[0]
