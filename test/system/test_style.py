# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Rules of CONTRIBUTING.md that ruff and mypy do not check; which tests `make check` runs."""

import ast
from pathlib import Path
import re
from xml.etree import ElementTree

import pytest

from tools.tests_of_change import nearest_tests

ROOT = Path(__file__).parents[2]
PACKAGES = ('starcal_ros', 'starcal_ground', 'studies')
MODULES = {path.stem for folder in PACKAGES for path in (ROOT / folder).rglob('*.py')}
FILES = sorted(
    path for folder in (*PACKAGES, 'bench', 'tools', 'docs', 'examples')
    for path in (ROOT / folder).rglob('*.py')
)  # fmt: skip
EVERY_FILE = [*FILES, *(ROOT / 'launch').rglob('*.py'), *(ROOT / 'test').rglob('*.py')]
LICENCE = '# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0'
# Without its docstring; no longer than the longest of today: a new one must earn more.
LONGEST_FUNCTION_LINES = 77
SUBJECTS = {  # tests of several modules together
    *('awkward_frames', 'diagnostics', 'icd_client', 'kills', 'lens_models', 'motion'),
    *('nodes', 'object_store', 'onboard_alone', 'set_up_mistakes', 'star_trackers', 'trend'),
    'worlds',
}


def test_tests_have_the_names_of_their_modules() -> None:
    names = {path.stem.removeprefix('test_'): path for path in (ROOT / 'test').rglob('test_*.py')
             if path.parent.name != 'system'}  # fmt: skip
    strange = {
        str(path.relative_to(ROOT)) for name, path in names.items()
        if name not in MODULES | SUBJECTS
        and not name.startswith(('against_', 'hostile_', *(f'{module}_' for module in MODULES)))
    }  # fmt: skip
    assert strange == set()


def test_tests_with_nodes_are_where_make_looks_for_them() -> None:
    """``make test`` collects the tests marked ``nodes`` in two folders only."""
    marked = [path for path in (ROOT / 'test').rglob('test_*.py')
              if 'pytest.mark.nodes' in path.read_text()]  # fmt: skip
    assert {path.relative_to(ROOT / 'test').parts[0] for path in marked} == {'nodes', 'system'}


def test_docstrings_state_a_result_and_functions_are_short() -> None:
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    texts, long = [], []
    for path in FILES:
        nodes = list(ast.walk(ast.parse(path.read_text())))
        texts += [ast.get_docstring(node) or '' for node in nodes if isinstance(node, documented)]
        for node in nodes:
            if isinstance(node, ast.FunctionDef):
                code = node.body[ast.get_docstring(node) is not None :] or node.body
                lines = (node.end_lineno or 0) - code[0].lineno + 1
                long += [f'{path}: {node.name}'] if lines > LONGEST_FUNCTION_LINES else []
    assert [text for text in texts if re.match(r'(What|Whether|Of)\b', text)] == []
    assert long == []


def test_no_folder_of_one_machine_is_named() -> None:
    """Files from elsewhere are looked for beside this repository, in ``../shared``."""
    folders = {
        name for path in EVERY_FILE for name in re.findall(r"Path\('(/\w+)", path.read_text())
    }
    assert folders <= {'/dev', '/proc', '/usr'}


def test_each_file_names_the_holder_and_the_licence_of_the_package() -> None:
    package = ElementTree.parse(ROOT / 'package.xml')
    assert f'Copyright 2026 {package.findtext("maintainer")}.' in LICENCE
    assert LICENCE.endswith(f': {package.findtext("license")}')
    lacking = [
        path.relative_to(ROOT)
        for path in EVERY_FILE
        if '_build' not in path.parts and path.read_text().partition('\n')[0] != LICENCE
    ]
    assert len(EVERY_FILE) > 200
    assert not lacking, f'put {LICENCE!r} on the first line of {lacking}'


@pytest.mark.slow
@pytest.mark.parametrize(
    ('changed', 'nearest'),
    [
        ('starcal_ros/estimation/weights.py', 'test/onboard/estimation/test_weights.py'),
        ('starcal_ros/errors.py', 'test/onboard/test_errors.py'),  # imported by 69 test files
        # Imported by no test, but by the package that the tests import.
        ('starcal_ros/records/calibration.py', 'test/onboard/records/test_observations.py'),
        # Loaded by name.
        ('starcal_ground/cli/commands/plan.py', 'test/ground/planning/test_plan.py'),
        ('test/flight.py', 'test/nodes/test_hostile_messages.py'),  # a helper of tests
        ('test/onboard/test_text.py', 'test/onboard/test_text.py'),
    ],
)
def test_the_tests_of_a_changed_file_are_few_and_about_it(changed, nearest, monkeypatch):
    monkeypatch.chdir(ROOT)
    tests = nearest_tests([Path(changed)])
    assert Path(nearest) in tests
    assert len(tests) < 20, tests  # of more than 200 files


@pytest.mark.slow
def test_documents_and_files_that_are_gone_have_no_tests(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert nearest_tests([Path('README.md'), Path('test/test_gone.py')]) == []
