# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Streaks of the stars of an image whose camera turned during the exposure.

A uniform turn of the camera, three angles, gives each star its path.  It is found from the second
moments of the sources, which are sigma^2 + s s' / 12 for a path s, and refined by the shapes that
the PSF fits find.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
import functools
import math

import numpy as np
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from starcal_ros import opencv as cv2
from starcal_ros.arrays import Floats, Indices, Pixels
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid, project, rotation_jacobian
from starcal_ros.errors import ImageRefused
from starcal_ros.robust_statistics import median
from starcal_ros.stars import detection
from starcal_ros.stars.detection import Background, Sources

LONGEST_PX = 10.0  # a longer streak is too faint beside its noise, and too curved, for the fit
_CORE_PX = 4  # half width of a window that shows whether a source is round
_HALF_PX = 15  # half width of a window: a streak of 20 px is seen to be too long
_BRIGHT_SNR = 8.0
_MOST = 40  # the brightest sources show the turn
_TESTED, _TESTED_SNR = 15, 20.0  # sources that show whether there are streaks at all
_FEWEST = 5
_LEVEL = 0.3  # pixels above this part of the peak, joined to it, are the source
_NOISE = 3.0  # and this many sigma above the background
_SHORTEST = 0.35  # s^2 / 12 over the variance of the PSF: shape_median allows it without streaks
_EXPLAINED = 0.5  # part of the elongation that a turn of the camera may leave
# Shares of a window that a source fills: a core that may be of a body, as of a planet or its limb,
# and a window that is; a streak from rim to rim fills a fifth.
_LARGE, _BODY = 0.75, 0.4
_STEPS = 8
_APART_PX = 4.0  # sources nearer than this, or half a streak, are parts of one


@dataclass(frozen=True)
class Streak:
    """Paths of stars on the detector by the turn (3,), rad, of a camera during the exposure."""

    camera: CameraModel
    turn_rad: Floats

    def at(self, xy_px: Floats | Indices) -> Floats:
        """Path (n, 2), px, of the stars at pixels (n, 2) in the middle of the exposure."""
        direction = line_of_sight(self.camera, np.asarray(xy_px, np.float64))
        return np.nan_to_num(rotation_jacobian(self.camera, direction) @ self.turn_rad)

    def moments_px2(self, xy_px: Floats) -> Floats:
        """Second moments (n, 3) uu, vv, uv of the paths of the stars at pixels (n, 2)."""
        u, v = self.at(xy_px).T
        return np.stack([u * u, v * v, u * v], axis=-1) / 12.0

    @functools.cached_property
    def longest_px(self) -> float:
        """Length, px, that nine of ten places of the image do not exceed."""
        return float(np.quantile(np.hypot(*self.at(pixel_grid(self.camera, 9, 9)).T), 0.9))

    def bend_px(self, xy_px: Floats) -> Floats:
        """Mean place (n, 2) of a star over the exposure, less that in its middle, px."""
        direction = line_of_sight(self.camera, np.asarray(xy_px, np.float64))
        ends = [
            project(self.camera, Rotation.from_rotvec(part * self.turn_rad).apply(direction))
            for part in (-0.5, 0.5)
        ]
        # A parabola whose ends are h from its middle has a mean of h / 3.
        return np.nan_to_num((ends[0] + ends[1] - 2.0 * np.asarray(xy_px)) / 6.0)


def without_streaks(
    pixels: Pixels, background: Background, sources: Sources, camera: CameraModel
) -> tuple[Sources, Streak | None]:
    """
    Sources at the middle of their streaks, each streak once, and the turn; None if they are sharp.

    Where the brightest are not round, sources that are parts of a body larger than a star are left
    out.

    Raises ImageRefused ``smeared`` where the streaks are longer than `LONGEST_PX`.
    """
    bright = sources.xy_px[sources.snr > _BRIGHT_SNR][:_MOST]
    if len(bright) < _FEWEST:
        return sources, None
    # Most images are sharp, which the cores of the brightest show.
    tested = bright[: min(_TESTED, np.count_nonzero(sources.snr > _TESTED_SNR))]
    if len(tested) >= _FEWEST:
        _, moments_px2, lit = _extents(pixels, background, tested, _CORE_PX)
        if not _elongated(moments_px2) and lit.max() < _LARGE:
            return sources, None
    middle_px, moments_px2, lit = _extents(pixels, background, bright, _HALF_PX)
    if lit.max() > _BODY:
        # The limb of a body outshines the stars, and its sources are as long as streaks.
        lit = _extents(pixels, background, sources.xy_px, _HALF_PX)[2]
        stars = sources.select(lit <= _BODY)
        if len(stars.snr) < len(sources.snr):
            return without_streaks(pixels, background, stars, camera)
    alone = detection.apart(middle_px, _APART_PX)
    streak = _turn(camera, middle_px[alone], moments_px2[alone])
    if streak is None:
        return sources, None
    length_px = streak.longest_px
    if length_px > LONGEST_PX:
        raise ImageRefused(
            'smeared',
            f'the stars are streaks of {length_px:.0f} px, up to {LONGEST_PX:g} can be measured',
        )
    middle_px = _extents(pixels, background, sources.xy_px, _HALF_PX)[0]
    alone = detection.apart(middle_px, max(_APART_PX, 0.5 * length_px))
    return dataclasses.replace(sources, xy_px=middle_px).select(alone), streak


def _elongated(moments_px2: Floats) -> bool:
    """Return True if most sources of second moments (n, 3) are too long for sharp stars."""
    half, narrow_px2 = _elongation(moments_px2)
    return len(half) >= _FEWEST and 2.0 * median(half) > _SHORTEST * narrow_px2


def _elongation(moments_px2: Floats) -> tuple[Floats, float]:
    """
    Half the difference (n,) of the moments along and across, and the median of the latter.

    That is at least 1 px^2: noise makes sources of fewer pixels as long as streaks of 2 px.
    """
    uu, vv, uv = moments_px2.T
    half = np.hypot(0.5 * (uu - vv), uv)
    return half, max(median(0.5 * (uu + vv) - half), 1.0) if len(half) else 1.0


def _extents(
    pixels: Pixels, background: Background, xy_px: Floats, half_px: int
) -> tuple[Floats, Floats, Floats]:
    """
    Centres of light (n, 2) and second moments (n, 3) uu, vv, uv of the sources at (n, 2).

    Also the share (n,) of its window that each fills.
    """
    centre = np.rint(xy_px).astype(np.int64)
    stamps, outside = detection.stamps_at_edges(pixels, centre, half_px)
    stamps -= background.level_at(centre)[:, None, None]
    side = 2 * half_px + 1
    # One call for all windows: the light that it carries over a joint is at their rims.
    cv2.GaussianBlur(stamps.reshape(-1, side), (7, 7), 1.0, dst=stamps.reshape(-1, side))
    peak = stamps[:, half_px, half_px]
    least = np.maximum(_LEVEL * peak, _NOISE * detection.NOISE_LEFT * background.noise_at(centre))
    lit = (stamps > least[:, None, None]) & ~outside
    # Pixels join within a window, also over corners, but not from one window to the next.
    joins = np.zeros((3, 3, 3), bool)
    joins[1] = True
    part, _ = label(lit, joins)
    own = part[:, half_px, half_px]
    is_own = (part == own[:, None, None]) & (own > 0)[:, None, None]
    light = np.where(is_own, stamps, 0.0)
    _, middle_px, moments_px2 = detection.second_moments(light)
    # The filter adds its variance.
    return centre + middle_px, moments_px2 - [1.0, 1.0, 0.0], is_own.mean(axis=(1, 2))


def _turn(camera: CameraModel, xy_px: Floats, moments_px2: Floats) -> Streak | None:
    """Turn that explains the second moments (n, 3) of sources; None if they are round."""
    if not _elongated(moments_px2):
        return None
    half, narrow_px2 = _elongation(moments_px2)
    uu, vv, uv = moments_px2.T
    # The paths are of a common direction or, in a roll, about the middle of the image.
    common = 0.5 * math.atan2(2.0 * median(uv), median(uu - vv))
    size_rad = math.sqrt(24.0 * median(half)) / float(camera.parameters[0])
    starts = ([-math.sin(common), math.cos(common), 0.0], [0.0, 0.0, 3.0])
    fits = [
        refined(Streak(camera, size_rad * np.array(start)), narrow_px2, xy_px, moments_px2)
        for start in starts
    ]
    streak, _, left_px2 = min(fits, key=lambda fit: fit[2])
    return streak if left_px2 < _EXPLAINED * 2.0 * median(half) else None


def refined(
    streak: Streak, variance_px2: float, xy_px: Floats, moments_px2: Floats
) -> tuple[Streak, float, float]:
    """
    Turn and variance of the PSF that fit second moments (n, 3), and the median of what is left.

    Robust Gauss-Newton: companions and cosmic rays change the moments of some sources.
    """
    # A source without a line of sight is an outlier.
    J = np.nan_to_num(rotation_jacobian(streak.camera, line_of_sight(streak.camera, xy_px)))
    turn = streak.turn_rad
    unit = 1.0 / float(streak.camera.parameters[0])

    def left() -> tuple[Floats, Floats]:
        u, v = (J @ turn).T
        model = np.stack([u * u, v * v, u * v], axis=-1) / 12.0
        off_px2 = moments_px2 - model - variance_px2 * np.array([1.0, 1.0, 0.0])
        return off_px2, np.sqrt((off_px2 @ [1.0, 1.0, 0.0]) ** 2 / 2.0 + 2.0 * off_px2[:, 2] ** 2)

    for _ in range(_STEPS):
        u, v = (J @ turn).T
        off_px2, size_px2 = left()
        A = np.zeros((len(J), 3, 4))
        A[:, 0, :3] = u[:, None] * J[:, 0] / 6.0
        A[:, 1, :3] = v[:, None] * J[:, 1] / 6.0
        A[:, 2, :3] = (u[:, None] * J[:, 1] + v[:, None] * J[:, 0]) / 12.0
        A[:, :, :3] *= unit
        A[:, :2, 3] = 1.0
        weight = 1.0 / (1.0 + (size_px2 / max(2.0 * median(size_px2), 1e-3)) ** 2)
        weighted = (A * weight[:, None, None]).reshape(-1, 4)
        normal = weighted.T @ A.reshape(-1, 4)
        # A roll of stars in one place, or a turn of length zero, has no derivative.
        normal += 1e-3 * np.eye(4)
        step = np.linalg.solve(normal, weighted.T @ off_px2.ravel())
        turn = turn + unit * step[:3]
        variance_px2 = max(variance_px2 + float(step[3]), 0.05)
    return Streak(streak.camera, turn), variance_px2, median(left()[1])
