"""The parameter files: complete, up to date, and read by nodes and tool alike."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import pytest
import yaml

from starcal_ros.options import check_value, read_parameter_file
from starcal_ros.pipeline.node_options import NODE_OPTION_CLASSES
from starcal_ros.pipeline.setup import load_setup, OPTION_CLASSES
from starcal_ros.products.camera_yaml import read_camera_info, with_camera_url_from

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / 'config'


def test_parameter_file_is_up_to_date() -> None:
    """The file equals the output of tools/write_parameters.py."""
    path = ROOT / 'tools' / 'write_parameters.py'
    spec = importlib.util.spec_from_file_location('write_parameters', path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert (CONFIG / 'starcal.yaml').read_text() == module.parameter_file()


def test_every_parameter_stands_with_its_default() -> None:
    content = yaml.safe_load((CONFIG / 'starcal.yaml').read_text())
    sections = {name: body['ros__parameters'] for name, body in content.items()}
    listed = {name: value for body in sections.values() for name, value in body.items()}
    fields = [
        field
        for options in (*OPTION_CLASSES, *NODE_OPTION_CLASSES)
        for field in dataclasses.fields(options)
    ]
    assert sorted(listed) == sorted(field.name for field in fields)
    for field in fields:
        assert check_value(field, listed[field.name]) == field.default, field.name


@pytest.mark.parametrize(
    'path', sorted((CONFIG / 'examples').glob('*.yaml')), ids=lambda path: path.stem
)
def test_examples_load(path: Path) -> None:
    if path.stem.endswith('_camera'):
        assert read_camera_info(str(path)).width > 0
        return
    values = read_parameter_file(path, ('star_observer', 'calibrator'))
    setup = load_setup(with_camera_url_from(values, path), others=NODE_OPTION_CLASSES)
    assert setup.prior.camera.width > 0
