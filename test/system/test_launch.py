# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The launch files, by their syntax tree: launch is not on PyPI, so they cannot be run here.

`test_nodes.py` starts the same nodes with the arguments of launch_ros.
"""

from __future__ import annotations

import ast
import configparser
from pathlib import Path
from typing import Any

import pytest

from starcal_ground.bags.player_options import PlayerOptions
from starcal_ros.options import names_of
from starcal_ros.pipeline.setup import NODE_OPTION_CLASSES, OPTION_CLASSES

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / 'launch').glob('*.launch.py'))
NODES = ('star_observer', 'calibrator')
# Keywords of launch_ros.actions.Node and of the process under it, on Jazzy and Kilted.
NODE_KEYWORDS = {
    *('package', 'executable', 'name', 'namespace', 'parameters', 'remappings'),
    *('ros_arguments', 'respawn', 'respawn_delay', 'output'),
}


def calls(path: Path, name: str) -> list[ast.Call]:
    """Calls of a function in a file."""
    tree = ast.parse(path.read_text())
    return [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name
    ]


def constants(node: ast.AST) -> list[Any]:
    """Constants in a part of the tree."""
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
    """Launch files that one includes."""
    words = [word for call in calls(path, 'IncludeLaunchDescription') for word in constants(call)]
    return [path.with_name(word) for word in words if str(word).endswith('.launch.py')]


def used(path: Path) -> set[str]:
    """Arguments used in a launch file."""
    found = (call.args[0] for call in calls(path, 'LaunchConfiguration'))
    return {str(argument.value) for argument in found if isinstance(argument, ast.Constant)}


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_composed_of_launch_alone(path) -> None:
    """It compiles, imports only launch and launch_ros, and describes every argument."""
    compile(path.read_text(), str(path), 'exec')
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert str(node.module).partition('.')[0] in ('launch', 'launch_ros')
        assert not isinstance(node, ast.Import)
    for call in calls(path, 'DeclareLaunchArgument'):
        assert 'description' in {keyword.arg for keyword in call.keywords}
    assert used(path) <= declared(path)


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
    (topics,) = (
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign)
        and constants(node.targets[0]) == []
        and isinstance(node.value, ast.Tuple)
        and isinstance(node.targets[0], ast.Name)
        and node.targets[0].id == 'TOPICS'
    )
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
