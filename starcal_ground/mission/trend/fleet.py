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
_BATCH = 1000  # tasks in a message to the scheduler: Dask warns of one over 10 MB
_ADDRESS = re.compile(r'(tcp|tls)://[^/\s]+:\d{1,5}')
# A task whose worker ends is tried again here, alone; none waits on a worker meanwhile.
_SETTINGS = {
    'distributed.scheduler.allowed-failures': 0,
    'distributed.scheduler.worker-saturation': 1.0,
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
        url=posixpath.join(root, name),
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
        if task.size >= 0 and not (places.is_remote(task.url) or os.path.exists(task.url)):
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

    ``unreachable``: the reasons of those that failed and have no row.
    """

    computed: int = 0
    failed: int = 0
    known: int = 0
    unreachable: list[str] = field(default_factory=list)


def update(
    table: trend_table.Table,
    tasks: Iterable[Task],
    workers: int = 0,
    scheduler: str = '',
    on_row: Callable[[], None] = lambda: None,
    root: str = os.sep,
) -> Done:
    """
    Add the rows of the tasks that the table does not have.

    A task that ends its worker process, also alone, becomes the row of a failure; the others go
    on.  A file that cannot be reached has no row, so the next run tries it again.
    The calibration of a bag is written beside the table before its row, and each row is on disk
    before the next, so a run that was stopped starts where it stopped.
    Raises OptionError when Dask ends or no scheduler answers, OSError when the root cannot be
    reached any more.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0 runs in-process.
    scheduler : str
        Address of a Dask scheduler whose workers have this package and see the same files; then
        no process is started.
    on_row : callable
        Called after each answer.
    root : str
        Place of all files; it is asked for after each file that cannot be reached.
    """
    done, listed, new = Done(), set(), []
    for task in tasks:
        listed.add(task.stamp)
        if table.has(task.stamp, task.spacecraft, task.camera):
            done.known += 1
        else:
            new.append(task)
    is_here = not (new and (workers or scheduler))
    in_turn = (compute(task) for task in new)
    with contextlib.closing(in_turn if is_here else _by_dask(new, workers, scheduler)) as answers:
        for answer in answers:
            row = answer.row
            done.failed += row is None or bool(row.error)
            if row is not None:
                _keep(table, row, answer.calibration)
                done.computed += not row.error
            else:
                done.unreachable.append(answer.unreachable)
                if not places.exists(root):
                    raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), root)
            on_row()
    # A file that was repaired or removed is no longer among the tasks.
    table.forget_failures(but=listed)
    return done


def _keep(table: trend_table.Table, row: trend_table.Row, calibration: str) -> None:
    """Write the calibration of a bag beside the table, then the row."""
    if calibration:
        folder = table.path.with_name(KEPT_FOLDER) / trend_table.kept_name(row)
        products.make_folder(folder)
        product_files.write_atomically(folder / CALIBRATION_FILE, calibration)
    table.add(row)


def _by_dask(tasks: Sequence[Task], workers: int, address: str) -> Generator[Answer, None, None]:
    """Answers to tasks, as they come."""
    import dask
    from distributed import as_completed, Client, KilledWorker

    option = f'--scheduler: {address}' if address else f'--workers: {workers}'
    # For another scheme Dask prints a traceback after the time-out.
    if address and not _ADDRESS.fullmatch(address):
        raise OptionError(f'{option}: not tcp://HOST:PORT or tls://HOST:PORT')
    logging.getLogger('distributed').setLevel(logging.CRITICAL)
    before = dict(os.environ)
    # Neither workers nor the resource tracker that Python starts import from this folder.
    os.environ['PYTHONSAFEPATH'] = '1'
    try:
        with (
            dask.config.set(_SETTINGS),
            contextlib.nullcontext(address) if address else _here(workers) as cluster,
            Client(cluster, set_as_default=False) as client,  # type: ignore[no-untyped-call]
        ):
            futures = client.map(compute, tasks, pure=False, batch_size=_BATCH)
            waiting = {future.key: task for future, task in zip(futures, tasks, strict=True)}
            completed = as_completed(futures, loop=client.loop)  # type: ignore[no-untyped-call]
            ended: list[Task] = []
            del futures  # a worker holds each result while there is a future of it
            for future in completed:
                task, error = waiting.pop(future.key), future.exception()
                if isinstance(error, KilledWorker):
                    ended.append(task)
                else:
                    yield failed(task, str(error)) if error else future.result()
            # With its worker, tasks end that only waited there: the second time alone.
            for task in ended:
                error = (future := client.submit(compute, task, pure=False)).exception()
                if isinstance(error, KilledWorker):
                    error = 'ends its worker process, also alone: out of memory?'
                yield failed(task, str(error)) if error else future.result()
    # A worker that is killed while it starts, or a scheduler that is lost or not there.
    except (RuntimeError, OSError, ValueError, CancelledError, asyncio.CancelledError) as error:
        words = printable(' '.join(str(error).split())).rstrip('.')
        raise OptionError(
            f'{option}: Dask ended ({words}; no scheduler, or out of memory?): run again to'
            ' continue after the last row, or without workers'
        ) from error
    finally:
        # Dask sets the variables of its workers in this process, for good.
        os.environ.clear()
        os.environ.update(before)


def _here(workers: int) -> contextlib.AbstractContextManager[Any]:
    """A cluster on this machine that no other user reaches."""
    import cryptography  # noqa: F401
    from distributed import LocalCluster

    return LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=workers,
        threads_per_worker=1,
        memory_limit=None,  # at the limit a worker pauses, and may never go on
        host='127.0.0.1',
        dashboard_address='127.0.0.1:0',
        # Without certificates another user of this machine could send it code.
        security=True,
        silence_logs=logging.CRITICAL,
    )
