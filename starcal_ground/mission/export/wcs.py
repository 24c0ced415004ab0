# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
World coordinate systems of images: FITS headers with TAN-SIP (Shupe et al. 2005, ASP 347, 491).

The attitude of an image is that of its own stars.  A polynomial through them takes its apparent
directions to the places of the catalog at its time: that removes the aberration of light, whatever
the velocity was, and refraction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import io
import json
import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from starcal_ground.bags.reader import OF_ANOTHER_BAG
from starcal_ground.mission.export import exported
from starcal_ground.mission.export.image_attitude import (
    attitude_by_stars,
    camera_of_image,
    without_outliers,
)
from starcal_ground.mission.export.request import Request
from starcal_ros.arrays import Floats
from starcal_ros.assessment.lookup import detector_sight, line_of_sight_sigma_arcsec
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD, utc_text
from starcal_ros.errors import needing, ProductError
from starcal_ros.records import Calibration, ORIGINAL, StarObservations, TIMES
from starcal_ros.sky.astrometry import julian_year
from starcal_ros.sky.catalog import load_catalog, StarCatalog

_MOST_SIP_ORDER = 9  # keywords have one digit for it
_GOOD_PX = 5e-3  # half of the centroid noise of a bright star
_MOST_DEG = 85.0  # from the middle: a gnomonic projection ends at 90 degrees
# Refraction 60 degrees from the zenith is followed to 0.03 arcsec over a field of 10 degrees, to
# 0.6 over one of 20; the rest is in STARRMS.
_MOST_ORDER_OF_SKY = 3
_TOO_WIDE = '--to wcs: the field is too wide for a gnomonic projection: use --to opencv'


def wcs_of_images(calibration: Calibration, asked: Request) -> exported.Content:
    """
    A FITS header for each image with stars.

    Raises ProductError if no image has three stars, if the catalog lacks stars of an image, or if
    the field is too wide for a gnomonic projection.  Raises CatalogError for a bad catalog.
    """
    with needing('mission', ProductError, '--to wcs'):
        from astropy.io import fits
    stated = json.loads(calibration.provenance.get('options', '{}')).get('catalog', '')
    file = asked.catalog or (Path(stated) if stated else None)
    if file is not None and not file.exists():
        raise ProductError(f'--to wcs: {file}: no such catalog; --catalog FILE states where it is')
    catalog = load_catalog(file)
    files: dict[str, bytes] = {}
    worst_px = 0.0
    for number, image in enumerate(asked.observations, 1):
        attitude = attitude_by_stars(calibration, image)
        if attitude is None:
            continue
        system = _system(calibration, image, attitude.icrf_from_camera, catalog)
        header = fits.Header(system.cards())
        if TIMES not in calibration.provenance:  # else the stamps are no times of exposure
            header['DATE-AVG'] = utc_text(image.time_ns).removesuffix(' UTC').replace(' ', 'T')
        if name := asked.image_files.get(image.time_ns):
            header['FILENAME'] = exported.ascii_line(Path(name).name), 'image of this header'
            header['HISTORY'] = exported.ascii_line(f'Coordinates of {name}')
            if digest := _digest_of(name, calibration.provenance):
                header['HISTORY'] = digest
        for line in exported.origin(calibration):
            header['COMMENT'] = exported.ascii_line(line)
        memory = io.BytesIO()
        fits.PrimaryHDU(header=header).writeto(memory)
        files[f'image{number:04d}.wcs'] = memory.getvalue()
        worst_px = max(worst_px, system.worst_px)
    if not files:
        raise ProductError('--to wcs: no image with stars among the observations')
    return exported.Content(files, worst_px)


def _digest_of(name: str, provenance: Mapping[str, str]) -> str:
    """Digest of an image file; empty without a record, or if two bags have a file of the name."""
    if f'{ORIGINAL}{name}{OF_ANOTHER_BAG}' in provenance:
        return ''
    return provenance.get(f'input {name}', '') or provenance.get(f'{ORIGINAL}{name}', '')


def directions_icrf(
    calibration: Calibration, image: StarObservations, pixels_px: ArrayLike
) -> tuple[Floats, Floats]:
    """
    Apparent directions of pixels of an image along the axes of the ICRF, by its stars.

    Parameters
    ----------
    calibration : Calibration
    image : StarObservations
        The stars of the image, as `read_observations` reads them.  ``direction_icrf`` of the
        result is apparent as theirs is, with the aberration of light and, where a site was
        stated, refraction.
    pixels_px : (n, 2)
        (u, v); the centre of the first pixel is (0, 0).

    Returns
    -------
    direction_icrf : (n, 3)
        Unit vectors; NaN as of `lines_of_sight`.
    sigma_arcsec : (n,)
        1-sigma, the root of the trace of the covariance: that of the camera, its common rotation
        removed, that of the attitude by the stars, and what the stars show the image to have of
        its own, by a camera that changes from image to image or a shutter that rolls.

    Raises
    ------
    ValueError
        For an image with fewer than three stars.

    Examples
    --------
    >>> import starcal_ground
    >>> calibration = starcal_ground.read_calibration('out')
    >>> images = starcal_ground.read_observations(['out/observations.mcap'], '/observations')
    >>> pixels_px = [[320, 256]]
    >>> direction, sigma_arcsec = starcal_ground.directions_icrf(
    ...     calibration, next(images), pixels_px
    ... )
    >>> direction.shape, bool(sigma_arcsec[0] < 5.0)
    ((1, 3), True)
    """
    attitude = attitude_by_stars(calibration, image)
    if attitude is None:
        raise ValueError('image: fewer than three stars determine no attitude')
    camera = camera_of_image(calibration, image)
    sight = detector_sight(camera, np.asarray(pixels_px, np.float64))
    directions = attitude.icrf_from_camera.apply(sight)
    turn_px2 = attitude.covariance_px2
    of_image_px2 = np.trace(turn_px2) + 2.0 * attitude.own_px2
    of_image_px2 -= np.einsum('ni,ij,nj->n', directions, turn_px2, directions)
    of_image_arcsec = np.sqrt(of_image_px2) / camera.parameters[0] / ARCSECOND_RAD
    return directions, np.hypot(
        line_of_sight_sigma_arcsec(calibration, pixels_px), of_image_arcsec
    )


@dataclass(frozen=True)
class _System:
    """
    A TAN-SIP system.

    ``centre`` (3,) is the direction of the pixel ``crpix_px`` (1, 2), the first pixel being (0, 0)
    there; ``cd`` (2, 2), rad a pixel; ``forward`` (A, B) and ``inverse`` (AP, BP) are (k, 2)
    coefficients of `_powers` from the second and the first order on; ``worst_px`` is the largest
    error of either over the detector, ``stars_px`` the rms difference of stars from their pixels,
    per axis, without outliers.
    """

    centre: Floats
    crpix_px: Floats
    cd: Floats
    order: int
    forward: Floats
    inverse: Floats
    worst_px: float
    stars_px: float

    def from_plane(self, plane: Floats) -> Floats:
        """Pixels (n, 2), from the reference pixel on, of points (n, 2) of the plane."""
        undistorted = plane @ np.linalg.inv(self.cd).T
        return np.asarray(undistorted + _powers(undistorted, self.order, 1) @ self.inverse)

    def cards(self) -> list[tuple[str, object, str]]:
        """Cards of a FITS header."""
        x, y, z = self.centre.tolist()
        ra_deg, dec_deg = math.degrees(math.atan2(y, x)), math.degrees(math.asin(z))
        cards: list[tuple[str, object, str]] = [
            ('WCSAXES', 2, ''),
            ('CTYPE1', 'RA---TAN-SIP', ''),
            ('CTYPE2', 'DEC--TAN-SIP', ''),
            ('RADESYS', 'ICRS', 'places of the catalog, at the date of the image'),
            ('CRVAL1', ra_deg % 360.0, '[deg]'),
            ('CRVAL2', dec_deg, '[deg]'),
            ('CRPIX1', float(self.crpix_px[0, 0]) + 1.0, 'the first pixel is 1'),
            ('CRPIX2', float(self.crpix_px[0, 1]) + 1.0, ''),
            ('CUNIT1', 'deg', ''),
            ('CUNIT2', 'deg', ''),
        ]
        for (i, j), value in np.ndenumerate(np.degrees(self.cd)):
            cards.append((f'CD{i + 1}_{j + 1}', float(value), ''))
        for names, coefficients, least in (
            (('A', 'B'), self.forward, 2),
            (('AP', 'BP'), self.inverse, 1),
        ):
            for name, column in zip(names, coefficients.T, strict=True):
                cards.append((f'{name}_ORDER', self.order, ''))
                cards += [
                    (f'{name}_{p}_{q}', value, '')
                    for (p, q), value in zip(
                        _exponents(self.order, least), column.tolist(), strict=True
                    )
                ]
        cards.append(('SIPERR', self.worst_px, '[px] largest error of the polynomials'))
        cards.append(('STARRMS', self.stars_px, '[px] rms of the stars, per axis'))
        return cards


def _system(
    calibration: Calibration,
    image: StarObservations,
    icrf_from_camera: Rotation,
    catalog: StarCatalog,
) -> _System:
    camera = camera_of_image(calibration, image)
    rows, known = catalog.rows_of(image.catalog_id)
    if not known.all():
        raise ProductError(
            f'--to wcs: the catalog lacks {np.count_nonzero(~known)} of {len(known)} stars of an'
            ' image: set --catalog to the file of the calibration'
        )
    places = _at_date(catalog.select(rows), image.time_ns)
    crpix_px = (np.array([[camera.width, camera.height]]) - 1.0) / 2.0
    middle = icrf_from_camera.apply(line_of_sight(camera, crpix_px[0]))
    apparent = _gnomonic(middle, image.direction_icrf)
    shift = _gnomonic(middle, places) - apparent
    if not np.isfinite(shift).all():
        raise ProductError(_TOO_WIDE)
    border = icrf_from_camera.apply(line_of_sight(camera, pixel_grid(camera, 2, 2).reshape(-1, 2)))
    order = _order_of_sky(apparent, shift, _gnomonic(middle, border), camera.parameters[0])
    to_catalog = _fitted(apparent, shift, order, 0)

    def directions(pixels: Floats) -> Floats:
        plane = _gnomonic(middle, icrf_from_camera.apply(line_of_sight(camera, pixels)))
        return _direction(middle, plane + _powers(plane, order, 0) @ to_catalog)

    # About the direction of the reference pixel: no constant is left.
    centre = directions(crpix_px)[0]
    pixels = pixel_grid(camera, exported.GRID, exported.GRID).reshape(-1, 2)
    plane = _gnomonic(centre, directions(pixels))
    if not np.isfinite(plane).all():
        raise ProductError(_TOO_WIDE)
    stars_plane = _gnomonic(centre, places)
    for sip_order in range(2, _MOST_SIP_ORDER + 1):
        system = _polynomials(centre, crpix_px, pixels - crpix_px, plane, sip_order)
        if system.worst_px < _GOOD_PX:
            break
    off_px = crpix_px + system.from_plane(stars_plane) - image.measured_px
    distance_px = np.linalg.norm(off_px, axis=1)
    good = off_px[without_outliers(distance_px)]
    return replace(system, stars_px=float(np.sqrt(np.mean(good**2))))


def _order_of_sky(apparent: Floats, shift: Floats, corners: Floats, focal_px: float) -> int:
    """
    Largest order of a polynomial through shifts (n, 2) that is as good in the corners (4, 2).

    Places of the catalog have errors of their own, and parallaxes are no polynomial: stars in a
    part of an image determine no high order in the rest of it.
    """
    for order in range(_MOST_ORDER_OF_SKY, 0, -1):
        at_stars, at_corners = _powers(apparent, order, 0), _powers(corners, order, 0)
        left, terms = shift - at_stars @ _fitted(apparent, shift, order, 0), at_stars.shape[1]
        if len(left) <= terms:
            continue
        variance = (left**2).sum() / (2 * (len(left) - terms))
        root = at_corners @ np.linalg.pinv(at_stars)
        if focal_px**2 * variance * (root**2).sum(axis=1).max() < _GOOD_PX**2:
            return order
    return 0


def _polynomials(
    centre: Floats, crpix_px: Floats, from_crpix: Floats, plane: Floats, order: int
) -> _System:
    """Fit the polynomials both ways to pixels (n, 2) and their points (n, 2) of the plane."""
    coefficients = _fitted(from_crpix, plane, order, 1)
    cd = coefficients[:2].T
    pixels_per_rad = np.linalg.inv(cd).T
    undistorted = plane @ pixels_per_rad
    inverse = _fitted(undistorted, from_crpix - undistorted, order, 1)
    forward = coefficients[2:] @ pixels_per_rad
    system = _System(centre, crpix_px, cd, order, forward, inverse, 0.0, 0.0)
    there = from_crpix + _powers(from_crpix, order, 2) @ forward - undistorted
    back = system.from_plane(plane) - from_crpix
    return replace(system, worst_px=float(max(np.abs(there).max(), np.abs(back).max())))


def _at_date(stars: StarCatalog, time_ns: int) -> Floats:
    """Unit vectors (n, 3) of the places of stars at a time, with their proper motions."""
    years = julian_year(time_ns) - stars.epoch_jyear
    ra = stars.ra_rad
    east = np.stack([-np.sin(ra), np.cos(ra), np.zeros(len(ra))], axis=-1)
    north = np.cross(stars.direction_icrs, east)
    moved = stars.direction_icrs + years * (
        east * stars.pm_ra_cosdec_rad_per_year[:, None]
        + north * stars.pm_dec_rad_per_year[:, None]
    )
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def _axes(centre: Floats) -> Floats:
    """Rows (3, 3): east, north and the direction (3,) itself."""
    east = np.cross([0.0, 0.0, 1.0], centre)
    east /= np.linalg.norm(east)  # no image is centred on a pole to the last bit
    return np.stack([east, np.cross(centre, east), centre])


def _gnomonic(centre: Floats, directions: Floats) -> Floats:
    """Gnomonic coordinates (n, 2) about a direction, rad; NaN near its horizon and behind."""
    x, y, z = (directions @ _axes(centre).T).T
    z = np.where(z > np.cos(np.radians(_MOST_DEG)), z, np.nan)
    return np.stack([x / z, y / z], axis=-1)


def _direction(centre: Floats, plane: Floats) -> Floats:
    """Unit vectors (n, 3) of gnomonic coordinates (n, 2)."""
    vectors = np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ _axes(centre)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _exponents(order: int, least: int) -> list[tuple[int, int]]:
    """Exponents of the terms of a polynomial from a least order on, lower ones first."""
    return [(n - q, q) for n in range(least, order + 1) for q in range(n + 1)]


def _powers(xy: Floats, order: int, least: int) -> Floats:
    """Terms (n, k) of a polynomial at points (n, 2)."""
    terms = [xy[:, 0] ** p * xy[:, 1] ** q for p, q in _exponents(order, least)]
    return np.stack(terms, axis=-1)


def _fitted(xy: Floats, values: Floats, order: int, least: int) -> Floats:
    """Coefficients (k, 2) of the polynomial through values (n, 2) at points (n, 2)."""
    scale = np.abs(xy).max()
    coefficients = np.linalg.lstsq(_powers(xy / scale, order, least), values, rcond=None)[0]
    degree = np.array([p + q for p, q in _exponents(order, least)])
    return np.asarray(coefficients / scale ** degree[:, None])
