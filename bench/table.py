# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Result tables of benches, as aligned text and as plain values, and the time of a call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import time
from typing import TypeVar

from starcal_ground.cli.terminal import table_lines

ResultT = TypeVar('ResultT')
Cell = str | int | float | bool | None


@dataclass
class Table:
    """Rows of cells under a title; numbers keep their precision until they are printed."""

    title: str
    columns: Sequence[str]
    rows: list[tuple[Cell, ...]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, *cells: Cell) -> None:
        """Append a row."""
        self.rows.append(cells)

    def text(self) -> str:
        """Aligned columns, the first to the left."""
        rows = [[_shown(cell) for cell in row] for row in self.rows]
        lines = table_lines(self.columns, rows)
        return '\n'.join([self.title, *(f'  {line}' for line in (*lines, *self.notes)), ''])

    def content(self) -> dict[str, object]:
        """The table as a JSON object."""
        rows = [dict(zip(self.columns, row, strict=True)) for row in self.rows]
        return {'title': self.title, 'rows': rows, 'notes': self.notes}


def timed(call: Callable[[], ResultT]) -> tuple[ResultT, float]:
    """Return the result of a call and the processor time of it, in seconds."""
    start_s = time.process_time()
    result = call()
    return result, time.process_time() - start_s


def verdict(ratio: float, target: float) -> str:
    """Comparison of a measured ratio with its target."""
    return f'>= {target:g}: ' + ('met' if ratio >= target else 'MISSED')


def _shown(cell: Cell) -> str:
    if cell is None:
        return '-'
    if isinstance(cell, bool):
        return 'yes' if cell else 'no'
    if isinstance(cell, float):
        if cell != 0 and not 1e-3 <= abs(cell) < 1e5:
            return f'{cell:.1e}'
        digits = 0 if abs(cell) >= 100 else 1 if abs(cell) >= 10 else 2 if abs(cell) >= 1 else 3
        return f'{cell:.{digits}f}'
    return f'{cell:,}' if isinstance(cell, int) else cell
