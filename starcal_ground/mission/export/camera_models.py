# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
Export to camera models of other tools; all lose the field.

OpenCV and ROS.  GIANT's ``OpenCVModel`` is OpenCV's rational model with thin prism, skew
(``alpha``) and a focal length that depends on temperature
(``giant/camera_models/opencv_model.py``, its equations).  mrcal has OpenCV's models of 5, 8 and 12
coefficients in OpenCV's order, without skew.  It has the pixel convention of starcal; its
reference frame represents the star tracker.

USGS tools: a fragment of an ALE image support data (ISD), and ISIS IK keywords.  Sources:
``usgscsm`` (Distortion.cpp: model radtan, the equations of plumb_bob; Utilities.cpp: focal plane,
line of sight) and ISIS (CameraDistortionMap: ``OD_K``; CameraFocalPlaneMap: ``ITRANSS``,
``ITRANSL``).  The first pixel has its centre at (0.5, 0.5) in an ISD, at (1, 1) in ISIS.
"""

from __future__ import annotations

import dataclasses
import json

import numpy as np
from scipy.optimize import least_squares

from starcal_ground.mission.export import exported
from starcal_ground.mission.export.request import Request, SpiceNames
from starcal_ground.mission.export.spice import checked_names, kernel_text, UM_PER_MM
from starcal_ground.products import CAMERA_INFO_FILE, camera_info_text, yaml_text
from starcal_ros.arrays import Floats
from starcal_ros.camera import CameraModel, pixel_grid, project
from starcal_ros.camera.lens import LENSES, ros_distortion
from starcal_ros.records import Calibration

_LARGEST = 'thin_prism'  # largest model that both GIANT and mrcal have
_GIANT_NAMES = {'fx': 'fx', 'fy': 'fy', 'skew': 'alpha', 'cx': 'px', 'cy': 'py'}


def opencv_yaml(calibration: Calibration, _asked: Request) -> exported.Content:
    """
    YAML for ``cv2.FileStorage``: camera matrix, distortion, and the rotation of an alignment.

    ``distortion_coefficients`` are for ``cv2.projectPoints``, or for ``cv2.fisheye`` if
    ``lens_model`` is ``fisheye``.
    """
    own = calibration.geometry.camera.model
    camera, made = exported.fitted(calibration, own if LENSES[own].opencv else _LARGEST, ('skew',))
    _, D = ros_distortion(camera.model, camera.distortion)
    rotation = calibration.geometry.star_tracker_from_camera.inv().as_matrix()
    aligned = calibration.has_alignment
    lines = [
        '%YAML:1.0',
        *_commented(exported.about(calibration, made)),
        *(['# rotation: camera_from_star_tracker'] if aligned else []),
        '---',
        f'image_width: {camera.width}',
        f'image_height: {camera.height}',
        f'lens_model: {LENSES[camera.model].opencv}',
        *_opencv_matrix('camera_matrix', camera.camera_matrix),
        *_opencv_matrix('distortion_coefficients', D[None, :]),
        *(_opencv_matrix('rotation', rotation) if aligned else []),
        f'largest_error_px: {made.worst_px!r}',
    ]
    return dataclasses.replace(made, files={'opencv.yaml': '\n'.join(lines) + '\n'})


def ros_yaml(calibration: Calibration, _asked: Request) -> exported.Content:
    """
    The camera YAML of ROS, and ``alignment.yaml`` for a static transform publisher.

    The alignment is a geometry_msgs/TransformStamped.
    """
    camera = calibration.geometry.camera
    _, made = exported.fitted(calibration, camera.model, ('skew',))
    x, y, z, w = calibration.geometry.star_tracker_from_camera_xyzw.tolist()
    content = {
        'header': {'frame_id': calibration.parent_frame},
        'child_frame_id': calibration.child_frame,
        'transform': {
            'translation': {'x': 0.0, 'y': 0.0, 'z': 0.0},
            'rotation': {'x': x, 'y': y, 'z': z, 'w': w},
        },
    }
    comment = _commented(exported.origin(calibration))
    files = {
        CAMERA_INFO_FILE: camera_info_text(camera, calibration.child_frame),
        'alignment.yaml': '\n'.join([*comment, yaml_text(content)]),
    }
    return dataclasses.replace(made, files=files)


def giant_json(calibration: Calibration, _asked: Request) -> exported.Content:
    """
    JSON whose ``OpenCVModel`` holds the keyword arguments of the model.

    ``star_tracker_from_camera_xyzw`` is a separate key: a camera model of GIANT has no alignment.
    """
    own = calibration.geometry.camera.model
    camera, made = exported.fitted(calibration, own if LENSES[own].giant else _LARGEST, ())
    # GIANT has the change of the focal length with temperature: nothing is lost.
    losses = tuple(loss for loss in made.losses if 'focal' not in loss.part)
    made = dataclasses.replace(made, losses=losses)
    named = zip(camera.parameter_names, camera.parameters.tolist(), strict=True)
    arguments = {_GIANT_NAMES.get(name, name): value for name, value in named}
    arguments |= {'n_rows': camera.height, 'n_cols': camera.width}
    terms = calibration.temperature
    if terms is not None and terms.focal_per_degc:
        # GIANT scales x' by 1 + a1 T + a2 T^2 with T itself: give it T - reference_degc.
        arguments |= {f'a{k}': value for k, value in enumerate(terms.focal_per_degc, start=1)}
    content = {
        'about': [
            *exported.about(calibration, made),
            'from giant.camera_models import OpenCVModel; OpenCVModel(**content["OpenCVModel"])',
        ],
        'OpenCVModel': arguments,
        'temperature_reference_degc': None if terms is None else terms.reference_degc,
        'star_tracker_from_camera_xyzw': (
            calibration.geometry.star_tracker_from_camera_xyzw.tolist()
            if calibration.has_alignment
            else None
        ),
    }
    return dataclasses.replace(
        made, files={'giant_camera.json': json.dumps(content, indent=1) + '\n'}
    )


def mrcal_cameramodel(calibration: Calibration, _asked: Request) -> exported.Content:
    """Text for ``mrcal.cameramodel``; ``extrinsics`` are rt_cam_ref."""
    own = calibration.geometry.camera.model
    camera, made = exported.fitted(calibration, own if LENSES[own].mrcal else _LARGEST, ('skew',))
    fx, _, fy, cx, cy = camera.intrinsics.tolist()
    _, D = ros_distortion(camera.model, camera.distortion)
    turn = calibration.geometry.star_tracker_from_camera.inv().as_rotvec()
    rt = [*(turn * calibration.has_alignment).tolist(), 0.0, 0.0, 0.0]
    lines = [
        *_commented(exported.about(calibration, made)),
        '{',
        f"    'lensmodel':  '{LENSES[camera.model].mrcal}',",
        f"    'extrinsics': {rt!r},",
        f"    'intrinsics': {[fx, fy, cx, cy, *D.tolist()]!r},",
        f"    'imagersize': {[camera.width, camera.height]!r},",
        '}',
    ]
    return dataclasses.replace(made, files={'camera.cameramodel': '\n'.join(lines) + '\n'})


def _commented(lines: list[str]) -> list[str]:
    return [f'# {exported.ascii_line(line)}' for line in lines]


def _opencv_matrix(name: str, matrix: Floats) -> list[str]:
    rows, cols = matrix.shape
    data = ', '.join(repr(value) for value in matrix.ravel().tolist())
    return [
        f'{name}: !!opencv-matrix',
        f'   rows: {rows}',
        f'   cols: {cols}',
        '   dt: d',
        f'   data: [ {data} ]',
    ]


_HALF_PX = 0.5
_ISIS_FIRST_PX = 1.0


def isd_files(calibration: Calibration, asked: Request) -> exported.Content:
    """
    JSON with the keys of a frame camera in an ISD that a calibration determines; and an ISIS IK.

    Without a pixel size a pixel counts as 1 mm; lines of sight do not depend on it.
    """
    names = checked_names(asked.names)
    isis, loss = _isis_kernel(calibration, names)
    camera, made = exported.fitted(calibration, 'plumb_bob', ())
    fx, skew, fy, cx, cy = camera.intrinsics.tolist()
    _, D = ros_distortion(camera.model, camera.distortion)
    focal_px, pitch_mm = np.sqrt(fx * fy), names.pixel_size_um / UM_PER_MM or 1.0
    content = {
        'about': exported.about(calibration, made),
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
    return exported.Content(files, made.worst_px, (*made.losses, loss))


def _isis_kernel(calibration: Calibration, names: SpiceNames) -> tuple[str, exported.Loss]:
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
    loss = exported.Loss('ISIS: all but radial distortion', worst_px)
    comments = ['Keywords of ISIS; its first pixel has its centre at (1, 1).', '']
    comments += exported.about(calibration, exported.Content({}, worst_px, (loss,)))
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
    pixels = pixel_grid(camera, exported.GRID, exported.GRID)

    def error_px(p: Floats) -> Floats:
        return np.asarray(project(camera, radial_directions(p[:5], p[5:], pixels)) - pixels)

    start = np.r_[camera.intrinsics, 0.0, 0.0]
    scale = np.r_[np.full(5, camera.intrinsics[0] * 1e-3), 1e-2, 1e-1]
    fit = least_squares(
        lambda p: np.nan_to_num(error_px(p), nan=camera.width).ravel(), start, x_scale=scale
    )
    worst_px = float(np.linalg.norm(error_px(fit.x), axis=1).max())
    return fit.x[:5], fit.x[5:], worst_px if np.isfinite(worst_px) else np.inf
