"""
Gaussian fits to stars, all stars of an image at once.

A pixel-integrated circular Gaussian with free position, flux and local background, weighted by the
noise of each pixel, attains the Cramer-Rao bound of the stamp.

Noise of a pixel with background-free signal S, in digital numbers (DN)::

    variance = noise_dn^2 + S / gain + (psf_error S)^2

``psf_error`` is how far the real PSF is from the Gaussian, as a fraction.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Floats = NDArray[np.float64]

_FIT_STEPS = 12  # stars settle in three to five; what has not by then is no star


@dataclass(frozen=True)
class PixelNoise:
    """Noise of one pixel with signal S: ``noise^2 + S / gain + (psf_error S)^2``, DN."""

    gain_e_per_dn: float
    psf_error: float

    def variance(self, signal_dn: Floats, noise_dn: Floats) -> Floats:
        """Variance in DN^2; negative signal counts as none."""
        signal = np.maximum(signal_dn, 0.0)
        return noise_dn**2 + signal / self.gain_e_per_dn + (self.psf_error * signal) ** 2


@dataclass(frozen=True)
class PsfFit:
    """
    Gaussian fits to stamps: position relative to the stamp's centre, flux, background.

    ``parameters`` (n, 4): x, y (px), flux, background (DN).  ``covariance`` (n, 4, 4) of them.
    ``reduced_chi2`` and ``worst_pixel_sigma`` (n,): fit quality under the pixel noise.
    ``shape_change`` and ``shape_sigma`` (n, 3): departure of the second moments xx, yy, xy from
    those of the PSF as a fraction of its variance, and their 1-sigma.
    """

    parameters: Floats
    covariance: Floats
    reduced_chi2: Floats
    worst_pixel_sigma: Floats
    shape_change: Floats
    shape_sigma: Floats


def stamp_radius_px(psf_sigma_px: float) -> int:
    """Half width of the fitting window: beyond 3.5 sigma lies under 0.3 % of a star's light."""
    return int(np.clip(np.ceil(3.5 * psf_sigma_px), 3, 12))


def fit_psf(
    stamps: Floats,
    sigma_px: float,
    noise_dn: Floats,
    pixel_noise: PixelNoise,
    saturation_dn: float = np.inf,
) -> PsfFit:
    """
    Weighted least-squares fit of the pixel-integrated Gaussian to every stamp at once.

    Parameters
    ----------
    stamps : (n, w, w)
        Pixel values, DN; the star within a pixel or so of the centre.
    sigma_px : float
        Width of the PSF.
    noise_dn : (n,)
        Background noise at each star.
    pixel_noise : PixelNoise
        How the noise grows with signal.
    saturation_dn : float
        Pixels at or above this say nothing of the star and take no part.

    Notes
    -----
    Gauss-Newton with the weights renewed from the model at each step, so that the noise of the
    data does not bias them; a step in position is at most half a pixel.  Stars that have settled
    to a thousandth of their sigma are left alone.
    """
    n, w, _ = stamps.shape
    data = stamps.reshape(n, w * w)
    valid = data < saturation_dn
    border = np.concatenate(
        [stamps[:, 0], stamps[:, -1], stamps[:, 1:-1, 0], stamps[:, 1:-1, -1]], axis=1
    )
    background = np.median(border, axis=1)
    peak_fraction = (2 * ndtr(0.5 / sigma_px) - 1) ** 2
    flux = (stamps[:, w // 2, w // 2] - background) / peak_fraction
    parameters = np.stack([np.zeros(n), np.zeros(n), flux, background], axis=-1)
    active = np.arange(n)
    for _ in range(_FIT_STEPS):
        at = parameters[active]
        J = _psf_columns(at, sigma_px, w, 4)
        signal = at[:, 2, None] * J[:, 2]
        weight = valid[active] / pixel_noise.variance(signal, noise_dn[active, None])
        step, covariance = _weighted_step(J, weight, data[active] - at[:, 3, None] - signal)
        step[:, :2] = np.clip(step[:, :2], -0.5, 0.5)
        at = at + step
        at[:, :2] = np.clip(at[:, :2], -w / 2, w / 2)
        parameters[active] = at
        moving = np.abs(step[:, :2]) > 1e-3 * np.sqrt(np.einsum('nii->ni', covariance)[:, :2])
        active = active[moving.any(axis=1)]
        if len(active) == 0:
            break

    # Second moments: one linear step from the solution, in units of the PSF variance.
    J = _psf_columns(parameters, sigma_px, w, 7)
    signal = parameters[:, 2, None] * J[:, 2]
    weight = valid / pixel_noise.variance(signal, noise_dn[:, None])
    residual = data - parameters[:, 3, None] - signal
    _, covariance = _weighted_step(J[:, :4], weight, residual)
    shape_step, shape_covariance = _weighted_step(J, weight, residual)
    normalised2 = weight * residual**2
    return PsfFit(
        parameters=parameters,
        covariance=covariance,
        reduced_chi2=normalised2.sum(axis=1) / np.maximum(valid.sum(axis=1) - 4, 1),
        worst_pixel_sigma=np.sqrt(normalised2.max(axis=1, initial=0.0)),
        shape_change=shape_step[:, 4:],
        shape_sigma=np.sqrt(np.einsum('nii->ni', shape_covariance)[:, 4:]),
    )


def neighbour_pull_px(
    flux_dn: Floats,
    offset_px: Floats,
    neighbour_flux_dn: Floats,
    sigma_px: float,
    noise_dn: float,
    pixel_noise: PixelNoise,
) -> Floats:
    """
    How far (k, 2) the light of a neighbour pulls the fitted place of a star.

    One linear step of the fit, with the light of the neighbour as its residual.

    Parameters
    ----------
    flux_dn, neighbour_flux_dn : (k,)
    offset_px : (k, 2)
        From the star to its neighbour.
    sigma_px, noise_dn, pixel_noise
        Width of the PSF, and the noise as in `fit_psf`.
    """
    width = 2 * stamp_radius_px(sigma_px) + 1
    zero = np.zeros(len(flux_dn))
    J = _psf_columns(np.stack([zero, zero, flux_dn, zero], axis=-1), sigma_px, width, 4)
    own = flux_dn[:, None] * J[:, 2]
    at = np.stack([*offset_px.T, neighbour_flux_dn, zero], axis=-1)
    light = neighbour_flux_dn[:, None] * _psf_columns(at, sigma_px, width, 4)[:, 2]
    noise = np.full((len(flux_dn), 1), noise_dn)
    weight = 1.0 / pixel_noise.variance(own + light, noise)
    step, _ = _weighted_step(J, weight, light)
    return step[:, :2]


def estimate_noise(stamps: Floats, sigma_px: float, noise_dn: Floats, gain: float) -> PixelNoise:
    """
    Gain and PSF error that make the squared fit residuals of bright stars their variance.

    Non-negative regression of ``residual^2 - noise^2`` on S and S^2 over the pixels that a star
    lights, each weighted by its own expected spread; repeated as the weights settle.  A gain that
    is given (not 0) is kept.
    """
    estimate = PixelNoise(gain or 1.0, 0.02)
    offsets = np.arange(stamps.shape[1], dtype=np.float64) - (stamps.shape[1] - 1) / 2.0
    for _ in range(3):
        fit = fit_psf(stamps, sigma_px, noise_dn, estimate)
        x, y, flux, level = fit.parameters.T
        px, py = _profile(x, sigma_px, offsets)[0], _profile(y, sigma_px, offsets)[0]
        signal = flux[:, None, None] * py[:, :, None] * px[:, None, :]
        residual = stamps - level[:, None, None] - signal
        noise2 = np.broadcast_to(noise_dn[:, None, None] ** 2, signal.shape)
        lit = signal > noise_dn[:, None, None]
        s, noise2 = signal[lit], noise2[lit]
        variance = noise2 + s / estimate.gain_e_per_dn + (estimate.psf_error * s) ** 2
        keep = np.abs(residual[lit]) < 5.0 * np.sqrt(variance)
        # 4 parameters of each star are fitted: its lit residuals are smaller by that much.
        lit_count = max(np.count_nonzero(keep), 1)
        shrink = max(1.0 - 3.0 * len(stamps) / lit_count, 0.3)
        s, noise2, variance = s[keep], noise2[keep], variance[keep]
        target = (residual[lit][keep] ** 2) / shrink - noise2
        A = np.stack([s, s**2], axis=-1) / variance[:, None]
        b = target / variance
        if gain:
            b, A = b - A[:, 0] / gain, A[:, 1:]
            per_signal, per_signal2 = (
                1.0 / gain,
                max(float(A[:, 0] @ b / (A[:, 0] @ A[:, 0])), 0.0),
            )
        else:
            per_signal, per_signal2 = np.linalg.lstsq(A, b, rcond=None)[0]
            if per_signal2 < 0.0:
                per_signal, per_signal2 = float(A[:, 0] @ b / (A[:, 0] @ A[:, 0])), 0.0
            elif per_signal < 0.0:
                per_signal, per_signal2 = 0.0, float(A[:, 1] @ b / (A[:, 1] @ A[:, 1]))
        estimate = PixelNoise(
            1.0 / float(np.clip(per_signal, 1e-4, 1e4)),
            float(np.sqrt(np.clip(per_signal2, 0, 0.25))),
        )
    return estimate


def _profile(centre: Floats, sigma_px: float, offsets: Floats) -> tuple[Floats, Floats, Floats]:
    """
    Pixel-integrated Gaussian along one axis with its first and second derivative by the centre.

    ``centre`` (n,); ``offsets`` (w,) pixel centres; each result is (n, w).
    The derivative by sigma^2 is half of the second one by the centre (heat equation).
    """
    edges = np.concatenate([offsets - 0.5, offsets[-1:] + 0.5])
    t = (edges - centre[:, None]) / sigma_px
    density = np.exp(-0.5 * t**2) / math.sqrt(2.0 * math.pi)
    value = np.diff(ndtr(t), axis=1)
    first = -np.diff(density, axis=1) / sigma_px
    second = -np.diff(t * density, axis=1) / sigma_px**2
    return value, first, second


def _psf_columns(parameters: Floats, sigma_px: float, width: int, count: int) -> Floats:
    """
    Derivatives (n, count, width * width) of a stamp by x, y, flux, background.

    And, with count 7, by the second moments xx, yy, xy as fractions of the PSF's variance.
    """
    offsets = np.arange(width, dtype=np.float64) - (width - 1) / 2.0
    x, y, flux, _ = parameters.T
    px, px1, px2 = _profile(x, sigma_px, offsets)
    py, py1, py2 = _profile(y, sigma_px, offsets)
    J = np.empty((len(x), count, width, width))

    def put(column: int, along_y: Floats, along_x: Floats) -> None:
        np.multiply(along_y[:, :, None], along_x[:, None, :], out=J[:, column])

    flux = flux[:, None]
    put(0, py, flux * px1)
    put(1, py1, flux * px)
    put(2, py, px)
    J[:, 3] = 1.0
    if count == 7:
        half_variance = 0.5 * sigma_px**2
        put(4, py, half_variance * flux * px2)
        put(5, py2, half_variance * flux * px)
        put(6, py1, 2 * half_variance * flux * px1)
    return J.reshape(len(x), count, width * width)


def _weighted_step(J: Floats, weight: Floats, residual: Floats) -> tuple[Floats, Floats]:
    """
    Weighted least-squares step (n, k) and covariance (n, k, k) of many small problems.

    ``J`` is (n, k, p), ``weight`` and ``residual`` (n, p).  The normal matrices are scaled to a
    unit diagonal, and a trace of it keeps a stamp without light solvable.
    """
    k = J.shape[1]
    weighted = J * weight[:, None, :]
    normal = weighted @ J.transpose(0, 2, 1)
    scale = 1.0 / np.sqrt(np.maximum(np.einsum('nii->ni', normal), 1e-12))
    scaled = normal * scale[:, :, None] * scale[:, None, :] + 1e-9 * np.eye(k)
    covariance = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    gradient = (weighted @ residual[:, :, None])[:, :, 0]
    return (covariance @ gradient[:, :, None])[:, :, 0], covariance
