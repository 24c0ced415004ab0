# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameter files in a namespace: each section reaches its node, or is warned of."""

from pathlib import Path

import pytest
from rcl_interfaces.srv import GetParameters

from starcal_ros.ros.parameters import folders_of_paths, unread_sections

pytestmark = pytest.mark.nodes

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize(
    ('section', 'reaches'),
    [('/opnav/calibrator', True), ('calibrator', False)],
)
def test_a_section_in_a_namespace(vehicle, tmp_path, section, reaches) -> None:
    """What rcl does with it, and that the node warns of what rcl passes over."""
    params = tmp_path / 'params.yaml'
    params.write_text(f'{section}:\n  ros__parameters: {{min_images: 7}}\n')
    ros = ('-r', '__ns:=/opnav', '--params-file', str(params), '-p', 'autostart:=false')
    node = vehicle.start_node('calibrator', *ros)
    answer = vehicle.call(GetParameters, '/opnav/calibrator/get_parameters', names=['min_images'])
    assert answer.values[0].integer_value == (7 if reaches else 3)
    warning = f"section '{section}' does not apply to /opnav/calibrator: write /**/calibrator"
    assert (warning in node.said()) is not reaches


@pytest.mark.parametrize('file', ['config/minimal.yaml', 'bags/tiny/params.yaml'])
def test_a_node_starts_with_a_file_of_the_repository_from_any_folder(vehicle, file) -> None:
    """The camera file of the small bag is relative to its parameters, not to this folder."""
    params = ROOT / file
    camera = f'camera_info_url:=file://{vehicle.bag}/camera.yaml'
    more = ('-p', camera) if 'minimal' in file else ()
    assert more or 'camera_info_url: camera.yaml' in params.read_text()
    assert not Path('camera.yaml').exists()
    node = vehicle.start_node('calibrator', '--params-file', str(params), *more)
    vehicle.until(lambda: 'active, listening to' in node.said())


def test_a_path_is_relative_to_the_file_that_gives_it(tmp_path) -> None:
    values = '{camera_info_url: camera.yaml, catalog: /a.npz, dark_frame: "", state_dir: here}'
    params = tmp_path / 'params.yaml'
    params.write_text(f'/**:\n  ros__parameters: {values}\n')
    other = tmp_path / 'other.yaml'
    other.write_text('/**/star_observer:\n  ros__parameters: {flat_field: flat.png}\n')
    given = ['--ros-args', '--params-file', str(params), '--params-file', str(other)]
    camera = dict.fromkeys([('camera_info_url', 'camera.yaml'), ('state_dir', 'here')], tmp_path)
    assert folders_of_paths(given, '/calibrator') == camera
    flat = {('flat_field', 'flat.png'): tmp_path}
    assert folders_of_paths(given, '/star_observer') == camera | flat
    of_launch = params.rename(tmp_path / 'launch_params_x1')
    assert folders_of_paths(['--params-file', str(of_launch)], '/calibrator') == {}


def test_sections_of_others_are_no_concern(tmp_path) -> None:
    """Two cameras in one file, other packages in it, and a name that is misspelt."""
    params = tmp_path / 'params.yaml'
    sections = ('/west/calibrator', '/east/calibrator', 'star_observer', 'camera_calibrator')
    params.write_text(''.join(f'{name}:\n  ros__parameters: {{}}\n' for name in sections))
    given = ['calibrator', '--ros-args', '--params-file', str(params)]
    assert unread_sections(given, '/west/calibrator', 'calibrator') == []
    (text,) = unread_sections(given, '/west/star_observer', 'star_observer')
    assert "section 'star_observer' does not apply to /west/star_observer" in text
    assert len(unread_sections(given, '/calibrator', 'calibrator')) == 2
    params.write_text('/**/calibratr:\n  ros__parameters: {}\n')
    (text,) = unread_sections(given, '/calibrator', 'calibrator')
    assert "'/**/calibratr' does not apply" in text and text.endswith('write /**/calibrator')
