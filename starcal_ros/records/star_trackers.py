# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Record of the alignment of the camera to one of several star trackers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from starcal_ros.arrays import Count, Finite, Floats, Shape


@dataclass(frozen=True)
class StarTrackerAlignment:
    """
    Alignment of the camera to one of several star trackers.

    Attributes
    ----------
    frame : str
        Name of the frame of the star tracker.
    images : int
        Number of images whose attitude it gave; with 0 its mounting is as assumed.
    star_tracker_from_camera_xyzw : (4,)
        Orientation of the camera in its frame.
    alignment_covariance_rad2 : (3, 3)
        Of that: passive small rotation, camera frame.
    first_from_star_tracker_xyzw : (4,)
        Its orientation in the frame of the first star tracker.
    mounting_covariance_rad2 : (3, 3)
        Of that: small rotation about the axes of the camera; zero for the first.
    drift_arcsec_per_hour : tuple of 3 float
        Of its attitude against the stars, about its own axes.
    drift_arcsec, drift_p_value : float
        Length of that over the time of its images, and the p-value of none; NaN for fewer than
        four images.
    """

    frame: str
    images: Count
    star_tracker_from_camera_xyzw: Annotated[Floats, Finite(), Shape((4,))]
    alignment_covariance_rad2: Annotated[Floats, Finite(), Shape((3, 3))]
    first_from_star_tracker_xyzw: Annotated[Floats, Finite(), Shape((4,))]
    mounting_covariance_rad2: Annotated[Floats, Finite(), Shape((3, 3))]
    drift_arcsec_per_hour: Annotated[tuple[float, ...], Shape((3,))]
    drift_arcsec: float
    drift_p_value: float
