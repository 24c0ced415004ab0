# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""File camera_info.yaml: round trips, hand-written files, errors, URLs."""

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from starcal_ground.products import write_camera_info
from starcal_ros.camera import CameraModel, project
from starcal_ros.errors import ProductError
from starcal_ros.formats.products.camera_yaml import (
    read_camera_info,
    read_camera_name,
    resolve_url,
)

PARAMETERS = np.array(
    [3641.5121868491606, -0.74, 3642.3, 647.5, 511.5, -0.0512, 0.1167, 0.01, 5.1e-4, 3.2e-5]
)
CAMERA = CameraModel(1296, 1024, PARAMETERS)
ROS_YAML = """\
image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0.5, 319.5, 0, 501, 239.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.1, 1e-2, 1e-05, -2.0e-4, 0.003]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [500, 0, 319.5, 0, 0, 501, 239.5, 0, 0, 0, 1, 0]
"""


def test_camera_info_is_what_camera_info_manager_reads(tmp_path: Path) -> None:
    path = tmp_path / 'camera_info.yaml'
    write_camera_info(CAMERA, path, 'opnav')
    fitted, _ = CAMERA.ros_fit
    fx, _, fy, cx, cy, k1, k2, k3, p1, p2 = fitted.parameters.tolist()
    P = [fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0]
    expected = {
        'image_width': 1296,
        'image_height': 1024,
        'camera_name': 'opnav',
        'camera_matrix': {'rows': 3, 'cols': 3, 'data': [fx, 0, cx, 0, fy, cy, 0, 0, 1]},
        'distortion_model': 'plumb_bob',
        'distortion_coefficients': {'rows': 1, 'cols': 5, 'data': [k1, k2, p1, p2, k3]},
        'rectification_matrix': {'rows': 3, 'cols': 3, 'data': [1, 0, 0, 0, 1, 0, 0, 0, 1]},
        'projection_matrix': {'rows': 3, 'cols': 4, 'data': P},
    }
    content = yaml.safe_load(path.read_text())
    assert content == expected and list(content) == list(expected)
    # Each key on a line of its own: ROS's Python parsers split nothing, people's greps do.
    assert all(len(line) < 400 for line in path.read_text().splitlines())


def test_hand_written_ros_yaml(tmp_path: Path) -> None:
    path = tmp_path / 'left.yaml'
    path.write_text(ROS_YAML)
    expected = [500.0, 0.5, 501.0, 319.5, 239.5, -0.1, 1e-2, 0.003, 1e-5, -2e-4]
    for location in (path, str(path), f'file://{path}'):
        camera = read_camera_info(location)
        assert (camera.width, camera.height) == (640, 480)
        assert camera.parameters.tolist() == expected
    path.write_text(ROS_YAML.replace(', 0.003]', ']').replace('cols: 5', 'cols: 4'))
    assert read_camera_info(path).parameters.tolist() == [*expected[:7], 0.0, *expected[8:]]
    # Files older than the key are plumb_bob, as camera_calibration_parsers takes them.
    path.write_text(ROS_YAML.replace('distortion_model: plumb_bob\n', ''))
    assert read_camera_info(path).parameters.tolist() == expected


OF_FIVE = [1, 2, 4, 5, 3]  # k1, k2, p1, p2, k3


@pytest.mark.parametrize(
    ('ros_model', 'D', 'model', 'expected'),
    [
        ('plumb_bob', OF_FIVE, 'plumb_bob', [1, 2, 3, 4, 5]),
        ('equidistant', [1, 2, 3, 4], 'equidistant', [1, 2, 3, 4]),
        ('fisheye', [1, 2, 3, 4], 'equidistant', [1, 2, 3, 4]),
        ('rational_polynomial', [*OF_FIVE, *range(6, 9)], 'rational_polynomial', range(1, 9)),
        ('rational_polynomial', [*OF_FIVE, *range(6, 13)], 'thin_prism', range(1, 13)),
        ('thin_prism_fraunhofer', [*OF_FIVE, *range(6, 13)], 'thin_prism', range(1, 13)),
        ('rational_polynomial', [*OF_FIVE, *range(6, 15)], 'tilted', range(1, 15)),
    ],
)
def test_every_distortion_model_of_ros(tmp_path, ros_model, D, model, expected) -> None:
    D, expected = [0.001 * c for c in D], [0.001 * c for c in expected]
    path = tmp_path / 'camera.yaml'
    text = ROS_YAML.replace('plumb_bob', ros_model).replace('[500.0, 0.5', '[500.0, 0.0')
    path.write_text(text.replace('[-0.1, 1e-2, 1e-05, -2.0e-4, 0.003]', str(D)))
    camera = read_camera_info(path)
    assert camera.model == model
    assert camera.parameters.tolist() == [500.0, 0.0, 501.0, 319.5, 239.5, *expected]
    write_camera_info(camera, path)
    content = yaml.safe_load(path.read_text())
    named = model if model in ('plumb_bob', 'equidistant') else 'rational_polynomial'
    assert content['distortion_model'] == named
    assert content['distortion_coefficients'] == {'rows': 1, 'cols': len(D), 'data': D}
    again = read_camera_info(path)
    assert (again.model, again.parameters.tolist()) == (model, camera.parameters.tolist())


def test_package_urls_follow_ament_prefixes(tmp_path, monkeypatch) -> None:
    first, second = tmp_path / 'first', tmp_path / 'second'
    (first / 'share' / 'other').mkdir(parents=True)
    (second / 'share' / 'my_cameras' / 'config').mkdir(parents=True)
    file = second / 'share' / 'my_cameras' / 'config' / 'a camera.yaml'
    file.write_text(ROS_YAML)
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{first}::{second}')
    assert resolve_url('package://my_cameras/config/a camera.yaml') == file
    assert resolve_url('package://my_cameras/config/a%20camera.yaml') == file
    assert read_camera_info('package://my_cameras/config/a camera.yaml').width == 640
    with pytest.raises(ProductError, match='package absent is not in AMENT_PREFIX_PATH'):
        resolve_url('package://absent/a.yaml')
    monkeypatch.delenv('AMENT_PREFIX_PATH')
    with pytest.raises(ProductError, match='package my_cameras is not in'):
        resolve_url('package://my_cameras/config/a.yaml')


@pytest.mark.parametrize(
    ('url', 'says'),
    [
        ('', 'empty'),
        ('http://example.org/a.yaml', 'only file:// and package://'),
        ('package://', 'not package://<package>/<path>'),
        ('package://name', 'not package://<package>/<path>'),
        ('package://../a', 'not package://<package>/<path>'),
    ],
)
def test_urls_that_cannot_be_read(url: str, says: str) -> None:
    with pytest.raises(ProductError, match=says):
        resolve_url(url)


def test_file_urls_with_and_without_percent_encoding(tmp_path: Path) -> None:
    for name, url_name in (('a b.yaml', 'a%20b.yaml'), ('100%25.yaml', '100%25.yaml')):
        (tmp_path / name).write_text(ROS_YAML)
        assert resolve_url(f'file://{tmp_path}/{url_name}') == tmp_path / name
    with pytest.raises(ProductError, match='none.*cannot be read: No such file'):
        read_camera_info(tmp_path / 'none')


# As mrcal documents its files: comments, then a Python dictionary; extrinsics are the pose.
CAMERAMODEL = """# generated by mrcal
{
    'lensmodel':  'LENSMODEL_OPENCV%d',
    'extrinsics': [ 0., 0.1, 0., 0., 0., 0., ],
    'intrinsics': [ 1761.2, 1761.3, 1965.7, 1087.5, %s],
    'imagersize': [ 4000, 2200,],
}
"""


@pytest.mark.parametrize(('count', 'model'), [
    (4, 'plumb_bob'), (5, 'plumb_bob'), (8, 'rational_polynomial'), (12, 'thin_prism'),
])  # fmt: skip
def test_a_cameramodel_of_mrcal_is_a_prior(tmp_path: Path, count: int, model: str) -> None:
    """Against OpenCV, whose coefficients and order mrcal's models have."""
    D = np.array([-0.01, 0.03, -3e-4, 5e-4, 1e-3, 2e-3, 1e-3, 1e-4, 1e-4, 2e-4, -1e-4, 1e-4])
    numbers = ', '.join(map(repr, D[:count].tolist()))
    path = tmp_path / 'camera.cameramodel'
    path.write_text(CAMERAMODEL % (count, numbers))
    camera = read_camera_info(path)
    assert (camera.width, camera.height, camera.model) == (4000, 2200, model)
    assert read_camera_name(path) == 'camera'
    directions = np.array([[0.1, -0.2, 1.0], [-0.4, 0.3, 1.0]])
    K = np.array([[1761.2, 0, 1965.7], [0, 1761.3, 1087.5], [0, 0, 1]])
    seen, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), K, D[:count])
    assert np.abs(project(camera, directions) - seen[:, 0]).max() < 1e-9  # roundings of 1e3 px


K = '[500.0, 0.0, 319.5, 0, 501, 239.5, 0, 0, 1]'
OPENCV_YAML = f"""%YAML:1.0
---
calibration_time: "Mon 03 Mar 2025 10:12:00"
image_width: 640
image_height: 480
flags: 0
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {K}
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -1.0e-01, 1.0e-02, 1.0e-05, -2.0e-04, 3.0e-03 ]
avg_reprojection_error: 2.1e-01
"""
KALIBR_YAML = """cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.01, 1.0e-05, -0.0002]
  distortion_model: radtan
  intrinsics: [500.0, 501, 319.5, 239.5]
  resolution: [640, 480]
  rostopic: /camera/image_raw
"""
INFO_YAML = f"""header:
  frame_id: camera
height: 480
width: 640
distortion_model: plumb_bob
d: []
k: {K}
---
"""
FORMS = {
    'opencv': (OPENCV_YAML, 'plumb_bob', [-0.1, 0.01, 0.003, 1e-5, -2e-4]),
    'opencv, 8 coefficients': (
        OPENCV_YAML.replace('3.0e-03 ]', '3.0e-03, 0.1, 0.2, 0.3 ]'),
        'rational_polynomial',
        [-0.1, 0.01, 0.003, 1e-5, -2e-4, 0.1, 0.2, 0.3],
    ),
    'kalibr': (KALIBR_YAML, 'plumb_bob', [-0.1, 0.01, 0.0, 1e-5, -2e-4]),
    'kalibr, equidistant': (
        KALIBR_YAML.replace('radtan', 'equidistant'), 'equidistant', [-0.1, 0.01, 1e-5, -2e-4],
    ),
    'CameraInfo of ROS 2': (INFO_YAML.removesuffix('---\n'), 'plumb_bob', [0.0] * 5),
    'ros2 topic echo --once': (INFO_YAML, 'plumb_bob', [0.0] * 5),
    'ros2 topic echo': (f'{INFO_YAML}{INFO_YAML}header:\n  stamp:', 'plumb_bob', [0.0] * 5),
    'a document with its mark': (f'---\n{INFO_YAML}', 'plumb_bob', [0.0] * 5),
    'CameraInfo of ROS 1': (
        f'width: 640\nheight: 480\nD: []\nK: {K}\ndistortion_model: ""\n', 'plumb_bob', [0.0] * 5,
    ),
    'no coefficients': (
        ROS_YAML.replace('[-0.1, 1e-2, 1e-05, -2.0e-4, 0.003]', '[]').replace('0.5,', '0.0,', 1),
        'plumb_bob',
        [0.0] * 5,
    ),
}  # fmt: skip


@pytest.mark.parametrize('form', FORMS)
def test_other_forms_of_a_camera_file_are_read(form: str, tmp_path: Path) -> None:
    text, model, distortion = FORMS[form]
    (tmp_path / 'camera.yaml').write_text(text)
    camera = read_camera_info(tmp_path / 'camera.yaml')
    assert (camera.width, camera.height, camera.model) == (640, 480, model)
    assert camera.intrinsics.tolist() == [500.0, 0.0, 501.0, 319.5, 239.5]
    assert camera.distortion.tolist() == distortion
    assert read_camera_name(tmp_path / 'camera.yaml') == (
        'narrow_stereo' if form == 'no coefficients' else 'camera'
    )


# A file, a text in it that is replaced, and words of the refusal.
BAD = {
    ROS_YAML: [
        ('plumb_bob', 'equidistant', 'distortion_model: 5 coefficients of equidistant, .* has 4'),
        ('plumb_bob', 'rational_polynomial', 'rational_polynomial, which has 8 or 12 or 14'),
        ('plumb_bob', 'double_sphere', "distortion_model: 'double_sphere' is not plumb_bob, rat"),
        ('plumb_bob', '[1]', r'distortion_model: \[1\] is not a text'),
        ('image_width: 640', '', "key 'image_width' is missing"),
        ('image_height: 480', 'image_height: tall', "image_height: 'tall' is not a whole number"),
        ('image_height: 480', 'image_height: 0', '640 x 0 is not an image'),
        ('0, 501, 239.5, 0, 0, 1]', '0, 501]', 'camera_matrix.data: 5 numbers, not 9'),
        ('[500.0, 0.5', '[0, 0.5', 'not positive'),
        ('[500.0, 0.5', '[1e300, 0.5', r'fx: 1e\+300 px is over 1e\+08 px'),
        ('[500.0, 0.5', '[35.0, 0.5', 'fx: 35 px is under 96 px, .*; is it in mm'),
        ('[500.0, 0.5', '[500.0, 60', 'skew: 60 px is over a tenth of fx'),
        ('0, 501,', '0, 50000,', 'fx, fy: 500, 50000 px differ by more than a factor of ten'),
        ('319.5', '3e5', 'cx: 300000 px is far outside of the 640 px'),
        ('-0.1, 1e-2', '1e300, 1e300', 'no line of sight over most of the detector'),
        ('-0.1, 1e-2', '-50.0, 0.0', 'no line of sight over most of the detector'),
        ('image_width: 640', 'image_width: 99999999', 'image size: 99999999 x 480 is over'),
        ('image_width: 640', 'image_width: 640\nimage_width: 1', 'line 2: duplicate key'),
        ('[500.0, 0.5', '[.nan, 0.5', r'camera_matrix.data\[0\]: nan is not a finite number'),
        ('239.5, 0, 0, 1]', '239.5, 0, 0, 2]', 'camera_matrix.data: .* is not'),
        (', 1e-2, 1e-05, -2.0e-4, 0.003', '', '1 coefficients of plumb_bob, which has 5'),
        ('camera_matrix', 'matrix', "key 'camera_matrix' is missing"),
        ('image_width: 640', 'image_width: [', 'not YAML'),
        (ROS_YAML, '', 'not'),
        (ROS_YAML, '3', 'not'),
        (ROS_YAML, '---\n---\n', 'not a camera YAML'),
    ],
    CAMERAMODEL % (5, '0., 0., 0., 0., 0.'): [
        ('OPENCV5', 'SPLINED_STEREOGRAPHIC_order=3', 'is not LENSMODEL_PINHOLE'),
        ('OPENCV5', 'OPENCV8', '9 numbers, LENSMODEL_OPENCV8 has 12'),
        ("'imagersize'", "'size'", 'imagersize'),
        ('4000, 2200', '__import__("os")', 'malformed'),
        ('}', '', 'camera.yaml: '),
    ],
    KALIBR_YAML: [
        ('cam0', KALIBR_YAML.replace('cam0', 'cam1') + 'cam0', 'several cameras of kalibr: keep'),
        ('pinhole', 'omni', "camera_model: 'omni' is not pinhole"),
        ('radtan', 'fov', "distortion_model: 'fov' is not plumb_bob"),
    ],
    OPENCV_YAML: [
        ('image_width', 'columns', 'image_width'),
        (K, str([0] * 9), 'K.* is zeros, an uncalibrated camera in ROS: leave'),
    ],
    INFO_YAML: [(K, str([0.0] * 9), 'K.* is zeros, an uncalibrated camera in ROS: leave')],
}


@pytest.mark.parametrize(
    ('text', 'old', 'new', 'words'),
    [(text, *row) for text, rows in BAD.items() for row in rows],
    ids=itertools.count(),
)
def test_a_bad_camera_file_is_refused_by_file_and_key(tmp_path, text, old, new, words) -> None:
    path = tmp_path / 'camera.yaml'
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ProductError, match=words) as caught:
        read_camera_info(path)
    assert str(path) in str(caught.value) and '\n' not in str(caught.value)
