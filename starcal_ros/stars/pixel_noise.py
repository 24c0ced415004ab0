# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Noise of a pixel, and its estimate from the residuals of fitted stars.

Noise of a pixel with background-free signal S of a star of flux F, in digital numbers (DN)::

    variance = background noise_dn^2 + S / gain + psf_error^2 S F

``background`` is the variance of a pixel beside a star over that of the open sky, and
``psf_error`` the relative deviation of the real PSF from the Gaussian.  That deviation has one
sign over several pixels and is largest beside the core: it is not noise that weights could reduce.
A fit with a smaller weight on the core would depend on the wings, where the Gaussian is worst.  So
the weights contain the noise alone, and the covariance contains the PSF error as well.  The PSF
term grows as the square of the brightness and photon noise as the brightness, so that a regression
separates the two.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from starcal_ros.arrays import Floats, Indices, Pixels

# Largest values of converters of 8 to 16 bits, in quantisation steps.
CONVERTER_ENDS = (255, 1023, 4095, 16383, 65535)
_STEP_SAMPLE = 64  # rows and columns read of a frame: the noise of most skies shows the step
# Values that show a step: seven differences are all even by chance once in 100 times.
_FEWEST_VALUES = 8
_SIGNIFICANT = 3.0  # sigma
_LIKELY = 1.9  # sigma


def quantisation_step_dn(pixels: Pixels) -> int:
    """
    Greatest common step of the values of a frame (height, width), DN; 1 where few values show it.

    A frame of 8 or 12 bits scaled to 16 has a step of 257, 16 or 17 DN: the rounding noise of its
    pixels is that part of a step, and the end of its converter that many steps.
    """
    down, across = (max(1, side // _STEP_SAMPLE) for side in pixels.shape)
    values = _values(pixels[::down, ::across])
    # The step of the frame divides that of its sample: it is read as a whole only if quiet.
    if len(values) < _FEWEST_VALUES and np.gcd.reduce(np.diff(values)) != 1:
        # Part by part, since a count converts its pixels to 8 bytes.
        parts = [_values(pixels[first::_STEP_SAMPLE]) for first in range(_STEP_SAMPLE)]
        values = np.unique(np.concatenate(parts))
    return int(np.gcd.reduce(np.diff(values))) if len(values) >= _FEWEST_VALUES else 1


def _values(pixels: Pixels) -> Indices:
    """Values (k,) of the pixels, sorted."""
    # A table of counts takes a twentieth of the time of a sort.
    return np.flatnonzero(np.bincount(pixels.ravel()))


def rounding_noise_dn(step_dn: float) -> float:
    """1-sigma noise of a value rounded to whole steps."""
    return step_dn / math.sqrt(12.0)


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a pixel: ``background noise_dn^2 + S / gain + psf_error^2 S F``."""

    gain_e_per_dn: float
    psf_error: float
    background: float = 1.0

    def variance(self, signal_dn: Floats, noise_dn: Floats, flux_dn: Floats) -> Floats:
        """Variance, DN^2; negative signal counts as 0."""
        signal = np.maximum(signal_dn, 0.0)
        per_signal = 1.0 / self.gain_e_per_dn + self.psf_error**2 * np.maximum(flux_dn, 0.0)
        return np.asarray(self.background * noise_dn**2 + per_signal * signal)


def expected_snr(
    flux_dn: Floats, sigma_px: float | Floats, noise_dn: float | Floats, noise: PixelNoise
) -> Floats:
    """Signal-to-noise (n,) of stars of a flux: photon noise and 4 pi sigma^2 px of sky noise."""
    flux = np.maximum(flux_dn, 0.0)
    sky_dn2 = 4.0 * math.pi * sigma_px**2 * noise.background * noise_dn**2
    return np.asarray(flux / np.sqrt(sky_dn2 + flux / noise.gain_e_per_dn))


def blurred_px(sigma_px: float | Floats, streak_px: float | Floats) -> Floats:
    """Width of the Gaussian with the noise-equivalent area of one moved along a line, to 5 %."""
    # The area is 4 pi sigma^2 without, 2 sqrt(pi) sigma s with a long path s.
    return np.asarray(sigma_px * (1.0 + (streak_px / sigma_px) ** 2 / (4.0 * math.pi)) ** 0.25)


@dataclass(frozen=True)
class NoiseSums:
    """
    Normal equations of a regression of squared residuals on noise_dn^2, S and S F.

    ``normal`` (3, 3) and ``right`` (3,); each pixel is weighted by its expected variance.  Sums of
    several images can be added.
    """

    normal: Floats
    right: Floats

    def pixel_noise(self, gain_e_per_dn: float = 0.0) -> PixelNoise:
        """
        Noise model that fits the squared residuals.

        A given gain (not 0) is kept.  A PSF error that is not significant is set to 0, because it
        would otherwise absorb a part of the photon noise.
        """
        per_signal = 1.0 / gain_e_per_dn if gain_e_per_dn else 0.0
        terms = np.array([1.0, per_signal, 0.0])
        right = self.right - self.normal[:, 1] * per_signal
        free = [0, 2] if gain_e_per_dn else [0, 1, 2]
        scale = 1.0 / np.sqrt(np.maximum(self.normal.diagonal(), 1e-300))
        correlation = self.normal * scale * scale[:, None] + 1e-9 * np.eye(3)
        while free:
            inverse = np.linalg.inv(correlation[free][:, free])
            value = scale[free] * (inverse @ (scale * right)[free])
            # The square of a normal residual over its variance has a variance of 2.
            sigma = scale[free] * np.sqrt(2.0 * inverse.diagonal())
            if free[-1] == 2 and value[-1] < _SIGNIFICANT * sigma[-1]:
                # Few stars cannot separate the two: the gain is dropped only if undetected.
                gain_shows_less = (
                    1 in free and value[1] < sigma[1] and value[2] > _LIKELY * sigma[2]
                )
                free = [0, 2] if gain_shows_less else [0, 1] if not gain_e_per_dn else [0]
            elif 1 in free and value[free.index(1)] < 0.0:
                free.remove(1)
            else:
                terms[free] = value
                break
        background, per_signal, error2 = terms
        return PixelNoise(
            1.0 / min(max(float(per_signal), 1e-4), 1e4),
            math.sqrt(min(max(float(error2), 0.0), 0.25)),
            min(max(float(background), 0.25), 4.0),
        )
