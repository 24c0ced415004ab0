"""How far the light of neighbours in the catalog pulls a centroid, and what is left of it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats
from starcal_ros.identification.prediction import Prediction
from starcal_ros.image.centroiding import Centroids, ImageModel, SWAMPED_SIGMA
from starcal_ros.image.psf_fit import neighbour_pull_px, stamp_radius_px
from starcal_ros.sky.catalog import CLOSE_PAIR_RAD, StarCatalog

_PULL_UNCERTAINTY = 0.25  # of a neighbour's light: stars of unlike colour differ so from their V
_MODELLED_UNCERTAINTY = 0.05  # of that of a star measured itself: wings that are no Gaussian's
_NEAR_SIGMA = 5.0  # a bright neighbour nearer than this swamps, if it is not measured itself
_ALONE_SIGMA = 0.1  # a star whose neighbours pull it by less tells the PSF


@dataclass(frozen=True)
class Pulls:
    """
    What the neighbours of each star do to its centroid.

    ``pull_px`` (n, 2) of those whose light is not taken off; ``uncertain_px`` (n, 2) what the pull
    of all of them may be wrong by once it is taken off; ``swamped`` (n,) whether one is too near
    and too bright for that; ``outshone`` (n,) whether a brighter one is near, measured or not.
    """

    pull_px: Floats
    uncertain_px: Floats
    swamped: NDArray[np.bool_]
    outshone: NDArray[np.bool_]


def neighbour_pulls(
    xy_px: Floats,
    magnitude: Floats,
    flux_dn: Floats,
    model: ImageModel,
    modelled: NDArray[np.bool_] | None = None,
) -> Pulls:
    """
    How the neighbours of each star pull its centroid.

    ``flux_dn`` (n,) is measured, with what of a neighbour falls into it; the neighbour's follows
    from the difference of the magnitudes.  Where the two are too close to be told apart, the pull
    is from the star to the centre of their light.  The light of stars that are ``modelled`` (n,)
    is taken off already.
    """
    sigma_px = model.psf_sigma_px or 1.0
    reach_px = stamp_radius_px(sigma_px) * math.sqrt(2.0) + 2.0 * sigma_px
    pairs = cKDTree(xy_px).query_pairs(reach_px, output_type='ndarray')
    star, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    ratio = 10.0 ** (0.4 * (magnitude[star] - magnitude[other]))
    flux = np.maximum(flux_dn[star], 1.0)
    offset_px = xy_px[other] - xy_px[star]
    distance_px = np.linalg.norm(offset_px, axis=1)
    known = np.zeros(len(star), bool) if modelled is None else modelled[other]
    # What two Gaussians have in common: all the light of one that stands behind the other.
    within = np.where(known, 0.0, np.exp(-((0.5 * distance_px / sigma_px) ** 2)))
    own_flux = flux / (1.0 + ratio * within)
    pull_px = neighbour_pull_px(
        own_flux,
        offset_px,
        ratio * own_flux,
        sigma_px,
        model.background.noise_dn,
        model.pixel_noise,
    )
    total_px, uncertain_px = np.zeros_like(xy_px), np.zeros_like(xy_px)
    np.add.at(total_px, star[~known], pull_px[~known])
    part = np.where(known, _MODELLED_UNCERTAINTY, _PULL_UNCERTAINTY)
    np.add.at(uncertain_px, star, part[:, None] * pull_px)
    # A neighbour half as bright takes part of the window for itself: no small pull any more.  Nor
    # is the centre of a double of like stars used: their orbits, which no catalog of places has,
    # move it by arcseconds (zeta Herculis).
    near = distance_px < np.where(known, SWAMPED_SIGMA, _NEAR_SIGMA) * sigma_px
    swamped, outshone = np.zeros((2, len(xy_px)), bool)
    swamped[star[near & (ratio > 0.5)]] = True
    outshone[star[(distance_px < _NEAR_SIGMA * sigma_px) & (ratio > 1.0)]] = True
    return Pulls(total_px, uncertain_px, swamped, outshone)


def unlisted_pull_px(magnitude: Floats, faintest: float, px_per_rad: float) -> Floats:
    """
    1-sigma per axis (n,) of the pull of a close companion that the catalog has not.

    It is fainter than the faintest star there, and anywhere within `CLOSE_PAIR_RAD`: on average
    0.58 of that away, with 0.65 of the light that it may have (one magnitude and less), and half
    of the square along each axis.
    """
    ratio = 10.0 ** (0.4 * np.minimum(magnitude - faintest, 0.0))
    return np.asarray(0.58 * 0.65 * math.sqrt(0.5) * CLOSE_PAIR_RAD * px_per_rad * ratio)


def _alone(direction: Floats, asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which (n,) of the directions (n, 3) asked for have no other within `CLOSE_PAIR_RAD`."""
    alone = asked.copy()
    near = direction[asked] @ direction.T > math.cos(CLOSE_PAIR_RAD)
    alone[asked] = np.count_nonzero(near, axis=1) == 1  # itself
    return alone


def separate(
    prediction: Prediction,
    catalog: StarCatalog,
    centroids: Centroids,
    model: ImageModel,
    max_blend_sigma: float,
) -> tuple[Centroids, NDArray[np.bool_]]:
    """
    Centroids freed from the light of their neighbours in the catalog, or refused as blends.

    The pull is taken off, and what it may be wrong by is added to the covariance; where that is
    more than ``max_blend_sigma`` the star is of no use.  So it is with the pull of companions that
    the catalog marks but does not hold.  Also says (n,) which stars stand alone.
    """
    magnitude = catalog.magnitude[prediction.catalog_index]
    pulls = neighbour_pulls(
        prediction.xy_px, magnitude, centroids.flux_dn, model, centroids.modelled
    )
    unlisted = _alone(prediction.direction_icrf, catalog.close_pair[prediction.catalog_index])
    faintest = float(catalog.magnitude[-1])
    unlisted_px = np.where(
        unlisted, unlisted_pull_px(magnitude, faintest, prediction.px_per_rad), 0.0
    )
    sigma_px = np.sqrt(0.5 * (centroids.covariance_px2[:, 0] + centroids.covariance_px2[:, 2]))
    size_px = np.sqrt((pulls.uncertain_px**2).sum(axis=1) + 2.0 * unlisted_px**2)
    beyond = size_px > max_blend_sigma * sigma_px
    refusal = centroids.refusal.copy()
    refusal[(pulls.swamped | beyond) & (refusal == '')] = 'blend'
    # Its light was taken for that of the brighter one.
    refusal[pulls.outshone & (refusal == 'faint')] = 'blend'
    u, v = pulls.uncertain_px.T
    separated = dataclasses.replace(
        centroids,
        xy_px=centroids.xy_px - pulls.pull_px,
        covariance_px2=centroids.covariance_px2
        + np.stack([u * u + unlisted_px**2, u * v, v * v + unlisted_px**2], axis=-1),
        refusal=refusal,
    )
    return separated, size_px < _ALONE_SIGMA * sigma_px
