# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Covariance of the shared parameters: camera, focal terms, alignment and its rate.

It follows from the normal matrices of the images at a state without residuals, so it also predicts
the covariance of a future calibration.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Mask
from starcal_ros.camera import parameter_names
from starcal_ros.least_squares.levenberg_marquardt import inverse, NotObservable
from starcal_ros.least_squares.linear_terms import LinearTerms
from starcal_ros.methods.assembly import (
    border_of,
    by_shared,
    reduced_information,
    with_shape_prior,
)
from starcal_ros.methods.problem import Problem, State
from starcal_ros.records import ALIGNMENT_NAMES


def shared_names(
    model: str, focal_terms: int, with_rate: bool, mountings: int = 0
) -> tuple[str, ...]:
    """Names of camera parameters, focal terms, alignment angles, their rate and mountings."""
    return (
        *parameter_names(model),
        *(f'focal_temperature_{i}' for i in range(1, focal_terms + 1)),
        *ALIGNMENT_NAMES,
        *(f'{name}_temperature' for name in ALIGNMENT_NAMES if with_rate),
        *(f'star_tracker_{k}_{axis}' for k in range(2, mountings + 2) for axis in ('x', 'y', 'z')),
    )


def shared_covariance(
    problem: Problem,
    state: State,
    blocks: Floats,
    good: Mask,
    tracker_sigma_rad: Floats,
    terms: LinearTerms | None = None,
) -> tuple[Rotation, Floats]:
    """
    The alignment, and the covariance (s, s) of `shared_names`, then of the modes of the field.

    Parameters
    ----------
    blocks : (m, p + 4, p + 4)
        Of `problem.image_blocks`.
    good : (m,) bool
        Images in the mean alignment of ``per_image``; unused by the other methods.
    tracker_sigma_rad : (3,)
        Of those attitudes.
    terms : LinearTerms or None
        Of `problem.field_terms`.

    Raises
    ------
    NotObservable
        If the images do not determine all estimated parameters.
    """
    information = reduced_information(problem, state, blocks, terms)
    shared = considered_covariance(problem, information)
    if problem.method != 'per_image':
        return state.camera_from_star_tracker, shared
    if not good.any():
        raise NotObservable('no attitude of an image fits the others')
    return _mean_alignment(problem, state, blocks, good, shared, tracker_sigma_rad, terms)


def considered_covariance(problem: Problem, information: Floats) -> Floats:
    """
    Covariance (p, p) of all camera parameters and of the other shared parameters.

    A fixed parameter with a prior sigma is a consider parameter: it keeps its prior variance,
    whose effect on the estimated parameters is added.  Without a prior sigma its variance is zero.
    """
    p, camera = len(information), problem.camera_count
    estimated = np.concatenate([problem.free, np.arange(camera, p)])
    held = np.setdiff1d(np.arange(camera), problem.free)
    held_variance = np.where(
        np.isfinite(problem.prior_sigma[held]), problem.prior_sigma[held], 0.0
    )
    held_variance = held_variance**2
    noise = inverse(information[np.ix_(estimated, estimated)])
    to_estimated = -noise @ information[np.ix_(estimated, held)]
    result = np.zeros((p, p))
    result[np.ix_(estimated, estimated)] = noise + (to_estimated * held_variance) @ to_estimated.T
    result[np.ix_(estimated, held)] = to_estimated * held_variance
    result[np.ix_(held, estimated)] = result[np.ix_(estimated, held)].T
    result[held, held] = held_variance
    return 0.5 * (result + result.T)


def _mean_alignment(
    problem: Problem,
    state: State,
    blocks: Floats,
    good: Mask,
    shared: Floats,
    tracker_sigma_rad: Floats,
    terms: LinearTerms | None,
) -> tuple[Rotation, Floats]:
    """
    Quaternion mean of the alignments of the images (Markley et al. 2007), and all covariance.

    SciPy's mean is the dominant eigenvector of sum w q q'; weighted by the covariances of the
    images.  The mean is linear in the rotations, and those in the camera parameters, the focal
    terms and the modes of the field, whose covariance is ``shared``.
    """
    alignments = (state.camera_from_icrf * problem.star_tracker_from_icrf.inv())[good]
    tracker = np.diag(tracker_sigma_rad**2)
    r = len(state.modes)
    k = len(shared) - r
    rows = by_shared(problem, state, blocks)[good][:, k:-1]
    C, B = rows[:, :, k:-1], rows[:, :, :k]
    if state.shapes.size:
        C = with_shape_prior(problem, C)
    if terms is not None:
        B = np.concatenate([B, border_of(problem, state, terms).blocks[good]], axis=2)
    stars, by_shared_unknowns = np.linalg.inv(C)[:, :3, :3], np.linalg.solve(C, B)[:, :3]
    within = stars + by_shared_unknowns @ shared @ by_shared_unknowns.transpose(0, 2, 1)
    weight = 1.0 / np.trace(within + tracker, axis1=1, axis2=2)
    alignment = alignments.mean(weight)
    weight = weight / weight.sum()
    A = alignment.as_matrix()
    F = np.einsum('m,mij->ij', weight, by_shared_unknowns)
    scattered = np.einsum('m,mij->ij', weight**2, stars + A @ tracker @ A.T)
    full = np.zeros((k + r + 3, k + r + 3))
    before = np.r_[0:k, k + 3 : k + 3 + r]
    angles = np.arange(k, k + 3)
    full[np.ix_(before, before)] = shared
    full[np.ix_(angles, angles)] = scattered + F @ shared @ F.T
    full[np.ix_(angles, before)] = -F @ shared
    full[np.ix_(before, angles)] = full[np.ix_(angles, before)].T
    return alignment, full
