# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Every file, function, option, message and test that a document names exists."""

import ast
import builtins
import functools
import importlib
import importlib.util
import inspect
from pathlib import Path
import pkgutil
import re
import shlex

import pytest

from bench import LONG, NAMES
import starcal_ground
import starcal_ros
import studies as studies_package
from studies import __main__ as studies

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = sorted(
    [
        *(ROOT / name for name in ('README.md', 'CONTRIBUTING.md', 'QUALITY_DECLARATION.md')),
        *(ROOT / 'docs').glob('*.md'),
        *(ROOT / 'bags').glob('tiny/*.md'),
        ROOT / 'bench' / 'README.md',
    ]
)
MODULES = [
    module.name
    for package in (starcal_ros, starcal_ground, studies_package)
    for module in pkgutil.walk_packages(package.__path__, f'{package.__name__}.')
]
OF_PACKAGES = [
    path for package in ('starcal_ros', 'starcal_ground')
    for path in sorted((ROOT / package).rglob('*.py'))
]  # fmt: skip
# Composed by the code, of other packages of ROS, or of the tools whose users read coming_from.md.
ELSEWHERE = {
    *('malloc_trim', 'refused_overrun', 'star_tracker_2_x', 'camera_calibration'),
    *('foxglove_bridge', 'Calibration.id_stars', 'estimate_geometric_calibration'),
    'estimate_attitude',
    *('estimate_static_alignment', 'estimate_temperature_dependent_alignment'),
    *('kalibr_calibrate_imu_camera', 'camchain.yaml', 'timeshift_cam_imu', 'target.yaml'),
    *('report.pdf', 'ros_base', '--velocity-topic T'),
    *('--scale-low', '--scale-high'),
}
# Hypothetical files of a user, and modules that were rejected.
NOT_OURS = {'rotation.py', 'env.sh', 'STUDY.json', '00000012.mcap'}
SUFFIXES = (
    *('bc', 'cameramodel', 'csv', 'html', 'json', 'mcap', 'md', 'npz', 'parquet', 'pdf', 'png'),
    *('sh', 'sqlite', 'tf', 'ti', 'toml', 'txt', 'xml', 'yaml'),
)
FOLDERS = (
    'bench|config|docs|examples|launch|requirements|starcal_ground|starcal_ros|studies|test|tools'
)
TOOLS_LEAVE = {'__pycache__', '_build', '.coverage'}
ROLE = re.compile(r'(?<!`)`([^`\n]+(?:\n[^`\n]+)?)`(?!`)')  # in a docstring: one backtick
NAME = re.compile(r'(?:\w+/)*[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+')


def spans(document: Path) -> list[str]:
    """Code spans of a document, those of its fences left out."""
    text = re.sub(r'^```.*?^```', '', document.read_text(), flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r'^( {4}|\$\$).*$', '', text, flags=re.MULTILINE)
    # In a span a line may be broken, a paragraph not.
    return [' '.join(span.split()) for span in re.findall(r'`((?:[^`\n]|\n(?!\n))+)`', text)]


@functools.cache
def files() -> tuple[str, ...]:
    """Files of the tree, which may be a source archive; those that tools leave in it are none."""
    folders = (*FOLDERS.split('|'), '.ci', 'bags/tiny', 'debian', 'msg', 'srv')
    paths = [*ROOT.iterdir(), *(path for name in folders for path in (ROOT / name).rglob('*'))]
    names = (path.relative_to(ROOT) for path in paths if path.is_file())
    return tuple(str(name) for name in names if not TOOLS_LEAVE & {*name.parts})


@functools.cache
def source() -> str:
    """Text of all files of the tree that are no documents, and their names."""
    kinds = ('.py', '.msg', '.srv', '.yaml', '.cfg', '.toml', '.xml', '.txt', '.json', '.html')
    texts = [
        (ROOT / name).read_text()
        for name in files()
        if Path(name).suffix in (*kinds, '.c', '.h', '') and ROOT / name != Path(__file__)
    ]
    return '\n'.join([*texts, *(f'/{name}' for name in files())])


@functools.cache
def words() -> frozenset[str]:
    return frozenset(re.findall(r'\w+', source()))


def resolves(name: str) -> bool:
    """True for ``[room/]module[.class].attribute``, or a name of another package."""
    path = re.sub(r'^starcal_(ros|ground)\.', '', name.replace('/', '.')).split('.')
    is_ours = False
    for count in range(len(path), 0, -1):
        tail = '.' + '.'.join(path[:count])
        for module in filter(lambda module: module.endswith(tail), MODULES):
            is_ours = True
            if has(importlib.import_module(module), path[count:]):
                return True
    # A field of a record or a message is cited by the names of both.
    return not is_ours and (
        importlib.util.find_spec(path[0]) is not None or all(part in words() for part in path)
    )


def has(owner: object, attributes: list[str]) -> bool:
    """True if an object has attributes of each other; the last may be a field of a record."""
    for attribute in attributes:
        if attribute in getattr(owner, '__dataclass_fields__', ()):
            return attribute == attributes[-1]
        if not hasattr(owner, attribute):
            return False
        owner = getattr(owner, attribute)
    return True


def test_each_symbol_of_the_algorithm_has_a_name_in_the_code() -> None:
    """The last column: functions and fields that exist, and names in the modules of these."""
    table = (ROOT / 'docs' / 'algorithm.md').read_text().split('## Notation')[1].split('\n## ')[0]
    cells = [line.rsplit('|', 2)[1] for line in table.splitlines() if line.startswith('| ')]
    for cell in cells[1:]:
        names = re.findall('`([^`]+)`', cell)
        dotted = {name.split('.')[0] for name in names if '.' in name}
        modules = [name for name in MODULES if name.rpartition('.')[2] in dotted]
        text = '\n'.join(inspect.getsource(importlib.import_module(name)) for name in modules)
        assert dotted and all(map(exists, names)), cell
        assert {name for name in names if '.' not in name} <= {*re.findall(r'\w+', text)}, cell


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_document_names_exists(document) -> None:
    assert [span for span in spans(document) if not exists(span)] == []


def exists(span: str) -> bool:
    """True if everything in a code span that looks like a name of the project is one."""
    if span in ELSEWHERE or span.rpartition('/')[2] in NOT_OURS:
        return True
    files = re.findall(rf'(?<![\w/.~-])(?:{FOLDERS})/[\w./-]*\w', span)
    options = re.findall(r'(?<!\S)--[a-z][a-z-]+', span)
    keys = re.findall(r'"(\w+)"', span) if span.startswith('{') else []
    return (
        all((ROOT / name).exists() for name in files)
        and all(option in source() for option in options)
        and all(key in words() for key in keys)
        and (not re.fullmatch(r'[a-z]\w*_\w+', span) or span in words())
        and (not re.fullmatch(r"[a-z][a-z']*( [a-z']+)+", span) or is_text(span))
        and (not NAME.fullmatch(span.removesuffix('()')) or is_name(span.removesuffix('()')))
        and (not re.match(r'(python -m )?bench \w', span) or is_bench(span))
        and (not span.startswith('pytest test') or are_tests(span))
    )


def is_text(span: str) -> bool:
    return span.split()[0] in ('starcal', 'make', 'bench', 'ros2', 'pip') or span in source()


def is_name(name: str) -> bool:
    """True for a file, or a name in a module."""
    if name.endswith('.py'):
        return f'/{name}\n' in source() + '\n'
    if name.rpartition('.')[2] in SUFFIXES:
        return re.sub(r'\d{8}', '', name.rpartition('/')[2]) in source()
    return resolves(name)


def is_bench(span: str) -> bool:
    return span.removeprefix('python -m ').split()[1] in (*NAMES, *LONG, 'NAME')


def are_tests(span: str) -> bool:
    """True if the files of a pytest command hold a test that its -k matches."""
    arguments = shlex.split(span)[1:]
    name = arguments[arguments.index('-k') + 1] if '-k' in arguments else ''
    files = [ROOT / word for word in arguments if word.startswith('test/')]
    found = [re.findall(r'def (test_\w+)', file.read_text()) for file in files if file.is_file()]
    return len(found) == len(files) and any(name in test for tests in found for test in tests)


@pytest.mark.slow
def test_what_a_docstring_names_exists() -> None:
    strange = []
    for path in OF_PACKAGES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                text = ast.get_docstring(node) or ''
                names = (' '.join(name.split()) for name in ROLE.findall(text))
                strange += [(path.name, name) for name in names if not is_in_code(name)]
    assert strange == []


def is_in_code(name: str) -> bool:
    """True if what a docstring names exists, and not in docstrings alone."""
    is_own = name.isidentifier() and not name.startswith(('__', 'starcal'))  # the tool; C
    return exists(name) and (not is_own or name in identifiers())


@functools.cache
def identifiers() -> frozenset[str]:
    """Names in the code of the package: of modules, definitions, arguments, and attributes."""
    names: set[object] = {part for module in MODULES for part in module.split('.')}
    names |= vars(builtins).keys()
    for path in OF_PACKAGES:
        for node in ast.walk(ast.parse(path.read_text())):
            names |= {getattr(node, field, None) for field in ('name', 'arg', 'id', 'attr')}
    return frozenset(name for name in names if isinstance(name, str))


@pytest.mark.parametrize(
    'span',
    [
        *('estimation/calibrate.no_such', 'equations.Equations.no_such'),
        *('docs/no_such.md', 'no_such_option', '--no-such'),
        *('pytest test/onboard/test_api.py -k no_such', 'bench no_such', 'no such message'),
        'no_such.py',
    ],
)
def test_a_name_that_does_not_exist_is_found(span) -> None:
    """The test above could fail."""
    assert not exists(span)


def test_a_docstring_names_no_function_of_docstrings_alone() -> None:
    assert is_in_code('line_of_sight_table') and not is_in_code('line_of_sight_jacobian')


def test_lines_that_run_a_module_of_python_exist() -> None:
    """In indented blocks too: modules, files of tests, names of benches, options of studies."""
    for document in DOCUMENTS:
        for line in re.findall(r'python3? -m ([\w.]+) ?([^\n#`]*)', document.read_text()):
            if line[0] not in ('bench', 'pytest', 'studies'):
                assert importlib.util.find_spec(line[0]), line
            elif line[0] == 'bench':
                name = line[1].split()[:1]
                assert not name or name[0].startswith('-') or is_bench(f'bench {name[0]}')
            elif line[0] == 'studies' and line[1]:
                studies.parser().parse_args(shlex.split(line[1].replace('STUDY', 'table1')))
            else:
                words_of = [word for word in line[1].split() if word.startswith('test/')]
                assert all((ROOT / word).exists() for word in words_of), line
