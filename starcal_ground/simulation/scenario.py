# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Simulated campaigns with known truth, and the stars in each of their images.

A `Scenario` is a campaign whose truth is drawn from a seed; a `Scene` holds the stars of one of
its images, without noise.  `images` renders pixels, `centroids` draws noisy centroids without
pixels.

Modelled: proper motion and aberration of the catalog, and star-tracker errors: one for an image,
or one of each sample.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import functools
import math
from typing import Any

import erfa
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ground.simulation.deep_sky import archive_table, deep_sky
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, field_radius_rad, project
from starcal_ros.camera.lens import fold_radius2, ideal_points
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SECONDS_PER_YEAR
from starcal_ros.records import AttitudeSample, CameraGeometry
from starcal_ros.sky.astrometry import apparent_directions, tt_julian_date
from starcal_ros.sky.attitude import AttitudeHistory
from starcal_ros.sky.catalog import cone, load_catalog, StarCatalog

# Random streams (seed, purpose, image): an image does not depend on the previous ones.
TRUTH_STREAM, ATTITUDE_STREAM, CENTROID_STREAM, PATTERN_STREAM, PIXEL_STREAM = range(5)
_STAMP_SIGMAS = 6.0  # half width of a stamp: 2e-9 of the light of a star is outside
_UNIX_EPOCH_JD = 2440587.5  # 1970-01-01T00:00 UTC, POSIX
ATTITUDE_OFFSETS_S: tuple[float, ...] = (-0.75, -0.25, 0.25, 0.75)
"""Times of the star-tracker samples relative to an image: 2 Hz, none at the image itself."""
MOUNTING_SIGMA_RAD = 150.0 * ARCSECOND_RAD
"""1-sigma of each axis by which launch has turned the camera."""
SAMPLES_S = 1.5
"""Time before and after an image with samples that have errors of their own."""


@dataclass(frozen=True)
class Detector:
    """Detector and signal levels; electrons are per pixel and image."""

    psf_sigma_px: float = 0.95  # at the centre of the detector
    psf_growth: float = 0.0  # relative growth centre to corner, with the square of the distance
    zero_point_electrons: float = 3.0e5  # flux of a star of V = 0: 35 mm f/2 lens, 0.1 s
    sky_electrons: float = 1.5
    dark_electrons: float = 3.0
    read_noise_electrons: float = 8.0
    electrons_per_dn: float = 4.0
    offset_dn: float = 64.0
    bits: int = 12
    hot_fraction: float = 2e-4
    hot_electrons: float = 600.0  # mean of an exponential distribution
    cosmic_rays: float = 2.0  # mean number per image

    def psf_sigma_at(self, pixels_px: Floats, shape: tuple[int, int]) -> Floats:
        """PSF sigma (n,) at pixels (n, 2) of a detector (height, width)."""
        middle = np.array([shape[1] - 1, shape[0] - 1]) / 2.0
        part2 = ((pixels_px - middle) ** 2).sum(axis=1) / (middle**2).sum()
        # The PSF does not widen further outside the detector.
        return np.asarray(self.psf_sigma_px * (1.0 + self.psf_growth * np.minimum(part2, 1.0)))

    @property
    def full_dn(self) -> int:
        """Saturation level of the converter."""
        return (1 << self.bits) - 1

    @property
    def background_electrons(self) -> float:
        """Mean signal of a pixel without a star."""
        return self.sky_electrons + self.dark_electrons

    @property
    def noise_electrons(self) -> float:
        """1-sigma noise of a pixel without a star: photon, dark, read and quantisation noise."""
        rounding = self.electrons_per_dn**2 / 12
        return math.sqrt(self.background_electrons + self.read_noise_electrons**2 + rounding)


@dataclass(frozen=True)
class EarthFixed:
    """A camera fixed to the Earth that points at the zenith: stars drift through its field."""

    latitude_deg: float
    longitude_deg: float
    roll_deg: float = 0.0  # angle of +x from east towards north


@dataclass(frozen=True)
class Inertial:
    """A camera that points at one star field after another: (ra, dec, roll) of each, degrees."""

    attitudes_deg: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Scenario:
    """One campaign: truth, prior, detector and exposure times."""

    name: str
    seed: int
    truth: CameraGeometry
    prior: CameraGeometry
    detector: Detector
    star_tracker_sigma_arcsec: tuple[float, float, float]
    pointing: EarthFixed | Inertial
    start_ns: int
    cadence_s: float
    image_count: int
    magnitude_limit: float = 9.0
    stars_per_image: int | None = None  # the brightest on the detector; None: all
    sky: StarCatalog | None = None  # sorted by magnitude; None: the bundled catalog
    table: str | None = None  # the sky as an archive gives it; None: the bundled catalog
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)  # turn of the camera in an exposure
    star_tracker_hz: float = 0.0  # rate of samples, errors independent; 0: at ATTITUDE_OFFSETS_S

    def time_ns(self, index: int) -> int:
        """Middle of the exposure of an image."""
        return self.start_ns + round(index * self.cadence_s * NANOSECONDS_PER_SECOND)


@dataclass(frozen=True)
class Scene:
    """
    Stars of one image, without noise.

    Attributes
    ----------
    camera_from_icrf : (3, 3)
        True attitude.
    icrf_from_star_tracker_xyzw : (4,)
        Reported attitude, with the star-tracker errors of this image.
    catalog_id, magnitude, direction_icrf, pixel_px, flux_electrons : (n,) or (n, 2 or 3)
        Stars on the detector, and those outside with light on it.
    """

    time_ns: int
    camera_from_icrf: Floats
    icrf_from_star_tracker_xyzw: Floats
    catalog_id: NDArray[np.int64]
    magnitude: Floats
    direction_icrf: Floats
    pixel_px: Floats
    flux_electrons: Floats
    catalog_digest: str


# Fields with many bright stars, over the whole sky, each at a different roll.
_TINY_FIELDS = (
    (250.0, 32.0, 10.0),
    (305.0, 40.0, 95.0),
    (283.0, 36.0, 200.0),
    (84.0, -2.0, 290.0),
    (57.0, 24.0, 45.0),
    (155.0, -48.0, 130.0),
    (190.0, -58.0, 250.0),
    (252.0, -38.0, 340.0),
    (15.0, 60.0, 170.0),
    (110.0, -30.0, 60.0),
)
_NARROW_SKY = (288.0, 38.0, 2.0)  # right ascension, declination and radius, degrees
_NARROW_FIELDS = tuple(
    (288.0 + 2.0 * r * math.cos(2.4 * k), 38.0 + 1.6 * r * math.sin(2.4 * k), 70.0 * k)
    for k, r in enumerate(np.sqrt(np.arange(0.5, 12.0) / 12.0).tolist())
)
_HOUSTON = EarthFixed(latitude_deg=29.76, longitude_deg=-95.37, roll_deg=20.0)
_HERCULES_NS = 1778829600 * NANOSECONDS_PER_SECOND  # 2026-05-15 07:20 UTC: 16.5 h sidereal there
_NIGHT: Mapping[str, Any] = {
    'detector': Detector(),
    'star_tracker_sigma_arcsec': (20.0, 20.0, 20.0),
    'pointing': _HOUSTON,
    'start_s': 0.0,
}
SCENARIOS: Mapping[str, Mapping[str, Any]] = {
    # The bag in the repository: a coarse quantisation keeps the noise near 1 DN, so that it
    # compresses well.
    'tiny': {
        'size': (640, 512),
        'cadence_s': 4.0,
        'image_count': 10,
        'detector': Detector(electrons_per_dn=8.0, offset_dn=32.0, zero_point_electrons=2e5),
        'star_tracker_sigma_arcsec': (10.0, 10.0, 40.0),
        'pointing': Inertial(_TINY_FIELDS),
    },
    'small': {'size': (1296, 1024), 'cadence_s': 60.0, 'image_count': 24, 'start_s': 1200.0},
    'paper': {'size': (2592, 2048), 'cadence_s': 10.0, 'image_count': 359},
    # A telescope whose stars are below the bundled catalog.
    'narrow': {
        'size': (640, 512),
        'width_deg': 0.5,
        'cadence_s': 60.0,
        'image_count': 12,
        'detector': Detector(zero_point_electrons=2e7, bits=14),
        'star_tracker_sigma_arcsec': (5.0, 5.0, 20.0),
        'pointing': Inertial(_NARROW_FIELDS),
        'magnitude_limit': 13.5,
    },
}
"""Size of the detector and fields of the scenarios by name, in which they differ from a night."""


def scenario(name: str, seed: int = 1) -> Scenario:
    """
    Scenario by name; the seed determines its truth and all its noise.

    The camera has a field of 20 x 16 degrees, half a degree in 'narrow'.  The prior is its
    calibration on the ground; launch has changed it.

    Raises ValueError if no scenario has that name.
    """
    if name not in SCENARIOS:
        raise ValueError(f'scenario: {name!r} is not one of {", ".join(SCENARIOS)}')
    given = {**_NIGHT, **SCENARIOS[name]}
    width, height = given.pop('size')
    rng = random_stream(seed, TRUTH_STREAM)
    focal_px = 35.0 / 0.0048 * width / 2592  # 35 mm lens; 4.8 um pixels at full resolution
    if name == 'narrow':
        focal_px = width / 2 / math.tan(math.radians(given.pop('width_deg')) / 2)
        given['sky'], given['table'] = _narrow_sky(given['magnitude_limit'])
    nominal = CameraModel(
        width,
        height,
        np.array(
            [focal_px, 0, focal_px, (width - 1) / 2, (height - 1) / 2, -0.045, 0.08, 0, 0, 0]
        ),
    )
    focal_true_px = focal_px * (1 + 1e-3 * rng.normal())
    true = nominal.replace(
        fx=focal_true_px,
        fy=focal_true_px * (1 + 2e-4 * rng.normal()),
        skew=rng.normal() * width / 2592,
        k1=-0.045 + 0.01 * rng.normal(),
        k2=0.08 + 0.05 * rng.normal(),
        p1=4e-4 * rng.normal(),
        p2=4e-4 * rng.normal(),
    )
    # An arbitrary mounting in which no axis of the camera is parallel to one of the star tracker.
    mounting = Rotation.from_euler('zyx', [-91.0, -28.0, 3.0], degrees=True)
    shift = Rotation.from_rotvec(MOUNTING_SIGMA_RAD * rng.normal(size=3))
    return Scenario(
        name=name,
        seed=seed,
        truth=CameraGeometry(true, (mounting * shift).as_quat()),
        prior=CameraGeometry(nominal, mounting.as_quat()),
        start_ns=_HERCULES_NS + round(given.pop('start_s') * NANOSECONDS_PER_SECOND),
        **given,
    )


def at_date(
    made: Scenario,
    start_ns: int,
    focal_ppm_per_year: float = 0.0,
    alignment_arcsec_per_year: float = 0.0,
) -> Scenario:
    """
    A scenario whose first image is of another time, and whose camera has drifted until then.

    The drift is linear from the date of the scenario on: of both focal lengths, and of the
    alignment about the x axis of the camera.  It is neglected within the campaign.
    """
    years = (start_ns - made.start_ns) / (NANOSECONDS_PER_SECOND * SECONDS_PER_YEAR)
    grown = 1.0 + 1e-6 * focal_ppm_per_year * years
    fx, _, fy = made.truth.camera.intrinsics[:3].tolist()
    turn = Rotation.from_euler('x', alignment_arcsec_per_year * years * ARCSECOND_RAD)
    alignment = made.truth.star_tracker_from_camera * turn
    camera = made.truth.camera.replace(fx=grown * fx, fy=grown * fy)
    truth = CameraGeometry(camera, alignment.as_quat())
    return replace(made, truth=truth, start_ns=start_ns)


@functools.cache
def _narrow_sky(faintest: float) -> tuple[StarCatalog, str]:
    """The sky of the scenario narrow, the same for all seeds, and the table of its region."""
    ra_rad, dec_rad, radius_rad = np.radians(_NARROW_SKY).tolist()
    axis, rng = erfa.s2c(ra_rad, dec_rad), np.random.default_rng(1)
    sky = deep_sky(axis, radius_rad, faintest, rng, spread=0.0)
    return sky, archive_table(sky, axis, radius_rad)


def random_stream(seed: int, purpose: int, index: int = 0) -> np.random.Generator:
    """Random generator of an image for one of the purposes ``*_STREAM``."""
    return np.random.default_rng([seed, purpose, index])


def camera_from_icrf(scenario: Scenario, index: int, offset_s: float = 0.0) -> Floats:
    """True attitude (3, 3) of the camera at an image, or some seconds after it."""
    if isinstance(scenario.pointing, Inertial):
        fields = scenario.pointing.attitudes_deg
        ra, dec, roll = np.radians(fields[index % len(fields)])
        # +z to (ra, dec), +x towards the east: Rz(ra + 90) Rx(90 - dec), then the roll.
        icrf_from_camera = Rotation.from_euler('ZXZ', [ra + np.pi / 2, np.pi / 2 - dec, roll])
        return np.asarray(icrf_from_camera.inv().as_matrix())
    site = scenario.pointing
    latitude, longitude = math.radians(site.latitude_deg), math.radians(site.longitude_deg)
    earth_from_camera = Rotation.from_euler(
        'ZXZ', [longitude + np.pi / 2, np.pi / 2 - latitude, math.radians(site.roll_deg)]
    )
    time_ns = scenario.time_ns(index) + round(offset_s * NANOSECONDS_PER_SECOND)
    # UTC replaces UT1: the zenith is off by 13 arcsec at most, which does not matter here.
    ut_days = time_ns / (86400 * NANOSECONDS_PER_SECOND)
    earth_from_icrf = erfa.c2t06a(*tt_julian_date(time_ns), _UNIX_EPOCH_JD, ut_days, 0.0, 0.0)
    return np.asarray(earth_from_camera.inv().as_matrix() @ earth_from_icrf)


def _icrf_from_star_tracker_xyzw(
    scenario: Scenario, index: int, offsets_s: Sequence[float] = (0.0,), noise: bool = True
) -> Floats:
    """
    Reported star-tracker attitudes (n, 4) at times about an image: the truth with errors.

    Each sample of a star tracker with a rate has an error of its own, else all have that of the
    image.
    """
    camera_from_star_tracker = scenario.truth.star_tracker_from_camera.inv()
    true = np.array([camera_from_icrf(scenario, index, offset_s) for offset_s in offsets_s])
    # The tracker's frame is off by small passive angles about its own axes.
    sigma_rad = np.array(scenario.star_tracker_sigma_arcsec) * ARCSECOND_RAD
    rng = random_stream(scenario.seed, ATTITUDE_STREAM, index)
    count = len(offsets_s) if scenario.star_tracker_hz else 1
    error = Rotation.from_rotvec(noise * sigma_rad * rng.normal(size=(count, 3)))
    reported = Rotation.from_matrix(true).inv() * camera_from_star_tracker * error
    return np.asarray(reported.as_quat())


def attitude_samples(scenario: Scenario, index: int) -> tuple[AttitudeSample, ...]:
    """Star-tracker samples around an image: none at the image itself."""
    hz, offsets_s = scenario.star_tracker_hz, ATTITUDE_OFFSETS_S
    if hz:
        half = int(SAMPLES_S * hz)
        offsets_s = tuple((k + 0.5) / hz for k in range(-half, half))
    reported_xyzw = _icrf_from_star_tracker_xyzw(scenario, index, offsets_s)
    return tuple(
        AttitudeSample(
            scenario.time_ns(index) + round(offset_s * NANOSECONDS_PER_SECOND), one_xyzw
        )
        for offset_s, one_xyzw in zip(offsets_s, reported_xyzw, strict=True)
    )


def _at_image_xyzw(scenario: Scenario, index: int, noise: bool) -> Floats:
    """Reported attitude (4,) at an image; between its samples, if each has its own error."""
    if not (scenario.star_tracker_hz and noise):
        return np.asarray(_icrf_from_star_tracker_xyzw(scenario, index, noise=noise)[0])
    history = AttitudeHistory()
    for sample in attitude_samples(scenario, index):
        history.add(sample.time_ns, sample)
    return history.at(scenario.time_ns(index), 2.0 * SAMPLES_S)[0]


def stamp_half_px(psf_sigma_px: float) -> int:
    """Half width of the stamp in which the light of a star is drawn, px."""
    return math.ceil(_STAMP_SIGMAS * psf_sigma_px)


def scene(scenario: Scenario, index: int, attitude_noise: bool = True) -> Scene:
    """Stars of an image, of the sky of the scenario down to the magnitude limit."""
    catalog = scenario.sky
    if catalog is None:
        catalog = load_catalog(None, scenario.magnitude_limit)
    camera, time_ns = scenario.truth.camera, scenario.time_ns(index)
    R = camera_from_icrf(scenario, index)
    margin_px = stamp_half_px(scenario.detector.psf_sigma_px * (1 + scenario.detector.psf_growth))
    radius_rad = field_radius_rad(camera, margin_px)
    stars = catalog.select(cone(catalog, R[2], radius_rad, scenario.magnitude_limit))
    directions = apparent_directions(stars, time_ns)
    in_camera = directions @ R.T
    # Beyond the fold of the distortion the model has a second image, which no lens has.
    ideal = ideal_points(camera.model, in_camera)
    folded = (ideal**2).sum(axis=1) >= fold_radius2(camera.model, camera.distortion)
    pixels = np.where(folded[:, None], np.nan, project(camera, in_camera))
    size = np.array([camera.width, camera.height])
    near = ((pixels > -margin_px) & (pixels < size - 1 + margin_px)).all(axis=1)
    if scenario.stars_per_image is not None:
        inside = near & ((pixels >= 0) & (pixels <= size - 1)).all(axis=1)
        brightest = np.argsort(np.where(inside, stars.magnitude, np.inf), kind='stable')
        shown = brightest[: min(scenario.stars_per_image, int(inside.sum()))]
        near = np.zeros_like(near)
        near[shown] = True
    magnitude = stars.magnitude[near]
    zero_point = scenario.detector.zero_point_electrons
    return Scene(
        time_ns=time_ns,
        camera_from_icrf=R,
        icrf_from_star_tracker_xyzw=_at_image_xyzw(scenario, index, attitude_noise),
        catalog_id=stars.id[near],
        magnitude=magnitude,
        direction_icrf=directions[near],
        pixel_px=pixels[near],
        flux_electrons=zero_point * 10 ** (-0.4 * magnitude),
        catalog_digest=catalog.digest,
    )


def scenes(scenario: Scenario, attitude_noise: bool = True) -> Iterator[Scene]:
    """Scenes of all images."""
    for index in range(scenario.image_count):
        yield scene(scenario, index, attitude_noise)
