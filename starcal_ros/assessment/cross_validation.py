# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Residuals of each image, predicted from the other images, by radius, magnitude and time.

The calibration without image k is one linear step from the minimum.  N is the information on the
shared unknowns, M_k the part of image k and a_k its gradient, all rotations eliminated; the step
is ``delta_k = -(N - M_k)^-1 a_k``.  With J the derivatives by the shared unknowns, K those by the
rotation and shape of the image, W the prior of the shape and ``G = I - K (K' K + W)^-1 K'``, the
residuals are ``G (r - J delta_k)`` and have the covariance ``G + G J (N - M_k)^-1 J' G``.  Their
mean square over that variance is 1 where the model and its sigmas hold, in every part of the data.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from starcal_ros.arrays import Floats, Mask
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.least_squares.levenberg_marquardt import inverse
from starcal_ros.least_squares.linear_terms import LinearTerms
from starcal_ros.least_squares.normal_equations import Chunk, Measurements, whitened_chunks
from starcal_ros.methods.assembly import image_chain, reduced_information
from starcal_ros.methods.problem import image_parameters, Problem, State
from starcal_ros.records import ResidualBin

_BINS = 4  # of each kind: corners and faint stars stand apart, and each holds a quarter
_FEWEST_STARS = 30  # of a bin: its normalised residual is known to 9 %
_FEWEST_IMAGES = 4  # three may determine no calibration without one of them


def cross_validation(estimate: Estimate, measurements: Measurements) -> tuple[ResidualBin, ...]:
    """
    Return the normalised residuals of images that others predict, by parts of the data.

    Parameters
    ----------
    measurements : Measurements
        The stars that were used.

    Returns
    -------
    tuple of ResidualBin
        By radius, magnitude and time; empty with fewer than four images.
    """
    table = estimate.table
    if table.image_count < _FEWEST_IMAGES:
        return ()
    found, expected = predicted_residuals(estimate, measurements)
    used = estimate.kept & np.isfinite(found)
    if not used.any():
        return ()
    middle = 0.5 * (
        np.array([estimate.geometry.camera.width, estimate.geometry.camera.height]) - 1
    )
    radius_px = np.linalg.norm(table.measured_px - middle, axis=1)
    return (
        *_bins('radius', radius_px, found, expected, used),
        *_bins('magnitude', table.magnitude.astype(np.float64), found, expected, used),
        *_bins('image', table.image.astype(np.float64), found, expected, used),
    )


def predicted_residuals(estimate: Estimate, measurements: Measurements) -> tuple[Floats, Floats]:
    """
    Return squared whitened residuals (n,) of stars, their image predicted by the others.

    With their expected values (n,); NaN for stars that were not used, and of images without which
    the others determine no calibration.  Parameters as of `cross_validation`.
    """
    problem, state = estimate.problem, estimate.state
    squared: Floats = np.full(len(estimate.table), np.nan)
    expected: Floats = np.full(len(estimate.table), np.nan)
    shared = _shared_information(problem, state, estimate.blocks, estimate.field_terms)
    for rows, found, variance in _images(problem, state, measurements, shared):
        squared[rows], expected[rows] = found, variance
    return squared, expected


def _shared_information(
    problem: Problem, state: State, blocks: Floats, field: LinearTerms | None
) -> Floats:
    """Information (d, d) on free camera parameters, focal terms and modes, the rest eliminated."""
    information = reduced_information(problem, state, blocks, field)
    k, modes = problem.camera_count + len(state.focal), len(state.modes)
    estimated = np.concatenate([problem.free, np.arange(problem.camera_count, len(information))])
    covariance = inverse(information[np.ix_(estimated, estimated)])
    first = len(problem.free) + k - problem.camera_count
    of_images = np.r_[0:first, len(estimated) - modes : len(estimated)]
    return inverse(covariance[np.ix_(of_images, of_images)])


def _images(
    problem: Problem, state: State, measurements: Measurements, shared: Floats
) -> list[tuple[NDArray[np.int64], Floats, Floats]]:
    """Rows, squared residuals and their expected values of the stars of each image."""
    found = []
    chunks = whitened_chunks(
        measurements,
        problem.model,
        image_parameters(problem, state),
        state.camera_from_icrf.as_matrix(),
        problem.field_prior.field(state.modes) if problem.field_prior else None,
    )
    chain = image_chain(problem, state, measurements.image_count)
    k = problem.camera_count + len(state.focal)
    of_camera = np.concatenate([problem.free, np.arange(problem.camera_count, k)])
    for chunk, J in chunks:
        if J is None:
            continue
        m, _, n = chunk.direction_icrf.shape
        by_image = J[:, :-1].reshape(2, -1, m, n).transpose(2, 0, 3, 1)
        modes = _whitened_modes(problem, chunk).reshape(2, -1, m, n).transpose(2, 0, 3, 1)
        for i, image in enumerate(chunk.image):
            real = chunk.whitener[0].reshape(m, n)[i] > 0
            columns = by_image[i][:, real] @ chain[image]
            own, residual = columns[..., k:-1], columns[..., -1]
            common = np.concatenate([columns[..., of_camera], modes[i][:, real]], axis=-1)
            predicted = _predicted(problem, common, own, residual, shared)
            if predicted is not None:
                rows = chunk.row.reshape(m, n)[i][real]
                found.append((rows, *predicted))
    return found


def _whitened_modes(problem: Problem, chunk: Chunk) -> Floats:
    """Whitened displacements (2, r, m n) of the stars of a chunk by the modes of the field."""
    prior = problem.field_prior
    if prior is None:
        return np.empty((2, 0, chunk.measured_px.shape[1]))
    phi = prior.polynomials(chunk.measured_px)
    u, v = prior.modes[: len(phi)].T @ phi, prior.modes[len(phi) :].T @ phi
    wuu, wuv, wvv = chunk.whitener
    return np.stack([wuu * u + wuv * v, wvv * v])


def _predicted(
    problem: Problem, common: Floats, own: Floats, residual: Floats, shared: Floats
) -> tuple[Floats, Floats] | None:
    """
    Squared residuals (n,) and their expected values of an image that the others predict.

    None where the image alone determines something, or has too few stars for its rotation.
    """
    n, d = residual.shape[1], common.shape[-1]
    J, K, r = common.reshape(2 * n, d), own.reshape(2 * n, -1), residual.reshape(2 * n)
    held = K.T @ K
    held[3:, 3:] += np.diag(1.0 / problem.shape_sigma_px**2)
    try:
        factor = cho_factor(held, lower=True)
        GJ = J - K @ cho_solve(factor, K.T @ J)
        Gr = r - K @ cho_solve(factor, K.T @ r)
        without = cho_factor(shared - J.T @ GJ)
    except np.linalg.LinAlgError:
        return None
    Gr = Gr + GJ @ cho_solve(without, GJ.T @ r)
    # Diagonals of G and of G J (N - M)^-1 J' G.  The inverse of the small matrix is formed, as its
    # product with many rows takes a tenth of the time of their solution.
    variance = 1.0 - ((K @ cho_solve(factor, np.eye(K.shape[1]))) * K).sum(axis=1)
    variance += ((GJ @ cho_solve(without, np.eye(d))) * GJ).sum(axis=1)
    return (Gr**2).reshape(2, n).sum(axis=0), variance.reshape(2, n).sum(axis=0)


def _bins(
    by: str, value: Floats, found: Floats, expected: Floats, used: Mask
) -> list[ResidualBin]:
    """Bins of like star count along a value."""
    count = int(min(_BINS, np.count_nonzero(used) // _FEWEST_STARS))
    if count == 0:
        return []
    edges = np.quantile(value[used], np.linspace(0.0, 1.0, count + 1))
    index = np.searchsorted(edges[1:-1], value, side='right')
    bins = []
    for k in range(count):
        inside = used & (index == k)
        n = int(np.count_nonzero(inside))
        if n:
            ratio = float(found[inside].sum() / expected[inside].sum())
            bins.append(
                ResidualBin(
                    by=by,
                    low=float(edges[k]),
                    high=float(edges[k + 1]),
                    stars=n,
                    normalised=math.sqrt(ratio),
                    sigma=0.5 / math.sqrt(n),
                )
            )
    return bins
