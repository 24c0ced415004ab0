# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Deliberate mistakes of a set-up in a simulated bag, to practise their diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats, Pixels
from starcal_ros.constants import NANOSECONDS_PER_SECOND
from starcal_ros.records import CameraGeometry, Image

_AXIS = (0.8, 0.6, 0.0)  # axis of the alignment error, perpendicular to the line of sight


@dataclass(frozen=True)
class Mistakes:
    """
    Mistakes of a bag and its parameter file; none by default.

    Attributes
    ----------
    flip : str
        'left-right' or 'top-bottom': images are mirrored.
    rotate_deg : int
        Images are turned counterclockwise by 90, 180 or 270 degrees.
    attitude_direction, quaternion_order : str
        'inertial_to_st', 'wxyz': the attitudes of the bag, contrary to the parameter file.
    alignment_error_deg, focal_error_percent : float
        Errors of the prior.
    clock_error_s : float
        Delay of the stamps of images.
    smear_px : int
        Length of the streak of each star, along +x.
    gamma : float
        Pixel values are proportional to light to the power 1 / gamma.
    """

    flip: str = ''
    rotate_deg: int = 0
    attitude_direction: str = 'st_to_inertial'
    quaternion_order: str = 'xyzw'
    alignment_error_deg: float = 0.0
    focal_error_percent: float = 0.0
    clock_error_s: float = 0.0
    smear_px: int = 1
    gamma: float = 1.0

    def image(self, image: Image) -> Image:
        """The image with its mistakes, as written to the bag."""
        pixels = image.pixels
        full = float(np.iinfo(pixels.dtype).max if pixels.itemsize == 1 else pixels.max())
        if self.smear_px > 1:
            pixels = _as_before(_smeared(pixels, self.smear_px), pixels, full)
        if self.gamma != 1.0:
            light = np.clip(pixels.astype(np.float64) - np.median(pixels), 0.0, None) / full
            curved = 0.05 * full + 0.9 * full * light ** (1 / self.gamma)
            pixels = _as_before(curved, pixels, full)
        turned: Pixels = np.rot90(pixels, self.rotate_deg // 90)  # type: ignore[assignment]
        if self.flip:
            turned = turned[:, ::-1] if self.flip == 'left-right' else turned[::-1]
        late_ns = round(self.clock_error_s * NANOSECONDS_PER_SECOND)
        # A copy without gaps, of the same type.
        return Image(image.time_ns + late_ns, turned.copy())

    def attitude(self, icrf_from_star_tracker_xyzw: Floats) -> Floats:
        """The attitude with its mistakes, as written to the bag."""
        sent = np.asarray(icrf_from_star_tracker_xyzw)
        if self.attitude_direction == 'inertial_to_st':
            sent = sent * [-1.0, -1.0, -1.0, 1.0]
        return sent[[3, 0, 1, 2]] if self.quaternion_order == 'wxyz' else sent

    def prior(self, prior: CameraGeometry) -> CameraGeometry:
        """The prior with its mistakes, as written to the parameter file."""
        fx, fy = (float(prior.camera.parameters[k]) for k in (0, 2))
        grown = 1.0 + self.focal_error_percent / 100.0
        turn = Rotation.from_rotvec(math.radians(self.alignment_error_deg) * np.array(_AXIS))
        alignment = prior.star_tracker_from_camera * turn
        return CameraGeometry(
            prior.camera.replace(fx=grown * fx, fy=grown * fy), alignment.as_quat()
        )


def _smeared(pixels: Pixels, length_px: int) -> Floats:
    """The image of a camera that turned during the exposure."""
    level = float(np.median(pixels))
    light = np.zeros(pixels.shape)
    for k in range(length_px):
        light += np.roll(pixels.astype(np.float64), k, axis=1) - level
    return level + light / math.sqrt(length_px)


def _as_before(changed: Floats, before: Pixels, full: float) -> Pixels:
    """Pixels converted to the given type and clipped to its range."""
    clipped = np.clip(np.rint(changed), 0.0, full)
    return clipped.astype(np.uint8) if before.itemsize == 1 else clipped.astype(np.uint16)


NO_MISTAKES = Mistakes()
