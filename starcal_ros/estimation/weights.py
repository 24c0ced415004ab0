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

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.centroid_variance import CentroidVariance, estimate_variance
from starcal_ros.estimation.equations import (
    chain,
    chain_columns,
    Linearisation,
    seen_by_stars,
    StarSums,
)
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.limits import FREE_FACTOR
from starcal_ros.estimation.options import CalibrationOptions, tracker_sigma_is_given
from starcal_ros.estimation.outliers import fitting_stars, misfit_images, QUARTILE
from starcal_ros.estimation.posterior import Posterior, Weighting
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
            group = np.zeros(len(images), np.int64)
            for size, axes in axes_by_sigma(stated):
                exact = TrackerErrors(1.0, 0.0, np.eye(1), group, EXACT_RAD / size, 0.0, '', 1.0)
                trackers.append(
                    dataclasses.replace(exact, axes=axes, sigma_rad=size, images=images)
                )
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
        for size, axes in axes_by_sigma(stated):
            # Noise about the boresight is that of few photons: slow errors are those of the
            # best axis, or as stated.
            tracker = tracker_errors(
                error[here][:, list(axes)] / size,
                variance[here][:, list(axes)],
                correlations,
                is_stated,
                data.options.star_tracker_slow_arcsec * ARCSECOND_RAD / size,
                float(stated.min() / size),
            )
            trackers.append(
                dataclasses.replace(
                    tracker, axes=axes, sigma_rad=size, images=here, correlations=correlations
                )
            )
    return AttitudeErrors(error, covariance, seen, misfit, tuple(trackers))


def axes_by_sigma(stated_rad: Floats) -> list[tuple[float, tuple[int, ...]]]:
    """Return the stated sigmas of the axes (3,), each once, with the axes that have it."""
    sizes = [float(size) for size in np.unique(stated_rad)]
    return [(size, tuple(np.flatnonzero(stated_rad == size).tolist())) for size in sizes]


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
            residual_px,
            own_px2,
            kept,
            data.groups,
            before.from_sky,
            found.last_octave,
            (variance.floor_px2, variance.floor_sigma_px2),
        )
    return Weighting(table, before.from_sky, variance, errors, kept, attitudes)
