# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Lines of sight with their sigmas, the whole camera as a table; how two cameras differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid, project_jacobians
from starcal_ros.camera import project as project_pixels
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.estimation.limits import ROWS_AT_ONCE
from starcal_ros.record_fields import Record
from starcal_ros.records import Calibration, CameraGeometry, MapCovariance

GRID = 25  # pixels a side over which calibrations are compared and common rotations taken


@dataclass(frozen=True, eq=False, repr=False)
class LineOfSightTable(Record):
    """
    Lines of sight of n pixels.

    Attributes
    ----------
    pixels : (n, 2)
        (u, v).
    direction_camera : (n, 3)
        Unit vectors in the camera frame; NaN as of `detector_sight`.
    shape_sigma_arcsec : (n,)
        1-sigma of the direction, the rotation common to the detector removed: the root of the
        trace of its covariance.
    sigma_arcsec : (n,)
        1-sigma in the star tracker frame, camera and alignment together.
    """

    pixels: Floats
    direction_camera: Floats
    shape_sigma_arcsec: Floats
    sigma_arcsec: Floats

    def columns(self) -> dict[str, Floats]:
        """Columns (n,) by name, as in files and messages."""
        u_px, v_px = self.pixels.T
        x, y, z = self.direction_camera.T
        sigmas = {
            'shape_sigma_arcsec': self.shape_sigma_arcsec,
            'sigma_arcsec': self.sigma_arcsec,
        }
        return {'u_px': u_px, 'v_px': v_px, 'x': x, 'y': y, 'z': z, **sigmas}


def line_of_sight_table(
    camera: CameraModel, covariance: MapCovariance, pixels: Floats
) -> LineOfSightTable:
    """Return the lines of sight of pixels (n, 2)."""
    columns: list[tuple[Floats, ...]] = []
    common = common_rotation(camera)
    for first in range(0, len(pixels), ROWS_AT_ONCE):
        derivatives = Derivatives.at(camera, pixels[first : first + ROWS_AT_ONCE])
        sigmas = (
            sigma_arcsec(derivatives.covariance_rad2(covariance, J))
            for J in (derivatives.of_shape(camera, common), derivatives.J)
        )
        columns.append((derivatives.directions, *sigmas))
    return LineOfSightTable(pixels, *map(np.concatenate, zip(*columns, strict=True)))


def sigma_arcsec(covariance_rad2: Floats) -> Floats:
    """Return the roots (...) of the traces of covariances (..., 3, 3): both angles summed."""
    variance_rad2 = np.trace(covariance_rad2, axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(variance_rad2, 0.0)) / ARCSECOND_RAD)


@dataclass(frozen=True)
class Derivatives:
    """
    Lines of sight of n pixels and their derivatives, in the camera frame.

    For a fixed pixel: a direction moves so as to undo the effect of a parameter on its image.

    Attributes
    ----------
    directions : (n, 3)
    J : (n, 3, p + 3 + 2 t)
        By the p camera parameters, the alignment angles and the t coefficients of the field of the
        camera for u, then for v.
    by_pixel : (n, 3, 2)
        By a displacement of the pixel.
    """

    directions: Floats
    J: Floats
    by_pixel: Floats

    @classmethod
    def at(cls, camera: CameraModel, pixels: Floats) -> Derivatives:
        """Return those of pixels (n, 2); NaN as of `detector_sight`."""
        directions = detector_sight(camera, pixels)
        _, J_parameters, J_rotation = project_jacobians(camera, directions)
        # A rotation about the line of sight itself moves nothing: the pseudo-inverse leaves it
        # out.
        to_angles = np.linalg.pinv(np.nan_to_num(J_rotation))
        p = J_parameters.shape[-1]
        alignment = np.broadcast_to(np.eye(3), (len(to_angles), 3, 3))
        angles = [to_angles @ np.nan_to_num(J_parameters), alignment, to_angles]
        moved = np.cross(
            directions[:, None, :], np.swapaxes(np.concatenate(angles, axis=-1), 1, 2)
        )
        J = -np.swapaxes(moved, 1, 2)
        by_pixel = J[..., p + 3 :]
        if camera.field is None:
            return cls(directions, J[..., : p + 3], by_pixel)
        phi = camera.field.basis(pixels)
        of_field = [by_pixel[..., k, None] * phi[:, None, :] for k in range(2)]
        return cls(directions, np.concatenate([J[..., : p + 3], *of_field], axis=-1), by_pixel)

    def of_shape(self, camera: CameraModel, common: Floats | None = None) -> Floats:
        """
        Return J without the alignment, and without the rotation common to the detector.

        That rotation belongs to the alignment: `common_rotation` if it is not given.
        """
        p = len(camera.parameters)
        J = self.J.copy()
        J[:, :, p : p + 3] = 0.0
        common = common_rotation(camera) if common is None else common
        return np.asarray(J - _rotations(self.directions) @ common)

    def covariance_rad2(self, covariance: MapCovariance, J: Floats) -> Floats:
        """Return the covariances (n, 3, 3) of the directions in the camera frame; J as here."""
        by_pixel = covariance.unresolved_px * self.by_pixel
        # One product for all pixels: NumPy would multiply the matrix once for each.
        rows = (J.reshape(-1, J.shape[-1]) @ covariance.matrix).reshape(J.shape)
        parts = rows @ J.swapaxes(1, 2), by_pixel @ by_pixel.swapaxes(1, 2)
        return np.asarray(sum(parts))


def grid_derivatives(camera: CameraModel) -> Derivatives:
    """Return those of a grid of pixels over the detector."""
    return Derivatives.at(camera, pixel_grid(camera, GRID, GRID))


def common_rotation(camera: CameraModel, grid: Derivatives | None = None) -> Floats:
    """
    Least-squares rotation (3, k) common to a grid of pixels, by the k numbers of `Derivatives`.

    It is zero for the alignment.  ``grid`` has the `grid_derivatives` where they are at hand.
    """
    p, grid = len(camera.parameters), grid or grid_derivatives(camera)
    seen = np.isfinite(grid.directions[:, 0])
    to_rotation = np.linalg.pinv(_rotations(grid.directions[seen]).reshape(-1, 3))
    common = to_rotation @ grid.J[seen].reshape(-1, grid.J.shape[-1])
    common[:, p : p + 3] = 0.0
    return np.asarray(common)


def _rotations(directions: Floats) -> Floats:
    """Movement (n, 3, 3) of directions (n, 3) by small rotations about the three axes."""
    return np.stack([np.cross(axis, directions) for axis in np.eye(3)], axis=-1)


def grid_lines_of_sight(geometry: CameraGeometry, columns: int, rows: int) -> Floats:
    """
    Unit directions of a grid of pixels in the star tracker frame, (columns * rows, 3), by rows.

    NaN where a pixel has no line of sight.
    """
    in_camera = line_of_sight(geometry.camera, pixel_grid(geometry.camera, columns, rows))
    return np.asarray(geometry.star_tracker_from_camera.apply(in_camera))


def movement(
    before: CameraGeometry, after: CameraGeometry, columns: int = 15, rows: int = 12
) -> tuple[float, Floats]:
    """
    Movement of the lines of sight of the pixels of a camera in the star tracker frame.

    Returns
    -------
    rotation_rad : float
        The rotation common to all pixels.
    left_px : (columns * rows,)
        The remaining movement at a grid of pixels, in pixels at the centre.  Both results are
        infinite if a pixel no longer has a line of sight.
    """
    old, new = (grid_lines_of_sight(geometry, columns, rows) for geometry in (before, after))
    if not (np.isfinite(old).all() and np.isfinite(new).all()):
        return np.inf, np.full(len(old), np.inf)
    rotation, _ = Rotation.align_vectors(new, old)
    left_rad = np.linalg.norm(new - rotation.apply(old), axis=1)
    return float(rotation.magnitude()), left_rad * after.camera.parameters[0]


Frame = Literal['camera', 'star_tracker']


def lines_of_sight(
    calibration: Calibration | CameraGeometry | CameraModel,
    pixels_px: ArrayLike,
    frame: Frame = 'camera',
) -> Floats:
    """
    Unit vectors (..., 3) of the lines of sight of pixels (..., 2); the inverse of `project`.

    Parameters
    ----------
    calibration : Calibration, CameraGeometry or CameraModel
    pixels_px : (..., 2)
        (u, v); the centre of the first pixel is (0, 0).
    frame : {'camera', 'star_tracker'}
        Axes of the vectors; the star tracker's are those of the alignment.

    Returns
    -------
    (..., 3)
        NaN beyond the detector, whose edge is half a pixel beyond the centres of its outermost
        pixels, and where the distortion model has no inverse.

    Raises
    ------
    ValueError
        For another frame, or the star tracker's without an alignment.

    Examples
    --------
    >>> import starcal_ros
    >>> camera = starcal_ros.CameraModel(1024, 768, [2000, 0, 2000, 511.5, 383.5, 0, 0, 0, 0, 0])
    >>> geometry = starcal_ros.CameraGeometry(camera, [0, 0, 0.6, 0.8])  # 73.7 degrees about z
    >>> starcal_ros.lines_of_sight(geometry, [711.5, 383.5]).round(4).tolist()
    [0.0995, 0.0, 0.995]
    >>> starcal_ros.lines_of_sight(geometry, [711.5, 383.5], 'star_tracker').round(4).tolist()
    [0.0279, 0.0955, 0.995]
    """
    camera, frame_from_camera = _in_frame(calibration, frame)
    in_camera = detector_sight(camera, np.asarray(pixels_px, np.float64))
    return np.asarray(in_camera @ frame_from_camera.T)


def detector_sight(camera: CameraModel, pixels: Floats) -> Floats:
    """
    Unit directions (..., 3) in the camera frame of pixels (..., 2) of the detector, else NaN.

    No star was measured beyond the detector: a direction there would be an extrapolation, with a
    sigma that does not cover its error.  The exported C returns STARCAL_OUTSIDE.
    """
    seen = camera.on_detector(pixels)[..., None]
    return np.where(seen, line_of_sight(camera, pixels), np.nan)


def project(
    calibration: Calibration | CameraGeometry | CameraModel,
    directions: ArrayLike,
    frame: Frame = 'camera',
) -> Floats:
    """
    Pixels (..., 2) of directions (..., 3); the inverse of `lines_of_sight`.

    Parameters
    ----------
    calibration : Calibration, CameraGeometry or CameraModel
    directions : (..., 3)
        Vectors of any length.
    frame : {'camera', 'star_tracker'}
        Their axes.

    Returns
    -------
    (..., 2)
        (u, v), outside the image too; NaN behind the camera and where the distortion folds.

    Raises
    ------
    ValueError
        For another frame, or the star tracker's without an alignment.

    Examples
    --------
    >>> import starcal_ros
    >>> calibration = starcal_ros.read_calibration('out')
    >>> sight = starcal_ros.lines_of_sight(calibration, [100.0, 200.0], 'star_tracker')
    >>> starcal_ros.project(calibration, sight, 'star_tracker').round(6).tolist()
    [100.0, 200.0]
    """
    camera, frame_from_camera = _in_frame(calibration, frame)
    in_camera = np.asarray(directions, np.float64) @ frame_from_camera
    return project_pixels(camera, in_camera)


def line_of_sight_covariance(
    calibration: Calibration, pixels_px: ArrayLike, frame: Frame = 'camera'
) -> Floats:
    """
    Covariance (..., 3, 3) of the unit vectors of `lines_of_sight`, rad^2; NaN where these are.

    Parameters
    ----------
    calibration : Calibration
    pixels_px : (..., 2)
        (u, v).
    frame : {'camera', 'star_tracker'}
        ``camera``: of the camera alone, the rotation common to the detector removed;
        ``star_tracker``: of camera and alignment together.

    Raises
    ------
    ValueError
        For another frame, or the star tracker's without an alignment.

    Examples
    --------
    >>> import starcal_ros
    >>> calibration = starcal_ros.read_calibration('out')
    >>> covariance = starcal_ros.line_of_sight_covariance(calibration, [[0, 0], [320, 256]])
    >>> covariance.shape, bool(covariance[0].trace() > covariance[1].trace())  # corner, middle
    ((2, 3, 3), True)
    """
    camera, frame_from_camera = _in_frame(calibration, frame)
    pixels = np.asarray(pixels_px, np.float64)
    flat = pixels.reshape(-1, 2)
    parts: list[Floats] = [np.empty((0, 3, 3))]
    for k in range(0, len(flat), ROWS_AT_ONCE):
        derivatives = Derivatives.at(camera, flat[k : k + ROWS_AT_ONCE])
        J = derivatives.J if frame == 'star_tracker' else derivatives.of_shape(camera)
        parts.append(derivatives.covariance_rad2(calibration.map_covariance, J))
    turned = frame_from_camera @ np.concatenate(parts) @ frame_from_camera.T
    return turned.reshape(*pixels.shape[:-1], 3, 3)


def line_of_sight_sigma_arcsec(
    calibration: Calibration, pixels_px: ArrayLike, frame: Frame = 'camera'
) -> Floats:
    """
    1-sigma (...) of the lines of sight of pixels (..., 2), arcsec, as in `starcal lookup`.

    The root of the trace of `line_of_sight_covariance`, which has the parameters.

    Examples
    --------
    >>> import starcal_ros
    >>> calibration = starcal_ros.read_calibration('out')
    >>> alone, pointing = (
    ...     starcal_ros.line_of_sight_sigma_arcsec(calibration, [320, 256], frame)
    ...     for frame in ('camera', 'star_tracker'))
    >>> bool(alone < 1.0 < pointing)
    True
    """
    return sigma_arcsec(line_of_sight_covariance(calibration, pixels_px, frame))


def _in_frame(
    calibration: Calibration | CameraGeometry | CameraModel, frame: str
) -> tuple[CameraModel, Floats]:
    """Camera of a calibration, and the rotation (3, 3) from the camera frame to a frame."""
    geometry = calibration.geometry if isinstance(calibration, Calibration) else calibration
    camera = geometry if isinstance(geometry, CameraModel) else geometry.camera
    if frame == 'camera':
        return camera, np.eye(3)
    if frame != 'star_tracker':
        raise ValueError(f"frame: {frame!r} is not 'camera' or 'star_tracker'")
    alone = isinstance(calibration, Calibration) and not calibration.has_alignment
    if alone or isinstance(geometry, CameraModel):
        raise ValueError(f'frame: {frame!r}: the camera alone has no alignment')
    return camera, geometry.star_tracker_from_camera.as_matrix()
