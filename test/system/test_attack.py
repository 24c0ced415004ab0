# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""A short form of `python -m bench attack`: all survived, nothing lost, nothing wrong."""

from __future__ import annotations

import pytest

from bench import attack_bags, attack_kills, attack_outputs, attack_state
from bench.attack_row import AttackRow

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


def assert_survived(rows: list[AttackRow], least: int) -> None:
    for row in rows:
        assert (row.survived, row.lost, row.wrong) == (row.tried, 0, 0), row
    assert sum(row.tried for row in rows) >= least


def test_outputs() -> None:
    assert_survived(attack_outputs.rows(True), 230)


def test_state() -> None:
    assert_survived(attack_state.rows(True), 300)


def test_bags() -> None:
    assert_survived(attack_bags.rows(True), 120)


def test_kills() -> None:
    assert_survived(attack_kills.rows(True), 24)
