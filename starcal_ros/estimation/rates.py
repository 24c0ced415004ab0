# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Angular rates of the camera at its images, and their errors.

A rate is measured by a star tracker with noise, or not at all.  Its error times the time of
read-out turns the camera from the first row to the last: three unknowns of each image.  The time
is an unknown too: its root mean square, by its prior and then by the posterior of the round
before, stands for it.  An offset of the stamps times the error of a rate is a hundredth of the
noise of the star tracker that gave the rate, which is estimated anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.records import StarObservations

UNKNOWN_RATE_RAD_S = 1e-3  # of a camera that looks at the Earth from a low orbit
_SHORTEST_GAP_S = 0.1  # between the samples of a rate whose sender states neither sigma nor gap
_LEAST_RAD2_S2 = 1e-18  # variance of a rate: a milliarcsecond in five seconds
_FEWEST_RATES = 3  # whose scatter bounds the sigma that a sender does not state


@dataclass(frozen=True)
class Rates:
    """
    Rates of images, and the time of read-out by which their errors turn the camera.

    The error of the rate of image k is ``root[k] z`` with z of unit variance.

    Attributes
    ----------
    rad_s : (m, 3)
        NaN where no image has one.
    root_rad_s : (m, 3, 3)
    readout_s : float
        Root mean square of the time of read-out.
    """

    rad_s: Floats
    root_rad_s: Floats
    readout_s: float = 0.0

    def turned(self, camera_from_star_tracker: Rotation, readout_s: float) -> Rates:
        """Return rates in the star tracker frame in that of the camera."""
        matrix = camera_from_star_tracker.as_matrix()
        return Rates(self.rad_s @ matrix.T, matrix @ self.root_rad_s, readout_s)


def measured_rates(images: Sequence[StarObservations], tracker_sigma_rad: Floats) -> Rates:
    """
    Return the rates of images in the frame of the star tracker, with their errors.

    Rates that differ by their errors would seem to show that there is no time of read-out, since
    the stars do not differ with them (errors in variables).  So a rate moves to the mean of all by
    as much as its error is of their scatter; an image without a rate has the mean.  The errors of
    the images are not lowered for it: together they are the error of the mean.

    A sigma that is not stated is that of two samples of a star tracker of sigma (3,), at most the
    scatter of the rates.
    """
    m = len(images)
    rate = np.array([image.star_tracker_rate_rad_s for image in images])
    sigma = np.array([image.star_tracker_rate_sigma_rad_s for image in images])
    gap_s = np.array([image.attitude_gap_s for image in images])
    known = np.isfinite(rate).all(axis=1)
    if not known.any():
        return Rates(rate, np.zeros((m, 3, 3)))
    several = np.count_nonzero(known) > 1
    scatter = np.cov(rate[known].T) if several else np.zeros((3, 3))
    between = math.sqrt(2.0) * tracker_sigma_rad / np.fmax(gap_s, _SHORTEST_GAP_S)[:, None]
    if np.count_nonzero(known) >= _FEWEST_RATES:
        between = np.minimum(between, np.sqrt(np.diag(scatter)))
    own = np.where(sigma > 0, sigma, between)[:, :, None] ** 2 * np.eye(3)
    # What their errors may make of the scatter at 2 sigma is no difference between rates.
    likely = 1.0 + 2.0 * math.sqrt(2.0 / max(np.count_nonzero(known) - 1, 1))
    values, vectors = np.linalg.eigh(scatter - likely * own[known].mean(axis=0))
    without_errors = (vectors * values.clip(0.0)) @ vectors.T
    own[~known] = without_errors + UNKNOWN_RATE_RAD_S**2 * np.eye(3)
    weight = known / (np.trace(without_errors) + np.einsum('mii->m', own) + _LEAST_RAD2_S2)
    mean = (weight @ np.where(known[:, None], rate, 0.0)) / weight.sum()
    off = np.where(known[:, None], rate - mean, 0.0)
    total = without_errors + own + _LEAST_RAD2_S2 * np.eye(3)
    shrunk = np.linalg.solve(total, off[:, :, None])[:, :, 0] @ without_errors
    root = np.asarray(np.linalg.cholesky(own + _LEAST_RAD2_S2 * np.eye(3)))
    return Rates(mean + shrunk, root)
