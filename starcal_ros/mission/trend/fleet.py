# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Tasks of a trend in this process or on a Dask cluster, their rows streamed into the table."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
import contextlib
import dataclasses
from dataclasses import dataclass
import itertools
import logging
import re
from typing import Any

from starcal_ros.errors import OptionError
from starcal_ros.formats.products.calibration_json import CALIBRATION_FILE
from starcal_ros.formats.products.product_files import make_folder, write_atomically
from starcal_ros.mission.trend.answers import Answer, compute, failed
from starcal_ros.mission.trend.rows import kept_name
from starcal_ros.mission.trend.tasks import KEPT_FOLDER, Task
from starcal_ros.mission.trend.trend_table import Table

Answers = Generator[tuple[Task, Answer], None, None]
MOST_SILENT = 5  # files that a store does not answer for, in a run; the others wait for the next
_CONNECT_S = 10.0
_AHEAD = 8  # tasks submitted ahead for each thread of a cluster: cancelling 100,000 is slow
_ADDRESS = re.compile(r'(tcp|tls)://[^/\s]+:\d{1,5}')
# A task whose worker ends is tried again here, alone; nothing in the current folder is imported.
_SETTINGS = {
    'distributed.scheduler.allowed-failures': 0,
    'distributed.nanny.pre-spawn-environ.PYTHONSAFEPATH': 1,
    'logging': {'distributed': 'critical'},
}


@dataclass
class Done:
    """
    How many tasks were computed, failed, or have the content of a row in the table.

    ``silent``: how many of the failed ones a store did not answer for.
    """

    computed: int = 0
    failed: int = 0
    known: int = 0
    silent: int = 0

    def count(self, table: Table, task: Task, answer: Answer) -> None:
        """Put an answer into the table, and count it."""
        row = answer.row
        if row is None or table.has(row):
            table.add_seen(task.stamp, answer.key)
            self.known += bool(answer.key)
            return
        if answer.calibration:
            folder = table.path.with_name(KEPT_FOLDER) / kept_name(row)
            make_folder(folder)
            write_atomically(folder / CALIBRATION_FILE, answer.calibration)
        table.add(row)
        self.computed += not row.error
        self.failed += bool(row.error)
        self.silent += answer.is_silence


def update(
    table: Table,
    tasks: Iterable[Task],
    workers: int = 0,
    scheduler: str = '',
    on_row: Callable[[], None] = lambda: None,
) -> Done:
    """
    Add the rows of the tasks that the table does not have; a task is taken when it is submitted.

    A task that ends its worker process, also alone, becomes the row of a failure; the others go
    on.  Failures that may pass are tried again, after the tasks that have no row.  The run ends
    early, and the next one continues, once a store has not answered for 5 files.
    The calibration of a bag is written beside the table before its row, and each row is on disk
    before the next, so a run that was stopped starts where it stopped.
    Raises OptionError when no scheduler answers at the address.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0 runs in-process.
    scheduler : str
        Address of a Dask scheduler whose workers have this package and see the same files; then
        no process is started.
    on_row : callable
        Called after each answer.
    """
    table.forget_failures([''])  # of files whose place does not tell when they change
    done, failures = Done(), table.failures()
    waiting = _not_known(table, tasks, done, failures)
    with contextlib.closing(_answers(waiting, workers, scheduler)) as answers:
        for task, answer in answers:
            done.count(table, task, answer)
            on_row()
            if done.silent == MOST_SILENT:
                return done
    # A file that was repaired or removed is no longer among the tasks.
    table.forget_failures(failures)
    return done


def _not_known(
    table: Table, tasks: Iterable[Task], done: Done, failures: dict[str, bool]
) -> Iterator[Task]:
    """Tasks that the table has no row of, then failures to try again; others are counted."""
    again: list[Task] = []
    for task in tasks:
        is_again = failures.pop(task.stamp, False)
        key = None if is_again else table.key_of(task.stamp)
        if key is not None:
            done.known += bool(key)
            continue
        likely = table.likely(task.size, task.spacecraft, task.camera)
        task = dataclasses.replace(task, known=likely)
        if is_again:
            again.append(task)
        else:
            yield task
    yield from again


def _answers(tasks: Iterator[Task], workers: int, scheduler: str) -> Answers:
    """Tasks with their answers, in any order."""
    first = list(itertools.islice(tasks, 1))
    tasks = itertools.chain(first, tasks)
    if first and (workers or scheduler):
        with _cluster(workers, scheduler) as (client, ahead):
            yield from _as_completed(client, ahead, tasks)
    else:
        yield from ((task, compute(task)) for task in tasks)


def _as_completed(client: Any, ahead: int, tasks: Iterator[Task]) -> Answers:
    """Answers of a cluster as they come, with ``ahead`` tasks submitted at a time."""
    from distributed import as_completed, KilledWorker

    running: dict[str, Task] = {}
    killed: list[Task] = []

    def submit(task: Task) -> Any:
        future = client.submit(compute, task, pure=False)
        running[future.key] = task
        return future

    # The second time alone: with its worker, tasks end that only waited there.
    for is_alone in (False, True):
        waiting = iter(killed) if is_alone else tasks
        first = map(submit, itertools.islice(waiting, 1 if is_alone else ahead))
        futures = as_completed(first, loop=client.loop)  # type: ignore[no-untyped-call]
        for future in futures:
            task, error = running.pop(future.key), future.exception()
            if error is None:
                yield task, future.result()
            elif isinstance(error, KilledWorker) and not is_alone:
                killed.append(task)
            else:
                if isinstance(error, KilledWorker):
                    error = 'ends its worker process, also alone: out of memory?'
                yield task, failed(task, str(error))
            for task in itertools.islice(waiting, 1):
                futures.add(submit(task))  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def _cluster(workers: int, address: str) -> Iterator[tuple[Any, int]]:
    """Client of a Dask cluster, here or at an address, and how many tasks to submit ahead."""
    import dask
    from distributed import Client, LocalCluster

    # For another scheme Dask prints a traceback after the time-out.
    if address and not _ADDRESS.fullmatch(address):
        raise OptionError(f'--scheduler: {address}: not tcp://HOST:PORT or tls://HOST:PORT')
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS))
        cluster: Any = address
        if not address:
            import cryptography  # noqa: F401

            # Without certificates another user of this machine could send it code.
            cluster = stack.enter_context(
                LocalCluster(  # type: ignore[no-untyped-call]
                    n_workers=workers,
                    threads_per_worker=1,
                    memory_limit=None,
                    host='127.0.0.1',
                    dashboard_address=None,
                    security=True,
                    silence_logs=logging.CRITICAL,
                )
            )
        try:
            client: Any = stack.enter_context(
                Client(  # type: ignore[no-untyped-call]
                    cluster, timeout=_CONNECT_S, set_as_default=False
                )
            )
        except (OSError, ValueError, TypeError) as error:
            raise OptionError(f'--scheduler: {address}: {error}') from error
        yield client, workers or _AHEAD * max(1, sum(client.nthreads().values()))
