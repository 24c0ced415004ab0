# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
What stands in config/, launch/ and requirements/: complete, up to date, and read by its users.

Launch files are read by their syntax tree: launch is not on PyPI, so they cannot be run here;
`test_nodes.py` starts the same nodes with the arguments of launch_ros.  Of the Foxglove layout,
every panel is placed and shows published fields.
"""

import ast
from collections.abc import Iterator
import configparser
import importlib.util
import json
from pathlib import Path
import re
import shutil
from typing import Any

import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from starcal_tool import run  # type: ignore[import-not-found]
import yaml

from starcal_ground.bags.player_options import PlayerOptions
from starcal_ground.cli.main import main
from starcal_ground.parameter_files import read_parameter_file, read_setup
from starcal_ros.formats.products.camera_yaml import read_camera_info
from starcal_ros.options import check_value, names_of, option_fields
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES

ROOT = Path(__file__).parents[2]
CONFIG = ROOT / 'config'


def tool(name: str) -> Any:
    """A module of the folder tools, which is no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / 'tools' / f'{name}.py')
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_parameter_file_is_up_to_date_and_has_the_defaults() -> None:
    text = (CONFIG / 'starcal.yaml').read_text()
    assert text == tool('write_parameters').parameter_file()
    content = yaml.safe_load(text)
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
    is_camera = path.stem.endswith('_camera')
    camera = read_camera_info(path) if is_camera else read_setup(path).prior.camera
    assert camera.width > 0


@pytest.mark.slow
def test_the_minimal_file_has_ten_lines_and_calibrates_a_bag(few_images, tmp_path) -> None:
    """Copied beside the prior camera, as its first line instructs: parameters are all basic."""
    text = (CONFIG / 'minimal.yaml').read_text()
    assert len(text.splitlines()) == 10
    fields = option_fields(*OPTION_CLASSES, *NODE_OPTION_CLASSES)
    basic = {field.name for field in fields if field.metadata['basic']}
    shutil.copy(few_images / 'camera.yaml', tmp_path)
    params = shutil.copy(CONFIG / 'minimal.yaml', tmp_path)
    assert read_parameter_file(Path(params), ('star_observer', 'calibrator')).keys() <= basic
    line = ['calibrate', str(few_images), '--params', str(params), '--no-report']
    assert main([*line, '-o', str(tmp_path / 'out')]) == 0
    assert (tmp_path / 'out' / 'calibration.json').exists()


def test_the_recorder_and_the_aggregator_know_the_names_of_the_interface_document() -> None:
    names = (ROOT / 'docs/diagnostics.md').read_text()
    record, diagnostics = (
        yaml.safe_load((CONFIG / name).read_text())['/**']['ros__parameters']
        for name in ('record.yaml', 'diagnostics.yaml')
    )
    # With the slash at the start: rosbag2 expands no name.
    assert {*record['record']['topics']} <= published().keys()
    assert f'Its `name` is `{diagnostics["starcal"]["startswith"][0]}` and' in names


def test_every_pin_has_its_digests_which_pip_is_given(tmp_path) -> None:
    """And there are none of other versions: `tools.write_hashes` was run after the last change."""
    lines = (ROOT / 'requirements/hashes.txt').read_text().splitlines()
    hashed = [line.split() for line in lines if not line.startswith('#')]
    assert {tuple(pin.split('==')) for pin, _, _ in hashed} == tool('write_hashes').pins()
    for _, digest, file in hashed:
        assert re.fullmatch('sha256:[0-9a-f]{64}', digest), file
    make_venv, path = tool('make_venv'), tmp_path / 'some.txt'
    path.write_text('# why\nempy==3.3.4 ; python_version > "3.9"  # old\n')
    (line,) = make_venv.hashed_lines(path)
    assert line.startswith('empy==3.3.4 ; python_version > "3.9" --hash=sha256:73ac49785b6')
    path.write_text('empy==3.3.3\n')
    with pytest.raises(SystemExit, match='tools.write_hashes'):
        make_venv.hashed_lines(path)


FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
NODES = ('star_observer', 'calibrator')
# Keywords of launch_ros.actions.Node and of the process under it, on Jazzy and Kilted.
NODE_KEYWORDS = {
    *('package', 'executable', 'name', 'namespace', 'parameters', 'remappings'),
    *('ros_arguments', 'respawn', 'respawn_delay', 'output'),
}


def calls(path: Path, name: str) -> list[ast.Call]:
    found = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call))
    return [node for node in found if isinstance(node.func, ast.Name) and node.func.id == name]


def constants(node: ast.AST) -> list[Any]:
    return [one.value for one in ast.walk(node) if isinstance(one, ast.Constant)]


def declared(path: Path) -> set[str]:
    """Declared arguments of a launch file, those of the files that it includes among them."""
    own = {
        str(call.args[0].value)
        for call in calls(path, 'DeclareLaunchArgument')
        if isinstance(call.args[0], ast.Constant)
    }
    return own.union(*map(declared, included(path)))


def included(path: Path) -> list[Path]:
    words = [word for call in calls(path, 'IncludeLaunchDescription') for word in constants(call)]
    return [path.with_name(word) for word in words if str(word).endswith('.launch.py')]


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_composed_of_launch_alone(path) -> None:
    compile(path.read_text(), str(path), 'exec')
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert str(node.module).partition('.')[0] in ('launch', 'launch_ros')
        assert not isinstance(node, ast.Import)
    for call in calls(path, 'DeclareLaunchArgument'):
        assert 'description' in {keyword.arg for keyword in call.keywords}
    used = (call.args[0] for call in calls(path, 'LaunchConfiguration'))
    names = {str(argument.value) for argument in used if isinstance(argument, ast.Constant)}
    assert names <= declared(path)


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_nodes_are_those_that_are_installed(path) -> None:
    scripts = configparser.ConfigParser()
    scripts.read(ROOT / 'setup.cfg')
    installed = scripts['options.entry_points']['console_scripts']
    for call in calls(path, 'Node'):
        given = {str(keyword.arg): keyword.value for keyword in call.keywords}
        assert set(given) <= NODE_KEYWORDS
        assert constants(given['package']) == ['starcal']
        for executable in constants(given['executable']) or NODES:
            assert f'{executable} = starcal_ros.entry_points:{executable}' in installed
    assert calls(path, 'Node')


def test_parameters_are_those_of_the_nodes() -> None:
    player = ast.parse((ROOT / 'launch' / 'replay.launch.py').read_text())
    (dictionary,) = (node for node in ast.walk(player) if isinstance(node, ast.Dict))
    names = {key.value for key in dictionary.keys if isinstance(key, ast.Constant)}
    assert names and names <= names_of(PlayerOptions)
    nodes = ast.parse((ROOT / 'launch' / 'starcal.launch.py').read_text())
    (comprehension,) = (node for node in ast.walk(nodes) if isinstance(node, ast.DictComp))
    names = set(constants(comprehension.generators[0].iter))
    assert 'autostart' in names
    assert names <= {*names_of(*OPTION_CLASSES, *NODE_OPTION_CLASSES), 'use_sim_time'}
    assert names <= declared(ROOT / 'launch' / 'starcal.launch.py')


def test_topics_are_inputs_of_the_star_observer() -> None:
    tree = ast.parse((ROOT / 'launch' / 'starcal.launch.py').read_text())
    assigned = [node for node in ast.walk(tree) if isinstance(node, ast.Assign)]
    (topics,) = (node.value for node in assigned if ast.unparse(node.targets[0]) == 'TOPICS')
    source = (ROOT / 'docs' / 'nodes.md').read_text().partition('## calibrator')[0]
    for topic in constants(topics):
        assert f'| sub | `{topic}` |' in source


def test_replay_hands_on_what_starcal_takes() -> None:
    path = ROOT / 'launch' / 'replay.launch.py'
    (include,) = calls(path, 'IncludeLaunchDescription')
    (integration,) = included(path)
    assert [file.name for file in included(integration)] == ['starcal.launch.py']
    (handed,) = (node for node in ast.walk(include) if isinstance(node, ast.ListComp))
    names = set(constants(handed.generators[0].iter))
    assert 'params_file' in names
    assert names <= declared(ROOT / 'launch' / 'starcal.launch.py') & declared(path)


LAYOUT = json.loads((CONFIG / 'foxglove.json').read_text())
PANELS = LAYOUT['configById']
SCRIPTS = {name: node['sourceCode'] for name, node in LAYOUT['userNodes'].items()}
PATH = re.compile(r'(/[\w/]+)((?:\.\w+(?:\[[:\d]*\])?)*)')
# What Foxglove offers at the version that this was written for; another name is an empty panel.
KINDS = {
    'Image', 'Indicator', 'DiagnosticSummary', 'StateTransitions', 'Plot', 'RawMessages', 'Tab',
    'CallService',
}  # fmt: skip


def published() -> dict[str, str]:
    """Types of topics by name, from the table of the interface document."""
    text = (ROOT / 'docs' / 'nodes.md').read_text()
    rows = re.findall(r'^\| pub \| `([^`]+)` \| \[?(\w+)/(\w+)', text, re.MULTILINE)
    return {'/' + name.lstrip('/'): f'{package}/msg/{kind}' for name, package, kind in rows}


def paths(content: object, key: str = '') -> Iterator[str]:
    if isinstance(content, dict):
        for name, value in content.items():
            yield from paths(value, name)
    elif isinstance(content, list):
        for value in content:
            yield from paths(value, key)
    elif key in ('value', 'path', 'topicPath', 'imageTopic', 'topicToRender') and content:
        yield str(content)


def placed(layout: object) -> Iterator[str]:
    if isinstance(layout, str):
        yield layout
    else:
        assert isinstance(layout, dict)
        assert layout['direction'] in ('row', 'column')
        assert 5 <= layout['splitPercentage'] <= 95
        for side in ('first', 'second'):
            yield from placed(layout[side])


def test_every_panel_is_placed_once() -> None:
    leaves = list(placed(LAYOUT['layout']))
    for panel in PANELS.values():
        for tab in panel.get('tabs', ()):
            leaves += placed(tab['layout'])
    assert sorted(leaves) == sorted(PANELS)
    assert {name.partition('!')[0] for name in PANELS} <= KINDS


def test_scripts_read_published_topics_and_are_named_after_their_output() -> None:
    """Their outputs are shown, and the button calls a service of the calibrator."""
    shown = {PATH.match(path)[1] for path in paths(PANELS)}  # type: ignore[index]
    assert {f'/studio_script/{name}' for name in SCRIPTS} <= shown
    button = PANELS['CallService!calibrate']
    assert (button['serviceName'], button['requestPayload']) == ('/calibrator/calibrate', '{}')
    for name, source in SCRIPTS.items():
        assert f'export const output = "/studio_script/{name}";' in source
        inputs = re.findall(r'export const inputs = \[(.*?)\];', source)[0]
        assert set(re.findall(r'"([^"]+)"', inputs)) <= set(published())


NODE = shutil.which('node') or ''
# Runs a script as Foxglove does: once for each message, 64-bit integers as BigInt.
_RUN = """
import script from './script.mjs';
const message = JSON.parse(process.argv[2], (key, value) =>
  key === 'coverage' ? value.map(BigInt) : value === null ? NaN : value);
for (const event of message) var made = script(event);
console.log(JSON.stringify(made, (key, value) => ArrayBuffer.isView(value) ? [...value] : value));
"""


def without_types(source: str) -> str:
    """Return a script as JavaScript; Node 22 could do this by itself."""
    source = re.sub(r'import \{[^}]*\} from "./types";|^type .*;$', '', source, flags=re.MULTILINE)
    source = re.sub(r'new Map<[^>]*>', 'new Map', source)
    return re.sub(r'script\(\s*event: [^)]*\): [^\n]* \{$', 'script(event) {', source, flags=re.M)


def made_by(name: str, folder: Path, *events: dict[str, Any]) -> Any:
    (folder / 'script.mjs').write_text(without_types(SCRIPTS[name]))
    (folder / 'run.mjs').write_text(_RUN)
    done = run(NODE, 'run.mjs', json.dumps(events), cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.skipif(not NODE, reason='no Node on this machine')
def test_scripts_make_a_picture_and_ratios(tmp_path) -> None:
    coverage = {'coverage': [0, 1, 2, 4], 'coverage_rows': 2, 'coverage_cols': 2, 'header': {}}
    collected = {'parameter_names': ['fx', 'cx'], 'predicted_sigma': [0.5, 3.0], **coverage}
    status = {'topic': '/ensemble_status', 'message': collected}
    picture = made_by('coverage', tmp_path, status)
    assert (picture['height'], picture['width'], picture['step']) == (64, 64, 64)
    cells = [picture['data'][k] for k in (0, 32, 64 * 32, 64 * 64 - 1)]
    assert cells == [0, 64 + 48, 64 + 96, 255]
    check = {'option': 'max_x', 'found': 0.5, 'limit': 2.0}
    gate = [check, {'option': 'min_x', 'found': 8.0, 'limit': 2.0}, {**check, 'limit': None}]
    message = {'parameter_names': ['fx', 'cy'], 'covariance': [4.0, 0.0, 0.0, 1.0], 'gate': gate}
    active = {'topic': '/calibration', 'message': message}
    assert made_by('limits', tmp_path, active) == {'of_limit': [0.25, 0.25]}
    # cx was held in the active calibration: JSON writes NaN as null.
    assert made_by('sigmas', tmp_path, active, status) == {'over_active': [0.25, None]}


@pytest.mark.parametrize('path', sorted(p for p in set(paths(PANELS)) if 'studio' not in p))
def test_each_path_is_a_field_of_a_published_topic(path) -> None:
    match = PATH.fullmatch(path)
    assert match is not None
    kind = published()[match[1]]
    store = get_typestore(Stores.ROS2_JAZZY)
    for file in (ROOT / 'msg').glob('*.msg'):
        store.register(get_types_from_msg(file.read_text(), f'starcal/msg/{file.stem}'))
    fields: dict[str, Any] = dict(store.fielddefs[kind][1])
    for part in re.findall(r'\.(\w+)(\[)?', match[2]):
        assert part[0] in fields
        node, description = fields[part[0]]
        is_array = int(node) in (3, 4)  # rosbags: array, sequence
        assert is_array == bool(part[1])
        if is_array:
            node, description = description[0]
        fields = dict(store.fielddefs[description][1]) if int(node) == 2 else {}  # 2: a message
