# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
PSF, pixel noise and saturation of an image, from its own stars or from earlier images.

One image gives its PSF to about 1 % and its gain to about 10 %.  The sums of `Instrument` are
accumulated from image to image, so that the estimates improve over a sequence.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np
from scipy.spatial import cKDTree

from starcal_ros.arrays import Floats, Indices, Mask, Pixels
from starcal_ros.options import option
from starcal_ros.robust_statistics import centre_and_scatter, median
from starcal_ros.stars import detection
from starcal_ros.stars.pixel_noise import blurred_px, CONVERTER_ENDS, NoiseSums, PixelNoise
from starcal_ros.stars.psf_fit import fit_psf, noise_sums, stamp_radius_px
from starcal_ros.stars.streak import refined, Streak

# Stars that show the PSF; the second where fewer are so bright, as in a narrow field.
BRIGHT_SNR, SHOWN_SNR, FEWEST_BRIGHT = 15.0, 8.0, 5
MAX_SHAPE_CHANGE = 0.35  # departure of second moments from the PSF's, a fraction: a blend
_BELOW_PLATEAU = 0.98  # pixels of a plateau differ by their sensitivity
_BRIGHTEST = 60  # stars that may show the level of saturation
_ISOLATED_PX = 12.0  # least distance to another source of the stars that give the PSF
_MIN_PSF_SIGMA_PX = 0.3  # 82 % of the light in one pixel: a smaller width cannot be measured
_MAX_PSF_SIGMA_PX = 4.0
_MAP_CHI2 = 30.0  # chance gives five terms a larger chi^2 once in 80,000 times
_CUT_OFF_BELOW = 1.0  # quantisation steps: many pixels of a lower background are clipped to 0 DN


@dataclass(frozen=True)
class CentroidOptions:
    """Measurement of stars, and data sheet values of the detector."""

    centroid: str = option(
        'psf',
        'centroid method; psf: fit of the point spread function; moment: centre of intensity, as'
        ' in the paper',
        choices=('psf', 'moment'),
    )
    min_snr: float = option(
        5.0, 'smallest signal-to-noise ratio of the stars used', low=2.0, high=1000.0
    )
    saturation_dn: float = option(
        0.0, 'smallest value of a saturated pixel, DN; 0: estimated from each image', low=0.0
    )
    max_saturated_pixels: int = option(
        40,
        'largest number of saturated pixels in a star used (the PSF is fitted to the others);'
        ' 0 for a detector that blooms',
        low=0,
        high=200,
    )
    gain_e_per_dn: float = option(
        0.0, 'detector gain, electrons per DN; 0: estimated from each image', low=0.0
    )


@dataclass(frozen=True)
class PsfWidth:
    """
    Gaussian width of the stars over the detector.

    The variance, px^2, is a polynomial of second degree: ``coefficients`` (6,) of 1, u, v, u^2,
    uv, v^2 with u and v from -1 to 1 over ``width`` and ``height``.
    """

    coefficients: Floats
    width: int
    height: int

    def at(self, xy_px: Floats | Indices) -> Floats:
        """Width (n,), px, at pixels (n, 2), limited to a factor of 1.5 of that in the middle."""
        middle = float(self.coefficients[0])
        if not self.coefficients[1:].any():
            return np.full(len(xy_px), np.sqrt(middle))
        variance = width_basis(xy_px, self.width, self.height) @ self.coefficients
        return np.asarray(np.sqrt(np.clip(variance, middle / 2.25, middle * 2.25)))

    @functools.cached_property
    def sigma_px(self) -> float:
        """Root of the mean variance over the detector, px."""
        return float(np.sqrt(self.coefficients @ [1.0, 0.0, 0.0, 1 / 3, 0.0, 1 / 3]))


def uniform_width(sigma_px: float, width: int, height: int) -> PsfWidth:
    """Return a width that is the same everywhere."""
    return PsfWidth(np.array([sigma_px**2, 0.0, 0.0, 0.0, 0.0, 0.0]), width, height)


def width_basis(xy_px: Floats | Indices, width: int, height: int) -> Floats:
    """Terms (n, 6) of the polynomial of `PsfWidth` at pixels (n, 2)."""
    u = 2.0 * xy_px[:, 0] / max(width - 1, 1) - 1.0
    v = 2.0 * xy_px[:, 1] / max(height - 1, 1) - 1.0
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


@dataclass(frozen=True)
class Instrument:
    """
    PSF, pixel noise and saturation level from the images so far.

    ``width_normal`` (6, 6) and ``width_right`` (6,) are the normal equations of `PsfWidth`,
    ``noise`` those of the pixel noise.  ``shape_median`` and ``shape_scatter`` (3,) are median and
    scatter of `PsfFit.shape_change` of the bright stars.  ``saturation_dn`` is the level of
    saturation, DN; 0 if no image shows one.
    """

    width: int
    height: int
    width_normal: Floats
    width_right: Floats
    noise: NoiseSums
    shape_median: Floats
    shape_scatter: Floats
    saturation_dn: float

    def psf_width(self) -> PsfWidth:
        """Width over the field; the same everywhere if no change is significant."""
        mean = max(self.width_right[0] / self.width_normal[0, 0], _MIN_PSF_SIGMA_PX**2)
        uniform = np.array([mean, 0.0, 0.0, 0.0, 0.0, 0.0])
        # A small ridge keeps the map solvable if all stars lie in one corner.
        ridge = 1e-6 * self.width_normal[0, 0] * np.eye(6)
        full = np.linalg.solve(self.width_normal + ridge, self.width_right)
        gained = full @ self.width_right - mean * self.width_right[0]
        return PsfWidth(full if gained > _MAP_CHI2 else uniform, self.width, self.height)


@dataclass(frozen=True)
class ImageModel:
    """
    Background, PSF, pixel noise and saturation of an image, for the measurement of its stars.

    ``psf`` is None if the image has too few bright stars.  ``shape_median`` and ``shape_scatter``
    (3,) are median and scatter of `PsfFit.shape_change` of its stars: real lenses do not make
    circular stars, so a star is refused only if its shape differs from the common one.
    ``streak`` is the turn of the camera during the exposure, None where it blurs no star.
    """

    background: detection.Background
    psf: PsfWidth | None
    pixel_noise: PixelNoise
    saturation_dn: float
    shape_median: Floats
    shape_scatter: Floats
    streak: Streak | None = None

    @property
    def psf_sigma_px(self) -> float:
        """Mean Gaussian width of the stars; 0 without a PSF."""
        return self.psf.sigma_px if self.psf else 0.0

    @property
    def blurred_px(self) -> float:
        """Width of a Gaussian over as many pixels of noise as a star; 1 without a PSF."""
        return float(blurred_px(self.psf_sigma_px or 1.0, self.longest_streak_px))

    @property
    def extent_px(self) -> float:
        """Largest root of the second moment of a star along any direction; 1 without a PSF."""
        return math.hypot(self.psf_sigma_px or 1.0, self.longest_streak_px / math.sqrt(12.0))

    @functools.cached_property
    def longest_streak_px(self) -> float:
        """Length of a streak that nine of ten places of the image do not exceed."""
        return self.streak.longest_px if self.streak else 0.0

    def streaks_at(self, xy_px: Floats | Indices) -> Floats | None:
        """Paths (n, 2), px, of stars at pixels (n, 2) during the exposure; None: sharp."""
        return self.streak.at(xy_px) if self.streak else None


def showing_psf(snr: Floats) -> Mask:
    """Mask (n,) of the stars that show the PSF, by their signal-to-noise ratio (n,)."""
    bright = snr > BRIGHT_SNR
    # Few stars of a narrow field are bright, and light spread along streaks has more noise.
    return bright if np.count_nonzero(bright) >= FEWEST_BRIGHT else snr > SHOWN_SNR


def saturation_level(pixels: Pixels, options: CentroidOptions, step_dn: int) -> float:
    """
    Smallest value of a saturated pixel, DN; 0 if no pixel is saturated.

    Without the option ``saturation_dn``, the largest value of the image counts as saturated if at
    least four pixels share it, or if it is the end of an 8, 10, 12, 14 or 16 bit range of steps.
    """
    if options.saturation_dn > 0:
        return options.saturation_dn
    peak = int(pixels.max(initial=0))
    # Far above the background, photon noise does not give four pixels the same greatest value.
    plateau = peak / step_dn in CONVERTER_ENDS or np.count_nonzero(pixels == peak) >= 4
    return _BELOW_PLATEAU * peak if plateau else 0.0


def model_image(
    pixels: Pixels,
    background: detection.Background,
    sources: detection.Sources,
    options: CentroidOptions,
    streak: Streak | None = None,
    neighbours: detection.Sources | None = None,
) -> ImageModel:
    """
    PSF width, pixel noise and saturation of an image from its own brighter sources.

    The width is the median over up to 80 bright, unsaturated, isolated sources; gain and PSF
    error are a robust regression of the squared residuals of their pixels on their signal.
    Streaks are fitted with the width, from the ``streak`` that the second moments gave.
    ``neighbours``: all sources, where those to be fitted are some of them.
    """
    saturation_dn = saturation_level(pixels, options, background.step_dn) or np.inf
    gain = options.gain_e_per_dn
    first_gain = gain or 1.0 / background.step_dn
    unknown = ImageModel(
        background, None, PixelNoise(first_gain, 0.0), saturation_dn, np.zeros(3), np.zeros(3)
    )
    given = pixels, sources, neighbours or sources, saturation_dn, streak
    xy = _isolated(*given, BRIGHT_SNR)
    # The peak of a streak is lower than its light, and a short exposure has few bright stars.
    if streak is not None or len(xy) < FEWEST_BRIGHT:
        xy = _isolated(*given, SHOWN_SNR)
    sigma = 1.2
    if len(xy) < FEWEST_BRIGHT:
        return unknown
    noise_model = PixelNoise(first_gain, 0.02)
    for _ in range(6):
        radius = stamp_radius_px(sigma, streak.longest_px if streak else 0.0)
        centre = np.rint(xy).astype(np.int64)
        inside = detection.windows_inside(pixels.shape, centre, radius)
        xy, centre = xy[inside], centre[inside]
        stamps = detection.windows_about(pixels, centre, radius).astype(np.float64)
        clean = stamps.max(axis=(1, 2)) < saturation_dn
        xy, centre, stamps = xy[clean], centre[clean], stamps[clean]
        if len(xy) < FEWEST_BRIGHT:
            return unknown
        noise_dn = background.noise_at(xy)
        paths_px = streak.at(xy) if streak else None
        fit = fit_psf(stamps, sigma, noise_dn, noise_model, paths_px)
        sigma_before = sigma
        if streak is None:
            change = median(fit.shape_change[:, :2].mean(axis=1))
        else:
            moments_px2 = streak.moments_px2(xy) + sigma**2 * fit.shape_change
            moments_px2[:, :2] += sigma**2
            streak, variance_px2, _ = refined(streak, sigma**2, xy, moments_px2)
            change = variance_px2 / sigma**2 - 1.0
        sigma *= float(np.sqrt(np.clip(1.0 + change, 0.5, 2.0)))
        sigma = float(np.clip(sigma, _MIN_PSF_SIGMA_PX, _MAX_PSF_SIGMA_PX))
        if abs(sigma - sigma_before) < 1e-3 * sigma:
            break
    shape_median, shape_scatter = centre_and_scatter(fit.shape_change)
    limit = np.maximum(MAX_SHAPE_CHANGE, 3.0 * shape_scatter)
    star_like = (np.abs(fit.shape_change - shape_median) < limit).all(axis=1)
    stamps, noise_dn = stamps[star_like], noise_dn[star_like]
    paths_px = streak.at(xy[star_like]) if streak else None
    for _ in range(3):
        fit = fit_psf(stamps, sigma, noise_dn, noise_model, paths_px)
        noise_model = noise_sums(fit, noise_dn, noise_model).pixel_noise(gain)
    psf = uniform_width(sigma, pixels.shape[1], pixels.shape[0])
    noise_model = _at_least_sky(noise_model, background)
    return ImageModel(
        background, psf, noise_model, saturation_dn, shape_median, shape_scatter, streak
    )


def _isolated(
    pixels: Pixels,
    sources: detection.Sources,
    neighbours: detection.Sources,
    saturation_dn: float,
    streak: Streak | None,
    least_snr: float,
) -> Floats:
    """Places (n, 2) of the bright, unsaturated sources that are alone, up to 80."""

    def bright(of: detection.Sources) -> Floats:
        xy_px = of.xy_px[of.snr > least_snr]
        nearest = np.rint(xy_px).astype(np.int64)
        return xy_px[pixels[nearest[:, 1], nearest[:, 0]] < saturation_dn]

    xy_px = bright(sources)[:400]
    apart_px = _ISOLATED_PX + (streak.longest_px if streak else 0.0)
    count = cKDTree(bright(neighbours)).query_ball_point(xy_px, apart_px, return_length=True)
    return np.asarray(xy_px[count == 1][:80])


def known_model(
    pixels: Pixels,
    background: detection.Background,
    known: Instrument,
    predicted_px: Floats,
    options: CentroidOptions,
) -> ImageModel:
    """
    Model of an image with the PSF and noise of earlier images.

    ``predicted_px`` (n, 2) are sorted, brightest first: only these stars can be saturated.
    """
    centre = np.rint(predicted_px).astype(np.int64)
    centre = centre[detection.windows_inside(pixels.shape, centre, 2)][:_BRIGHTEST]
    cores = detection.windows_about(pixels, centre, 2)
    saturation_dn = saturation_level(cores, options, background.step_dn)
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


def _at_least_sky(noise: PixelNoise, background: detection.Background) -> PixelNoise:
    """Pixel noise, raised to the noise of the sky if the converter clips it at 0 DN."""
    if background.level_dn >= _CUT_OFF_BELOW * background.step_dn:
        return noise
    # Clipped pixels do not scatter: their noise would make the sigmas of faint stars too small.
    return dataclasses.replace(noise, background=max(noise.background, 1.0))
