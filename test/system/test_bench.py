# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""The benches run with small sizes, and the compared solvers find the same minimum."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from starcal_tool import run_python  # type: ignore[import-not-found]

from bench import acquisition
from starcal_ros.errors import ImageRefused
from starcal_ros.identification.star_finder import Exposure, observe_stars, StarSearch
from starcal_ros.sky.catalog import load_catalog

pytestmark = [pytest.mark.packaging, pytest.mark.slow]

ROOT = Path(__file__).parents[2]


def found_by(name: str, tmp_path: Path) -> tuple[Any, str]:
    """Tables of a bench in its short form, and what it prints."""
    found = tmp_path / 'found.json'
    done = run_python('-m', 'bench', name, '--quick', '--json', found, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return json.loads(found.read_text())[name], done.stdout


def test_solver_bench(tmp_path) -> None:
    """A row for each solver; SciPy and starcal agree to a hundredth of a sigma."""
    (compared,), said = found_by('solver', tmp_path)
    rows = {row['solver']: row for row in compared['rows']}
    for name in ('starcal, search alone', 'starcal, whole estimate', 'OpenCV calibrateCamera'):
        assert rows[name]['ms'] > 0 and name in said
    scipy = rows['SciPy trf, sparse Jacobian']
    # Costs of one minimum differ by their rounding and by the inner tolerance of SciPy, 1e-9.
    assert scipy['sigma off'] < 0.01 and abs(scipy['cost off']) < 1e-8


def test_calibrate_bench(tmp_path) -> None:
    """A bare read takes less memory than a calibration, which ends well."""
    (table,), _ = found_by('calibrate', tmp_path)
    bare, whole, ratio = table['rows']
    assert min(bare['processor s'], whole['processor s']) > 0
    assert bare['peak MB'] < whole['peak MB']
    assert ratio['processor s'] == pytest.approx(whole['processor s'] / bare['processor s'])


def test_fleet_bench(tmp_path) -> None:
    """The command passes over all simulated calibrations, which its table has."""
    (table,), _ = found_by('fleet', tmp_path)
    assert [row['rows'] for row in table['rows']] == [100, 1000]
    assert all(row['peak MB'] > 0 for row in table['rows'])


def test_peers_bench(tmp_path) -> None:
    """Every tool that is installed has a row; errors of starcal are within 2 sigma."""
    (errors, times), said = found_by('peers', tmp_path)
    rows = {(row['campaign'], row['tool']): row for row in errors['rows']}
    kinds = {kind for kind, _ in rows}
    assert len(kinds) == 4
    for kind in kinds:
        ours, scipy = rows[kind, 'starcal, estimator'], rows[kind, 'SciPy']
        assert ours['best variants'] == 'accepted' and ours['error/sigma'] < 2.0
        # A lens that its model does not describe is not in the sigma of a solver.
        assert (scipy['error/sigma'] > 4.0) == ('ripple' in kind)
        assert rows[kind, 'OpenCV']['sigma "'] is None
        for name in ('tetra3rs', 'GIANT', 'GIANT, estimator', 'mrcal'):
            skipped = f'{name} is not installed: skipped' in said
            images_only = name in ('tetra3rs', 'GIANT') and kind.startswith('stars')
            assert ((kind, name) in rows) == (not skipped and not images_only)
    whole = rows['images, sound', 'starcal, bag to camera']
    assert whole['frames'] == 5 and whole['by ours'] == pytest.approx(1.0, abs=1e-3)
    assert [row['frames found'] for row in times['rows']] == [4] * len(times['rows'])


def test_acquisition_bench() -> None:
    """Scrambled fields are refused, and easy true fields are found."""
    refused = acquisition.scrambled(1, 8)
    rows = {row['field']: row for row in refused.content()['rows']}  # type: ignore[attr-defined]
    assert set(rows) == {*acquisition.SCRAMBLES, 'all'}
    assert rows['all']['tried'] == 8 * len(acquisition.SCRAMBLES)
    assert rows['all']['wrongly accepted'] == 0
    found = acquisition.to_be_found(2)
    rows = {row['field']: row for row in found.content()['rows']}  # type: ignore[attr-defined]
    assert all(row['wrong'] == 0 for row in rows.values())
    # Of the hardest, 500 cosmic rays and nine stars in ten missing, only some are found.
    assert all(rows[name]['found'] == 2 for name in ('clean', '5 planets', '50 cosmic rays'))


def test_a_match_that_is_right_in_a_part_of_the_image_is_refused() -> None:
    """A field 2.13 degrees off: the stars of a corner are right, the others chance."""
    rng = np.random.default_rng([acquisition.SEED, 1])
    scenario = acquisition.random_fields(rng, 40)
    kind = acquisition.SCRAMBLES['true stars, attitude 2 to 8 degrees off']
    fields = acquisition.scrambled_images(kind, scenario, rng, 100)
    image, drawn, attitudes = [next(fields) for _ in range(4)][3]
    right = Rotation.from_quat(drawn.icrf_from_star_tracker_xyzw)
    off_deg = np.degrees((right.inv() * Rotation.from_quat(attitudes)).magnitude())
    shot = Exposure(image, attitudes[int(np.abs(off_deg - 2.13).argmin())], 0.0)
    with pytest.raises(ImageRefused, match='part of the image'):
        observe_stars(shot, scenario.prior, StarSearch(load_catalog(None, 9.0)))
