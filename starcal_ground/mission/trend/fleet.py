# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The tasks of a fleet: found below a root, answered where their files are, counted into the table.

A task is a calibration to read or a bag to calibrate.  Its answer is made in this process or by a
worker of Dask.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
import contextlib
from dataclasses import dataclass, field, replace
import errno
import functools
import hashlib
import itertools
import logging
import math
import os
from pathlib import Path
import posixpath
import re
import socket
from typing import Any

import numpy as np

from starcal_ground import file_kinds, products
from starcal_ground.bags import reader
from starcal_ground.bags.topics import Topics
from starcal_ground.campaign import calibrate, chosen, observe, Source
from starcal_ground.images.first_setup import air_of
from starcal_ground.mission.trend import places, trend_table
from starcal_ros import processes, untrusted
from starcal_ros.errors import OptionError, StarcalError
from starcal_ros.formats.messages.message_codec import OBSERVATIONS_TYPE
from starcal_ros.formats.products import product_files
from starcal_ros.formats.products.product_files import CALIBRATION_FILE
from starcal_ros.pipeline.setup import files_of, read_setup
from starcal_ros.records import StarObservations
from starcal_ros.text import printable

KEPT_FOLDER = 'trend.calibrations'  # beside the table; those of bags, no source of rows
_ARCHIVED = re.compile(r'\d{8,}_calibration_\d{8,}\.json')  # in the state folder of a calibrator
_METADATA = 'metadata.yaml'
_KEYS = ('spacecraft', 'camera')
_NOT_SEEN = 'not seen by this worker; mount it under the same path as on the client'
MOST_SILENT = 5  # files in turn that a store does not give, before it is asked if it answers
_CONNECT_S = 10.0
_AHEAD = 8  # tasks submitted ahead for each thread of a cluster: cancelling 100,000 is slow
_ADDRESS = re.compile(r'(tcp|tls)://[^/\s]+:\d{1,5}')
# A task whose worker ends is tried again here, alone.
_SETTINGS = {
    'distributed.scheduler.allowed-failures': 0,
    'logging': {'distributed': 'critical'},
}


@dataclass(frozen=True, slots=True)
class Task:
    """
    A calibration file to read, or a bag to calibrate.

    Attributes
    ----------
    url : str
        Absolute path or URL.
    stamp : str
        Digest of name, identity and settings, none of which is read from the file: what has it is
        not read again.
    files : tuple of str
        Those that are read, as far as the listing shows.
    size : int
        Their bytes; -1 if one could not be read when it was listed.
    params : str
        Parameter file for a bag; empty for a calibration.
    spacecraft, camera : str
        From the pattern of cameras.
    """

    url: str
    stamp: str
    files: tuple[str, ...]
    size: int = 0
    params: str = ''
    spacecraft: str = ''
    camera: str = ''


def find(root: str, cameras: Cameras) -> Iterator[Task]:
    """
    Tasks below a root, as it is listed; no file is read.

    A bag is a task where it has parameters and no calibration beside it.  Raises OSError when a
    folder cannot be listed. Raises StarcalError when a parameter file or a file that it names
    cannot be read.
    """
    settings_of = functools.cache(_settings)
    for entries in places.listings(root):
        listed = {e.name: e for e in entries if KEPT_FOLDER not in e.name.split('/')}
        yield from _tasks(root, listed, cameras, settings_of)


def _tasks(
    root: str,
    listed: dict[str, places.Entry],
    cameras: Cameras,
    settings_of: Callable[[str], str],
) -> Iterator[Task]:
    """Tasks of files by name: calibrations in order of their paths, then bags."""
    for name, entry in listed.items():
        if posixpath.basename(name) == CALIBRATION_FILE:
            beside = posixpath.join(posixpath.dirname(name), products.OBSERVATIONS_FILE)
            yield _task(root, name, (entry,), cameras, beside=listed.get(beside))
        elif _ARCHIVED.fullmatch(posixpath.basename(name)):
            yield _task(root, name, (entry,), cameras)
    for name, files in _bags(listed).items():
        folder = posixpath.dirname(name) if name in listed else name
        params = cameras.params_of(name)
        if params and posixpath.join(folder, CALIBRATION_FILE) not in listed:
            yield _task(root, name, files, cameras, params, settings_of(params))


def _settings(params: str) -> str:
    """Digest of the contents of a parameter file and of those that it names, where they exist."""
    sha256 = hashlib.sha256()
    for file in (Path(params), *files_of(read_setup(Path(params)).frames).values()):
        if os.path.lexists(file):
            with untrusted.regular_file(file) as stream:
                while block := stream.read(1 << 20):
                    sha256.update(block)
    return sha256.hexdigest()


def _task(
    root: str,
    name: str,
    files: Sequence[places.Entry],
    cameras: Cameras,
    params: str = '',
    settings: str = '',
    beside: places.Entry | None = None,
) -> Task:
    """A task; a file ``beside`` is read with it, and decides nothing."""
    spacecraft, camera = map(printable, cameras.of(name))
    text = f'{[(entry.name, entry.identity) for entry in files]!r} {settings}'
    return Task(
        url=places.join(root, name),
        stamp=hashlib.sha256(text.encode()).hexdigest(),
        files=tuple(entry.url for entry in (*files, *filter(None, [beside]))),
        size=sum(entry.size for entry in files) if all(e.size >= 0 for e in files) else -1,
        params=params,
        spacecraft=spacecraft,
        camera=camera,
    )


def _bags(listed: dict[str, places.Entry]) -> dict[str, list[places.Entry]]:
    """Bag folders with a metadata.yaml, and single files elsewhere; no files of an archive."""
    bags: dict[str, list[places.Entry]] = {}
    for name, entry in listed.items():
        folder, file = posixpath.split(name)
        # One image each: the state of a calibrator, calibrated there.
        if not file.endswith('.mcap') or posixpath.basename(folder) == 'ensemble':
            continue
        metadata = listed.get(posixpath.join(folder, _METADATA))
        if metadata and file != products.OBSERVATIONS_FILE:
            bags.setdefault(folder, [metadata]).append(entry)
        else:
            bags[name] = [entry]
    return bags


@dataclass(frozen=True)
class Cameras:
    """
    Which camera a path below the root belongs to, and the parameters of that camera.

    Attributes
    ----------
    pattern : regular expression or None
        Of the start of a path, with groups for spacecraft and camera.
    params : str
        Parameter file, in which ``{spacecraft}`` and ``{camera}`` are replaced; may be empty.
    """

    pattern: re.Pattern[str] | None = None
    params: str = ''

    def of(self, name: str) -> tuple[str, str]:
        """Spacecraft and camera of a path below the root, empty if nothing names them."""
        match = self.pattern.match(name) if self.pattern else None
        names = match.groupdict() if match else {}
        return names.get(_KEYS[0], ''), names.get(_KEYS[1], '')

    def params_of(self, name: str) -> str:
        """Absolute path of the parameters of a bag; empty if there are none."""
        if not self.params:
            return ''
        spacecraft, camera = self.of(name)
        text = self.params.replace('{spacecraft}', spacecraft).replace('{camera}', camera)
        return os.path.abspath(text)


def read_cameras(pattern: str, params: str) -> Cameras:
    """
    Cameras by a pattern such as ``{spacecraft}/{camera}/*.mcap``, empty for none.

    The expression is of the start of a path, up to the segment of the last name.  Raises
    OptionError in one line, for a pattern without a name.
    """
    if not pattern:
        return Cameras(params=params)
    start = pattern[: pattern.rfind('}') + 1]
    start += pattern[len(start) :].partition('/')[0]
    expression = re.escape(start.removeprefix('./')).replace(r'\*', '[^/]*')
    for key in _KEYS:
        expression = expression.replace(rf'\{{{key}\}}', f'(?P<{key}>[^/]+?)', 1)
    if '(?P' not in expression or re.search(r'\\[{}]', expression):
        raise OptionError(
            f'--cameras: {untrusted.shown(pattern)}: not a pattern with {{spacecraft}} and'
            ' {camera}'
        )
    return Cameras(re.compile(f'{expression}(?:/|$)'), params)


@dataclass(frozen=True)
class Answer:
    """
    The row that a task gives, and ``calibration.json`` of a bag.

    No row where a file cannot be reached; ``unreachable`` says why.
    """

    row: trend_table.Row | None
    calibration: str = ''
    unreachable: str = ''


def compute(task: Task) -> Answer:
    """Answer to a task; for one that fails, the row with its error."""
    try:
        if task.size >= 0 and not places.exists(task.url):
            raise FileNotFoundError(errno.ENOENT, _NOT_SEEN, task.url)
        # The result must not depend on the threads of BLAS.
        with places.fetched(task.url, task.files, task.size) as path, processes.one_blas_thread():
            return _answer(task, path)
    except (OSError, ModuleNotFoundError) as error:
        reason = f'cannot be read: {getattr(error, "strerror", "") or error}'
        if task.size < 0:  # nor could the client
            return failed(task, reason)
        return Answer(None, unreachable=f'{task.url}: {socket.gethostname()}: {reason}')
    # One bag must not end a run over thousands, whatever is in it.
    except Exception as error:
        return failed(task, f'{type(error).__name__}: {error}')


def failed(task: Task, error: str) -> Answer:
    """Answer to a task that failed."""
    return Answer(_of_camera(trend_table.failure(task.stamp, task.url, error), task))


def _of_camera(row: trend_table.Row, task: Task) -> trend_table.Row:
    return replace(row, spacecraft=task.spacecraft, camera=task.camera)


def _answer(task: Task, path: Path) -> Answer:
    """Answer by the file at a path; raises OSError where it cannot be read."""
    text = ''
    try:
        if task.params:
            setup = read_setup(Path(task.params))
            source = Source((path,), Topics(), setup, air_of(setup))
            campaign = calibrate(observe(chosen(source)))
            made, kind = campaign.calibration, trend_table.COMPUTED
            degc = _mean_temperature(campaign.observations)
            text = product_files.calibration_text(made)
        else:
            made, kind = product_files.read_calibration(path), trend_table.RECORDED
            degc = _temperature(path.with_name(products.OBSERVATIONS_FILE))
        row = trend_table.row_of(made, task.stamp, task.url, kind, degc)
        return Answer(_of_camera(row, task), text)
    except (StarcalError, ValueError) as error:
        cause = error.__cause__
        if isinstance(cause, OSError):
            raise cause from error
        said = file_kinds.explained(error) if isinstance(error, StarcalError) else str(error)
        return failed(task, said.replace(str(path), task.url))


def _temperature(observations: Path) -> float:
    """Mean temperature of recorded observations; NaN without any."""
    if not observations.is_file():
        return math.nan
    try:
        topic = reader.choose_topic([observations], OBSERVATIONS_TYPE)
        records: list[StarObservations] = list(reader.read_observations([observations], topic))
    except StarcalError:
        return math.nan
    return _mean_temperature([record for record in records if not record.refusal])


def _mean_temperature(records: Sequence[StarObservations]) -> float:
    degc = np.array([record.temperature_degc for record in records])
    known = degc[~np.isnan(degc)]
    return float(np.mean(known)) if len(known) else math.nan


@dataclass
class Done:
    """
    How many tasks were computed, failed, or have a row in the table.

    ``unreachable``: the reasons of those that failed and have no row; ``silent``: how many files
    in turn a store did not give in the end.
    """

    computed: int = 0
    failed: int = 0
    known: int = 0
    unreachable: list[str] = field(default_factory=list)
    silent: int = 0

    def count(self, table: trend_table.Table, task: Task, answer: Answer) -> None:
        """Put an answer into the table, and count it."""
        row = answer.row
        self.silent = 0 if row or not places.is_remote(task.url) else self.silent + 1
        self.failed += not row or bool(row.error)
        if row is None:
            self.unreachable.append(answer.unreachable)
            return
        if answer.calibration:
            folder = table.path.with_name(KEPT_FOLDER) / trend_table.kept_name(row)
            products.make_folder(folder)
            product_files.write_atomically(folder / CALIBRATION_FILE, answer.calibration)
        table.add(row)
        self.computed += not row.error


def update(
    table: trend_table.Table,
    tasks: Iterable[Task],
    workers: int = 0,
    scheduler: str = '',
    on_row: Callable[[], None] = lambda: None,
) -> Done:
    """
    Add the rows of the tasks that the table does not have; a task is taken when it is submitted.

    A task that ends its worker process, also alone, becomes the row of a failure; the others go
    on.  A file that cannot be reached has no row, so the next run tries it again.  The run ends
    early, and the next one continues, once a store has not given 5 files in turn and does not say
    whether the last one exists.
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
    done, failures = Done(), table.failures()
    with contextlib.closing(
        _answers(_not_known(table, tasks, done, failures), workers, scheduler)
    ) as answers:
        for task, answer in answers:
            done.count(table, task, answer)
            on_row()
            if done.silent == MOST_SILENT:
                if not places.is_answered(task.url):
                    return done
                done.silent = 0  # by these files only
    # A file that was repaired or removed is no longer among the tasks.
    table.forget(failures)
    return done


def _not_known(
    table: trend_table.Table, tasks: Iterable[Task], done: Done, failures: set[str]
) -> Iterator[Task]:
    """Tasks without a row, which are then no longer among the failures; others are counted."""
    for task in tasks:
        failures.discard(task.stamp)
        if table.has(task.stamp, task.spacecraft, task.camera):
            done.known += 1
        else:
            yield task


def _answers(
    tasks: Iterator[Task], workers: int, scheduler: str
) -> Generator[tuple[Task, Answer], None, None]:
    """Tasks with their answers, in any order."""
    first = list(itertools.islice(tasks, 1))
    tasks = itertools.chain(first, tasks)
    if first and (workers or scheduler):
        try:
            with _cluster(workers, scheduler) as (client, ahead):
                yield from _as_completed(client, ahead, tasks)
        # A worker that is killed while it starts, or a scheduler that is lost.
        except (RuntimeError, OSError, CancelledError, asyncio.CancelledError) as error:
            option = f'--scheduler: {scheduler}' if scheduler else f'--workers: {workers}'
            words = printable(' '.join(str(error).split())).rstrip('.')
            raise OptionError(
                f'{option}: Dask ended ({words}; out of memory?): run again to continue after the'
                ' last row, or without workers'
            ) from error
    else:
        yield from ((task, compute(task)) for task in tasks)


def _as_completed(
    client: Any, ahead: int, tasks: Iterator[Task]
) -> Generator[tuple[Task, Answer], None, None]:
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


def _set_environment(variables: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(variables)


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
        # Dask sets the variables of its workers in this process, for good.
        stack.callback(_set_environment, dict(os.environ))
        # Neither workers nor the resource tracker that Python starts import from this folder.
        os.environ['PYTHONSAFEPATH'] = '1'
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
                    # Its default is port 8787 of all addresses, once in a machine.
                    scheduler_kwargs={'dashboard_address': '127.0.0.1:0'},
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
