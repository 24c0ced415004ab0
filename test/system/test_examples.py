# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The scripts and the notebook of examples/, run as their reader would."""

from __future__ import annotations

import json
from pathlib import Path
import subprocess
import sys

import pytest

from starcal_ros.formats.products.product_files import read_calibration

EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'
TINY = EXAMPLES.parent / 'bags' / 'tiny'


def run(cwd: Path, *command: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, command)], cwd=cwd, capture_output=True, text=True
    )


@pytest.mark.slow
def test_from_arrays(tmp_path) -> None:
    done = run(tmp_path, EXAMPLES / 'from_arrays.py')
    assert (done.returncode, done.stderr) == (0, '')
    verdict, *rows, sight = done.stdout.splitlines()
    assert verdict == 'accepted' and len(rows) == 10
    for row in rows:
        name, found, _, sigma, _, truth = row.split()
        # 5 sigma: one draw of fixed seed; 1e-5: parameters that are held, as they are printed.
        assert abs(float(found) - float(truth)) <= 5 * float(sigma) + 1e-5, name
    assert sight.startswith('line of sight of pixel (0, 0)')


@pytest.mark.slow
def test_from_bag(tmp_path) -> None:
    written = tmp_path / 'calibration.json'
    done = run(tmp_path, EXAMPLES / 'from_bag.py', TINY, TINY / 'params.yaml', written)
    assert (done.returncode, done.stderr) == (0, '')
    assert len(done.stdout.splitlines()) == 10
    assert read_calibration(written).accepted


def test_from_a_bag_that_is_not_there(tmp_path) -> None:
    done = run(tmp_path, EXAMPLES / 'from_bag.py', 'none', TINY / 'params.yaml', 'out.json')
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr == 'none: no such file or folder\n'


@pytest.mark.slow
def test_notebook(monkeypatch) -> None:
    """Each code cell in turn, in one namespace: what Jupyter does, without Jupyter."""
    cells = json.loads((EXAMPLES / 'calibrate.ipynb').read_text())['cells']
    sources = [''.join(cell['source']) for cell in cells if cell['cell_type'] == 'code']
    assert len(sources) >= 5
    monkeypatch.chdir(EXAMPLES)
    names: dict[str, object] = {}
    for number, source in enumerate(sources):
        exec(compile(source, f'cell {number}', 'exec'), names)
    assert 'calibration' in names


def test_the_notebook_is_kept_without_outputs() -> None:
    cells = json.loads((EXAMPLES / 'calibrate.ipynb').read_text())['cells']
    for cell in cells:
        assert not cell.get('outputs') and cell.get('execution_count') is None


@pytest.mark.slow
def test_mission(tmp_path) -> None:
    """FITS and AEM to kernels that spiceypy loads, with the boresight of the calibration."""
    params = TINY / 'params.yaml'
    done = run(tmp_path, EXAMPLES / 'mission.py', TINY, params, tmp_path / 'mission')
    assert (done.returncode, done.stderr) == (0, '')
    difference = done.stdout.splitlines()[-1].removeprefix('difference from the calibration: ')
    assert float(difference.split()[0]) < 1e-9
    assert (tmp_path / 'mission/camera.ti').read_text().startswith('KPL/IK')


@pytest.mark.parametrize('name', ['from_bag.py', 'mission.py'])
def test_without_arguments_the_usage_is_printed(name, tmp_path) -> None:
    done = run(tmp_path, EXAMPLES / name)
    assert done.returncode == 2
    assert done.stderr.startswith(f'usage: python {name} BAG PARAMS ')
    assert done.stderr.count('\n') == 1
