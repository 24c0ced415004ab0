# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Weights of stars and star trackers from the residuals of a round of the estimate.

The variances of centroids, the errors that observations share, the stars that are left out and
the errors of the star trackers follow from the residuals of a posterior and weigh the next round.

A residual is smaller than its error, because the unknowns follow it: of two axes an observation of
leverage h keeps ``2 - h`` degrees of freedom.  A bright star holds the rotation of its image and
keeps fewer than a faint one, so each observation has its own.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.equations import (
    chain,
    chain_columns,
    Linearisation,
    seen_by_stars,
    StarSums,
)
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.limits import FREE_FACTOR, MOST_ROUNDS, ROUNDING, STEP_SIGMA
from starcal_ros.estimation.options import CalibrationOptions, tracker_sigma_is_given
from starcal_ros.estimation.outliers import fitting_stars, misfit_images, QUARTILE
from starcal_ros.estimation.posterior import Posterior
from starcal_ros.estimation.problem import (
    attitude_errors,
    image_alignment,
    image_parameters,
    Problem,
    State,
)
from starcal_ros.estimation.shared_errors import (
    Groups,
    shared_errors,
    SharedError,
    star_shares_px2,
)
from starcal_ros.estimation.star_equations import ROTATION, StarTable, whitened_chunks
from starcal_ros.estimation.tracker_errors import (
    AttitudeErrors,
    correlations_of,
    Rates,
    tracker_errors,
    TrackerErrors,
)
from starcal_ros.estimation.unknowns import Assumptions
from starcal_ros.records import CameraGeometry

EXACT_RAD = 1e-3 * ARCSECOND_RAD  # sigma in Method 2, which takes the star tracker as exact
_SCALE_LIMITS = (0.05, 400.0)  # data without noise, and centroids whose covariance means nothing
# Nodes of the factor as a function of magnitude, at quantiles.  Without that function, halves of
# two real sets differ by 1.19 and 1.92 of their sigma, with it by 1.01 and 1.75.
_NODES = 5
_BINS = 500  # bins of magnitude, in which that function is constant to a hundredth
_NODE_SIGMA = 0.5  # prior 1-sigma of a log factor: cores and wings of bright stars
_LEAST_FREEDOM = 0.1  # floor of the freedom of two axes: one star of few keeps none


@dataclass(frozen=True)
class CentroidVariance:
    """
    Correction of the centroid covariances C: ``f(magnitude) (scale C + floor_px2 I)``.

    The floor covers errors that a centroid fit cannot see: the real shape of the PSF, the air.
    The scale corrects a wrong detector gain.  The factor f covers errors that come with
    brightness, as of saturated cores: linear between ``class_magnitude`` (k,), ascending, with the
    values ``class_factor`` (k,), and constant outside; 1 where both are empty.
    """

    scale: float
    floor_px2: float
    class_magnitude: tuple[float, ...] = ()
    class_factor: tuple[float, ...] = ()

    def of(self, covariance_px2: Floats, magnitude: NDArray[np.floating]) -> Floats:
        """Corrected covariances (n, 3) uu, uv, vv of stars of magnitudes (n,)."""
        corrected = self.scale * covariance_px2 + self.floor_px2 * np.array([1.0, 0.0, 1.0])
        return corrected * self.factor(magnitude)[:, None]

    def factor(self, magnitude: NDArray[np.floating]) -> Floats:
        """Factors (n,) on the variance of stars of magnitudes (n,)."""
        if not self.class_magnitude:
            return np.ones(len(magnitude))
        return np.asarray(np.interp(magnitude, self.class_magnitude, self.class_factor))


def estimate_variance(
    residual_px: Floats,
    covariance_px2: Floats,
    magnitude: NDArray[np.floating],
    used: Mask,
    freedom: Floats,
    outlier_sigma: float,
) -> CentroidVariance:
    """
    Scale, floor and factor by brightness that make the covariances those of the residuals.

    Parameters
    ----------
    residual_px, covariance_px2, magnitude, used : (n, 2), (n, 3), (n,), (n,) bool
        The observations that the fit used, with their covariances as measured.
    freedom : (n,)
        Degrees of freedom that the fit leaves each of them, of two.
    outlier_sigma : float
        Length of a residual beyond which it is an outlier.

    Notes
    -----
    Scale and floor maximise the restricted likelihood of the residuals, whose gradient is the sum
    of ``freedom / 2 (square / freedom - variance) / variance^2`` times the derivatives of the
    variance: weighted least squares of squares over freedom on the measured variance and one, the
    weights renewed, with less of a square near that of an outlier (`_part`).
    """
    own = 0.5 * (covariance_px2[used, 0] + covariance_px2[used, 2])
    left = np.maximum(freedom[used], _LEAST_FREEDOM)
    squared = (residual_px[used] ** 2).sum(axis=1) / left
    # The median of a squared length of two normal axes is ln 2 of its mean.
    scale, floor_px2 = max(float(np.median(squared / own)) / math.log(2.0), 1e-12), 0.0
    for _ in range(MOST_ROUNDS):
        expected = scale * own + floor_px2
        weight = 0.5 * left * _part(squared / expected, outlier_sigma) / expected**2
        scale, floor_px2 = _line(own, squared, weight)
        step = scale * own + floor_px2 - expected
        if weight @ step**2 < STEP_SIGMA**2:
            break
    ratio = squared / (scale * own + floor_px2)
    counted = 0.5 * left * _part(ratio, outlier_sigma)
    nodes, factors = _brightness(ratio, counted, np.asarray(magnitude, np.float64)[used])
    return CentroidVariance(scale, floor_px2, nodes, factors)


def _part(ratio: Floats, outlier_sigma: float) -> Floats:
    """
    Return the part of squared residuals over variance (n,) that counts.

    Half at the limit of outliers, 4.5 sigma, all to 4.1 and none from 4.9.
    One at an edge would count and not count in turns, and the estimate with it.
    """
    return np.asarray(np.clip(3.5 - 3.0 * ratio / (0.5 * outlier_sigma**2), 0.0, 1.0))


def _line(own: Floats, squared: Floats, weight: Floats) -> tuple[float, float]:
    """Return scale and floor of ``squared = scale own + floor``, not negative."""
    weighted = weight * own
    by_own, both, by_one = float(weighted @ own), float(weighted.sum()), float(weight.sum())
    right_own, right_one = float(weighted @ squared), float(weight @ squared)
    determinant = by_own * by_one - both**2
    scale, floor_px2 = right_own / by_own, 0.0
    if determinant > ROUNDING * by_own * by_one:  # not all variances are equal
        scale = (by_one * right_own - both * right_one) / determinant
        floor_px2 = (by_own * right_one - both * right_own) / determinant
    if floor_px2 < 0:
        scale, floor_px2 = right_own / by_own, 0.0
    if not _SCALE_LIMITS[0] <= scale <= _SCALE_LIMITS[1]:
        scale = float(np.clip(scale, *_SCALE_LIMITS))
        floor_px2 = max((right_one - scale * both) / by_one, 0.0)
    return scale, floor_px2


def _brightness(
    ratio: Floats, counted: Floats, magnitude: Floats
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """
    Return magnitudes and factors of a smooth function of brightness.

    Scoring of the exponential likelihood of ``ratio`` (n,), squared residuals over variance, of
    which each counts as ``counted`` (n,) stars, with a normal prior of the logarithms: few stars,
    or none that differ, give factors near 1.
    """
    nodes = np.unique(np.quantile(magnitude, np.linspace(0.0, 1.0, _NODES)))
    if len(nodes) < 2:
        return (), ()
    place = np.rint((magnitude - nodes[0]) / np.ptp(nodes) * _BINS).astype(np.int64)
    stars, summed = (np.bincount(place, counted * one) for one in (1.0, ratio))
    bins = nodes[0] + np.ptp(nodes) / _BINS * np.arange(len(stars))
    basis = np.stack([np.interp(bins, nodes, row) for row in np.eye(len(nodes))], axis=1)
    log_factor = np.zeros(len(nodes))
    prior = np.eye(len(nodes)) / _NODE_SIGMA**2
    for _ in range(MOST_ROUNDS):
        scaled = summed * np.exp(-basis @ log_factor)
        gradient = basis.T @ (scaled - stars) - prior @ log_factor
        # Observed in place of expected information: monotone for a convex cost.
        step = np.linalg.solve(
            (basis * np.maximum(scaled, stars)[:, None]).T @ basis + prior, gradient
        )
        log_factor = np.clip(log_factor + step, *np.log(_SCALE_LIMITS))
        if gradient @ step < STEP_SIGMA**2:
            break
    return tuple(nodes.tolist()), tuple(np.exp(log_factor).tolist())


@dataclass(frozen=True)
class Data:
    """Inputs that stay the same over the rounds of an estimate."""

    table: StarTable
    time_ns: NDArray[np.int64]
    stated_rad: Floats  # (3,)
    prior: CameraGeometry
    options: CalibrationOptions
    rates: Rates  # in the frame of the first star tracker
    assumed: Assumptions
    groups: tuple[Groups, ...]


@dataclass(frozen=True)
class Weighting:
    """Conclusions from the residuals of a round: the weights of the next one."""

    variance: CentroidVariance
    errors: tuple[SharedError, ...]
    kept: Mask
    attitudes: AttitudeErrors | None

    def covariance_px2(self, table: StarTable) -> Floats:
        """Return the covariances (n, 3) of the observations."""
        covariance_px2 = self.variance.of(table.covariance_px2, table.magnitude)
        beyond_px2 = np.broadcast_to(star_shares_px2(self.errors)[1], len(table))
        return np.asarray(covariance_px2 + np.outer(beyond_px2, [1.0, 0.0, 1.0]))

    def inflation_px2(self, table: StarTable) -> Floats:
        """
        Return the variance (n,) by which the weights are lower for errors that images share.

        With it, k images of a star weigh as the mean of theirs does.
        """
        sightings = np.bincount(table.star, self.kept, int(table.star.max()) + 1)[table.star]
        return np.asarray(np.maximum(sightings - 1.0, 0.0) * star_shares_px2(self.errors)[0])

    def working_px2(self, table: StarTable) -> Floats:
        """Return the covariances (n, 3) whose inverses are the weights."""
        inflation_px2 = self.inflation_px2(table)
        return self.covariance_px2(table) + np.outer(inflation_px2, [1.0, 0.0, 1.0])


def weighted_attitudes(
    problem: Problem, data: Data, attitudes: AttitudeErrors | None, state: State
) -> Problem:
    """
    Return the problem with the working sigmas of the star trackers.

    Until their errors are known, by the scatter at the state of the robust search: a stated sigma
    that is too small would bend the camera to the attitudes, which then seem to be right.
    """
    m = data.table.image_count
    if data.options.method == 'single':
        return dataclasses.replace(problem, star_tracker_sigma_rad=np.full((m, 3), EXACT_RAD))
    factor = np.ones((m, 3))
    if attitudes is None:
        error = attitude_errors(problem, state, state.camera_from_icrf) / data.stated_rad
        factor *= max(1.0, float(np.median(np.abs(error))) / QUARTILE)
    else:
        for tracker in attitudes.trackers:
            factor[tracker.images[:, None], tracker.axes] = tracker.working
        factor[attitudes.misfit] = np.inf
    if data.options.method == 'per_image':
        factor *= FREE_FACTOR
    return dataclasses.replace(problem, star_tracker_sigma_rad=factor * data.stated_rad)


def degrees_of_freedom(
    found: Posterior, linear: Linearisation, table: StarTable, kept: Mask
) -> Floats:
    """Degrees of freedom (n,) that the fit leaves each observation, of two."""
    problem, state, layout = linear.problem, linear.state, linear.layout
    leverage = np.zeros(len(table))
    E = chain(problem, layout, table.image_count)
    _, own, _ = chain_columns(layout)
    # By camera and rotation: an image turns no star by itself.
    rows = np.arange(E.shape[1])
    used_rows = np.concatenate([rows[: problem.camera_count], rows[ROTATION]])
    root = np.linalg.cholesky(found.equations.covariance)
    by_root = (E[:, used_rows, own] @ root).transpose(0, 2, 1)
    given = image_parameters(problem, state), state.camera_from_icrf.as_matrix()
    for chunk, J in whitened_chunks(linear.measurements, problem.model, *given):
        assert J is not None  # as in the sums
        m, _, n = chunk.direction_icrf.shape
        columns = J[:, : len(used_rows)].reshape(2, -1, m, n).transpose(0, 2, 1, 3)
        each = np.square(by_root[chunk.image] @ columns).sum(axis=(0, 2)).ravel()
        real = chunk.whitener[0] > 0
        leverage[chunk.row[real]] = each[real]
    used = max(int(np.count_nonzero(kept)), 1)
    if leverage.sum() + found.resolved >= 2 * used:
        raise NotObservable('fewer residuals than unknowns')
    return np.asarray(2.0 - leverage - found.resolved / used)


def tracker_attitudes(
    data: Data,
    linear: Linearisation,
    sums: StarSums,
    found: Posterior,
    after: State,
    before: AttitudeErrors | None,
) -> AttitudeErrors:
    """
    Return the errors of the star trackers as the stars alone show them, at the state ``after``.

    ``before`` are those of the round before.  Of the same images they have the same correlations:
    the attitudes change by arcseconds from round to round.
    """
    m, problem = data.table.image_count, linear.problem
    stated = data.stated_rad
    trackers: list[TrackerErrors] = []
    rotation, covariance, seen = _rotations_of_stars(sums, found)
    by_stars = Rotation.from_rotvec(-rotation) * linear.state.camera_from_icrf
    error = attitude_errors(problem, after, by_stars)
    tracker_from_camera = np.swapaxes(image_alignment(problem, after).as_matrix(), -1, -2)
    covariance = tracker_from_camera @ covariance @ np.swapaxes(tracker_from_camera, -1, -2)
    error = np.where(seen[:, None], error, 0.0)
    variance = np.einsum('mii->mi', covariance) / stated**2
    if data.options.method == 'single':
        # Star trackers that are taken as exact have no misfits; their errors are as stated.
        for k in np.unique(problem.star_tracker):
            images = np.flatnonzero(problem.star_tracker == k)
            group, working = np.zeros(len(images), np.int64), EXACT_RAD / stated[0]
            exact = TrackerErrors(1.0, 0.0, np.eye(1), group, working, 0.0, '', 1.0)
            trackers.append(dataclasses.replace(exact, sigma_rad=stated[0], images=images))
        return AttitudeErrors(error, covariance, seen, np.zeros(m, bool), tuple(trackers))
    is_stated = tracker_sigma_is_given(data.options)
    misfit = misfit_images(error / stated, variance, seen, problem.star_tracker, is_stated)
    known_trackers = before.trackers if before else ()
    for k in np.unique(problem.star_tracker):
        here = np.flatnonzero((problem.star_tracker == k) & seen & ~misfit)
        if len(here) == 0:
            continue
        known = (t.correlations for t in known_trackers if np.array_equal(t.images, here))
        correlations = next(known, None) or correlations_of(
            data.time_ns[here], after.camera_from_icrf[here]
        )
        for size in np.unique(stated):
            # Noise about the boresight is that of few photons: slow errors are those of the
            # best axis, or as stated.
            axes = np.flatnonzero(stated == size)
            tracker = tracker_errors(
                error[np.ix_(here, axes)] / size,
                variance[np.ix_(here, axes)],
                correlations,
                is_stated,
                data.options.star_tracker_slow_arcsec * ARCSECOND_RAD / float(size),
                float(stated.min() / size),
            )
            trackers.append(
                dataclasses.replace(
                    tracker,
                    axes=tuple(axes.tolist()),
                    sigma_rad=float(size),
                    images=here,
                    correlations=correlations,
                )
            )
    return AttitudeErrors(error, covariance, seen, misfit, tuple(trackers))


def _rotations_of_stars(sums: StarSums, found: Posterior) -> tuple[Floats, Floats, Mask]:
    """Rotations (m, 3) by the stars alone, their covariances (m, 3, 3), images with enough."""
    blocks, layout = sums.blocks, found.layout
    stars, own, rotation = chain_columns(layout)
    C = blocks[:, rotation, rotation]
    values = np.zeros(blocks.shape[:2])
    values[:, stars], values[:, own] = found.mean[seen_by_stars(layout)], found.of_images
    values[:, rotation] = 0.0
    c = blocks[:, rotation, -1] - np.einsum('mij,mj->mi', blocks[:, rotation], values)
    c = c - (found.mean[layout.field_at] @ sums.field_cross)[:, rotation]
    diagonal = np.einsum('mii->mi', C)
    seen: Mask = np.asarray((diagonal > 0).all(axis=1))
    scale = np.where(seen[:, None], 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    scaled = C * scale[:, :, None] * scale[:, None, :]
    scaled[~seen] = np.eye(3)
    seen &= np.linalg.eigvalsh(scaled)[:, 0] > 1e-9
    covariance = np.zeros_like(C)
    covariance[seen] = np.linalg.inv(scaled[seen])
    covariance *= scale[:, :, None] * scale[:, None, :]
    return np.einsum('mij,mj->mi', covariance, c), covariance, seen


def judge(
    data: Data,
    from_sky: Floats,
    residual_px: Floats,
    freedom: Floats,
    before: Weighting,
    found: Posterior | None,
    attitudes: AttitudeErrors | None = None,
) -> Weighting:
    """
    Return the weights that the residuals of a state ask for.

    Raises NotObservable where no star fits or has an image.
    """
    table, options = data.table, data.options
    finite = np.asarray(np.isfinite(residual_px).all(axis=1))
    residual_px = np.where(finite[:, None], residual_px, 1e6)
    used = before.kept & finite
    if not used.any():
        raise NotObservable('no star has an image')
    variance = CentroidVariance(1.0, 0.0)
    if options.variance_components:
        variance = estimate_variance(
            residual_px,
            table.covariance_px2,
            table.magnitude,
            used,
            freedom,
            options.outlier_sigma,
        )
    covariance_px2 = variance.of(table.covariance_px2, table.magnitude)
    errors: tuple[SharedError, ...] = ()
    # A star is judged without the excess of its own error, which must not decide about itself.
    share_px2, beyond_px2 = star_shares_px2(before.errors)
    kept = fitting_stars(
        residual_px,
        covariance_px2,
        share_px2 - beyond_px2,
        table,
        data.groups[1],  # the coarsest cells
        options.outlier_sigma,
    )
    if not kept.any():
        raise NotObservable('no image has three stars that fit')
    if found is not None:
        own_px2 = 0.5 * (covariance_px2[:, 0] + covariance_px2[:, 2])
        errors = shared_errors(
            residual_px, own_px2, kept, data.groups, from_sky, found.last_octave
        )
    return Weighting(variance, errors, kept, attitudes)
