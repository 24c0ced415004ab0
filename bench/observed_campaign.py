# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Simulated star observations of a world that departs from the calibration model, with their truth.

The directions of the stars are those that an observer computes without the departures of the
world; the measured pixels and the reported attitudes contain them.  The noise of each centroid has
the stated covariance.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from bench.lens_departures import Lens, no_departure, unit
from bench.trials import GRID
from starcal_ros.arrays import Floats
from starcal_ros.camera import field_radius_rad, line_of_sight, pixel_grid, project
from starcal_ros.constants import ARCSECOND_RAD, SPEED_OF_LIGHT_M_S
from starcal_ros.records import CameraGeometry, Ensemble, StarObservations
from starcal_ros.sky.astrometry import apparent_directions, GIVEN_SIGMA_M_S
from starcal_ros.sky.catalog import cone, load_catalog, StarCatalog
from starcal_ros.studies.simulation import scenario as synthetic
from starcal_ros.studies.simulation.scenario import Scenario

MEMORY = math.exp(-0.1)  # correlation of neighbouring images: ten images
_START_NS = 1786160160 * 10**9
_CADENCE_NS = 60 * 10**9
_SATURATED_MAGNITUDE = 2.0
_PSF_SIGMA_PX = 0.95
_ELECTRONS_PER_DN = 0.0668
_NOISE_ELECTRONS = 35.3  # of the window of a star
_EARTH_RATE_RAD_S = 7.292115e-5
_FIXED_TO_EARTH = ('small', 'paper')  # pointings named after their scenario
_DITHER_DEG = 0.15
_MARGIN_PX = 30.0  # outliers come from there
_PIXEL_STEPS = 4  # displacements change by 0.01 px per px at most
_SMOOTH_RAD = math.radians(60.0)  # correlation length of errors that depend on the attitude
# Random streams (seed, purpose)
_POINTING, _NOISE, _TRACKER, _CHANGE, _STARS, _LENS, _VELOCITY, _RATE, _OUTLIERS = range(80, 89)


@dataclass(frozen=True)
class World:
    """
    Sizes of the departures of a world, and the images taken in it.

    Pointings: ``sky`` at random; ``ram``, ``hemisphere`` within 20 and 90 degrees of the velocity;
    ``side`` within 20 degrees of a direction across it, ``side_level`` with nearly the same roll;
    ``strip`` one degree apart; ``fields4`` four fields in turns; ``small``, ``paper`` fixed to the
    Earth as in the scenarios of that name.
    """

    images: int = 18
    pointing: str = 'sky'
    magnitude_limit: float = 8.39  # sigma of a centroid 0.3 px
    zero_point_dn: float = 3.98e6
    tracker_arcsec: float = 20.0
    velocity_m_s: float = 0.0  # that the observer does not take into account
    rate_deg_s: float = 0.0  # about an axis across the line of sight
    row_s: float = 0.0  # time between the read-outs of two rows
    stamp_s: float = 0.0  # stamp less time of the exposure
    breathing: float = 0.0  # relative change of the focal length, rms
    memory: float = 0.0  # correlation of that change from image to image
    wander_arcsec: float = 0.0  # star tracker error correlated in time, each axis
    smooth_arcsec: float = 0.0  # star tracker error that depends on the attitude, each axis
    star_arcsec: float = 0.0  # error of the place of each star, each axis
    bad_stars: int = 0  # catalog stars ten pixels off
    outlier_fraction: float = 0.0
    principal_point_px: tuple[float, float] = (0.0, 0.0)  # truth less prior
    lens: Lens = no_departure


@dataclass(frozen=True)
class Campaign:
    """
    Observations of one campaign, and the truth behind them.

    Attributes
    ----------
    true_directions : (GRID * GRID, 3)
        Lines of sight of the pixels of a grid in the camera frame.
    rate_rad_s : (m, 3)
        Angular rate of the camera at each image, camera frame.
    velocity_m_s : (3,)
        Velocity that the directions of the observations lack, ICRF axes.
    """

    ensemble: Ensemble
    prior: CameraGeometry
    truth: CameraGeometry
    star_tracker_sigma_arcsec: float
    true_directions: Floats
    rate_rad_s: Floats
    velocity_m_s: Floats


def simulate(world: World, seed: int, images: int | None = None) -> Campaign:
    """Campaign of a world; the seed determines camera, pointings, departures and noise."""
    drawn = _draw(dataclasses.replace(world, images=images or world.images), seed)
    camera = drawn.truth.camera
    grid = pixel_grid(camera, GRID, GRID)
    directions = line_of_sight(camera, grid - drawn.displacement_px(grid))
    ensemble = Ensemble(tuple(_image(drawn, k) for k in range(drawn.world.images)))
    motion = (drawn.rate_rad_s, drawn.velocity_m_s)
    geometries = (drawn.base.prior, drawn.truth)
    return Campaign(ensemble, *geometries, world.tracker_arcsec, directions, *motion)


@dataclass(frozen=True)
class _Drawn:
    """Unknowns of a campaign of m images, as its seed determines them."""

    world: World
    base: Scenario
    truth: CameraGeometry
    velocity_m_s: Floats
    camera_from_icrf: Rotation  # (m,) at the exposures
    rate_rad_s: Floats  # (m, 3)
    reported_xyzw: Floats  # (m, 4) icrf_from_star_tracker at the stamps
    focal_scale: Floats  # (m,)
    star_offset_rad: Floats  # (n, 3) of the stars of the catalog

    def displacement_px(self, pixels: Floats) -> Floats:
        """Displacement of stars at pixels (n, 2) by the departure of the lens."""
        camera = self.truth.camera
        middle = np.array([camera.width - 1, camera.height - 1]) / 2.0
        half_widths = np.asarray((pixels - middle) / (camera.width / 2.0))
        return self.world.lens(_stream(self.base.seed, _LENS), half_widths)


def _draw(world: World, seed: int) -> _Drawn:
    base = synthetic.scenario('paper' if world.pointing == 'paper' else 'small', seed)
    camera = base.truth.camera
    cx, cy = camera.intrinsics[3:] + world.principal_point_px
    truth = dataclasses.replace(base.truth, camera=camera.replace(cx=float(cx), cy=float(cy)))
    velocity_m_s = world.velocity_m_s * unit(_stream(seed, _VELOCITY).normal(size=3))
    camera_from_icrf = _attitudes(world, base, velocity_m_s)
    rate_rad_s = _rates(world, seed, camera_from_icrf)
    at_stamp = Rotation.from_rotvec(-world.stamp_s * rate_rad_s) * camera_from_icrf
    errors = Rotation.from_rotvec(_tracker_errors_rad(world, seed, camera_from_icrf))
    camera_from_tracker = Rotation.from_quat(truth.star_tracker_from_camera_xyzw).inv()
    change = _walk(_stream(seed, _CHANGE), world.images, 1, world.memory)[:, 0]
    reported_xyzw = (at_stamp.inv() * camera_from_tracker * errors).as_quat()
    offset_rad = _star_offsets_rad(world, base, camera_from_icrf)
    motion = (velocity_m_s, camera_from_icrf, rate_rad_s)
    focal_scale = 1.0 + world.breathing * change
    return _Drawn(world, base, truth, *motion, reported_xyzw, focal_scale, offset_rad)


def _stream(seed: int, *purpose: int) -> Generator:
    return np.random.default_rng([seed, *purpose])


def _attitudes(world: World, base: Scenario, velocity_m_s: Floats) -> Rotation:
    """True attitudes camera_from_icrf (m,) at the exposures."""
    m, rng = world.images, _stream(base.seed, _POINTING)
    if world.pointing in _FIXED_TO_EARTH:
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
    edge_deg = 90.0 if world.pointing == 'hemisphere' else 20.0
    level = world.pointing.endswith('level')
    return _within_cap(axis, math.cos(math.radians(edge_deg)), m, rng, level)


def _within_cap(
    axis: Floats, cos_edge: float, count: int, rng: Generator, level: bool
) -> Rotation:
    """Attitudes whose boresights are uniform over a cap, at any roll or nearly the same one."""
    cosine = rng.uniform(cos_edge, 1.0, count)
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
    if world.pointing in _FIXED_TO_EARTH:
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
    wander = world.wander_arcsec * _walk(rng, m, 3, MEMORY)
    boresight = camera_from_icrf.as_matrix()[:, 2]
    # By chords, which keep the kernel positive definite on the sphere.
    kernel = np.exp((boresight @ boresight.T - 1.0) / _SMOOTH_RAD**2) + 1e-9 * np.eye(m)
    smooth = world.smooth_arcsec * np.linalg.cholesky(kernel) @ rng.normal(size=(m, 3))
    return np.asarray((noise + wander + smooth) * ARCSECOND_RAD)


@functools.lru_cache(maxsize=4)
def _catalog(magnitude_limit: float) -> StarCatalog:
    return load_catalog(None, magnitude_limit)


def _star_offsets_rad(world: World, base: Scenario, camera_from_icrf: Rotation) -> Floats:
    """Errors (n, 3) of the places of all catalog stars; the part along the direction is moot."""
    catalog, rng = _catalog(world.magnitude_limit), _stream(base.seed, _STARS)
    offsets = world.star_arcsec * ARCSECOND_RAD * rng.normal(size=(len(catalog), 3))
    if world.bad_stars:
        near = [cone(catalog, axis, 0.1) for axis in camera_from_icrf.as_matrix()[:, 2]]
        bad = rng.choice(np.unique(np.concatenate(near)), world.bad_stars, replace=False)
        ten_px_rad = 10.0 / base.truth.camera.parameters[0]
        way = np.cross(catalog.direction_icrs[bad], rng.normal(size=(len(bad), 3)))
        offsets[bad] += ten_px_rad * unit(way)
    return np.asarray(offsets)


def _image(drawn: _Drawn, k: int) -> StarObservations:
    """Observations of one image."""
    world, base, camera = drawn.world, drawn.base, drawn.truth.camera
    fixed_to_earth = world.pointing in _FIXED_TO_EARTH
    time_ns = base.time_ns(k) if fixed_to_earth else _START_NS + k * _CADENCE_NS
    catalog, R = _catalog(world.magnitude_limit), drawn.camera_from_icrf[k].as_matrix()
    near = cone(catalog, R[2], field_radius_rad(camera, _MARGIN_PX))
    near = near[catalog.magnitude[near] > _SATURATED_MAGNITUDE]
    stars = catalog.select(near)
    directions = apparent_directions(stars, time_ns)
    seen = _aberrated(directions, drawn.velocity_m_s) + drawn.star_offset_rad[near]
    pixels = _pixels(drawn, k, seen @ R.T)
    pixels += _outliers_px(world, len(pixels), _stream(base.seed, _OUTLIERS, k))
    sigma_px, flux_dn = _brightness(world, stars.magnitude)
    noise = _stream(base.seed, _NOISE, k).normal(size=pixels.shape)
    variance = sigma_px**2
    to_tracker = Rotation.from_quat(drawn.truth.star_tracker_from_camera_xyzw)
    inside = np.all((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1]), axis=1)
    return StarObservations(
        time_ns=time_ns,
        width=camera.width,
        height=camera.height,
        refusal='',
        detail='',
        icrf_from_star_tracker_xyzw=drawn.reported_xyzw[k],
        attitude_gap_s=0.1,
        catalog_id=stars.id,
        direction_icrf=directions,
        magnitude=stars.magnitude.astype(np.float32),
        measured_px=pixels + sigma_px[:, None] * noise,
        covariance_px2=np.stack([variance, 0.0 * variance, variance], axis=-1),
        flux_dn=flux_dn.astype(np.float32),
        snr=(_PSF_SIGMA_PX / sigma_px).astype(np.float32),
        refused_stars={},
        background_dn=0.0,
        noise_dn=5.0,
        psf_sigma_px=0.0,
        catalog_digest=stars.digest,
        star_tracker_rate_rad_s=to_tracker.apply(drawn.rate_rad_s[k]),
        velocity_sigma_m_s=math.nan if world.velocity_m_s else GIVEN_SIGMA_M_S,
    ).select(np.asarray(inside))


def _aberrated(directions: Floats, velocity_m_s: Floats) -> Floats:
    """Directions (n, 3) for an observer who moves as well; first order in v/c."""
    beta = velocity_m_s / SPEED_OF_LIGHT_M_S
    return np.asarray(directions + beta - directions * (directions @ beta)[:, None])


def _pixels(drawn: _Drawn, k: int, in_camera: Floats) -> Floats:
    """True pixels (n, 2): a row that is read later sees the camera turned; lens displacements."""
    camera, scale = drawn.truth.camera, drawn.focal_scale[k]
    camera = camera.replace(fx=camera.intrinsics[0] * scale, fy=camera.intrinsics[2] * scale)
    pixels = project(camera, in_camera)
    moved_per_s = np.cross(in_camera, drawn.rate_rad_s[k])
    for _ in range(_PIXEL_STEPS):
        after_s = drawn.world.row_s * (pixels[:, 1] - (camera.height - 1) / 2.0)
        turned = project(camera, in_camera + moved_per_s * after_s[:, None])
        pixels = turned + drawn.displacement_px(pixels)
    return pixels


def _brightness(world: World, magnitude: Floats) -> tuple[Floats, Floats]:
    """Sigma of the centroids (n,), px, and flux (n,), DN."""
    flux_dn = world.zero_point_dn * 10 ** (-0.4 * magnitude)
    electrons = _ELECTRONS_PER_DN * flux_dn
    sigma_px = _PSF_SIGMA_PX * np.sqrt(electrons + _NOISE_ELECTRONS**2) / electrons
    return sigma_px, flux_dn


def _outliers_px(world: World, count: int, rng: Generator) -> Floats:
    """Displacements (n, 2) of 1 to 20 px of a fraction of the stars."""
    length_px = rng.uniform(1.0, 20.0, count) * (rng.random(count) < world.outlier_fraction)
    return np.asarray(length_px[:, None] * unit(rng.normal(size=(count, 2))))
