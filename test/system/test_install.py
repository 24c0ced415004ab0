# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""`pip install .` without extras, without what rosdep lacks, and as a Debian package."""

from importlib import metadata
import json
import os
from pathlib import Path
import re
import shlex
import shutil
import sys
import sysconfig
from xml.etree import ElementTree

import pytest
from ros_tools import HIDDEN, required  # type: ignore[import-not-found]
from starcal_tool import run, run_python  # type: ignore[import-not-found]

ROOT = Path(__file__).resolve().parents[2]
TUTORIAL = ROOT / 'docs' / 'tutorial.md'
MANIFEST = ROOT / 'MANIFEST.in'
# What is made here and is no source.
MADE = ('.*cache*', '.hypothesis', '*.egg-info', '__pycache__', '_build', 'generated')
SDIST = 'from setuptools.build_meta import build_sdist; print(build_sdist(".."))'
OF_EXTRAS = ('dask', 'distributed', 'sphinx', 'spiceypy')
PIP, ALONE = (sys.executable, '-m', 'pip'), ('--no-deps', '--no-index')


def link_distribution(name: str, packages: Path) -> None:
    """Make an installed distribution importable from another folder of packages."""
    distribution = metadata.distribution(name)
    here = Path(sysconfig.get_path('purelib'))
    tops = {Path(file).parts[0] for file in distribution.files or () if '..' not in file.parts}
    for top in tops - {'__pycache__'}:
        if not (packages / top).exists():
            (packages / top).symlink_to(here / top)


@pytest.fixture(scope='module')
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    sources = tmp_path_factory.mktemp('build') / 'sources'
    for name in re.findall(r'^graft (.+)', MANIFEST.read_text(), re.MULTILINE):
        shutil.copytree(ROOT / name, sources / name, ignore=shutil.ignore_patterns(*MADE))
    for path in ROOT.iterdir():
        if path.is_file():
            shutil.copy(path, sources)
    return sources


@pytest.fixture(scope='module')
def unpacked(sources: Path) -> Path:
    packed = run_python('-c', SDIST, cwd=sources)
    assert packed.returncode == 0, packed.stderr
    archive: Path = sources.parent / packed.stdout.splitlines()[-1]
    run('tar', 'xzf', archive, cwd=sources.parent)
    return archive.with_suffix('').with_suffix('')


@pytest.fixture(scope='module')
def wheel(unpacked: Path) -> Path:
    """A wheel made from the source archive, which must have all that it takes."""
    folder = unpacked.parent
    built = run(*PIP, 'wheel', *ALONE, '--no-build-isolation', unpacked, cwd=folder)
    assert built.returncode == 0, built.stdout + built.stderr
    (wheel,) = folder.glob('starcal_ros-*.whl')
    return wheel


def installed(wheel: Path, folder: Path, extra: str) -> Path:
    """An environment with starcal, by pip, and links to what it requires, without network."""
    venv = folder / 'venv'
    made = run_python('-m', 'venv', '--without-pip', venv, cwd=folder)
    if made.returncode:
        pytest.skip(f'no venv can be made here: {made.stderr}')
    to_venv = ('--python', venv / 'bin/python')
    done = run(*PIP, *to_venv, 'install', *ALONE, wheel, cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    (packages,) = venv.glob('lib/python*/site-packages')
    (information,) = packages.glob('starcal_ros-*.dist-info')
    for name in required(metadata.Distribution.at(information), extra):
        link_distribution(name, packages)
    return venv


@pytest.fixture(scope='module')
def flight_install(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return installed(wheel, tmp_path_factory.mktemp('flight'), '')


@pytest.mark.packaging
@pytest.mark.slow
def test_the_source_archive_is_complete(sources, unpacked) -> None:
    """It has each file of a clone but those of git and of editors, and its tests run in it."""
    clone, archive = (
        {str(path.relative_to(top)) for path in top.rglob('*') if path.is_file()}
        for top in (sources, unpacked)
    )
    assert {
        name for name in clone - archive if name[0] != '.' and '.egg-info' not in name
    } == set()
    tests = ('test/onboard/camera', 'test/system/test_named_in_documents.py')
    done = run_python('-m', 'pytest', '-q', '-p', 'no:cacheprovider', *tests, cwd=unpacked)
    assert done.returncode == 0, done.stdout


@pytest.mark.packaging
@pytest.mark.slow
def test_a_bag_is_calibrated_without_extras(flight_install, tmp_path) -> None:
    """With the versions of this environment: in `make test VERSIONS=newest` those of today."""
    python = flight_install / 'bin/python'
    for name in OF_EXTRAS:
        assert run(python, '-c', f'import {name}', cwd=tmp_path).returncode == 1, name
    tiny, starcal = ROOT / 'bags/tiny', flight_install / 'bin/starcal'
    params = tiny / 'params.yaml'
    done = run(starcal, 'calibrate', tiny, '--params', params, '-o', 'out', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert json.loads((tmp_path / 'out/calibration.json').read_text())['accepted']
    refused = run(starcal, 'trend', '.', '-o', 'trend', '--workers', '1', cwd=tmp_path)
    assert refused.returncode == 2
    assert f"{python} -m pip install '.[mission]'" in refused.stderr
    assert refused.stderr.count('\n') == 1
    assert 'look at out/report.html' in done.stdout
    assert '<svg' in (tmp_path / 'out/report.html').read_text()
    write = (
        'import sys, starcal_ground; found = starcal_ground.calibrate_bag(*sys.argv[1:]);'
        "starcal_ground.write_calibration(found, 'again.json')"
    )
    done = run(python, '-W', 'error', '-c', write, tiny, params, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    files = (tmp_path / 'out/calibration.json', tmp_path / 'again.json')
    made, again = (json.loads(path.read_text()) for path in files)
    assert made['accepted'] and made['intrinsics'] == again['intrinsics']


@pytest.mark.packaging
@pytest.mark.slow
def test_pip_lines_of_the_tutorial(sources) -> None:
    lines = re.findall(r'`pip install ([^`]+)`', TUTORIAL.read_text())
    assert '.' in lines and "'.[mission]'" in lines
    pip, offline = (*PIP, 'install', '--dry-run'), (*ALONE, '--no-build-isolation')
    for line in lines:
        tried = run(*pip, *offline, *shlex.split(line), cwd=sources)
        assert tried.returncode == 0, tried.stderr
        assert 'does not provide the extra' not in tried.stderr


@pytest.mark.packaging
@pytest.mark.slow
def test_types_and_definitions_are_installed(flight_install) -> None:
    packages = list(flight_install.glob('lib/python*/site-packages/starcal_[rg]*/py.typed'))
    assert {path.parent.name for path in packages} == {'starcal_ros', 'starcal_ground'}
    installed = {path.name for path in (flight_install / 'share/starcal/msg').iterdir()}
    assert installed == {path.name for path in (ROOT / 'msg').glob('*.msg')}


TINY = ROOT / 'bags' / 'tiny'


@pytest.fixture
def vehicle(tmp_path: Path) -> dict[str, str]:
    """Environment of a process without the packages that have no key."""
    (tmp_path / 'sitecustomize.py').write_text(HIDDEN)
    return os.environ | {'PYTHONPATH': f'{tmp_path}:{ROOT}'}


@pytest.mark.nodes
def test_the_nodes_run_and_what_needs_more_costs_one_line(vehicle) -> None:
    pytest.importorskip('starcal.msg')
    source = """
import sys
from starcal_ros.errors import ArchiveError
from starcal_ros.pipeline.setup import CalibratorOptions
import starcal_ros.ros.star_observer
from starcal_ros.ros.calibrator import Calibrator
from starcal_ros.ros.state import CalibratorState
assert not {'mcap', 'rosbags', 'threadpoolctl'} & sys.modules.keys()
try:
    CalibratorState(int).open(None, CalibratorOptions(state_dir='state'))
except ArchiveError as error:
    print(error)
"""
    done = run_python('-c', source, env=vehicle, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert 'python -m pip install mcap rosbags, or leave state_dir' in done.stdout
    params = TINY / 'params.yaml'
    for words in (
        ('starcal_ros.entry_points', 'bag_player'),
        ('starcal_ground.cli.main', 'calibrate', TINY, '--params', params, '-o', 'none'),
    ):
        refused = run_python('-m', *words, env=vehicle, cwd=ROOT)
        assert refused.returncode == 2, refused.stderr
        assert 'python -m pip install mcap rosbags' in refused.stderr
        assert refused.stderr.count('\n') == 1


def test_the_debian_package_has_the_dependencies_of_package_xml() -> None:
    package = ElementTree.parse(ROOT / 'package.xml')
    control = (ROOT / 'debian/control').read_text()
    listed = re.findall(
        r'^ ((?:ros-jazzy|python3)-[a-z0-9-]+)', control.partition('Depends:\n $')[2], re.M
    )
    keys = {str(one.text) for kind in ('depend', 'exec_depend') for one in package.iter(kind)}
    expected = {
        key if key.startswith('python3-') else f'ros-jazzy-{key.replace("_", "-")}' for key in keys
    }
    assert set(listed) == expected
    version = (ROOT / 'debian/changelog').read_text().partition('(')[2].partition('-')[0]
    assert version == package.findtext('version')


def test_without_ros_the_debian_build_says_where_it_stops(tmp_path) -> None:
    if not shutil.which('dh'):
        pytest.skip('no debhelper')
    for name in ('debian', 'CMakeLists.txt', 'package.xml'):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tmp_path / name)
    build = ('debian/rules', 'build', f'ROS_PREFIX={tmp_path}/none')
    done = run(*build, cwd=tmp_path)
    assert done.returncode == 2
    assert f'no ROS 2 in {tmp_path}/none' in done.stderr
