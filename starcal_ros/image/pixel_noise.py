"""
Noise of a pixel, and how it is estimated from the residuals of fitted stars.

Noise of a pixel with background-free signal S of a star of flux F, in digital numbers (DN)::

    variance = background noise_dn^2 + S / gain + psf_error^2 S F

``background`` is how much more a pixel beside a star scatters than one of the open sky, and
``psf_error`` is how far the real PSF is from the Gaussian.  That error is of one sign over several
pixels, and largest beside the core: no noise that weights could hold down.  A fit that trusts the
core less for its sake leans on the wings, where the Gaussian is worst.  So the weights are of the
noise alone, and the error of the PSF is in the covariance.  With F in its term it grows as the
square of the brightness, and photon noise as the brightness: that tells one from the other.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from starcal_ros.arrays import Floats

_SIGNIFICANT = 3.0  # sigma
_LIKELY = 1.9  # sigma


@dataclass(frozen=True)
class PixelNoise:
    """Noise of a pixel: ``background noise^2 + S / gain + psf_error^2 S F``, S of it, F of all."""

    gain_e_per_dn: float
    psf_error: float
    background: float = 1.0

    def variance(self, signal_dn: Floats, noise_dn: Floats, flux_dn: Floats) -> Floats:
        """Variance in DN^2; negative signal counts as none."""
        signal = np.maximum(signal_dn, 0.0)
        per_signal = 1.0 / self.gain_e_per_dn + self.psf_error**2 * np.maximum(flux_dn, 0.0)
        return np.asarray(self.background * noise_dn**2 + per_signal * signal)


def expected_snr(
    flux_dn: Floats, sigma_px: float | Floats, noise_dn: float | Floats, noise: PixelNoise
) -> Floats:
    """Signal-to-noise (n,) of stars of a flux, from their photons and 4 pi sigma^2 px of sky."""
    flux = np.maximum(flux_dn, 0.0)
    sky_dn2 = 4.0 * math.pi * sigma_px**2 * noise.background * noise_dn**2
    return np.asarray(flux / np.sqrt(sky_dn2 + flux / noise.gain_e_per_dn))


@dataclass(frozen=True)
class NoiseSums:
    """
    What residuals say of the pixel noise: a regression of their squares on noise_dn^2, S and S F.

    ``normal`` (3, 3) and ``right`` (3,), with each pixel weighted by its own expected spread.
    Sums of several images can be added.
    """

    normal: Floats
    right: Floats

    def pixel_noise(self, gain_e_per_dn: float = 0.0) -> PixelNoise:
        """
        Noise with which the squared residuals are their variance.

        A gain that is given (not 0) is kept.  An error of the PSF that is not significant is
        none: it would take its share of the photon noise with it.
        """
        per_signal = 1.0 / gain_e_per_dn if gain_e_per_dn else 0.0
        found = np.array([1.0, per_signal, 0.0])
        right = self.right - self.normal[:, 1] * per_signal
        free = [0, 2] if gain_e_per_dn else [0, 1, 2]
        scale = 1.0 / np.sqrt(np.maximum(self.normal.diagonal(), 1e-300))
        correlation = self.normal * scale * scale[:, None] + 1e-9 * np.eye(3)
        while free:
            inverse = np.linalg.inv(correlation[free][:, free])
            value = scale[free] * (inverse @ (scale * right)[free])
            # A squared normal residual over its variance has a variance of 2.
            sigma = scale[free] * np.sqrt(2.0 * inverse.diagonal())
            if free[-1] == 2 and value[-1] < _SIGNIFICANT * sigma[-1]:
                # Few stars cannot separate the two: the gain goes only where nothing shows it.
                gain_shows_less = (
                    1 in free and value[1] < sigma[1] and value[2] > _LIKELY * sigma[2]
                )
                free = [0, 2] if gain_shows_less else [0, 1] if not gain_e_per_dn else [0]
            elif 1 in free and value[free.index(1)] < 0.0:
                free.remove(1)
            else:
                found[free] = value
                break
        background, per_signal, error2 = found
        return PixelNoise(
            1.0 / min(max(float(per_signal), 1e-4), 1e4),
            math.sqrt(min(max(float(error2), 0.0), 0.25)),
            min(max(float(background), 0.25), 4.0),
        )
