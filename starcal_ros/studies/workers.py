# Copyright 2026 starcal maintainers. SPDX-License-Identifier: Apache-2.0
"""Parallel trials and tasks, in processes of this machine or on a running Dask cluster."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
import contextlib
import functools
import itertools
import logging
import os
import pickle
import queue
import re
import selectors
import signal
import subprocess
import sys
import threading
from types import FrameType
from typing import Any, IO, TYPE_CHECKING, TypeVar

from starcal_ros.blas_threads import one_blas_thread
from starcal_ros.errors import OptionError, StarcalError
from starcal_ros.safe_path import module_command
from starcal_ros.studies.monte_carlo import Design, Row, run_trial

if TYPE_CHECKING:
    from distributed import Client, Future

Item = TypeVar('Item')
Result = TypeVar('Result')
Process = subprocess.Popen[bytes]

_CONNECT_S = 10.0
_POLL_S = 0.2  # interval of checks for an interrupt
_TRIES = 3  # of an item whose process ends, the last of them alone
_AHEAD = 8  # trials submitted ahead for each worker thread of a cluster
# One process for each processor: threads that never work would take 0.1 s each to start.
_ONE_THREAD = dict.fromkeys(('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'), '1')
_ADDRESS = re.compile(r'(tcp|tls)://[^/\s]+:\d{1,5}')


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def run_trials(
    design: Design,
    workers: int = 0,
    scheduler: str = '',
    on_trial: Callable[[], None] = lambda: None,
) -> list[Row]:
    """Rows of all trials of a design, in any order; see `run_each`."""
    trial = functools.partial(run_trial, design)
    found = run_each(trial, design.trials, workers, scheduler, on_trial)
    return [row for _, rows in found for row in rows]


def run_each(
    function: Callable[[int], Result],
    count: int,
    workers: int = 0,
    scheduler: str = '',
    on_each: Callable[[], None] = lambda: None,
) -> list[tuple[int, Result]]:
    """
    Pairs (number, result) of a function called with 0 to count - 1, in any order.

    Parameters
    ----------
    workers : int
        Processes to start on this machine; 0 runs in-process.
    scheduler : str
        Address of a Dask scheduler, whose workers have this package; then no process is started.
    on_each : callable
        Called after each result.

    Raises
    ------
    OptionError
        When no scheduler answers at the address.
    StarcalError
        When the processes of a call end early, each time that it is tried.
    """
    results = []
    with contextlib.closing(stream_each(function, range(count), workers, scheduler)) as found:
        for number, result in found:
            if isinstance(result, Exception):
                raise result
            results.append((number, result))
            on_each()
    return results


def stream_each(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    workers: int = 0,
    scheduler: str = '',
) -> Generator[tuple[int, Result | Exception], None, None]:
    """
    Pairs (index, result) of a function called with each item, in any order, as they come.

    The result of an item whose function raises, or whose process ends early each time that it is
    tried, is the exception.  ``workers`` and ``scheduler`` as for `run_each`.

    Raises
    ------
    OptionError
        When no scheduler answers at the address.
    """
    if not items:
        return
    # Here and not in the worker processes: those of a cluster are not ours.
    function = functools.partial(_on_one_thread, function)
    if not scheduler and workers == 0:
        for number, item in enumerate(items):
            try:
                yield number, function(item)
            except Exception as error:
                yield number, error
        return
    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(_interrupts_wait())
        if scheduler:
            import dask

            settings = {'logging': {'distributed': 'critical'}}
            stack.enter_context(dask.config.set(settings))
            stack.enter_context(_quiet())
            client = stack.enter_context(_client(scheduler))
            yield from _on_cluster(client, function, items, stop)
        else:
            start = pickle.dumps(sys.path) + pickle.dumps(function)
            processes = stack.enter_context(contextlib.closing(_Processes(start)))
            yield from _in_processes(processes, items, min(workers, len(items)), stop)


def _on_one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    """Result of a function, which must not depend on the threads of BLAS."""
    with one_blas_thread():
        return function(item)


class _Processes:
    """
    Worker processes that are reached through their own pipes only; closing ends them.

    No process starts from a copy of this one, whose threads may hold locks, nor listens on a
    socket, where another user could send it code.
    """

    def __init__(self, start: bytes) -> None:
        self._start = start
        self._idle: list[Process] = []
        self._busy = selectors.DefaultSelector()

    @property
    def busy(self) -> int:
        """Number of processes that have an item."""
        return len(self._busy.get_map())

    def send(self, number: int, item: object) -> None:
        """Give an item and its number to an idle process, or to a new one."""
        process = self._idle.pop() if self._idle else self._started()
        self._busy.register(_pipe(process.stdout), selectors.EVENT_READ, (process, number))
        # Of a process that has ended, `answers` reports the end.
        with contextlib.suppress(BrokenPipeError):
            pickle.dump(item, _pipe(process.stdin))
            _pipe(process.stdin).flush()

    def end_idle(self) -> None:
        """End the processes that have no item."""
        while self._idle:
            _end(self._idle.pop())

    def answers(self, timeout_s: float) -> list[tuple[int, bool, Any]]:
        """
        Triples (number, success, result or exception) that came within a time.

        Of a process that ended, success is False and the exception a `_Death`.
        """
        found: list[tuple[int, bool, Any]] = []
        for key, _ in self._busy.select(timeout_s):
            process, number = key.data
            self._busy.unregister(key.fileobj)
            try:
                found.append((number, *pickle.load(_pipe(process.stdout))))
                self._idle.append(process)
            except (OSError, EOFError, ValueError, pickle.UnpicklingError):
                _end(process)
                found.append((number, False, _Death(process.returncode)))
        return found

    def close(self) -> None:
        """End all processes."""
        busy = [key.data[0] for key in self._busy.get_map().values()]
        for process in (*self._idle, *busy):
            process.kill()
        for process in (*self._idle, *busy):
            _end(process)
        self._busy.close()

    def _started(self) -> Process:
        process = subprocess.Popen(
            module_command('starcal_ros.studies.worker'),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ONE_THREAD},
        )
        with contextlib.suppress(BrokenPipeError):
            _pipe(process.stdin).write(self._start)
        return process


class _Death(Exception):
    """A process ended with an exit status and did not answer."""


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    assert pipe is not None  # all are pipes, see `_Processes._started`
    return pipe


def _end(process: Process) -> None:
    """End a process that does not answer, and close its pipes."""
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):  # what was left to write finds no reader
            _pipe(pipe).close()


def _in_processes(
    processes: _Processes, items: Sequence[Item], workers: int, stop: threading.Event
) -> Iterator[tuple[int, Any]]:
    """
    Results as they come, from so many processes at a time.

    An item whose process ends is tried again in another and, if that ends too, at the end, in a
    new process while there is no other: where memory is short, the system may end the wrong one.
    """
    waiting, last = deque(range(len(items))), deque[int]()
    deaths: Counter[int] = Counter()
    while waiting or last or processes.busy:
        if stop.is_set():
            raise KeyboardInterrupt
        while waiting and processes.busy < workers:
            number = waiting.popleft()
            processes.send(number, items[number])
        if last and not processes.busy:
            processes.end_idle()
            number = last.popleft()
            processes.send(number, items[number])
        for number, success, result in processes.answers(_POLL_S):
            if success or not isinstance(result, _Death):
                yield number, result
                continue
            deaths[number] += 1
            if deaths[number] == _TRIES:
                status = result.args[0]
                yield (
                    number,
                    StarcalError(
                        f'a worker process ended with status {status}, the last of {_TRIES} times:'
                        ' out of memory?'
                    ),
                )
            elif deaths[number] == _TRIES - 1:
                last.append(number)
            else:
                waiting.append(number)


def _on_cluster(
    client: Client,
    function: Callable[[Item], Result],
    items: Sequence[Item],
    stop: threading.Event,
) -> Iterator[tuple[int, Result | Exception]]:
    """Results as they come, from the workers of a cluster."""
    from distributed import KilledWorker

    killed = []
    for number, result in _gather(client, function, dict(enumerate(items)), stop):
        if isinstance(result, KilledWorker):
            killed.append(number)
        else:
            yield number, result
    # An item that only waited on a worker that another one ended is blamed too: alone, each shows
    # whether it was the one.
    for number in killed:
        for _, result in _gather(client, function, {number: items[number]}, stop):
            if isinstance(result, KilledWorker):
                result = StarcalError('the workers of the cluster ended with it: out of memory?')
            yield number, result


def _gather(
    client: Client,
    function: Callable[[Item], Result],
    items: Mapping[int, Item],
    stop: threading.Event,
) -> Iterator[tuple[int, Result | Exception]]:
    """Results as they come; submits few tasks ahead, since cancelling 100,000 of them is slow."""
    finished: queue.SimpleQueue[Future[Result]] = queue.SimpleQueue()
    submitted: dict[Future[Result], int] = {}
    waiting = iter(items.items())

    def submit(most: int) -> None:
        for number, item in itertools.islice(waiting, most):
            future = client.submit(function, item, pure=False, retries=2)
            submitted[future] = number
            future.add_done_callback(finished.put)  # type: ignore[no-untyped-call]

    threads = client.nthreads()  # type: ignore[no-untyped-call]
    submit(_AHEAD * max(1, sum(threads.values())))
    while submitted:
        if stop.is_set():
            raise KeyboardInterrupt
        with contextlib.suppress(queue.Empty):
            future = finished.get(timeout=_POLL_S)
            number = submitted.pop(future)
            try:
                result: Result | Exception = future.result()
            except Exception as error:
                result = error
            submit(1)
            yield number, result


@contextlib.contextmanager
def _interrupts_wait() -> Iterator[threading.Event]:
    """
    Ctrl-C sets an event; a second one raises `KeyboardInterrupt` at once.

    An exception raised inside the Dask client can leave a lock held, on which closing the client
    would wait forever.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            signal.default_int_handler(number, frame)
        stop.set()

    before = signal.signal(signal.SIGINT, note)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


def _client(address: str) -> Client:
    from distributed import Client

    # Of another scheme Dask prints a traceback after the time-out.
    if not _ADDRESS.fullmatch(address):
        raise OptionError(f'--scheduler: {address}: not tcp://HOST:PORT or tls://HOST:PORT')
    try:
        return Client(  # type: ignore[no-untyped-call]
            address, timeout=_CONNECT_S, set_as_default=False
        )
    except (OSError, ValueError, TypeError) as error:
        raise OptionError(f'--scheduler: {address}: {error}') from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress messages about connections that close at the end of a run."""
    logger = logging.getLogger('distributed')
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
