# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Untrusted text and messages: the short form of the attacks, and what they are made of."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bench import attack_inputs, fuzz_inputs
from starcal_ros.cli import main

TEXTS = ('parameters', 'camera', 'metadata', 'calibration', 'state')
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize('kind', TEXTS)
def test_spoilt_texts_are_refused_in_one_line(kind: str, tmp_path: Path) -> None:
    found = fuzz_inputs.fuzz(kind, 60, tmp_path)
    assert found.failures == ()
    assert found.tried == 60


@pytest.mark.nodes
def test_spoilt_observations_are_refused_or_saved(tmp_path: Path) -> None:
    pytest.importorskip('rclpy')
    found = fuzz_inputs.fuzz('observations', 60, tmp_path)
    assert found.failures == ()
    assert 0 < found.read < found.tried == 60  # some are sound, some are not


def test_a_failure_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests above could fail: a door that raises another error is caught."""

    def broken(path: Path) -> None:
        raise ZeroDivisionError(path)

    monkeypatch.setattr(fuzz_inputs, 'read_camera_info', broken)
    found = fuzz_inputs.fuzz('camera', 3, tmp_path)
    assert len(found.failures) == 3 and 'ZeroDivisionError' in found.failures[0]


def test_pipes_and_devices_are_no_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pipe = tmp_path / 'pipe'
    os.mkfifo(pipe)
    (tmp_path / 'bag').mkdir()
    for name in ('metadata.yaml', 'a.mcap'):
        os.mkfifo(tmp_path / 'bag' / name)
    for arguments, text in (
        (['inspect', pipe], 'not a regular file'),
        (['inspect', '/dev/zero'], 'not a regular file'),
        (['inspect', tmp_path / 'bag'], 'no .mcap files in the folder'),
        (['inspect', ROOT / 'bags' / 'tiny', '--params', pipe], 'not a regular file'),
        (['compare', pipe, '/dev/zero'], 'not a regular file'),
    ):
        assert main.main([str(word) for word in arguments]) == 2
        error = capsys.readouterr().err
        assert text in error and error.count('\n') == 1


@pytest.mark.nodes
@pytest.mark.slow
@pytest.mark.timeout(600)  # six processes of hypothesis and as many nodes
def test_nodes_withstand_hostile_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy')
    monkeypatch.chdir(ROOT)
    for row in attack_inputs.rows(quick=True):
        assert row.survived == row.tried > 0, row
        assert (row.lost, row.wrong) == (0, 0), row
