# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Air that stars were seen through, and the zenith, by the stars alone.

Refraction by ``A tan z`` shrinks an image by A, and along the direction of the zenith by
``A tan^2 z`` more: 54 arcsec in a radian at 45 degrees.  Images of one site have zeniths of one
declination, its latitude, and right ascensions as the stamps run.  Where the clock was not right,
each image takes the sidereal time that fits it best with the camera that fits all.

A star at the zenith distance z is raised by ``A tan z + B tan^3 z`` (Explanatory Supplement to the
Astronomical Almanac, 3rd ed., section 7.2.2.5.2).  As vectors, with the zenith Z and the direction
e: ``tan z`` towards the zenith is ``Z / (e . Z) - e``.
"""

from __future__ import annotations

from collections.abc import Sequence
import dataclasses
from dataclasses import dataclass
import math
import operator

import numpy as np

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import CameraModel, project_jacobians
from starcal_ros.camera.detector_field import basis
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND, SPEED_OF_LIGHT_M_S
from starcal_ros.identification.star_finder import realigned
from starcal_ros.records import CameraGeometry, refused_image, StarObservations
from starcal_ros.robust_statistics import median
from starcal_ros.sky.astrometry import LEAST_COSINE, SIDEREAL_RAD_S

USUAL_ARCSEC = (52.0, 7.0)
"""A of sites between the sea and 2000 m, 0.55 micrometres: mean and 1-sigma."""
_CUBIC = -0.00115  # B / A, from the scale height of the air and the Earth's radius
_STARS = 150  # most accurate stars used in each image
_FLOOR_PX = 0.03  # added to the sigma of a centroid in quadrature
_OUTLIER = 4.0  # limit of a residual over their median
# 1-sigma per axis, less the velocity of the Earth: of a spacecraft about the Sun, and of the Earth
# on another date.
SPACE_M_S, EARTH_M_S = 50000.0, 24000.0
_FASTEST_M_S = 200000.0  # fastest spacecraft about the Sun, at its perihelion
_FIELD_PX = 0.1  # rms residual of the lens model, in _OCTAVES
_OCTAVES = 2
_LATITUDES_RAD = np.radians(np.arange(-84.0, 85.0, 6.0))
_LOWEST_BORESIGHT = math.cos(math.radians(75.0))
_TURNS = 30  # alternate fits of the camera and of the times
_TELLING = 12.0  # twice the logarithm of a ratio of likelihoods: 400
_MISSHAPEN, _MISSHAPEN_PX = 3.5, 0.5  # stretch of an image in a corner: over the median, and least


def refracted(direction_icrf: Floats, zenith_icrf: Floats, refraction_arcsec: float) -> Floats:
    """
    Directions (n, 3) of stars as seen through the air.

    ``refraction_arcsec`` is A; the zenith (3,) has the axes of the directions.
    """
    cosine = np.maximum(direction_icrf @ zenith_icrf, LEAST_COSINE)[:, None]
    towards = zenith_icrf / cosine - direction_icrf
    tangent2 = 1.0 / cosine**2 - 1.0
    bent = direction_icrf + refraction_arcsec * ARCSECOND_RAD * (1 + _CUBIC * tangent2) * towards
    return np.asarray(bent / np.linalg.norm(bent, axis=1, keepdims=True))


def zenith_of(latitude_rad: float, right_ascension_rad: Floats) -> Floats:
    """Zenith (n, 3) of a site at n times, ICRF; precession, 0.3 degrees since 2000, left out."""
    along = np.cos(latitude_rad)
    return np.stack(
        [
            along * np.cos(right_ascension_rad),
            along * np.sin(right_ascension_rad),
            np.full(np.shape(right_ascension_rad), np.sin(latitude_rad)),
        ],
        axis=-1,
    )


@dataclass(frozen=True)
class _Site:
    """
    Latitude, sidereal times (m,) of the images there, and 2 log of their likelihood.

    ``gain`` is that of the mean over all times over that of space, ``best`` that of these times
    over that of no air on the Earth; no times and minus infinity where an image has no zenith
    above it.
    """

    latitude_rad: float
    times_rad: Floats
    gain: float
    best: float = -math.inf


def with_air(
    observations: Sequence[StarObservations], camera: CameraModel, is_ground: bool = False
) -> tuple[list[StarObservations], str]:
    """
    Observations with directions as seen through the air, if there was any, and what was found.

    ``camera`` is that of all images, its focal length good to 5 %; ``is_ground`` where air is
    stated.  Where the stars do not tell, half of the usual refraction is taken, with that as its
    1-sigma.  An image that no air gives the shape of the others is refused: its stars are false,
    or its lens is another.  Observations that state a zenith, as recorded ones, are unchanged.
    """
    used = [one for one in observations if not one.refusal]
    if len(used) < 2 - is_ground or any(np.isfinite(one.zenith_icrf).all() for one in used):
        return list(observations), ''
    images = _images(used, camera)
    site = _searched(images)
    is_air = site.best > -_TELLING if is_ground else site.gain > _TELLING
    (size, sigma), velocity_m_s = USUAL_ARCSEC, EARTH_M_S
    zenith = zenith_of(site.latitude_rad, site.times_rad)
    text = (
        f'observer: ground: the stars show {"refraction, with " * (site.gain > _TELLING)}a zenith'
        f' at {math.degrees(site.latitude_rad):+.0f} degrees of declination'
    )
    if not is_air:
        size = sigma = 0.5 * size
        velocity_m_s = SPACE_M_S
        # A zenith found by chance would be trusted: only the change of the focal length is left.
        zenith = np.array([one.boresight for one in images])
        text = (
            'observer: ground: the stars do not show its air: half of the usual refraction is'
            ' taken, with that as its 1-sigma; of a camera in space state observer: space'
            if is_ground
            else 'observer: ground or space: the stars do not tell; state it: --set'
            ' observer=space, or --set observer=ground, best with the site'
        )
    speed_m_s = _speed_m_s(images)
    if not is_air and speed_m_s > _FASTEST_M_S:
        text = (
            'observer: ground or space: something else than air shifts the stars, such as trees or'
            f' lights in the images (by as much as a velocity of {speed_m_s / 1000:.0f} km/s'
            ' would): leave out those images'
        )
    elif not is_ground and site.gain < -_TELLING:
        size = sigma = 0.0
        text = 'observer: space: the stars show no refraction'
    through = {
        one.time_ns: dataclasses.replace(
            one,
            direction_icrf=refracted(one.direction_icrf, zenith[k], size),
            velocity_sigma_m_s=velocity_m_s,
            zenith_icrf=zenith[k] if sigma else np.full(3, math.nan),
            refraction_arcsec=np.array([size, sigma]),
        )
        for k, one in enumerate(used)
    }
    half_px = 0.5 * math.hypot(camera.width, camera.height)
    off_px = half_px / float(camera.parameters[0]) * _shapes_px(images, zenith, size)
    worst = int(np.argmax(off_px))
    if off_px[worst] > max(_MISSHAPEN * float(np.median(off_px)), _MISSHAPEN_PX):
        one = used[worst]
        detail = f'stretched by {off_px[worst]:.1f} px in a corner against the others'
        refused = refused_image(one.time_ns, one.width, one.height, 'no_match', detail)
        kept = [refused if each is one else each for each in observations]
        return with_air(kept, camera, is_ground)
    return [through.get(one.time_ns, one) for one in observations], text


def _speed_m_s(images: Sequence[_Equations]) -> float:
    """Speed of the observer that explains the shifts of the stars where there is no air."""
    inverse, h = _common(images, SPACE_M_S)
    own = images[0].of_camera
    return float(np.linalg.norm((inverse @ h)[own : own + 3]))


def _shapes_px(images: Sequence[_Equations], zenith: Floats, size_arcsec: float) -> Floats:
    """Change (m,) of focal length, aspect ratio and skew by which an image differs, px."""
    left = [
        one.residual - one.by_air(zenith[k : k + 1])[:, 0] * (size_arcsec / USUAL_ARCSEC[0])
        for k, one in enumerate(images)
    ]
    inverse, _ = _common(images, SPACE_M_S)
    h = np.sum([one.by_common.T @ r for one, r in zip(images, left, strict=True)], axis=0)
    shapes = []
    for one, r in zip(images, left, strict=True):
        own = one.by_common[:, :3]
        shapes.append(np.linalg.lstsq(own, r - one.by_common @ (inverse @ h), rcond=1e-10)[0])
    return np.asarray(np.linalg.norm(shapes, axis=1))


@dataclass(frozen=True)
class _Equations:
    """
    Stars (n) of an image: their directions, ICRF, and equations free of the rotation of the image.

    ``late_rad`` is the rotation of the Earth since the first image by the stamps.  Whitened:
    ``residual`` (2 n,), ``by_common`` (2 n, c) by the camera (``of_camera`` numbers),
    the velocity of the observer and the field, ``by_direction`` (n, 2, 3); ``turns`` (2 n, 3)
    spans the rotations.
    """

    direction: Floats
    boresight: Floats
    late_rad: float
    residual: Floats
    by_common: Floats
    by_direction: Floats
    turns: Floats
    of_camera: int

    def by_air(self, zenith: Floats) -> Floats:
        """Displacements (2 n, c) by refraction about zeniths (c, 3)."""
        through = np.stack([refracted(self.direction, z, USUAL_ARCSEC[0]) for z in zenith], -1)
        moved = self.by_direction @ (through - self.direction[..., None])
        return _without(self.turns, moved.reshape(len(self.residual), len(zenith)))


def _without(turns: Floats, columns: Floats) -> Floats:
    """Columns (2 n, c) free of the rotations that orthonormal ones (2 n, 3) span."""
    return np.asarray(columns - turns @ (turns.T @ columns))


def _images(used: Sequence[StarObservations], camera: CameraModel) -> list[_Equations]:
    """Equations of the best stars of each image, without those that no camera like it fits."""
    chosen = []
    for one in used:
        order = np.argsort(one.covariance_px2[:, [0, 2]].sum(axis=1), kind='stable')
        chosen.append(one.select(np.isin(np.arange(len(one)), order[:_STARS])))
    first_ns = used[0].time_ns
    images = [_seen(one, camera, first_ns) for one in chosen]
    inverse, h = _common(images, SPACE_M_S)
    kept = []
    for one, image in zip(chosen, images, strict=True):
        left = image.residual - image.by_common @ (inverse @ h)
        # Any air changes an image nearly as its own focal length, skew and aspect ratio do.
        affine = image.by_common[:, :3]
        left -= affine @ np.linalg.lstsq(affine, left, rcond=1e-10)[0]
        size = np.linalg.norm(left.reshape(-1, 2), axis=1)
        kept.append(one.select(size < _OUTLIER * max(median(size), 1.0)))
    return [_seen(one, camera, first_ns) for one in kept]


def _seen(one: StarObservations, camera: CameraModel, first_ns: int) -> _Equations:
    start = realigned(CameraGeometry(camera, np.array([0.0, 0.0, 0.0, 1.0])), one)
    camera_from_icrf = start.icrf_from_camera(one.icrf_from_star_tracker_xyzw).as_matrix().T
    e = one.direction_icrf @ camera_from_icrf.T
    xy, by_camera, by_rotation = project_jacobians(dataclasses.replace(camera, field=None), e)
    sigma = np.sqrt(one.covariance_px2[:, [0, 2]] + _FLOOR_PX**2)[..., None]
    # J_rotation r = J_direction (e x r) up to the sign of the rotation: take its inverse.
    by_direction = -np.cross(by_rotation, e[:, None]) / sigma @ camera_from_icrf
    n = 2 * len(e)
    turns = np.linalg.qr((by_rotation / sigma).reshape(n, 3))[0]
    # Aberration: d e = (v - e (e . v)) / c; the part along e moves no pixel.
    by_velocity = by_direction / SPEED_OF_LIGHT_M_S
    waves = basis(xy, camera.width, camera.height, _OCTAVES) * _FIELD_PX
    waves = waves / math.sqrt(waves.shape[1])
    by_field = np.einsum('ab,nt->nabt', np.eye(2), waves).reshape(len(e), 2, -1) / sigma
    by_common = np.concatenate([by_camera / sigma, by_velocity, by_field], axis=2).reshape(n, -1)
    residual = ((one.measured_px - xy)[..., None] / sigma).reshape(n, 1)
    return _Equations(
        one.direction_icrf,
        camera_from_icrf[2],
        SIDEREAL_RAD_S * (one.time_ns - first_ns) / NANOSECONDS_PER_SECOND,
        _without(turns, residual)[:, 0],
        _without(turns, by_common),
        by_direction,
        turns,
        len(camera.parameters),
    )


def _common(images: Sequence[_Equations], velocity_m_s: float) -> tuple[Floats, Floats]:
    """Inverse (c, c) of the information on what is common to images, and the gradient (c,)."""
    H = np.sum([one.by_common.T @ one.by_common for one in images], axis=0)
    own = images[0].of_camera
    precision = np.ones(len(H) - own)
    precision[:3] = velocity_m_s**-2
    H[own:, own:] += np.diag(precision)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-30))
    inverse = np.linalg.pinv(H * np.outer(scale, scale), rcond=1e-10) * np.outer(scale, scale)
    return inverse, np.sum([one.by_common.T @ one.residual for one in images], axis=0)


@dataclass(frozen=True)
class _Choice:
    """Sidereal times (k,) of an image: chi^2 (k,) beyond none, gradients (c, k), the highest."""

    times_rad: Floats
    chi2: Floats
    by_common: Floats
    highest: int


def _searched(images: Sequence[_Equations]) -> _Site:
    """
    The latitude that fits best, and the sidereal times.

    Either the stamps are right up to one offset, or each image has a time of its own.
    """
    inverse, h = _common(images, SPACE_M_S)
    freedom = sum(len(one.residual) - 3 for one in images) - len(h)
    total = sum(float(one.residual @ one.residual) for one in images)
    without_air = float(h @ inverse @ h)
    variance = max((total - without_air) / max(freedom, 1), 1.0)
    inverse, h = _common(images, EARTH_M_S)
    fit = _Fit(images, inverse, h, variance)
    sites = []
    by_gain = operator.attrgetter('gain')
    for times in (fit.by_stamps, fit.by_images):
        coarse = max((times(latitude, None) for latitude in _LATITUDES_RAD), key=by_gain)
        near = coarse.latitude_rad + np.radians(np.arange(-5.0, 5.5))
        fine = max((times(latitude, coarse) for latitude in near.clip(-1.5, 1.5)), key=by_gain)
        # The mean of a likelihood is that over all times, not over those about the best.
        site = fine if len(fine.times_rad) else coarse
        gain = coarse.gain - without_air / variance
        best = site.best - float(h @ inverse @ h) / variance
        sites.append(dataclasses.replace(site, gain=gain, best=best))
    return max(sites, key=by_gain)


def _high(one: _Equations, zenith: Floats) -> Mask:
    """Which zeniths (k, 3) are well above the stars of an image."""
    lowest = (one.direction @ zenith.T).min(axis=0)
    return np.asarray((zenith @ one.boresight > _LOWEST_BORESIGHT) & (lowest > LEAST_COSINE))


def _choice(one: _Equations, zenith: Floats, times_rad: Floats) -> _Choice:
    columns = one.by_air(zenith)
    return _Choice(
        times_rad,
        (columns**2).sum(axis=0) - 2.0 * (one.residual @ columns),
        one.by_common.T @ columns,
        int(np.argmax(zenith @ one.boresight)),
    )


def _of_mean(chi2: Floats, at: int, variance: float) -> float:
    """Chi^2 of the mean likelihood of choices (k,), of which one is the best."""
    mean = float(np.exp(0.5 * (chi2[at] - chi2) / variance).mean())
    return float(chi2[at]) / variance - 2.0 * math.log(mean)


@dataclass(frozen=True)
class _Fit:
    """Images with the information and the gradient of what is common, and the noise."""

    images: Sequence[_Equations]
    inverse: Floats
    h: Floats
    variance: float

    def by_stamps(self, latitude_rad: float, about: _Site | None) -> _Site:
        """Times as the stamps run, the first one free."""
        if about is not None and not len(about.times_rad):
            return about
        first = np.radians(np.arange(0.0, 360.0, 4.0))
        if about is not None:
            first = about.times_rad[0] + np.radians(np.arange(-5.0, 5.5))
        zeniths = [zenith_of(latitude_rad, first + one.late_rad) for one in self.images]
        pairs = list(zip(self.images, zeniths, strict=True))
        high = np.all([_high(one, zenith) for one, zenith in pairs], axis=0)
        if not high.any():
            return _Site(latitude_rad, first[:0], -math.inf)
        made = [_choice(one, z[high], first[high] + one.late_rad) for one, z in pairs]
        left = self.h[:, None] - np.sum([one.by_common for one in made], axis=0)
        chi2 = np.sum([one.chi2 for one in made], axis=0)
        chi2 -= (left * (self.inverse @ left)).sum(axis=0)
        at = int(np.argmin(chi2))
        times = np.array([one.times_rad[at] for one in made])
        best = -float(chi2[at]) / self.variance
        return _Site(latitude_rad, times, -_of_mean(chi2, at, self.variance), best)

    def by_images(self, latitude_rad: float, about: _Site | None) -> _Site:
        """Times of each image by itself, by turns with camera and velocity."""
        choices = []
        for k, one in enumerate(self.images):
            times = np.radians(np.arange(0.0, 360.0, 6.0))
            if about is not None and len(about.times_rad):
                times = about.times_rad[k] + np.radians(np.arange(-20.0, 20.5))
            zenith = zenith_of(latitude_rad, times)
            high = _high(one, zenith)
            if not high.any():
                return _Site(latitude_rad, times[:0], -math.inf)
            choices.append(_choice(one, zenith[high], times[high]))
        at, before = [one.highest for one in choices], [-1]
        for _ in range(_TURNS):
            columns = [one.by_common[:, k] for one, k in zip(choices, at, strict=True)]
            left = self.h - np.sum(columns, axis=0)
            common = self.inverse @ left
            if at == before:
                break
            before = at
            at = [int(np.argmin(one.chi2 + 2.0 * (common @ one.by_common))) for one in choices]
        total = best = float(left @ common) / self.variance
        for each, k in zip(choices, at, strict=True):
            by_common = 2.0 * (common @ each.by_common)
            total -= _of_mean(each.chi2 + by_common, k, self.variance)
            total += float(by_common[k]) / self.variance
            best -= float(each.chi2[k]) / self.variance
        chosen = np.array([one.times_rad[k] for one, k in zip(choices, at, strict=True)])
        return _Site(latitude_rad, chosen, total, best)
