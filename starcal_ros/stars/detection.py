# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Background of an image, the star-like sources above it, and how many catalog stars it can show.

Positions of sources are good to a fifth of a pixel; `centroiding` measures the identified stars.
"""

from __future__ import annotations

from dataclasses import dataclass
import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.spatial import cKDTree

from starcal_ros import opencv as cv2
from starcal_ros.arrays import Floats, Indices, Mask, Pixels, rows_of, Singles
from starcal_ros.robust_statistics import median, medians
from starcal_ros.stars.pixel_noise import quantisation_step_dn, rounding_noise_dn

DETECTION_SIGMA = 5.0  # noise alone exceeds it at 0.6 places of a megapixel
_MESH_PX = 64  # glare and vignetting vary slowly over it
_MESH_STEP_PX = (4, 4)  # down and across: 256 samples of a cell give its noise to 5 %
GAP_SIGMA = 8.0  # a pixel of 0 DN this far below the rest of its cell is invalid
_CUT_OFF = 0.3  # with more of a cell at 0 DN, its lower half no longer shows the noise
_LEAST_CUT_OFF = 0.5  # quantisation steps
_STEEP_PART = 0.2  # a slope that adds more to the variance of a cell is corrected
_MOSTLY_INVALID = 0.75  # a cell with more invalid pixels takes the level of its neighbour
_SPARSE_PX = 256
_MOST_SLOPE = 0.05  # noise per pixel, over cells of 256 px: this slope pulls a star by 0.25 sigma
_SPARSE_STEP_PX = (32, 8)  # memory is read row by row: few rows, many of their pixels
# Matched filter of detection; stars of 0.7 to 1.5 px lose under 10 % of S/N.
_DETECTION_SIGMA_PX, _FILTER_PX = 1.0, (7, 7)
# A Gaussian filter of sigma s leaves white noise at 1 / (2 s sqrt(pi)) of its strength.
NOISE_LEFT = 1.0 / (2.0 * _DETECTION_SIGMA_PX * math.sqrt(math.pi))
_ALONG_U, _ALONG_V = np.array([[[1], [0]], [[0], [1]]])  # a step along either axis, (2, 1)
_AROUND = [(dv, du) for dv in (-1, 0, 1) for du in (-1, 0, 1) if (dv, du) != (0, 0)]
_ROWS_AT_ONCE = 64  # rows of an image that fit in the cache of a processor
_RIM_PX = 4  # reach of the filter, plus one pixel to interpolate the maximum
# Peak over filtered peak: 6.3 for a single lit pixel without noise; for a star centred on a pixel
# 4.2 with a PSF of 0.45 px (half of the light in that pixel) and 4.65 with one of 0.4 px.
_HOT_PEAK_RATIO = 4.7


@dataclass(frozen=True)
class Background:
    """
    Background level and 1-sigma noise, DN, on a coarse mesh and for the whole image.

    ``level_mesh`` and ``noise_mesh`` are (rows, cols) float32 over equal parts of the image of
    ``shape`` (height, width); ``level_dn`` and ``noise_dn`` are their medians.  ``step_dn`` is the
    quantisation step of the image.
    """

    level_mesh: Singles
    noise_mesh: Singles
    level_dn: float
    noise_dn: float
    shape: tuple[int, ...]
    step_dn: int = 1

    def level_at(self, xy_px: Floats | Indices) -> Floats:
        """Level (n,) at pixels (n, 2)."""
        return sample_mesh(self.level_mesh, self.shape, xy_px)

    def noise_at(self, xy_px: Floats | Indices) -> Floats:
        """Noise (n,) at pixels (n, 2)."""
        return sample_mesh(self.noise_mesh, self.shape, xy_px)

    @functools.cached_property
    def slope_meshes(self) -> tuple[Singles, Singles]:
        """Slopes (rows, cols) of the level, down and across, DN per pixel."""
        return mesh_slope(self.level_mesh, self.shape)


@dataclass(frozen=True)
class Sources:
    """
    Star-like local maxima of an image, brightest first.

    ``xy_px`` (n, 2); ``snr`` (n,); ``searched_px2`` the searched area of the image.
    """

    xy_px: Floats
    snr: Floats
    searched_px2: float

    def select(self, rows: Mask | slice) -> Sources:
        """Return some of the sources, of the same area."""
        return rows_of(self, rows)


def measure_background(pixels: Pixels) -> Background:
    """
    Background level and noise of an image from the median and the clipped spread of each cell.

    Reads one pixel in sixteen.  Ignores invalid pixels (0 DN far below all others, as in a masked
    border).  The noise is at least that of the quantisation.
    """
    samples, mesh_shape = _cells(pixels, _MESH_PX, _MESH_STEP_PX)
    step_dn = quantisation_step_dn(pixels)
    samples.sort(axis=1)
    zeros = np.count_nonzero(samples == 0.0, axis=1)
    invalid = np.where(_gap_above_zero(samples, zeros, step_dn), zeros, 0)
    level = _quantile(samples, 0.5, invalid)
    # Stars lie above the median only: the lower quantile gives the spread.
    spread = level - _quantile(samples, 0.1587, invalid)
    tail = _noise_above(samples, level, np.where(invalid > 0, 0, zeros), step_dn)
    samples -= level[:, None]
    valid = np.arange(samples.shape[1]) >= invalid[:, None]
    mean, noise = _clipped(samples, spread, step_dn, valid)
    noise = np.maximum(noise, tail)
    has_pixels = (invalid < _MOSTLY_INVALID * samples.shape[1]).reshape(mesh_shape)
    level, noise = (
        filled(values.reshape(mesh_shape), has_pixels).ravel() for values in (mean + level, noise)
    )
    noise = np.maximum(_without_slope(noise, level.reshape(mesh_shape), pixels, step_dn), tail)
    return _background(level, noise, mesh_shape, pixels.shape, step_dn)


def sample_background(pixels: Pixels) -> Background:
    """
    Background level and noise from one pixel in 128, for fits that estimate their own level.

    Differences of nearby pixels give the noise, free of the gradient over a large cell.  If the
    sky is too steep for large cells, `measure_background` replaces the result.
    """
    samples, mesh_shape = _cells(pixels, _SPARSE_PX, _SPARSE_STEP_PX)
    step_dn = quantisation_step_dn(pixels)
    noise = _difference_noise(pixels, _SPARSE_PX, _SPARSE_STEP_PX, step_dn)
    level = medians(samples[:, ::4].T).astype(np.float32)
    zeros = np.count_nonzero(samples == 0.0, axis=1)
    cut_off = np.flatnonzero(zeros > _CUT_OFF * samples.shape[1])
    if len(cut_off):
        ascending = np.sort(samples[cut_off], axis=1)
        tail = _noise_above(ascending, level[cut_off], zeros[cut_off], step_dn)
        noise[cut_off] = np.maximum(noise[cut_off], tail)
    background = _background(level, noise, mesh_shape, pixels.shape, step_dn)
    steepest = (np.hypot(*background.slope_meshes) / background.noise_mesh).max()
    return background if steepest <= _MOST_SLOPE else measure_background(pixels)


def _noise_above(ascending: Singles, level: Singles, zeros: Indices, step_dn: int) -> Singles:
    """
    Noise (k,) of the sorted rows (k, n) that the converter clips at 0 DN; 0 for other rows.

    Clipping removes the lower half of the noise: the upper half's 2-sigma quantile is used.
    Noise below a quantisation step changes too few pixels to be measured: the result is at least
    half of one.
    """
    count = ascending.shape[1]
    above = ascending[:, int(0.9772 * count)] - level
    noise = np.maximum(0.5 * above, np.float32(_LEAST_CUT_OFF * step_dn))
    return np.where(zeros > _CUT_OFF * count, noise, np.float32(0.0))


def _without_slope(noise: Singles, level_mesh: Singles, pixels: Pixels, step_dn: int) -> Singles:
    """Noise (k,) of the cells, from differences of pixels where the background is steep."""
    down, across = mesh_slope(smooth_mesh(level_mesh), pixels.shape)
    cell_v, cell_u = np.array(pixels.shape) / level_mesh.shape
    ramp = (((down * cell_v) ** 2 + (across * cell_u) ** 2) / 12.0).ravel()
    steep = ramp > _STEEP_PART * noise**2
    if not steep.any():
        return noise
    from_differences = _difference_noise(pixels, _MESH_PX, _MESH_STEP_PX, step_dn)
    return np.where(steep, np.minimum(from_differences, noise), noise)


def _difference_noise(
    pixels: Pixels, cell_px: int, step_px: tuple[int, int], step_dn: int
) -> Singles:
    """Noise (k,) of the cells from differences of pixels two columns apart, almost slope-free."""
    samples, mesh_shape = _cells(pixels, cell_px, step_px)
    beside, _ = _cells(pixels[:, 2:], cell_px, step_px, mesh_shape)
    width = min(samples.shape[1], beside.shape[1])
    apart = samples[:, :width] - beside[:, :width]
    apart -= np.partition(apart, apart.shape[1] // 2, axis=1)[:, apart.shape[1] // 2, None]
    rank = int(apart.shape[1] * 0.6827)
    _, noise = _clipped(apart, np.partition(np.abs(apart), rank, axis=1)[:, rank], step_dn)
    return np.asarray(noise / math.sqrt(2.0), np.float32)


def mesh_slope(mesh: Singles, shape: tuple[int, ...]) -> tuple[Singles, Singles]:
    """Slopes (rows, cols) of a mesh over an image of ``shape``, down and across, per pixel."""
    down, across = (
        np.gradient(mesh, shape[axis] / cells, axis=axis) if cells > 1 else np.zeros_like(mesh)
        for axis, cells in enumerate(mesh.shape)
    )
    return np.asarray(down, np.float32), np.asarray(across, np.float32)


def _quantile(ascending: Singles, part: float, first: Indices) -> Singles:
    """Quantiles (k,) of the sorted rows (k, n), each from its element ``first`` (k,) on."""
    count = ascending.shape[1]
    rank = first + ((count - first) * part).astype(np.int64)
    row = np.arange(len(ascending))
    return np.asarray(ascending[row, np.minimum(rank, count - 1)])


def _gap_above_zero(ascending: Singles, zeros: Indices, step_dn: int) -> Mask:
    """Mask (k,) of the sorted rows that hold 0 DN far below the noise of their other samples."""
    level = _quantile(ascending, 0.5, zeros)
    spread = level - _quantile(ascending, 0.1587, zeros)
    return np.asarray((zeros > 0) & (level > GAP_SIGMA * np.maximum(spread, step_dn)))


def filled(values: NDArray[Any], valid: Mask) -> NDArray[Any]:
    """Values (rows, cols) with each invalid one replaced by the nearest valid one, if any."""
    if valid.all() or not valid.any():
        return values
    nearest = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return np.asarray(values[tuple(nearest)])


def _cells(
    pixels: Pixels,
    cell_px: int,
    step_px: tuple[int, int],
    mesh_shape: tuple[int, int] | None = None,
) -> tuple[Singles, tuple[int, int]]:
    """Thinned pixels of equal cells of an image, a row for each cell; (rows, columns) of cells."""
    height, width = pixels.shape
    rows, cols = mesh_shape or (max(1, height // cell_px), max(1, width // cell_px))
    cell_v, cell_u = height // rows, width // cols
    cells = pixels[: rows * cell_v, : cols * cell_u].reshape(rows, cell_v, cols, cell_u)
    down, across = step_px
    thinned = cells[:, ::down, :, ::across].transpose(0, 2, 1, 3)
    return thinned.reshape(rows * cols, -1).astype(np.float32), (rows, cols)


def _clipped(
    samples: Singles, spread: Singles, step_dn: int, valid: Mask | None = None
) -> tuple[Singles, Singles]:
    """Mean and 1-sigma of each row of samples about zero, without values beyond three spreads."""
    inside = np.abs(samples) <= 3.0 * np.maximum(spread, step_dn)[:, None]
    if valid is not None:
        inside &= valid
    kept = np.maximum(np.count_nonzero(inside, axis=1), 1)
    samples = samples * inside
    mean = samples.sum(axis=1) / kept
    variance = np.einsum('ij,ij->i', samples, samples) / kept - mean**2
    # 0.9733 of the variance of a normal distribution lies within 3 sigma.
    return mean, np.sqrt(np.maximum(variance, 0.0) / 0.9733)


def _background(
    level: Singles,
    noise: Singles,
    mesh_shape: tuple[int, int],
    shape: tuple[int, ...],
    step_dn: int,
) -> Background:
    """Smoothed level and noise of the cells; the noise is at least that of rounding."""
    level_mesh = smooth_mesh(level.reshape(mesh_shape))
    noise_mesh = smooth_mesh(np.maximum(noise, rounding_noise_dn(step_dn)).reshape(mesh_shape))
    medians_dn = median(level_mesh), median(noise_mesh)
    return Background(level_mesh, noise_mesh, *medians_dn, shape, step_dn)


def smooth_mesh(mesh: Singles) -> Singles:
    """Return the mesh after a 3 x 3 median, which removes cells with a bright star."""
    mesh = np.ascontiguousarray(mesh, np.float32)
    return np.asarray(cv2.medianBlur(mesh, 3), np.float32) if min(mesh.shape) >= 3 else mesh


def sample_mesh(mesh: Singles, shape: tuple[int, ...], xy_px: Floats | Indices) -> Floats:
    """Values (n,) of a mesh over an image of ``shape`` at pixels (n, 2), bilinear."""
    rows, cols = mesh.shape
    row = (xy_px[:, 1] + 0.5) * rows / shape[0] - 0.5
    column = (xy_px[:, 0] + 0.5) * cols / shape[1] - 0.5
    # SciPy's function, because cv2.remap takes at most 32767 points.
    return np.asarray(map_coordinates(mesh, [row, column], np.float64, order=1, mode='nearest'))


def detect(
    pixels: Pixels, background: Background, detection_sigma: float = DETECTION_SIGMA
) -> Sources:
    """
    Star-like sources of an image above a signal-to-noise ratio, brightest first.

    Local maxima of the background-free image under a Gaussian matched filter; single lit pixels
    (hot pixels, cosmic rays) are left out by their sharpness.  Positions are good to about 0.2 px.
    """
    height, width = pixels.shape
    # One array of the size of the image: the pages of each further one take as long as the filter.
    image: Any = cv2.resize(background.level_mesh, (width, height))
    for first in range(0, height, _ROWS_AT_ONCE):
        rows = slice(first, first + _ROWS_AT_ONCE)
        # Converted first: a subtraction that converts takes four times as long.
        np.subtract(pixels[rows].astype(np.float32), image[rows], out=image[rows])
    border = cv2.BORDER_REFLECT
    filtered: Singles = np.asarray(
        cv2.GaussianBlur(image, _FILTER_PX, _DETECTION_SIGMA_PX, dst=image, borderType=border),
        np.float32,
    )
    lowest = detection_sigma * NOISE_LEFT * float(background.noise_mesh.min())
    # Few pixels pass the lowest threshold; all later steps use only those.  The search of the flat
    # image takes a tenth of the time of that by rows and columns.
    place = np.flatnonzero(filtered > lowest)
    v, u = np.divmod(place, width)
    place = place[(u >= 2) & (u < width - 2) & (v >= 2) & (v < height - 2)]
    flat = filtered.ravel()
    for dv, du in _AROUND:
        beside, centre = flat[place + (dv * width + du)], flat[place]
        place = place[centre >= beside if (dv, du) > (0, 0) else centre > beside]
    v, u = np.divmod(place, width)
    centre = flat[place]
    noise = background.noise_at(np.stack([u, v], axis=-1))
    bright = centre > detection_sigma * NOISE_LEFT * noise
    v, u, centre, noise = v[bright], u[bright], centre[bright], noise[bright]
    peak_dn = pixels[v, u] - background.level_at(np.stack([u, v], axis=-1))
    sharp = peak_dn > _HOT_PEAK_RATIO * centre
    v, u, centre, noise = v[~sharp], u[~sharp], centre[~sharp], noise[~sharp]
    vertex = _parabola_vertex(
        filtered[v - _ALONG_V, u - _ALONG_U], centre, filtered[v + _ALONG_V, u + _ALONG_U]
    )
    order = np.argsort(-centre, kind='stable')
    xy = vertex.T + np.stack([u, v], axis=-1)
    snr = (centre / (NOISE_LEFT * noise)).astype(np.float64)
    return Sources(xy[order], snr[order], float(width * height))


def detect_near(
    pixels: Pixels, background: Background, predicted_px: Floats, reach_px: int
) -> Sources:
    """
    The brightest star-like source in a square window about each predicted pixel (n, 2).

    The method of the paper ("Extracting star centroids"): its cost does not grow with the image.
    Filter, threshold and rejection of single lit pixels are those of `detect`; a source in several
    windows is listed once.
    """
    centre = np.rint(predicted_px).astype(np.int64)
    inside = windows_inside(pixels.shape, centre, reach_px + _RIM_PX)
    xy, snr = brightest_near(pixels, background, predicted_px[inside], reach_px)
    _, first = np.unique(np.rint(xy), axis=0, return_index=True)
    kept = np.sort(first[snr[first] > DETECTION_SIGMA])
    kept = kept[np.argsort(-snr[kept], kind='stable')]
    area = min(len(xy) * (2 * reach_px + 1) ** 2, pixels.size)
    return Sources(xy[kept], snr[kept], float(area))


def brightest_near(
    pixels: Pixels, background: Background, predicted_px: Floats, reach_px: int
) -> tuple[Floats, Floats]:
    """
    Place (n, 2) and signal-to-noise (n,) of the brightest pixel near each predicted one.

    The signal-to-noise ratio is 0 where that pixel is not star-like.  Windows must lie 4 px inside
    the image.
    """
    centre = np.rint(predicted_px).astype(np.int64)
    half = reach_px + _RIM_PX
    windows = windows_about(pixels, centre, half).astype(np.float32)
    windows -= background.level_at(centre)[:, None, None].astype(np.float32)
    filtered = np.zeros_like(windows)
    if len(windows):
        # One filter call for all windows, stacked in one image: the rim absorbs light that the
        # filter carries over a joint.
        cv2.GaussianBlur(
            windows.reshape(-1, 2 * half + 1),
            _FILTER_PX,
            _DETECTION_SIGMA_PX,
            dst=filtered.reshape(-1, 2 * half + 1),
        )
    within = slice(_RIM_PX, _RIM_PX + 2 * reach_px + 1)
    side = 2 * reach_px + 1
    best = filtered[:, within, within].reshape(len(centre), side * side).argmax(axis=1)
    v, u = best // side + _RIM_PX, best % side + _RIM_PX
    n = np.arange(len(centre))
    peak = filtered[n, v, u]
    place = _parabola_vertex(
        filtered[n, v - _ALONG_V, u - _ALONG_U], peak, filtered[n, v + _ALONG_V, u + _ALONG_U]
    )
    xy = centre + np.stack([u, v], axis=-1) - half
    noise = background.noise_at(xy)
    # A maximum at the rim of the window is the flank of a source outside.
    star_like = (np.abs(xy - centre) < reach_px).all(axis=1)
    star_like &= windows[n, v, u] < _HOT_PEAK_RATIO * peak
    snr = np.where(star_like, peak / (NOISE_LEFT * noise), 0.0)
    return xy + place.T, snr


def _parabola_vertex(
    before: NDArray[np.floating], centre: NDArray[np.floating], after: NDArray[np.floating]
) -> Floats:
    """Place of the maximum of the parabola through three equidistant values, in their step."""
    curvature = 2 * centre - before - after
    vertex = 0.5 * (after - before) / np.maximum(curvature, 1e-12)
    return np.asarray(vertex.clip(-0.5, 0.5), np.float64)


def windows_about(pixels: Pixels, centre: Indices, radius: int) -> Pixels:
    """Square windows (n, 2 radius + 1, 2 radius + 1) about integer pixels (n, 2), all inside."""
    side = 2 * radius + 1
    if len(centre) == 0:  # the image may be smaller than a window
        return np.empty((0, side, side), pixels.dtype)
    # The type stubs of NumPy drop the type of the pixels here.
    every: Any = np.lib.stride_tricks.sliding_window_view(pixels, (side, side))
    windows: Pixels = every[centre[:, 1] - radius, centre[:, 0] - radius]
    return windows


def stamps_at_edges(pixels: Pixels, centre: Indices, radius: int) -> tuple[Floats, Mask]:
    """
    As `windows_about` for windows that may leave the image, and a mask of their pixels outside.

    Pixels outside repeat the pixel at the edge.
    """
    height, width = pixels.shape
    stamps = np.empty((len(centre), 2 * radius + 1, 2 * radius + 1))
    outside = np.zeros(stamps.shape, bool)
    inside = windows_inside(pixels.shape, centre, radius)
    stamps[inside] = windows_about(pixels, centre[inside], radius)
    leaves = np.nonzero(~inside)[0]
    if len(leaves):
        reach = np.arange(-radius, radius + 1)
        u, v = (
            centre[leaves, 0, None, None] + reach,
            centre[leaves, 1, None, None] + reach[:, None],
        )
        outside[leaves] = (u < 0) | (u >= width) | (v < 0) | (v >= height)
        stamps[leaves] = pixels[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    return stamps, outside


def windows_inside(shape: tuple[int, ...], centre: Indices, radius: int) -> Mask:
    """Mask (n,) of the integer pixels whose window lies within the image."""
    height, width = shape
    u, v = centre[:, 0], centre[:, 1]
    return (u >= radius) & (u < width - radius) & (v >= radius) & (v < height - radius)


def second_moments(light: Floats | Singles) -> tuple[Floats, Floats, Floats]:
    """Sums (n,), centres (n, 2) from the middles, second moments (n, 3) uu, vv, uv of stamps."""
    n, side, _ = light.shape
    v, u = np.indices((side, side), np.float64).reshape(2, -1) - side // 2
    powers = np.stack([np.ones_like(u), u, v, u * u, v * v, u * v], axis=-1)
    sums = light.reshape(n, side * side).astype(np.float64) @ powers
    mean = sums[:, 1:] / np.maximum(sums[:, :1], 1e-9)
    place_px = mean[:, :2]
    return sums[:, 0], place_px, mean[:, 2:] - place_px[:, [0, 1, 0]] * place_px[:, [0, 1, 1]]


def apart(xy_px: Floats, least_px: float) -> Mask:
    """Mask (n,) of the points (n, 2), brightest first, without a brighter one nearby."""
    is_apart = np.ones(len(xy_px), bool)
    is_apart[cKDTree(xy_px).query_pairs(least_px, output_type='ndarray').max(axis=1)] = False
    return is_apart


_GROUP = 256  # stars of one mean: its noise is 0.06 of that of a star
# Share of the smallest signal-to-noise ratio, 3 mag.  A measurable star in a dark group would be
# refused anyway, since it is twenty times as bright as in the catalog.
_DARK = 0.05
_MOST_SNR = 3.0  # limits the effect of a bright neighbour on the mean of a group
_RADIUS_PX = 3
_CORE = np.zeros((7, 7), np.float32)  # weights of the light of 3 x 3 pixels above their border
_CORE[2:-2, 2:-2], _CORE[[0, -1]], _CORE[1:-1, [0, -1]] = 1.0, -9 / 24, -9 / 24


def detectable_count(pixels: Pixels, xy_px: Floats, background: Background, min_snr: float) -> int:
    """
    Number of the stars at pixels (n, 2), brightest first, that may have ``min_snr``.

    The signal-to-noise ratio of 3 x 3 pixels above the border of their window is averaged over
    groups of stars of similar brightness, since noise hides a single faint star.  Stars after the
    first of the dark groups at the end are not counted.
    """
    height, width = pixels.shape
    inner = np.array([width, height]) - 1 - _RADIUS_PX
    count = len(xy_px)
    # In most images the last group is not dark, and no other is looked at.
    for first in range(count // _GROUP * _GROUP - _GROUP, -1, -_GROUP):
        group_px = xy_px[first : first + _GROUP]
        # A window at the edge is moved inside: it shows no star, and few windows are at an edge.
        centre = np.clip(np.rint(group_px).astype(np.int64), _RADIUS_PX, inner)
        windows = windows_about(pixels, centre, _RADIUS_PX).astype(np.float32)
        light = windows.reshape(_GROUP, -1) @ _CORE.ravel()
        noise = background.noise_at(group_px) * np.linalg.norm(_CORE)
        if np.clip(light / noise, -_MOST_SNR, _MOST_SNR).mean() >= _DARK * min_snr:
            break
        count = first + _GROUP
    return count
