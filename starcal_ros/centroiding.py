"""
Star centroids with covariance: background, detection, moments (Eqs. 8, 9) and PSF fits.

The moment method is the paper's.  The PSF fit goes beyond it: a pixel-integrated circular Gaussian
with free position, flux and local background, weighted by the noise of each pixel, attains the
Cramer-Rao bound of the stamp.  Both work on all stars of an image at once.

Noise of a pixel with background-free signal S, in digital numbers (DN)::

    variance = noise_dn^2 + S / gain + (psf_error S)^2

The background noise comes from the image; gain and ``psf_error`` (how far the real PSF is from the
Gaussian, as a fraction) come from the options or from the residuals of the brighter stars.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.special import ndtr

from starcal_ros.options import option

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8] | NDArray[np.uint16]

_MESH_PX = 64  # glare and vignetting vary slowly over it
_MESH_STEP_PX = 4  # 256 samples of a cell give its noise to 5 %
_MAD_TO_SIGMA = 1.4826  # of a normal distribution
_DETECTION_SIGMA_PX = (
    1.0  # matched filter of detection; 0.7 to 1.5 px stars lose under 10 % of S/N
)
# A Gaussian filter of sigma s leaves white noise at 1 / (2 s sqrt(pi)) of its strength.
_NOISE_LEFT = 1.0 / (2.0 * _DETECTION_SIGMA_PX * math.sqrt(math.pi))
_HOT_PEAK_RATIO = 4.0  # peak over filtered peak: 6.3 for one lit pixel, 2.7 for a 0.7 px star
_MIN_PSF_SIGMA_PX = 0.45
_MAX_PSF_SIGMA_PX = 4.0
_FIT_STEPS = 12  # stars settle in three to five; what has not by then is no star


@dataclass(frozen=True)
class CentroidOptions:
    """How stars are measured."""

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
        0,
        'most saturated pixels of a star that is used; the PSF fit leaves them out',
        low=0,
        high=20,
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
class Background:
    """
    Background level and 1-sigma noise on a coarse mesh, DN, with what the whole image shows.

    ``level_mesh`` and ``noise_mesh`` are (rows, cols) float32 over equal parts of the image.
    """

    level_mesh: NDArray[np.float32]
    noise_mesh: NDArray[np.float32]
    level_dn: float
    noise_dn: float


@dataclass(frozen=True)
class Sources:
    """
    Star-like local maxima of an image, brightest first.

    ``xy_px`` (n, 2); ``snr`` (n,); ``searched_px2`` the area of the image that was looked at.
    """

    xy_px: Floats
    snr: Floats
    searched_px2: float


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
class Centroids:
    """
    Measured stars.

    ``xy_px`` (n, 2); ``covariance_px2`` (n, 3) uu, uv, vv; ``flux_dn``, ``snr`` (n,);
    ``refusal`` (n,) text: empty where the star is good, else a name of `STAR_REFUSALS`.
    """

    xy_px: Floats
    covariance_px2: Floats
    flux_dn: Floats
    snr: Floats
    refusal: NDArray[np.str_]


def measure_background(pixels: Pixels) -> Background:
    """
    Background level and noise of an image from the median and the clipped spread of each cell.

    One pixel in sixteen is read.  The noise is at least that of the quantisation to whole DN.
    """
    height, width = pixels.shape
    rows, cols = max(1, height // _MESH_PX), max(1, width // _MESH_PX)
    cell_v, cell_u = height // rows, width // cols
    cells = pixels[: rows * cell_v, : cols * cell_u].reshape(rows, cell_v, cols, cell_u)
    thinned = cells[:, ::_MESH_STEP_PX, :, ::_MESH_STEP_PX].transpose(0, 2, 1, 3)
    samples = thinned.reshape(rows * cols, -1).astype(np.float32)
    samples.sort(axis=1)
    count = samples.shape[1]
    median = samples[:, count // 2]
    # Below the median lies no star: the lower quantiles alone give the spread.
    spread = median - samples[:, int(count * 0.1587)]
    clip = 3.0 * np.maximum(spread, 1.0)
    inside = np.abs(samples - median[:, None]) <= clip[:, None]
    kept = np.maximum(inside.sum(axis=1), 1)
    mean = (samples * inside).sum(axis=1) / kept
    variance = ((samples - mean[:, None]) ** 2 * inside).sum(axis=1) / kept
    # 0.9733 of the variance of a normal distribution lies within 3 sigma.
    noise = np.sqrt(np.maximum(variance / 0.9733, 1.0 / 12.0))
    level_mesh = _smooth_mesh(mean.reshape(rows, cols))
    noise_mesh = _smooth_mesh(noise.reshape(rows, cols).astype(np.float32))
    return Background(
        level_mesh, noise_mesh, float(np.median(level_mesh)), float(np.median(noise_mesh))
    )


def _smooth_mesh(mesh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mesh after a 3 x 3 median, which takes out cells that hold a bright star."""
    mesh = np.ascontiguousarray(mesh, np.float32)
    return np.asarray(cv2.medianBlur(mesh, 3), np.float32) if min(mesh.shape) >= 3 else mesh


def sample_mesh(mesh: NDArray[np.float32], shape: tuple[int, int], xy_px: Floats) -> Floats:
    """Values (n,) of a mesh over an image of ``shape`` at pixels (n, 2), bilinear."""
    rows, cols = mesh.shape
    row = (xy_px[:, 1] + 0.5) * rows / shape[0] - 0.5
    column = (xy_px[:, 0] + 0.5) * cols / shape[1] - 0.5
    # SciPy's, as cv2.remap takes at most 32767 points.
    return np.asarray(map_coordinates(mesh, [row, column], np.float64, order=1, mode='nearest'))


def saturation_level(pixels: Pixels, options: CentroidOptions) -> float:
    """
    Pixel value from which a pixel counts as saturated, DN.

    Where the options do not say: the end of the data type, or the greatest value in the image
    when it is a plateau or the end of a 10, 12 or 14 bit range.
    """
    if options.saturation_dn > 0:
        return options.saturation_dn
    peak = int(pixels.max())
    ends = (255,) if pixels.dtype == np.uint8 else (1023, 4095, 16383, 65535)
    # Four pixels at one greatest value: photon noise does not do that far above the background.
    plateau = peak in ends or np.count_nonzero(pixels == peak) >= 4
    return 0.98 * peak if plateau else float(peak) + 1.0


def detect(pixels: Pixels, background: Background, options: CentroidOptions) -> Sources:
    """
    Star-like sources of an image above ``detection_sigma``, brightest first.

    Local maxima of the background-free image under a Gaussian matched filter; single lit pixels
    (hot pixels, cosmic rays) are left out by their sharpness.  Positions are good to about 0.2 px.
    """
    height, width = pixels.shape
    level = cv2.resize(background.level_mesh, (width, height), interpolation=cv2.INTER_LINEAR)
    image: NDArray[np.float32] = np.subtract(pixels, level, dtype=np.float32)
    filtered: NDArray[np.float32] = np.asarray(
        cv2.GaussianBlur(image, (0, 0), _DETECTION_SIGMA_PX, borderType=cv2.BORDER_REFLECT),
        np.float32,
    )
    lowest = options.detection_sigma * _NOISE_LEFT * float(background.noise_mesh.min())
    # Few pixels pass the lowest threshold: everything after looks at those alone.
    v, u = np.nonzero(filtered > lowest)
    inner = (u >= 2) & (u < width - 2) & (v >= 2) & (v < height - 2)
    v, u = v[inner], u[inner]
    centre = filtered[v, u]
    noise = sample_mesh(
        background.noise_mesh, (height, width), np.stack([u, v], axis=-1).astype(np.float64)
    )
    keep = centre > options.detection_sigma * _NOISE_LEFT * noise
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            if (dv, du) != (0, 0):
                other = filtered[v + dv, u + du]
                keep &= centre >= other if (dv, du) > (0, 0) else centre > other
    v, u, centre, noise = v[keep], u[keep], centre[keep], noise[keep]
    sharp = image[v, u] > _HOT_PEAK_RATIO * centre
    v, u, centre, noise = v[~sharp], u[~sharp], centre[~sharp], noise[~sharp]
    offset = [
        _parabola_vertex(filtered[v - b, u - a], centre, filtered[v + b, u + a])
        for a, b in ((1, 0), (0, 1))
    ]
    order = np.argsort(-centre, kind='stable')
    xy = np.stack([u + offset[0], v + offset[1]], axis=-1).astype(np.float64)
    snr = (centre / (_NOISE_LEFT * noise)).astype(np.float64)
    return Sources(xy[order], snr[order], float(width * height))


def detect_near(
    pixels: Pixels,
    background: Background,
    predicted_px: Floats,
    reach_px: int,
    options: CentroidOptions,
) -> Sources:
    """
    The brightest star-like source in a square window about each predicted pixel (n, 2).

    The paper's way ("Extracting star centroids"): its cost does not grow with the image.  Same
    filter, threshold and rejection of single lit pixels as `detect`; a source that several windows
    share is listed once.
    """
    shape = (pixels.shape[0], pixels.shape[1])
    rim = 4  # the filter's own reach, and one pixel for the place of the maximum
    centre = np.rint(predicted_px).astype(np.int64)
    centre = centre[_inside(shape, centre, reach_px + rim)]
    windows = _stamps(pixels, centre, reach_px + rim)
    windows -= sample_mesh(background.level_mesh, shape, centre.astype(np.float64))[:, None, None]
    filtered = gaussian_filter1d(windows, _DETECTION_SIGMA_PX, axis=1, truncate=3.0)
    filtered = gaussian_filter1d(filtered, _DETECTION_SIGMA_PX, axis=2, truncate=3.0)
    within = slice(rim, rim + 2 * reach_px + 1)
    side = 2 * reach_px + 1
    best = filtered[:, within, within].reshape(len(centre), -1).argmax(axis=1)
    v, u = best // side + rim, best % side + rim
    n = np.arange(len(centre))
    peak = filtered[n, v, u]
    xy = centre + np.stack([u, v], axis=-1) - (reach_px + rim)
    noise = sample_mesh(background.noise_mesh, shape, xy.astype(np.float64))
    offset = [
        _parabola_vertex(filtered[n, v - b, u - a], peak, filtered[n, v + b, u + a])
        for a, b in ((1, 0), (0, 1))
    ]
    snr = peak / (_NOISE_LEFT * noise)
    # At the rim of the window it is the flank of something outside.
    inner = (np.abs(xy - centre) < reach_px).all(axis=1)
    good = inner & (snr > options.detection_sigma)
    good &= windows[n, v, u] < _HOT_PEAK_RATIO * peak
    _, first = np.unique(xy[:, 1] * shape[1] + xy[:, 0], return_index=True)
    once = np.zeros(len(centre), bool)
    once[first] = True
    good &= once
    order = np.nonzero(good)[0]
    order = order[np.argsort(-snr[order], kind='stable')]
    area = min(len(centre) * side * side, shape[0] * shape[1])
    return Sources((xy + np.stack(offset, axis=-1))[order], snr[order], float(area))


def _parabola_vertex(
    before: NDArray[np.floating], centre: NDArray[np.floating], after: NDArray[np.floating]
) -> Floats:
    """Place of the maximum of the parabola through three equidistant values, in their step."""
    curvature = 2 * centre - before - after
    vertex = 0.5 * (after - before) / np.maximum(curvature, 1e-12)
    return np.asarray(np.clip(vertex, -0.5, 0.5), np.float64)


def _stamps(pixels: Pixels, centre: NDArray[np.int64], radius: int) -> Floats:
    """Square windows (n, 2 radius + 1, 2 radius + 1) about integer pixels (n, 2)."""
    offsets = np.arange(-radius, radius + 1)
    v = centre[:, 1, None, None] + offsets[:, None]
    u = centre[:, 0, None, None] + offsets[None, :]
    return pixels[v, u].astype(np.float64)


def _inside(shape: tuple[int, int], centre: NDArray[np.int64], radius: int) -> NDArray[np.bool_]:
    """Return (n,) whether a window about each integer pixel lies within the image."""
    height, width = shape
    u, v = centre[:, 0], centre[:, 1]
    return (u >= radius) & (u < width - radius) & (v >= radius) & (v < height - radius)


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
    flux_dn: Floats, offset_px: Floats, neighbour_flux_dn: Floats, model: ImageModel
) -> Floats:
    """
    How far (k, 2) the light of a neighbour pulls the fitted place of a star.

    One linear step of the fit, with the light of the neighbour as its residual.

    Parameters
    ----------
    flux_dn, neighbour_flux_dn : (k,)
    offset_px : (k, 2)
        From the star to its neighbour.
    """
    sigma_px = model.psf_sigma_px or 1.0
    width = 2 * stamp_radius_px(sigma_px) + 1
    zero = np.zeros(len(flux_dn))
    J = _psf_columns(np.stack([zero, zero, flux_dn, zero], axis=-1), sigma_px, width, 4)
    own = flux_dn[:, None] * J[:, 2]
    at = np.stack([*offset_px.T, neighbour_flux_dn, zero], axis=-1)
    light = neighbour_flux_dn[:, None] * _psf_columns(at, sigma_px, width, 4)[:, 2]
    noise_dn = np.full((len(flux_dn), 1), model.background.noise_dn)
    weight = 1.0 / model.pixel_noise.variance(own + light, noise_dn)
    step, _ = _weighted_step(J, weight, light)
    return step[:, :2]


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


@dataclass(frozen=True)
class ImageModel:
    """
    What an image says of itself before single stars are measured.

    ``psf_sigma_px`` is 0 where too few bright stars stand in the image to tell.
    ``shape_median`` and ``shape_scatter`` (3,) are what `PsfFit.shape_change` is for its stars:
    a real lens has no circular stars, and what all stars share makes none of them suspect.
    """

    background: Background
    psf_sigma_px: float
    pixel_noise: PixelNoise
    saturation_dn: float
    shape_median: Floats
    shape_scatter: Floats


def stamp_radius_px(psf_sigma_px: float) -> int:
    """Half width of the fitting window: beyond 3.5 sigma lies under 0.3 % of a star's light."""
    return int(np.clip(np.ceil(3.5 * psf_sigma_px), 3, 12))


def model_image(
    pixels: Pixels, background: Background, sources: Sources, options: CentroidOptions
) -> ImageModel:
    """
    PSF width, pixel noise and saturation of an image from its own brighter sources.

    The width is the median over up to 80 bright, unsaturated, isolated sources; gain and PSF
    error are a robust regression of the squared residuals of their pixels on their signal.
    """
    saturation_dn = saturation_level(pixels, options)
    gain = options.gain_e_per_dn
    unknown = ImageModel(
        background, 0.0, PixelNoise(gain or 1.0, 0.0), saturation_dn, np.zeros(3), np.zeros(3)
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
        inside = _inside(shape, centre, radius)
        xy, centre = xy[inside], centre[inside]
        stamps = _stamps(pixels, centre, radius)
        clean = stamps.max(axis=(1, 2)) < saturation_dn
        xy, centre, stamps = xy[clean], centre[clean], stamps[clean]
        if len(xy) < 5:
            return unknown
        noise_dn = sample_mesh(background.noise_mesh, shape, xy)
        fit = fit_psf(stamps, sigma, noise_dn, noise_model)
        change = float(np.median(fit.shape_change[:, :2].mean(axis=1)))
        sigma_before = sigma
        sigma *= float(np.sqrt(np.clip(1.0 + change, 0.5, 2.0)))
        sigma = float(np.clip(sigma, _MIN_PSF_SIGMA_PX, _MAX_PSF_SIGMA_PX))
        if abs(sigma - sigma_before) < 1e-3 * sigma:
            break
    shape_median = np.median(fit.shape_change, axis=0)
    shape_scatter = _MAD_TO_SIGMA * np.median(np.abs(fit.shape_change - shape_median), axis=0)
    limit = np.maximum(options.max_shape_change, 3.0 * shape_scatter)
    star_like = (np.abs(fit.shape_change - shape_median) < limit).all(axis=1)
    noise_model = _estimate_noise(stamps[star_like], sigma, noise_dn[star_like], gain)
    return ImageModel(background, sigma, noise_model, saturation_dn, shape_median, shape_scatter)


def _isolated(xy_px: Floats, distance_px: float) -> Floats:
    """Return the points without another one nearer than a distance."""
    if len(xy_px) < 2:
        return xy_px
    separation = np.linalg.norm(xy_px[:, None] - xy_px[None], axis=-1)
    np.fill_diagonal(separation, np.inf)
    return np.asarray(xy_px[separation.min(axis=1) > distance_px])


def _estimate_noise(stamps: Floats, sigma_px: float, noise_dn: Floats, gain: float) -> PixelNoise:
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


def measure_stars(
    pixels: Pixels, predicted_px: Floats, model: ImageModel, options: CentroidOptions
) -> Centroids:
    """
    Centroids of the stars near predicted pixels (n, 2), by the method of the options.

    Where the image does not tell its PSF width, the moment method is used.
    """
    if options.centroid == 'psf' and model.psf_sigma_px > 0:
        return _measure_by_psf(pixels, predicted_px, model, options)
    return _measure_by_moments(pixels, predicted_px, model, options)


def _measure_by_psf(
    pixels: Pixels, predicted_px: Floats, model: ImageModel, options: CentroidOptions
) -> Centroids:
    """Centroids by `fit_psf`, in windows about the predicted pixels."""
    shape = (pixels.shape[0], pixels.shape[1])
    radius = stamp_radius_px(model.psf_sigma_px)
    n = len(predicted_px)
    refusal = np.full(n, '', dtype='U16')
    centre = np.rint(np.nan_to_num(predicted_px, nan=-1e6)).astype(np.int64)
    inside = _inside(shape, centre, radius + 1)
    refusal[~inside] = 'border'
    centre = np.clip(centre, radius + 1, [shape[1] - radius - 2, shape[0] - radius - 2])
    # The window goes where the star is: the brightest pixel next to the prediction.
    near = _stamps(pixels, centre, 1).reshape(n, 9)
    best = near.argmax(axis=1)
    centre = centre + np.stack([best % 3 - 1, best // 3 - 1], axis=-1)
    stamps = _stamps(pixels, centre, radius)
    noise_dn = sample_mesh(model.background.noise_mesh, shape, centre.astype(np.float64))
    fit = fit_psf(stamps, model.psf_sigma_px, noise_dn, model.pixel_noise, model.saturation_dn)
    x, y, flux, _ = fit.parameters.T
    covariance = fit.covariance
    snr = flux / np.sqrt(covariance[:, 2, 2])

    departure = np.abs(fit.shape_change - model.shape_median)
    limit = np.maximum(options.max_shape_change, 4.0 * model.shape_scatter)
    misshapen = ((departure > limit) & (departure > 4.0 * fit.shape_sigma)).any(axis=1)
    # 81 pixels of normal noise pass 5 sigma once in 20,000 stars.
    misshapen |= fit.worst_pixel_sigma > 5.0
    saturated = (stamps >= model.saturation_dn).sum(axis=(1, 2))
    wandered = np.maximum(np.abs(x), np.abs(y)) > 1.5
    for bad, reason in (
        (saturated > options.max_saturated_pixels, 'saturated'),
        ((snr < options.min_snr) | ~np.isfinite(snr), 'faint'),
        (wandered, 'not_detected'),
        (misshapen, 'elongated'),
    ):
        refusal[bad & (refusal == '')] = reason
    return Centroids(
        xy_px=centre + np.stack([x, y], axis=-1),
        covariance_px2=np.stack(
            [covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], axis=-1
        ),
        flux_dn=flux,
        snr=snr,
        refusal=refusal,
    )


def _measure_by_moments(
    pixels: Pixels, predicted_px: Floats, model: ImageModel, options: CentroidOptions
) -> Centroids:
    """
    Centroids as centres of intensity over a mask (Eqs. 8, 9).

    The brightest pixel of the region of interest is found, the window recentred there, and the
    mask is every pixel within ``mask_radius_px`` above ``mask_threshold_sigma``.
    """
    shape = (pixels.shape[0], pixels.shape[1])
    radius = int(np.ceil(options.mask_radius_px))
    n = len(predicted_px)
    refusal = np.full(n, '', dtype='U16')
    centre = np.rint(np.nan_to_num(predicted_px, nan=-1e6)).astype(np.int64)
    inside = _inside(shape, centre, 2 * radius)
    refusal[~inside] = 'border'
    centre = np.clip(centre, 2 * radius, [shape[1] - 2 * radius - 1, shape[0] - 2 * radius - 1])
    w = 2 * radius + 1
    best = _stamps(pixels, centre, radius).reshape(n, w * w).argmax(axis=1)
    centre = centre + np.stack([best % w - radius, best // w - radius], axis=-1)

    stamps = _stamps(pixels, centre, radius)
    level = sample_mesh(model.background.level_mesh, shape, centre.astype(np.float64))
    noise_dn = sample_mesh(model.background.noise_mesh, shape, centre.astype(np.float64))
    signal = stamps - level[:, None, None]
    offsets = np.arange(-radius, radius + 1).astype(np.float64)
    disc = offsets[:, None] ** 2 + offsets[None, :] ** 2 <= options.mask_radius_px**2
    mask = disc & (signal > (options.mask_threshold_sigma * noise_dn)[:, None, None])
    weight = np.where(mask, signal, 0.0)
    flux = weight.sum(axis=(1, 2))
    total = np.maximum(flux, 1e-12)
    x = (weight * offsets[None, None, :]).sum(axis=(1, 2)) / total
    y = (weight * offsets[None, :, None]).sum(axis=(1, 2)) / total
    variance = np.where(mask, model.pixel_noise.variance(signal, noise_dn[:, None, None]), 0.0)
    dx = offsets[None, None, :] - x[:, None, None]
    dy = offsets[None, :, None] - y[:, None, None]
    covariance = (
        np.stack(
            [
                (variance * dx * dx).sum(axis=(1, 2)),
                (variance * dx * dy).sum(axis=(1, 2)),
                (variance * dy * dy).sum(axis=(1, 2)),
            ],
            axis=-1,
        )
        / (total**2)[:, None]
    )
    # A mask of one pixel would claim no error at all: no centroid is known better than its pixel.
    count = mask.sum(axis=(1, 2))
    snr = flux / np.sqrt(np.maximum(variance.sum(axis=(1, 2)), 1e-12))
    moment_xx = (weight * dx * dx).sum(axis=(1, 2)) / total
    moment_yy = (weight * dy * dy).sum(axis=(1, 2)) / total
    moment_xy = (weight * dx * dy).sum(axis=(1, 2)) / total
    size = np.maximum(moment_xx + moment_yy, 1e-12)
    ellipticity = np.hypot(moment_xx - moment_yy, 2 * moment_xy) / size
    for bad, reason in (
        (stamps.max(axis=(1, 2)) >= model.saturation_dn, 'saturated'),
        (snr < options.min_snr, 'faint'),
        (count < options.min_pixels, 'too_few_pixels'),
        (ellipticity > options.max_shape_change, 'elongated'),
    ):
        refusal[bad & (refusal == '')] = reason
    return Centroids(
        xy_px=centre + np.stack([x, y], axis=-1),
        covariance_px2=covariance,
        flux_dn=flux,
        snr=snr,
        refusal=refusal,
    )
