# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Star-tracker errors that are alike from image to image: how much the mean of the images is worth.

The attitude errors that the stars of each image show are a constant (the alignment), white noise
and, for a star tracker that wanders with heat or orbit, an Ornstein-Uhlenbeck process of variance
``s^2`` and correlation time ``tau``.  Its likelihood at irregular times is one pass of a Kalman
filter (Kelly et al. 2009, ApJ 698, 895), here over a grid of parameters at once and with the
constant profiled (restricted likelihood).  The variance of the constant is averaged over the grid
by likelihood, because one ensemble seldom determines ``tau``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from starcal_ros.arrays import Floats

_FEWEST_IMAGES = 8  # fewer show no correlation time
_SHARES = np.array([0.0, 0.3, 0.6, 0.9, 1.0])  # of the process in the variance of the tracker
# Of its standard deviation, in the scatter of the images: a perfect star tracker has none, and an
# image of few stars scatters by far more than the star tracker.
_SCALES = np.concatenate([[0.0], np.geomspace(0.05, 6.0, 20)])
_TIMES = 12  # from half the median interval to four times the span
# Twice the log of the likelihood ratio that white noise exceeds in 7 of 100 ensembles of 14 images
# and in 1 of 100 of 200, by draws with a coarser grid of scales.  Averaging without need makes the
# sigma 2 times as large.
_DETECTION = 3.0
_UNLIMITED = np.full(3, np.inf)
_COARSE = 2.0  # a quarter of the grid missed at most 1.5 of it in 6,338 drawn ensembles


@dataclass(frozen=True)
class AttitudeCorrelation:
    """
    Correlation of the star-tracker errors of an ensemble.

    Attributes
    ----------
    detected : bool
        Whether the correlation is carried in the variance.
    correlation_time_s : float
        Most likely; 0 where not detected.
    independent_images : (3,)
        Number of images with independent errors that would determine the mean as well.
    added_variance_rad2 : (3,)
        What the correlation adds to the variance of the mean of the images.
    """

    detected: bool
    correlation_time_s: float
    independent_images: Floats
    added_variance_rad2: Floats


def attitude_correlation(
    time_ns: NDArray[np.int64],
    error_rad: Floats,
    variance_rad2: Floats,
    suspect: bool,
    largest_rad: Floats = _UNLIMITED,
) -> AttitudeCorrelation:
    """
    Return the correlation of star-tracker errors in time.

    Parameters
    ----------
    time_ns : (m,)
        Of the images, in any order.
    error_rad : (m, 3)
        Star-tracker errors by the stars, about the axes of the star tracker.
    variance_rad2 : (m, 3)
        Of them, from the centroids.
    suspect : bool
        Whether the scatter of the images exceeds the assumed sigma of the star tracker: then the
        correlation is averaged over without a test, since a short ensemble cannot reject it.
    largest_rad : (3,)
        Largest sigma of a correlated process: an assumed one that the scatter does not exceed.
    """
    m = len(time_ns)
    none = AttitudeCorrelation(False, 0.0, np.full(3, float(m)), np.zeros(3))
    order = np.argsort(time_ns)
    steps_s = np.diff(time_ns[order]) / 1e9
    if m < _FEWEST_IMAGES or not (steps_s > 0).any():
        return none
    error, noise = error_rad[order], variance_rad2[order]
    scatter = np.sqrt(np.maximum(error.var(axis=0, ddof=1), 1e-300))
    times_s = np.geomspace(0.5 * np.median(steps_s[steps_s > 0]), 4.0 * steps_s.sum(), _TIMES)
    # Most ensembles show no correlation on a quarter of the grid, far from the limit.
    for every, least in ((2, _DETECTION - _COARSE), (1, _DETECTION)):
        scales, times = _SCALES[::every], times_s[::every]
        share, scale, tau = (
            axis.ravel() for axis in np.meshgrid(_SHARES, scales, times, indexing='ij')
        )
        total = (scale[:, None] * scatter) ** 2  # (g, 3)
        process, white = share[:, None] * total, (1.0 - share)[:, None] * total
        log_likelihood, variance = _filter(error, noise, steps_s, process, white, tau)
        # One share and one correlation time for all axes; each axis has its own scale.
        too_large = (share > 0.0)[:, None] & (np.sqrt(total) > largest_rad)
        log_likelihood = np.where(too_large, -np.inf, log_likelihood)
        by_process = log_likelihood.reshape(len(_SHARES), len(scales), len(times), 3)
        most = by_process.max(axis=1).sum(axis=2)  # (shares, times)
        if not suspect and 2.0 * (most.max() - most[0].max()) < least:
            return none
    prior = most - most.max()
    conditional = by_process - by_process.max(axis=1, keepdims=True)
    weight = np.exp(conditional + prior[:, None, :, None])
    weight /= weight.sum(axis=(0, 1, 2))
    by_process_variance = variance.reshape(by_process.shape)
    mean_variance = (weight * by_process_variance).sum(axis=(0, 1, 2))
    white_k = by_process[0].reshape(-1, 3).argmax(axis=0)
    white_variance = by_process_variance[0].reshape(-1, 3)[white_k, np.arange(3)]
    added = np.maximum(mean_variance - white_variance, 0.0)
    time_k = int(np.unravel_index(most.argmax(), most.shape)[1])
    return AttitudeCorrelation(
        detected=True,
        correlation_time_s=float(times_s[time_k]),
        independent_images=m * white_variance / (white_variance + added),
        added_variance_rad2=added,
    )


def _filter(
    error: Floats, noise: Floats, steps_s: Floats, process: Floats, white: Floats, tau: Floats
) -> tuple[Floats, Floats]:
    """
    Restricted log-likelihood (g, 3) of each grid point and axis, and variance (g, 3) of the mean.

    The same gains filter the errors and a series of ones: the mean is the regression of the
    innovations of one on those of the other.
    """
    state = np.zeros((2, *process.shape))  # of the errors, of the ones
    variance = process.copy()
    log_det, squares = np.zeros_like(process), np.zeros((3, *process.shape))
    for k in range(len(error)):
        if k:
            decay = np.exp(-steps_s[k - 1] / tau)[:, None]
            state *= decay
            variance = process + decay**2 * (variance - process)
        innovation_variance = variance + white + noise[k]
        innovation = np.stack([error[k] - state[0], 1.0 - state[1]])
        gain = variance / innovation_variance
        state += gain * innovation
        variance = variance * (1.0 - gain)
        log_det += np.log(innovation_variance)
        squares[0] += innovation[0] ** 2 / innovation_variance
        squares[1] += innovation[0] * innovation[1] / innovation_variance
        squares[2] += innovation[1] ** 2 / innovation_variance
    left = squares[0] - squares[1] ** 2 / squares[2]
    return -0.5 * (log_det + np.log(squares[2]) + left), 1.0 / squares[2]
