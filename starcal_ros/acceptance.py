"""The gate: whether a candidate calibration may come into force, and if not, every reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.options import option
from starcal_ros.records import CameraGeometry


@dataclass(frozen=True)
class GateOptions:
    """Limits that a calibration must keep to come into force."""

    max_residual_rms_px: float = option(
        1.0, 'largest residual per axis over the stars used, px', low=0.0, high=100.0
    )
    max_rejected_fraction: float = option(
        0.25, 'largest fraction of stars left out as outliers', low=0.0, high=1.0
    )
    min_coverage: float = option(
        0.3, 'least fraction of the focal-plane cells that hold a star', low=0.0, high=1.0
    )
    max_map_sigma_px: float = option(
        0.5,
        'largest 1-sigma of the distortion map over the detector, common turn removed, px',
        low=0.0,
        high=100.0,
    )
    max_change_px: float = option(
        50.0,
        'largest change of the distortion map against the prior, common turn removed, px',
        low=0.0,
        high=1e5,
    )
    max_turn_deg: float = option(
        2.0,
        'largest turn of the lines of sight in the star tracker frame against the prior, degrees',
        low=0.0,
        high=180.0,
    )


@dataclass(frozen=True)
class Candidate:
    """What the gate looks at: a solution and its statistics, ``coverage`` (rows, cols) counts."""

    geometry: CameraGeometry
    prior: CameraGeometry
    covariance: NDArray[np.float64]
    residual_rms_px: float
    stars_used: int
    stars_rejected: int
    coverage: NDArray[np.int64]
    map_sigma_px: float
    termination: str


def movement(
    before: CameraGeometry, after: CameraGeometry, columns: int = 15, rows: int = 12
) -> tuple[float, NDArray[np.float64]]:
    """
    How far the lines of sight of the pixels moved in the star tracker frame.

    Returns
    -------
    turn_rad : float
        The rotation common to all pixels.
    left_px : (columns * rows,)
        The movement that is left at a grid of pixels, in pixels of the middle.  Both are infinite
        where a pixel has no line of sight any more.
    """
    pixels = pixel_grid(before.camera, columns, rows)
    old, new = (
        Rotation.from_quat(geometry.star_tracker_from_camera_xyzw).apply(
            line_of_sight(geometry.camera, pixels)
        )
        for geometry in (before, after)
    )
    if not (np.isfinite(old).all() and np.isfinite(new).all()):
        return np.inf, np.full(len(pixels), np.inf)
    turn, _ = Rotation.align_vectors(new, old)
    left_rad = np.linalg.norm(new - turn.apply(old), axis=1)
    return float(turn.magnitude()), left_rad * after.camera.parameters[0]


def alignment_difference_rad(a: CameraGeometry, b: CameraGeometry) -> NDArray[np.float64]:
    """The passive small rotation (3,) of the camera frame that takes alignment b to a."""
    st_from_a = Rotation.from_quat(a.star_tracker_from_camera_xyzw)
    st_from_b = Rotation.from_quat(b.star_tracker_from_camera_xyzw)
    # a_from_b = exp(-[dtheta x]), so b_from_a has dtheta as its rotation vector.
    return np.asarray((st_from_b.inv() * st_from_a).as_rotvec())


def judge(candidate: Candidate, options: GateOptions) -> tuple[str, ...]:
    """Every reason against a candidate, one sentence each; empty when it may come into force."""
    reasons = []
    if candidate.termination != 'converged':
        reasons.append(f'the solver did not converge ({candidate.termination})')
    values = np.concatenate(
        [
            candidate.geometry.camera.parameters,
            candidate.geometry.star_tracker_from_camera_xyzw,
            candidate.covariance.ravel(),
        ]
    )
    if not np.isfinite(values).all():
        return (*reasons, 'a parameter or its covariance is not a finite number')
    if (np.diag(candidate.covariance) < 0).any():
        reasons.append('a variance is negative')
    # Written so that NaN is refused: a comparison with it is false.
    if not candidate.residual_rms_px <= options.max_residual_rms_px:
        reasons.append(
            f'residual {candidate.residual_rms_px:.3f} px per axis is over the limit of '
            f'{options.max_residual_rms_px:g} px (max_residual_rms_px)'
        )
    total = candidate.stars_used + candidate.stars_rejected
    if not candidate.stars_rejected <= options.max_rejected_fraction * total:
        reasons.append(
            f'{candidate.stars_rejected} of {total} stars are outliers, more than a fraction of '
            f'{options.max_rejected_fraction:g} (max_rejected_fraction)'
        )
    covered = float((candidate.coverage > 0).mean())
    if not covered >= options.min_coverage:
        reasons.append(
            f'stars cover {100 * covered:.0f} % of the detector, under the limit of '
            f'{100 * options.min_coverage:.0f} % (min_coverage)'
        )
    if not candidate.map_sigma_px <= options.max_map_sigma_px:
        reasons.append(
            f'the distortion map is uncertain by {candidate.map_sigma_px:.3f} px at its worst, '
            f'over the limit of {options.max_map_sigma_px:g} px (max_map_sigma_px)'
        )
    turn_rad, left_px = movement(candidate.prior, candidate.geometry)
    shape_px = left_px.max()
    if not shape_px <= options.max_change_px:
        reasons.append(
            f'the distortion map would change by {shape_px:.1f} px at its worst, '
            f'over the limit of {options.max_change_px:g} px (max_change_px)'
        )
    if not np.degrees(turn_rad) <= options.max_turn_deg:
        reasons.append(
            f'the lines of sight would turn by {np.degrees(turn_rad):.3f} degrees, '
            f'over the limit of {options.max_turn_deg:g} degrees (max_turn_deg)'
        )
    return tuple(reasons)
