# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Images of one pointing: the same stars on the same pixels are not new knowledge of each pixel.

What is left of a star after the fit has a part that comes again in every image of the pointing
(its phase in the pixel, its catalog place, an image that was sent twice) and a part that does not.
The share of the first is measured within the groups, and the covariance of a star of a group of c
images is multiplied by ``1 + (c - 1) share``: then c of them weigh as the mean of theirs does.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Indices, Mask
from starcal_ros.least_squares.normal_equations import StarTable

_SAME_PX = 1.0  # movement of a star from image to image below which a pointing is the same


def pointing_groups(camera_from_icrf: Rotation, focal_px: float) -> Indices:
    """Return the number (m,) of the pointing of each image, from 0."""
    quaternions = np.atleast_2d(camera_from_icrf.as_quat())
    m = len(quaternions)
    # A quaternion and its negative are one rotation.
    tree = cKDTree(np.concatenate([quaternions, -quaternions]))
    chord = 2.0 * np.sin(0.25 * _SAME_PX / focal_px)
    group = np.full(m, -1)
    count = 0
    for k, near in enumerate(tree.query_ball_point(quaternions, chord)):
        if group[k] < 0:
            alike = np.array([k, *near]) % m
            group[alike[group[alike] < 0]] = count
            count += 1
    return group


def repetition(table: StarTable, kept: Mask, residual_px: Floats, group: Indices) -> Floats:
    """
    Return the factor (n,) on the covariance of each star.

    ``group`` (m,) is that of `pointing_groups`, ``residual_px`` (n, 2) of a fit.
    """
    size = np.bincount(group)
    if size.max(initial=1) < 2:
        return np.ones(len(table))
    of_star = group[table.image]
    _, place = np.unique(
        of_star.astype(np.int64) * (int(table.star.max()) + 1) + table.star, return_inverse=True
    )
    kept_place = place[kept]
    count = np.bincount(kept_place, minlength=int(place.max()) + 1)
    several = kept & (count[place] > 1)
    if not several.any():
        return np.ones(len(table))
    length = np.maximum(np.abs(residual_px[several]).max(), 1e-12)
    residual = residual_px[several] / length
    means = np.stack([np.bincount(place[several], r, len(count)) for r in residual.T], axis=-1)
    means = means[place[several]] / count[place[several], None]
    degrees_of_freedom = np.count_nonzero(several) - len(np.unique(place[several]))
    within = ((residual - means) ** 2).sum() / max(degrees_of_freedom, 1)
    total = (residual**2).sum() / np.count_nonzero(several)
    share = float(np.clip(1.0 - within / max(total, 1e-300), 0.0, 1.0))
    return np.asarray(1.0 + (np.maximum(count[place], 1) - 1) * share)
