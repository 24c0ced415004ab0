# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Attacks on files, state, bags and the tool: how many were tried and survived, what was lost."""

from __future__ import annotations

from collections.abc import Callable

from bench import attack_bags, attack_inputs, attack_kills, attack_outputs, attack_state
from bench.attack_row import AttackRow
from bench.table import Table

# Each returns its rows; with True in a short form of seconds.
PARTS: tuple[Callable[[bool], list[AttackRow]], ...] = (
    attack_outputs.rows,
    attack_state.rows,
    attack_bags.rows,
    attack_inputs.rows,
    attack_kills.rows,
)


def run(quick: bool) -> list[Table]:
    """Run every attack and print the table."""
    table = Table('Attacks', ('attack', 'tried', 'survived', 'lost', 'wrong', 'note'))
    for part in PARTS:
        for row in part(quick):
            table.add(row.attack, row.tried, row.survived, row.lost, row.wrong, row.note)
            print(f'{row.attack}: {row.survived} of {row.tried}', flush=True)
    print(table.text())
    return [table]
