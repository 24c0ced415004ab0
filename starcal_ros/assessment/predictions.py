# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Predictions of what was left out: images, stars and cells of the detector, from all others.

The estimate without image k is one linear step from the posterior.  N is the information on the
shared unknowns with their priors, M_k the part of image k with its own unknowns eliminated, J
the derivatives by the shared unknowns, K those by the unknowns of the image, W their prior and
``G = 1 - K (K' K + W)^-1 K'``: the residuals r become ``G r + G J (N - M_k)^-1 J' G r`` and have
the covariance ``G + G J (N - M_k)^-1 J' G``.  Stars and cells are predicted as groups: the sum of
the residuals of a group has the variance of their noise and of the error that they share, less
what the unknowns follow.  The mean square over the predicted variance is 1 where the model and its
sigmas hold, in every part of the data.
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
from starcal_ros.estimation.posterior import common_shape
from starcal_ros.records import ResidualBin

_BINS = 4  # of each kind: corners and faint stars stand apart, and each holds a quarter
_FEWEST_STARS = 30  # of a bin: its normalised residual is known to 9 %
_FEWEST_IMAGES = 4  # three may determine no calibration without one of them
_CELLS = 24  # of the detector along its width


def predictions(estimate: Estimate) -> tuple[ResidualBin, ...]:
    """
    Return the normalised residuals of what others predict, by parts of the data.

    Images by radius, magnitude and time; then stars by the number of their images, and cells of
    the detector by radius.  Empty with fewer than four images.
    """
    table = estimate.table
    if table.image_count < _FEWEST_IMAGES:
        return ()
    found, expected = predicted_residuals(estimate)
    used = estimate.kept & np.isfinite(found)
    if not used.any():
        return ()
    radius_px = _radius_px(estimate, table.measured_px)
    return (
        *_bins('radius', radius_px, found, expected, used),
        *_bins('magnitude', table.magnitude.astype(np.float64), found, expected, used),
        *_bins('image', table.image.astype(np.float64), found, expected, used),
        *_groups(estimate, expected, used),
    )


def _radius_px(estimate: Estimate, pixels: Floats) -> Floats:
    camera = estimate.geometry.camera
    middle = 0.5 * (np.array([camera.width, camera.height]) - 1)
    return np.asarray(np.linalg.norm(pixels - middle, axis=1))


def predicted_residuals(estimate: Estimate) -> tuple[Floats, Floats]:
    """
    Return squared whitened residuals (n,) of stars, their image predicted by the others.

    With their expected values (n,); NaN for stars that were not used, and of images without which
    the others determine no calibration.
    """
    found: Floats = np.full(len(estimate.table), np.nan)
    expected: Floats = np.full(len(estimate.table), np.nan)
    posterior = estimate.posterior
    # The sidereal time of an image that is left out is not known from the others: kept as found.
    part = np.setdiff1d(posterior.estimated, estimate.linear.layout.of(['site']))
    # A change that all images share moves no prediction of one from the others.
    shared = common_shape(estimate.linear.layout, posterior.common_shape_px2)
    covariance = (posterior.covariance - shared)[np.ix_(part, part)]
    shown = np.flatnonzero(np.diag(covariance) > 0)
    part, covariance = part[shown], covariance[np.ix_(shown, shown)]
    # Coefficients of the field that their prior holds at zero say nothing of an image.
    follow = _followed(estimate, part)
    part, covariance = part[follow], covariance[np.ix_(follow, follow)]
    information = inverse(covariance)
    of_image = estimate.linear.layout.image_precision(estimate.posterior.shape_sigma_px)
    for rows, columns, own, residual in _images(estimate, part):
        predicted = _predicted(columns, own, residual, information, np.diag(of_image))
        if predicted is not None:
            found[rows], expected[rows] = predicted
    return found, expected


def _followed(estimate: Estimate, part: Indices) -> Indices:
    """Return which unknowns move pixels by more than a thousandth of the noise of a star."""
    layout = estimate.linear.layout
    variance = np.diag(estimate.posterior.covariance)[part]
    weight = np.zeros(layout.count)
    weight[layout.places['field']] = np.diag(estimate.sums.field_information)
    of_field = np.isin(part, np.arange(layout.count)[layout.places['field']])
    return np.flatnonzero(~of_field | (variance * weight[part] > 1e-3))


def _images(estimate: Estimate, part: Indices) -> Iterator[tuple[Indices, Floats, Floats, Floats]]:
    """Yield rows, columns (2 n, d), own columns (2 n, b) and residuals (2 n,) of each image."""
    found = estimate.posterior
    for chunk, shared, own, residual in star_rows(estimate.linear):
        left = residual - shared @ found.mean
        left -= np.einsum('mij,mj->mi', own, found.of_images[chunk.image])
        m, _, n = chunk.direction_icrf.shape
        real = chunk.whitener[0].reshape(m, n) > 0
        for i, rows in enumerate(chunk.row.reshape(m, n)):
            used = np.tile(real[i], 2)
            yield rows[real[i]], shared[i, used][:, part], own[i, used], left[i, used]


def _predicted(
    J: Floats, K: Floats, r: Floats, information: Floats, own_prior: Floats
) -> tuple[Floats, Floats] | None:
    """
    Squared residuals (n,) and their expected values of an image that the others predict.

    Derivatives J (2 n, d) by the shared unknowns and K (2 n, b) by those of the image, residuals r
    (2 n,), N (d, d) and W (b, b) as at the top of this module; components u before v.  None where
    the image alone determines something, or has too few stars for its rotation.
    """
    n = len(r) // 2
    try:
        factor = cho_factor(K.T @ K + own_prior, lower=True)
        GJ = J - K @ cho_solve(factor, K.T @ J)
        Gr = r - K @ cho_solve(factor, K.T @ r)
        without = cho_factor(information - J.T @ GJ)
    except np.linalg.LinAlgError:
        return None
    Gr = Gr + GJ @ cho_solve(without, GJ.T @ r)
    # Diagonals of G and of G J (N - M)^-1 J' G.  The inverse of the small matrix is formed, as its
    # product with many rows takes a tenth of the time of their solution.
    variance = 1.0 - ((K @ cho_solve(factor, np.eye(K.shape[1]))) * K).sum(axis=1)
    variance += ((GJ @ cho_solve(without, np.eye(J.shape[1]))) * GJ).sum(axis=1)
    return (Gr**2).reshape(2, n).sum(axis=0), variance.reshape(2, n).sum(axis=0)


def _groups(estimate: Estimate, expected: Floats, used: Mask) -> list[ResidualBin]:
    """Bins of stars and of cells of the detector: sums of residuals over their predicted sigma."""
    rows = np.flatnonzero(used)
    residual_px = estimate.residual_px[rows]
    covariance = estimate.covariance_px2[rows]
    variance = 0.5 * (covariance[:, 0] + covariance[:, 2])
    free = 0.5 * np.minimum(expected[rows], 2.0)
    from_sky = estimate.weights.from_sky[rows]
    on_sky = np.einsum('nba,nb->na', from_sky, residual_px)
    pixels = estimate.table.measured_px[rows]
    size_px = estimate.geometry.camera.width / _CELLS
    index = np.floor((pixels + 0.5) / size_px).astype(np.int64)
    cell = np.unique(index[:, 0] * (1 << 20) + index[:, 1], return_inverse=True)[1]
    star = np.unique(estimate.table.star[rows], return_inverse=True)[1]
    place = sum(e.variance_px2 for e in estimate.shared_errors if e.of_star)
    fine = sum(e.variance_px2 for e in estimate.shared_errors if not e.of_star)
    bins = []
    along: Floats
    for by, group, value, shared, along in (
        ('star', star, on_sky, place, np.bincount(star).astype(np.float64)),
        ('cell', cell, residual_px, fine, _radius_px(estimate, _centres(cell, pixels))),
    ):
        weight = 1.0 / variance
        total = np.bincount(group, weight)
        summed = np.stack([np.bincount(group, weight * v) for v in value.T], axis=1)
        noise = np.bincount(group, weight * free)
        predicted = noise + shared * (total**2 - np.bincount(group, weight**2))
        if by == 'cell':  # a star that comes again in its cell brings its error of place again
            again = np.unique(cell * (int(star.max()) + 1) + star, return_inverse=True)[1]
            first = np.unique(again, return_index=True)[1]
            twice = np.bincount(again, weight) ** 2 - np.bincount(again, weight**2)
            predicted += place * np.bincount(cell[first], twice, len(predicted))
        several = np.bincount(group) > 1
        squared = (summed**2).sum(axis=1)
        bins += _bins(by, along, squared, np.asarray(2.0 * predicted, np.float64), several)
    return bins


def _centres(group: Indices, pixels: Floats) -> Floats:
    """Return the mean pixel (g, 2) of each group."""
    count = np.bincount(group)
    return np.stack([np.bincount(group, p) / count for p in pixels.T], axis=1)


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
