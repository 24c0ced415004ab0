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
    """Frame name of an additional star tracker, and its assumed orientation (4,) in the first."""

    frame: str
    first_from_star_tracker_xyzw: Floats


@dataclass(frozen=True)
class Attitude:
    """
    Attitude of the first star tracker at an image, from any star tracker by its mounting.

    Attributes
    ----------
    icrf_from_star_tracker_xyzw : (4,)
        Orientation of the first star tracker.
    gap_s : float
        Gap between the two samples around the image.
    rate_rad_s : (3,)
        Angular rate of the first star tracker in its frame; NaN where it is not known.
    star_tracker : str
        Frame of the star tracker that measured the attitude; empty: the first.
    first_from_star_tracker_xyzw : (4,)
        Orientation of that star tracker in the frame of the first.
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
    Attitudes at a time, starting with the star tracker that has the fewest images ``taken``.

    The order calibrates every star tracker, and lets each replace a silent one. Raises
    ImageRefused if no star tracker has an attitude, with the reason of the first.
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
