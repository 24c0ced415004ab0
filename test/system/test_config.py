# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parameter files and pinned requirements: complete, up to date, and read by their users."""

from __future__ import annotations

from pathlib import Path
import re
import shutil

import pytest
from tool_modules import tool  # type: ignore[import-not-found]
import yaml

from starcal_ground.cli.main import main
from starcal_ground.parameter_files import read_parameter_file, read_setup
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.options import check_value, option_fields
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / 'config'


def test_parameter_file_is_up_to_date() -> None:
    """The file equals the output of tools/write_parameters.py."""
    assert (CONFIG / 'starcal.yaml').read_text() == tool('write_parameters').parameter_file()


def test_every_parameter_stands_with_its_default() -> None:
    content = yaml.safe_load((CONFIG / 'starcal.yaml').read_text())
    sections = {name: body['ros__parameters'] for name, body in content.items()}
    listed = {name: value for body in sections.values() for name, value in body.items()}
    fields = option_fields(*OPTION_CLASSES, *NODE_OPTION_CLASSES)
    assert sorted(listed) == sorted(field.name for field in fields)
    for field in fields:
        assert check_value(field, listed[field.name]) == field.default, field.name


# Packages of requirements/runtime.txt by their key in rosdep.
ROSDEP = {
    'argcomplete': 'python3-argcomplete',
    'numpy': 'python3-numpy',
    'opencv-python-headless': 'python3-opencv',
    'pyerfa': 'python3-astropy',  # which depends on python3-erfa
    'PyYAML': 'python3-yaml',
    'rich': 'python3-rich',
    'scipy': 'python3-scipy',
}
# Those of the report by their names in Ubuntu.
UBUNTU = {'Jinja2': 'python3-jinja2', 'pillow': 'python3-pil'}


def test_a_vehicle_gets_every_package() -> None:
    """Each has a key in package.xml, which the nodes and the start need, or is in the tutorial."""
    runtime = (ROOT / 'requirements/runtime.txt').read_text().partition('# What these need')[0]
    needed = {line for line in runtime.splitlines() if '==' in line}
    package = (ROOT / 'package.xml').read_text()
    assert '-pip<' not in package  # not to be released by rosdistro
    section = (ROOT / 'docs/tutorial.md').read_text().partition('Run in the vehicle')[2]
    for pin in needed - {line for line in needed if line.startswith('setuptools')}:
        name = pin.partition('==')[0]
        if name in ROSDEP:
            assert f'<exec_depend>{ROSDEP[name]}</exec_depend>' in package
        else:
            assert UBUNTU.get(name, pin) in section
            assert UBUNTU.get(name, pin) not in package


@pytest.mark.parametrize(
    'path', sorted((CONFIG / 'examples').glob('*.yaml')), ids=lambda path: path.stem
)
def test_examples_load(path) -> None:
    if path.stem.endswith('_camera'):
        assert read_camera_info(str(path)).width > 0
        return
    setup = read_setup(path)
    assert setup.prior.camera.width > 0


@pytest.mark.slow
def test_the_minimal_file_has_ten_lines_and_calibrates_a_bag(tmp_path) -> None:
    """Copied beside the prior camera, as its first line instructs: parameters are all basic."""
    text = (CONFIG / 'minimal.yaml').read_text()
    assert len(text.splitlines()) == 10
    fields = option_fields(*OPTION_CLASSES, *NODE_OPTION_CLASSES)
    basic = {field.name for field in fields if field.metadata['basic']}
    bag = ROOT / 'bags' / 'tiny'
    shutil.copy(bag / 'camera.yaml', tmp_path)
    params = shutil.copy(CONFIG / 'minimal.yaml', tmp_path)
    assert read_parameter_file(Path(params), ('star_observer', 'calibrator')).keys() <= basic
    out = str(tmp_path / 'out')
    assert main(['calibrate', str(bag), '--params', str(params), '-o', out]) == 0
    assert (tmp_path / 'out' / 'calibration.json').exists()


def test_the_recorder_and_the_aggregator_know_the_names_of_the_interface_document() -> None:
    interface, names = (
        ROOT.joinpath('docs', name).read_text() for name in ('nodes.md', 'diagnostics.md')
    )
    record, diagnostics = (
        yaml.safe_load((CONFIG / name).read_text())['/**']['ros__parameters']
        for name in ('record.yaml', 'diagnostics.yaml')
    )
    published = re.findall(r'^\| pub \| `/?([^`]+)` \|', interface, re.MULTILINE)
    assert {name.lstrip('/') for name in record['record']['topics']} <= set(published)
    assert all(name[0] == '/' for name in record['record']['topics'])  # rosbag2 expands none
    assert f'Its `name` is `{diagnostics["starcal"]["startswith"][0]}` and' in names


def test_every_pin_has_its_digests() -> None:
    """And there are none of other versions: `tools.write_hashes` was run after the last change."""
    lines = (ROOT / 'requirements/hashes.txt').read_text().splitlines()
    hashed = [line.split() for line in lines if not line.startswith('#')]
    assert {tuple(pin.split('==')) for pin, _, _ in hashed} == tool('write_hashes').pins()
    for _, digest, file in hashed:
        assert re.fullmatch('sha256:[0-9a-f]{64}', digest), file


def test_pip_is_given_the_digests(tmp_path) -> None:
    make_venv, path = tool('make_venv'), tmp_path / 'some.txt'
    path.write_text('# why\nempy==3.3.4 ; python_version > "3.9"  # old\n')
    (line,) = make_venv.hashed_lines(path)
    assert line.startswith('empy==3.3.4 ; python_version > "3.9" --hash=sha256:73ac49785b6')
    path.write_text('empy==3.3.3\n')
    with pytest.raises(SystemExit, match='tools.write_hashes'):
        make_venv.hashed_lines(path)
