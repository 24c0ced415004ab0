# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Monte Carlo studies: the same from any number of workers, and true to what is known."""

import dataclasses
import functools
import itertools
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

import numpy as np
import psutil  # type: ignore[import-untyped]
import pytest
from scipy.stats import chi2

from starcal_ground.comparison import map_error_px
from starcal_ros.camera import line_of_sight, pixel_grid
from starcal_ros.constants import ARCSECOND_RAD
from starcal_ros.errors import StarcalError, TooFewObservations
from studies import __main__ as studies
from studies import monte_carlo, trials
from studies.monte_carlo import Design, Row, StudyResult
from studies.workers import run_each

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
METHODS = ('per_image', 'single', 'hierarchical')
ARGUMENTS = (
    *('coverage', '--trials', '2', '--images', '4', '--stars', '20', '--seed', '5'),
    *('--methods', 'hierarchical'),
)
SMALL = {
    'table1': Design('table1', 2, (4,), (20, 30), (20.0,), ('single', 'hierarchical')),
    'coverage': Design('coverage', 2, (4,), (20,), (20.0,), ('hierarchical',), seed=5),
}


@functools.cache
def here(design: Design) -> StudyResult:
    """Run in this process."""
    trial = functools.partial(monte_carlo.run_trial, design)
    return monte_carlo.conclude(design, itertools.chain(*run_each(trial, range(design.trials))))


def only(rows: tuple[Row, ...], **values: object) -> Row:
    (row,) = (row for row in rows if all(row[k] == v for k, v in values.items()))
    return row


def test_json_is_the_same_bytes_from_any_number_of_workers(tmp_path, capfd) -> None:
    written = []
    for count in (0, 2):
        folder = tmp_path / str(count)
        assert studies.main([*ARGUMENTS, '-o', str(folder), '--workers', str(count)]) == 0
        out, err = capfd.readouterr()
        assert err == ''  # no progress
        assert 'hierarchical' in out
        written.append((folder / 'coverage.json').read_bytes())
    assert written[0] == written[1]


def test_workers_are_reached_through_no_socket() -> None:
    """A socket without authentication would let another user run code as this one."""
    # Renamed in psutil 6.
    sockets = getattr(psutil.Process, 'net_connections', None) or psutil.Process.connections
    us = psutil.Process()
    before = set(sockets(us, 'all'))
    earlier = {child.pid for child in us.children(recursive=True)}  # of other tests
    opened, seen = set(), 0

    def look(_: object) -> None:
        nonlocal seen
        opened.update(set(sockets(us, 'all')) - before)
        for child in us.children(recursive=True):
            if child.pid not in earlier:
                seen += 1
                opened.update(sockets(child, 'all'))

    trial = functools.partial(monte_carlo.run_trial, SMALL['coverage'])
    run_each(trial, range(1), workers=1, on_each=look)
    assert seen and not opened


def test_results_are_in_order_and_an_error_and_the_end_of_a_worker_reach_the_caller() -> None:
    assert run_each(int, '987654321', workers=2) == [9, 8, 7, 6, 5, 4, 3, 2, 1]
    with pytest.raises(ValueError, match='invalid literal'):
        run_each(int, '1x2', workers=1)
    with pytest.raises(StarcalError, match='a worker process ended with status 7: out of memory'):
        run_each(os._exit, [7], workers=1)


def test_interrupted_leaves_in_one_line(tmp_path: Path) -> None:
    # The background of a shell ignores SIGINT, and what is started there inherits that.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    out, pipe = str(tmp_path / 'out'), subprocess.PIPE
    words = ['coverage', '--trials', '100000', '--workers', '1', '-o', out]
    command = [sys.executable, '-m', 'studies', *words]
    # As a person would, in a terminal's process group.
    started = subprocess.Popen(
        command, cwd=ROOT, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )
    signal.signal(signal.SIGINT, before)
    deadline = time.monotonic() + 240
    # A second of work is past the start of Python, which answers an interrupt by itself.
    while time.monotonic() < deadline and not any(
        child.cpu_times().user > 1.0
        for child in psutil.Process(started.pid).children(recursive=True)
    ):
        time.sleep(0.2)
    children = psutil.Process(started.pid).children(recursive=True)
    os.killpg(started.pid, signal.SIGINT)
    try:
        out, err = started.communicate(timeout=240)
    except subprocess.TimeoutExpired:
        os.killpg(started.pid, signal.SIGKILL)
        started.communicate()
        raise
    assert (started.returncode, out, err) == (130, '', 'studies: interrupted\n')
    assert not psutil.wait_procs(children, timeout=240)[1]
    assert not list((tmp_path / 'out').iterdir())


def test_a_trial_hangs_on_nothing_but_seed_study_and_number() -> None:
    design = SMALL['coverage']
    rows = {trial: monte_carlo.run_trial(design, trial) for trial in (1, 0)}
    more = dataclasses.replace(design, trials=1000)
    assert rows[1] == monte_carlo.run_trial(more, 1)
    for other in (rows[0], monte_carlo.run_trial(dataclasses.replace(design, seed=6), 1)):
        assert rows[1][0]['map_px'] != other[0]['map_px']
    assert monte_carlo.conclude(design, itertools.chain(*rows.values())) == here(design)


@pytest.mark.parametrize('study', SMALL)
def test_results_and_their_table(study: str) -> None:
    found = here(SMALL[study])
    content = json.loads(monte_carlo.content(found, 'starcal 0'))
    assert content['study'] == study and content['parameters']['trials'] == found.design.trials
    assert {len(column) for column in content['trials'].values()} == {len(found.rows)}
    assert len(content['summary']) == len(found.summary)
    header, rows = monte_carlo.table(found)
    assert len(rows) == len(found.summary) and {len(row) for row in rows} == {len(header)}
    assert {row['method'] for row in found.summary} == {*found.design.methods}


def test_per_image_beats_single_where_the_star_tracker_is_bad() -> None:
    """Table 1 of the paper; and hierarchical is as good as the better of the two."""
    found = here(Design('table1', 2, (8,), (8, 80), tracker_arcsec=(0.0, 40.0), methods=METHODS))
    for stars in (8, 80):
        cell = functools.partial(only, found.summary, stars=stars)
        noisy = {m: cell(tracker_arcsec=40.0, method=m) for m in METHODS}
        # The bounds say 14 and 13 times; the rms of 2 trials of some 5 free directions of a map
        # is known to 22 %.
        assert float(noisy['single']['map_px']) > 8 * float(noisy['per_image']['map_px'])
        for tracker in (0.0, 40.0):
            of = {m: float(cell(tracker_arcsec=tracker, method=m)['map_px']) for m in METHODS}
            # The errors are paired (same stars, same noise), but each method has its own
            # estimated errors: what differs is under the scatter of 2 trials.
            assert of['hierarchical'] < 1.05 * min(of['per_image'], of['single'])


def test_hierarchical_gains_where_stars_are_few_and_the_star_tracker_good() -> None:
    """Stars place an image to 4 arcsec, the tracker to 1; that sigmas are true: the test below."""
    methods = ('per_image', 'hierarchical')
    found = here(Design('table1', 3, (16,), (8,), tracker_arcsec=(1.0,), methods=methods))
    for per_image, hierarchical in zip(found.rows[::2], found.rows[1::2], strict=True):
        assert (per_image['method'], hierarchical['method']) == methods
        gain = float(per_image['reported_px']) / float(hierarchical['reported_px'])
        bounds = float(per_image['own_bound_px']) / float(per_image['bound_px'])
        assert gain == pytest.approx(bounds, abs=0.10) and gain > 1.0


def test_errors_are_as_large_as_the_covariance_says() -> None:
    """With outliers; without any, test/onboard/estimation/test_calibrate.py has more trials."""
    methods, share = ('per_image', 'hierarchical'), monte_carlo.OUTLIER_SHARE
    found = here(Design('coverage', 10, (8,), (60,), (20.0,), methods, (share,)))
    low, high = chi2.ppf([0.005, 0.995], 11 * 10) / 10
    for method in methods:
        row = only(found.summary, method=method)
        assert (row['low'], row['high']) == pytest.approx((low, high))
        # The field that stars cannot show and a slow error of the star tracker are in the sigma
        # and not in these trials: it is up to 15 % too large.
        assert low / 1.15**2 < float(row['normalised']) < high
        # Of 10 trials the rms of the map is known to 10 %; three of those.
        assert float(row['to_reported']) == pytest.approx(1.0, abs=0.3)
        assert float(row['to_bound']) == pytest.approx(1.0, abs=0.3)
        # The mean of 10 errors of one sigma: four of its own sigmas, for 11 of them.
        assert abs(float(row['worst_bias_sigmas'])) < 4 / np.sqrt(10)


def test_bound_is_the_inverse_of_the_whole_normal_matrix() -> None:
    field = trials.draw_star_field(np.random.default_rng(1), 3, 20)
    N = trials.information_blocks(field)
    tracker_arcsec, f, m = 7.0, 8, 3
    rows = trials.ESTIMATED[:f]
    G = np.eye(3) / (tracker_arcsec * ARCSECOND_RAD) ** 2
    dense = np.zeros((f + 3 + 3 * m, f + 3 + 3 * m))
    for k in range(m):
        at = slice(f + 3 + 3 * k, f + 6 + 3 * k)
        dense[:f, :f] += N[k][np.ix_(rows, rows)]
        dense[at, :f] = N[k][np.ix_(np.arange(10, 13), rows)]
        dense[:f, at] = dense[at, :f].T
        dense[at, at] = N[k][10:, 10:] + G
        dense[at, f : f + 3] = dense[f : f + 3, at] = -G
        dense[f : f + 3, f : f + 3] += G
    unit = np.sqrt(np.outer(np.diag(dense), np.diag(dense)))
    expected = (np.linalg.inv(dense / unit) / unit)[:11, :11]
    found = trials.bound('hierarchical', N, tracker_arcsec).matrix
    found = found[np.ix_(trials.ESTIMATED, trials.ESTIMATED)]
    unit = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    # Condition 1e6 of the scaled matrix times a rounding.
    np.testing.assert_allclose(found / unit, expected / unit, atol=1e-8)


def test_per_image_and_single_bound_the_hierarchical() -> None:
    """Nothing known of the attitude, and all: the limits of the star tracker's sigma."""
    field = trials.draw_star_field(np.random.default_rng(2), 5, 20)
    blocks = trials.information_blocks(field)
    for method, tracker_arcsec in (('per_image', 3e5), ('single', 0.0)):
        limit = trials.bound('hierarchical', blocks, tracker_arcsec).matrix
        own = trials.bound(method, blocks, tracker_arcsec).matrix
        # 0.001 arcsec, which stands for none, against the 1 arcsec that the stars know: squared.
        np.testing.assert_allclose(np.diag(limit)[:10], np.diag(own)[:10], 1e-5, err_msg=method)


def test_map_error_leaves_out_a_common_turn() -> None:
    field = trials.draw_star_field(np.random.default_rng(3), 1, 1)
    camera = field.truth.camera
    assert map_error_px(camera, camera) < 1e-9  # rounding of the inverse
    # A moved principal point is a turn but for its second order: 5 px of tilt times the
    # squared tangent at the corners, 0.05.
    moved = camera.replace(cx=camera.parameters[3] + 5)
    assert 0.01 < map_error_px(moved, camera) < 0.1
    # A longer focal length brings every direction to the axis, by sin(2 angle) / 2 of its change.
    _, _, fy, _, _ = camera.intrinsics
    longer = camera.replace(fx=camera.parameters[0] * 1.001, fy=fy * 1.001)
    directions = line_of_sight(camera, pixel_grid(camera, 25, 25))
    radius = np.linalg.norm(directions[:, :2], axis=1) * directions[:, 2]
    expected = 1e-3 * np.sqrt(np.mean(radius**2)) * camera.parameters[0]
    # The distortion in the denominator is some per cent of a few per cent.
    assert map_error_px(longer, camera) == pytest.approx(expected, rel=0.01)


def test_one_trial_and_unsolvable_cells_are_taken() -> None:
    design = Design('coverage', 1, (2, 4), (4,), (20.0,), ('per_image',))
    found = here(design)
    # Eight stars are under the ten that a calibration takes.
    assert [row['images'] for row in found.rows] == [4]
    json.loads(monte_carlo.content(found, ''))
    with pytest.raises(TooFewObservations, match='no calibration was possible in 1 trials'):
        here(dataclasses.replace(design, images=(2,)))


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['table2'], "invalid choice: 'table2'"),
        (['table1', '--trials', '0'], '--trials: 0 is not within 1 to'),
        (['table1', '--tracker', 'nan'], 'nan is not within 0 to 3600'),
        (['table1', '--methods', 'all'], "--methods: invalid choice: 'all'"),
        (['table1', '--workers', '-1'], '--workers: -1 is not within 0'),
    ],
)
def test_a_bad_argument_is_named(arguments, words, tmp_path, capsys) -> None:
    try:
        status = studies.main([*arguments, '-o', str(tmp_path / 'out')])
    except SystemExit as error:
        status = int(error.code or 0)
    out, err = capsys.readouterr()
    assert status == 2 and out == '' and words in err.splitlines()[-1]
    assert not (tmp_path / 'out').exists()
