# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Reports in a state folder: made by a process of its own, in nobody's way."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import dataclasses
from pathlib import Path
import queue
import resource
import shutil
import sys
import time
from typing import Any

import psutil  # type: ignore[import-untyped]
import pytest

from starcal_ros.cli import main
from starcal_ros.formats.products.calibration_json import read_calibration
from starcal_ros.formats.products.camera_yaml import write_camera_info
from starcal_ros.pipeline.node_options import CalibratorOptions
from starcal_ros.pipeline.setup import load_setup
from starcal_ros.ros.kept.report_queue import ACTIVE, CalibratorReports, CANDIDATE
from starcal_ros.ros.kept.state import Answer, CalibratorState
from starcal_ros.simulation.centroids import true_observations
from starcal_ros.simulation.scenario import scenario

SCENARIO = scenario('tiny', seed=7)
PAGE_S = 120.0  # the longest wait for a page on a machine that is busy

Told = queue.Queue[tuple[Path, str]]
StandIn = Callable[[str], None]


@pytest.fixture(scope='module')
def subject(tmp_path_factory: pytest.TempPathFactory) -> Answer:
    """What the state of a calibrator answers to a solve."""
    folder = tmp_path_factory.mktemp('setup')
    write_camera_info(SCENARIO.prior.camera, folder / 'camera.yaml')
    alignment = SCENARIO.prior.star_tracker_from_camera_xyzw.tolist()
    setup = load_setup(
        {'camera_info_url': str(folder / 'camera.yaml'), 'prior_alignment': alignment}
    )
    state = CalibratorState(lambda: 1_800_000_000_000_000_000)
    state.open(setup, CalibratorOptions())
    for image in true_observations(SCENARIO).images:
        state.add(image)
    answer = state.solve()
    assert answer.calibration is not None and answer.residuals is not None
    return answer


@pytest.fixture
def told() -> Told:
    return queue.Queue()


@pytest.fixture
def reports(told: Told, tmp_path: Path) -> Iterator[CalibratorReports]:
    one = CalibratorReports(lambda page, trouble: told.put((page, trouble)))
    one.open(str(tmp_path), 'camera')
    yield one
    one.close()


def children() -> set[int]:
    """Processes that this one has started and not yet seen the end of."""
    return {child.pid for child in psutil.Process().children()}


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition; fail where it does not come to hold."""
    deadline_s = time.monotonic() + PAGE_S
    while not condition():
        assert time.monotonic() < deadline_s, 'the condition did not come to hold'
        time.sleep(0.01)


@pytest.fixture
def stand_in(tmp_path_factory: pytest.TempPathFactory, monkeypatch: Any) -> StandIn:
    """Have a shell script, the folder is its $5, where the interpreter is called."""

    def put(script: str) -> None:
        interpreter = tmp_path_factory.mktemp('bin') / 'python'
        interpreter.write_text(f'#!/bin/sh\n{script}\n')
        interpreter.chmod(0o755)
        monkeypatch.setattr(sys, 'executable', str(interpreter))

    return put


def numbered(subject: Answer, number: int) -> Answer:
    assert subject.calibration is not None
    calibration = dataclasses.replace(subject.calibration, number=number)
    return dataclasses.replace(subject, calibration=calibration)


@pytest.mark.slow
def test_the_folder_is_as_the_tool_writes_it(
    subject: Answer, reports: CalibratorReports, told: Told, tmp_path: Path
) -> None:
    before = children()
    reports.show(ACTIVE, subject)
    page, trouble = told.get(timeout=PAGE_S)
    assert (page, trouble) == (tmp_path / 'report' / 'report.html', '')
    assert {path.name for path in page.parent.iterdir()} == {
        'calibration.json', 'camera_info.yaml', 'observations.mcap',
        'report.html', 'residuals.npz',
    }  # fmt: skip
    text = page.read_text()
    assert 'calibration 1, active since 2027-01-15 08:00:00.000 UTC' in text
    assert 'figure-images' in text and 'without access to the images' in text
    page.unlink()
    assert main.main(['report', str(page.parent)]) == 0
    assert page.read_text() == text
    reports.show(ACTIVE, Answer(True, '', subject.calibration))  # it came back by a roll-back
    assert told.get(timeout=PAGE_S)[1] == ''
    left = {path.name for path in page.parent.iterdir()}
    assert left == {'calibration.json', 'camera_info.yaml', 'report.html'}
    assert [path.name for path in tmp_path.iterdir()] == ['report']
    assert children() == before and reports.trouble == ''


def test_the_newest_wins(
    subject: Answer, reports: CalibratorReports, told: Told, tmp_path: Path, stand_in: StandIn
) -> None:
    stand_in(
        'test -e "$5/../go" || { touch "$5/../busy"; exec sleep 600; }; touch "$5/report.html"'
    )
    reports.show(ACTIVE, subject)
    until((tmp_path / 'busy').exists)
    reports.show(CANDIDATE, numbered(subject, 0))
    (tmp_path / 'go').touch()
    for number in range(2, 6):
        reports.show(ACTIVE, numbered(subject, number))
    pages = [tmp_path / name / 'report.html' for name in (CANDIDATE, ACTIVE)]
    assert [told.get(timeout=PAGE_S) for _ in pages] == [(page, '') for page in pages]
    numbers = [read_calibration(page.with_name('calibration.json')) for page in pages]
    assert [calibration.number for calibration in numbers] == [0, 5]
    assert told.empty()


def test_closing_ends_the_process_and_keeps_the_products(
    subject: Answer, reports: CalibratorReports, told: Told, tmp_path: Path, stand_in: StandIn
) -> None:
    stand_in('touch "$5/../busy"; exec sleep 600')
    before = children()
    reports.show(ACTIVE, subject)
    until((tmp_path / 'busy').exists)
    assert children() > before
    reports.show(CANDIDATE, subject)
    reports.close()
    assert children() == before
    for name in (ACTIVE, CANDIDATE):
        assert read_calibration(tmp_path / name / 'calibration.json').number == 1
    assert told.empty()
    reports.show(ACTIVE, subject)
    assert children() == before
    stand_in('touch "$5/report.html"')
    reports.open(str(tmp_path), 'camera')
    reports.show(ACTIVE, subject)
    assert told.get(timeout=PAGE_S) == (tmp_path / 'report' / 'report.html', '')


def test_a_full_disk_leaves_the_report_before(
    subject: Answer, reports: CalibratorReports, told: Told, tmp_path: Path, stand_in: StandIn
) -> None:
    stand_in('touch "$5/report.html"')
    reports.show(ACTIVE, subject)
    page = told.get(timeout=PAGE_S)[0]
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limit[1]))
    try:
        reports.show(ACTIVE, numbered(subject, 2))
        trouble = told.get(timeout=PAGE_S)[1]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert 'cannot be written: File too large' in trouble and reports.trouble == trouble
    assert page.exists()
    assert read_calibration(page.parent / 'calibration.json').number == 1
    assert not list(tmp_path.glob('.*'))
    reports.show(ACTIVE, numbered(subject, 2))
    assert told.get(timeout=PAGE_S)[1] == '' and reports.trouble == ''


def test_a_folder_that_went_away_is_said(
    subject: Answer, reports: CalibratorReports, told: Told, tmp_path: Path
) -> None:
    shutil.rmtree(tmp_path)
    reports.show(ACTIVE, subject)
    assert 'No such file or directory' in told.get(timeout=PAGE_S)[1]


@pytest.mark.parametrize(
    ('script', 'said'),
    [
        ('echo first >&2; echo "starcal: no room" >&2; exit 2', 'starcal: no room'),
        ('exit 1', 'exit status 1'),
        ('kill -9 $$', 'ended by signal 9'),
    ],
)
def test_why_there_is_no_page(
    subject: Answer,
    reports: CalibratorReports,
    told: Told,
    tmp_path: Path,
    stand_in: StandIn,
    script: str,
    said: str,
) -> None:
    """The products are there all the same."""
    stand_in(script)
    reports.show(ACTIVE, Answer(True, '', subject.calibration))
    assert told.get(timeout=PAGE_S)[1] == said == reports.trouble
    assert (tmp_path / 'report' / 'calibration.json').is_file()
