# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The prior alignment of a setup that states none, from the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.identification.star_finder import realigned
from starcal_ros.pipeline.setup import Setup
from starcal_ros.records import CameraGeometry, Ensemble, FOUND

_ALIGNING = 20  # images, of whose alignments the middle one is taken


def aligned(setup: Setup, star_tracker_from_camera_xyzw: Floats) -> Setup:
    """A copy of a setup with the prior alignment found from the images."""
    prior = CameraGeometry(setup.prior.camera, star_tracker_from_camera_xyzw)
    found = ', '.join(filter(None, (setup.origin.get(FOUND), 'alignment')))
    return replace(setup, prior=prior, is_aligned=True, origin={**setup.origin, FOUND: found})


def aligned_by(ensemble: Ensemble, setup: Setup) -> Setup:
    """The setup; where it has no prior alignment, with that of the middle one of the images."""
    if setup.is_aligned or not ensemble.images:
        return setup
    shown = Rotation.from_quat(
        np.array(
            [
                realigned(setup.prior, image).star_tracker_from_camera_xyzw
                for image in ensemble.images[:_ALIGNING]
            ]
        )
    )
    apart = np.abs(shown.as_quat() @ shown.as_quat().T)  # cosines of half angles
    return aligned(setup, shown[int(np.median(apart, axis=1).argmax())].as_quat())
