# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The C++ node of examples/, built with the exported C where rclcpp is installed, and run."""

from collections.abc import Iterator
import os
from pathlib import Path
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from starcal_ground.mission.export.c_camera import TABLE_FILE
from starcal_ground.mission.export.export_formats import export
from starcal_ground.mission.export.request import Request
from starcal_ros.camera import line_of_sight
from starcal_ros.records import Calibration

pytest.importorskip('rclpy')

from export_calibrations import calibration  # type: ignore[import-not-found]
from geometry_msgs.msg import PointStamped, Vector3Stamped
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from starcal_tool import run  # type: ignore[import-not-found]

pytestmark = [pytest.mark.nodes, pytest.mark.packaging, pytest.mark.slow]
EXAMPLE = Path(__file__).resolve().parents[2] / 'examples' / 'pointing_node'
# A unit vector in double precision; the table is that of the Python package.
SAME_DIRECTION = 1e-12
COMPILED_IN, UPLINKED = calibration('plumb_bob'), calibration('thin_prism', with_field=True)


@pytest.fixture(scope='module')
def node(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the example as a user does: camera exported, then CMake."""
    prefixes = [*os.environ.get('CMAKE_PREFIX_PATH', '').split(os.pathsep), sys.prefix]
    if not any(Path(one, 'share/rclcpp/cmake').is_dir() for one in prefixes if one):
        pytest.skip('no rclcpp with its headers: PyPI has none')
    folder = tmp_path_factory.mktemp('pointing_node')
    export(COMPILED_IN, 'c', folder, Request())
    definitions = (f'-DSTARCAL_CAMERA_DIR={folder}', f'-DPython3_EXECUTABLE={sys.executable}')
    build = os.environ | {'CMAKE_PREFIX_PATH': os.pathsep.join(filter(None, prefixes))}
    for command in (
        ('cmake', '-S', EXAMPLE, '-B', folder / 'build', *definitions),
        ('cmake', '--build', folder / 'build'),
    ):
        done = run(*command, env=build)
        assert done.returncode == 0, done.stdout + done.stderr
    return folder / 'build' / 'pointing_node'


@pytest.fixture
def started(node: Path) -> Iterator[None]:
    with subprocess.Popen([node]) as process:
        yield
        process.kill()


def test_it_answers_with_lines_of_sight_of_the_python_package(client, started, tmp_path) -> None:
    answers = client.collect(Vector3Stamped, 'line_of_sight')
    client.until(lambda: client.node.count_publishers('line_of_sight'))
    pixels = client.publisher(PointStamped, 'pixel')
    asked = np.array([[0.0, 0.0], [640.5, 500.25], [1295.0, 1023.0]])

    def sights() -> np.ndarray:
        answers.clear()
        for x, y in asked.tolist():
            message = PointStamped()
            message.point.x, message.point.y = x, y
            pixels.publish(message)
        client.until(lambda: len(answers) == len(asked))
        return np.array([[a.vector.x, a.vector.y, a.vector.z] for a in answers])

    def set_table(path: Path) -> str:
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(path))
        wish = Parameter(name='table', value=value)
        (answer,) = client.call(
            SetParameters, '/pointing_node/set_parameters', parameters=[wish]
        ).results
        return '' if answer.successful else answer.reason

    assert np.abs(sights() - expected(COMPILED_IN, asked)).max() < SAME_DIRECTION
    export(UPLINKED, 'c', tmp_path, Request(table=True))
    table = tmp_path / TABLE_FILE
    assert set_table(table) == ''
    assert np.abs(sights() - expected(UPLINKED, asked)).max() < SAME_DIRECTION
    damaged = tmp_path / 'damaged.bin'
    damaged.write_bytes(table.read_bytes()[:-9])
    assert set_table(damaged) == f'table {damaged}: refused with starcal_status 7'
    assert set_table(tmp_path / 'none') == f'table {tmp_path}/none: cannot be read'
    assert np.abs(sights() - expected(UPLINKED, asked)).max() < SAME_DIRECTION


def test_a_bad_table_at_the_start_costs_one_line(node, tmp_path) -> None:
    done = run(node, '--ros-args', '-p', f'table:={tmp_path / "none"}')
    assert done.returncode == 2
    assert 'none: cannot be read' in done.stderr and done.stderr.count('\n') == 1


def expected(made: Calibration, pixels: np.ndarray) -> np.ndarray:
    tracker = Rotation.from_quat(made.geometry.star_tracker_from_camera_xyzw)
    return np.asarray(tracker.apply(line_of_sight(made.geometry.camera, pixels)))
