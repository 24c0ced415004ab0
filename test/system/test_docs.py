# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The documents: commands run, links resolve, tables match the code."""

import ast
import dataclasses
import itertools
from pathlib import Path
import re
import shlex
import shutil
from xml.etree import ElementTree

import cv2
import numpy as np
from PIL import Image
import pytest
from starcal_tool import run, run_python  # type: ignore[import-not-found]

from starcal_ground.bags.player_options import PlayerOptions
from starcal_ground.cli import main
from starcal_ground.cli.commands import demo
from starcal_ground.cli.main import parser
from starcal_ground.comparison import compare, truth_like
from starcal_ground.parameter_files import read_parameter_file
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.options import names_of
from starcal_ros.pipeline.setup import load_setup, NODE_OPTION_CLASSES, OPTION_CLASSES

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = sorted([*ROOT.glob('*.md'), *(ROOT / 'docs').glob('*.md'), *ROOT.glob('bags/*/*.md')])
OPTIONS = (*OPTION_CLASSES, *NODE_OPTION_CLASSES, PlayerOptions)


@dataclasses.dataclass(frozen=True)
class Line:
    """A shell line in a document; ``runs``: executed here, not only parsed."""

    document: Path
    words: tuple[str, ...]
    runs: bool


FENCE = re.compile(r'(<!-- not run: [^\n]+ -->\n+)?^```(\w*)\n(.*?)^```', re.DOTALL | re.MULTILINE)
# A command indented by four: the older documents have such.
INDENTED = re.compile(r'^ {4}((?:starcal|make|ros2|\.venv/bin/\S+) [a-z\-].*)$', re.MULTILINE)


def shell_lines(document: Path) -> list[Line]:
    """Lines of shell in a document, continued ones joined, comments cut."""
    text = document.read_text()
    blocks = [
        (body, not marked) for marked, kind, body in FENCE.findall(text) if kind in ('sh', 'bash')
    ]
    blocks += [(line, False) for line in INDENTED.findall(FENCE.sub('', text))]
    return [
        Line(document, tuple(words), runs)
        for body, runs in blocks
        for line in body.replace('\\\n', ' ').splitlines()
        if (words := shlex.split(line, comments=True))
    ]


LINES = [line for document in DOCUMENTS for line in shell_lines(document)]


def lines_of(command: str) -> list[Line]:
    return [line for line in LINES if Path(line.words[0]).name == command]


def pip_lines() -> list[Line]:
    """Lines that call pip, by its name or as a module of Python; their words from pip on."""
    called = [dataclasses.replace(line, words=line.words[2:]) for line in lines_of('python3')
              if line.words[1:3] == ('-m', 'pip')]  # fmt: skip
    return lines_of('pip') + called


TOOL_LINES = lines_of('starcal')
MAKE_TARGETS = sorted(
    {word for line in lines_of('make') for word in line.words[1:] if '=' not in word}
)
# What the documents call besides, on the reader's machine: nothing of ours to hold it against.
OTHERS = {
    *('git', 'cd', 'rosdep', 'colcon', '.', 'eval', 'apt', 'sudo', 'xdg-open', 'export'),
    *('kill', 'sqlite3', 'chromium'),
}


def links(document: Path) -> list[str]:
    return re.findall(r'\]\(([^)\s]+)\)', document.read_text())


def heading_anchors(document: Path) -> set[str]:
    headings = re.findall(r'^#+ (.+)$', document.read_text(), re.MULTILINE)
    return {re.sub(r'[^\w\- ]', '', text).lower().replace(' ', '-') for text in headings}


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document) -> None:
    for link in links(document):
        if link.startswith('https://'):
            continue
        name, _, anchor = link.partition('#')
        target = document.parent / name if name else document
        assert target.exists(), link
        assert not anchor or anchor in heading_anchors(target), link


def test_the_front_page_begins_with_a_command_that_the_tool_takes() -> None:
    text = (ROOT / 'docs/index.rst').read_text()
    (line,) = re.findall(r'^   \.venv/bin/starcal (.*)$', text, re.MULTILINE)
    words = shlex.split(line)
    assert parser(words).parse_args(words).command == 'calibrate'
    assert text.index('.venv/bin/pip install .') < text.index(line)


def test_equations_are_set_without_a_network() -> None:
    """As MathML, which holds no command of TeX and no mark of a column."""
    pytest.importorskip('latex2mathml')  # `make docs` brings it
    from docs.conf import mathml

    equations = [
        equation
        for document in DOCUMENTS
        for equation in re.findall(
            r'^ *\$\$\n(.*?)^ *\$\$', document.read_text(), re.DOTALL | re.MULTILINE
        )
    ]
    assert len(equations) > 10
    for equation in equations:
        words = ''.join(ElementTree.fromstring(mathml(equation, is_block=True)).itertext())
        assert words and not set(words) & set('\\\\&'), equation


def test_pictures_show_something() -> None:
    shown = {
        str((document.parent / link).resolve().relative_to(ROOT))
        for document in DOCUMENTS
        for link in links(document)
        if link.endswith(('.png', '.svg'))
    }
    there = {str(path.relative_to(ROOT)) for path in (ROOT / 'docs' / 'images').iterdir()}
    assert shown == there
    for name in there:
        if name.endswith('.svg'):
            assert '<path' in (ROOT / name).read_text(), name
            continue
        picture = cv2.imread(str(ROOT / name))
        assert picture is not None and min(picture.shape[:2]) >= 300, name
        assert np.ptp(picture) > 200, name


def test_tables_are_as_the_code_has_them() -> None:
    checked = run_python('-m', 'docs.make_tables', '--check', cwd=ROOT)
    assert checked.returncode == 0, checked.stdout + checked.stderr


def test_topics_and_services_are_names_that_the_nodes_use() -> None:
    text = (ROOT / 'docs' / 'nodes.md').read_text()
    documented = re.findall(r'^\| (?:sub|pub|srv) \| `([^`]+)` \|', text, re.MULTILINE)
    assert len(documented) >= 15
    rooms = (ROOT / 'starcal_ros' / 'ros', ROOT / 'starcal_ground' / 'ros')
    nodes = [path for room in rooms for path in room.glob('*.py')]
    constants = {
        node.value
        for path in nodes
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    for name in documented:
        name = name.removeprefix('<frame>')  # of a star tracker, from a parameter
        base = name.removesuffix('/compressed')
        assert name in constants or {base, '/compressed'} <= constants, name


def test_no_command_is_unknown_and_no_subcommand_undocumented() -> None:
    known = {'starcal', 'make', 'ros2', 'pip', 'python', 'python3', *OTHERS}
    for line in LINES:
        assert (Path(line.words[0]).name or line.words[0]) in known, line
    text = (ROOT / 'docs' / 'commands.md').read_text()
    assert {*re.findall(r'^\| `starcal (\w+)', text, re.MULTILINE)} == {*main.COMMANDS}


@pytest.mark.parametrize('line', TOOL_LINES, ids=lambda line: ' '.join(line.words)[:60])
def test_the_tool_takes_the_line(line) -> None:
    words = [re.sub(r'^[NMS]$', '1', word) for word in line.words]  # a number to be given
    args = parser().parse_args(words[1:])  # ends the test where it does not understand
    assert args.command in main.COMMANDS


PRODUCTS = ('calibration.json', 'camera_info.yaml', 'observations.mcap', 'report.html')
RUNNING = sorted({line.document for line in TOOL_LINES if line.runs})


@pytest.mark.packaging
@pytest.mark.slow
@pytest.mark.parametrize('document', RUNNING, ids=lambda path: path.name)
def test_the_commands_of_a_document_run(document, tmp_path, monkeypatch) -> None:
    shutil.copytree(ROOT / 'bags' / 'tiny', tmp_path / 'bags' / 'tiny')
    monkeypatch.chdir(tmp_path)
    for line in TOOL_LINES:
        if line.document == document and line.runs:
            assert main.main(line.words[1:]) == 0, line.words
            options = dict(itertools.pairwise(line.words))
            if '-o' in options:
                assert (tmp_path / options['-o']).exists(), line.words
            if line.words[1] == 'calibrate':
                for name in PRODUCTS:
                    assert (tmp_path / options['-o'] / name).is_file(), line.words


PARAMETER_BLOCKS = [
    (document, text)
    for document in DOCUMENTS
    for _, kind, text in FENCE.findall(document.read_text())
    if kind == 'yaml' and 'ros__parameters' in text
]


@pytest.mark.parametrize(
    ('document', 'text'), PARAMETER_BLOCKS, ids=[path.name for path, _ in PARAMETER_BLOCKS]
)
def test_a_parameter_file_of_a_document_is_one(document, text, tmp_path) -> None:
    params = tmp_path / 'params.yaml'
    params.write_text(text)
    values = read_parameter_file(params, ('star_observer', 'calibrator'))
    camera = ROOT / 'bags' / 'tiny' / 'camera.yaml'
    setup = load_setup({**values, 'camera_info_url': str(camera)})
    assert setup.prior.camera.width > 0


PROGRAMS = [
    (document, text, not marked)
    for document in DOCUMENTS
    for marked, kind, text in FENCE.findall(document.read_text())
    if kind == 'python'
]


@pytest.mark.parametrize(
    ('document', 'text', 'runs'), PROGRAMS, ids=[document.name for document, *_ in PROGRAMS]
)
def test_a_program_of_a_document_runs(
    document, text, runs, tiny_products, tmp_path, monkeypatch
) -> None:
    """With the small campaign in place of the paper's; of a marked one the imports alone."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    (tmp_path / 'DIR').symlink_to(tiny_products)
    program = ast.parse(text.replace("scenario('paper')", "scenario('tiny')"))
    if not runs:
        imports = [n for n in program.body if isinstance(n, (ast.Import, ast.ImportFrom))]
        for one in imports:
            # Programs of other projects need not be here; a wrong name of ours is not skipped.
            name = one.module if isinstance(one, ast.ImportFrom) else one.names[0].name
            package = str(name).partition('.')[0]
            if package not in ('bench', 'docs', 'starcal_ground', 'starcal_ros'):
                pytest.importorskip(package)
        program.body = list(imports)
    exec(compile(program, document.name, 'exec'), {})


def test_the_demo_lines_of_the_tutorial_are_those_of_the_demo(tiny, tiny_products) -> None:
    """Estimates within a tenth of their sigma, sigmas within 2 %."""
    bag = demo.tiny_bag(tiny_products)
    made = compare(tiny, truth_like(tiny, bag.truth))
    places = {name.replace('_', ' '): k for k, name in enumerate(tiny.parameter_names)}
    shown = re.findall(
        r'^    (fx|k1|p1|alignment x) (.*)$', (ROOT / 'docs/tutorial.md').read_text(), re.MULTILINE
    )
    assert len(shown) == 4
    for name, text in shown:
        *values, off, sigma, sigmas = numbers(text)
        k, unit = places[name], 1.0 if values else ARCSECOND_RAD
        for value, geometry in zip(values, (tiny.geometry, bag.truth), strict=False):
            assert abs(value - geometry.camera.parameters[k]) < 0.1 * sigma, name
        assert abs(off - made.difference[k] / unit) < 0.1 * sigma, name
        assert sigma == pytest.approx(made.sigma[k] / unit, rel=0.02), name
        assert sigmas == pytest.approx(made.sigmas[k], abs=0.1), name


def test_the_picture_of_the_report_is_of_todays_calibration(tiny) -> None:
    """Redraw it with ``python -m docs.make_images``."""
    with Image.open(ROOT / 'docs' / 'images' / 'report.png') as picture:
        drawn = dict(part.split('=') for part in picture.info['Description'].split('; '))
    for k, name in enumerate(tiny.geometry.camera.parameter_names):
        apart = abs(float(drawn[name]) - tiny.geometry.camera.parameters[k])
        assert apart < 0.1 * tiny.sigma[k], name
    assert abs(float(drawn['residual_rms_px']) - tiny.residual_rms_px) < 1e-3


def numbers(line: str) -> list[float]:
    return [float(n) for n in re.findall(r'(?<!\w)[-+]?[\d.]+(?:e[-+]?\d+)?', line)]


@pytest.mark.parametrize('target', MAKE_TARGETS)
def test_make_knows_the_target(target) -> None:
    assert run('make', '--dry-run', target, cwd=ROOT).returncode == 0


def interface(directions: str) -> dict[str, str]:
    """Types of topics or services by name, from the tables of the interface document."""
    text = (ROOT / 'docs' / 'nodes.md').read_text()
    rows = re.findall(rf'^\| (?:{directions}) \| `([^`]+)` \| \[?(\w+/\w+)', text, re.MULTILINE)
    return dict(rows)


TOPICS = {name.lstrip('/') for name in interface('sub|pub')}


def check_ros_arguments(words: tuple[str, ...]) -> None:
    names = names_of(*OPTIONS)
    for before, word in itertools.pairwise(words):
        name = word.partition(':=')[0]
        if before in ('-r', '--remap'):
            assert name.lstrip('/') in TOPICS or name.startswith('__'), words
        if before in ('-p', '--param'):
            assert name in names, words


@pytest.mark.parametrize('line', lines_of('ros2'), ids=lambda line: ' '.join(line.words)[:60])
def test_what_a_ros2_line_names_is_there(line) -> None:
    _, verb, *rest = line.words
    if verb == 'launch' and rest[0] == 'starcal':
        # The launch file of the flight nodes declares the arguments of those that include it.
        files = {rest[1], 'starcal.launch.py'}
        source = ''.join((ROOT / 'launch' / name).read_text() for name in files)
        for argument in rest[2:]:
            assert f"'{argument.partition(':=')[0]}'" in source
    elif verb == 'run' and rest[0] == 'starcal':
        scripts = (ROOT / 'setup.cfg').read_text()
        assert re.search(rf'(?m)^ {{4}}{rest[1]} = starcal_(?:ros|ground)', scripts)
        if rest[1] == 'starcal':
            parser().parse_args(rest[2:])
        check_ros_arguments(tuple(rest))
    elif verb == 'service':
        assert rest[0] == 'call'
        *_, node, service = rest[1].split('/')  # a namespace may precede them
        services = interface('srv')
        kind = services[f'~/{service}']
        assert node == 'calibrator' and rest[2] == kind.replace('/', '/srv/')
    elif verb == 'topic':
        assert rest[0] in ('echo', 'hz', 'list') and rest[1].lstrip('/') in TOPICS
    elif verb == 'bag':
        assert rest[0] in ('record', 'play', 'convert', 'info')
        if rest[0] == 'record':
            assert {word.lstrip('/') for word in rest if word.startswith('/')} <= TOPICS
    elif verb in ('param', 'lifecycle'):
        assert rest[1].lstrip('/') in ('star_observer', 'calibrator')
        if verb == 'param':
            assert rest[2] in names_of(*OPTIONS)
        else:
            assert rest[2] in ('configure', 'activate', 'deactivate', 'cleanup', 'shutdown')
    else:
        assert verb in ('launch', 'run') and rest[0] != 'starcal', line


def test_the_documents_have_what_is_tested_and_the_readme_is_one_page() -> None:
    """Commands and programs that run, a parameter file, and the ways into the vehicle."""
    assert {path.name for path in RUNNING} >= {'README.md', 'tutorial.md', 'commands.md'}
    ran = {line.words[1] for line in TOOL_LINES if line.runs}
    assert ran >= {'diagnose', 'calibrate', 'compare'}
    assert sum(runs for *_, runs in PROGRAMS) >= 4
    assert 'tutorial.md' in {path.name for path, _ in PARAMETER_BLOCKS}
    assert {line.words[1] for line in lines_of('ros2')} >= {'launch', 'run', 'service', 'topic'}
    text = FENCE.sub('', (ROOT / 'README.md').read_text())
    assert len(re.sub(r'\]\([^)]*\)', ']', text).split()) < 600


def test_versions_are_the_pinned_ones_and_that_of_the_package() -> None:
    pinned = (ROOT / 'requirements' / 'runtime.txt').read_text().splitlines()
    lines = [line.words for line in pip_lines() if line.words[1] == 'install']
    assert lines
    for words in lines:
        packages = {word for word in words[2:] if not word.startswith('--')}
        assert packages and packages <= set(pinned)
    version = ElementTree.parse(ROOT / 'package.xml').findtext('version')
    assert f'version {version}' in (ROOT / 'docs' / 'performance.md').read_text()
    assert f'\nversion: {version}\n' in (ROOT / 'CITATION.cff').read_text()
