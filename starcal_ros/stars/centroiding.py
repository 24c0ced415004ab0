# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Star centroids with covariance, by moments (Eqs. 8, 9) or by PSF fits.

The moment method is that of the paper; the fit goes beyond it.  Both use the PSF, the pixel noise
and the saturation level of `image_model`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Indices, Mask, Pixels, Rows, rows_of
from starcal_ros.records import StarRefusal
from starcal_ros.robust_statistics import centre_and_scatter, MAD_TO_SIGMA, medians
from starcal_ros.stars import detection, psf_fit
from starcal_ros.stars.hot_pixels import CORE_PX, hot_in_stamps, lit_alone, NO_HOT_PIXELS
from starcal_ros.stars.image_model import (
    BRIGHT_SNR,
    CentroidOptions,
    FEWEST_BRIGHT,
    ImageModel,
    Instrument,
    MAX_SHAPE_CHANGE,
    PsfWidth,
    showing_psf,
    width_basis,
)
from starcal_ros.stars.pixel_noise import blurred_px, expected_snr, NoiseSums, PixelNoise

# The mask of Eqs. 8 and 9; the radius holds 99 % of the light of a star of 1 px.
_MASK_RADIUS_PX = 3.0
_MASK_THRESHOLD_SIGMA = 3.0  # above the background
_MIN_MASK_PIXELS = 4
_MODELLED_SNR = 4.0  # light of stars above this ratio is subtracted from their neighbours
SWAMPED_SIGMA = 3.0  # distance to a brighter star below which a star cannot be separated
_NEIGHBOUR_NOISE = 0.2  # light of a neighbour below this share of the pixel noise is neglected
_MOST = 60  # the brightest stars that show the PSF; fainter ones add almost nothing
_MEMORY = 0.95  # weight of the earlier images at each new one: about twenty images count
_COMMON_CHANGE = 0.5 * MAX_SHAPE_CHANGE
_OF_MEDIAN = 1.25  # 1-sigma of a median over that of a mean
_IN_PLACE_PX = 1.5  # from the brightest pixel; a fit that ends farther away shows another source


@dataclass(frozen=True)
class Centroids:
    """
    Measured stars.

    ``xy_px`` (n, 2); ``covariance_px2`` (n, 3) uu, uv, vv; ``flux_dn``, ``snr`` (n,);
    ``refusal`` (n,) uint8 codes of `StarRefusal`, 0 where the star is good.
    ``fit`` is that of the stars ``fitted`` (k,), and None for moments; the others are surely
    faint, with an SNR of 0 and without covariance.  ``psf_sigma_px``, ``noise_dn`` (n,) are PSF
    width and noise of the fit; ``modelled`` (n,) masks
    the stars whose light was subtracted from their neighbours.
    """

    xy_px: Floats
    covariance_px2: Floats
    flux_dn: Floats
    snr: Floats
    refusal: NDArray[np.uint8]
    fit: psf_fit.PsfFit | None
    fitted: Indices
    psf_sigma_px: Floats
    noise_dn: Floats
    modelled: Mask

    @property
    def sigma_px(self) -> Floats:
        """1-sigma (n,) per axis, the root of the mean variance of both axes."""
        return np.sqrt(0.5 * (self.covariance_px2[:, 0] + self.covariance_px2[:, 2]))


def measure_stars(
    pixels: Pixels,
    predicted_px: Floats,
    model: ImageModel,
    options: CentroidOptions,
    hot_pixels: Indices = NO_HOT_PIXELS.index,
) -> Centroids:
    """
    Centroids of the stars near predicted pixels (n, 2), by the method of the options.

    The brighter of two neighbours must come first.  Without a PSF the moment method is used.
    ``hot_pixels`` (k,), flat indices row by row from 0, sorted, are left out of a fit.
    """
    if options.centroid == 'psf' and model.psf is not None:
        return _measure_by_psf(pixels, predicted_px, model, model.psf, options, hot_pixels)
    return _measure_by_moments(pixels, predicted_px, model, options)


def with_faint(measured: Centroids, predicted_px: Floats) -> Centroids:
    """Measured stars and, as faint ones, the rest of the predicted (n, 2); without the PSF fit."""
    more = len(predicted_px) - len(measured.refusal)

    def extended(values: Floats, value: float) -> Floats:
        return np.concatenate([values, np.full((more, *values.shape[1:]), value)])

    return Centroids(
        xy_px=np.concatenate([measured.xy_px, predicted_px[len(measured.refusal) :]]),
        covariance_px2=extended(measured.covariance_px2, np.nan),
        flux_dn=extended(measured.flux_dn, 0.0),
        snr=extended(measured.snr, 0.0),
        refusal=np.concatenate([measured.refusal, np.full(more, StarRefusal.FAINT, np.uint8)]),
        fit=None,
        fitted=measured.fitted,
        psf_sigma_px=extended(measured.psf_sigma_px, np.nan),
        noise_dn=extended(measured.noise_dn, np.nan),
        modelled=np.concatenate([measured.modelled, np.zeros(more, bool)]),
    )


def _measure_by_psf(
    pixels: Pixels,
    predicted_px: Floats,
    model: ImageModel,
    psf: PsfWidth,
    options: CentroidOptions,
    hot_pixels: Indices,
) -> Centroids:
    """Centroids by `fit_psf`, in windows about the predicted pixels."""
    centre, inside = _brightest_beside(pixels, predicted_px, hot_pixels)
    windows = _windows(pixels, centre, model, psf, hot_pixels)
    guess = psf_fit.first_guess(windows.stamps, windows.level_dn)
    stamps, parameters, done, modelled = _without_neighbours(
        windows.stamps,
        *psf_fit.approach(windows.stamps, guess, model.pixel_noise),
        predicted_px,
        centre,
        inside & (windows.saturated_pixels == 0),
        model,
    )
    stamps, parameters, done, noise_dn = _on_uneven_sky(
        pixels, centre, stamps, parameters, done, model
    )
    # Most stars of the catalog are too faint: their refusal needs no covariance and no shape.
    faint = psf_fit.surely_fainter(stamps, parameters, done, options.min_snr, model.pixel_noise)
    fitted = np.flatnonzero(~faint)
    fit = psf_fit.fit_at(stamps.select(fitted), parameters[fitted], model.pixel_noise)
    parameters[fitted] = fit.parameters
    snr, misshapen = np.zeros(len(faint)), np.zeros(len(faint), bool)
    snr[fitted], misshapen[fitted] = fit.snr, _misshapen(fit, model)
    covariance_px2 = np.full((len(faint), 3), np.nan)
    covariance_px2[fitted] = fit.covariance[:, [0, 0, 1], [0, 1, 1]]
    refusal = _first_reason(
        (~inside, StarRefusal.BORDER),
        (windows.saturated_pixels > options.max_saturated_pixels, StarRefusal.SATURATED),
        ((snr < options.min_snr) | ~np.isfinite(snr), StarRefusal.FAINT),
        (~_in_place(parameters, model), StarRefusal.NOT_DETECTED),
        (misshapen, StarRefusal.ELONGATED),
    )
    xy_px = centre + parameters[:, :2]
    if model.streak is not None:
        xy_px = xy_px - model.streak.bend_px(xy_px)
    return Centroids(
        xy_px=xy_px,
        covariance_px2=covariance_px2,
        flux_dn=parameters[:, 2],
        snr=snr,
        refusal=refusal,
        fit=fit,
        fitted=fitted,
        psf_sigma_px=stamps.sigma_px,
        noise_dn=noise_dn,
        modelled=modelled,
    )


def _in_place(parameters: Floats, model: ImageModel) -> Mask:
    """Mask (n,) of the fits (n, 4) that end at the brightest pixel, anywhere along a streak."""
    reach_px = _IN_PLACE_PX + model.extent_px - (model.psf_sigma_px or 1.0)
    return np.asarray(np.maximum(*np.abs(parameters[:, :2].T)) < reach_px)


def _first_reason(*reasons: tuple[Mask, StarRefusal]) -> NDArray[np.uint8]:
    """Codes (n,) of the first of the reasons whose mask (n,) holds; 0 without any."""
    return np.select(*zip(*reasons, strict=True)).astype(np.uint8)


def _brightest_beside(
    pixels: Pixels, predicted_px: Floats, hot_pixels: Indices
) -> tuple[Indices, Mask]:
    """The brightest pixel (n, 2) next to each predicted one, and a mask (n,) of those inside."""
    height, width = pixels.shape
    centre = np.rint(np.where(np.isnan(predicted_px), -1e6, predicted_px)).astype(np.int64)
    inside = detection.windows_inside(pixels.shape, centre, 1)
    innermost = np.array([width - 2, height - 2])
    centre = np.minimum(np.maximum(centre, 1), innermost)
    near = detection.windows_about(pixels, centre, 1)
    near[hot_in_stamps(hot_pixels, centre, 1, width)] = 0
    near = near.reshape(len(centre), 9)
    best = near.argmax(axis=1)
    # On a saturated plateau, the predicted pixel.
    best[near[:, 4] == near[np.arange(len(near)), best]] = 4
    centre = centre + np.stack([best % 3 - 1, best // 3 - 1], axis=-1)
    return np.minimum(np.maximum(centre, 1), innermost), inside


class _Windows(NamedTuple):
    """Windows about stars; level of their borders and saturated pixels (n,)."""

    stamps: psf_fit.Stamps
    level_dn: Floats
    saturated_pixels: Indices


def _windows(
    pixels: Pixels, centre: Indices, model: ImageModel, psf: PsfWidth, hot_pixels: Indices
) -> _Windows:
    """Windows for a fit about pixels (n, 2), without pixels that show no light of the star."""
    radius = psf_fit.stamp_radius_px(psf.sigma_px, model.longest_streak_px)
    stamps, outside = detection.stamps_at_edges(pixels, centre, radius)
    saturated = (stamps >= model.saturation_dn) & ~outside
    noise_dn = model.background.noise_at(centre)
    sky_dn = model.background.level_at(centre)
    invalid = (stamps == 0.0) & (sky_dn > detection.GAP_SIGMA * noise_dn)[:, None, None]
    # On most skies the slope of the mesh is exact: a free one would cost 7 % of the accuracy.
    stamps -= _slopes(model.background, centre, radius)
    hot = hot_in_stamps(hot_pixels, centre, radius, pixels.shape[1]) & ~outside
    level_dn = psf_fit.border_level_dn(stamps)
    hot |= _single_pixels(pixels, stamps, centre, level_dn, noise_dn, model.pixel_noise)
    # The first guess uses all pixels; the fit leaves these out.
    np.copyto(stamps, level_dn[:, None, None], where=hot)
    out = saturated | hot | outside | invalid
    return _Windows(
        psf_fit.Stamps(
            stamps,
            psf.at(centre),
            noise_dn[:, None] ** 2,
            out if out.any() else None,
            model.streaks_at(centre),
        ),
        level_dn,
        np.count_nonzero(saturated & ~hot, axis=(1, 2)),
    )


def _slopes(background: detection.Background, centre: Indices, radius: int) -> Floats:
    """Slope of the background in windows about pixels (n, 2), DN, zero in their middles."""
    side = 2 * radius + 1
    slopes = [
        detection.sample_mesh(slope, background.shape, centre) for slope in background.slope_meshes
    ]
    places = np.indices((side, side), np.float64).reshape(2, -1) - radius
    return np.asarray((np.stack(slopes, axis=-1) @ places).reshape(-1, side, side))


def _misshapen(fit: psf_fit.PsfFit, model: ImageModel) -> Mask:
    """Mask (n,) of the stars whose shape differs from the common one of the image."""
    departure = np.abs(fit.shape_change - model.shape_median)
    limit = np.maximum(MAX_SHAPE_CHANGE, 4.0 * model.shape_scatter)
    other = np.asarray(((departure > limit) & (departure > 4.0 * fit.shape_sigma)).any(axis=1))
    misfits = np.flatnonzero(fit.worst_pixel_sigma > psf_fit.MISFIT_SIGMA)
    if len(misfits):
        other[misfits] |= _beyond_others(fit, misfits) > psf_fit.MISFIT_SIGMA
    return other


def _beyond_others(fit: psf_fit.PsfFit, stars: Rows) -> Floats:
    """
    Largest residual (k,) of a pixel of some stars, less that of bright ones, over its noise.

    Coma, diffraction and undersampling leave the same part of the flux of all stars in a pixel:
    its median is no fault of one of them, and its scatter, without that of the noise, is allowed.
    """
    flux_dn = np.maximum(fit.parameters[:, 2, None], 1e-9)
    common, variance = np.zeros((2, fit.residual_dn.shape[1]))
    bright = np.flatnonzero(fit.snr > BRIGHT_SNR)[:_MOST]
    if len(bright) >= FEWEST_BRIGHT:
        part = np.nan_to_num(fit.residual_dn[bright]) / flux_dn[bright]
        noise = np.nan_to_num(fit.sigma_dn[bright]) / flux_dn[bright]
        common = np.median(part, axis=0)
        scatter = MAD_TO_SIGMA * np.median(np.abs(part - common), axis=0)
        variance = np.maximum(scatter**2 - np.median(noise, axis=0) ** 2, 0.0)
    beyond_dn = np.abs(fit.residual_dn[stars] - common * flux_dn[stars])
    sigmas = beyond_dn / np.sqrt(fit.sigma_dn[stars] ** 2 + variance * flux_dn[stars] ** 2)
    return np.asarray(np.nan_to_num(sigmas).max(axis=1, initial=0.0))


def shape_changed(measured: Centroids, model: ImageModel) -> bool:
    """Return True if most bright stars have another shape than the model: streaks, or defocus."""
    if measured.fit is None:
        return False
    shown = showing_psf(measured.fit.snr)
    change = measured.fit.shape_change[shown]
    if len(change) < FEWEST_BRIGHT:
        return False
    noise = _OF_MEDIAN * medians(measured.fit.shape_sigma[shown]) / math.sqrt(len(change))
    departure = np.abs(medians(change) - model.shape_median)
    return bool((departure > np.maximum(_COMMON_CHANGE, 4.0 * noise)).any())


def _without_neighbours(
    stamps: psf_fit.Stamps,
    parameters: Floats,
    done: Mask,
    predicted_px: Floats,
    centre: Indices,
    usable: Mask,
    model: ImageModel,
) -> tuple[psf_fit.Stamps, Floats, Mask, Mask]:
    """
    Stamps without the light of the neighbours that can be modelled.

    Also what `psf_fit.approach` finds in them, and a mask (n,) of the modelled stars.
    """
    flux, sigma_px, noise = parameters[:, 2], stamps.sigma_px, model.pixel_noise
    streak_px = psf_fit.longest_px(stamps.streak_px)
    blurred = blurred_px(sigma_px, streak_px)
    snr = expected_snr(flux, blurred, np.sqrt(stamps.noise2_dn2[:, 0]), noise)
    widest_px = float(sigma_px.max(initial=0.0))
    modelled = usable & (snr > _MODELLED_SNR) & _in_place(parameters, model)
    if len(stamps) < 2:
        return stamps, parameters, done, modelled
    # The wing of a star outside the stamp adds light to it.
    reach_px = math.sqrt(2.0) * (stamps.width // 2) + 2.0 * widest_px + 0.5 * streak_px
    pairs = cKDTree(centre).query_pairs(reach_px, output_type='ndarray')
    apart_px = psf_fit.apart_px(
        predicted_px[pairs[:, 0]] - predicted_px[pairs[:, 1]],
        sigma_px[pairs[:, 0]],
        None if stamps.streak_px is None else stamps.streak_px[pairs[:, 0]],
    )
    # Both fits would follow the light of the brighter one, which comes first.
    modelled[pairs[apart_px < max(3.0, 3.0 * widest_px)].max(axis=1)] = False
    # The fainter of two unresolved stars cannot be separated: `blending` refuses it.
    pairs = pairs[apart_px >= SWAMPED_SIGMA * float(sigma_px.min())]
    star, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    subtracted = modelled[other]
    star, other = star[subtracted], other[subtracted]
    if not len(star):
        return stamps, parameters, done, modelled
    away_px = (centre[other] - centre[star]).astype(np.float64)
    noise2_dn2 = np.broadcast_to(stamps.noise2_dn2, stamps.flat_dn.shape).copy()
    cleared = dataclasses.replace(stamps, data_dn=stamps.data_dn.copy(), noise2_dn2=noise2_dn2)
    parameters, done = parameters.copy(), done.copy()
    touched = np.zeros(len(stamps), bool)
    little_dn = _NEIGHBOUR_NOISE * np.sqrt(stamps.noise2_dn2[star, 0])
    light: Floats = np.zeros((len(star), stamps.width**2))
    # Two rounds: the light of a neighbour is known better without that of its own neighbours.
    for _ in range(2):
        before = light
        light = psf_fit.light_in_stamps(
            away_px + parameters[other, :2],
            parameters[other, 2],
            sigma_px[other],
            stamps.width,
            None if stamps.streak_px is None else stamps.streak_px[other],
        )
        if not (np.abs(light - before).max(axis=1, initial=0.0) > little_dn).any():
            break
        lit = light.max(axis=1, initial=0.0) > little_dn
        # These include stars that get back light which was subtracted before.
        touched[star[lit]] = True
        # Few of the stars: passes over the windows of all would cost as much as these fits.
        neighbours = np.zeros((np.count_nonzero(touched), stamps.width**2))
        np.add.at(neighbours, (np.cumsum(touched) - 1)[star[lit]], light[lit])
        # The light is subtracted, its photon noise stays.
        cleared.flat_dn[touched] = stamps.flat_dn[touched] - neighbours
        photons_dn2 = neighbours / (noise.gain_e_per_dn * noise.background)
        noise2_dn2[touched] = stamps.noise2_dn2[touched] + photons_dn2
        parameters[touched], done[touched] = psf_fit.approach(
            cleared.select(np.flatnonzero(touched)), parameters[touched], noise
        )
    return cleared, parameters, done, modelled


def _on_uneven_sky(
    pixels: Pixels,
    centre: Indices,
    stamps: psf_fit.Stamps,
    parameters: Floats,
    done: Mask,
    model: ImageModel,
) -> tuple[psf_fit.Stamps, Floats, Mask, Floats]:
    """
    Stamps with a free slope where the level differs from the mesh by more than a pixel's noise.

    Also what `psf_fit.approach` finds in them, and the noise (n,) of their sky.  A glow or halo is
    smaller than the cells of the mesh.  One that falls off over 30 px, and is at the limit, pulls
    a star of 1 px by a sixth of its sigma, and sharper ones by less, as the square of the width.
    """
    sky_dn, mesh_dn = model.background.level_at(centre), model.background.noise_at(centre)
    limit_dn = mesh_dn / np.minimum(stamps.sigma_px, 1.0) ** 2
    star = np.flatnonzero(np.abs(parameters[:, 3] - sky_dn) > limit_dn)
    # The light of a companion raises the level in the window, but not twice as far from the star.
    reach_px = stamps.width
    inner = np.clip(centre[star], reach_px, np.array(pixels.shape[::-1]) - 1 - reach_px)
    around, _ = detection.stamps_at_edges(pixels, inner, reach_px)
    beyond = np.abs(psf_fit.border_level_dn(around) - sky_dn[star]) > limit_dn[star]
    star, around = star[beyond], around[beyond]
    if not len(star):
        return stamps, parameters, done, mesh_dn
    # Second differences are free of slopes.
    bends = np.abs(np.diff(around, 2)).reshape(len(star), -1)
    around_dn = MAD_TO_SIGMA / math.sqrt(6.0) * medians(bends.T)
    uneven, noise_dn = np.zeros(len(stamps), bool), mesh_dn.copy()
    uneven[star], noise_dn[star] = True, np.maximum(mesh_dn[star], around_dn)
    noise2_dn2 = stamps.noise2_dn2 + (noise_dn**2 - mesh_dn**2)[:, None]
    stamps = dataclasses.replace(stamps, noise2_dn2=noise2_dn2, uneven=uneven)
    parameters, done = parameters.copy(), done.copy()
    near = psf_fit.approach(stamps.select(star), parameters[star], model.pixel_noise)
    parameters[star], done[star] = near
    return stamps, parameters, done, noise_dn


def _single_pixels(
    pixels: Pixels,
    stamps: Floats,
    centre: Indices,
    level_dn: Floats,
    noise_dn: Floats,
    noise: PixelNoise,
) -> Mask:
    """
    Mask (n, w, w) of single lit pixels of the stamps away from the core of the star.

    They are cosmic rays or new hot pixels: the light of a star extends to adjacent pixels.
    """
    above_dn = stamps - level_dn[:, None, None]
    radius = stamps.shape[1] // 2
    reach = np.arange(-radius, radius + 1)
    away = np.hypot(reach[:, None], reach) > CORE_PX
    least_dn = psf_fit.MISFIT_SIGMA * math.sqrt(noise.background) * noise_dn
    beyond = (above_dn > least_dn[:, None, None]) & away
    star, row, column = np.unravel_index(np.flatnonzero(beyond), beyond.shape)
    v, u = centre[star, 1] + row - radius, centre[star, 0] + column - radius
    lit_dn = above_dn[star, row, column]
    inner = (u >= 1) & (u < pixels.shape[1] - 1) & (v >= 1) & (v < pixels.shape[0] - 1)
    inner &= (
        lit_dn**2 > least_dn[star] ** 2 + psf_fit.MISFIT_SIGMA**2 * lit_dn / noise.gain_e_per_dn
    )
    star, row, column, v, u = (values[inner] for values in (star, row, column, v, u))
    alone = lit_alone(pixels, v, u, level_dn[star])
    single = np.zeros(stamps.shape, bool)
    single[star[alone], row[alone], column[alone]] = True
    return single


def _measure_by_moments(
    pixels: Pixels, predicted_px: Floats, model: ImageModel, options: CentroidOptions
) -> Centroids:
    """
    Centroids as centres of intensity over a mask (Eqs. 8, 9).

    The window is centred on the brightest pixel of the region of interest; the mask holds the
    pixels within 3 px of it that are 3 times the noise above the background.
    """
    height, width = pixels.shape
    radius = int(np.ceil(_MASK_RADIUS_PX))
    n = len(predicted_px)
    centre = np.rint(np.nan_to_num(predicted_px, nan=-1e6)).astype(np.int64)
    inside = detection.windows_inside(pixels.shape, centre, 2 * radius)
    centre = np.clip(centre, 2 * radius, [width - 2 * radius - 1, height - 2 * radius - 1])
    w = 2 * radius + 1
    best = detection.windows_about(pixels, centre, radius).reshape(n, w * w).argmax(axis=1)
    centre = centre + np.stack([best % w - radius, best // w - radius], axis=-1)

    stamps = detection.windows_about(pixels, centre, radius)
    noise_dn = model.background.noise_at(centre)
    signal = stamps - model.background.level_at(centre)[:, None, None]
    offsets = np.arange(-radius, radius + 1).astype(np.float64)
    disc = offsets[:, None] ** 2 + offsets[None, :] ** 2 <= _MASK_RADIUS_PX**2
    mask = disc & (signal > (_MASK_THRESHOLD_SIGMA * noise_dn)[:, None, None])
    weight = np.where(mask, signal, 0.0)
    flux = weight.sum(axis=(1, 2))
    of_pixel = model.pixel_noise.variance(signal, noise_dn[:, None, None], flux[:, None, None])
    variance = np.where(mask, of_pixel, 0.0)
    place_px, covariance_px2, ellipticity = _moments(weight, variance, offsets)
    snr = flux / np.sqrt(np.maximum(variance.sum(axis=(1, 2)), 1e-12))
    refusal = _first_reason(
        (~inside, StarRefusal.BORDER),
        (stamps.max(axis=(1, 2)) >= model.saturation_dn, StarRefusal.SATURATED),
        (snr < options.min_snr, StarRefusal.FAINT),
        # A mask of one pixel would give a covariance of zero.
        (mask.sum(axis=(1, 2)) < _MIN_MASK_PIXELS, StarRefusal.TOO_FEW_PIXELS),
        (ellipticity > MAX_SHAPE_CHANGE, StarRefusal.ELONGATED),
    )
    return Centroids(
        xy_px=centre + place_px,
        covariance_px2=covariance_px2,
        flux_dn=flux,
        snr=snr,
        refusal=refusal,
        fit=None,
        fitted=np.empty(0, np.intp),
        psf_sigma_px=np.zeros(n),
        noise_dn=noise_dn,
        modelled=np.zeros(n, bool),
    )


def _moments(weight: Floats, variance: Floats, offsets: Floats) -> tuple[Floats, Floats, Floats]:
    """
    Centres of intensity (n, 2) from the middles, their covariances (n, 3) and ellipticities (n,).

    ``weight`` and ``variance`` (n, w, w) are those of the pixels, 0 outside the mask; ``offsets``
    (w,) are the places of the pixels along each axis.
    """
    total, place_px, moments_px2 = detection.second_moments(weight)
    x, y = place_px.T
    dx = offsets[None, None, :] - x[:, None, None]
    dy = offsets[None, :, None] - y[:, None, None]

    def second(values: Floats) -> Floats:
        pairs = ((dx, dx), (dx, dy), (dy, dy))
        return np.stack([(values * a * b).sum(axis=(1, 2)) for a, b in pairs], axis=-1)

    uu, vv, uv = moments_px2.T
    ellipticity = np.hypot(uu - vv, 2 * uv) / np.maximum(uu + vv, 1e-12)
    return place_px, second(variance) / (np.maximum(total, 1e-12) ** 2)[:, None], ellipticity


def learn(
    before: Instrument | None, measured: Centroids, usable: Mask, model: ImageModel
) -> Instrument | None:
    """
    PSF, pixel noise and saturation after one more image; ``before`` if it has too few stars.

    ``usable`` (n,) masks the isolated stars that were not refused.
    """
    if measured.fit is None:
        return before
    stars = np.flatnonzero(usable[measured.fitted])
    # The lens changes the shape of all stars alike; this is not the noise of a pixel.
    plain = stars[measured.fit.worst_pixel_sigma[stars] <= psf_fit.MISFIT_SIGMA]
    stars = plain if len(plain) >= FEWEST_BRIGHT else stars
    bright = stars[showing_psf(measured.fit.snr[stars])][:_MOST]
    # Fainter stars show no PSF error, so that it can be separated from photon noise.
    shown = stars[:_MOST]
    noise = psf_fit.noise_sums(
        rows_of(measured.fit, shown),
        measured.noise_dn[measured.fitted[shown]],
        model.pixel_noise,
    )
    if before is not None:  # a decaying weight follows a change of focus
        noise = NoiseSums(
            noise.normal + _MEMORY * before.noise.normal,
            noise.right + _MEMORY * before.noise.right,
        )
    if len(bright) < FEWEST_BRIGHT:
        return None if before is None else dataclasses.replace(before, noise=noise)
    fit, row = rows_of(measured.fit, bright), measured.fitted[bright]
    variance = measured.psf_sigma_px[row] ** 2
    median, scatter = centre_and_scatter(fit.shape_change)
    change = fit.shape_change[:, :2].mean(axis=1)
    # A companion or a cosmic ray moves one star by more than the scatter of all.
    spread2 = 0.25 * (fit.shape_sigma[:, :2] ** 2).sum(axis=1) + 0.5 * scatter[:2].mean() ** 2
    off2 = (change - median[:2].mean()) ** 2 / spread2
    weight = (off2 < 9.0) / (spread2 * variance**2)
    height, width = model.background.shape
    basis = width_basis(measured.xy_px[row], width, height)
    weighted = basis * weight[:, None]
    normal, right = weighted.T @ basis, weighted.T @ (variance * (1.0 + change))
    if before is not None:
        normal = normal + _MEMORY * before.width_normal
        right = right + _MEMORY * before.width_right
        median = median + _MEMORY * (before.shape_median - median)
        scatter = scatter + _MEMORY * (before.shape_scatter - scatter)
    shown_dn = model.saturation_dn if np.isfinite(model.saturation_dn) else 0.0
    return Instrument(width, height, normal, right, noise, median, scatter, shown_dn)
