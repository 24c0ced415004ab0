# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The next pointings of a campaign: where to point the camera so that a sigma falls fastest.

Candidates are scored by the stars that the catalog has there (`planning.prospect`).
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ground.planning.prospect import (
    expected_noise_px2,
    forecast,
    Prospect,
    prospect,
    Target,
    target,
)
from starcal_ros.arrays import Floats, Mask
from starcal_ros.errors import OptionError
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.identification.prediction import predict, within_image
from starcal_ros.pipeline.setup import Setup
from starcal_ros.pipeline.solve import aligned_by, estimated
from starcal_ros.processes import one_blas_thread
from starcal_ros.records import Ensemble, StarObservations
from starcal_ros.text import significant

_CANDIDATES = 150  # in a cone: on the whole sky 16 degrees apart
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_FAINTEST = 0.99  # share of the stars observed so far that are brighter than those predicted
_HELPS = 0.01  # an image that lowers the sigma by less has ceased to help
_SAME_COSINE = 1e-12  # rounding: a pointing can be reached from itself
_MOST_IMAGES = 1000


def _direction(ra_deg: float, dec_deg: float) -> Floats:
    ra, dec = math.radians(ra_deg), math.radians(dec_deg)
    return np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])


@dataclass(frozen=True)
class Pointing:
    """+z of the camera to (ra, dec), ICRF; +x towards east, then turned about +z by the roll."""

    ra_deg: float
    dec_deg: float
    roll_deg: float = 0.0

    @property
    def icrf_from_camera(self) -> Rotation:
        """Attitude of the camera."""
        ra, dec, roll = np.radians([self.ra_deg, self.dec_deg, self.roll_deg])
        return Rotation.from_euler('ZXZ', [ra + np.pi / 2, np.pi / 2 - dec, roll])


@dataclass(frozen=True)
class Cone:
    """Directions within a radius of a direction, ICRF."""

    ra_deg: float
    dec_deg: float
    radius_deg: float


@dataclass(frozen=True)
class Request:
    """
    Wishes and bounds of a plan.

    ``minimise`` is ``line_of_sight``, ``map``, or a camera parameter or alignment angle; see
    `planning.prospect.target`.  ``pointings`` are allowed, each at most once; empty: any of
    ``within``.  No boresight comes into ``avoid``, as the Sun, the Moon and the Earth.  A slew is
    between the boresights of one image and the next.
    """

    images: int
    minimise: str = 'line_of_sight'
    pointings: tuple[Pointing, ...] = ()
    within: Cone = Cone(0.0, 0.0, 180.0)
    avoid: tuple[Cone, ...] = ()
    largest_slew_deg: float = 180.0

    def __post_init__(self) -> None:
        """Raise OptionError for numbers that have no meaning."""
        places: tuple[Pointing | Cone, ...] = (*self.pointings, *self.avoid, self.within)
        for place in places:
            numbers = dataclasses.astuple(place)
            if not all(map(math.isfinite, numbers)) or abs(place.dec_deg) > 90.0:
                raise OptionError(f'{place}: not a direction in degrees')
        for one in (*self.avoid, self.within):
            if not 0.0 <= one.radius_deg <= 180.0:
                raise OptionError(f'{one}: the radius is not within 0 to 180 deg')
        if not 1 <= self.images <= _MOST_IMAGES:
            raise OptionError(f'images: {self.images} is not within 1 to {_MOST_IMAGES}')
        if not 0.0 < self.largest_slew_deg <= 180.0:
            raise OptionError(
                f'largest slew: {self.largest_slew_deg:g} deg is not within 0 to 180'
            )


@dataclass(frozen=True)
class Step:
    """An image to take: its pointing, the stars to expect, and the sigma to expect after it."""

    pointing: Pointing
    stars: int
    sigma: float


@dataclass(frozen=True)
class Plan:
    """
    The images to take, in order.

    ``name`` is the sigma with its unit as suffix, ``sigma`` its value now, and ``enough`` the
    number of images after which the next one lowers it by less than 1 %; None: not reached.
    """

    name: str
    sigma: float
    steps: tuple[Step, ...]
    enough: int | None

    def in_a_sentence(self) -> str:
        """Return the sigma now and at the end."""
        last = self.steps[-1].sigma if self.steps else self.sigma
        count = f'{len(self.steps)} image{"s" * (len(self.steps) != 1)}'
        now, then = significant(self.sigma, 4), significant(last, 4)
        return f'{self.name} {now} now, {then} expected after {count}'


@one_blas_thread()
def plan_pointings(ensemble: Ensemble, setup: Setup, request: Request) -> Plan:
    """
    Return the pointings that lower a sigma most, each given those before it.

    Raises TooFewObservations when the ensemble so far gives no estimate to start from. Raises
    OptionError for a sigma that is not estimated, or if no pointing is allowed or shows a star.
    """
    setup = aligned_by(ensemble, setup)
    found = estimated(ensemble, setup)
    wanted = target(found, request.minimise)
    pointings = _allowed(request)
    images = [_expected(found, ensemble, setup, one) for one in pointings]
    if not any(map(len, images)):
        raise OptionError('no pointing that is allowed shows a star')
    each = prospect(found, images, setup.calibration)
    chosen = _chosen(each, wanted, request, pointings, np.array([len(i) > 0 for i in images]))
    stars = [len(images[k]) for k in chosen]
    sigmas = forecast(found, wanted, each.variances(chosen, wanted.squares), stars)
    few = np.flatnonzero(sigmas[1:] > (1.0 - _HELPS) * sigmas[:-1])
    enough = int(few[0]) if len(few) else None
    now, *after = sigmas.tolist()
    chosen_pointings = [pointings[k] for k in chosen]
    return Plan(wanted.name, now, tuple(map(Step, chosen_pointings, stars, after)), enough)


def _chosen(
    each: Prospect, wanted: Target, request: Request, pointings: Sequence[Pointing], free: Mask
) -> list[int]:
    """Return the numbers of the pointings to take; ``free`` (c,) show stars."""
    boresights = np.array([_direction(one.ra_deg, one.dec_deg) for one in pointings])
    least = math.cos(math.radians(request.largest_slew_deg)) - _SAME_COSINE
    chosen: list[int] = []
    allowed = free
    while len(chosen) < request.images and allowed.any():
        chosen.append(each.best(chosen, allowed, wanted.squares))
        if request.pointings:  # a camera may return to a direction of a cone, not to an image
            free = free & (np.arange(len(free)) != chosen[-1])
        allowed = free & (boresights @ boresights[chosen[-1]] >= least)
    return chosen


def _allowed(request: Request) -> list[Pointing]:
    """Return the allowed pointings: of the list, or evenly over the cone, each with a roll."""
    allowed = list(request.pointings) or _over(request.within)
    boresights = np.array([_direction(one.ra_deg, one.dec_deg) for one in allowed])
    clear = np.ones(len(allowed), bool)
    for cone in request.avoid:
        cosine = boresights @ _direction(cone.ra_deg, cone.dec_deg)
        clear &= cosine <= math.cos(math.radians(cone.radius_deg))
    return [one for one, is_clear in zip(allowed, clear, strict=True) if is_clear]


def _over(cone: Cone) -> list[Pointing]:
    """Return pointings on a spiral of the golden section."""
    k = np.arange(_CANDIDATES) + 0.5
    from_axis = np.arccos(1.0 - (1.0 - math.cos(math.radians(cone.radius_deg))) * k / _CANDIDATES)
    about = 2.0 * np.pi * _GOLDEN * k
    to_icrf = Pointing(cone.ra_deg, cone.dec_deg).icrf_from_camera
    spiral = np.stack([np.cos(about), np.sin(about)]) * np.sin(from_axis)
    x, y, z = to_icrf.apply(np.stack([*spiral, np.cos(from_axis)], axis=-1)).T
    ra_deg, dec_deg = np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arcsin(z.clip(-1, 1)))
    roll_deg = 360.0 * (k * math.sqrt(2.0) % 1.0)
    return [Pointing(*row) for row in np.stack([ra_deg, dec_deg, roll_deg], axis=-1).tolist()]


def _expected(
    estimate: Estimate, ensemble: Ensemble, setup: Setup, pointing: Pointing
) -> StarObservations:
    """Return what an image is expected to show: stars as bright as those observed so far."""
    geometry, last = estimate.geometry, ensemble.images[-1]
    star_tracker = (
        pointing.icrf_from_camera
        * Rotation.from_quat(geometry.star_tracker_from_camera_xyzw).inv()
    )
    camera = geometry.camera
    stars = within_image(
        predict(
            geometry,
            star_tracker.as_quat(),
            last.time_ns,
            setup.catalog,
            float(np.quantile(estimate.table.magnitude, _FAINTEST)),
            0.0,
            site=setup.site,
        ),
        camera.width,
        camera.height,
    )
    magnitude = setup.catalog.magnitude[stars.catalog_index]
    variance = expected_noise_px2(estimate, magnitude)
    zero = np.zeros(len(magnitude))
    unknown = np.full(len(magnitude), np.nan, np.float32)
    return StarObservations.of_image(
        last.time_ns,
        (camera.width, camera.height),
        icrf_from_star_tracker_xyzw=star_tracker.as_quat(),
        catalog_id=setup.catalog.id[stars.catalog_index],
        direction_icrf=stars.direction_icrf,
        magnitude=magnitude.astype(np.float32),
        measured_px=stars.xy_px,
        covariance_px2=np.stack([variance, zero, variance], axis=-1),
        flux_dn=unknown,
        snr=unknown,
        velocity_sigma_m_s=last.velocity_sigma_m_s,
        temperature_degc=last.temperature_degc,
        # A camera at rest, where the rates of the images are known.
        star_tracker_rate_rad_s=0.0 * last.star_tracker_rate_rad_s,
    )
