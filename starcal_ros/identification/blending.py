# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Correction of centroids for catalog neighbours, and refusal of blended stars."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Mask
from starcal_ros.identification.prediction import in_image, Prediction
from starcal_ros.records import StarRefusal
from starcal_ros.sky.catalog import CLOSE_PAIR_RAD, StarCatalog
from starcal_ros.stars.centroiding import Centroids, SWAMPED_SIGMA
from starcal_ros.stars.image_model import ImageModel
from starcal_ros.stars.pixel_noise import expected_snr
from starcal_ros.stars.psf_fit import apart_px, neighbour_pull_px, stamp_radius_px

_PULL_UNCERTAINTY = 0.25  # relative, of a neighbour's flux from its V magnitude: colours differ
_MODELLED_UNCERTAINTY = 0.05  # relative, of a measured neighbour's flux: the PSF is not Gaussian
_NEAR_SIGMA = 5.0  # distance to a bright unmeasured neighbour below which a star is swamped
_NEGLIGIBLE = 0.02  # in sigmas of a centroid: a pull estimated to be smaller is not computed
MAX_BLEND_SIGMA = 3.0  # largest uncertainty by neighbours, in sigmas of the centroid
_ALONE_SIGMA = 0.1  # stars pulled by less than this are used to fit the PSF


@dataclass(frozen=True)
class Pulls:
    """
    Effect of the neighbours of each star on its centroid.

    ``pull_px`` (n, 2) pull by neighbours whose light is not subtracted; ``uncertain_px`` (n, 2)
    uncertainty of the pull by all neighbours after correction; ``swamped`` (n,) True if a
    neighbour is too near and too bright for a correction; ``outshone`` (n,) True if a brighter
    neighbour is near, measured or not.
    """

    pull_px: Floats
    uncertain_px: Floats
    swamped: Mask
    outshone: Mask


def neighbour_pulls(
    xy_px: Floats,
    magnitude: Floats,
    flux_dn: Floats,
    model: ImageModel,
    modelled: Mask,
    measured: Mask,
    inside: Mask,
) -> Pulls:
    """
    Pull of the neighbours, all of ``xy_px`` (n + k, 2), on the centroids of the first n of them.

    ``flux_dn`` (n,) is measured and includes light of neighbours; the flux of a neighbour follows
    from the difference of the magnitudes.  For an unresolved pair the pull is from the star to the
    common centre of light.  The light of ``modelled`` (n,) stars is already subtracted.  Only the
    ``measured`` (n,) stars get a pull: most stars of a wide field are too faint to be measured.
    Of a neighbour that is not ``inside`` (n + k,) the image the border may cut off all the light
    or none: half of its pull is taken, with as large an uncertainty.
    """
    sigma_px = model.psf_sigma_px or 1.0
    radius_px = stamp_radius_px(sigma_px, model.longest_streak_px)
    reach_px = radius_px * math.sqrt(2.0) + 2.0 * model.extent_px
    pairs = cKDTree(xy_px).query_pairs(reach_px, output_type='ndarray')
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    star, other = pairs[pairs[:, 0] < len(flux_dn)].T
    ratio = 10.0 ** (0.4 * (magnitude[star] - magnitude[other]))
    offset_px = xy_px[other] - xy_px[star]
    distance_px = apart_px(offset_px, sigma_px, model.streaks_at(xy_px[star]))
    known = np.r_[modelled, np.zeros(len(xy_px) - len(modelled), bool)][other]
    # A neighbour half as bright or more dominates part of the window: the pull is not small.  The
    # centre of a double of similar stars is not used either: its orbital motion, which the catalog
    # lacks, reaches arcseconds (zeta Herculis).
    near = distance_px < np.where(known, SWAMPED_SIGMA, _NEAR_SIGMA) * sigma_px
    swamped, outshone = np.zeros((2, len(flux_dn)), bool)
    swamped[star[near & (ratio > 0.5)]] = True
    outshone[star[(distance_px < _NEAR_SIGMA * sigma_px) & (ratio > 1.0)]] = True
    snr = expected_snr(flux_dn, model.blurred_px, model.background.noise_dn, model.pixel_noise)
    least_px = _NEGLIGIBLE * sigma_px / np.maximum(snr, 1.0)
    about_px = ratio * distance_px * np.exp(-((0.5 * distance_px / sigma_px) ** 2))
    # In photon noise the core of a bright star weighs less, and so the wings more.
    peak_dn = np.maximum(flux_dn, 0.0) / (2.0 * math.pi * sigma_px**2)
    noise_dn2 = model.pixel_noise.gain_e_per_dn * model.background.noise_dn**2
    about_px *= 1.0 + (peak_dn / noise_dn2)[star]
    matters = measured[star] & (about_px > least_px[star])
    star, ratio, known = star[matters], ratio[matters], known[matters]
    offset_px, distance_px = offset_px[matters], distance_px[matters]
    flux = np.maximum(flux_dn[star], 1.0)
    # Share of the neighbour's light in the measured flux: the overlap of two Gaussians.
    within = np.where(known, 0.0, np.exp(-((0.5 * distance_px / sigma_px) ** 2)))
    own_flux = flux / (1.0 + ratio * within)
    whole = inside[other[matters]]
    pull_px = np.where(whole, 1.0, 0.5)[:, None] * neighbour_pull_px(
        own_flux,
        offset_px,
        ratio * own_flux,
        sigma_px,
        model.background.noise_dn,
        model.pixel_noise,
        model.streaks_at(xy_px[star]),
    )
    total_px, uncertain_px = np.zeros((2, len(flux_dn), 2))
    np.add.at(total_px, star[~known], pull_px[~known])
    part = np.where(known, _MODELLED_UNCERTAINTY, np.where(whole, _PULL_UNCERTAINTY, 1.0))
    np.add.at(uncertain_px, star, part[:, None] * pull_px)
    return Pulls(total_px, uncertain_px, swamped, outshone)


def unlisted_pull_px(magnitude: Floats, faintest: float, px_per_rad: float) -> Floats:
    """
    1-sigma per axis (n,) of the pull of a close companion that is not in the catalog.

    The companion is fainter than the catalog limit and anywhere within `CLOSE_PAIR_RAD`: on
    average at 0.58 of that distance, with 0.65 of its largest possible flux, and half of the
    square along each axis.
    """
    ratio = 10.0 ** (0.4 * np.minimum(magnitude - faintest, 0.0))
    return np.asarray(0.58 * 0.65 * math.sqrt(0.5) * CLOSE_PAIR_RAD * px_per_rad * ratio)


def _alone(direction: Floats, tested: Mask) -> Mask:
    """Mask (n,) of the tested directions (n, 3) without another one within `CLOSE_PAIR_RAD`."""
    alone = tested.copy()
    near = direction[tested] @ direction.T > math.cos(CLOSE_PAIR_RAD)
    alone[tested] = np.count_nonzero(near, axis=1) == 1  # itself
    return alone


def separate(
    prediction: Prediction,
    catalog: StarCatalog,
    centroids: Centroids,
    model: ImageModel,
    unmeasured: tuple[Floats, Floats],
) -> tuple[Centroids, Mask]:
    """
    Centroids corrected for catalog neighbours, and a mask (n,) of the isolated stars.

    ``unmeasured`` are pixels (k, 2) and magnitudes (k,) of other neighbours: below the magnitude
    limit, and beyond the border.

    The pull is subtracted and its uncertainty added to the covariance; a star with an uncertainty
    above `MAX_BLEND_SIGMA` is refused as a blend.  The same applies to close companions that the
    catalog flags but does not list.
    """
    magnitude = catalog.magnitude[prediction.catalog_index]
    # The search for lost lines also uses the stars measured far from their predictions.
    reason = centroids.refusal
    measured = (reason == StarRefusal.NONE) | (reason == StarRefusal.NOT_DETECTED)
    unmeasured_px, unmeasured_magnitude = unmeasured
    xy_px = np.concatenate([prediction.xy_px, unmeasured_px])
    pulls = neighbour_pulls(
        xy_px,
        np.concatenate([magnitude, unmeasured_magnitude]),
        centroids.flux_dn,
        model,
        centroids.modelled,
        measured,
        in_image(xy_px, prediction.camera),
    )
    unlisted = _alone(prediction.direction_icrf, catalog.close_pair[prediction.catalog_index])
    faintest = float((catalog.deeper or catalog).magnitude[-1])
    unlisted_px = np.where(
        unlisted, unlisted_pull_px(magnitude, faintest, prediction.px_per_rad), 0.0
    )
    size_px = np.sqrt((pulls.uncertain_px**2).sum(axis=1) + 2.0 * unlisted_px**2)
    beyond = size_px > MAX_BLEND_SIGMA * centroids.sigma_px
    refusal = centroids.refusal.copy()
    refusal[(pulls.swamped | beyond) & (refusal == StarRefusal.NONE)] = StarRefusal.BLEND
    # Its light was attributed to the brighter star.
    refusal[pulls.outshone & (refusal == StarRefusal.FAINT)] = StarRefusal.BLEND
    u, v = pulls.uncertain_px.T
    separated = dataclasses.replace(
        centroids,
        xy_px=centroids.xy_px - pulls.pull_px,
        covariance_px2=centroids.covariance_px2
        + np.stack([u * u + unlisted_px**2, u * v, v * v + unlisted_px**2], axis=-1),
        refusal=refusal,
    )
    return separated, size_px < _ALONE_SIGMA * centroids.sigma_px
