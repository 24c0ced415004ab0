# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tasks of a trend on worker processes or a Dask cluster, rows streamed into the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import dataclass

from starcal_ros.studies.workers import stream_each
from starcal_ros.trend.table import Table
from starcal_ros.trend.tasks import compute, failed, Task


@dataclass(frozen=True)
class Done:
    """How many tasks were computed, failed, were in the table before, or repeat another one."""

    computed: int
    failed: int
    known: int
    repeated: int


def update(
    table: Table,
    tasks: Sequence[Task],
    workers: int = 0,
    scheduler: str = '',
    on_row: Callable[[], None] = lambda: None,
) -> Done:
    """
    Add the rows of the tasks that the table does not have.

    A task whose worker process ends each time that it is tried becomes the row of a failure; the
    others go on.  What is computed is on disk within a batch, so a run that was stopped starts
    where it stopped.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0 runs in-process.
    scheduler : str
        Address of a Dask scheduler, whose workers have this package and see the same files.

    Raises
    ------
    OptionError
        When no scheduler answers at the address.
    """
    different: dict[str, Task] = {}
    for task in tasks:
        different.setdefault(task.key, task)
    new = [task for task in different.values() if task.key not in table]
    count = failures = 0
    with table, contextlib.closing(stream_each(compute, new, workers, scheduler)) as found:
        for number, result in found:
            if isinstance(result, Exception):
                row = failed(new[number], str(result))
            else:
                row = result
            table.add(row)
            count += not row.error
            failures += bool(row.error)
            on_row()
    return Done(count, failures, len(different) - len(new), len(tasks) - len(different))
