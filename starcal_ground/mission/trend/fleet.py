# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""
The tasks of a fleet: found below a root, answered where their files are, counted into the table.

A task is a calibration to read or a bag to calibrate.  Its row is made in this process or by a
worker of Dask.  The root is a folder, or any URL of fsspec (``s3://``, ``gs://``).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError
import contextlib
from dataclasses import dataclass, field
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
import tempfile
from typing import Any, TYPE_CHECKING

import numpy as np

from starcal_ground import file_kinds, products
from starcal_ground.bags import reader
from starcal_ground.bags.topics import Topics
from starcal_ground.campaign import chosen, observe, Source
from starcal_ground.images.first_setup import air_of
from starcal_ground.mission.trend.trend_table import COMPUTED, FAILED, RECORDED, Row, Table
from starcal_ground.parameter_files import read_setup
from starcal_ground.source_diagnosis import calibrated
from starcal_ros import processes, untrusted
from starcal_ros.errors import OptionError, StarcalError
from starcal_ros.formats.messages.message_codec import OBSERVATIONS_TYPE
from starcal_ros.formats.products.product_files import CALIBRATION_FILE, read_calibration
from starcal_ros.pipeline.setup import files_of
from starcal_ros.records import Calibration, StarObservations
from starcal_ros.text import printable

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_ARCHIVED = re.compile(r'\d{8,}_calibration_\d{8,}\.json')  # in the state folder of a calibrator
_METADATA = 'metadata.yaml'
_KEYS = ('spacecraft', 'camera')
_IDENTITIES = (  # S3, Google and Azure name them differently
    *('ETag', 'etag', 'md5Hash'),
    *('LastModified', 'last_modified', 'updated', 'mtime', 'created'),
)
_LONGEST_REASON, _LONGEST_ERROR = 200, 2000  # characters
_NOT_SEEN = 'not seen by this worker; mount it under the same path as on the client'
_BATCH = 1000  # tasks in a message to the scheduler: Dask warns of one over 10 MB
_ADDRESS = re.compile(r'(tcp|tls)://[^/\s]+:\d{1,5}')
# A task whose worker ends is tried again here, alone; none waits on a worker meanwhile.
_SETTINGS = {
    'distributed.scheduler.allowed-failures': 0,
    'distributed.scheduler.worker-saturation': 1.0,
    'logging': {'distributed': 'critical'},
}


@dataclass(frozen=True)
class Cameras:
    """
    Which camera a path below the root belongs to, and the parameters of that camera.

    Raises OptionError in one line, for a pattern without a name.

    Attributes
    ----------
    pattern : str
        Such as ``{spacecraft}/{camera}/*.mcap``; it applies to the start of a path, up to the
        segment of the last name.  Empty for none.
    params : str
        Parameter file, in which ``{spacecraft}`` and ``{camera}`` are replaced; may be empty.
    """

    pattern: str = ''
    params: str = ''

    def __post_init__(self) -> None:
        """Check the pattern."""
        expression = self._expression.pattern
        if self.pattern and ('(?P' not in expression or re.search(r'\\[{}]', expression)):
            raise OptionError(
                f'--cameras: {untrusted.shown(self.pattern)}: not a pattern with {{spacecraft}}'
                ' and {camera}'
            )

    @functools.cached_property
    def _expression(self) -> re.Pattern[str]:
        named, brace, rest = self.pattern.rpartition('}')
        start = f'{named}{brace}{rest.partition("/")[0]}'.removeprefix('./')
        expression = re.escape(start).replace(r'\*', '[^/]*')
        for key in _KEYS:
            expression = expression.replace(rf'\{{{key}\}}', f'(?P<{key}>[^/]+?)', 1)
        return re.compile(f'{expression}(?:/|$)')

    def of(self, name: str) -> dict[str, str]:
        """Spacecraft and camera of a path below the root, empty if nothing names them."""
        match = self._expression.match(name)
        names = match.groupdict() if match else {}
        return {key: printable(names.get(key, '')) for key in _KEYS}

    def params_of(self, name: str) -> str:
        """Absolute path of the parameters of a bag; empty if there are none."""
        params = self.params
        for key, value in self.of(name).items():
            params = params.replace(f'{{{key}}}', value)
        return params and os.path.abspath(params)


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
        Those that are read, relative to the folder of ``url``.
    params : str
        Parameter file for a bag; empty for a calibration.
    spacecraft, camera : str
        From the pattern of cameras.
    """

    url: str
    stamp: str
    files: tuple[str, ...] = ()
    params: str = ''
    spacecraft: str = ''
    camera: str = ''


def find(root: str, cameras: Cameras) -> Iterator[Task]:
    """
    Tasks below a root, as it is listed: calibrations of a listing, then bags; no file is read.

    A bag is a task where it has parameters and no calibration beside it.  Raises OSError when a
    store cannot be listed.  Raises StarcalError when a parameter file or a file that it names
    cannot be read.
    """
    settings_of = functools.cache(_settings)

    def task(name: str, files: Sequence[str], params: str = '') -> Task:
        settings = settings_of(params) if params else ''
        text = f'{[(file, listed[file]) for file in files]!r} {settings}'
        stamp = hashlib.sha256(text.encode()).hexdigest()
        folder = posixpath.dirname(name)
        # Read with it for the temperature, which decides nothing.
        beside = posixpath.join(folder, products.OBSERVATIONS_FILE)
        read = [*files, beside] if not params and beside in listed else files
        names = tuple(posixpath.relpath(file, folder or '.') for file in read)
        return Task(posixpath.join(root, name), stamp, names, params, **cameras.of(name))

    for listed in _listings(root):
        for name in listed:
            file = posixpath.basename(name)
            if file == CALIBRATION_FILE or _ARCHIVED.fullmatch(file):
                yield task(name, [name])
        for name, files in _bags(listed).items():
            folder = posixpath.dirname(name) if name in listed else name
            params = cameras.params_of(name)
            if params and posixpath.join(folder, CALIBRATION_FILE) not in listed:
                yield task(name, files, params)


def _settings(params: str) -> str:
    """Digest of the contents of a parameter file and of those that it names, where they exist."""
    sha256 = hashlib.sha256()
    for file in (Path(params), *files_of(read_setup(Path(params)).frames).values()):
        if os.path.lexists(file):
            with untrusted.regular_file(file) as stream:
                while block := stream.read(1 << 20):
                    sha256.update(block)
    return sha256.hexdigest()


def _bags(listed: Mapping[str, str]) -> dict[str, list[str]]:
    """Files of bag folders with a metadata.yaml, and single files elsewhere."""
    bags: dict[str, list[str]] = {}
    for name in listed:
        folder, file = posixpath.split(name)
        # One image each: the state of a calibrator, calibrated there.
        if not file.endswith('.mcap') or posixpath.basename(folder) == 'ensemble':
            continue
        metadata = posixpath.join(folder, _METADATA)
        if metadata in listed and file != products.OBSERVATIONS_FILE:
            bags.setdefault(folder, [metadata]).append(name)
        else:
            bags[name] = [name]
    return bags


def absolute(place: str) -> str:
    """The place as every process finds it: an absolute path, or the URL."""
    return place.rstrip('/') if is_remote(place) else os.path.abspath(place)


def is_remote(place: str) -> bool:
    """True for a URL."""
    return '://' in place


def exists(place: str) -> bool:
    """True for a file or a folder; raises OSError."""
    if not is_remote(place):
        return os.path.exists(place)
    with _store(place) as (fs, path):
        fs.invalidate_cache()
        return bool(fs.exists(path))


def _listings(root: str) -> Iterator[dict[str, str]]:
    """
    Files below a root by their paths from there: of a folder each, or of all of a store.

    Their identities change with the content: size, and etag or time where it is known.
    """
    if not is_remote(root):
        for folder, folders, files in os.walk(root):
            folders.sort()
            paths = (os.path.join(folder, name) for name in sorted(files))
            yield {os.path.relpath(path, root): _identity(path) for path in paths}
        return
    with _store(root) as (fs, base):
        fs.invalidate_cache()
        infos = fs.find(base, detail=True)
    yield {
        posixpath.relpath(path, base): f'{info["size"]} '
        f'{next((info[name] for name in _IDENTITIES if info.get(name)), "")}'
        for path, info in sorted(infos.items())
    }


def _identity(path: str) -> str:
    try:
        status = os.stat(path)
    except OSError as error:
        return f'error {error.errno}'
    return f'{status.st_size} {status.st_mtime_ns}'


@contextlib.contextmanager
def _fetched(task: Task) -> Iterator[Path]:
    """
    The path of a file or folder while the block runs; raises OSError.

    Remote files are copied into a temporary folder of this machine, since readers of bags seek
    and are C code; local ones are read where they are.
    """
    if not is_remote(task.url):
        if not os.path.exists(task.url):
            raise FileNotFoundError(errno.ENOENT, _NOT_SEEN, task.url)
        yield Path(task.url)
        return
    with tempfile.TemporaryDirectory(prefix='starcal-') as folder:
        with _store(posixpath.dirname(task.url)) as (fs, base):
            there = [posixpath.join(base, file) for file in task.files]
            fs.get(there, [os.path.join(folder, file) for file in task.files])
        yield Path(folder, posixpath.basename(task.url))


@contextlib.contextmanager
def _store(url: str) -> Iterator[tuple[AbstractFileSystem, str]]:
    """The file system of a URL and the path there; failures of its client become OSError."""
    import fsspec

    try:
        yield fsspec.core.url_to_fs(url)
    # Each client of an object store has exceptions of its own, or leaves out the reason.
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise
        if isinstance(cause := error.__cause__, ModuleNotFoundError):  # the client
            raise ModuleNotFoundError(str(cause), name=cause.name) from error
        words = ' '.join(f'{type(error).__name__}: {error}'.split())
        raise OSError(errno.EIO, words[:_LONGEST_REASON], url) from error


def compute(task: Task) -> Row:
    """Row of a task, of one that fails with its error; raises OSError without its files."""
    path = Path(task.url)
    try:
        # The result must not depend on the threads of BLAS.
        with _fetched(task) as path, processes.one_blas_thread():
            if not task.params:
                return row_of(task, RECORDED, read_calibration(path), _observations(path))
            setup = read_setup(Path(task.params))
            source = Source((path,), Topics(), setup, air_of(setup))
            campaign = calibrated(observe(chosen(source)))
            return row_of(task, COMPUTED, campaign.calibration, campaign.observations)
    # One bag must not end a run over thousands, whatever is in it.
    except Exception as error:
        for cause in (error, error.__cause__):
            if isinstance(cause, (OSError, ModuleNotFoundError)):
                reason = getattr(cause, 'strerror', '') or cause
                words = f'{socket.gethostname()}: cannot be read: {reason}'
                raise OSError(errno.EIO, words, task.url) from error
        words = f'{type(error).__name__}: {error}'
        if isinstance(error, StarcalError):
            words = file_kinds.explained(error)
        return failed(task, words.replace(str(path), task.url))


def failed(task: Task, error: str) -> Row:
    """Row of a task that failed."""
    words = printable(' '.join(error.split()) or 'failed')[:_LONGEST_ERROR]
    return _row_of(task, FAILED, error=words)


def _row_of(task: Task, kind: str, **values: Any) -> Row:
    return Row(task.stamp, printable(task.url), kind, task.spacecraft, task.camera, **values)


def row_of(
    task: Task, kind: str, made: Calibration, observations: Iterable[StarObservations] = ()
) -> Row:
    """Row of a calibration, with the mean temperature of its observations."""
    degc = np.array([image.temperature_degc for image in observations if not image.refusal])
    known = degc[np.isfinite(degc)]
    reference_degc = made.temperature.reference_degc if made.temperature else math.nan
    return _row_of(
        task,
        kind,
        time_ns=((made.first_image_ns or made.time_ns) + made.time_ns) // 2,
        temperature_degc=float(known.mean()) if len(known) else reference_degc,
        calibration=made,
    )


def _observations(calibration: Path) -> list[StarObservations]:
    """Observations beside a calibration; none where they are missing or damaged."""
    file = calibration.with_name(products.OBSERVATIONS_FILE)
    if file.is_file():
        with contextlib.suppress(StarcalError):
            topic = reader.choose_topic([file], OBSERVATIONS_TYPE)
            return list(reader.read_observations([file], topic))
    return []


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
    table: Table,
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
    Each row is on disk before the next, so a run that was stopped starts where it stopped.
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
    by_dask = new and (workers or scheduler)
    answers = _by_dask(new, workers, scheduler) if by_dask else _in_turn(new)
    with contextlib.closing(answers):
        for answer in answers:
            if isinstance(answer, Row):
                table.add(answer)
                done.computed += not answer.error
            else:
                done.unreachable.append(f'{answer.filename}: {answer.strerror}')
                if not exists(root):
                    raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), root)
            done.failed += not isinstance(answer, Row) or bool(answer.error)
            on_row()
    # A file that was repaired or removed is no longer among the tasks.
    table.forget_failures(but=listed)
    return done


Answers = Generator['Row | OSError', None, None]


def _in_turn(tasks: Sequence[Task]) -> Answers:
    """Rows of tasks, or why their files cannot be reached."""
    for task in tasks:
        try:
            yield compute(task)
        except OSError as error:
            yield error


def _by_dask(tasks: Sequence[Task], workers: int, address: str) -> Answers:
    """Rows of tasks as they come, or why their files cannot be reached."""
    import dask
    from distributed import as_completed, Client, KilledWorker

    def answer(task: Task, future: Any) -> Row | OSError:
        error = future.exception()
        if isinstance(error, KilledWorker):
            return failed(task, 'ends its worker process, also alone: out of memory?')
        return error if isinstance(error, OSError) else future.result()

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
                task = waiting.pop(future.key)
                if isinstance(future.exception(), KilledWorker):
                    ended.append(task)
                else:
                    yield answer(task, future)
            # With its worker, tasks end that only waited there: the second time alone.
            for task in ended:
                yield answer(task, client.submit(compute, task, pure=False))
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
