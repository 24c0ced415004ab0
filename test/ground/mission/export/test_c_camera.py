# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The exported C, compiled and run under sanitizers, against the Python package."""

import dataclasses
import hashlib
import math
import os
from pathlib import Path
import shutil
import struct
import subprocess
import zlib

from export_calibrations import calibration  # type: ignore[import-not-found]
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.mission.export.c_camera import c_table, TABLE_FILE
from starcal_ground.mission.export.export_formats import export
from starcal_ground.mission.export.request import Request
from starcal_ground.written_files import write_calibration
from starcal_ros.assessment.lookup import (
    common_rotation,
    Derivatives,
    line_of_sight_covariance,
    line_of_sight_table,
    lines_of_sight,
)
from starcal_ros.camera import CameraModel, line_of_sight, pixel_grid, project, project_jacobians
from starcal_ros.camera.lens import LENSES
from starcal_ros.estimation.problem import camera_at
from starcal_ros.records import Calibration, factored_field, MapCovariance, SigmaPart

pytestmark = [pytest.mark.packaging, pytest.mark.slow]  # compilers run
WARNINGS = ['-Wall', '-Wextra', '-Werror', '-pedantic']
SANITIZERS = ['-g', '-fsanitize=address,undefined', '-fno-sanitize-recover=all']
DRIVER = Path(__file__).with_name('check_camera.c')
# Of a unit vector: some ten roundings of the lens, and its inverse to 1e-14.
SAME_DIRECTION = 1e-12
# A direction to 1e-12 is 4e-9 px at a focal length of 3600 px; Newton and field end below it.
SAME_PX = 1e-8
REFERENCE_DEGC = 20.0  # of `calibration(temperature=True)`
OUTSIDE, BAD_ARGUMENT, NO_IMAGE = range(1, 4)
NOT_A_TABLE, OTHER_VERSION, TRUNCATED, DAMAGED, TOO_LARGE = range(5, 10)

COMPILERS = [
    (name, standard)
    for pair in (('gcc', 'g++'), ('clang', 'clang++'))
    for name, standard in zip(pair, ('c99', 'c++17'), strict=True)
    if shutil.which(name)
]


def built(
    made: Calibration,
    folder: Path,
    compiler: str = 'gcc',
    standard: str = 'c99',
    level: str = '-O0',
) -> Path:
    """Compile the exported source with the driver; optimised it takes twice as long."""
    export(made, 'c', folder, Request())
    language = 'c++' if standard.startswith('c++') else 'c'
    program = folder / 'check_camera'
    files = [f'-I{folder}', str(folder / 'starcal_camera.c'), str(DRIVER), '-o', str(program)]
    options = ['-x', language, f'-std={standard}', *WARNINGS, *SANITIZERS, level]
    subprocess.run([compiler, *options, *files, '-lm'], check=True)
    return program


def run(program: Path, *arguments: str | Path, lines: np.ndarray | None = None) -> tuple[int, str]:
    text = '' if lines is None else '\n'.join(' '.join(map(repr, row)) for row in lines.tolist())
    # LeakSanitizer needs ptrace, which a container may forbid.
    environment = {**os.environ, 'ASAN_OPTIONS': 'detect_leaks=0'}
    done = subprocess.run(
        [str(program), *map(str, arguments)],
        input=text, capture_output=True, text=True, check=False, env=environment,
    )  # fmt: skip
    assert done.stderr == ''
    return done.returncode, done.stdout


def sights(program: Path, degc: float, pixels: np.ndarray, *table: Path) -> np.ndarray:
    lines = np.c_[np.full(len(pixels), degc), pixels]
    status, text = run(program, 'sights', *table, lines=lines)
    assert status == 0
    rows = [line.split() for line in text.splitlines()]
    assert all(row[0] == '0' and len(row) == 87 for row in rows), text[:200]
    return np.array([[float.fromhex(word) for word in row[1:]] for row in rows])


def with_correlations(made: Calibration) -> Calibration:
    """Give a calibration a full covariance, its field as factor and remainder."""
    rng = np.random.default_rng(3)
    p = len(made.parameter_names)
    scale = np.r_[np.full(5, 0.05), np.full(p - 8, 1e-4), np.full(3, 1e-6)]
    if made.field is None:
        root = scale[:, None] * rng.normal(size=(p, p))
        return dataclasses.replace(made, covariance=root @ root.T)
    count = made.field.coefficients.size
    scale = np.r_[scale, np.full(count, 0.01)]
    root = scale[:, None] * rng.normal(size=(p + count, p + count))
    camera = made.geometry.camera
    assert camera.field is not None
    field = factored_field(camera.field, MapCovariance(root @ root.T, 0.02))
    covariance = field.covariance[:p, :p]
    return dataclasses.replace(made, field=field, covariance=covariance)


def compare(made: Calibration, program: Path, degc: float, *table: Path) -> None:
    geometry = camera_at(made, degc)
    camera = geometry.camera
    pixels = pixel_grid(camera, 23, 19)
    got = sights(program, degc, pixels, *table)
    d, by_pixel, back, by_direction = np.split(got[:, :17], [3, 9, 11], axis=1)
    pointing, shape, across, J, turn, tracker = np.split(got[:, 17:], [9, 18, 22, 60, 66], axis=1)
    expected = line_of_sight(camera, pixels)
    assert np.abs(d - expected).max() < SAME_DIRECTION
    assert np.abs(back - pixels).max() < SAME_PX
    in_tracker = Rotation.from_quat(geometry.star_tracker_from_camera_xyzw).apply(expected)
    assert np.abs(tracker - in_tracker).max() < SAME_DIRECTION
    there = Derivatives.at(camera, pixels)
    matrix = made.map_covariance.matrix
    unresolved = made.map_covariance.unresolved_px**2
    of_pixel = unresolved * there.by_pixel @ np.swapaxes(there.by_pixel, 1, 2)
    # The table has the common rotation of the reference temperature.
    common = common_rotation(made.geometry.camera)
    for found, by_all in ((pointing, there.J), (shape, there.of_shape(camera, common))):
        covariance = by_all @ matrix @ np.swapaxes(by_all, 1, 2) + of_pixel
        trace = np.trace(covariance, axis1=1, axis2=2)
        worst = np.abs(found.reshape(-1, 3, 3) - covariance).max(axis=(1, 2)) / trace
        assert worst.max() < 1e-6  # the parameters cancel to a thousandth and less
    assert across.reshape(-1, 2, 2).trace(axis1=1, axis2=2) == pytest.approx(
        pointing.reshape(-1, 3, 3).trace(axis1=1, axis2=2), rel=1e-9
    )
    _, J_parameters, J_rotation = project_jacobians(camera, expected)
    p = len(camera.parameters)
    found_J = J.reshape(-1, 2, 19)
    assert np.allclose(found_J[..., :p], J_parameters, rtol=1e-9, atol=1e-12)
    if camera.model in ('tilted', 'equidistant'):
        assert (found_J[..., p:] == 0).all()
    assert np.allclose(turn.reshape(-1, 2, 3), J_rotation, rtol=1e-9, atol=1e-8)
    check_slopes(camera, pixels, by_pixel, by_direction)


def check_slopes(
    camera: CameraModel, pixels: np.ndarray, by_pixel: np.ndarray, by_direction: np.ndarray
) -> None:
    """Against central differences of the Python functions, inside the detector."""
    inside = ((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1])).all(axis=1)
    pixels = pixels[inside]
    step = 1e-2  # px: roundings of 1e-15 over it are 1e-13 of 3e-4, the third order far below
    directions = line_of_sight(camera, pixels)
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        change = line_of_sight(camera, pixels + shift) - line_of_sight(camera, pixels - shift)
        found = by_pixel[inside].reshape(-1, 3, 2)[..., axis]
        assert np.allclose(found, change / (2 * step), rtol=0, atol=1e-10)
    step = 1e-5
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        change = project(camera, directions + shift) - project(camera, directions - shift)
        found = by_direction[inside].reshape(-1, 2, 3)[..., axis]
        # px: a slope of 3600 px per radian, its third order times 1e-10.
        assert np.allclose(found, change / (2 * step), rtol=0, atol=2e-4)


@pytest.mark.parametrize('with_field', [False, True])
@pytest.mark.parametrize('model', LENSES)
def test_c_gives_the_numbers_of_python(tmp_path, model, with_field) -> None:
    made = with_correlations(calibration(model, with_field=with_field, temperature=True))
    program = built(made, tmp_path, level='-O1' if with_field else '-O0')
    assert run(program, 'selftest') == (0, '')
    for degc in (REFERENCE_DEGC, REFERENCE_DEGC - 31.5):
        compare(made, program, degc)


@pytest.mark.parametrize(('compiler', 'standard'), COMPILERS)
def test_it_compiles_without_warnings_and_passes_self_test(tmp_path, compiler, standard) -> None:
    made = calibration('tilted', with_field=True)
    program = built(made, tmp_path, compiler, standard, '-O1')
    assert run(program, 'selftest') == (0, '')


def test_a_camera_alone_has_no_direction_or_sigma_in_a_star_tracker_frame(tmp_path) -> None:
    program = built(dataclasses.replace(calibration(), parent_frame=''), tmp_path)
    assert run(program, 'selftest') == (0, '')
    seen = np.array([[REFERENCE_DEGC, 100.0, 80.0]])
    assert run(program, 'sights', lines=seen) == (0, '0\n')  # of the line of sight, and no more


def test_the_budget_and_the_identity_of_the_calibration(tmp_path) -> None:
    budget = (SigmaPart('total', 0.16, 0.4, ''), SigmaPart('stars', 0.15, 0.1, 'estimated'))
    made = dataclasses.replace(calibration(), sigma_budget=budget)
    program = built(made, tmp_path)
    assert run(program, 'selftest') == (0, '')
    _, text = run(program, 'budget')
    identity, *parts = text.splitlines()
    assert [part.split(':')[0] for part in parts] == ['total', 'stars']
    assert float.fromhex(parts[1].split()[2]) == 0.1
    # The identity is that of the file of the product.
    path = tmp_path / 'calibration.json'
    write_calibration(made, path)
    assert identity == hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_program_takes_a_new_table_without_compiling_again(tmp_path) -> None:
    program = built(calibration('plumb_bob'), tmp_path)
    newer = with_correlations(calibration('equidistant', with_field=True, temperature=True))
    done = export(newer, 'c', tmp_path, Request(table=True))
    assert list(done.files) == [TABLE_FILE]
    table = tmp_path / TABLE_FILE
    assert run(program, 'status', table)[0] == 0
    assert run(program, 'selftest', table)[0] == 0
    compare(newer, program, REFERENCE_DEGC, table)


def forged(table: bytes, place: int, kind: str, value: float) -> bytes:
    """A table with another number at a place, and a CRC that fits."""
    changed = bytearray(table)
    struct.pack_into(kind, changed, place, value)
    struct.pack_into('<I', changed, 16, zlib.crc32(bytes(changed[20:])))
    return bytes(changed)


def test_damaged_truncated_and_foreign_tables_are_refused(tmp_path) -> None:
    made = calibration('plumb_bob', with_field=True)
    program, table = built(made, tmp_path), c_table(made)
    path = tmp_path / 'table.bin'

    def status(content: bytes) -> int:
        path.write_bytes(content)
        return run(program, 'status', path)[0]

    assert status(table + b'more of the memory page') == 0
    assert status(b'') == NOT_A_TABLE
    assert status(b'#include <stdio.h>\n' * 50) == NOT_A_TABLE
    assert status(table[:8]) == TRUNCATED and status(table[:119]) == TRUNCATED
    assert status(table[:-1]) == TRUNCATED
    assert status(table[:8] + struct.pack('<I', 2) + table[12:]) == OTHER_VERSION
    for place in (17, 25, 300, len(table) - 1):
        flipped = bytearray(table)
        flipped[place] ^= 0x10
        assert status(bytes(flipped)) == DAMAGED
    # Numbers that no starcal writes, with a CRC that fits.
    for place, value in [(20, 5), (24, 0), (32, 1 << 31), (36, 1 << 30), (44, 4096), (48, 8)]:
        assert status(forged(table, place, '<I', value)) == DAMAGED, place
    for focal_px in (math.nan, math.inf, -3600.0):
        assert status(forged(table, 120, '<d', focal_px)) == DAMAGED
    count = made.geometry.camera.field.coefficients.shape[1]
    place = len(table) - 2 * count * (2 * count + 1) - 4 * count
    assert status(forged(table, place, '<H', 128)) == TOO_LARGE


def test_no_number_of_a_table_makes_a_result_that_is_not_finite(tmp_path) -> None:
    """Each number in turn out of all range, with a CRC that fits: no result, or a finite one."""
    budget = (SigmaPart('total', 0.16, 0.4, ''),)
    made = dataclasses.replace(calibration('tilted', with_field=True), sigma_budget=budget)
    program, table = built(made, tmp_path), c_table(made)
    at = table.index(b'total')
    numbers = [*range(120, 120 + 8 * 36, 8), *range(120 + 8 * 36, at - 8, 8 * 97)]
    path, pixels = tmp_path / 'table.bin', np.array([[20.0, 3.0, 4.0], [31.0, 700.0, 500.0]])
    refused = 0
    for place in numbers:
        for value in (1e308, -1e308, 1e160):
            path.write_bytes(forged(table, place, '<d', value))
            status, text = run(program, 'sights', path, lines=pixels)
            assert status in (0, 8, 100 + DAMAGED), place
            for row in map(str.split, text.splitlines()):
                finite = np.isfinite([float.fromhex(word) for word in row[1:]])
                assert finite.all(), (place, value, row[0])
                refused += len(row) == 1
    assert refused > 0
    for value in (math.nan, math.inf):
        path.write_bytes(forged(table, at + 32, '<d', value))
        assert run(program, 'status', path)[0] == DAMAGED


def test_a_table_that_is_not_this_calibration_fails_its_self_test(tmp_path) -> None:
    made = calibration('plumb_bob')
    program, table, path = built(made, tmp_path), c_table(made), tmp_path / 'table.bin'
    (focal_px,) = struct.unpack_from('<d', table, 120)
    path.write_bytes(forged(table, 120, '<d', focal_px + 1e-6))
    assert run(program, 'selftest', path)[0] == 10


def test_directions_that_the_camera_does_not_see_are_refused(tmp_path) -> None:
    made = calibration('plumb_bob')
    strong = made.geometry.camera.replace(k1=-0.9, k2=0.0, k3=0.0)
    made = dataclasses.replace(made, geometry=dataclasses.replace(made.geometry, camera=strong))
    program = built(made, tmp_path)
    # Ahead; beside the detector; beyond the fold of the lens at tan = 0.61; behind; no directions.
    text = '0 0 2, .25 0 1, .8 0 1, 0 0 -1, 1 0 0, 0 0 0, nan 0 1, inf 0 1'
    lines = np.array([row.split() for row in text.split(',')], np.float64)
    _, text = run(program, 'pixels', lines=lines)
    statuses = [int(line.split()[0]) for line in text.splitlines()]
    assert statuses == [0, 1, *[NO_IMAGE] * 3, *[BAD_ARGUMENT] * 3]


@pytest.mark.parametrize('with_field', [False, True])
def test_c_and_python_have_the_same_edge_of_the_detector(tmp_path, with_field) -> None:
    made = calibration('plumb_bob', with_field=with_field)
    camera = made.geometry.camera
    right, bottom = camera.width - 0.5, camera.height - 0.5
    on = [[-0.5, -0.5], [right, bottom], [-0.5, bottom], [right, 0.0]]
    beyond = [[-0.501, 10.0], [right + 0.001, 10.0], [10.0, -0.501], [10.0, bottom + 0.001]]
    pixels = np.array([*on, *beyond, *pixel_grid(camera, 3, 3).tolist()])
    lines = np.c_[np.full(len(pixels), REFERENCE_DEGC), pixels]
    _, text = run(built(made, tmp_path), 'sights', lines=lines)
    outside = np.array([line.split()[0] == str(OUTSIDE) for line in text.splitlines()])
    assert np.flatnonzero(outside).tolist() == [4, 5, 6, 7]
    table = line_of_sight_table(camera, made.map_covariance, pixels)
    for found in (
        lines_of_sight(made, pixels),
        lines_of_sight(made, pixels, 'star_tracker'),
        line_of_sight_covariance(made, pixels).reshape(len(pixels), 9),
        *(column[:, None] for column in (table.shape_sigma_arcsec, table.sigma_arcsec)),
    ):
        np.testing.assert_array_equal(np.isnan(found), np.tile(outside, (found.shape[1], 1)).T)


def test_the_function_of_the_page_compiles(tmp_path) -> None:
    export(calibration(), 'c', tmp_path, Request())
    page = Path(__file__).parents[4] / 'docs/onboard.md'
    source = page.read_text().split('```c\n')[1].split('```')[0]
    (tmp_path / 'page.c').write_text(source)
    subprocess.run(['gcc', '-std=c99', *WARNINGS, '-c', 'page.c'], cwd=tmp_path, check=True)


def test_it_uses_no_heap_and_no_function_but_those_of_libm(tmp_path) -> None:
    export(calibration('tilted', with_field=True), 'c', tmp_path, Request())
    made = tmp_path / 'camera.o'
    source = str(tmp_path / 'starcal_camera.c')
    subprocess.run(['gcc', '-std=c99', '-O2', '-c', source, '-o', str(made)], check=True)
    listed = subprocess.run(['nm', str(made)], capture_output=True, text=True, check=True).stdout
    used = {line.split()[-1] for line in listed.splitlines() if ' U ' in line}
    assert used <= {
        *('sin', 'cos', 'sincos', 'tan', 'atan', 'hypot', 'sqrt', 'fmax'),
        *('memcpy', 'memcmp', 'memset', '__stack_chk_fail', '_GLOBAL_OFFSET_TABLE_'),
    }
    # Neither initialised nor zeroed data that could change.
    assert not [line for line in listed.splitlines() if line.split()[-2] in 'bBdDC']
