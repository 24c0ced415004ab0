# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Covariance of the unknowns under the errors that observations share.

Errors that observations share (`shared_errors`, `tracker_errors`) lower the weights to those that
give the same precision, and enter the covariance exactly.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from starcal_ros.arrays import Floats, Indices
from starcal_ros.estimation.equations import Linearisation, star_rows, StarSums, tracker_turns
from starcal_ros.estimation.posterior import common_shape, ErrorParts, Posterior
from starcal_ros.estimation.problem import whitened_attitude_errors
from starcal_ros.estimation.shared_errors import GroupSums, SharedError
from starcal_ros.estimation.unknowns import IMAGE_ROTATION, Layout

TRACKER_NOISE, TRACKER_SLOW = 'star tracker noise', 'star tracker slow error'
_HELD = 0.05  # information on a mode times its variance, below which its prior holds it


@dataclass(frozen=True)
class Weights:
    """
    Covariances of the observations as they are weighted, and the errors that they share.

    Attributes
    ----------
    variance_px2 : (n,)
        Variance of each observation per axis.
    inflation_px2 : (n,)
        Variance per axis that the working weights have beyond that of each observation.
    from_sky : (n, 2, 2)
    errors : tuple of SharedError
    attitudes : tuple of (images, groups, covariance, independent)
        Images (k,) of each star tracker, their groups (k,) and the covariance (g, g) of errors of
        images of these groups in working sigmas, with the part of its diagonal that images do not
        share.
    """

    variance_px2: Floats
    inflation_px2: Floats
    from_sky: Floats
    errors: tuple[SharedError, ...]
    attitudes: tuple[tuple[Indices, Indices, Floats, float], ...]


def with_shared_errors(
    found: Posterior, sums: StarSums, linear: Linearisation, weights: Weights
) -> Posterior:
    """Return the posterior with the covariance under the errors that observations share."""
    layout = linear.layout
    covariance = found.covariance - common_shape(layout, found.common_shape_px2)
    root, held = _root(covariance, found.estimated, sums, layout)
    excess, shared = _of_observations(found, linear, weights, root)
    of_attitudes, by_tracker = _of_attitudes(found, linear, weights, root)
    excess += of_attitudes
    none = (0, held.shape[1])  # errors of the modes that priors hold
    return dataclasses.replace(
        found,
        covariance=found.covariance + root @ excess @ root.T,
        errors=ErrorParts(
            np.concatenate([root, held], axis=1),
            np.pad(excess, none),
            {name: np.pad(one, none) for name, one in {**shared, **by_tracker}.items()},
        ),
    )


def _root(
    covariance: Floats, estimated: Indices, sums: StarSums, layout: Layout
) -> tuple[Floats, Floats]:
    """
    Return L (P, r) and M (P, h), where ``L L' + M M'`` is a covariance.

    M has the modes of the field that priors hold: errors of the observations move no mode that
    the observations do not determine.
    """
    field = np.arange(layout.count)[layout.places['field']]
    others = np.setdiff1d(estimated, field)
    values, vectors = np.linalg.eigh(covariance[np.ix_(field, field)])
    values, vectors = values[values > 0], vectors[:, values > 0]
    size = np.sqrt(values)
    modes = np.zeros((layout.count, len(values)))
    modes[field] = vectors * size
    # The others follow the modes of the field, and have a part of their own.
    modes[others] = covariance[np.ix_(others, field)] @ vectors / size
    left = covariance[np.ix_(others, others)] - modes[others] @ modes[others].T
    size = np.sqrt(np.diag(left).clip(1e-300))
    own_values, own_vectors = np.linalg.eigh(left / np.outer(size, size))
    own = np.zeros((layout.count, len(others)))
    own[others] = size[:, None] * own_vectors * np.sqrt(own_values.clip(0.0))
    shown = np.einsum('im,ij,jm->m', vectors, sums.field_information, vectors, optimize=True)
    moved = values * shown > _HELD
    return np.concatenate([own, modes[:, moved]], axis=1), modes[:, ~moved]


def _of_observations(
    found: Posterior, linear: Linearisation, weights: Weights, root: Floats
) -> tuple[Floats, dict[str, Floats]]:
    """
    Return ``L' X' W (V - 1/W) W X L`` (r, r) of the observations, the images eliminated.

    With the whole variance of each error that they share.
    """
    r = root.shape[1]
    groups = GroupSums(
        weights.errors, weights.variance_px2, weights.inflation_px2, weights.from_sky, r
    )
    if not groups.own_px2.any():  # the errors are those of the working weights
        return groups.own, {}
    to_images = found.back @ root
    for chunk, shared, own, _ in star_rows(linear):
        m, _, n = chunk.direction_icrf.shape
        X = (shared @ root - own @ to_images[chunk.image]).reshape(m, 2, n, r)
        u, v = X.transpose(1, 0, 2, 3).reshape(2, m * n, r)
        wuu, wuv, wvv = (one[:, None] for one in chunk.whitener)
        Y = np.stack([wuu * u, wuv * u + wvv * v], axis=1)
        real = chunk.whitener[0] > 0
        groups.add(chunk.row[real], Y[real])
    whole = groups.whole()
    return sum(whole.values(), -groups.own), whole


def _of_attitudes(
    found: Posterior, linear: Linearisation, weights: Weights, root: Floats
) -> tuple[Floats, dict[str, Floats]]:
    """Return the same (r, r) of the star-tracker attitudes, by noise and slow errors."""
    _, J = whitened_attitude_errors(linear.problem, linear.state)
    at, turns = tracker_turns(linear.layout)
    rows = J @ (-(turns @ root[at]) - found.back[:, IMAGE_ROTATION] @ root)
    r = root.shape[1]
    working, noise, slow = np.zeros((3, r, r))
    for images, group, covariance, independent in weights.attitudes:
        shared = covariance - independent * np.eye(len(covariance))
        member = csr_array((np.ones(len(group)), (group, np.arange(len(group)))))
        for axis in range(3):
            part = rows[images, axis]
            square = part.T @ part
            working += square
            noise += independent * square
            summed = member @ part
            slow += summed.T @ shared @ summed
    return noise + slow - working, {TRACKER_NOISE: noise, TRACKER_SLOW: slow}
