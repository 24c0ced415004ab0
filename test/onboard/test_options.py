# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Options: types, limits, error messages, YAML files."""

import dataclasses
from dataclasses import dataclass
import math
from pathlib import Path

import numpy as np
import pytest

from starcal_ground.bags.player_options import PlayerOptions
from starcal_ground.parameter_files import read_parameter_file, read_values
from starcal_ros.errors import OptionError
from starcal_ros.estimation.options import CalibrationOptions
from starcal_ros.options import (
    check_value,
    from_mapping,
    names_of,
    option,
    option_fields,
    parameter_sections,
    section_applies,
)
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES


@dataclass(frozen=True)
class Sample:
    """An option of each type."""

    yes: bool = option(False, 'a switch')
    count: int = option(3, 'a number of things', low=1, high=10)
    size_px: float = option(1.5, 'a size, px', low=0.5)
    free: float = option(0.0, 'any number')
    kind: str = option('a', 'one of a few', choices=('a', 'b'))
    name: str = option('', 'any text')
    axes: tuple[float, ...] = option((1.0, 2.0, 3.0), 'three numbers', low=0.0, length=3)
    parts: tuple[str, ...] = option(('u', 'v'), 'some of a few', choices=('u', 'v', 'w'))
    words: tuple[str, ...] = option(('some',), 'any texts')


@pytest.mark.parametrize(
    ('values', 'expected'),
    [
        ({}, Sample()),
        ({'yes': True}, Sample(yes=True)),
        ({'count': 10}, Sample(count=10)),
        ({'count': 7.0}, Sample(count=7)),
        ({'size_px': 2}, Sample(size_px=2.0)),
        ({'size_px': 0.5}, Sample(size_px=0.5)),
        ({'kind': 'b'}, Sample(kind='b')),
        ({'name': '/a b'}, Sample(name='/a b')),
        ({'axes': [0, 1, 2.5]}, Sample(axes=(0.0, 1.0, 2.5))),
        ({'axes': np.array([4.0, 5.0, 6.0])}, Sample(axes=(4.0, 5.0, 6.0))),
        ({'parts': ['w']}, Sample(parts=('w',))),
        ({'parts': []}, Sample(parts=())),
        ({'words': ['x', 'y']}, Sample(words=('x', 'y'))),
        ({'of_another_stage': 1}, Sample()),
    ],
)
def test_good_values(values: dict[str, object], expected: Sample) -> None:
    made = from_mapping(Sample, values)
    assert made == expected
    for field in dataclasses.fields(Sample):
        # 7.0 for a whole number becomes one, 2 for a size a float: later code need not ask.
        assert type(getattr(made, field.name)) is type(field.default)


@pytest.mark.parametrize(
    ('values', 'text'),
    [
        ({'count': None}, 'count: None is not a whole number'),
        ({'count': math.nan}, 'count: nan is not a whole number'),
        ({'size_px': 0.49}, 'size_px: 0.49 is not at least 0.5'),
        ({'size_px': [1.0]}, 'size_px: [1.0] is not a number'),
        ({'axes': 1.0}, 'axes: 1.0 is not a list, such as [1.0]'),
        ({'axes': [1.0, 2.0, -1.0]}, 'axes[2]: -1.0 is not at least 0.0'),
        ({'axes': [1.0, 2.0, math.nan]}, 'axes[2]: nan is not a finite number'),
        ({'parts': ['u', 'x']}, "parts[1]: 'x' is not one of u, v, w"),
        ({'words': [2]}, 'words[0]: 2 is not a text'),
    ],
)
def test_bad_values(values: dict[str, object], text: str) -> None:
    """Beside those that `test_record_fields` draws for each option."""
    with pytest.raises(OptionError) as refused:
        from_mapping(Sample, values)
    assert str(refused.value) == text


def test_long_values_are_refused_in_a_short_line() -> None:
    for name, value, says in (
        ('estimate', ['fx', 'fx'], 'estimate: fx is given twice'),
        ('estimate', ['fx'] * 100_000, 'estimate: 100000 values, at most 100 are read'),
        ('estimate', ['x' * 10**6], r'estimate\[0\]: .* is not a text of at most 4096'),
        ('method', 'm' * 4000, 'method: .* is not one of'),
        ('min_images', 10**5000, 'min_images: an integer of more than 60 digits is not within 64'),
        ('catalog', 'a\0b', 'catalog: a text with a NUL character'),
    ):
        (kind,) = (kind for kind in OPTION_CLASSES if name in names_of(kind))
        with pytest.raises(OptionError, match=says) as caught:
            from_mapping(kind, {name: value})
        assert len(str(caught.value)) < 300


@pytest.mark.parametrize('options_class', OPTION_CLASSES)
def test_every_default_is_a_value_that_its_own_option_takes(options_class: type) -> None:
    defaults = {f.name: f.default for f in option_fields(options_class)}
    assert from_mapping(options_class, defaults) == options_class()
    for field in option_fields(options_class):
        assert field.metadata['description'], field.name


def test_options_are_few_about_ten_are_basic_and_no_two_stages_share_a_name() -> None:
    fields = option_fields(*OPTION_CLASSES, *NODE_OPTION_CLASSES)
    # One flat file holds the options of all stages.
    assert len(names_of(*OPTION_CLASSES, *NODE_OPTION_CLASSES)) == len(fields) <= 70
    assert 8 <= sum(field.metadata['basic'] for field in fields) <= 12


def test_a_constant_that_studies_vary_is_not_a_parameter() -> None:
    constants = {'lens_prior', 'outlier_sigma', 'principal_point_prior', 'variance_components'}
    assert constants <= {field.name for field in dataclasses.fields(CalibrationOptions)}
    assert not constants & names_of(CalibrationOptions)
    given = from_mapping(CalibrationOptions, {'outlier_sigma': 3.0, 'min_images': 5})
    assert given == CalibrationOptions(min_images=5)


def parameter_file(folder: Path, text: str) -> Path:
    path = folder / 'params.yaml'
    path.write_text(text)
    return path


SECTIONS = """
/**: {ros__parameters: {a: 1, b: 1, c: 1, d: 1}}
observer: {ros__parameters: {b: 2}}
/calibrator: {ros__parameters: {c: [3, 4]}}
/**/observer: {ros__parameters: {d: text}}
somebody_else: {ros__parameters: {a: 9, e: 9}}
/space/observer: {ros__parameters: {a: 9}}
cam0: {ros__parameters: {exposure: 3}}
"""


def test_the_sections_of_the_named_nodes_and_of_all_are_read(tmp_path: Path) -> None:
    path = parameter_file(tmp_path, SECTIONS)
    values = read_parameter_file(path, ('observer', 'calibrator'))
    assert values == {'a': 1, 'b': 2, 'c': [3, 4], 'd': 'text'}
    assert read_parameter_file(path, ('nobody',)) == {'a': 1, 'b': 1, 'c': 1, 'd': 1}


def test_the_later_section_wins_as_in_ros(tmp_path: Path) -> None:
    # rclpy of Jazzy says so of this very file: a is 2, not the more specific 1.
    text = 'foo: {ros__parameters: {a: 1}}\n/**: {ros__parameters: {a: 2}}\n'
    assert read_parameter_file(parameter_file(tmp_path, text), ('foo',)) == {'a': 2}


def test_namespaces_may_enclose_a_node(tmp_path: Path) -> None:
    """As rcl reads them: a level of the file for each part of the name."""
    nodes = '{observer: {ros__parameters: {a: 1}}, "**": {calibrator: {ros__parameters: {b: 2}}}}'
    path = parameter_file(tmp_path, f'space: {nodes}')
    assert set(parameter_sections(path)) == {'space/observer', 'space/**/calibrator'}


@pytest.mark.parametrize(
    ('section', 'node', 'applies'),
    [
        ('calibrator', '/calibrator', True),
        ('calibrator', '/space/calibrator', False),
        ('/**/calibrator', '/calibrator', True),
        ('/**/calibrator', '/space/west/calibrator', True),
        ('/space/west/calibrator', '/space/west/calibrator', True),
        ('/*/calibrator', '/space/calibrator', False),  # in rcl it does
        ('/space/**', '/ground/calibrator', False),
        ('space/calibrator', '/space/calibrator', True),
        ('/**', '/space/calibrator', True),
        ('/**/observer', '/space/calibrator', False),
    ],
)
def test_sections_of_a_node(section: str, node: str, applies: bool) -> None:
    assert section_applies(section, node) is applies


@pytest.mark.parametrize('section', ['/space/calibrator', 'calibratr', 'space/calibrator'])
def test_a_section_that_nobody_reads_is_refused(tmp_path: Path, section: str) -> None:
    """It was passed over without a word, and the node kept its defaults."""
    parts = {'/**': 'a: 1', section: 'b: 2', 'camera_calibrator': 'c: 3'}
    text = ''.join(f'{part}: {{ros__parameters: {{{of}}}}}\n' for part, of in parts.items())
    path = parameter_file(tmp_path, text)
    with pytest.raises(OptionError, match=r"'.*cal.*' is not read: write /\*\*/calibrator"):
        read_parameter_file(path, ('observer', 'calibrator'))
    assert read_parameter_file(path, ('observer',)) == {'a': 1}


@pytest.mark.parametrize(
    ('text', 'says'),
    [
        ('a: [1, 2', 'not YAML'),
        ('', 'not a ROS parameter file'),
        ('- 1\n- 2\n', 'not a ROS parameter file'),
        ('foo:\n  a: 1\n', "section 'foo' has no ros__parameters"),
        ('/**:\n  ros__parameters: [1]\n', "section '/**' has no ros__parameters"),
    ],
)
def test_a_file_that_is_none(tmp_path: Path, text: str, says: str) -> None:
    path = parameter_file(tmp_path, text)
    with pytest.raises(OptionError) as refused:
        read_parameter_file(path, ('foo',))
    assert str(refused.value).startswith(f'{path}: ') and says in str(refused.value)
    assert '\n' not in str(refused.value)
    with pytest.raises(OptionError, match='none.yaml: cannot be read: No such file'):
        read_parameter_file(tmp_path / 'none.yaml', ('foo',))


PATHS = {
    'camera_info_url', 'catalog', 'dark_frame', 'flat_field', 'bad_pixel_map', 'state_dir',
    'state_key_file', 'bag',
}  # fmt: skip


def test_a_tilde_is_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`state_dir: ~/x` made a folder of the name `~` in the working folder."""
    monkeypatch.setenv('HOME', '/home/of_tests')
    fields = option_fields(*OPTION_CLASSES, *NODE_OPTION_CLASSES, PlayerOptions)
    paths = [field for field in fields if field.metadata['is_path']]
    assert {field.name for field in paths} == PATHS
    for field in paths:
        for given, expected in (
            ('~/x', '/home/of_tests/x'),
            ('~', '/home/of_tests'),
            *((path, path) for path in ('/a/~', '', 'package://a/~')),
        ):
            assert check_value(field, given) == expected
        says = f'{field.name}: .~nobody_here/x.: no home folder of ~nobody'
        with pytest.raises(OptionError, match=says):
            check_value(field, '~nobody_here/x')
    # A camera file at home is not looked for beside the parameter file.
    text = "/**: {ros__parameters: {camera_info_url: '~/camera.yaml'}}"
    camera_url = read_values(parameter_file(tmp_path, text))['camera_info_url']
    assert camera_url == '/home/of_tests/camera.yaml'
