# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Exported files, read back by OpenCV, yaml and the published equations of their readers."""

import ast
from collections.abc import Callable
import dataclasses
import json
import math
from pathlib import Path
import subprocess
from typing import Any

import cv2
from export_calibrations import calibration  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
import spiceypy
import yaml

from starcal_ground.cli.commands import export as export_command
from starcal_ground.cli.main import main
from starcal_ground.mission.export import export_formats
from starcal_ground.mission.export.export_formats import export, Format, FORMATS
from starcal_ground.mission.export.exported import Content
from starcal_ground.mission.export.request import Request, SpiceNames
from starcal_ground.written_files import write_calibration
from starcal_ros.camera import line_of_sight, pixel_grid, project
from starcal_ros.errors import OptionError
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.records import Calibration, SigmaPart

GRID = 25  # the grid over which an export states its error
# OpenCV projects in double precision: some ten roundings of 1e-13 px each.
SAME_PX = 1e-9


def grid_of(made: Calibration) -> tuple[np.ndarray, np.ndarray]:
    camera = made.geometry.camera
    pixels = pixel_grid(camera, GRID, GRID)
    return pixels, line_of_sight(camera, pixels)


def worst_px(seen: np.ndarray, pixels: np.ndarray) -> float:
    return float(np.linalg.norm(seen - pixels, axis=1).max())


def opencv_pixels(
    directions: np.ndarray, K: np.ndarray, D: np.ndarray, fisheye: bool
) -> np.ndarray:
    module = cv2.fisheye if fisheye else cv2
    zero = np.zeros((3, 1))
    points = directions.reshape(1, -1, 3) if fisheye else directions
    arguments = (points, zero, zero, K, D)
    seen, _ = module.projectPoints(*arguments)
    return np.asarray(seen.reshape(-1, 2))


def seen_by_opencv(folder: Path, directions: np.ndarray) -> np.ndarray:
    storage = cv2.FileStorage(str(folder / 'opencv.yaml'), cv2.FILE_STORAGE_READ)
    K = storage.getNode('camera_matrix').mat()
    D = storage.getNode('distortion_coefficients').mat()
    return opencv_pixels(directions, K, D, storage.getNode('lens_model').string() == 'fisheye')


def seen_by_ros(folder: Path, directions: np.ndarray) -> np.ndarray:
    return project(read_camera_info(folder / 'camera_info.yaml'), directions)


def seen_by_giant(folder: Path, directions: np.ndarray) -> np.ndarray:
    """By the equations that GIANT publishes: it is on no package registry."""
    named = json.loads((folder / 'giant_camera.json').read_text())['OpenCVModel']
    x, y = directions[:, 0] / directions[:, 2], directions[:, 1] / directions[:, 2]
    r2 = x**2 + y**2

    def term(name: str) -> float:
        return float(named.get(name, 0.0))

    radial = (1 + term('k1') * r2 + term('k2') * r2**2 + term('k3') * r2**3) / (
        1 + term('k4') * r2 + term('k5') * r2**2 + term('k6') * r2**3
    )
    p1, p2 = named['p1'], named['p2']
    xd = radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = radial * y + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    xd += term('s1') * r2 + term('s2') * r2**2
    yd += term('s3') * r2 + term('s4') * r2**2
    u = named['fx'] * xd + named['alpha'] * yd + named['px']
    return np.stack([u, named['fy'] * yd + named['py']], axis=-1)


def mrcal_content(folder: Path) -> dict[str, Any]:
    lines = (folder / 'camera.cameramodel').read_text().splitlines()
    content = ast.literal_eval('\n'.join(line for line in lines if not line.startswith('#')))
    return dict(content)


def seen_by_mrcal(folder: Path, directions: np.ndarray) -> np.ndarray:
    """By OpenCV, whose model and order mrcal documents for LENSMODEL_OPENCVn."""
    fx, fy, cx, cy, *D = mrcal_content(folder)['intrinsics']
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return opencv_pixels(directions, K, np.array(D), fisheye=False)


def seen_by_ale(folder: Path, directions: np.ndarray) -> np.ndarray:
    """By the equations of usgscsm's frame camera, radtan as in OpenCV."""
    isd = json.loads((folder / 'camera_isd.json').read_text())
    x = directions[:, :2] / directions[:, 2:]
    focal = isd['focal_length_model']['focal_length']
    D = np.array(isd['optical_distortion']['radtan']['coefficients'])
    flat = np.c_[x, np.ones(len(x))]
    distorted = opencv_pixels(flat, np.eye(3), D, fisheye=False) * focal
    affine = [isd['focal2pixel_samples'], isd['focal2pixel_lines']]
    center = [isd['detector_center'][side] for side in ('sample', 'line')]
    at = [c + a[0] + distorted @ a[1:] for c, a in zip(center, affine, strict=True)]
    return np.stack(at, axis=-1) - 0.5  # (0.5, 0.5) is the centre of the first pixel


# Reader of a format, the models that it has, those that are approximated, and whether it has skew.
Reader = Callable[[Path, np.ndarray], np.ndarray]
BROWN = ('plumb_bob', 'rational_polynomial', 'thin_prism')
READERS: dict[str, tuple[Reader, tuple[str, ...], tuple[str, ...], bool]] = {
    'opencv': (seen_by_opencv, (*BROWN, 'tilted', 'equidistant'), (), False),
    'ros': (seen_by_ros, ('plumb_bob', 'rational_polynomial', 'equidistant'), BROWN[2:], False),
    'giant': (seen_by_giant, BROWN, ('tilted',), True),
    'mrcal': (seen_by_mrcal, BROWN, ('tilted',), False),
    'isd': (seen_by_ale, ('plumb_bob',), ('thin_prism', 'equidistant'), True),
}
NAMES = SpiceNames(-999)


def parts(done: Content) -> list[str]:
    return [loss.part for loss in done.losses]


@pytest.mark.parametrize(('skew', 'with_field'), [(0.0, False), (-0.74, False), (0.0, True)])
@pytest.mark.parametrize(
    ('kind', 'model'),
    [(kind, model) for kind, row in READERS.items() for model in (*row[1], *row[2])],
)
def test_a_reader_sees_stars_as_far_off_as_the_export_states(
    tmp_path, kind, model, skew, with_field
) -> None:
    seen_by, exact, _, has_skew = READERS[kind]
    made = calibration(model, skew, with_field)
    done = export(made, kind, tmp_path, Request(NAMES))
    pixels, directions = grid_of(made)
    found_px = worst_px(seen_by(tmp_path, directions), pixels)
    assert found_px == pytest.approx(done.worst_px, abs=SAME_PX)
    if model in exact:  # another one is fitted with whatever the format has
        loses_skew = bool(skew) and not has_skew
        assert ('skew' in parts(done)) == loses_skew
        assert loses_skew or with_field or found_px < SAME_PX
    assert any('field' in part for part in parts(done)) == with_field


def test_other_facts_of_a_camera_are_in_the_files_of_their_readers(tmp_path) -> None:
    made = calibration(temperature=True)
    quaternion = made.geometry.star_tracker_from_camera_xyzw
    tracker_from_camera = Rotation.from_quat(quaternion)
    done = export(made, 'opencv', tmp_path, Request())
    storage = cv2.FileStorage(str(tmp_path / 'opencv.yaml'), cv2.FILE_STORAGE_READ)
    size = [int(storage.getNode(f'image_{side}').real()) for side in ('width', 'height')]
    assert size == [1296, 1024] and storage.getNode('camera_matrix').mat()[0, 1] == 0.0
    assert storage.getNode('largest_error_px').real() == pytest.approx(done.worst_px)
    rotation = storage.getNode('rotation').mat()
    assert np.abs(rotation.T - tracker_from_camera.as_matrix()).max() < 1e-15

    export(made, 'ros', tmp_path, Request())
    transform = yaml.safe_load((tmp_path / 'alignment.yaml').read_text())['transform']
    assert [transform['rotation'][axis] for axis in 'xyzw'] == quaternion.tolist()

    done = export(made, 'giant', tmp_path, Request())
    named = json.loads((tmp_path / 'giant_camera.json').read_text())['OpenCVModel']
    assert (named['a1'], named['a2']) == (4e-5, -6e-7)
    assert (named['n_rows'], named['n_cols']) == (1024, 1296)
    assert not any('focal' in part for part in parts(done))
    assert any('alignment' in part for part in parts(done))

    export(made, 'mrcal', tmp_path, Request())
    content = mrcal_content(tmp_path)
    assert content['lensmodel'] == f'LENSMODEL_OPENCV{len(content["intrinsics"]) - 4}'
    assert content['imagersize'] == [1296, 1024]
    camera_from_tracker = Rotation.from_rotvec(content['extrinsics'][:3])
    assert (camera_from_tracker * tracker_from_camera).magnitude() < 1e-15
    assert content['extrinsics'][3:] == [0.0, 0.0, 0.0]


def test_a_change_with_temperature_costs_pixels_per_degree(tmp_path) -> None:
    done = export(calibration(skew=0.0, temperature=True), 'opencv', tmp_path, Request())
    cost = {loss.part: loss.cost_px for loss in done.losses}
    # 4e-5 per degree at the corner farthest from the principal point (651.25, 505.75).
    corner_px = math.hypot(651.25, 1023 - 505.75)
    assert cost['change of the focal length per degC'] == pytest.approx(4e-5 * corner_px)
    # 1, 2, 3 urad about x, y, z: sqrt(5) urad across the axis, more in a corner by the roll.
    across_px = 3642 * math.sqrt(5) * 1e-6
    assert across_px < cost['change of the alignment per degC'] < across_px + 3e-6 * 900


# As foreign names may be: an escape sequence, line ends, comments and blocks of other formats.
HOSTILE = '\x1b[31m\x00\x7f\x85\u2028\r\n...\n*/ #error /* // ??/ \\ \\begindata @TABLE@ "\' %s µ'
PARSERS: dict[str, Callable[[str], object]] = {
    '.yaml': lambda text: list(yaml.parse(text)),
    '.json': json.loads,
    '.cameramodel': lambda text: ast.literal_eval(text[text.index('{') :]),
}


@pytest.mark.parametrize('kind', [row.name for row in FORMATS if not row.needs_observations])
def test_hostile_names_leave_every_format_valid(tmp_path, kind) -> None:
    made = dataclasses.replace(
        calibration('plumb_bob'),
        parent_frame=f'tracker {HOSTILE}',
        child_frame=f'camera {HOSTILE}',
        provenance={'software': HOSTILE, HOSTILE: HOSTILE, 'long': 'x' * 300},
        accepted=False,
        reasons=(HOSTILE,),
        sigma_budget=(SigmaPart(HOSTILE, 1.0, 1.0, HOSTILE),),
    )
    names = SpiceNames(-999, camera_frame='CAMERA', star_tracker_frame='TRACKER')
    for name in export(made, kind, tmp_path, Request(names)).files:
        path = tmp_path / name
        text = path.read_text('ascii')
        assert all(line.isprintable() for line in text.split('\n')), path
        PARSERS.get(path.suffix, str)(text.removeprefix('%YAML:1.0\n'))
        if kind == 'spice':
            assert text.count('\\begindata') == 1
            assert max(map(len, text.split('\n'))) <= 132  # SPICE reads no longer line
    if kind == 'c':
        command = ['gcc', '-std=c99', '-Wall', '-Wextra', '-Werror', '-c', 'starcal_camera.c']
        subprocess.run(command, cwd=tmp_path, check=True)


def test_a_format_is_added_by_a_row(tmp_path, monkeypatch, capsys) -> None:
    """As CONTRIBUTING.md says, from outside of the package."""

    def focal_lengths(made: Calibration, _: Request) -> Content:
        fx, _, fy, _, _ = made.geometry.camera.intrinsics
        return Content({'focal.txt': f'{fx:.3f} {fy:.3f}'})

    row = Format('focal', 'focal lengths as text', '`focal.txt`', 'all but these', focal_lengths)
    rows = (*FORMATS, dataclasses.replace(row, needs_alignment=True))
    for module in (export_formats, export_command):
        monkeypatch.setattr(module, 'FORMATS', rows)
    export(calibration(), 'focal', tmp_path, Request())
    assert (tmp_path / 'focal.txt').read_text() == '3641.500 3642.300'
    alone = dataclasses.replace(calibration(), parent_frame='')
    with pytest.raises(OptionError, match='camera alone'):
        export(alone, 'focal', tmp_path, Request())
    with pytest.raises(SystemExit):
        main(['export', '--help'])
    assert 'focal: focal lengths as text' in ' '.join(capsys.readouterr().out.split())


ROTATIONS = {
    'opencv': 'rotation:',
    'giant': '"star_tracker_from_camera_xyzw": [',
    'mrcal': "'extrinsics': [0.1",
}


@pytest.mark.parametrize('kind', ['ros', 'spice', *ROTATIONS])
def test_no_rotation_is_exported_to_a_star_tracker_that_does_not_exist(kind, tmp_path) -> None:
    if kind not in ROTATIONS:
        alone = dataclasses.replace(calibration('plumb_bob'), parent_frame='')
        words = f'--to {kind}: the calibration is of the camera alone'
        with pytest.raises(OptionError, match=words):
            export(alone, kind, tmp_path, Request())
        return
    for frame in ('star_tracker', ''):
        made = calibration('plumb_bob')
        turn_xyzw = Rotation.from_rotvec([-0.1, 0.0, 0.0]).as_quat()
        turned = dataclasses.replace(made.geometry, star_tracker_from_camera_xyzw=turn_xyzw)
        made = dataclasses.replace(made, geometry=turned, parent_frame=frame)
        (text,) = export(made, kind, tmp_path, Request()).files.values()
        assert (ROTATIONS[kind] in text) is bool(frame)


CENTER = ('BORESIGHT_SAMPLE', 'BORESIGHT_LINE')


@pytest.mark.parametrize(
    ('model', 'with_field', 'pixel_size_um'),
    [
        ('plumb_bob', False, 0.0),
        ('plumb_bob', True, 5.5),
        ('thin_prism', False, 5.5),
        ('equidistant', False, 0.0),
        ('equidistant', True, 0.0),
    ],
)
def test_isis_keywords_have_the_stated_error(tmp_path, model, with_field, pixel_size_um) -> None:
    made = calibration(model, with_field=with_field)
    names = SpiceNames(-999, pixel_size_um=pixel_size_um)
    done = export(made, 'isd', tmp_path, Request(names))
    pixels, directions = grid_of(made)
    assert worst_px(seen_by_ale(tmp_path, directions), pixels) == pytest.approx(
        done.worst_px, abs=SAME_PX
    )
    spiceypy.kclear()
    spiceypy.furnsh(str(tmp_path / 'camera_isis.ti'))
    key = {
        name: np.array(spiceypy.gdpool(f'INS-999001_{name}', 0, 9))
        for name in ('FOCAL_LENGTH', *CENTER, 'TRANSX', 'TRANSY', 'OD_K')
    }
    spiceypy.kclear()
    # ISIS: pixel to focal plane, radial distortion removed, then the direction.
    center = np.concatenate([key[name] for name in CENTER]) - 1.0
    at = np.c_[np.ones(len(pixels)), pixels - center]
    x, y = at @ key['TRANSX'], at @ key['TRANSY']
    r2 = x**2 + y**2
    k = key['OD_K']
    scale = 1 - (k[0] + r2 * (k[1] + r2 * k[2]))
    sights = np.c_[x * scale, y * scale, np.full(len(x), key['FOCAL_LENGTH'][0])]
    isis_px = worst_px(project(made.geometry.camera, sights), pixels)
    assert isis_px == pytest.approx(done.losses[-1].cost_px, abs=1e-6)  # digits of a text kernel
    assert isis_px < 1.0


@pytest.mark.parametrize('form', ['opencv', 'ros'])
@pytest.mark.parametrize('model', ['plumb_bob', 'equidistant'])
def test_an_exported_camera_is_read_as_a_prior_camera(tmp_path, form, model) -> None:
    made = export(calibration(model, 0.0, False), form, tmp_path, Request())
    camera = read_camera_info(tmp_path / next(iter(made.files)))
    pixels, directions = grid_of(calibration(model, 0.0, False))
    assert worst_px(project(camera, directions), pixels) < made.worst_px + 1e-6


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / 'out').mkdir()
    write_calibration(calibration(), tmp_path / 'out/calibration.json')
    return tmp_path / 'out'


def test_the_command_writes_kernels_that_load(folder, tmp_path, starcal) -> None:
    kernels = tmp_path / 'deep/kernels'
    names = ['--spacecraft-id', -999, '--star-tracker-id', -999100]
    out = starcal('export', folder, '--to', 'spice', '-o', kernels, *names).out
    assert 'largest error of a pixel against the calibration: 0 px' in out
    spiceypy.kclear()
    for path in kernels.iterdir():
        spiceypy.furnsh(str(path))
    assert spiceypy.pxform('CAMERA_OPTICAL_FRAME', 'STAR_TRACKER', 0.0).shape == (3, 3)
    spiceypy.kclear()


@pytest.mark.parametrize('accepted', [True, False])
def test_the_command_states_the_cost_of_each_part_and_a_refusal_by_the_gate(
    folder, tmp_path, starcal, accepted
) -> None:
    reasons = () if accepted else ('error of the map 2 px, limit 0.1 px',)
    judged = dataclasses.replace(calibration(), accepted=accepted, reasons=reasons)
    write_calibration(judged, folder / 'calibration.json')
    answer = starcal('export', folder, '--to', 'opencv', '-o', tmp_path)
    expected = [f'starcal: warning: the gate refused this calibration: {one}' for one in reasons]
    assert (answer.status, answer.err.splitlines()) == (0, expected)
    lines = answer.out.splitlines()
    assert lines[1].startswith('largest error') and lines[2].startswith('left out: skew, 0.')
