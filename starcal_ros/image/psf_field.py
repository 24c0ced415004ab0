"""
What images say of their camera's light: the width of the PSF over the field, and the pixel noise.

One image knows its PSF to a percent or so and its gain to some ten; the sums of `Instrument` are
added up from image to image, old ones fading, so that an ensemble knows them better and a change
of focus is followed.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats
from starcal_ros.image.pixel_noise import NoiseSums, PixelNoise
from starcal_ros.image.psf_fit import noise_sums, PsfFit, select
from starcal_ros.robust_statistics import centre_and_scatter

_MEMORY = 0.95  # weight of what is known against each new image: about twenty images count
_BRIGHT_SNR = 15.0  # of stars that tell the shape of the PSF
_MOST = 60  # brightest of them, which know all the rest do
MIN_PSF_SIGMA_PX = 0.3  # 82 % of the light in one pixel: a narrower PSF does not show its width
_FEWEST = 5  # such stars, or an image tells nothing
_MAP_CHI2 = 30.0  # five normal deviates squared come to that once in 80,000 times


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

    def at(self, xy_px: Floats) -> Floats:
        """Width (n,) in px at pixels (n, 2), within a factor of 1.5 of that at the middle."""
        middle = float(self.coefficients[0])
        if not self.coefficients[1:].any():
            return np.full(len(xy_px), np.sqrt(middle))
        variance = width_basis(xy_px, self.width, self.height) @ self.coefficients
        return np.asarray(np.sqrt(np.clip(variance, middle / 2.25, middle * 2.25)))

    @functools.cached_property
    def sigma_px(self) -> float:
        """Width in px that is the mean of the variance over the detector."""
        return float(np.sqrt(self.coefficients @ [1.0, 0.0, 0.0, 1 / 3, 0.0, 1 / 3]))


@dataclass(frozen=True)
class MeasuredStars:
    """
    Stars of an image as they were fitted.

    ``xy_px`` (n, 2); ``sigma_px``, ``noise_dn`` (n,) with which each was fitted; ``usable`` (n,)
    marks those that stand alone and are good.
    """

    xy_px: Floats
    fit: PsfFit
    sigma_px: Floats
    noise_dn: Floats
    usable: NDArray[np.bool_]


def uniform_width(sigma_px: float, width: int, height: int) -> PsfWidth:
    """Return a width that is the same everywhere."""
    return PsfWidth(np.array([sigma_px**2, 0.0, 0.0, 0.0, 0.0, 0.0]), width, height)


def width_basis(xy_px: Floats, width: int, height: int) -> Floats:
    """Terms (n, 6) of the polynomial of `PsfWidth` at pixels (n, 2)."""
    u = 2.0 * xy_px[:, 0] / max(width - 1, 1) - 1.0
    v = 2.0 * xy_px[:, 1] / max(height - 1, 1) - 1.0
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


@dataclass(frozen=True)
class Instrument:
    """
    What the images so far have shown.

    ``width_normal`` (6, 6) and ``width_right`` (6,) are the normal equations of `PsfWidth`,
    ``noise`` those of the pixel noise.  ``shape_median`` and ``shape_scatter`` (3,) are what
    `PsfFit.shape_change` is for the bright stars.  ``saturation_dn`` is the level of saturation
    where an image has shown one, else 0.
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
        """The width over the field, or one for all of it where no change is significant."""
        mean = max(self.width_right[0] / self.width_normal[0, 0], MIN_PSF_SIGMA_PX**2)
        uniform = np.array([mean, 0.0, 0.0, 0.0, 0.0, 0.0])
        # A trace of the mean keeps a map solvable whose stars stand in one corner.
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
    What is known after one more image, from its stars; ``before`` where they are too few.

    Parameters
    ----------
    expected : PixelNoise
        With which the stars were fitted.
    saturation_dn : float
        Level of saturation that the image shows; 0 for none.
    size : (int, int)
        Width and height of the detector.
    """
    fit = stars.fit
    bright = np.nonzero(stars.usable & (fit.snr > _BRIGHT_SNR))[0][:_MOST]
    if len(bright) < _FEWEST:
        return before
    fit, noise_dn = select(fit, bright), stars.noise_dn[bright]
    variance = stars.sigma_px[bright] ** 2
    median, scatter = centre_and_scatter(fit.shape_change)
    change = fit.shape_change[:, :2].mean(axis=1)
    # One star may be off by the scatter of all, or by more: a companion or a cosmic ray.
    spread2 = 0.25 * (fit.shape_sigma[:, :2] ** 2).sum(axis=1) + 0.5 * scatter[:2].mean() ** 2
    off2 = (change - median[:2].mean()) ** 2 / spread2
    weight = (off2 < 9.0) / (spread2 * variance**2)
    basis = width_basis(stars.xy_px[bright], *size)
    weighted = basis * weight[:, None]
    normal, right = weighted.T @ basis, weighted.T @ (variance * (1.0 + change))
    noise = noise_sums(fit, noise_dn, expected)
    if before is not None:
        keep = _MEMORY
        normal, right = normal + keep * before.width_normal, right + keep * before.width_right
        noise = NoiseSums(
            noise.normal + keep * before.noise.normal, noise.right + keep * before.noise.right
        )
        median = median + keep * (before.shape_median - median)
        scatter = scatter + keep * (before.shape_scatter - scatter)
    return Instrument(*size, normal, right, noise, median, scatter, saturation_dn)
