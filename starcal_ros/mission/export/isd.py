# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Calibrations for USGS tools: a fragment of an ALE image support data (ISD), and ISIS IK keywords.

Sources: ``usgscsm`` (Distortion.cpp: model radtan, the equations of plumb_bob; Utilities.cpp:
focal plane, line of sight) and ISIS (CameraDistortionMap: ``OD_K``; CameraFocalPlaneMap:
``ITRANSS``, ``ITRANSL``).  The first pixel has its centre at (0.5, 0.5) in an ISD, at (1, 1) in
ISIS.
"""

from __future__ import annotations

import json

import numpy as np
from scipy.optimize import least_squares

from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, pixel_grid, project
from starcal_ros.camera.lens import ros_distortion
from starcal_ros.mission.export.losses import about, Content, fitted, GRID, Loss
from starcal_ros.mission.export.spice import kernel_text, SpiceNames, UM_PER_MM
from starcal_ros.records import Calibration

_HALF_PX = 0.5
_ISIS_FIRST_PX = 1.0


def isd_files(calibration: Calibration, names: SpiceNames) -> Content:
    """
    JSON with the keys of a frame camera in an ISD that a calibration determines; and an ISIS IK.

    Without a pixel size a pixel counts as 1 mm; lines of sight do not depend on it.
    """
    isis, loss = _isis_kernel(calibration, names)
    camera, made = fitted(calibration, 'plumb_bob', ())
    fx, skew, fy, cx, cy = camera.intrinsics.tolist()
    _, D = ros_distortion(camera.model, camera.distortion)
    focal_px, pitch_mm = np.sqrt(fx * fy), names.pixel_size_um / UM_PER_MM or 1.0
    content = {
        'about': about(calibration, made),
        'name_model': 'USGS_ASTRO_FRAME_SENSOR_MODEL',
        'image_lines': camera.height,
        'image_samples': camera.width,
        'detector_sample_summing': 1.0,
        'detector_line_summing': 1.0,
        'starting_detector_sample': 0.0,
        'starting_detector_line': 0.0,
        'detector_center': {'line': cy + _HALF_PX, 'sample': cx + _HALF_PX},
        'focal_length_model': {'focal_length': focal_px * pitch_mm},
        'focal2pixel_samples': [0.0, fx / focal_px / pitch_mm, skew / focal_px / pitch_mm],
        'focal2pixel_lines': [0.0, 0.0, fy / focal_px / pitch_mm],
        'optical_distortion': {'radtan': {'coefficients': D.tolist()}},
    }
    files = {'camera_isd.json': json.dumps(content, indent=1) + '\n', 'camera_isis.ti': isis}
    return Content(files, made.worst_px, (*made.losses, loss))


def _isis_kernel(calibration: Calibration, names: SpiceNames) -> tuple[str, Loss]:
    """
    IK with ISIS's keywords of a camera with radial distortion, and its largest error.

    Lens, skew and field are fitted anew by focal length, affine focal plane and ``OD_K``.
    """
    camera = calibration.geometry.camera
    intrinsics, k, worst_px = _radial(camera)
    fx, skew, fy, cx, cy = intrinsics.tolist()
    pitch_mm = names.pixel_size_um / UM_PER_MM or 1.0
    focal_mm = np.sqrt(fx * fy) * pitch_mm
    to_pixel = np.array([[fx, skew], [0.0, fy]]) / focal_mm
    to_mm = np.linalg.inv(to_pixel)
    prefix = f'INS{names.camera_id}_'
    values: dict[str, list[float]] = {
        'FOCAL_LENGTH': [focal_mm],
        'PIXEL_PITCH': [pitch_mm],
        'BORESIGHT_SAMPLE': [cx + _ISIS_FIRST_PX],
        'BORESIGHT_LINE': [cy + _ISIS_FIRST_PX],
        'TRANSX': [0.0, *to_mm[0].tolist()],
        'TRANSY': [0.0, *to_mm[1].tolist()],
        'ITRANSS': [0.0, *to_pixel[0].tolist()],
        'ITRANSL': [0.0, *to_pixel[1].tolist()],
        'OD_K': [0.0, *(k / focal_mm ** np.array([2.0, 4.0])).tolist()],
    }
    loss = Loss('ISIS: all but radial distortion', worst_px)
    comments = ['Keywords of ISIS; its first pixel has its centre at (1, 1).', '']
    comments += about(calibration, Content({}, worst_px, (loss,)))
    return kernel_text('Camera for ISIS', comments, prefix, values), loss


def radial_directions(intrinsics: Floats, k: Floats, pixels: Floats) -> Floats:
    """Lines of sight (n, 3) of pixels (n, 2) by ISIS's radial model, k of r2 and r2^2."""
    fx, skew, fy, cx, cy = intrinsics
    y = (pixels[:, 1] - cy) / fy
    x = (pixels[:, 0] - cx - skew * y) / fx
    r2 = x * x + y * y
    scale = 1.0 - r2 * (k[0] + r2 * k[1])
    return np.stack([x * scale, y * scale, np.ones_like(x)], axis=-1)


def _radial(camera: CameraModel) -> tuple[Floats, Floats, float]:
    """Best intrinsics (5,) and k (2,) over the detector, and the largest error of a pixel."""
    pixels = pixel_grid(camera, GRID, GRID)

    def error_px(p: Floats) -> Floats:
        return np.asarray(project(camera, radial_directions(p[:5], p[5:], pixels)) - pixels)

    start = np.r_[camera.intrinsics, 0.0, 0.0]
    scale = np.r_[np.full(5, camera.intrinsics[0] * 1e-3), 1e-2, 1e-1]
    found = least_squares(
        lambda p: np.nan_to_num(error_px(p), nan=camera.width).ravel(), start, x_scale=scale
    )
    worst_px = float(np.linalg.norm(error_px(found.x), axis=1).max())
    return found.x[:5], found.x[5:], worst_px if np.isfinite(worst_px) else np.inf
