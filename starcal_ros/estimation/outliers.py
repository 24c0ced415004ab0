# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Stars and attitudes that do not fit the others.

An error is compared with its variance given the others, less the part that the unknowns absorb.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, stdtrit

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation.shared_errors import Groups
from starcal_ros.estimation.star_equations import squared_sigmas, StarTable

FEWEST_STARS = 3  # the rotation of an image fits one star exactly and two nearly
_FEWEST_SIGHTINGS = 3  # sightings that separate the error of a star from those of its images
_STAR_CHANCE = 1e-7  # probability that the sum of its residuals drops a good star
_FEWEST_ATTITUDES = 3  # two show that one of them is wrong, but not which
_MISFIT_SIGMA = 6.0  # noise exceeds it once in 10^8 attitudes, and a jump is far larger
_EFFICIENCY = 0.37  # efficiency of a variance from the median of squares, normal errors
_CHANCE = 1e-5  # probability that a good attitude lies beyond the limit
_MEDIAN_OF_SQUARE = 0.4549  # median of chi^2 with one degree of freedom


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
    bad = (2 * misses > sightings) | (summed > chdtri(2 * sightings, _STAR_CHANCE) * largest)
    fits &= ~(bad & (sightings >= _FEWEST_SIGHTINGS))[star]
    left = np.bincount(table.image[fits], minlength=table.image_count)
    return np.asarray(fits & (left[table.image] >= FEWEST_STARS))


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
    return np.asarray(np.unique(table.catalog_id)[(sightings >= _FEWEST_SIGHTINGS) & (uses == 0)])


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
    Beyond 6 sigma about an axis off the median, both of the stated sigma and of the scatter of the
    images: a star tracker that drifts has no misfits.  Where the sigma is a guess, the scatter of
    few images alone is uncertain: the limit is that of Student's t if it is larger.  If more than
    a third would be misfits, the majority is unclear, and none is reported.
    """
    misfit: Mask = np.zeros(len(seen), bool)
    for k in np.unique(star_tracker[seen]):
        here = seen & (star_tracker == k)
        if np.count_nonzero(here) < _FEWEST_ATTITUDES:
            continue
        left = error[here] - np.median(error[here], axis=0)
        spread2 = np.median(left**2, axis=0) / _MEDIAN_OF_SQUARE
        # The spread of a dozen images may be small by half: the stated sigma bounds it too.
        usual = np.maximum(np.maximum(spread2, 1.0), variance[here])
        freedom = _EFFICIENCY * (np.count_nonzero(here) - 1)
        limit = max(_MISFIT_SIGMA, 0.0 if is_stated else float(stdtrit(freedom, 1.0 - _CHANCE)))
        found = (left**2 > limit**2 * usual).any(axis=1)
        if 3 * np.count_nonzero(found) <= np.count_nonzero(here):
            misfit[here] = found
    return misfit
