# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""PSF, pixel noise and saturation of an image, from its own stars or from images before it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.image.detection import (
    Background,
    sample_mesh,
    Sources,
    stamps_about,
    windows_about,
    windows_inside,
)
from starcal_ros.image.pixel_noise import PixelNoise
from starcal_ros.image.psf_field import Instrument, MIN_PSF_SIGMA_PX, PsfWidth, uniform_width
from starcal_ros.image.psf_fit import fit_psf, noise_sums, stamp_radius_px
from starcal_ros.options import option
from starcal_ros.robust_statistics import centre_and_scatter, median

_BELOW_PLATEAU = 0.98  # pixels of a plateau differ by their sensitivity
_BRIGHTEST = 60  # stars that may show the level of saturation
_MAX_PSF_SIGMA_PX = 4.0
_CUT_OFF_BELOW_DN = 1.0  # a background below it shows 0 DN in a good part of its pixels


@dataclass(frozen=True)
class CentroidOptions:
    """Options for the detection and measurement of stars."""

    centroid: str = option('psf', 'how centroids are measured', choices=('psf', 'moment'))
    detection_sigma: float = option(
        5.0, 'signal-to-noise ratio at which a source is detected', low=3.0, high=100.0
    )
    min_snr: float = option(
        5.0, 'least signal-to-noise ratio of a star that is used', low=2.0, high=1000.0
    )
    mask_radius_px: float = option(
        3.0, 'radius of the mask of the moment method, px', low=1.0, high=10.0
    )
    mask_threshold_sigma: float = option(
        3.0, 'threshold of that mask above the background, in background noise', low=0.0, high=50.0
    )
    min_pixels: int = option(
        4, 'least number of pixels above that threshold in the mask', low=1, high=100
    )
    saturation_dn: float = option(
        0.0,
        'pixel value from which a star counts as saturated, DN; 0: found from the image',
        low=0.0,
    )
    max_saturated_pixels: int = option(
        40,
        'most saturated pixels of a star that is used, which the PSF fit places by the others;'
        ' 0 for a detector that blooms',
        low=0,
        high=200,
    )
    gain_e_per_dn: float = option(
        0.0, 'detector gain, electrons per DN; 0: found from the image', low=0.0
    )
    max_shape_change: float = option(
        0.35,
        'largest departure of the second moments of a star from those of the PSF, as a fraction',
        low=0.05,
        high=5.0,
    )


@dataclass(frozen=True)
class ImageModel:
    """
    Background, PSF, pixel noise and saturation of an image, for the measurement of its stars.

    ``psf`` is None if the image has too few bright stars.  ``shape_median`` and ``shape_scatter``
    (3,) are median and scatter of `PsfFit.shape_change` of its stars: the stars of a real lens are
    not circular, and a shape common to all of them is no reason to refuse one.
    """

    background: Background
    psf: PsfWidth | None
    pixel_noise: PixelNoise
    saturation_dn: float
    shape_median: Floats
    shape_scatter: Floats

    @property
    def psf_sigma_px(self) -> float:
        """Mean Gaussian width of the stars; 0 without a PSF."""
        return self.psf.sigma_px if self.psf else 0.0


def saturation_level(pixels: Pixels, options: CentroidOptions) -> float:
    """
    Pixel value from which a pixel counts as saturated, DN; 0 if no pixel is.

    Without the option ``saturation_dn`` it is the greatest value, if that is a plateau or the end
    of the data type or of a 10, 12 or 14 bit range.
    """
    if options.saturation_dn > 0:
        return options.saturation_dn
    peak = int(pixels.max(initial=0))
    ends = (255,) if pixels.dtype == np.uint8 else (1023, 4095, 16383, 65535)
    # Far above the background, photon noise does not give four pixels the same greatest value.
    plateau = peak in ends or np.count_nonzero(pixels == peak) >= 4
    return _BELOW_PLATEAU * peak if plateau else 0.0


def model_image(
    pixels: Pixels, background: Background, sources: Sources, options: CentroidOptions
) -> ImageModel:
    """
    PSF width, pixel noise and saturation of an image from its own brighter sources.

    The width is the median over up to 80 bright, unsaturated, isolated sources; gain and PSF
    error are a robust regression of the squared residuals of their pixels on their signal.
    """
    saturation_dn = saturation_level(pixels, options) or np.inf
    gain = options.gain_e_per_dn
    unknown = ImageModel(
        background, None, PixelNoise(gain or 1.0, 0.0), saturation_dn, np.zeros(3), np.zeros(3)
    )
    shape = (pixels.shape[0], pixels.shape[1])
    bright = sources.xy_px[sources.snr > 15.0][:400]
    nearest = np.rint(bright).astype(np.int64)
    bright = bright[pixels[nearest[:, 1], nearest[:, 0]] < saturation_dn]
    xy = _isolated(bright, 12.0)[:80]
    sigma = 1.2
    if len(xy) < 5:
        return unknown
    noise_model = PixelNoise(gain or 1.0, 0.02)
    for _ in range(6):
        radius = stamp_radius_px(sigma)
        centre = np.rint(xy).astype(np.int64)
        inside = windows_inside(shape, centre, radius)
        xy, centre = xy[inside], centre[inside]
        stamps = stamps_about(pixels, centre, radius)
        clean = stamps.max(axis=(1, 2)) < saturation_dn
        xy, centre, stamps = xy[clean], centre[clean], stamps[clean]
        if len(xy) < 5:
            return unknown
        noise_dn = sample_mesh(background.noise_mesh, shape, xy)
        fit = fit_psf(stamps, sigma, noise_dn, noise_model)
        change = median(fit.shape_change[:, :2].mean(axis=1))
        sigma_before = sigma
        sigma *= float(np.sqrt(np.clip(1.0 + change, 0.5, 2.0)))
        sigma = float(np.clip(sigma, MIN_PSF_SIGMA_PX, _MAX_PSF_SIGMA_PX))
        if abs(sigma - sigma_before) < 1e-3 * sigma:
            break
    shape_median, shape_scatter = centre_and_scatter(fit.shape_change)
    limit = np.maximum(options.max_shape_change, 3.0 * shape_scatter)
    star_like = (np.abs(fit.shape_change - shape_median) < limit).all(axis=1)
    stamps, noise_dn = stamps[star_like], noise_dn[star_like]
    for _ in range(3):
        fit = fit_psf(stamps, sigma, noise_dn, noise_model)
        noise_model = noise_sums(fit, noise_dn, noise_model).pixel_noise(gain)
    psf = uniform_width(sigma, shape[1], shape[0])
    noise_model = _at_least_sky(noise_model, background)
    return ImageModel(background, psf, noise_model, saturation_dn, shape_median, shape_scatter)


def known_model(
    pixels: Pixels,
    background: Background,
    known: Instrument,
    predicted_px: Floats,
    options: CentroidOptions,
) -> ImageModel:
    """
    Model of an image from the images before it; its stars lie at predicted pixels (n, 2).

    The predictions are sorted, brightest first: the saturated pixels of an image are theirs.
    """
    shape = (pixels.shape[0], pixels.shape[1])
    centre = np.rint(predicted_px).astype(np.int64)
    centre = centre[windows_inside(shape, centre, 2)][:_BRIGHTEST]
    cores = windows_about(pixels, centre, 2)
    saturation_dn = saturation_level(cores, options)
    if saturation_dn == 0 and _BELOW_PLATEAU * cores.max(initial=0) <= known.saturation_dn:
        saturation_dn = known.saturation_dn
    return ImageModel(
        background,
        known.psf_width(),
        _at_least_sky(known.noise.pixel_noise(options.gain_e_per_dn), background),
        saturation_dn or np.inf,
        known.shape_median,
        known.shape_scatter,
    )


def _at_least_sky(noise: PixelNoise, background: Background) -> PixelNoise:
    """Noise beside a star that is no less than that of the sky where the converter cuts it off."""
    if background.level_dn >= _CUT_OFF_BELOW_DN:
        return noise
    # Pixels at 0 DN do not scatter: their residuals would make faint stars look certain.
    return dataclasses.replace(noise, background=max(noise.background, 1.0))


def _isolated(xy_px: Floats, distance_px: float) -> Floats:
    """Return the points that have no other point within a distance."""
    if len(xy_px) < 2:
        return xy_px
    separation = np.linalg.norm(xy_px[:, None] - xy_px[None], axis=-1)
    np.fill_diagonal(separation, np.inf)
    return np.asarray(xy_px[separation.min(axis=1) > distance_px])
