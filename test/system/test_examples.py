# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Examples run as their reader would run them: scripts, the notebook, and those of docstrings."""

import dataclasses
import doctest
import json
from pathlib import Path
import shutil
import sys
import typing

import pytest
from starcal_tool import run_python  # type: ignore[import-not-found]

import starcal_ground
from starcal_ground.comparison import Comparison
import starcal_ros
from starcal_ros.formats.products.product_files import read_calibration
from starcal_ros.records import Calibration, Ensemble, MapCovariance

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
TINY = EXAMPLES.parent / 'bags' / 'tiny'


@pytest.mark.slow
def test_from_arrays(tmp_path) -> None:
    done = run_python(EXAMPLES / 'from_arrays.py', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    verdict, *rows, sight = done.stdout.splitlines()
    assert verdict == 'accepted' and len(rows) == 10
    for row in rows:
        name, found, _, sigma, _, truth = row.split()
        # 5 sigma: one draw of fixed seed; 1e-5: parameters that are held, as they are printed.
        assert abs(float(found) - float(truth)) <= 5 * float(sigma) + 1e-5, name
    assert sight.startswith('line of sight of pixel (0, 0)')


@pytest.mark.slow
def test_from_bag(few_images, tmp_path) -> None:
    written = tmp_path / 'calibration.json'
    params = few_images / 'params.yaml'
    done = run_python(EXAMPLES / 'from_bag.py', few_images, params, written, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert len(done.stdout.splitlines()) == 10
    assert read_calibration(written).accepted


@pytest.mark.slow
def test_notebook(monkeypatch) -> None:
    """Each code cell in turn, in one namespace: what Jupyter does, without Jupyter."""
    cells = json.loads((EXAMPLES / 'calibrate.ipynb').read_text())['cells']
    for cell in cells:  # it is kept without outputs
        assert not cell.get('outputs') and cell.get('execution_count') is None
    sources = [''.join(cell['source']) for cell in cells if cell['cell_type'] == 'code']
    assert len(sources) >= 5
    monkeypatch.chdir(EXAMPLES)
    names: dict[str, object] = {}
    for number, source in enumerate(sources):
        exec(compile(source, f'cell {number}', 'exec'), names)
    assert 'calibration' in names


@pytest.mark.slow
def test_mission(few_images, tmp_path) -> None:
    """FITS and AEM to kernels that spiceypy loads, with the boresight of the calibration."""
    params = few_images / 'params.yaml'
    done = run_python(
        EXAMPLES / 'mission.py', few_images, params, tmp_path / 'mission', cwd=tmp_path
    )
    assert (done.returncode, done.stderr) == (0, '')
    difference = done.stdout.splitlines()[-1].removeprefix('difference from the calibration: ')
    assert float(difference.split()[0]) < 1e-9
    assert (tmp_path / 'mission/camera.ti').read_text().startswith('KPL/IK')


@pytest.mark.parametrize(
    ('name', 'given', 'words'),
    [
        ('from_bag.py', (), 'usage: python from_bag.py BAG PARAMS '),
        ('mission.py', (), 'usage: python mission.py BAG PARAMS '),
        (
            'from_bag.py',
            ('none', TINY / 'params.yaml', 'o.json'),
            'none: no such file or folder\n',
        ),
    ],
)
def test_missing_arguments_and_a_missing_bag_are_one_line(name, given, words, tmp_path) -> None:
    done = run_python(EXAMPLES / name, *given, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith(words) and done.stderr.count('\n') == 1


PUBLIC = [
    getattr(package, name)
    for package in (starcal_ros, starcal_ground)
    for name in package.__all__
    if name != '__version__'
]
# Shown in the example of the record that holds them.
LEAVES = {'Amplitude', 'ChiSquared', 'DetectorStep', 'DifferenceMap', 'ResidualBin'}


def records_in(kind: object) -> set[type]:
    """The records in a type: itself, and those of its fields."""
    inside = {record for part in typing.get_args(kind) for record in records_in(part)}
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind).values()
        return {kind, *inside}.union(*(records_in(hint) for hint in hints))
    return inside


HELD = {
    record for kind in (Calibration, Comparison, Ensemble, MapCovariance)
    for record in records_in(kind) if record.__name__ not in LEAVES
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    'described',
    [*PUBLIC, *sorted(HELD - {*PUBLIC}, key=lambda kind: kind.__name__)],
    ids=lambda described: described.__name__,
)
def test_the_example_of_a_docstring_runs(described, tiny_products, tmp_path, monkeypatch) -> None:
    shutil.copytree(tiny_products, tmp_path / 'out')
    (tmp_path / 'bags').symlink_to(EXAMPLES.parent / 'bags')
    monkeypatch.chdir(tmp_path)
    names = vars(sys.modules[described.__module__]).copy()
    (example,) = doctest.DocTestFinder(recurse=False).find(described, globs=names)
    assert example.examples
    said: list[str] = []
    doctest.DocTestRunner().run(example, out=said.append)
    assert ''.join(said) == ''
