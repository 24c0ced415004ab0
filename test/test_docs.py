"""The documents: their commands run, their links lead somewhere, their tables are the code's."""

from __future__ import annotations

import ast
import dataclasses
import importlib
from pathlib import Path
import re
import shlex
import subprocess
import sys
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from starcal_ros import cli, pipeline
from starcal_ros.node_options import NODE_OPTION_CLASSES, PlayerOptions
from starcal_ros.options import read_parameter_file

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted([*ROOT.glob('*.md'), *(ROOT / 'docs').glob('*.md'), *ROOT.glob('bags/*/*.md')])
OPTIONS = (*pipeline.OPTION_CLASSES, *NODE_OPTION_CLASSES, PlayerOptions)
RUN_S = 60.0


def run(*command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*map(str, command)], cwd=ROOT, capture_output=True, text=True, timeout=RUN_S
    )


def code(document: Path) -> str:
    """All that a document shows as code, fenced or indented."""
    text = document.read_text()
    fenced = re.findall(r'^```\w*\n(.*?)^```', text, re.DOTALL | re.MULTILINE)
    indented = re.findall(r'^ {4}(\S.*)$', text, re.MULTILINE)
    return '\n'.join([*fenced, *indented])


def shell_lines() -> list[str]:
    """Lines of shell in the documents, continued ones joined, comments cut."""
    text = '\n'.join(code(document) for document in DOCUMENTS).replace('\\\n', ' ')
    return sorted({' '.join(line.partition(' #')[0].split()) for line in text.splitlines()})


TOOL_LINES = [line for line in shell_lines() if re.match(r'(\.venv/bin/)?starcal [a-z]', line)]
MAKE_TARGETS = sorted(
    {
        word
        for line in shell_lines()
        if line.startswith('make ')
        for word in line.split()[1:]
        if '=' not in word
    }
)


def links(document: Path) -> list[str]:
    return re.findall(r'\]\(([^)\s]+)\)', document.read_text())


def heading_anchors(document: Path) -> set[str]:
    headings = re.findall(r'^#+ (.+)$', document.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', text).lower().replace(' ', '-') for text in headings}


def test_the_documents_are_there() -> None:
    names = {str(document.relative_to(ROOT)) for document in DOCUMENTS}
    assert names >= {
        'README.md',
        'CONTRIBUTING.md',
        'docs/icd.md',
        'docs/algorithm.md',
        'docs/design.md',
        'docs/performance.md',
        'bags/tiny/README.md',
    }


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    for link in links(document):
        if link.startswith('https://'):
            continue
        name, _, anchor = link.partition('#')
        target = document.parent / name if name else document
        assert target.exists(), link
        assert not anchor or anchor in heading_anchors(target), link


def test_pictures_show_something() -> None:
    shown = {link for document in DOCUMENTS for link in links(document) if link.endswith('.png')}
    there = {str(path.relative_to(ROOT)) for path in (ROOT / 'docs' / 'images').glob('*.png')}
    assert shown == there
    for name in there:
        picture = cv2.imread(str(ROOT / name))
        assert picture is not None and min(picture.shape[:2]) >= 300, name
        assert np.ptp(picture) > 200, name


def test_tables_are_as_the_code_has_them() -> None:
    checked = run(sys.executable, '-m', 'docs.make_tables', '--check')
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_every_parameter_is_in_the_interface_document_and_none_else() -> None:
    text = (ROOT / 'docs' / 'icd.md').read_text()
    rows = re.findall(r'^\| `(\w+)` \| `[^|]*` \|', text, re.MULTILINE)
    assert sorted(rows) == sorted(f.name for cls in OPTIONS for f in dataclasses.fields(cls))


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_named_functions_exist(document: Path) -> None:
    modules = {path.stem for path in (ROOT / 'starcal_ros').glob('*.py')}
    for module, name in re.findall(r'`(\w+)\.(\w+)`', document.read_text()):
        if module in modules and name not in (
            'py',
            'json',
            'yaml',
            'npz',
            'html',
        ):  # those are files
            assert hasattr(importlib.import_module(f'starcal_ros.{module}'), name), name


def test_topics_and_services_are_names_that_the_nodes_use() -> None:
    text = (ROOT / 'docs' / 'icd.md').read_text()
    documented = re.findall(r'^\| (?:sub|pub|srv) \| `([^`]+)` \|', text, re.MULTILINE)
    assert len(documented) >= 15
    nodes = (ROOT / 'starcal_ros' / 'nodes').glob('*.py')
    constants = {
        node.value
        for path in nodes
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    for name in documented:
        base = name.removesuffix('/compressed')
        assert name in constants or {base, '/compressed'} <= constants, name


def test_the_tool_is_called_as_it_can_be() -> None:
    """Every subcommand and option that a document shows is one that the tool has."""
    assert len(TOOL_LINES) >= 3
    for line in TOOL_LINES:
        _, command, *rest = shlex.split(line)
        told = run(sys.executable, '-m', 'starcal_ros.cli', command, '--help')
        assert told.returncode == 0, line
        for word in rest:
            assert not word.startswith('-') or word in told.stdout, line


def test_subcommands_in_the_interface_document_are_those_of_the_tool() -> None:
    text = (ROOT / 'docs' / 'icd.md').read_text()
    documented = set(re.findall(r'^\| `starcal (\w+)', text, re.MULTILINE))
    assert documented == set(cli._COMMANDS)


def test_the_calibration_of_the_readme_runs(tmp_path: Path) -> None:
    (line,) = (line for line in TOOL_LINES if line.startswith('.venv') and ' bags/tiny ' in line)
    words = shlex.split(line)
    assert words[-2:] == ['-o', 'out']
    done = run(sys.executable, '-m', 'starcal_ros.cli', *words[1:-1], tmp_path / 'out')
    assert done.returncode == 0, done.stderr
    for name in ('calibration.json', 'camera_info.yaml', 'observations.mcap', 'report.html'):
        assert (tmp_path / 'out' / name).is_file()


def test_the_parameter_file_of_the_readme_is_one(tmp_path: Path) -> None:
    (text,) = re.findall(r'^```yaml\n(.*?)^```', (ROOT / 'README.md').read_text(), re.S | re.M)
    params = tmp_path / 'params.yaml'
    params.write_text(text)
    values = read_parameter_file(params, ('star_observer', 'calibrator'))
    assert values['camera_info_url'] == 'camera.yaml'
    camera = ROOT / 'bags' / 'tiny' / 'camera.yaml'
    setup = pipeline.load_setup({**values, 'camera_info_url': str(camera)}, OPTIONS)
    assert setup.prior.camera.width > 0


@pytest.mark.parametrize('target', MAKE_TARGETS)
def test_make_knows_the_target(target: str) -> None:
    assert run('make', '--dry-run', target).returncode == 0


def test_scripts_that_are_named_exist() -> None:
    lines = [line for line in shell_lines() if line.startswith('.venv/bin/python -m ')]
    assert lines
    for line in lines:
        module = shlex.split(line)[2]
        assert (ROOT / (module.replace('.', '/') + '.py')).is_file(), line


def test_the_launch_file_has_the_arguments_that_the_readme_gives() -> None:
    (line,) = (line for line in shell_lines() if line.startswith('ros2 launch '))
    _, _, package, name, *arguments = line.split()
    assert package == 'starcal'
    source = (ROOT / 'launch' / name).read_text()
    for argument in arguments:
        assert f"'{argument.partition(':=')[0]}'" in source


def test_versions_to_install_are_the_pinned_ones() -> None:
    (line,) = (line for line in shell_lines() if line.startswith('pip install '))
    pinned = (ROOT / 'requirements' / 'runtime.txt').read_text().splitlines()
    assert line.split()[2:]
    assert set(line.split()[2:]) <= set(pinned)


def test_the_version_of_the_figures_is_that_of_the_package() -> None:
    version = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert f'version {version}' in (ROOT / 'docs' / 'performance.md').read_text()
