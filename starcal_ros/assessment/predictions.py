# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Predictions of images, stars and cells of the detector from all others.

The estimate without image k is one linear step from the posterior at the most likely amplitudes.
N is the information on the shared unknowns with their priors, M_k the part of image k with its own
unknowns eliminated, J the derivatives by the shared unknowns, K those by the unknowns of the
image, W their prior and ``G = 1 - K (K' K + W)^-1 K'``: the residuals r, whitened by the working
variance, become ``G r + G J (N - M_k)^-1 J' G r`` and have the covariance ``G + G (V - 1) G + G J
((N - M_k)^-1 + E) J' G``, where V is the variance of an observation over the working one and E the
covariance of the others by the errors that observations share, beyond the working weights.  (The
posterior averaged over the amplitudes has wide tails: less an image, its inverse is nearly
singular.)  Stars, cells and stars of like brightness are predicted as groups: the sum of the
residuals of a group has the variance of their noise and of the error that they share, less the
part that the unknowns absorb.  The mean square over the predicted variance is 1 where the model
and its sigmas hold, in every part of the data.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.estimation.calibrate import Estimate
from starcal_ros.estimation.equations import star_rows
from starcal_ros.estimation.levenberg_marquardt import inverse
from starcal_ros.estimation.limits import FEWEST, NEGLIGIBLE
from starcal_ros.estimation.shared_errors import pairs_of
from starcal_ros.records import ResidualBin

_BINS = 4  # quantiles of radius, magnitude and time: corners and faint stars are separate
_FEWEST_STARS = 30  # the normalised residual of a bin is then accurate to 9 %


def predictions(estimate: Estimate) -> tuple[ResidualBin, ...]:
    """
    Return the normalised residuals of parts of the data, each predicted by the others.

    Images by radius, magnitude and time; then stars by the number of their images, cells of the
    detector by radius, and stars of like brightness of an image by magnitude.  Empty with fewer
    than four images.
    """
    table = estimate.table
    if table.image_count <= FEWEST:  # fewer may determine no calibration without one of them
        return ()
    found, expected = predicted_residuals(estimate)
    used = estimate.kept & np.isfinite(found)
    if not used.any():
        return ()
    radius_px = _radius_px(estimate, table.measured_px)
    in_time: Floats = np.empty(table.image_count)
    in_time[np.argsort(estimate.linear.problem.time_s, kind='stable')] = np.arange(len(in_time))
    return (
        *_bins('radius', radius_px, found, expected, used),
        *_bins('magnitude', table.magnitude.astype(np.float64), found, expected, used),
        *_bins('image', in_time[table.image], found, expected, used),
        *_groups(estimate, expected, used),
    )


def _radius_px(estimate: Estimate, pixels: Floats) -> Floats:
    camera = estimate.geometry.camera
    middle = 0.5 * (np.array([camera.width, camera.height]) - 1)
    return np.asarray(np.linalg.norm(pixels - middle, axis=1))


def predicted_residuals(estimate: Estimate) -> tuple[Floats, Floats]:
    """
    Return squared whitened residuals (n,) of stars, and their expected values (n,).

    The image of a star is predicted by the others.  NaN for stars that were not used, and for
    stars of images without which the others determine no calibration.
    """
    found: Floats = np.full(len(estimate.table), np.nan)
    expected: Floats = np.full(len(estimate.table), np.nan)
    part, mean, information = _at_most_likely(estimate)
    errors = estimate.posterior.errors
    assert errors is not None
    root = errors.root[part]
    excess = root @ errors.excess @ root.T
    variance_px2 = estimate.weights.variance_px2
    own_share = variance_px2 / (variance_px2 + estimate.weights.inflation_px2)
    of_image = estimate.linear.layout.image_precision(estimate.posterior.shapes.sigma_px)
    for rows, columns, own, residual in _images(estimate, part, mean):
        V = own_share[rows]
        predicted = _predicted(
            columns, own, residual, np.tile(V, 2), information, np.diag(of_image), excess
        )
        if predicted is not None:
            found[rows], expected[rows] = predicted[0] / V, predicted[1] / V
    return found, expected


def _at_most_likely(estimate: Estimate) -> tuple[Indices, Floats, Floats]:
    """Return unknowns (d,), means (P,) of all and information (d, d) at the best amplitudes."""
    posterior, layout = estimate.posterior, estimate.linear.layout
    given = posterior.equations
    entry, field = layout.field, layout.field_at
    assert entry.octave is not None and entry.term is not None
    sigma_px = entry.sigma * np.exp(posterior.field.log_px)[entry.octave]
    term, precision = np.zeros(layout.count), layout.prior_precision.copy()
    term[field], precision[field] = entry.term * np.exp(posterior.term.log_px[0]), sigma_px**-2.0
    # These keep their values: each image may have its own sidereal time, which others do not show,
    # and field coefficients that their prior holds at zero predict nothing of an image.
    shown = (sigma_px**2 + term[field] ** 2) * np.diag(given.information)[field]
    kept = np.concatenate([layout.of(['site']), field[shown < NEGLIGIBLE]])
    part, held = np.setdiff1d(posterior.estimated, kept), np.intersect1d(posterior.estimated, kept)
    own = precision[part]
    pull = own * term[part]
    information = given.information[np.ix_(part, part)] + np.diag(own)
    information -= np.outer(pull, pull) / (1.0 + term[part] @ pull)
    mean = posterior.mean.copy()
    right = given.gradient[part] - own * layout.prior_offset[part]
    right -= given.information[np.ix_(part, held)] @ mean[held]
    mean[part] = inverse(information) @ right
    return part, mean, information


def _images(
    estimate: Estimate, part: Indices, mean: Floats
) -> Iterator[tuple[Indices, Floats, Floats, Floats]]:
    """Yield rows, columns (2 n, d), own columns (2 n, b) and residuals (2 n,) of each image."""
    equations = estimate.posterior.equations
    of_images = equations.own - equations.back @ mean
    for chunk, shared, own, residual in star_rows(estimate.linear, part, mean):
        left = residual - np.einsum('mij,mj->mi', own, of_images[chunk.image])
        m, _, n = chunk.direction_icrf.shape
        real = chunk.whitener[0].reshape(m, n) > 0
        for i, rows in enumerate(chunk.row.reshape(m, n)):
            used = np.flatnonzero(np.tile(real[i], 2))
            # The rows lie star by star: whole columns are copied.
            columns = shared[i].T[:, used].T
            yield rows[real[i]], columns, own[i, used], left[i, used]


def _predicted(
    J: Floats,
    K: Floats,
    r: Floats,
    V: Floats,
    information: Floats,
    own_prior: Floats,
    excess: Floats,
) -> tuple[Floats, Floats] | None:
    """
    Squared residuals (n,) and their expected values of an image that the others predict.

    Derivatives J (2 n, d) by the shared unknowns and K (2 n, b) by those of the image, residuals r
    (2 n,), V (2 n,), N (d, d), W (b, b) and E (d, d) as at the top of this module; components u
    before v.  None where the image alone determines something, or has too few stars for its
    rotation.
    """
    n = len(r) // 2
    try:
        factor = cho_factor(K.T @ K + own_prior, lower=True)
        GJ = J - (cho_solve(factor, K.T @ J).T @ K.T).T
        Gr = r - K @ cho_solve(factor, K.T @ r)
        without = cho_factor(information - J.T @ GJ)
    except np.linalg.LinAlgError:
        return None
    Gr = Gr + GJ @ cho_solve(without, GJ.T @ r)
    # Diagonals.  The inverse of the small matrix is formed, as its product with many rows takes a
    # tenth of the time of their solution.
    back = K @ cho_solve(factor, np.eye(K.shape[1]))
    leverage, beyond = (back * K).sum(axis=1), V - 1.0
    variance = 1.0 - leverage + beyond * (1.0 - 2.0 * leverage)
    variance += ((back @ ((K.T * beyond) @ K)) * back).sum(axis=1)
    variance += (((cho_solve(without, np.eye(J.shape[1])) + excess) @ GJ.T) * GJ.T).sum(axis=0)
    return (Gr**2).reshape(2, n).sum(axis=0), variance.reshape(2, n).sum(axis=0)


def _groups(estimate: Estimate, expected: Floats, used: Mask) -> list[ResidualBin]:
    """Bins of stars, cells and stars of like brightness: sums over their predicted sigma."""
    rows = np.flatnonzero(used)
    residual_px = estimate.residual_px[rows]
    variance = estimate.weights.variance_px2[rows]
    free = 0.5 * np.minimum(expected[rows], 2.0)
    from_sky = estimate.weights.from_sky[rows]
    on_sky = np.einsum('nba,nb->na', from_sky, residual_px)
    pixels = estimate.table.measured_px[rows]
    of_stars, coarsest, *finer = estimate.weights.errors
    cell = np.unique(coarsest.group[rows], return_inverse=True)[1]
    star = np.unique(estimate.table.star[rows], return_inverse=True)[1]
    magnitude = estimate.table.magnitude[rows].astype(np.float64)
    edges = np.quantile(magnitude, np.linspace(0.0, 1.0, _BINS + 1)[1:-1])
    alike = estimate.table.image[rows] * _BINS + np.searchsorted(edges, magnitude)
    alike = np.unique(alike, return_inverse=True)[1]
    of_star = of_stars.share_px2[rows]
    fine = np.sum([error.share_px2[rows] for error in (coarsest, *finer)], axis=0)
    weight = 1.0 / variance
    bins = []
    for by, group, value, shared, along in (
        ('star', star, on_sky, of_star, np.bincount(star)[star]),
        ('cell', cell, residual_px, fine, _radius_px(estimate, pixels)),
        ('brightness', alike, residual_px, 0.0 * fine, magnitude),
    ):
        count = np.bincount(group)
        predicted = np.bincount(group, weight * free) + _of_pairs(group, weight, shared)
        if by == 'cell':  # a star that comes again in its cell brings its error again
            again = pairs_of(cell, star)
            first = np.unique(again, return_index=True)[1]
            twice = _of_pairs(again, weight, of_star)
            predicted += np.bincount(cell[first], twice, len(predicted))
        squared: Floats = np.asarray(sum(np.bincount(group, weight * v) ** 2 for v in value.T))
        mean = np.bincount(group, along) / count
        bins += _bins(by, mean, squared, np.asarray(2.0 * predicted, np.float64), count > 1)
    return bins


def _of_pairs(group: Indices, weight: Floats, share_px2: Floats) -> Floats:
    """Return the variances of weighted sums over groups by the covariances of their members."""
    each = weight * np.sqrt(share_px2)
    return np.asarray(np.bincount(group, each) ** 2 - np.bincount(group, each**2))


def _bins(
    by: str, value: Floats, found: Floats, expected: Floats, used: Mask
) -> list[ResidualBin]:
    """Bins of like count along a value."""
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
            ratio = float((found[inside] / expected[inside]).mean())
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
