# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tasks of a trend on worker processes or a Dask cluster, rows streamed into the table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
import contextlib
import dataclasses
from dataclasses import dataclass
import time

from starcal_ros.mission.trend.answers import compute, failed, Seen
from starcal_ros.mission.trend.rows import Row, START
from starcal_ros.mission.trend.tasks import Task
from starcal_ros.mission.trend.trend_table import Table
from starcal_ros.mission.trend.workers import stream_each

_PAUSES_S = (1.0, 10.0)  # before a file that could not be reached is tried again
_MOST_AGAIN = 10_000  # such files; where a whole store is gone, others are tried by the next run


@dataclass
class Done:
    """How many tasks were computed, failed, were in the table before, or repeat another one."""

    computed: int = 0
    failed: int = 0
    known: int = 0
    repeated: int = 0

    def count_known(self, table: Table, start: str) -> None:
        """Count a file whose row, named by the start of its key, is in the table."""
        if start:
            is_first = table.count(start)
            self.known += is_first
            self.repeated += not is_first

    def count(self, table: Table, task: Task, answer: Row | Seen) -> None:
        """Put an answer into the table, and count it."""
        if isinstance(answer, Seen):
            table.add_seen(task.stamp, answer)
            self.count_known(table, answer.key)
        elif table.add(answer):
            self.computed += not answer.error
            self.failed += bool(answer.error)
        else:
            self.count_known(table, answer.key[:START])


def update(
    table: Table,
    tasks: Iterable[Task],
    workers: int = 0,
    scheduler: str = '',
    on_row: Callable[[], None] = lambda: None,
    with_reports: bool = False,
) -> Done:
    """
    Add the rows of the tasks that the table does not have; a task is taken when it is submitted.

    A task that ends its worker process on every attempt becomes the row of a failure; the others
    go on.  A file that cannot be reached, one of the first 10,000, is tried again after the
    others, with a pause.
    What is computed is on disk within a batch, so a run that was stopped starts where it stopped.
    A worker writes the calibration of a bag (and its report) beside the table before its row is
    sent, so that each row on disk has its calibration.
    ``workers``, ``scheduler`` as for `stream_each`; the workers of a cluster see the same files.
    """
    done = Done()
    waiting = _not_known(table, tasks, done, with_reports)
    with table:
        for pause_s in (*_PAUSES_S, None):
            again: list[Task] = []
            with contextlib.closing(stream_each(compute, waiting, workers, scheduler)) as found:
                for task, answer in found:
                    if isinstance(answer, Exception):
                        answer = failed(task, str(answer))
                    may_pass = isinstance(answer, Row) and answer.is_passing
                    if may_pass and pause_s is not None and len(again) < _MOST_AGAIN:
                        again.append(task)
                        continue
                    done.count(table, task, answer)
                    on_row()
            if not again or pause_s is None:
                break
            time.sleep(pause_s)
            waiting = iter(again)
    return done


def _not_known(
    table: Table, tasks: Iterable[Task], done: Done, with_report: bool
) -> Iterator[Task]:
    """Tasks that the table has no row of, with what a worker asks of the table; others count."""
    for task in tasks:
        start = table.start_of(task)
        if start is None:
            yield dataclasses.replace(
                task, known=table.likely(task), table=table.folder, with_report=with_report
            )
        else:
            done.count_known(table, start)
