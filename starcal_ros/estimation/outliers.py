# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Stars and attitudes that do not fit the others.

An error is compared with its variance given the others, less the part that the unknowns absorb.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, ndtri, stdtrit

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation.limits import FALSE_ALARM_RATE, FEWEST
from starcal_ros.estimation.shared_errors import Groups
from starcal_ros.estimation.star_equations import squared_sigmas, StarTable

QUARTILE = float(ndtri(0.75))  # median size of normal errors of unit variance
# With the limit of normal errors, 4.5 to 5, one of six attitudes was a misfit where data sheets
# state far too little (test_worlds.py); a jump is far larger.
_MISFIT_SIGMA = 6.0


def fitting_stars(
    residual_px: Floats,
    covariance_px2: Floats,
    star_px2: Floats | float,
    table: StarTable,
    cells: Groups,
    outlier_sigma: float,
) -> Mask:
    """
    Return (n,) which observations are used.

    Not an outlier, unless other stars at this place of the detector show the same, which is then
    the lens; not of a star that is one in most of its images, or whose residuals together are too
    large (a wrong catalog place, a planet); and in an image that has enough of the others.

    Parameters
    ----------
    residual_px, covariance_px2 : (n, 2), (n, 3)
    star_px2 : (n,) or float
        Variance per axis that sightings of a star share.
    cells : Groups
        Parts of the detector.
    """
    length2 = squared_sigmas(residual_px, covariance_px2)
    beside2 = _squared_beside(residual_px, covariance_px2, length2, cells, outlier_sigma)
    length2 = np.minimum(length2, beside2)
    fits = length2 < outlier_sigma**2
    star = table.star
    sightings = np.bincount(star)
    misses = np.bincount(star, ~fits)
    # The variance of each sighting has the error that all share, but it is only one error.
    own = 0.5 * (covariance_px2[:, 0] + covariance_px2[:, 2])
    share = np.minimum(star_px2 / own, 1.0)
    largest = np.bincount(star, share) / sightings * (sightings - 1) + 1.0
    summed = np.bincount(star, np.where(fits, length2, 0.0))
    judged = sightings >= FEWEST
    chance = FALSE_ALARM_RATE / max(int(np.count_nonzero(judged)), 1)
    bad = (2 * misses > sightings) | (summed > chdtri(2 * sightings, chance) * largest)
    fits &= ~(bad & judged)[star]
    left = np.bincount(table.image[fits], minlength=table.image_count)
    return np.asarray(fits & (left[table.image] >= FEWEST))


def _squared_beside(
    residual_px: Floats, covariance_px2: Floats, length2: Floats, cells: Groups, limit: float
) -> Floats:
    """
    Squared sigmas (n,) from the mean residual of other stars in the same cell of the detector.

    Their residuals are cut at the limit, and the observation itself counts as a zero: a lone
    neighbour, or a wrong one among several, moves the mean little.
    """
    weight = 2.0 / (covariance_px2[:, 0] + covariance_px2[:, 2])
    cut = np.minimum(1.0, limit / np.sqrt(np.maximum(length2, 1e-30)))
    total = np.bincount(cells.group, weight)[cells.group]
    shared = np.empty_like(residual_px)
    for axis in (0, 1):
        each = weight * cut * residual_px[:, axis]
        shared[:, axis] = np.bincount(cells.group, each)[cells.group] / total
        if cells.of_one_star is not None:
            shared[:, axis] -= np.bincount(cells.of_one_star, each)[cells.of_one_star] / total
    return squared_sigmas(residual_px - shared, covariance_px2)


def dropped_stars(table: StarTable, kept: Mask) -> NDArray[np.int64]:
    """Return the catalog stars with enough sightings that are left out of all images."""
    sightings, uses = np.bincount(table.star), np.bincount(table.star, kept)
    return np.asarray(np.unique(table.catalog_id)[(sightings >= FEWEST) & (uses == 0)])


def misfit_images(
    error: Floats,
    variance: Floats,
    seen: Mask,
    star_tracker: Indices,
    is_stated: bool,
) -> Mask:
    """
    Return (m,) the images whose attitude does not fit the others of its star tracker.

    Parameters
    ----------
    error, variance : (m, 3)
        Attitude errors as the stars show them, in the stated sigma of each axis, and their
        variances by the centroids.
    seen : (m,) bool
        Images with enough stars.
    is_stated : bool
        False where the stated sigma is a guess.

    Notes
    -----
    Farther off the median about an axis than noise is by chance, both that of the stated sigma and
    that of the scatter of the images: a star tracker that drifts has no misfits.  The limit is 6
    sigma where a sigma is stated.  Where it is a guess, the scatter of few images alone is
    uncertain: the limit is that of Student's t.  If more than a third would be misfits, the
    majority is unclear, and none is reported.
    """
    misfit: Mask = np.zeros(len(seen), bool)
    # Efficiency of the variance of normal errors from the median of their squares, against that
    # from the mean of their squares.
    efficiency = 8.0 * (QUARTILE * math.exp(-0.5 * QUARTILE**2)) ** 2 / (2.0 * math.pi)
    for k in np.unique(star_tracker[seen]):
        here = seen & (star_tracker == k)
        m = np.count_nonzero(here)
        if m < FEWEST:
            continue
        left = error[here] - np.median(error[here], axis=0)
        spread2 = np.median(left**2, axis=0) / QUARTILE**2
        # The spread of a dozen images may be small by half: the stated sigma bounds it too.
        usual = np.maximum(np.maximum(spread2, 1.0), variance[here])
        limit = _MISFIT_SIGMA
        if not is_stated:
            chance = 0.5 * FALSE_ALARM_RATE / (3 * m)  # each side of each axis
            limit = -float(stdtrit(efficiency * (m - 1), chance))
        found = (left**2 > limit**2 * usual).any(axis=1)
        if 3 * np.count_nonzero(found) <= m:
            misfit[here] = found
    return misfit
