# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Alignment of the camera to each of several star trackers, and their drift.

The search estimates the alignment A to the first star tracker and, for each further one, a small
rotation h of the camera frame by which its mounting M is wrong (`estimation.problem`): its
alignment is ``exp(-[h x]) A M``.  A small rotation a of A turns that alignment by ``a + h``.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import stdtr

from starcal_ros.arrays import Floats, Mask
from starcal_ros.constants import ARCSECOND_RAD, NANOSECONDS_PER_SECOND
from starcal_ros.estimation.problem import Problem, State
from starcal_ros.records import Ensemble, StarTrackerAlignment
from starcal_ros.text import p_value_text

_FEWEST_IMAGES = 4  # for a mean, a slope and a scatter about them
_HOUR_S = 3600.0


@dataclass(frozen=True)
class AttitudeErrors:
    """
    Star-tracker errors of m images as their stars show them.

    Attributes
    ----------
    time_ns : (m,)
    error_rad : (m, 3)
        About the axes of the star tracker of the image.
    variance_rad2 : (m, 3)
        Its variance from the centroids.
    tracker_sigma_rad : (3,)
        1-sigma of a star tracker.
    seen : (m,) bool
        True if the stars of the image show an attitude that fits.
    """

    time_ns: NDArray[np.int64]
    error_rad: Floats
    variance_rad2: Floats
    tracker_sigma_rad: Floats
    seen: Mask


def star_tracker_names(ensemble: Ensemble) -> tuple[str, ...]:
    """Names of the star trackers of an ensemble; the first, whose name is empty, is always one."""
    return ('', *sorted({image.star_tracker for image in ensemble.images} - {''}))


def star_tracker_alignments(
    names: tuple[str, ...],
    problem: Problem,
    state: State,
    covariance: Floats,
    errors: AttitudeErrors,
) -> tuple[StarTrackerAlignment, ...]:
    """
    Return the alignments to the star trackers of an ensemble; none where there is one only.

    Parameters
    ----------
    names : tuple of str
        From `star_tracker_names`.
    covariance : (3 + 3 s, 3 + 3 s)
        Covariance of the alignment and of the mountings of the s further star trackers.
    errors : AttitudeErrors
        Each about the axes of its own star tracker.
    """
    if problem.first_from_star_tracker is None:
        return ()
    mountings = np.concatenate([np.zeros(3), state.mountings]).reshape(-1, 3)
    A = state.camera_from_star_tracker
    found = []
    for k, name in enumerate(names):
        here = problem.star_tracker == k
        assumed = problem.first_from_star_tracker[here][0] if k else Rotation.identity()
        alignment = Rotation.from_rotvec(-mountings[k]) * A * assumed
        to_angles = np.zeros((3, len(covariance)))
        to_mounting = np.zeros_like(to_angles)
        if k:
            to_mounting[:, 3 * k : 3 * k + 3] = np.eye(3)
        to_angles[:, :3] = np.eye(3)
        to_angles += to_mounting
        of_mounting = to_mounting @ covariance @ to_mounting.T
        rate, total, p_value = _drift(errors, here)
        found.append(
            StarTrackerAlignment(
                frame=name,
                images=int(here.sum()),
                star_tracker_from_camera_xyzw=canonical_xyzw(alignment.inv()),
                alignment_covariance_rad2=to_angles @ covariance @ to_angles.T,
                first_from_star_tracker_xyzw=canonical_xyzw(A.inv() * alignment),
                mounting_covariance_rad2=of_mounting,
                drift_arcsec_per_hour=tuple(float(one) for one in rate),
                drift_arcsec=total,
                drift_p_value=p_value,
            )
        )
    return tuple(found)


def canonical_xyzw(rotation: Rotation) -> Floats:
    """Return one of the two quaternions (4,), so that equal rotations are equal numbers."""
    quaternion = rotation.as_quat()
    return np.asarray(quaternion * np.copysign(1.0, quaternion[3]))


def _drift(errors: AttitudeErrors, here: Mask) -> tuple[Floats, float, float]:
    """
    Slope (3,) of the errors in time, arcsec/h; its length over the span; p-value of none.

    By the scatter about the slope: a drift raises the sigma of the star tracker that is estimated.
    """
    unknown = np.full(3, np.nan), math.nan, math.nan
    used = here & errors.seen
    if np.count_nonzero(used) < _FEWEST_IMAGES:
        return unknown
    time_ns = errors.time_ns[used]
    hours = (time_ns - time_ns[0]) / (NANOSECONDS_PER_SECOND * _HOUR_S)
    weight = 1.0 / (errors.variance_rad2[used] + errors.tracker_sigma_rad**2)
    middle = (weight * hours[:, None]).sum(axis=0) / weight.sum(axis=0)
    from_middle = hours[:, None] - middle
    information = (weight * from_middle**2).sum(axis=0)
    if not (information > 0).all():
        return unknown
    slope = (weight * from_middle * errors.error_rad[used]).sum(axis=0) / information
    error_rad = errors.error_rad[used]
    mean_rad = (weight * error_rad).sum(axis=0) / weight.sum(axis=0)
    freedom = len(hours) - 2
    scatter = (weight * (error_rad - mean_rad - from_middle * slope) ** 2).sum(axis=0) / freedom
    t = slope * np.sqrt(information / np.maximum(scatter, 1e-300))
    p_value = min(1.0, 3.0 * 2.0 * float(stdtr(freedom, -np.abs(t)).min()))  # of three axes
    rate = slope / ARCSECOND_RAD
    return rate, float(np.linalg.norm(rate) * np.ptp(hours)), p_value


def summary(one: StarTrackerAlignment) -> str:
    """One line of text: images, 1-sigma of alignment and mounting, drift."""
    aligned, mounted = (
        np.sqrt(np.diag(covariance)) / ARCSECOND_RAD
        for covariance in (one.alignment_covariance_rad2, one.mounting_covariance_rad2)
    )
    text = f'{one.frame}: {one.images} images, alignment within {_three(aligned)} arcsec'
    if mounted.any():
        text += f', mounting within {_three(mounted)}'
    if np.isfinite(one.drift_p_value):
        text += (
            f'; drift {one.drift_arcsec:.1f} arcsec (p-value {p_value_text(one.drift_p_value)})'
        )
    return text


def _three(values: Floats) -> str:
    return ', '.join(f'{value:.1f}' for value in values)
