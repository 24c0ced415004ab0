# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Weights of stars and star trackers from the residuals of a round of the estimate.

The variances of centroids, the errors that observations share, the stars that are left out and
the errors of the star trackers follow from what a posterior leaves; they weigh the next round.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.camera import CameraModel, rotation_jacobian
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.calibration_options import CalibrationOptions, tracker_sigma_is_given
from starcal_ros.estimation.equations import (
    chain,
    chain_columns,
    Linearisation,
    seen_by_stars,
    StarSums,
)
from starcal_ros.estimation.levenberg_marquardt import NotObservable
from starcal_ros.estimation.posterior import Posterior
from starcal_ros.estimation.problem import (
    attitude_errors,
    image_alignment,
    image_parameters,
    Problem,
    State,
)
from starcal_ros.estimation.refraction import Refraction
from starcal_ros.estimation.reweighting import (
    CentroidVariance,
    estimate_variance,
    fitting_stars,
    misfit_images,
)
from starcal_ros.estimation.shared_errors import (
    coarsest_cells,
    Groups,
    pixel_variance_px2,
    place_variance_px2,
    shared_errors,
    SharedError,
)
from starcal_ros.estimation.star_equations import ROTATION, StarTable, whitened_chunks
from starcal_ros.estimation.tracker_errors import (
    Correlations,
    correlations_of,
    tracker_errors,
    TrackerErrors,
)
from starcal_ros.estimation.unknowns import Layout
from starcal_ros.records import CameraGeometry

# Method 1 does not use the star tracker for the camera, Method 2 takes it as exact: a sigma of a
# thousand times the stated one, and of a milliarcsecond.
FREE_FACTOR, EXACT_RAD = 1e3, 1e-3 * ARCSECOND_RAD
_SIGMA_PER_MEDIAN = 1.5  # of the sizes of normal errors


@dataclass(frozen=True)
class Data:
    """Inputs that stay the same over the rounds of an estimate."""

    table: StarTable
    time_ns: NDArray[np.int64]
    stated_rad: Floats  # (3,)
    prior: CameraGeometry
    options: CalibrationOptions
    rates_rad_s: Floats  # (m, 3) of the first star tracker in its frame
    velocity_sigma_m_s: Floats  # (m,)
    refraction: Refraction | None
    groups: tuple[Groups, ...]


@dataclass(frozen=True)
class Attitudes:
    """Errors of the star trackers as the stars show them, and what follows from them."""

    error_rad: Floats
    covariance_rad2: Floats
    seen: Mask
    misfit: Mask
    trackers: tuple[TrackerErrors, ...]
    images: tuple[NDArray[np.int64], ...]  # of each of them, those that fit
    correlations: tuple[Correlations, ...] = ()  # of these images


@dataclass(frozen=True)
class Judged:
    """Conclusions from the residuals of a round: the weights of the next one."""

    variance: CentroidVariance
    errors: tuple[SharedError, ...]
    kept: Mask
    attitudes: Attitudes | None

    def covariance_px2(self, table: StarTable) -> Floats:
        """Return the covariances (n, 3) of the observations."""
        return self.variance.of(table.covariance_px2, table.magnitude)

    def inflation_px2(self, table: StarTable) -> Floats:
        """
        Return the variance (n,) by which the weights are lower for errors that images share.

        With it, k images of a star weigh as the mean of theirs does.
        """
        sightings = np.bincount(table.star, self.kept, int(table.star.max()) + 1)[table.star]
        return np.asarray(np.maximum(sightings - 1.0, 0.0) * place_variance_px2(self.errors))

    def working_px2(self, table: StarTable) -> Floats:
        """Return the covariances (n, 3) whose inverses are the weights."""
        inflation_px2 = self.inflation_px2(table)
        return self.covariance_px2(table) + np.outer(inflation_px2, [1.0, 0.0, 1.0])


def weighted_attitudes(
    problem: Problem, data: Data, attitudes: Attitudes | None, state: State
) -> Problem:
    """
    Return the problem with the working sigmas of the star trackers.

    Until their errors are known, by the scatter at the state of the robust search: a stated sigma
    that is too small would bend the camera to the attitudes, which then seem to be right.
    """
    m = data.table.image_count
    if data.options.method == 'single':
        return dataclasses.replace(problem, star_tracker_sigma_rad=np.full((m, 3), EXACT_RAD))
    factor = np.ones(m)
    if attitudes is None:
        error = attitude_errors(problem, state, state.camera_from_icrf) / data.stated_rad
        factor *= max(1.0, _SIGMA_PER_MEDIAN * float(np.median(np.abs(error))))
    else:
        for images, tracker in zip(attitudes.images, attitudes.trackers, strict=True):
            factor[images] = tracker.working
        factor[attitudes.misfit] = np.inf
    if data.options.method == 'per_image':
        factor *= FREE_FACTOR
    return dataclasses.replace(problem, star_tracker_sigma_rad=factor[:, None] * data.stated_rad)


def tracker_covariances(
    problem: Problem, data: Data, attitudes: Attitudes
) -> tuple[tuple[Indices, Indices, Floats, float], ...]:
    """Return `Weights.attitudes`."""
    found = []
    for images, tracker in zip(attitudes.images, attitudes.trackers, strict=True):
        working2 = (problem.star_tracker_sigma_rad[images[0], 0] / data.stated_rad[0]) ** 2
        independent = tracker.independent / working2
        found.append((images, tracker.group, tracker.covariance / working2, independent))
    return tuple(found)


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
    of_image, c = E[:, used_rows, own], len(used_rows)
    given = image_parameters(problem, state), state.camera_from_icrf.as_matrix()
    for chunk, J in whitened_chunks(linear.measurements, problem.model, *given):
        assert J is not None  # as in the sums
        m, _, n = chunk.direction_icrf.shape
        columns = J[:, :c].reshape(2, c, m, n).transpose(2, 0, 3, 1).reshape(m, 2 * n, c)
        K = columns @ of_image[chunk.image]
        each = ((K @ found.image_covariance[chunk.image]) * K).sum(axis=2).reshape(m, 2, n)
        real = chunk.whitener[0] > 0
        leverage[chunk.row[real]] = each.sum(axis=1).ravel()[real]
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
    before: Attitudes | None,
) -> Attitudes:
    """
    Return the errors of the star trackers as the stars alone show them, at the state ``after``.

    ``before`` are those of the round before.  Of the same images they have the same correlations:
    the attitudes change by arcseconds from round to round.
    """
    m, problem = data.table.image_count, linear.problem
    stated = data.stated_rad
    rotation, covariance, seen = _rotations_of_stars(sums, linear.layout, found)
    by_stars = Rotation.from_rotvec(-rotation) * linear.state.camera_from_icrf
    error = attitude_errors(problem, after, by_stars)
    tracker_from_camera = np.swapaxes(image_alignment(problem, after).as_matrix(), -1, -2)
    covariance = tracker_from_camera @ covariance @ np.swapaxes(tracker_from_camera, -1, -2)
    error = np.where(seen[:, None], error, 0.0)
    variance = np.einsum('mii->mi', covariance) / stated**2
    if data.options.method == 'single':
        # Star trackers that are taken as exact have no misfits; their errors are as stated.
        images = tuple(
            np.flatnonzero(problem.star_tracker == k) for k in np.unique(problem.star_tracker)
        )
        working = EXACT_RAD / stated[0]
        trackers = tuple(
            TrackerErrors(1.0, 0.0, np.eye(1), np.zeros(len(i), np.int64), working, 0.0, '', 1.0)
            for i in images
        )
        return Attitudes(error, covariance, seen, np.zeros(m, bool), trackers, images)
    misfit = misfit_images(error / stated, variance, seen, problem.star_tracker, data.time_ns)
    found_images, found_trackers, found_correlations = [], [], []
    for k in np.unique(problem.star_tracker):
        here = np.flatnonzero((problem.star_tracker == k) & seen & ~misfit)
        if len(here) == 0:
            continue
        correlations = _known_correlations(here, before)
        if correlations is None:
            correlations = correlations_of(data.time_ns[here], after.camera_from_icrf[here])
        found_images.append(here)
        found_correlations.append(correlations)
        found_trackers.append(
            tracker_errors(
                error[here] / stated,
                variance[here],
                correlations,
                tracker_sigma_is_given(data.options),
                data.options.star_tracker_slow_arcsec * ARCSECOND_RAD / float(stated.mean()),
            )
        )
    return Attitudes(
        error,
        covariance,
        seen,
        misfit,
        tuple(found_trackers),
        tuple(found_images),
        tuple(found_correlations),
    )


def _known_correlations(images: Indices, before: Attitudes | None) -> Correlations | None:
    """Return the correlations of these images of the round before, if it had them."""
    if before is not None:
        for those, correlations in zip(before.images, before.correlations, strict=True):
            if np.array_equal(those, images):
                return correlations
    return None


def _rotations_of_stars(
    sums: StarSums, layout: Layout, found: Posterior
) -> tuple[Floats, Floats, Mask]:
    """Rotations (m, 3) by the stars alone, their covariances (m, 3, 3), images with enough."""
    blocks = sums.blocks
    stars, own, rotation = chain_columns(layout)
    C = blocks[:, rotation, rotation]
    values = np.zeros(blocks.shape[:2])
    values[:, stars], values[:, own] = found.mean[seen_by_stars(layout)], found.of_images
    values[:, rotation] = 0.0
    c = blocks[:, rotation, -1] - np.einsum('mij,mj->mi', blocks[:, rotation], values)
    c = c - (found.mean[layout.of(['field'])] @ sums.field_cross)[:, rotation]
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


def sky_rotations(state: State, table: StarTable, camera: CameraModel) -> Floats:
    """
    Rotations (n, 2, 2) of displacements fixed to a star into pixel axes.

    The rotation part of the derivative of the pixel by the place of the star.
    """
    e = table.direction_icrf
    along = np.cross(e, [0.1, 0.2, 0.97])
    along /= np.linalg.norm(along, axis=1)[:, None]
    rotations = state.camera_from_icrf.as_matrix()[table.image]
    in_camera = np.einsum('nij,nj->ni', rotations, e)
    J = rotation_jacobian(
        dataclasses.replace(camera, parameters=state.parameters, field=None), in_camera
    )
    columns = [
        np.einsum('nab,nb->na', J, np.cross(np.einsum('nij,nj->ni', rotations, one), in_camera))
        for one in (along, np.cross(e, along))
    ]
    M = np.stack(columns, axis=2)
    # A mirrored pair of axes is the same for all stars: the sky's second axis is turned over.
    M[..., 1] *= np.sign(M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0])[:, None]
    angle = np.arctan2(M[:, 1, 0] - M[:, 0, 1], M[:, 0, 0] + M[:, 1, 1])
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], axis=1), np.stack([sin, cos], axis=1)], axis=1)


def judge(
    data: Data,
    from_sky: Floats,
    residual_px: Floats,
    freedom: Floats,
    before: Judged,
    found: Posterior | None,
    attitudes: Attitudes | None = None,
) -> Judged:
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
            residual_px, table.covariance_px2, table.magnitude, used, freedom
        )
    covariance_px2 = variance.of(table.covariance_px2, table.magnitude)
    errors: tuple[SharedError, ...] = ()
    kept = fitting_stars(
        residual_px,
        covariance_px2,
        place_variance_px2(before.errors),
        table,
        coarsest_cells(data.groups),
        options.outlier_sigma,
    )
    if not kept.any():
        raise NotObservable('no image has three stars that fit')
    if found is not None:
        own_px2 = 0.5 * (covariance_px2[:, 0] + covariance_px2[:, 2])
        weight = np.where(kept, 1.0 / own_px2, 0.0)
        errors = shared_errors(residual_px, weight, data.groups, from_sky, found.last_octave)
    return Judged(variance, errors, kept, attitudes)


def agree(one: Judged, other: Judged, table: StarTable) -> bool:
    """Return True if both lead to the same estimate."""
    if one.attitudes is None or other.attitudes is None:
        return False
    return (
        np.array_equal(one.kept, other.kept)
        and np.array_equal(one.attitudes.misfit, other.attitudes.misfit)
        # No estimate moves with 2 % of the variances, nor with more of the one of a bright star
        # that holds its image: that creeps on with a floor near zero, as the variance of places
        # does where hardly a star is seen twice.
        and _change(one.working_px2(table), other.working_px2(table)) < 0.02
        and math.isclose(
            pixel_variance_px2(one.errors),
            pixel_variance_px2(other.errors),
            rel_tol=0.1,
            abs_tol=1e-7,
        )
        and len(one.attitudes.trackers) == len(other.attitudes.trackers)
        and all(
            math.isclose(a.working, b.working, rel_tol=0.05)
            for a, b in zip(one.attitudes.trackers, other.attitudes.trackers, strict=True)
        )
    )


def _change(before: Floats, after: Floats) -> float:
    """Return the RMS of the relative change of variances uu, vv of covariances (n, 3)."""
    return float(np.sqrt(np.mean((after[:, ::2] / before[:, ::2] - 1.0) ** 2)))
