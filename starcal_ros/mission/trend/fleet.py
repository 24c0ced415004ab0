# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tasks of a trend on worker processes or a Dask cluster, rows streamed into the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
import dataclasses
from dataclasses import dataclass, field
import time

from starcal_ros.mission.trend.answers import compute, failed, Seen
from starcal_ros.mission.trend.rows import Row, START
from starcal_ros.mission.trend.tasks import Task
from starcal_ros.mission.trend.trend_table import Table
from starcal_ros.studies.workers import stream_each

_PAUSES_S = (1.0, 10.0)  # before a file that could not be reached is tried again


@dataclass
class Done:
    """How many tasks were computed, failed, were in the table before, or repeat another one."""

    computed: int = 0
    failed: int = 0
    known: int = 0
    repeated: int = 0
    _starts: set[str] = field(default_factory=set, compare=False, repr=False)

    def count_known(self, start: str) -> None:
        """Count a file whose row, named by the start of its key, is in the table."""
        if start:
            self.known += start not in self._starts
            self.repeated += start in self._starts
            self._starts.add(start)

    def count(self, table: Table, task: Task, answer: Row | Seen) -> None:
        """Put an answer into the table, and count it."""
        if isinstance(answer, Seen):
            table.add_seen(task.stamp, answer)
            self.count_known(answer.key)
        elif table.add(answer):
            self.computed += not answer.error
            self.failed += bool(answer.error)
            self._starts.add(answer.key[:START])
        else:
            self.count_known(answer.key[:START])


def update(
    table: Table,
    tasks: Sequence[Task],
    workers: int = 0,
    scheduler: str = '',
    on_row: Callable[[], None] = lambda: None,
) -> Done:
    """
    Add the rows of the tasks that the table does not have.

    A task that ends its worker process on every attempt becomes the row of a failure; the others
    go on.  A file that cannot be reached is tried again after the others, with a pause.
    What is computed is on disk within a batch, so a run that was stopped starts where it stopped.
    A worker writes the calibration of a bag beside the table before its row is sent, so that each
    row on disk has its calibration.
    ``workers`` and ``scheduler`` as for `run_each`; the workers of a cluster see the same files.
    """
    done = Done()
    waiting = []
    for task in tasks:
        start = table.start_of(task)
        if start is not None:
            done.count_known(start)
        else:
            waiting.append(dataclasses.replace(task, known=table.likely(task), table=table.folder))
    with table:
        for pause_s in (*_PAUSES_S, None):
            again = []
            with contextlib.closing(stream_each(compute, waiting, workers, scheduler)) as found:
                for task, answer in found:
                    if isinstance(answer, Exception):
                        answer = failed(task, str(answer))
                    if isinstance(answer, Row) and answer.is_passing and pause_s is not None:
                        again.append(task)
                        continue
                    done.count(table, task, answer)
                    on_row()
            if not again or pause_s is None:
                break
            time.sleep(pause_s)
            waiting = again
    return done
