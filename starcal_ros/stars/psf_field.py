# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Width of the PSF over the field, and pixel noise, estimated over a sequence of images.

One image gives its PSF to about 1 % and its gain to about 10 %.  The sums of `Instrument` are
accumulated from image to image with decaying weight, so that the estimates improve over a sequence
and still follow a change of focus.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools

import numpy as np

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.robust_statistics import centre_and_scatter
from starcal_ros.stars.pixel_noise import NoiseSums, PixelNoise
from starcal_ros.stars.psf_fit import noise_sums, PsfFit, select

_MEMORY = 0.95  # weight of the earlier images at each new one: about twenty images count
_BRIGHT_SNR = 15.0  # smallest signal-to-noise ratio of stars that determine the PSF
_MOST = 60  # the brightest stars that are used; fainter ones add almost nothing
MIN_PSF_SIGMA_PX = 0.3  # 82 % of the light in one pixel: a smaller width cannot be measured
_FEWEST = 5  # an image with fewer such stars is not used
_MAP_CHI2 = 30.0  # chance gives five terms a larger chi^2 once in 80,000 times


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


@dataclass(frozen=True)
class MeasuredStars:
    """
    Fitted stars of an image.

    ``xy_px`` (n, 2); ``sigma_px``, ``noise_dn`` (n,) PSF width and noise used in each fit;
    ``usable`` (n,) mask of the isolated stars that were not refused.
    """

    xy_px: Floats
    fit: PsfFit
    sigma_px: Floats
    noise_dn: Floats
    usable: Mask


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
        mean = max(self.width_right[0] / self.width_normal[0, 0], MIN_PSF_SIGMA_PX**2)
        uniform = np.array([mean, 0.0, 0.0, 0.0, 0.0, 0.0])
        # A small ridge keeps the map solvable if all stars lie in one corner.
        ridge = 1e-6 * self.width_normal[0, 0] * np.eye(6)
        full = np.linalg.solve(self.width_normal + ridge, self.width_right)
        gained = full @ self.width_right - mean * self.width_right[0]
        return PsfWidth(full if gained > _MAP_CHI2 else uniform, self.width, self.height)


def learn(
    before: Instrument | None,
    stars: MeasuredStars,
    expected: PixelNoise,
    saturation_dn: float,
    size: tuple[int, int],
) -> Instrument | None:
    """
    PSF, pixel noise and saturation after one more image; ``before`` if it has too few stars.

    ``expected`` is the noise model of the fits, ``saturation_dn`` the level of saturation in the
    image (0 if none), ``size`` width and height of the detector.
    """
    usable = np.nonzero(stars.usable)[0]
    bright = usable[stars.fit.snr[usable] > _BRIGHT_SNR][:_MOST]
    if len(bright) < _FEWEST:
        return before
    # Fainter stars show no PSF error, so that it can be separated from photon noise.
    shown = usable[:_MOST]
    noise = noise_sums(select(stars.fit, shown), stars.noise_dn[shown], expected)
    fit = select(stars.fit, bright)
    variance = stars.sigma_px[bright] ** 2
    median, scatter = centre_and_scatter(fit.shape_change)
    change = fit.shape_change[:, :2].mean(axis=1)
    # A companion or a cosmic ray moves one star by more than the scatter of all.
    spread2 = 0.25 * (fit.shape_sigma[:, :2] ** 2).sum(axis=1) + 0.5 * scatter[:2].mean() ** 2
    off2 = (change - median[:2].mean()) ** 2 / spread2
    weight = (off2 < 9.0) / (spread2 * variance**2)
    basis = width_basis(stars.xy_px[bright], *size)
    weighted = basis * weight[:, None]
    normal, right = weighted.T @ basis, weighted.T @ (variance * (1.0 + change))
    if before is not None:
        keep = _MEMORY
        normal, right = normal + keep * before.width_normal, right + keep * before.width_right
        noise = NoiseSums(
            noise.normal + keep * before.noise.normal, noise.right + keep * before.noise.right
        )
        median = median + keep * (before.shape_median - median)
        scatter = scatter + keep * (before.shape_scatter - scatter)
    return Instrument(*size, normal, right, noise, median, scatter, saturation_dn)
