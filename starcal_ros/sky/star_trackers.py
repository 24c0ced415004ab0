# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attitudes of several star trackers for one image, each in the frame of the first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from starcal_ros.arrays import Floats
from starcal_ros.errors import ImageRefused
from starcal_ros.sky.attitude import AttitudeHistory

IDENTITY_XYZW = np.array([0.0, 0.0, 0.0, 1.0])
IDENTITY_XYZW.setflags(write=False)


@dataclass(frozen=True)
class Mounting:
    """
    A further star tracker: the name of its frame, and its orientation (4,) in that of the first.

    Both are as assumed.
    """

    frame: str
    first_from_star_tracker_xyzw: Floats


@dataclass(frozen=True)
class Attitude:
    """
    Attitude at an image, by the mounting of the star tracker that gave it.

    Attributes
    ----------
    icrf_from_star_tracker_xyzw : (4,)
        Of the first star tracker.
    gap_s : float
        Between the two samples about the image.
    rate_rad_s : (3,)
        Angular rate of the first star tracker in its frame; NaN where it is not known.
    star_tracker : str
        Frame of the star tracker that gave it; empty: the first.
    first_from_star_tracker_xyzw : (4,)
        Its orientation in the frame of the first.
    """

    icrf_from_star_tracker_xyzw: Floats
    gap_s: float
    rate_rad_s: Floats
    star_tracker: str = ''
    first_from_star_tracker_xyzw: Floats = field(default_factory=lambda: IDENTITY_XYZW)


def attitudes_at(
    time_ns: int,
    first: AttitudeHistory,
    others: Sequence[AttitudeHistory],
    mountings: Sequence[Mounting],
    max_gap_s: float,
    taken: Mapping[str, int],
) -> list[Attitude]:
    """
    Attitudes at a time, that of the star tracker with the fewest images ``taken`` first.

    So each is calibrated, and any of them replaces another that is silent.

    Raises
    ------
    ImageRefused
        For the reason of the first star tracker, when none has an attitude.
    """
    from scipy.spatial.transform import Rotation  # half of the start of a short command

    found: list[Attitude] = []
    refusal: ImageRefused | None = None
    try:
        found.append(Attitude(*first.at(time_ns, max_gap_s), first.rate_at(time_ns, max_gap_s)))
    except ImageRefused as refused:
        refusal = refused
    for history, mounting in zip(others, mountings, strict=True):
        try:
            quaternion, gap_s = history.at(time_ns, max_gap_s)
        except ImageRefused:
            continue
        mounted = Rotation.from_quat(mounting.first_from_star_tracker_xyzw)
        first_xyzw = (Rotation.from_quat(quaternion) * mounted.inv()).as_quat()
        rate_rad_s = mounted.apply(history.rate_at(time_ns, max_gap_s))
        found.append(
            Attitude(
                first_xyzw,
                gap_s,
                rate_rad_s,
                mounting.frame,
                mounting.first_from_star_tracker_xyzw,
            )
        )
    if refusal is not None and not found:
        raise refusal
    return sorted(found, key=lambda one: taken.get(one.star_tracker, 0))
