"""Calibrations as YAML of OpenCV, kalibr and ROS; none of them holds skew or a field."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation
import yaml

from starcal_ros.arrays import Floats
from starcal_ros.export.losses import Fitted, fitted, in_words
from starcal_ros.export.provenance import ascii_line, origin, PIXEL_CONVENTION
from starcal_ros.lens import ros_distortion
from starcal_ros.records import Calibration

# kalibr's word for a lens model, and the parameters that kalibr lacks.
_KALIBR = {
    'plumb_bob': ('radtan', ('skew', 'k3')),
    'equidistant': ('equidistant', ('skew',)),
}


def opencv_yaml(calibration: Calibration) -> tuple[str, Fitted]:
    """
    YAML for ``cv2.FileStorage``: camera matrix, distortion, rotation; and the camera in it.

    ``distortion_coefficients`` are those of ``cv2.projectPoints``, of ``cv2.fisheye`` where
    ``lens_model`` is ``fisheye``.
    """
    found = fitted(calibration, calibration.geometry.camera.model, ('skew',))
    camera = found.camera
    _, D = ros_distortion(camera.model, camera.distortion)
    lines = [
        '%YAML:1.0',
        *_comments(calibration, found),
        '# rotation: camera_from_star_tracker',
        '---',
        f'image_width: {camera.width}',
        f'image_height: {camera.height}',
        f'lens_model: {"fisheye" if camera.model == "equidistant" else "pinhole"}',
        *_opencv_matrix('camera_matrix', camera.matrix),
        *_opencv_matrix('distortion_coefficients', D[None, :]),
        *_opencv_matrix('rotation', _camera_from_star_tracker(calibration)),
        f'largest_error_px: {found.worst_px!r}',
    ]
    return '\n'.join(lines) + '\n', found


def kalibr_yaml(calibration: Calibration, topic: str) -> tuple[str, Fitted]:
    """
    A camchain of kalibr with one camera, and the camera in it.

    The star tracker stands for the IMU: ``T_cam_imu`` is the alignment without translation.  Of
    ``radtan`` and ``equidistant``, the model with the smaller error.
    """
    candidates = [(fitted(calibration, m, zero), word) for m, (word, zero) in _KALIBR.items()]
    found, word = min(candidates, key=lambda candidate: candidate[0].worst_px)
    camera = found.camera
    fx, _, fy, cx, cy = camera.intrinsics.tolist()
    _, D = ros_distortion(camera.model, camera.distortion)
    T = np.eye(4)
    T[:3, :3] = _camera_from_star_tracker(calibration)
    content = {
        'cam0': {
            'camera_model': 'pinhole',
            'intrinsics': [fx, fy, cx, cy],
            'distortion_model': word,
            'distortion_coeffs': D[:4].tolist(),
            'T_cam_imu': T.tolist(),
            'timeshift_cam_imu': 0.0,
            'rostopic': topic,
            'resolution': [camera.width, camera.height],
        }
    }
    note = '# T_cam_imu: camera_from_star_tracker; kalibr has no star tracker'
    return '\n'.join([*_comments(calibration, found), note, _yaml(content)]), found


def transform_yaml(calibration: Calibration) -> str:
    """A geometry_msgs/TransformStamped of the alignment, for a static transform publisher."""
    x, y, z, w = calibration.geometry.star_tracker_from_camera_xyzw.tolist()
    content = {
        'header': {'frame_id': calibration.parent_frame},
        'child_frame_id': calibration.child_frame,
        'transform': {
            'translation': {'x': 0.0, 'y': 0.0, 'z': 0.0},
            'rotation': {'x': x, 'y': y, 'z': z, 'w': w},
        },
    }
    return '\n'.join([*_commented(origin(calibration)), _yaml(content)])


def _camera_from_star_tracker(calibration: Calibration) -> Floats:
    quaternion = Rotation.from_quat(calibration.geometry.star_tracker_from_camera_xyzw)
    return np.asarray(quaternion.inv().as_matrix())


def _comments(calibration: Calibration, found: Fitted) -> list[str]:
    words = in_words(found.worst_px, found.losses)
    return _commented([*origin(calibration), *words, *PIXEL_CONVENTION])


def _commented(lines: Iterable[str]) -> list[str]:
    return [f'# {ascii_line(line)}' for line in lines]


def _yaml(content: object) -> str:
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=10_000)
    return text


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
