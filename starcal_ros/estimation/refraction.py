# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Refraction as unknowns: its size, the latitude of the site and the sidereal time of each image.

They are unknown where the observations state a zenith, by a site and its clock or by the stars
(`sky.astrometry`).  All images are of one site: their zeniths have one declination.  Where the
site is stated, or they run as the stamps do, the sidereal times have one error.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats, Indices
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.estimation.tracker_errors import groups_of
from starcal_ros.sky.astrometry import LEAST_COSINE, SIDEREAL_RAD_S

ZENITH_SIGMA_RAD = 1.0  # latitude and sidereal time may be any that have the stars in their sky
STATED_SITE_RAD = 0.01  # a site is stated to 60 km, and a clock to two minutes
_ONE_CLOCK_RAD = 1e-6  # sidereal times that run as the stamps do differ by rounding alone


@dataclass(frozen=True)
class Refraction:
    """
    Stamps (m,) and zeniths (m, 3) of images, and the size of refraction with its 1-sigma.

    The size is that at a zenith distance of 45 degrees; ``site_sigma_rad`` is the 1-sigma of
    latitude and sidereal time.
    """

    time_ns: NDArray[np.int64]
    zenith_icrf: Floats
    size_arcsec: float
    sigma_arcsec: float
    site_sigma_rad: float = ZENITH_SIGMA_RAD

    @functools.cached_property
    def times(self) -> Indices:
        """Number (m,) of the error of the sidereal time of each image; neighbours share one."""
        m = len(self.zenith_icrf)
        right_ascension = np.arctan2(self.zenith_icrf[:, 1], self.zenith_icrf[:, 0])
        late_s = (self.time_ns - self.time_ns[0]) / NANOSECONDS_PER_SECOND
        off = np.exp(1j * (right_ascension - right_ascension[0] - SIDEREAL_RAD_S * late_s))
        is_stated = self.site_sigma_rad < ZENITH_SIGMA_RAD
        if is_stated or np.abs(off - 1.0).max() < _ONE_CLOCK_RAD:
            return np.zeros(m, np.int64)
        return groups_of(self.time_ns)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the unknowns of the site."""
        times = range(int(self.times.max()) + 1)
        return ('latitude_rad', *(f'sidereal_time_{k + 1}_rad' for k in times))

    def by_size(
        self, camera_from_icrf: Floats, pixels: Floats, directions: Floats, image: Indices
    ) -> Floats:
        """Small rotations (3, 1, n) of stars by the size of refraction, per arcsec."""
        del pixels
        zenith = np.einsum('mij,mj->im', camera_from_icrf, self.zenith_icrf)[:, image]
        turn = np.cross(zenith, directions, axis=0) / _cosine(zenith, directions)
        return np.asarray(ARCSECOND_RAD * turn[:, None])

    def by_site(
        self, camera_from_icrf: Floats, pixels: Floats, directions: Floats, image: Indices
    ) -> Floats:
        """Small rotations (3, q, n) of stars by latitude and sidereal times, per rad."""
        del pixels
        pole = np.array([0.0, 0.0, 1.0])
        east = np.cross(pole, self.zenith_icrf)
        north = np.cross(self.zenith_icrf, east)
        north /= np.maximum(np.linalg.norm(north, axis=1, keepdims=True), 1e-9)
        zenith, by_latitude, by_time = (
            np.einsum('mij,mj->im', camera_from_icrf, axis)[:, image]
            for axis in (self.zenith_icrf, north, east)
        )
        cosine = _cosine(zenith, directions)
        turns = np.zeros((3, len(self.labels), directions.shape[1]))
        for row, change in ((0, by_latitude), (1 + self.times[image], by_time)):
            moved = change - zenith * (np.sum(change * directions, axis=0) / cosine)
            turn = np.cross(moved, directions, axis=0) / cosine
            turns[:, row, np.arange(len(cosine))] = turn
        return self.size_arcsec * ARCSECOND_RAD * turns


def _cosine(zenith: Floats, directions: Floats) -> Floats:
    """Cosines (n,) of zenith distances, at least `LEAST_COSINE`."""
    return np.asarray(np.maximum(np.sum(zenith * directions, axis=0), LEAST_COSINE))
