# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Simulated star observations of worlds that differ from the calibration model, with their truth.

The directions of the stars are those that an observer computes without the departures of the
world; the measured pixels and the reported attitudes contain them.  The noise of each centroid has
the stated covariance.  `studies.rendered_worlds` has worlds with images.

A lens departure draws phases and places from a random generator and returns the displacement in
pixels (n, 2) of points ``x`` (n, 2) in half widths from the centre.  A generator in the same state
gives the same lens.
"""

from __future__ import annotations

from collections.abc import Callable
import dataclasses
from dataclasses import dataclass, field
from functools import partial
import math
from typing import Any

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from starcal_ground.simulation import scenario as synthetic
from starcal_ground.simulation.centroids import observations, with_rate
from starcal_ground.simulation.scenario import Detector, Scenario, Scene
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import GRID
from starcal_ros.camera import CameraModel, field_radius_rad, line_of_sight, pixel_grid, project
from starcal_ros.camera.lens import fold_radius2, LENSES
from starcal_ros.constants import ARCSECOND_RAD, SPEED_OF_LIGHT_M_S
from starcal_ros.records import AttitudeSample, CameraGeometry, Ensemble, StarObservations
from starcal_ros.sky.astrometry import apparent_directions, GIVEN_SIGMA_M_S
from starcal_ros.sky.attitude import AttitudeHistory
from starcal_ros.sky.catalog import cone, load_catalog

Lens = Callable[[Generator, Floats], Floats]
"""Displacement (n, 2) px of stars at points (n, 2) in half widths of the detector."""

_MEMORY = math.exp(-0.1)  # correlation of neighbouring images: ten images
_START_NS = 1786160160 * 10**9
_CADENCE_S = 60.0
SATURATED_MAGNITUDE = 2.0
PSF_SIGMA_PX = 0.95
ELECTRONS_PER_DN = 0.0668
NOISE_ELECTRONS = 35.3  # of the window of a star
_EARTH_RATE_RAD_S = 7.292115e-5
_DITHER_DEG = 0.15
_MARGIN_PX = 30.0  # outliers come from there
_PIXEL_STEPS = 4  # displacements change by 0.01 px per px at most
_SMOOTH_RAD = math.radians(60.0)  # correlation length of errors that depend on the attitude
# Random streams (seed, purpose)
_POINTING, _NOISE, _TRACKER, _CHANGE, _STARS, _LENS, _VELOCITY, _RATE, _OUTLIERS = range(80, 89)
_SAMPLES = 89
_GAP_S = 2.0  # the default of the package
_BLENDS, _OPTICS = 90, 91
_BLEND_FREEDOM = 3.0  # degrees of freedom: medians of displacements are half of their rms
_HALF_HEIGHT = 1024 / 1296  # half widths
_CORNER = math.hypot(1.0, _HALF_HEIGHT)


def no_departure(rng: Generator, x: Floats) -> Floats:
    """Lens that the model describes."""
    return np.zeros_like(x)


def unit(vector: Floats) -> Floats:
    """Return vectors (..., d) scaled to unit length."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


def ripple(size_px: float, rad_per_half_width: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a product of waves along both axes, each component with its own phases."""
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 2))
    return np.asarray(size_px * np.sin(rad_per_half_width * x[:, None, :] + phase).prod(axis=2))


def kink(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a radial displacement that begins at a radius and is size_px at the corners."""
    radius, start = np.linalg.norm(x, axis=1, keepdims=True), 0.9
    beyond = np.maximum(radius - start, 0.0) / (_CORNER - start)
    return np.asarray(size_px * beyond * x / np.maximum(radius, start))


def corner_bump(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a Gaussian displacement about a point near one of the corners."""
    centre, width = rng.choice([-1.0, 1.0], 2) * [0.85, 0.65], 0.1
    distance2 = ((x - centre) ** 2).sum(axis=1, keepdims=True)
    return np.asarray(size_px * np.exp(-distance2 / (2 * width**2)) * unit(rng.normal(size=2)))


def tilt(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Detector that is tilted: keystone of size_px at the corner that it leans to."""
    return keystone(size_px, unit(rng.normal(size=2)), x / _CORNER)


def radial8(size_px: float, rng: Generator, x: Floats) -> Floats:
    """Lens with a further radial term, ``r^8``, of size_px at the corners."""
    return eighth_order(size_px, x / _CORNER)


def keystone(size_px: float, way: Floats, from_centre: Floats) -> Floats:
    """Displacement by a tilt of points (n, 2), in units of the distance to a corner."""
    return np.asarray(size_px * (from_centre @ way)[:, None] * from_centre)


def eighth_order(size_px: float, from_centre: Floats) -> Floats:
    """Displacement along the radius of points (n, 2), in the same units."""
    return np.asarray(size_px * from_centre * (from_centre**2).sum(axis=1, keepdims=True) ** 4)


@dataclass(frozen=True)
class World:
    """
    Sizes of the departures of a world, and the images taken in it.

    Pointings: ``sky`` at random; ``ram`` within 20 degrees of the velocity; ``side`` within 20
    degrees of a direction across it, ``side_level`` with nearly the same roll; ``strip`` one
    degree apart; ``fields4`` four fields in turns; ``small`` fixed to the Earth as in the scenario
    of that name.
    """

    images: int = 18
    pointing: str = 'sky'
    model: str = 'plumb_bob'  # of the lens, and of its prior
    field_deg: float = 0.0  # along the rows; 0: the camera of the scenario
    corner: float = 0.0  # radial distortion of that lens in a corner, relative
    shutter: str = 'unknown'  # as stated
    magnitude_limit: float = 8.39  # sigma of a centroid 0.3 px
    bright_px: float = 0.0  # sigma of the centroids of the brightest stars
    claim: float = 1.0  # stated sigma of the centroids over the true one
    zero_point_dn: float = 3.98e6
    tracker_arcsec: float = 20.0
    tracker_claim: float = 1.0  # stated sigma of the star tracker over the true one
    tracker_hz: float = 0.0  # of samples with errors of their own; 0: one error, an exact rate
    tracker_samples: int = 0  # about each image; 0: all of three seconds
    filter_s: float = 0.0  # correlation time of the errors of samples
    velocity_m_s: float = 0.0  # that the observer does not take into account
    rate_deg_s: float = 0.0  # about an axis across the line of sight
    row_s: float = 0.0  # time between the read-outs of two rows
    stamp_s: float = 0.0  # stamp less time of the exposure
    breathing: float = 0.0  # relative change of the focal length, rms
    flexing: float = 0.0  # p1 of the second half of the images less that of the first
    wander_arcsec: float = 0.0  # star tracker error correlated in time, each axis
    smooth_arcsec: float = 0.0  # star tracker error that depends on the attitude, each axis
    star_arcsec: float = 0.0  # error of the place of each star, each axis
    blend: float = 0.0  # error of each star by fainter ones, over the sigma of its centroid
    bad_stars: int = 0  # catalog stars ten pixels off
    outlier_fraction: float = 0.0
    principal_point_px: tuple[float, float] = (0.0, 0.0)  # truth less prior
    lens: Lens = no_departure

    @property
    def sags(self) -> tuple[float, ...]:
        """Changes of p1, of the first half of the images and of the second."""
        return (-0.5 * self.flexing, 0.5 * self.flexing) if self.flexing else (0.0,)


@dataclass(frozen=True)
class Campaign:
    """
    Observations of one campaign, and the truth behind them.

    Attributes
    ----------
    scenario : Scenario
        Prior, and truth without the departure of the lens.
    camera_from_icrf : (m,)
        True attitudes at the exposures.
    rate_rad_s : (m, 3)
        Angular rate of the camera at each image, camera frame.
    velocity_m_s : (3,)
        Velocity that the directions of the observations lack, ICRF axes.
    scale : float
        Focal length that the images had on average, over that of the scenario.
    """

    world: World
    scenario: Scenario
    camera_from_icrf: Rotation
    rate_rad_s: Floats
    velocity_m_s: Floats
    scale: float = 1.0
    ensemble: Ensemble = field(default_factory=Ensemble)

    @property
    def true_directions(self) -> list[Floats]:
        """
        Lines of sight (GRID * GRID, 3) of the pixels of a grid in the camera frame.

        Of the camera, or before and after its lens sags.
        """
        camera = scaled(self.scenario.truth.camera, self.scale)
        grid = pixel_grid(camera, GRID, GRID)
        ideal = grid - self.displacement_px(grid)
        return [line_of_sight(sagged(camera, p1), ideal) for p1 in self.world.sags]

    def displacement_px(self, pixels: Floats) -> Floats:
        """Displacement of stars at pixels (n, 2) by the departure of the lens."""
        camera = self.scenario.truth.camera
        middle = np.array([camera.width - 1, camera.height - 1]) / 2.0
        half_widths = np.asarray((pixels - middle) / (camera.width / 2.0))
        return self.world.lens(_stream(self.scenario.seed, _LENS), half_widths)


def simulate(world: World, seed: int, images: int | None = None) -> Campaign:
    """Campaign of a world; the seed determines camera, pointings, departures and noise."""
    world = dataclasses.replace(world, images=images or world.images)
    scenario = _scenario(world, seed)
    velocity_m_s = world.velocity_m_s * unit(_stream(seed, _VELOCITY).normal(size=3))
    camera_from_icrf = _attitudes(world, scenario, velocity_m_s)
    rate_rad_s = _rates(world, seed, camera_from_icrf)
    at_stamp = Rotation.from_rotvec(-world.stamp_s * rate_rad_s) * camera_from_icrf
    errors = Rotation.from_rotvec(_tracker_errors_rad(world, seed, camera_from_icrf))
    camera_from_tracker = scenario.truth.star_tracker_from_camera.inv()
    reported_xyzw = (at_stamp.inv() * camera_from_tracker * errors).as_quat()
    change = _stream(seed, _CHANGE).normal(size=world.images)
    offset_rad = _star_offsets_rad(world, scenario, camera_from_icrf)
    scale = 1.0 + world.breathing * float(change.mean())
    made = Campaign(world, scenario, camera_from_icrf, rate_rad_s, velocity_m_s, scale)
    ensemble = Ensemble(
        tuple(
            _image(made, k, reported_xyzw[k], _camera_of(made, k, change[k]), offset_rad)
            for k in range(world.images)
        )
    )
    if world.tracker_hz:
        ensemble = Ensemble(tuple(_sampled(made, *item) for item in enumerate(ensemble.images)))
    return dataclasses.replace(made, ensemble=ensemble)


def _sampled(made: Campaign, k: int, image: StarObservations) -> StarObservations:
    """Observations with attitude and rate by samples of the star tracker, each with its error."""
    world, rng = made.world, _stream(made.scenario.seed, _SAMPLES, k)
    half = world.tracker_samples // 2 or math.ceil(1.5 * world.tracker_hz)
    late_s = (np.arange(-half, half) + rng.uniform()) / world.tracker_hz
    memory = math.exp(-1.0 / (world.tracker_hz * world.filter_s)) if world.filter_s else 0.0
    errors_rad = world.tracker_arcsec * ARCSECOND_RAD * _walk(rng, 2 * half, 3, memory)
    from_icrf = Rotation.from_rotvec(-np.outer(late_s, made.rate_rad_s[k]))
    from_icrf *= made.camera_from_icrf[k]
    camera_from_tracker = made.scenario.truth.star_tracker_from_camera.inv()
    reported = from_icrf.inv() * camera_from_tracker * Rotation.from_rotvec(errors_rad)
    history = AttitudeHistory()
    # What is stamped as this image is of the time of the exposure.
    stamps_ns = image.time_ns + np.rint((late_s - world.stamp_s) * 1e9).astype(np.int64)
    for stamp_ns, xyzw in zip(stamps_ns.tolist(), reported.as_quat(), strict=True):
        history.add(stamp_ns, AttitudeSample(stamp_ns, xyzw))
    xyzw, gap_s = history.at(image.time_ns, _GAP_S)
    sigma_rad = np.array(made.scenario.star_tracker_sigma_arcsec) * ARCSECOND_RAD  # as stated
    rate = history.rate_at(image.time_ns, _GAP_S, sigma_rad)
    image = dataclasses.replace(image, icrf_from_star_tracker_xyzw=xyzw, attitude_gap_s=gap_s)
    return with_rate(image, *rate)


def _scenario(world: World, seed: int) -> Scenario:
    base = synthetic.scenario('small', seed)
    camera = base.truth.camera
    cx, cy = camera.intrinsics[3:] + world.principal_point_px
    own: dict[str, Any] = {}
    truth = dataclasses.replace(base.truth, camera=camera.replace(cx=float(cx), cy=float(cy)))
    if world.field_deg:
        truth, own['prior'] = _optics(world, base)
    if world.pointing != 'small':
        own |= {'start_ns': _START_NS, 'cadence_s': _CADENCE_S}
    return dataclasses.replace(
        base,
        truth=truth,
        detector=Detector(
            psf_sigma_px=PSF_SIGMA_PX,
            electrons_per_dn=ELECTRONS_PER_DN,
            zero_point_electrons=ELECTRONS_PER_DN * world.zero_point_dn,
        ),
        star_tracker_sigma_arcsec=(world.tracker_claim * world.tracker_arcsec,) * 3,
        image_count=world.images,
        magnitude_limit=world.magnitude_limit,
        **own,
    )


def _optics(world: World, base: Scenario) -> tuple[CameraGeometry, CameraGeometry]:
    """Truth of a camera of any field, and its design as the prior: off by what launch may do."""
    camera, rng = base.truth.camera, _stream(base.seed, _OPTICS)
    half_rad, is_fisheye = math.radians(world.field_deg) / 2.0, world.model == 'equidistant'
    focal_px = camera.width / 2.0 / (half_rad if is_fisheye else math.tan(half_rad))
    corner = math.hypot(camera.width, camera.height) / 2.0 / focal_px
    middle = np.array([camera.width - 1, camera.height - 1]) / 2.0
    while True:
        c = np.zeros(len(LENSES[world.model].coefficients))
        share = rng.dirichlet([4.0, 2.0, 1.0]) * np.append(1.0, rng.choice([-1.0, 1.0], 2))
        c[:3] = world.corner * share / corner ** np.array([2, 4, 6])
        if not is_fisheye:
            c[3:5] = 0.05 * world.corner / corner * rng.normal(size=2)
            c[5:6] = 0.3 * world.corner / corner**2 * rng.normal()
        design = c * (1.0 + 0.2 * rng.normal(size=len(c)))
        if min(fold_radius2(world.model, one) for one in (c, design)) > (1.3 * corner) ** 2:
            break
    off_px = 0.03 * camera.width * rng.uniform() * unit(rng.normal(size=2))
    skew_px, stretch = 1e-4 * focal_px * rng.normal(), 1.0 + 3e-4 * rng.normal()
    intrinsics = [focal_px, skew_px, stretch * focal_px, *(middle + off_px)]
    prior_px = focal_px * (1.0 + rng.uniform(-0.02, 0.02))
    true, prior = (
        CameraModel(camera.width, camera.height, np.array([*values, *coefficients]), world.model)
        for values, coefficients in (
            (intrinsics, c),
            ([prior_px, 0.0, prior_px, *middle], design),
        )
    )
    turn = Rotation.from_rotvec(math.radians(rng.uniform()) * unit(rng.normal(size=3)))
    mounting = (base.truth.star_tracker_from_camera * turn).as_quat()
    return dataclasses.replace(base.truth, camera=true), CameraGeometry(prior, mounting)


def _stream(seed: int, *purpose: int) -> Generator:
    return np.random.default_rng([seed, *purpose])


def _attitudes(world: World, base: Scenario, velocity_m_s: Floats) -> Rotation:
    """True attitudes camera_from_icrf (m,) at the exposures."""
    m, rng = world.images, _stream(base.seed, _POINTING)
    if world.pointing == 'small':
        found = [synthetic.camera_from_icrf(base, k) for k in range(m)]
        return Rotation.from_matrix(np.array(found))
    if world.pointing == 'strip':
        steps = Rotation.from_euler('y', np.arange(m)[:, None], degrees=True)
        return steps * Rotation.random(random_state=rng)
    if world.pointing == 'fields4':
        fields = Rotation.random(4, random_state=rng)[np.arange(m) % 4]
        return Rotation.from_rotvec(np.radians(_DITHER_DEG) * rng.normal(size=(m, 3))) * fields
    if world.pointing == 'sky':
        return Rotation.random(m, random_state=rng)
    axis = unit(velocity_m_s)
    if world.pointing.startswith('side'):
        axis = unit(np.asarray(np.cross(axis, rng.normal(size=3))))
    return _within_cap(axis, m, rng, world.pointing.endswith('level'))


def _within_cap(axis: Floats, count: int, rng: Generator, level: bool) -> Rotation:
    """Attitudes with boresights uniform over a cap of 20 degrees, at any roll or nearly one."""
    cosine = rng.uniform(math.cos(math.radians(20.0)), 1.0, count)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    sine = np.sqrt(1.0 - cosine**2)
    local = np.stack([sine * np.cos(angle), sine * np.sin(angle), cosine], axis=-1)
    # The smallest rotation; SciPy 1.11 warns of a single pair of vectors in `align_vectors`.
    about = np.cross(axis, [0.0, 0.0, 1.0])
    sine_of_axis = np.linalg.norm(about)
    angle_of_axis = np.arctan2(sine_of_axis, axis[2])
    cap_from_axis = Rotation.from_rotvec(about * (angle_of_axis / max(sine_of_axis, 1e-300)))
    boresight = cap_from_axis.inv().apply(local)
    up = Rotation.random(count, random_state=rng).as_matrix()[:, 0]
    if level:
        up = np.broadcast_to(cap_from_axis.as_matrix()[0], up.shape)
    across = unit(np.asarray(np.cross(up, boresight)))
    return Rotation.from_matrix(np.stack([across, np.cross(boresight, across), boresight], 1))


def _rates(world: World, seed: int, camera_from_icrf: Rotation) -> Floats:
    """Angular rates (m, 3) in the camera frame, rad/s."""
    if world.pointing == 'small':
        return np.asarray(camera_from_icrf.apply([0.0, 0.0, _EARTH_RATE_RAD_S]))
    angle = _stream(seed, _RATE).uniform(0.0, 2.0 * np.pi)
    axis = np.array([math.cos(angle), math.sin(angle), 0.0])
    return np.tile(math.radians(world.rate_deg_s) * axis, (world.images, 1))


def _walk(rng: Generator, count: int, width: int, memory: float) -> Floats:
    """Stationary random walk (count, width) of unit variance."""
    steps = rng.normal(size=(count, width))
    for k in range(1, count):
        steps[k] = memory * steps[k - 1] + math.sqrt(1.0 - memory**2) * steps[k]
    return steps


def _tracker_errors_rad(world: World, seed: int, camera_from_icrf: Rotation) -> Floats:
    """Errors (m, 3) of the reported attitudes about the star tracker's axes."""
    m, rng = world.images, _stream(seed, _TRACKER)
    noise = world.tracker_arcsec * rng.normal(size=(m, 3))
    wander = world.wander_arcsec * _walk(rng, m, 3, _MEMORY)
    boresight = camera_from_icrf.as_matrix()[:, 2]
    # By chords, which keep the kernel positive definite on the sphere.
    kernel = np.exp((boresight @ boresight.T - 1.0) / _SMOOTH_RAD**2) + 1e-9 * np.eye(m)
    smooth = world.smooth_arcsec * np.linalg.cholesky(kernel) @ rng.normal(size=(m, 3))
    return np.asarray((noise + wander + smooth) * ARCSECOND_RAD)


def _star_offsets_rad(world: World, scenario: Scenario, camera_from_icrf: Rotation) -> Floats:
    """Errors (n, 3) of the places of all catalog stars; the part along the direction is moot."""
    catalog, rng = load_catalog(None, world.magnitude_limit), _stream(scenario.seed, _STARS)
    size_rad = np.full(len(catalog), world.star_arcsec * ARCSECOND_RAD)
    offsets = size_rad[:, None] * rng.normal(size=(len(catalog), 3))
    if world.blend:
        # Most stars have hardly a neighbour within their PSF, and some a bright one: Student's t.
        blended = _stream(scenario.seed, _BLENDS)
        tail = np.sqrt(_BLEND_FREEDOM / blended.chisquare(_BLEND_FREEDOM, len(catalog)))
        sigma_px = _sigma_px(world, _electrons(scenario, catalog.magnitude))
        tail *= world.blend * sigma_px / scenario.truth.camera.parameters[0]
        offsets += tail[:, None] * blended.normal(size=(len(catalog), 3))
    if world.bad_stars:
        near = [cone(catalog, axis, 0.1) for axis in camera_from_icrf.as_matrix()[:, 2]]
        bad = rng.choice(np.unique(np.concatenate(near)), world.bad_stars, replace=False)
        ten_px_rad = 10.0 / scenario.truth.camera.parameters[0]
        way = np.cross(catalog.direction_icrs[bad], rng.normal(size=(len(bad), 3)))
        offsets[bad] += ten_px_rad * unit(way)
    return np.asarray(offsets)


def _camera_of(made: Campaign, k: int, change: float) -> CameraModel:
    """Camera of an image: its focal length breathes, its lens sags."""
    world, camera = made.world, made.scenario.truth.camera
    sag = world.sags[0 if 2 * k < world.images else -1]
    return sagged(scaled(camera, 1.0 + world.breathing * change), sag)


def scaled(camera: CameraModel, scale: float) -> CameraModel:
    """Return a camera of another focal length."""
    fx, _, fy = scale * camera.intrinsics[:3]
    return camera.replace(fx=float(fx), fy=float(fy))


def sagged(camera: CameraModel, sag: float) -> CameraModel:
    """Return a camera whose p1 is larger by ``sag``."""
    if not sag:
        return camera
    p1 = camera.parameters[camera.parameter_names.index('p1')]
    return camera.replace(p1=float(p1) + sag)


def _image(
    made: Campaign, k: int, reported_xyzw: Floats, own: CameraModel, offset_rad: Floats
) -> StarObservations:
    """Observations of an image; the catalog stars are off by ``offset_rad`` (n, 3)."""
    world, scenario, seed = made.world, made.scenario, made.scenario.seed
    camera, time_ns = scenario.truth.camera, scenario.time_ns(k)
    catalog, R = load_catalog(None, world.magnitude_limit), made.camera_from_icrf[k].as_matrix()
    near = cone(catalog, R[2], field_radius_rad(camera, _MARGIN_PX))
    near = near[catalog.magnitude[near] > SATURATED_MAGNITUDE]
    stars = catalog.select(near)
    directions = apparent_directions(stars, time_ns)
    seen = aberrated(directions, made.velocity_m_s) + offset_rad[near]
    pixels = _pixels(made, made.rate_rad_s[k], own, seen @ R.T)
    pixels += _outliers_px(world, len(pixels), _stream(seed, _OUTLIERS, k))
    electrons = _electrons(scenario, stars.magnitude)
    sigma_px = _sigma_px(world, electrons)
    noise_px = sigma_px[:, None] * _stream(seed, _NOISE, k).normal(size=pixels.shape)
    inside = np.all((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1]), axis=1)
    scene = Scene(
        *(time_ns, R, reported_xyzw, stars.id, stars.magnitude, directions, pixels),
        *(electrons, stars.digest),
    )
    covariance_px2 = (world.claim * sigma_px[:, None, None]) ** 2 * np.eye(2)
    snr = PSF_SIGMA_PX / sigma_px
    found = observations(scenario, scene, pixels + noise_px, covariance_px2, snr)
    return dataclasses.replace(
        found.select(np.asarray(inside)),
        star_tracker_rate_rad_s=scenario.truth.star_tracker_from_camera.apply(made.rate_rad_s[k]),
        velocity_sigma_m_s=math.nan if world.velocity_m_s else GIVEN_SIGMA_M_S,
    )


def _electrons(scenario: Scenario, magnitude: Floats) -> Floats:
    return np.asarray(scenario.detector.zero_point_electrons * 10 ** (-0.4 * magnitude))


def _sigma_px(world: World, electrons: Floats) -> Floats:
    """1-sigma (n,) of centroids of stars by their light."""
    by_light = PSF_SIGMA_PX * np.sqrt(electrons + NOISE_ELECTRONS**2) / electrons
    return np.hypot(world.bright_px, by_light)


def aberrated(directions: Floats, velocity_m_s: Floats) -> Floats:
    """Directions (n, 3) for an observer who moves as well; first order in v/c."""
    beta = velocity_m_s / SPEED_OF_LIGHT_M_S
    return np.asarray(directions + beta - directions * (directions @ beta)[:, None])


def _pixels(made: Campaign, rate_rad_s: Floats, camera: CameraModel, in_camera: Floats) -> Floats:
    """True pixels (n, 2): a row that is read later sees the camera turned; lens displacements."""
    pixels = project(camera, in_camera)
    moved_per_s = np.cross(in_camera, rate_rad_s)
    for _ in range(_PIXEL_STEPS):
        after_s = made.world.row_s * (pixels[:, 1] - (camera.height - 1) / 2.0)
        turned = project(camera, in_camera + moved_per_s * after_s[:, None])
        pixels = turned + made.displacement_px(pixels)
    return pixels


def _outliers_px(world: World, count: int, rng: Generator) -> Floats:
    """Displacements (n, 2) of 1 to 20 px of a fraction of the stars."""
    length_px = rng.uniform(1.0, 20.0, count) * (rng.random(count) < world.outlier_fraction)
    return np.asarray(length_px[:, None] * unit(rng.normal(size=(count, 2))))


_BRIGHT24 = World(24, magnitude_limit=6.0, zero_point_dn=1.2e7)  # sigma 0.001 to 0.02 px
# A lens departure is in px, its wave in rad per half width, the error of a star in arcsec.
WORLDS = {
    'plain': World(),
    'n3': World(images=3),
    'bright24': _BRIGHT24,
    'small24': World(24, 'small'),
    'vel_leo_ram': World(pointing='ram', velocity_m_s=7600.0),
    'rolling_slow': World(rate_deg_s=0.055, row_s=20e-6),
    'rolling_fast': World(rate_deg_s=0.42, row_s=20e-6),
    'stamp_50ms': World(rate_deg_s=0.1, stamp_s=0.05),
    'breath6': World(images=6, breathing=3e-4),
    'n6_walk': World(images=6, wander_arcsec=60.0),
    'st_lfe_strip': World(60, 'strip', tracker_arcsec=5.0, smooth_arcsec=15.0),
    'catalog03_bright24': dataclasses.replace(_BRIGHT24, star_arcsec=0.3),
    'fields4_cat': World(60, 'fields4', star_arcsec=3.0),
    'wave11_050': World(lens=partial(ripple, 0.05, 11.0)),
    'rip7_010': World(lens=partial(ripple, 0.01, 7.0)),
    'rip7_050': World(lens=partial(ripple, 0.05, 7.0)),
    'kink': World(lens=partial(kink, 0.4)),
    'corner_bump': World(lens=partial(corner_bump, 0.2)),
    'radial8_10': World(lens=partial(radial8, 1.0)),
    'radial8_30': World(lens=partial(radial8, 3.0)),
    'out5': World(outlier_fraction=0.05),
    'badstars': World(24, 'fields4', bad_stars=10),
}


def campaign(name: str, seed: int, images: int | None = None) -> Campaign:
    """Campaign of a world of `WORLDS`, with as many images as the world has by default."""
    return simulate(WORLDS[name], seed, images)
