"""
Variance components: what the residuals say of the sigmas that the estimate was given.

So that the reported covariance is true, the variance of the centroids and that of the star tracker
are estimated again from what is left after the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from scipy.optimize import nnls
from scipy.special import chdtr

from starcal_ros.arrays import Floats, Mask

_STARS_PER_GROUP = 40  # whose median squared residual is known to 25 %
_FEWEST_IMAGES = 3  # from which their scatter can contradict a sigma, or one of them the others
_MISFIT_SIGMA = 6.0  # of an attitude: one in 10^8 by chance, and a jump is far larger
_GIVEN_CHANCE = 0.01  # of contradicting a sigma that is right
_MEDIAN_OF_SQUARE = 0.4549  # median of chi^2 with one degree of freedom


@dataclass(frozen=True)
class CentroidVariance:
    """
    What the residuals say of the centroid covariances C: they are ``scale C + floor_px2 I``.

    The floor stands for what a centroid does not know of: the real shape of the PSF, the catalog,
    the air.  The scale is a wrong detector gain, or the excess of faint stars over their bound.
    """

    scale: float
    floor_px2: float

    def of(self, covariance_px2: Floats) -> Floats:
        """Covariances (n, 3) uu, uv, vv as the residuals have them."""
        return self.scale * covariance_px2 + self.floor_px2 * np.array([1.0, 0.0, 1.0])

    def is_close_to(self, other: CentroidVariance) -> bool:
        """Whether a weight changes by under 1 %, which moves no estimate by 0.001 sigma."""
        return math.isclose(self.scale, other.scale, rel_tol=0.01) and math.isclose(
            self.floor_px2, other.floor_px2, rel_tol=0.01, abs_tol=1e-8
        )


def estimate_variance(
    residual_px: Floats, covariance_px2: Floats, kept: Mask, freedom: float
) -> CentroidVariance:
    """
    Scale and floor that make the centroid covariances those of the residuals.

    The kept stars are ranked by their own variance and cut into groups; the median squared
    residual of a group, which outliers do not move, is its variance; scale and floor are the
    non-negative line through the groups.  ``freedom`` is the share of the residuals' degrees of
    freedom that the fit has left them.
    """
    own = 0.5 * (covariance_px2[kept, 0] + covariance_px2[kept, 2])
    squared = (residual_px[kept] ** 2).sum(axis=1)
    groups = int(np.clip(len(own) // _STARS_PER_GROUP, 1, 12))
    parts = np.array_split(np.argsort(own, kind='stable'), groups)
    mean_own = np.array([own[part].mean() for part in parts])

    def found(scale: float, floor_px2: float) -> Floats:
        # Within a group variances differ: the model of them says what the median stands for.
        model = np.maximum(scale * own + floor_px2, 1e-12)
        # The median of a squared Rayleigh deviate is 2 ln 2 variances per axis.
        medians = [np.median(squared[part] / model[part]) * model[part].mean() for part in parts]
        return np.array(medians) / (2 * math.log(2.0) * freedom)

    if groups < 3 or mean_own[-1] < 2.0 * mean_own[0]:
        # Scale and floor cannot be told apart: a floor when there is an excess, else a scale.
        variance = found(1.0, 0.0)
        excess = float((variance - mean_own).mean())
        if excess >= 0.0:
            return CentroidVariance(1.0, excess)
        return CentroidVariance(float(np.clip((variance / mean_own).mean(), 0.1, 1.0)), 0.0)
    scale, floor_px2 = 1.0, 0.0
    for _ in range(8):
        weight = 1.0 / np.maximum(scale * mean_own + floor_px2, 1e-12)
        A = np.stack([mean_own, np.ones(groups)], axis=-1) * weight[:, None]
        (scale, floor_px2), _ = nnls(A, found(scale, floor_px2) * weight)
        scale = max(float(scale), 0.1)
    return CentroidVariance(scale, float(floor_px2))


def estimate_star_tracker_sigma(
    eta_rad: Floats, covariance_rad2: Floats, seen: Mask, given_rad: Floats, fitted: int = 1
) -> tuple[Floats, Mask]:
    """
    1-sigma of the star tracker about its axes, and which attitudes do not fit.

    Parameters
    ----------
    eta_rad, covariance_rad2, seen : (m, 3), (m, 3, 3), (m,)
        Attitude errors as the stars alone show them (`problem.attitudes_of_stars_alone`).
    given_rad : (3,)
        What the star tracker is said to have; kept where fewer than three images tell otherwise.
    fitted : int
        Numbers for each axis that were taken from the attitudes: mean, and slope where there is.

    Returns
    -------
    sigma_rad : (3,)
    misfit : (m,) bool
        Beyond 6 sigma about any axis, of what was given and of what the images show.

    Notes
    -----
    What was given stands as long as the scatter of the images does not contradict it (1 %): a
    dozen images know a sigma to 20 %.  Else the stars' own variance is taken off the scatter;
    where nothing is left, the star tracker is better than the stars can tell, and what their
    scatter could hide is an upper limit.
    """
    own = np.einsum('mii->mi', covariance_rad2)
    if np.count_nonzero(seen) < _FEWEST_IMAGES + fitted - 1:
        return given_rad, np.zeros_like(seen)
    centred = eta_rad - np.median(eta_rad[seen], axis=0)
    spread2 = np.median(centred[seen] ** 2, axis=0) / _MEDIAN_OF_SQUARE
    # The spread of a dozen images may come out small by half: what was given bounds it too.
    usual = np.maximum(np.maximum(spread2, given_rad**2), own)
    misfit = seen & (centred**2 > _MISFIT_SIGMA**2 * usual).any(axis=1)
    if 3 * np.count_nonzero(misfit) > np.count_nonzero(seen):
        # No majority that the others could misfit: they scatter more than was thought.
        misfit = np.zeros_like(seen)
    good = seen & ~misfit
    count = int(np.count_nonzero(good))
    stars = own[good].mean(axis=0)
    freedom = count - fitted
    found = eta_rad[good].var(axis=0, ddof=fitted)
    chance = chdtr(freedom, freedom * found / (given_rad**2 + stars))
    as_given = (chance > _GIVEN_CHANCE / 2) & (chance < 1 - _GIVEN_CHANCE / 2)
    hidden = stars * math.sqrt(2.0 / count)
    sigma2 = np.where(found - stars > hidden, found - stars, np.minimum(hidden, given_rad**2))
    return np.sqrt(np.where(as_given, given_rad**2, sigma2)), misfit
