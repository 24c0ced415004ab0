# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The camera of a ROS camera YAML and of files like it, and the URLs that name one."""

from __future__ import annotations

import ast
from collections.abc import Mapping
from dataclasses import dataclass
import os
from pathlib import Path
import re
from typing import Annotated, Any
from urllib.parse import unquote

import numpy as np

from starcal_ros.camera import CameraModel, check_plausible
from starcal_ros.camera.lens import from_ros_distortion
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.product_files import read_text
from starcal_ros.record_fields import Finite, read_record, Shape
from starcal_ros.untrusted import PARAMETER_BYTES, shown, yaml_value

DEFAULT_CAMERA_NAME = 'camera'
_HAS_CONTENT = re.compile(r'^\s*[^#\s]', re.MULTILINE)
_IS_MRCAL = re.compile(r'["\']lensmodel["\']\s*:')
_OF_MRCAL = (4, 5, 8, 12)  # coefficients of OpenCV's models


@dataclass(frozen=True)
class _Matrix:
    data: Annotated[tuple[float, ...], Finite(), Shape((9,))]


@dataclass(frozen=True)
class _Coefficients:
    data: Annotated[tuple[float, ...], Finite()]


@dataclass(frozen=True)
class _CameraInfo:
    """The keys of a camera YAML that are read."""

    image_width: int
    image_height: int
    camera_matrix: _Matrix
    distortion_coefficients: _Coefficients
    distortion_model: str = 'plumb_bob'

    def camera(self) -> CameraModel:
        """Return the camera, K[0,1] as its skew; raises ValueError for impossible values."""
        K = self.camera_matrix.data
        fx, skew, cx, zero, fy, cy = K[:6]
        if not any(K):
            raise ValueError(
                'camera_matrix (K) is zeros, an uncalibrated camera in ROS: leave camera_info_url'
                ' out to find the camera by its stars, or state a first K'
            )
        if zero != 0.0 or K[6:] != (0.0, 0.0, 1.0):
            raise ValueError(f'camera_matrix.data: {list(K)} is not [fx s cx 0 fy cy 0 0 1]')
        # None: ROS writes so where a lens has no distortion.
        data = list(self.distortion_coefficients.data)
        try:
            model, distortion = from_ros_distortion(self.distortion_model[:60], data)
        except ValueError as error:
            raise ValueError(f'distortion_model: {error}') from error
        parameters = np.r_[fx, skew, fy, cx, cy, distortion]
        camera = CameraModel(self.image_width, self.image_height, parameters, model)
        check_plausible(camera)
        return camera


def _values_of_mrcal(text: str) -> Mapping[str, Any]:
    """Keys of a camera YAML from a .cameramodel of mrcal; its extrinsics are not read."""
    content = ast.literal_eval(text[text.index('{') :])
    name, values = str(content['lensmodel']), [float(x) for x in content['intrinsics']]
    width, height = content['imagersize']
    if name not in ('LENSMODEL_PINHOLE', *(f'LENSMODEL_OPENCV{n}' for n in _OF_MRCAL)):
        raise ValueError(f'lensmodel: {name[:60]} is not LENSMODEL_PINHOLE or LENSMODEL_OPENCVn')
    count = int(name.removeprefix('LENSMODEL_PINHOLE').removeprefix('LENSMODEL_OPENCV') or 0)
    if len(values) != 4 + count:
        raise ValueError(f'intrinsics: {len(values)} numbers, {name} has {4 + count}')
    fx, fy, cx, cy = values[:4]
    K, D = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], values[4:] + [0.0] * max(0, 5 - count)
    return _values(width, height, K, D, 'plumb_bob' if count <= 5 else 'rational_polynomial')


def _camera_info_values(text: str) -> Mapping[str, Any]:
    """
    Keys of a ROS camera YAML, from one or from another form of the same camera.

    These are a file of ``cv2.FileStorage``, a camchain of kalibr with one camera, a camera model
    of mrcal, and a printed ``CameraInfo`` message.
    """
    if _IS_MRCAL.search(text):
        return _values_of_mrcal(text)
    if text.startswith('%YAML:1.0'):  # neither OpenCV's first line nor its tag is YAML
        text = text.partition('\n')[2].replace('!!opencv-matrix', '')
    # A line ends each message of ros2 topic echo, and the head of a file of OpenCV: the first
    # document with more than comments is read, since the camera of one message is that of all.
    documents = re.split(r'^---\s*$', text, flags=re.MULTILINE)
    content = yaml_value(next(filter(_HAS_CONTENT.search, documents), ''))
    if not isinstance(content, dict):
        raise ValueError('not a camera YAML (no keys)')
    if any(isinstance(body, dict) and 'ros__parameters' in body for body in content.values()):
        raise ValueError('a parameter file, not a camera file: give it as --params')
    if 'cam1' in content:
        raise ValueError('several cameras of kalibr: keep cam0, of this camera, alone')
    if isinstance(kalibr := content.get('cam0'), dict):
        if kalibr.get('camera_model') != 'pinhole':
            raise ValueError(f'camera_model: {shown(kalibr.get("camera_model"))} is not pinhole')
        fx, fy, cx, cy = kalibr['intrinsics']
        width, height = kalibr['resolution']
        model = kalibr['distortion_model']
        return _values(
            width,
            height,
            [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            [] if model == 'none' else kalibr['distortion_coeffs'],
            {'radtan': 'plumb_bob', 'none': 'plumb_bob'}.get(model, model),
        )
    folded = {key.lower(): value for key, value in content.items()}
    if 'k' in folded and 'camera_matrix' not in folded:
        model = folded.get('distortion_model') or 'plumb_bob'
        return _values(folded['width'], folded['height'], folded['k'], folded['d'], model)
    coefficients = content.get('distortion_coefficients')
    if 'distortion_model' not in content and isinstance(coefficients, dict):
        many = len(coefficients.get('data', ())) > 5
        model = 'rational_polynomial' if many else 'plumb_bob'
        is_fisheye = content.get('lens_model') == 'fisheye'
        content['distortion_model'] = 'equidistant' if is_fisheye else model
    return content


def _values(width: Any, height: Any, K: Any, D: Any, model: Any) -> Mapping[str, Any]:
    return {
        'image_width': width,
        'image_height': height,
        'camera_matrix': {'data': K},
        'distortion_coefficients': {'data': D},
        'distortion_model': model,
    }


def read_camera_info(location: str | Path) -> CameraModel:
    """
    The camera in a ROS camera YAML; K[0,1], where a file has one, is its skew.

    The location is a path, or a ``file://`` or ``package://`` URL.  Files of OpenCV, kalibr and
    mrcal and a printed ``CameraInfo`` are read too: the camera, not its pose.

    Raises ProductError naming the file and the key that is missing, wrong or not supported.
    """
    path = resolve_url(location) if isinstance(location, str) else location
    text = read_text(path, PARAMETER_BYTES)
    try:
        return read_record(_CameraInfo, _camera_info_values(text)).camera()
    except (ValueError, KeyError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
        words = ' '.join(f'{error}'.split())
        raise ProductError(f'{path}: {words}') from error


def read_camera_name(location: str | Path) -> str:
    """The ``camera_name`` in a ROS camera YAML that `read_camera_info` accepts, or the default."""
    if not location:
        return DEFAULT_CAMERA_NAME
    path = resolve_url(location) if isinstance(location, str) else location
    name = _camera_info_values(read_text(path, PARAMETER_BYTES)).get('camera_name')
    return name if isinstance(name, str) and name else DEFAULT_CAMERA_NAME


def resolve_url(url: str) -> Path:
    """
    The path that a ``file://`` or ``package://`` URL, or a plain path, names.

    Packages are looked for as ament does, in ``share/<package>`` of each prefix of
    AMENT_PREFIX_PATH, but without ROS.

    Raises ProductError for another scheme, an empty URL or a package that no prefix has.
    """
    scheme, separator, rest = url.partition('://')
    if not separator:
        if not url:
            raise ProductError('the camera YAML is not named (empty URL)')
        return Path(url)
    if scheme == 'file':
        return _as_written_or_decoded(Path(rest))
    if scheme != 'package':
        raise ProductError(f'{url}: only file:// and package:// URLs can be read')
    package, _, inside = rest.partition('/')
    if not re.fullmatch(r'\w+', package) or not inside:
        raise ProductError(f'{url}: not package://<package>/<path>')
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        share = Path(prefix, 'share', package)
        if prefix and share.is_dir():
            return _as_written_or_decoded(share / inside)
    raise ProductError(f'{url}: package {package} is not in AMENT_PREFIX_PATH')


def _as_written_or_decoded(path: Path) -> Path:
    """The path; ROS does not decode %20 in its URLs but others do, so both are taken."""
    return path if path.exists() else Path(unquote(str(path)))
