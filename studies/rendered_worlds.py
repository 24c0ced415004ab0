# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rendered images of worlds with a fault of the lens, the detector or the star tracker."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
from dataclasses import dataclass
from functools import partial
import math

import cv2
import erfa
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from starcal_ground.simulation import rendering
from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.deep_sky import deep_sky
from starcal_ground.simulation.scenario import Detector, Inertial, Scenario, Scene
from starcal_ros.arrays import Floats, Mask, Pixels
from starcal_ros.camera import CameraModel, line_of_sight, project
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SPEED_OF_LIGHT_M_S
from starcal_ros.records import AttitudeSample, CameraGeometry, Image
from starcal_ros.sky.astrometry import earth_velocity_c
from studies.worlds import aberrated, eighth_order, keystone

# Displacement (n, 2) px of pixels (n, 2), of a size, and drawn from a generator.
Lens = Callable[[CameraModel, float, Generator, Floats], Floats]
Pair = tuple[CameraGeometry, CameraGeometry]

IMAGES = 14
COPIES = 30
_WANDER_IMAGES = 10.0  # correlation length of the star tracker that wanders
_ABBBA = (0, 1, 1, 1, 0)
_EXPOSURE_S = 0.1  # of a camera that turns
_READOUT_S = 0.02  # from its first row to the last
_COARSE_PX = 330.0  # focal length of pixels of 10 arcminutes, in which stars blend
_COARSE = Detector(psf_sigma_px=0.6, zero_point_electrons=4e6, bits=14, electrons_per_dn=8.0)
_SPREAD_DEG = 20.0  # of the fields with faint stars
_SKY_RAD = math.radians(90.0)  # about their middle
_PLANET_PX = 60.0  # radius of a disc
_PLANET_ELECTRONS = 60_000.0  # of a sunlit pixel, which saturates where stars of V = 7 are seen
_GLARE_ELECTRONS = 300.0  # scattered light at the edge of a planet that fills the frame
_GHOSTS = ((-1.0, 1.3, 40.0), (0.5, 2.0, 12.0), (-0.4, 0.6, 80.0))  # place, radius, electrons
_MOONS, _MOON_LOG_ELECTRONS = 4, (7.6, 12.6)  # as stars of V = 2 to 5.5
_HOSTILE = Detector(psf_growth=0.3, hot_fraction=2e-3, cosmic_rays=40.0, sky_electrons=20.0)


def _as_modelled(camera: CameraModel, size: float, rng: Generator, pixels: Floats) -> Floats:
    return np.zeros_like(pixels)


@dataclass(frozen=True)
class World:
    """
    A fault of the world and its size, and words of which a refusal must hold one.

    The other fields are the parts of a campaign that a fault changes: ``geometries`` the truth and
    the prior; ``lens`` the pixels of stars; ``focal_change`` the focal length in an image, in
    units of the size; ``read_out`` the pixels of an image, by ``mean_shift_px`` along a row.  A
    camera that turns does so by the size, in deg/s, about an axis across the line of sight, is
    smeared during the exposure and reads its rows one after another.  Faint stars are those below
    the catalog, to the size, in magnitudes.
    """

    name: str
    size: float = 0.0
    unit: str = ''
    causes: tuple[str, ...] = ()
    images: int = IMAGES
    geometries: Callable[[Pair, float, Generator], Pair] | None = None
    lens: Lens = _as_modelled
    focal_change: Callable[[Scenario, int], float] | None = None
    read_out: Callable[[Pixels, int], Pixels] | None = None
    mean_shift_px: float = 0.0
    has_one_image: bool = False
    has_aberration_reversed: bool = False
    has_wandering_tracker: bool = False
    has_faint_stars: bool = False
    is_turning: bool = False
    tracker_hz: float = 0.0  # of samples with errors of their own; 0: one error of an image
    tracker_arcsec: float = 20.0  # each axis
    tracker_samples: int = 0  # about an image; 0: all
    options: tuple[tuple[str, object], ...] = ()  # that are stated
    body: str = ''  # a planet in the frame, at another place in each image
    scenario: str = ''  # whose pointings and camera the images have
    detector: Detector | None = None
    has_velocity: bool = False  # of the observer, given


def scenario_of(world: World, seed: int) -> Scenario:
    """A campaign of random pointings; the faults of the camera itself are in its truth."""
    base = synthetic.scenario(world.scenario or 'small', seed)
    rng, count = np.random.default_rng([seed, 77]), world.images
    ra_deg, z = rng.uniform(0.0, 360.0, count), rng.uniform(-0.95, 0.95, count)
    fields = np.stack([ra_deg, np.degrees(np.arcsin(z)), rng.uniform(0.0, 360.0, count)], axis=-1)
    if world.has_one_image:
        fields[:] = fields[0]
    if world.has_faint_stars:
        fields = fields[0] * [1.0, 0.6, 1.0] + _SPREAD_DEG * rng.normal(size=(count, 3))
        ra_rad, dec_rad = np.radians(fields[0, :2]).tolist()
        sky = deep_sky(erfa.s2c(ra_rad, dec_rad), _SKY_RAD, world.size, rng)
        base = dataclasses.replace(base, sky=sky, magnitude_limit=world.size, detector=_COARSE)
    truth, prior = base.truth, base.prior
    if world.geometries:
        truth, prior = world.geometries((truth, prior), world.size, rng)
    if not world.scenario:
        pointing = Inertial(tuple((a, b, c) for a, b, c in fields.tolist()))
        base = dataclasses.replace(base, pointing=pointing, cadence_s=60.0)
    return dataclasses.replace(
        base,
        truth=truth,
        prior=prior,
        detector=world.detector or base.detector,
        start_ns=base.start_ns + seed % 1000 * 8_640_000_000_000,
        image_count=count,
        star_tracker_sigma_arcsec=(world.tracker_arcsec,) * 3,
        star_tracker_hz=world.tracker_hz,
        turn_rad=tuple((_EXPOSURE_S * _rate_rad_s(world, seed)).tolist()),
    )


def _rate_rad_s(world: World, seed: int) -> Floats:
    """Angular rate (3,) of the camera, camera frame."""
    angle = np.random.default_rng([seed, 76]).uniform(0.0, 2.0 * np.pi)
    axis = np.array([math.cos(angle), math.sin(angle), 0.0])
    return np.asarray(math.radians(world.size) * world.is_turning * axis)


def frames(world: World, scenario: Scenario) -> Iterator[tuple[Image, list[AttitudeSample]]]:
    """Frames of a campaign in a world, with the star tracker's samples about each."""
    pattern = rendering.fixed_pattern(scenario)
    rng = np.random.default_rng([scenario.seed, 78])
    wander_rad: Floats = np.zeros(3)
    step = math.exp(-1.0 / _WANDER_IMAGES)
    first: Image | None = None
    for index in range(scenario.image_count):
        shown = synthetic.scene(scenario, index)
        at_px = _seen_at(world, scenario, shown, index)
        seen = line_of_sight(scenario.truth.camera, at_px) @ shown.camera_from_icrf
        moved = dataclasses.replace(shown, pixel_px=at_px, direction_icrf=seen)
        if world.has_one_image and first is not None:
            noise = rng.integers(-1, 2, first.pixels.shape)
            pixels = np.clip(first.pixels.astype(np.int64) + noise, 0, scenario.detector.full_dn)
            image = Image(shown.time_ns, pixels.astype(np.uint16))
        else:
            light, is_hidden = _planet(world.body, scenario, index)
            hidden = is_hidden(moved.pixel_px)
            flux = np.where(hidden, 0.0, moved.flux_electrons)
            moved = dataclasses.replace(moved, flux_electrons=flux)
            image = rendering.render(scenario, moved, index, pattern + light)
        first = first or image
        samples = list(synthetic.attitude_samples(scenario, index))
        if world.tracker_samples:
            first_one = (len(samples) - world.tracker_samples) // 2
            samples = samples[first_one : first_one + world.tracker_samples]
        if world.is_turning:
            rate_icrf = shown.camera_from_icrf.T @ _rate_rad_s(world, scenario.seed)
            samples = [_turned(sample, shown.time_ns, rate_icrf) for sample in samples]
        if world.has_wandering_tracker:
            sigma_rad = world.size * ARCSECOND_RAD
            keep, add = (step, math.sqrt(1.0 - step**2)) if index else (0.0, 1.0)
            wander_rad = keep * wander_rad + add * sigma_rad * rng.normal(size=3)
            samples = [_rotated(sample, wander_rad) for sample in samples]
        if world.read_out:
            pixels = world.read_out(image.pixels, int(world.size))
            image = dataclasses.replace(image, pixels=pixels)
        yield image, samples


def _planet(
    kind: str, scenario: Scenario, index: int
) -> tuple[Floats | float, Callable[[Floats], Mask]]:
    """Light (height, width) of a planet of a kind, electrons, and which pixels (n, 2) it hides."""
    if not kind:
        return 0.0, lambda pixels: np.zeros(len(pixels), bool)
    camera, rng = scenario.truth.camera, np.random.default_rng([scenario.seed, 75, index])
    size = np.array([camera.width, camera.height])
    radius_px, at = _PLANET_PX, rng.uniform(0.15, 0.85, 2)
    if kind == 'limb':  # far beyond a corner, which it covers
        radius_px, at = 3.0 * camera.width, np.rint(at)
    centre = at * size
    if kind == 'limb':
        centre += (2.0 * at - 1.0) * (
            radius_px / math.sqrt(2.0) - rng.uniform(0.1, 0.25) * size[0]
        )
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - centre[0]) / radius_px, (v - centre[1]) / radius_px
    r = np.hypot(x, y)
    lit = np.clip(radius_px * (1.0 - r) + 0.5, 0.0, 1.0)
    if kind == 'crescent':
        lit *= np.clip(radius_px * (x - 0.8 * np.sqrt(np.maximum(1.0 - y * y, 0.0))), 0.0, 1.0)
    light = _PLANET_ELECTRONS * lit
    light += _GLARE_ELECTRONS * lit.mean() ** 0.25 / np.maximum(r, 1.0) ** 2
    if kind == 'bloom':  # the charge of saturated pixels fills their columns
        light[:, np.abs(x[0]) < 0.5] += _PLANET_ELECTRONS
    for along, wide, electrons in _GHOSTS if kind == 'ghosts' else ():
        place = 0.5 * size + along * (centre - 0.5 * size)
        apart = np.hypot(u - place[0], v - place[1])
        light += electrons * np.clip(0.2 * (wide * radius_px - apart), 0.0, 1.0)
    psf_px = scenario.detector.psf_sigma_px
    light = cv2.GaussianBlur(light, (0, 0), psf_px)
    if kind == 'moons':
        places = centre + np.outer(rng.uniform(-9.0, 9.0, _MOONS), [radius_px, 0.1 * radius_px])
        flux, psf_px = (
            np.exp(rng.uniform(*_MOON_LOG_ELECTRONS, _MOONS)),
            scenario.detector.psf_sigma_px,
        )
        light += rendering.star_electrons(places, flux, psf_px, (camera.height, camera.width))
    return light, lambda pixels: np.hypot(*(pixels - centre).T) < radius_px


def _rotated(sample: AttitudeSample, error_rad: Floats) -> AttitudeSample:
    reported = Rotation.from_quat(sample.icrf_from_star_tracker_xyzw)
    rotated = reported * Rotation.from_rotvec(error_rad)
    return dataclasses.replace(sample, icrf_from_star_tracker_xyzw=rotated.as_quat())


def _turned(sample: AttitudeSample, image_ns: int, rate_icrf_rad_s: Floats) -> AttitudeSample:
    """Sample of a camera that has turned since the image."""
    after_s = (sample.time_ns - image_ns) / NANOSECONDS_PER_SECOND
    turn = Rotation.from_rotvec(after_s * rate_icrf_rad_s)
    reported = turn * Rotation.from_quat(sample.icrf_from_star_tracker_xyzw)
    return dataclasses.replace(sample, icrf_from_star_tracker_xyzw=reported.as_quat())


def _seen_at(world: World, scenario: Scenario, shown: Scene, index: int) -> Floats:
    """Pixels (n, 2) of the stars of a scene on the detector of a world."""
    camera, seen = _camera_at(world, scenario, index), shown.direction_icrf
    if world.has_aberration_reversed:
        seen = aberrated(seen, -2.0 * earth_velocity_c(shown.time_ns) * SPEED_OF_LIGHT_M_S)
    if world.has_aberration_reversed or world.focal_change:
        return np.asarray(project(camera, seen @ shown.camera_from_icrf.T))
    pixels = shown.pixel_px
    if world.is_turning:
        pixels = _read_out(camera, _rate_rad_s(world, scenario.seed), pixels)
    return np.asarray(pixels + _displacement(world, scenario, pixels))


def _read_out(camera: CameraModel, rate_rad_s: Floats, pixels: Floats) -> Floats:
    """Pixels (n, 2) where the row that shows a star is read before or after the middle one."""
    in_camera, at = line_of_sight(camera, pixels), pixels
    for _ in range(5):  # the shift changes by a thousandth of itself
        after_s = _READOUT_S * (at[:, 1:] / (camera.height - 1) - 0.5)
        at = project(camera, Rotation.from_rotvec(-after_s * rate_rad_s).apply(in_camera))
    return at


def _camera_at(world: World, scenario: Scenario, index: int) -> CameraModel:
    """True camera of an image; the displacement by the lens of the world comes on top."""
    camera = scenario.truth.camera
    if not world.focal_change:
        return camera
    fx, _, fy = camera.intrinsics[:3]
    change_px = world.focal_change(scenario, index) * world.size
    return camera.replace(fx=fx + change_px, fy=fy + change_px * fy / fx)


def _displacement(world: World, scenario: Scenario, pixels: Floats) -> Floats:
    """Displacement that the world adds to the true camera at pixels (n, 2), px."""
    rng = np.random.default_rng([scenario.seed, 80])
    return world.lens(scenario.truth.camera, world.size, rng, pixels)


def true_directions(world: World, scenario: Scenario, pixels: Floats, index: int) -> Floats:
    """True lines of sight (n, 3) in the camera frame of measured pixels (n, 2) of an image."""
    pixels = pixels - [world.mean_shift_px, 0.0]
    at = pixels.copy()
    for _ in range(60):  # the displacement is a contraction: 0.1 px of 10 px at most
        at = pixels - _displacement(world, scenario, at)
    return line_of_sight(_camera_at(world, scenario, index), at)


def _from_middle(camera: CameraModel, pixels: Floats) -> tuple[Floats, float]:
    """Pixels (n, 2) from the middle of the detector, and the distance of its corners."""
    middle = np.array([camera.width - 1, camera.height - 1]) / 2.0
    return pixels - middle, float(np.hypot(*middle))


def _tilted(camera: CameraModel, size_px: float, rng: Generator, pixels: Floats) -> Floats:
    angle_rad, (xy, corner_px) = rng.uniform(0.0, 2.0 * np.pi), _from_middle(camera, pixels)
    way = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    return keystone(size_px, way, xy / corner_px)


def _radial8(camera: CameraModel, size_px: float, rng: Generator, pixels: Floats) -> Floats:
    xy, corner_px = _from_middle(camera, pixels)
    return eighth_order(size_px, xy / corner_px)


def _ripple(camera: CameraModel, size_px: float, rng: Generator, pixels: Floats) -> Floats:
    """Eight waves of 0.35 to 1.2 detector widths; size_px is the rms along each axis."""
    count = 8
    rng.uniform()  # the documented figures are of the waves after this number
    wave_px = rng.uniform(0.35, 1.2, count) * camera.width
    direction = rng.uniform(0.0, 2.0 * np.pi, count)
    vectors = 2.0 * np.pi / wave_px * np.stack([np.cos(direction), np.sin(direction)])
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, count))
    gain = size_px * math.sqrt(2.0 / count) * rng.choice([-1.0, 1.0], (2, count))
    at = pixels @ vectors
    return np.stack([(gain[k] * np.sin(at + phase[k])).sum(axis=1) for k in (0, 1)], -1)


def _fisheye(camera: CameraModel, size: float, rng: Generator, pixels: Floats) -> Floats:
    focal_px = camera.parameters[0]
    xy = _from_middle(camera, pixels)[0] / focal_px
    r = np.linalg.norm(xy, axis=1, keepdims=True)
    return np.asarray(focal_px * xy * (np.arctan(r) / np.maximum(r, 1e-12) - 1.0))


def _wide(pair: Pair, size: float, rng: Generator) -> Pair:
    """Cameras with a third of the focal length and hardly any distortion."""

    def wide(geometry: CameraGeometry) -> CameraGeometry:
        fx, _, fy = geometry.camera.intrinsics[:3] / 3.0
        camera = geometry.camera.replace(fx=fx, fy=fy, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0)
        return dataclasses.replace(geometry, camera=camera)

    return wide(pair[0]), wide(pair[1])


def _coarse(pair: Pair, size: float, rng: Generator) -> Pair:
    """Cameras with a fifth of the pixels along each axis, and twice the field."""

    def coarse(geometry: CameraGeometry) -> CameraGeometry:
        camera, width, height = geometry.camera, 240, 256
        scale = _COARSE_PX / camera.parameters[0]
        numbers = camera.parameters.copy()
        middle = np.array([camera.width - 1, camera.height - 1]) / 2
        numbers[:3] *= scale
        numbers[3:5] = scale * (numbers[3:5] - middle) + [(width - 1) / 2, (height - 1) / 2]
        return dataclasses.replace(geometry, camera=CameraModel(width, height, numbers))

    return coarse(pair[0]), coarse(pair[1])


def _off_axis(pair: Pair, size_px: float, rng: Generator) -> Pair:
    """True principal point off the prior."""
    angle, (truth, prior) = rng.uniform(0.0, 2.0 * np.pi), pair
    cx, cy = truth.camera.intrinsics[3:] + size_px * np.array([np.cos(angle), np.sin(angle)])
    camera = truth.camera.replace(cx=float(cx), cy=float(cy))
    return dataclasses.replace(truth, camera=camera), prior


def _by_lens(lenses: tuple[int, ...], scenario: Scenario, index: int) -> float:
    """Change for lens 0 or 1 of an image, in turns; the size is the shift at a corner."""
    camera = scenario.truth.camera
    corner = float(camera.parameters[0]) / math.hypot(camera.width / 2, camera.height / 2)
    return lenses[index % len(lenses)] * corner


def _breathing(scenario: Scenario, index: int) -> float:
    return float(np.random.default_rng([scenario.seed, 79, index]).uniform(-1.0, 1.0))


def _without_columns(pixels: Pixels, count: int) -> Pixels:
    middle, left = pixels.shape[1] // 2, pixels.copy()
    left[:, middle:-count] = pixels[:, middle + count :]
    return left


def _with_odd_rows_shifted(pixels: Pixels, size: int) -> Pixels:
    shifted = pixels.copy()
    shifted[1::2, 1:] = pixels[1::2, :-1]
    return shifted


_FIELD = ('residual over predicted sigma',)
_LARGE = (*_FIELD, '1-sigma of map')
_CHANGE = ('image to image',)
_WANDER = ('1-sigma of line_of_sight',)
_LENSES = partial(_by_lens, (0, 1))
_LENSES_ABBBA = partial(_by_lens, _ABBBA)
WORLDS = (
    World('sound'),
    *(
        World('principal point', s, 'px', ('cx', 'cy'), geometries=_off_axis)
        for s in (2.0, 20.0, 60.0)
    ),
    *(World('tilted detector', s, 'px', _FIELD, lens=_tilted) for s in (0.3, 1.0, 3.0)),
    *(World('8th-order radial', s, 'px', _FIELD, lens=_radial8) for s in (0.3, 1.0, 3.0)),
    *(World('ripple', s, 'px', _LARGE, lens=_ripple) for s in (0.03, 0.1, 0.3, 1.0)),
    World('fisheye', causes=('lens', *_LARGE), geometries=_wide, lens=_fisheye),
    *(World('columns lost', s, 'px', ('step',), read_out=_without_columns) for s in (1.0, 3.0)),
    # A star lies on both kinds of rows: half of the shift.
    World(
        *('odd rows shifted', 1.0, 'px', ('rows', 'step')),
        read_out=_with_odd_rows_shifted,
        mean_shift_px=0.5,
    ),
    World('two lenses', 1.0, 'px', _CHANGE, focal_change=_LENSES),
    *(
        World('two lenses as ABBBA', s, 'px', _CHANGE, len(_ABBBA), focal_change=_LENSES_ABBBA)
        for s in (0.3, 1.0)
    ),
    World('one image', COPIES, 'times', _FIELD, COPIES, has_one_image=True),
    *(
        World('focal breathing', s, 'px', _CHANGE, focal_change=_breathing)
        for s in (0.5, 2.0, 4.0)
    ),
    World(
        *('aberration reversed', 0.5, 'year', ('velocity', 'aberration')),
        has_aberration_reversed=True,
    ),
    World('tracker wanders', 60.0, 'arcsec', _WANDER, 2 * IMAGES, has_wandering_tracker=True),
    *(
        World('stars below the catalog', s, 'mag', geometries=_coarse, has_faint_stars=True)
        for s in (10.5, 12.0)
    ),
    *(
        World(
            *(f'turning, {name} shutter', s, 'deg/s'),
            is_turning=True,
            tracker_hz=10.0,
            tracker_arcsec=10.0,
            options=options,
        )
        for name, options in (
            ('unknown', (('shutter', 'unknown'),)),
            ('stated', (('shutter', 'rolling'), ('readout_s', _READOUT_S))),
        )
        for s in (0.05, 0.1, 0.3)
    ),
    *(
        World(
            *('turning, two samples an image', s, 'deg/s'),
            is_turning=True,
            tracker_hz=10.0,
            tracker_samples=2,
            options=(('shutter', 'unknown'),),
        )
        for s in (0.05, 0.1, 0.3)
    ),
)
BODIES = tuple(
    World(kind, body=kind, has_velocity=True)
    for kind in ('disc', 'limb', 'crescent', 'bloom', 'ghosts', 'moons')
)
# Campaigns whose error is compared with its Cramer-Rao bound: all is stated.
BAGS = (
    World('small', images=16, scenario='small', has_velocity=True),
    World(
        *('slew', 0.3, 'deg/s'),
        is_turning=True,
        has_velocity=True,
        options=(('shutter', 'rolling'), ('readout_s', _READOUT_S)),
    ),
    World('hostile', detector=_HOSTILE, has_velocity=True),
    World('paper', images=16, scenario='paper', has_velocity=True),
)


def world(name: str, size: float = 0.0) -> World:
    """World of a name and size."""
    worlds = (*WORLDS, *BODIES, *BAGS)
    return next(one for one in worlds if (one.name, one.size) == (name, size))
