# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Gaussian fits to stars, all stars of an image at once.

A pixel-integrated circular Gaussian with free position, flux and local background, weighted by the
noise of each pixel, attains the Cramer-Rao bound of the stamp.  In an image with streaks it is the
mean of such Gaussians along a line, by Gauss-Legendre quadrature.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf, ndtr

from starcal_ros.arrays import Floats, Mask, rows_of
from starcal_ros.stars.hot_pixels import CORE_PX, lit_alone
from starcal_ros.stars.pixel_noise import blurred_px, expected_snr, NoiseSums, PixelNoise

_FIT_STEPS = 4  # stars converge in two or three; other sources may not
# After a step s, an error of s / SNR remains for faint stars, of s^2 / sigma_px for bright ones.
# If s^2 is below this fraction of sigma_px times the position noise, the last step leaves 0.1 of
# that noise.
_SETTLED = 0.3
_MOMENTS = np.array([[-1, 0, 1] * 3, [-1] * 3 + [0] * 3 + [1] * 3, [1] * 9], np.float64).T
_MOST_RADIUS_PX = 15
MISFIT_SIGMA = 5.0  # normal noise in 81 pixels exceeds it for one star in 20,000


@dataclass(frozen=True)
class PsfFit:
    """
    Gaussian fits to stamps.

    ``parameters`` (n, 4): x, y from the centre of the stamp (px), flux, background (DN).
    ``covariance`` (n, 4, 4) of the parameters.
    ``snr`` (n,): flux over its 1-sigma from the noise alone.
    ``worst_pixel_sigma`` (n,): largest residual of a pixel in units of its noise.
    ``shape_change`` and ``shape_sigma`` (n, 3): departure of the second moments xx, yy, xy from
    those of the PSF as a fraction of its variance, and its 1-sigma.
    ``signal_dn``, ``residual_dn`` and ``sigma_dn`` (n, p): light of the star in each pixel of its
    stamp, residual of the fit and 1-sigma of the noise, NaN for excluded pixels.
    ``leverage`` (n, p): part of the noise of a pixel that the fit follows.
    """

    parameters: Floats
    covariance: Floats
    snr: Floats
    worst_pixel_sigma: Floats
    shape_change: Floats
    shape_sigma: Floats
    signal_dn: Floats
    residual_dn: Floats
    sigma_dn: Floats
    leverage: Floats


def stamp_radius_px(psf_sigma_px: float, streak_px: float = 0.0) -> int:
    """Half width of the fitting window; beyond 3 sigma a PSF gives no position information."""
    return min(max(math.ceil(3.0 * psf_sigma_px + 0.5 * streak_px), 3), _MOST_RADIUS_PX)


@dataclass(frozen=True)
class Stamps:
    """
    Square windows about stars, with PSF width and noise for their fits.

    Parameters
    ----------
    data_dn : (n, w, w)
        Pixel values, DN; the star within a pixel or so of the middle.
    sigma_px : (n,)
        Width of the PSF at each star.
    noise2_dn2 : (n, 1) or (n, w * w)
        Pixel variance for each star, or for each pixel, without the photon noise of the star.
    out : (n, w, w), optional
        Mask of the pixels to leave out: saturated, hot, outside the image.
    streak_px : (n, 2), optional
        Path of each star during the exposure; None: sharp stars.
    uneven : (n,), optional
        Mask of the stars whose background has a slope; None: all have a level alone.
    """

    data_dn: Floats
    sigma_px: Floats
    noise2_dn2: Floats
    out: Mask | None = None
    streak_px: Floats | None = None
    uneven: Mask | None = None

    def __len__(self) -> int:
        """Return the number of stars."""
        return len(self.data_dn)

    @property
    def width(self) -> int:
        """Pixels along each side of a window."""
        return self.data_dn.shape[1]

    @property
    def flat_dn(self) -> Floats:
        """Pixel values, (n, w * w)."""
        return self.data_dn.reshape(len(self), self.width**2)

    @property
    def valid(self) -> Mask | None:
        """Mask (n, w * w) of the pixels to be fitted; None: all."""
        return None if self.out is None else ~self.out.reshape(len(self), self.width**2)

    def select(self, stars: NDArray[np.intp]) -> Stamps:
        """Return the windows of some stars, by ascending row number without repetition."""
        if len(stars) == len(self):
            return self
        return rows_of(self, stars)


def fit_psf(
    stamps: Floats,
    sigma_px: float,
    noise_dn: Floats,
    pixel_noise: PixelNoise,
    streak_px: Floats | None = None,
) -> PsfFit:
    """
    Weighted least-squares fit of the pixel-integrated Gaussian to every stamp (n, w, w), DN.

    Each star is within about a pixel of the centre.  ``sigma_px`` is the width of the PSF,
    ``noise_dn`` (n,) the pixel noise without the photon noise of the star, ``streak_px`` (n, 2)
    the path of each star during the exposure.
    """
    sigma = np.full(len(stamps), sigma_px)
    windows = Stamps(stamps, sigma, noise_dn[:, None] ** 2, streak_px=streak_px)
    guess = first_guess(windows, border_level_dn(stamps))
    return fit_at(windows, approach(windows, guess, pixel_noise)[0], pixel_noise)


def approach(stamps: Stamps, parameters: Floats, pixel_noise: PixelNoise) -> tuple[Floats, Mask]:
    """
    Parameters (n, 4) one step before the minimum: x, y (px), flux, background (DN).

    Gauss-Newton with weights from the model of each step, so that the noise of the data does not
    bias them; a step in position is at most half a pixel.  A star is done when one more step,
    which `fit_at` takes, reaches the minimum; also a mask (n,) of the stars that are.
    """
    parameters = parameters.copy()
    active = np.arange(len(stamps))
    for _ in range(_FIT_STEPS):
        if len(active) == 0:
            break
        chosen = stamps.select(active)
        parameters[active], step, normal = _nearer(chosen, parameters[active], pixel_noise)
        # Position noise for fixed flux and background: a lower bound, and cheap.
        place_sigma_px = 1.0 / np.sqrt(np.einsum('nii->ni', normal)[:, :2])
        limit_px2 = _SETTLED * place_sigma_px * chosen.sigma_px[:, None]
        active = active[(step[:, :2] ** 2 > limit_px2).any(axis=1)]
    done = np.ones(len(stamps), bool)
    done[active] = False
    return parameters, done


def surely_fainter(
    stamps: Stamps, parameters: Floats, done: Mask, snr: float, pixel_noise: PixelNoise
) -> Mask:
    """
    Mask (n,) of the stars whose fit by `fit_at` will be below a signal-to-noise ratio.

    The arguments are those of `fit_at` and the mask of `approach`.
    """
    flux, level = parameters[:, 2], parameters[:, 3]
    path_px = 0.0 if stamps.streak_px is None else np.hypot(*stamps.streak_px.T)
    blurred = blurred_px(stamps.sigma_px, path_px)
    noise_dn = np.sqrt(stamps.noise2_dn2.min(axis=1))
    # The free background adds as much noise as a wider star; the last step is a tenth of a sigma.
    wider = blurred / np.sqrt(1.0 - 4.0 * math.pi * blurred**2 / stamps.width**2)
    most = expected_snr(flux, wider, noise_dn, pixel_noise)
    # The fit may do without a single pixel.
    brightest_dn = stamps.flat_dn.max(axis=1) - level
    even = brightest_dn < (MISFIT_SIGMA - 1.0) * math.sqrt(pixel_noise.background) * noise_dn
    return np.asarray(done & even & (most < snr - 0.75))


def _nearer(
    stamps: Stamps, parameters: Floats, pixel_noise: PixelNoise
) -> tuple[Floats, Floats, Floats]:
    """Parameters (n, 4) after a step towards the fit, the step, and normal matrices (n, 4, 4)."""
    normal, gradient = _normal(_whitened_rows(parameters, stamps, pixel_noise, 4)[0], parameters)
    step = np.asarray(np.linalg.solve(normal, gradient[:, :, None])[:, :, 0], np.float64)
    step[:, :2].clip(-0.5, 0.5, out=step[:, :2])
    half_px = stamps.width / 2
    parameters = parameters + step
    parameters[:, :2].clip(-half_px, half_px, out=parameters[:, :2])
    return parameters, step, normal


def fit_at(stamps: Stamps, parameters: Floats, pixel_noise: PixelNoise) -> PsfFit:
    """
    Fits after a last step from parameters (n, 4) near the minimum, with covariance and residuals.

    Excludes a single pixel that does not fit, such as a cosmic ray on the flank of a bright star.
    """
    # Second moments: one linear step from the solution, in units of the PSF variance.
    rows, light, root_weight = _whitened_rows(parameters, stamps, pixel_noise, 7)
    normal, gradient = _normal(rows, parameters)
    covariance = np.asarray(np.linalg.inv(normal[:, :4, :4]), np.float64)
    last = (covariance @ gradient[:, :4, None])[:, :, 0]
    last[:, :2].clip(-0.5, 0.5, out=last[:, :2])
    residual = _residual(parameters, last, rows)
    spoilt, pixel = _single_misfits(residual, light, parameters, stamps)
    if len(spoilt):
        root_weight[spoilt, pixel], rows[spoilt, :, pixel] = 0.0, 0.0
        rows[spoilt] = _less_slopes(rows[spoilt], root_weight[spoilt], stamps.select(spoilt))
        normal[spoilt], gradient[spoilt] = _normal(rows[spoilt], parameters[spoilt])
        covariance[spoilt] = np.linalg.inv(normal[spoilt, :4, :4])
        last[spoilt] = (covariance[spoilt] @ gradient[spoilt, :4, None])[:, :, 0]
        residual[spoilt] = _residual(parameters[spoilt], last[spoilt], rows[spoilt])
    # Only the columns of the moments of the 7 x 7 inverse are needed.
    of_shape = np.linalg.solve(normal, np.broadcast_to(np.eye(7)[:, 4:], (len(normal), 7, 3)))
    shape_step = (gradient[:, None, :] @ of_shape)[:, 0]
    shape_variance = of_shape[:, [4, 5, 6], [0, 1, 2]]
    leverage = np.einsum('nkp,nkp->np', covariance @ rows[:, :4], rows[:, :4])
    parameters = parameters + last
    snr = parameters[:, 2] / np.sqrt(covariance[:, 2, 2])
    excess: Floats | float = 0.0
    if pixel_noise.psf_error > 0:
        # The variance that the PSF error adds to a pixel, over the variance in its weight.
        flux = np.maximum(parameters[:, 2, None], 0.0)
        excess = pixel_noise.psf_error**2 * flux * light * root_weight**2
        scatter = (rows[:, :7] * excess[:, None, :]) @ rows[:, :7].transpose(0, 2, 1)
        covariance = covariance + covariance @ scatter[:, :4, :4] @ covariance
        shape_variance = shape_variance + (of_shape * (scatter @ of_shape)).sum(axis=1)
    with np.errstate(divide='ignore', invalid='ignore'):
        residual_dn = residual / root_weight
        sigma_dn = np.where(root_weight > 0.0, np.sqrt(1.0 + excess) / root_weight, np.nan)
    return PsfFit(
        parameters=parameters,
        covariance=covariance,
        snr=snr,
        worst_pixel_sigma=np.abs(residual / np.sqrt(1.0 + excess)).max(axis=1, initial=0.0),
        shape_change=shape_step,
        shape_sigma=np.sqrt(shape_variance),
        signal_dn=light,
        residual_dn=residual_dn,
        sigma_dn=sigma_dn,
        leverage=leverage,
    )


def _residual(parameters: Floats, step: Floats, rows: Floats) -> Floats:
    """Residuals (n, p) over the noise after a step (n, 4) from the parameters, to first order."""
    modelled = step.copy()
    modelled[:, 2:] += parameters[:, 2:]
    return np.asarray(rows[:, -1] - (modelled[:, None, :] @ rows[:, :4])[:, 0])


def _single_misfits(
    sigmas: Floats, light: Floats, parameters: Floats, stamps: Stamps
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """
    Rows (k,) of stars with a single pixel that is too bright, and the index (k,) of that pixel.

    Pixels of the core never count: a star cannot be measured well without its peak.  ``sigmas``
    (n, p) are the residuals in units of pixel noise, ``light`` (n, p) the light of the stars.
    """
    width = stamps.width
    star = np.flatnonzero(sigmas.max(axis=1, initial=0.0) > MISFIT_SIGMA)
    pixel = sigmas[star].argmax(axis=1)
    v, u = np.divmod(pixel, width)
    x, y = parameters[star, :2].T + width // 2
    away = np.hypot(u - x, v - y) > CORE_PX
    star, pixel, v, u = star[away], pixel[away], v[away], u[away]
    left_dn = stamps.flat_dn[star] - light[star] - parameters[star, 3, None]
    # Dark rims: the stamps lie below each other.
    rimmed = np.zeros((len(star), width + 2, width + 2))
    rimmed[:, 1:-1, 1:-1] = left_dn.reshape(-1, width, width)
    row = np.arange(len(star)) * (width + 2)
    alone = lit_alone(rimmed.reshape(-1, width + 2), row + v + 1, u + 1, 0.0)
    return star[alone], pixel[alone]


def first_guess(windows: Stamps, background: Floats) -> Floats:
    """
    Start parameters (n, 4) of the fit, from the centre of light of the middle 3 x 3 pixels.

    ``background`` (n,) is the result of `border_level_dn`.
    """
    stamps, sigma_px, c = windows.data_dn, windows.sigma_px, windows.width // 2
    if windows.streak_px is not None:
        # The middle pixels do not show the place along a streak.
        flux = stamps.sum(axis=(1, 2)) - windows.width**2 * background
        return np.stack([*np.zeros((2, len(stamps))), flux, background], axis=-1)
    core = stamps[:, c - 1 : c + 2, c - 1 : c + 2].reshape(-1, 9)
    off_x, off_y, total = (core @ _MOMENTS).T
    total = total - 9.0 * background
    share = erf(1.5 / (math.sqrt(2.0) * sigma_px))  # part of the light in three pixels
    # Difference of the outer two of three pixels for an offset of one pixel.
    slope = 2.0 * (_gauss(0.5 / sigma_px) - _gauss(1.5 / sigma_px)) / sigma_px
    per_light = share / slope / np.maximum(total, 1e-12)
    guess = np.stack([off_x * per_light, off_y * per_light, total / share**2, background], axis=-1)
    guess[:, :2].clip(-0.7, 0.7, out=guess[:, :2])
    return guess


def border_level_dn(stamps: Floats) -> Floats:
    """Medians (n,) of the outermost pixels of windows (n, w, w)."""
    border = np.concatenate(
        [stamps[:, 0], stamps[:, -1], stamps[:, 1:-1, 0], stamps[:, 1:-1, -1]], axis=1
    )
    middle = border.shape[1] // 2
    return np.asarray(np.partition(border, middle, axis=1)[:, middle])


def light_in_stamps(
    place_px: Floats,
    flux_dn: Floats,
    sigma_px: Floats,
    width: int,
    streak_px: Floats | None = None,
) -> Floats:
    """Light (k, width^2) in stamps from stars at (k, 2) from their middles, inside or outside."""
    (columns, _, _), (rows, _, _) = _profiles(place_px, sigma_px, streak_px, width, False)
    light = rows.transpose(0, 2, 1) @ (flux_dn[:, None, None] * columns)
    return np.asarray(light.reshape(len(flux_dn), width * width))


def neighbour_pull_px(
    flux_dn: Floats,
    offset_px: Floats,
    neighbour_flux_dn: Floats,
    sigma_px: float,
    noise_dn: float,
    pixel_noise: PixelNoise,
    streak_px: Floats | None = None,
) -> Floats:
    """
    Shift (k, 2) of the fitted position of a star by the light of a neighbour.

    It is the position that the fit finds in the noise-free light of both stars.  ``offset_px``
    (k, 2) points from the star to its neighbour; PSF and noise are those of `fit_psf`.
    """
    width = 2 * stamp_radius_px(sigma_px, longest_px(streak_px)) + 1
    count = len(flux_dn)
    sigma = np.full(count, sigma_px)
    own, other = light_in_stamps(
        np.concatenate([np.zeros((count, 2)), offset_px]),
        np.concatenate([flux_dn, neighbour_flux_dn]),
        np.full(2 * count, sigma_px),
        width,
        None if streak_px is None else np.concatenate([streak_px, streak_px]),
    ).reshape(2, count, width, width)
    stamps = Stamps(own + other, sigma, np.full((count, 1), noise_dn**2), streak_px=streak_px)
    alone = np.stack([*np.zeros((2, count)), flux_dn, np.zeros(count)], axis=-1)
    # After two steps a hundredth of the shift remains.
    for _ in range(2):
        alone, _, _ = _nearer(stamps, alone, pixel_noise)
    return alone[:, :2]


def noise_sums(fit: PsfFit, noise_dn: Floats, expected: PixelNoise) -> NoiseSums:
    """
    Sums over the pixels of fitted stars, weighted by their expected variance.

    ``noise_dn`` (n,).  Each squared residual is corrected for the degrees of freedom of the fit;
    residuals of more than five sigma are left out.
    """
    noise2 = noise_dn[:, None] ** 2
    signal = np.maximum(fit.signal_dn, 0.0)
    flux = np.maximum(fit.parameters[:, 2, None], 0.0)
    variance = expected.variance(signal, noise_dn[:, None], flux)
    squared = fit.residual_dn**2 / np.maximum(1.0 - fit.leverage, 0.05)
    # The comparison is false for NaN, an excluded pixel.
    keep = squared < 25.0 * variance
    weight = keep / variance
    signal = signal * weight
    A = np.stack([noise2 * weight, signal, signal * flux]).reshape(3, -1)
    return NoiseSums(A @ A.T, A @ np.where(keep, squared * weight, 0.0).ravel())


def longest_px(streak_px: Floats | None) -> float:
    """Length of the longest of the streaks (n, 2), px; 0 without any."""
    if streak_px is None:
        return 0.0
    return float(np.hypot(streak_px[:, 0], streak_px[:, 1]).max(initial=0.0))


def apart_px(offset_px: Floats, sigma_px: float | Floats, streak_px: Floats | None) -> Floats:
    """Distances (k,) over offsets (k, 2), shorter along a streak as its light is wider there."""
    apart2 = (offset_px**2).sum(axis=-1)
    if streak_px is not None:
        variance = (streak_px**2).sum(axis=-1) / 12.0
        along2 = (offset_px * streak_px).sum(axis=-1) ** 2 / 12.0 / np.maximum(variance, 1e-9)
        apart2 = apart2 - along2 * variance / (variance + np.square(sigma_px))
    return np.asarray(np.sqrt(apart2))


def _gauss(t: Floats) -> Floats:
    return np.asarray(np.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi))


def _profile(
    centre: Floats, sigma_px: Floats, width: int, second: bool
) -> tuple[Floats, Floats, Floats]:
    """
    Pixel-integrated Gaussian along one axis with its first and second derivative by the centre.

    ``centre`` (...) from the middle of ``width`` pixels, ``sigma_px`` alike; results are (...,
    width).  The derivative by sigma^2 is half of the second one by the centre (heat equation).
    """
    edges = np.arange(width + 1) - width / 2.0
    t = (edges - centre[..., None]) / sigma_px[..., None]
    density = _gauss(t)
    cumulative = ndtr(t)
    value = cumulative[..., 1:] - cumulative[..., :-1]
    first = (density[..., :-1] - density[..., 1:]) / sigma_px[..., None]
    if not second:
        return value, first, first
    density *= t
    return value, first, (density[..., :-1] - density[..., 1:]) / sigma_px[..., None] ** 2


def _profiles(
    place_px: Floats, sigma_px: Floats, streak_px: Floats | None, width: int, second: bool
) -> tuple[tuple[Floats, Floats, Floats], tuple[Floats, Floats, Floats]]:
    """
    `_profile` of columns and of rows at the nodes of streaks, each (n, nodes, width).

    The columns have the weight of their node, so that the sum over the nodes of a row times a
    column is the light of a star.
    """
    n = len(sigma_px)
    if streak_px is None:
        # One call for both axes.
        centre = np.concatenate([place_px[:, 0], place_px[:, 1]])
        both = _profile(centre, np.concatenate([sigma_px, sigma_px]), width, second)
        value, first, last = both
        return (
            (value[:n, None], first[:n, None], last[:n, None]),
            (value[n:, None], first[n:, None], last[n:, None]),
        )
    # The quadrature is good to 1e-4 of the peak.
    count = math.ceil(longest_px(streak_px) / float(sigma_px.min(initial=1.0))) + 2
    nodes, weights = (0.5 * values for values in np.polynomial.legendre.leggauss(count))
    centre = place_px.T[:, :, None] + nodes * streak_px.T[:, :, None]
    value, first, last = _profile(
        centre, np.broadcast_to(sigma_px[:, None], centre.shape), width, second
    )
    weight = weights[:, None]
    return (
        (value[0] * weight, first[0] * weight, last[0] * weight),
        (value[1], first[1], last[1]),
    )


def _whitened_rows(
    parameters: Floats, stamps: Stamps, pixel_noise: PixelNoise, count: int
) -> tuple[Floats, Floats, Floats]:
    """
    Derivatives of stamps by x, y, flux, background, and as the last row their pixels.

    The rows (n, count + 1, p) are divided by the noise of each pixel, and 0 for pixels that are
    left out.  A count of 7 adds, after the background, derivatives by the second moments xx, yy,
    xy as fractions of the PSF variance.  Also returns the light (n, p) of the stars, and the
    inverse (n, p) of that noise.
    """
    n, width, sigma_px = len(stamps), stamps.width, stamps.sigma_px
    flux = parameters[:, 2, None]
    (px, px1, px2), (py, py1, py2) = _profiles(
        parameters[:, :2], sigma_px, stamps.streak_px, width, count == 7
    )
    rows = np.empty((n, count + 1, width * width))

    def spread(row: int, of_rows: Floats, of_columns: Floats) -> None:
        """Write the sum over the nodes of products of profiles (n, nodes, w) to a row."""
        square = rows[:, row].reshape(n, width, width)
        np.matmul(of_rows.transpose(0, 2, 1), of_columns, out=square)

    spread(2, py, px)
    px, px1 = flux[:, None] * px, flux[:, None] * px1
    spread(0, py, px1)
    spread(1, py1, px)
    rows[:, 3] = 1.0
    if count == 7:
        variance = sigma_px[:, None, None] ** 2
        spread(4, py, 0.5 * variance * flux[:, None] * px2)
        spread(5, 0.5 * variance * py2, px)
        spread(6, py1, variance * px1)
    rows[:, count] = stamps.flat_dn
    light = np.maximum(flux, 0.0) * rows[:, 2]
    root_weight = light / pixel_noise.gain_e_per_dn
    root_weight += pixel_noise.background * stamps.noise2_dn2
    np.sqrt(root_weight, out=root_weight)
    valid = stamps.valid
    np.divide(1.0 if valid is None else valid, root_weight, out=root_weight)
    rows *= root_weight[:, None, :]
    return _less_slopes(rows, root_weight, stamps), light, root_weight


def _less_slopes(rows: Floats, root_weight: Floats, stamps: Stamps) -> Floats:
    """Whitened rows (n, k, p), those of uneven stars at right angles to slopes: both are free."""
    if stamps.uneven is None:
        return rows
    star = np.flatnonzero(stamps.uneven)
    places = np.indices((stamps.width, stamps.width)).reshape(2, -1) - stamps.width // 2
    slopes = places * root_weight[star, None]
    across = slopes.transpose(0, 2, 1)
    # The addition keeps a window without pixels solvable.
    parts = np.linalg.solve(slopes @ across + 1e-12 * np.eye(2), slopes)
    rows[star] -= (rows[star] @ across) @ parts
    return rows


def _normal(rows: Floats, parameters: Floats) -> tuple[Floats, Floats]:
    """
    Normal matrices (n, k, k) and gradients (n, k) at parameters (n, 4) of small least squares.

    ``rows`` (n, k + 1, p) are whitened derivatives and pixels, which are linear in flux and
    background.  A small addition to the diagonal keeps a stamp without light solvable.
    """
    k = rows.shape[1] - 1
    product = rows[:, :k] @ rows.transpose(0, 2, 1)
    normal, gradient = product[:, :, :k], product[:, :, k]
    gradient -= (product[:, :, 2:4] @ parameters[:, 2:, None])[:, :, 0]
    diagonal = np.einsum('nii->ni', normal)
    diagonal += 1e-9 * diagonal + 1e-12
    return normal, gradient
