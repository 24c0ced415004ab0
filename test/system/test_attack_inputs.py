# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Untrusted text and messages: the short form of the attacks, and what they are made of."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench import attack_inputs, fuzz_inputs

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


def test_pipes_and_devices_are_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    row = attack_inputs._pipe(tmp_path)
    assert row.survived == row.tried == 6


@pytest.mark.nodes
@pytest.mark.slow
@pytest.mark.timeout(600)  # six processes of hypothesis and as many nodes
def test_nodes_withstand_hostile_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('rclpy')
    monkeypatch.chdir(ROOT)
    for row in attack_inputs.rows(quick=True):
        assert row.survived == row.tried > 0, row
        assert (row.lost, row.wrong) == (0, 0), row
